//! Vectors, seeded random numbers and value noise.

use std::cell::Cell;
use std::ops::{Add, Mul, Neg, Sub};

use super::Assets;
use super::photo_texture::Patch;
use tmpi_core::Mat3;

/// A vector, a point or a linear RGB colour.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct V3 {
    pub x: f64,
    pub y: f64,
    pub z: f64,
}

pub(super) const fn v3(x: f64, y: f64, z: f64) -> V3 {
    V3 { x, y, z }
}

impl Add for V3 {
    type Output = V3;
    fn add(self, o: V3) -> V3 {
        v3(self.x + o.x, self.y + o.y, self.z + o.z)
    }
}

impl Sub for V3 {
    type Output = V3;
    fn sub(self, o: V3) -> V3 {
        v3(self.x - o.x, self.y - o.y, self.z - o.z)
    }
}

impl Mul<f64> for V3 {
    type Output = V3;
    fn mul(self, s: f64) -> V3 {
        v3(self.x * s, self.y * s, self.z * s)
    }
}

impl Neg for V3 {
    type Output = V3;
    fn neg(self) -> V3 {
        v3(-self.x, -self.y, -self.z)
    }
}

impl V3 {
    pub fn dot(self, o: V3) -> f64 {
        self.x * o.x + self.y * o.y + self.z * o.z
    }

    pub fn cross(self, o: V3) -> V3 {
        v3(self.y * o.z - self.z * o.y, self.z * o.x - self.x * o.z, self.x * o.y - self.y * o.x)
    }

    pub fn norm(self) -> f64 {
        self.dot(self).sqrt()
    }

    pub fn unit(self) -> V3 {
        self * (1.0 / self.norm().max(1e-300))
    }

    /// Componentwise product.
    pub fn mul(self, o: V3) -> V3 {
        v3(self.x * o.x, self.y * o.y, self.z * o.z)
    }

    pub fn map(self, f: impl Fn(f64) -> f64) -> V3 {
        v3(f(self.x), f(self.y), f(self.z))
    }

    pub fn min(self, o: V3) -> V3 {
        v3(self.x.min(o.x), self.y.min(o.y), self.z.min(o.z))
    }

    pub fn max(self, o: V3) -> V3 {
        v3(self.x.max(o.x), self.y.max(o.y), self.z.max(o.z))
    }

    pub fn lerp(self, o: V3, t: f64) -> V3 {
        self * (1.0 - t) + o * t
    }

    pub fn array(self) -> [f64; 3] {
        [self.x, self.y, self.z]
    }
}

pub(super) const RIGHT: V3 = v3(1.0, 0.0, 0.0);
pub(super) const DOWN: V3 = v3(0.0, 1.0, 0.0);
pub(super) const AHEAD: V3 = v3(0.0, 0.0, 1.0);

/// Orthonormal frame: origin, and local x, y and z axes in world coordinates.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Frame {
    pub origin: V3,
    pub axes: [V3; 3],
}

impl Frame {
    pub fn at(origin: V3) -> Self {
        Self { origin, axes: [RIGHT, DOWN, AHEAD] }
    }

    /// A frame whose axes are the columns of `m`.
    pub fn turned(origin: V3, m: &Mat3) -> Self {
        Self { origin, axes: std::array::from_fn(|j| v3(m[0][j], m[1][j], m[2][j])) }
    }

    /// A frame rotated about the vertical by `radians`.
    pub fn yaw(origin: V3, radians: f64) -> Self {
        let (s, c) = radians.sin_cos();
        Self { origin, axes: [v3(c, 0.0, -s), v3(0.0, 1.0, 0.0), v3(s, 0.0, c)] }
    }

    /// A frame whose y axis is along `axis`; the other axes are arbitrary.
    pub fn along(origin: V3, axis: V3) -> Self {
        let y = axis.unit();
        let helper = if y.x.abs() < 0.8 { RIGHT } else { AHEAD };
        let z = helper.cross(y).unit();
        Self { origin, axes: [y.cross(z), y, z] }
    }

    pub fn dir_in(&self, d: V3) -> V3 {
        v3(d.dot(self.axes[0]), d.dot(self.axes[1]), d.dot(self.axes[2]))
    }

    pub fn point_in(&self, p: V3) -> V3 {
        self.dir_in(p - self.origin)
    }

    pub fn dir_out(&self, d: V3) -> V3 {
        self.axes[0] * d.x + self.axes[1] * d.y + self.axes[2] * d.z
    }

    pub fn point_out(&self, p: V3) -> V3 {
        self.dir_out(p) + self.origin
    }
}

/// `SplitMix64`: small, and the same on every machine. The state is a cell, so that calls may nest in arguments. The generator carries the
/// assets, because most random choices of textures and objects need both.
#[derive(Debug)]
pub(super) struct Rng {
    state: Cell<u64>,
    pub assets: Assets,
}

impl Rng {
    #[cfg(test)]
    pub fn new(seed: u64) -> Self {
        Self::with(seed, &Assets::default())
    }

    pub fn with(seed: u64, assets: &Assets) -> Self {
        let r = Self { state: Cell::new(seed ^ 0x5851_f42d_4c95_7f2d), assets: assets.clone() };
        r.next();
        r
    }

    /// A random piece of a picture, if there are pictures.
    pub fn patch(&self) -> Option<Patch> {
        let of = &self.assets.pictures.0;
        (!of.is_empty()).then(|| Patch::cut(&of[(self.next() % of.len() as u64) as usize], self))
    }

    /// A whole picture in every other call, if there are pictures. Without pictures, does not advance the generator.
    pub fn backdrop(&self) -> Option<Patch> {
        let of = &self.assets.pictures.0;
        (!of.is_empty() && self.chance(0.5)).then(|| Patch::whole(&of[(self.next() % of.len() as u64) as usize]))
    }

    pub fn next(&self) -> u64 {
        self.state.set(self.state.get().wrapping_add(0x9e37_79b9_7f4a_7c15));
        mix(self.state.get())
    }

    /// Uniform in [0, 1).
    pub fn unit(&self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn range(&self, a: f64, b: f64) -> f64 {
        a + (b - a) * self.unit()
    }

    /// Uniform in the logarithm; `a` and `b` are positive.
    pub fn log_range(&self, a: f64, b: f64) -> f64 {
        self.range(a.ln(), b.ln()).exp()
    }

    /// Uniform in `a..=b`.
    pub fn int(&self, a: u32, b: u32) -> u32 {
        a + (self.next() % u64::from(b - a + 1)) as u32
    }

    pub fn chance(&self, p: f64) -> bool {
        self.unit() < p
    }

    /// A random element of `items`, which must not be empty.
    pub fn pick<T: Copy>(&self, items: &[T]) -> T {
        items[(self.next() % items.len() as u64) as usize]
    }

    pub fn sign(&self) -> f64 {
        if self.chance(0.5) { 1.0 } else { -1.0 }
    }

    /// A random rotation with uniform yaw, pitch and roll; not uniform over all rotations.
    pub fn rotation(&self) -> Mat3 {
        let angle = || self.range(-180.0, 180.0);
        tmpi_core::Pose { yaw: angle(), pitch: angle(), roll: angle(), ..Default::default() }.orientation()
    }
}

fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Hash of a lattice point, in [0, 1).
pub(super) fn hash3(x: i64, y: i64, z: i64, seed: u32) -> f64 {
    let k = (x as u64).wrapping_mul(0x8da6_b343_d816_3841)
        ^ (y as u64).wrapping_mul(0xd8e1_63d4_1cb1_ab1f)
        ^ (z as u64).wrapping_mul(0xcb1a_b31f_58f3_7a2d)
        ^ u64::from(seed).wrapping_mul(0x2545_f491_4f6c_dd1d);
    (mix(k) >> 40) as f64 / (1u64 << 24) as f64
}

/// Value noise with period 1 between lattice points, in [0, 1).
pub(super) fn noise(p: V3, seed: u32) -> f64 {
    let f = p.map(f64::floor);
    let s = (p - f).map(|t| t * t * (3.0 - 2.0 * t));
    let (x, y, z) = (f.x as i64, f.y as i64, f.z as i64);
    let row = |dy, dz| {
        let (a, b) = (hash3(x, y + dy, z + dz, seed), hash3(x + 1, y + dy, z + dz, seed));
        a + (b - a) * s.x
    };
    let slab = |dz| {
        let (a, b) = (row(0, dz), row(1, dz));
        a + (b - a) * s.y
    };
    let (a, b) = (slab(0), slab(1));
    a + (b - a) * s.z
}

/// Sum of noise octaves, in [0, 1]. Octaves finer than `width` are replaced by their mean, to avoid aliasing on far surfaces.
pub(super) fn fbm(p: V3, octaves: u32, width: f64, seed: u32) -> f64 {
    let (mut sum, mut total, mut amplitude, mut frequency) = (0.0, 0.0, 0.5, 1.0);
    for o in 0..octaves {
        let v = if width * frequency > 0.8 { 0.5 } else { noise(p * frequency, seed.wrapping_add(o)) };
        sum += amplitude * v;
        total += amplitude;
        amplitude *= 0.55;
        frequency *= 2.03;
    }
    sum / total
}

pub(super) fn smoothstep(a: f64, b: f64, x: f64) -> f64 {
    let t = ((x - a) / (b - a)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}
