//! Objects, light and sky of a scene; traces and shades single rays.

use super::bvh::{Aabb, Bvh};
use super::cutout::CutoutShape;
use super::math::{Frame, Rng, V3, fbm, smoothstep, v3};
use super::shape::Shape;
use super::texture::Texture;

#[derive(Debug)]
pub(super) struct Object {
    shape: Shape,
    frame: Frame,
    texture: Texture,
    /// Parts of a compound object share a group; the hidden surface is behind the whole group.
    group: u32,
}

#[derive(Clone, Copy, Debug)]
pub(super) enum Light {
    /// Unit direction towards the sun, and its colour.
    Sun(V3, V3),
    /// Position of a lamp, and its colour at one metre.
    Lamp(V3, V3),
}

#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sky {
    pub zenith: V3,
    pub horizon: V3,
    pub cloud: V3,
    /// Cloud cover in [0, 1].
    pub cover: f64,
    pub seed: u32,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Hit {
    /// Ray parameter, in lengths of the direction.
    pub t: f64,
    pub object: u32,
    pub group: u32,
    /// Local unit normal, outward.
    normal: V3,
    /// Index of the triangle, in a mesh.
    triangle: u32,
}

#[derive(Debug, Default)]
pub(super) struct World {
    objects: Vec<Object>,
    unbounded: Vec<u32>,
    tree: Bvh,
    /// The reference camera.
    pub eye: Frame,
    /// Field of view along the longer side of the picture, in degrees.
    pub fov: f64,
    pub lights: Vec<Light>,
    pub ambient: V3,
    pub sky: Sky,
    /// Colour and density per metre.
    pub fog: Option<(V3, f64)>,
    pub exposure: f64,
    groups: u32,
}

impl World {
    pub fn new(rng: &Rng) -> Self {
        let grey = v3(0.5, 0.55, 0.6);
        let sky = Sky { zenith: v3(0.12, 0.25, 0.6), horizon: grey, cloud: v3(0.9, 0.9, 0.9), cover: 0.4, seed: rng.next() as u32 };
        Self { eye: Frame::at(V3::default()), fov: 60.0, ambient: v3(0.4, 0.4, 0.4), sky, exposure: 1.0, ..Self::default() }
    }

    pub fn group(&mut self) -> u32 {
        self.groups += 1;
        self.groups
    }

    pub fn add(&mut self, group: u32, frame: Frame, shape: Shape, texture: Texture) {
        self.objects.push(Object { shape, frame, texture, group });
    }

    /// Adds a flat piece around `centre`, spanned by two perpendicular unit vectors.
    #[allow(clippy::too_many_arguments, reason = "each names one geometric quantity; a struct would only repeat them")]
    pub fn card(&mut self, group: u32, centre: V3, right: V3, down: V3, half: (f64, f64), cutout: CutoutShape, texture: Texture) {
        let frame = Frame { origin: centre, axes: [right, down, right.cross(down)] };
        self.add(group, frame, Shape::Card(half.0, half.1, cutout), texture);
    }

    /// Adds a round bar from `a` to `b`.
    pub fn bar(&mut self, group: u32, a: V3, b: V3, radii: (f64, f64), texture: Texture) {
        let d = b - a;
        let half = (d.norm() * 0.5).max(1e-6);
        self.add(group, Frame::along((a + b) * 0.5, d), Shape::Cylinder(half, radii.0, radii.1), texture);
    }

    /// Builds the tree. Call this once, after the last object.
    pub fn finish(&mut self) {
        let mut boxes = Vec::with_capacity(self.objects.len());
        for (i, o) in self.objects.iter().enumerate() {
            let Some((half, mid)) = o.shape.bounds() else {
                self.unbounded.push(i as u32);
                continue;
            };
            let c = o.frame.point_out(mid);
            let [a, b, d] = o.frame.axes.map(|v| v.map(f64::abs));
            let e = a * half.x + b * half.y + d * half.z + v3(1e-9, 1e-9, 1e-9);
            boxes.push((i as u32, Aabb { low: c - e, high: c + e }));
        }
        self.tree = Bvh::new(&boxes);
    }

    fn hit_object(&self, i: u32, o: V3, d: V3, near: f64, far: f64) -> Option<(f64, V3, u32)> {
        let object = &self.objects[i as usize];
        object.shape.hit_triangle(object.frame.point_in(o), object.frame.dir_in(d), near, far)
    }

    /// Nearest hit beyond `near`, ignoring the group `skip` (0 ignores none).
    pub fn trace(&self, o: V3, d: V3, near: f64, skip: u32) -> Option<Hit> {
        let mut best: Option<Hit> = None;
        let mut test = |i: u32, far: f64| {
            let group = self.objects[i as usize].group;
            if group == skip {
                return far;
            }
            match self.hit_object(i, o, d, near, far) {
                Some((t, normal, triangle)) => {
                    best = Some(Hit { t, object: i, group, normal, triangle });
                    t
                }
                None => far,
            }
        };
        let mut far = f64::INFINITY;
        for &i in &self.unbounded {
            far = test(i, far);
        }
        self.tree.walk(o, d, far, test);
        best
    }

    fn occluded(&self, o: V3, d: V3, far: f64) -> bool {
        if self.unbounded.iter().any(|&i| self.hit_object(i, o, d, 0.0, far).is_some()) {
            return true;
        }
        let mut hit = false;
        self.tree.walk(o, d, far, |i, far| {
            if self.hit_object(i, o, d, 0.0, far).is_some() {
                hit = true;
                return -1.0;
            }
            far
        });
        hit
    }

    /// Linear colour of a hit; `pixel` is the width of a pixel per length of `d`.
    pub fn shade(&self, o: V3, d: V3, hit: &Hit, pixel: f64) -> V3 {
        let object = &self.objects[hit.object as usize];
        let p = o + d * hit.t;
        let mut n = object.frame.dir_out(hit.normal);
        let facing = n.dot(d) / d.norm();
        if facing > 0.0 {
            n = -n;
        }
        let width = hit.t * pixel / facing.abs().max(0.15);
        let place = object.frame.point_in(p);
        let albedo = match &object.shape {
            Shape::Mesh(mesh, scale) => mesh.colour(hit.triangle, place * (1.0 / scale), width / scale),
            _ => object.texture.at(place, hit.normal, width),
        };
        let mut light = self.ambient * (0.7 - 0.3 * n.y);
        let lift = p + n * (1e-5 * (1.0 + hit.t));
        let mut shine = 0.0;
        for l in &self.lights {
            let (dir, far, colour) = match *l {
                Light::Sun(dir, colour) => (dir, f64::INFINITY, colour),
                Light::Lamp(place, colour) => {
                    let v = place - lift;
                    let r = v.norm();
                    (v * (1.0 / r.max(1e-9)), r, colour * (1.0 / (0.3 + r * r)))
                }
            };
            let cos = n.dot(dir);
            if cos > 0.0 && !self.occluded(lift, dir, far) {
                light = light + colour * cos;
                if object.texture.gloss > 0.0 {
                    let half = (dir - d.unit()).unit();
                    shine += object.texture.gloss * n.dot(half).max(0.0).powi(40) * colour.y;
                }
            }
        }
        let c = albedo.mul(light) + albedo * object.texture.glow + v3(shine, shine, shine);
        match self.fog {
            Some((colour, density)) => c.lerp(colour, 1.0 - (-density * hit.t * d.norm()).exp()),
            None => c,
        }
    }

    /// Linear colour of the sky in direction `d`.
    pub fn sky_at(&self, d: V3) -> V3 {
        let d = d.unit();
        let up = (-d.y).max(0.0);
        let s = &self.sky;
        let mut c = s.horizon.lerp(s.zenith, smoothstep(0.0, 0.7, up.sqrt()));
        if s.cover > 0.0 && up > 0.0 {
            let q = v3(d.x, 0.0, d.z) * (1.5 / (up + 0.12));
            let f = fbm(q, 5, 0.01, s.seed);
            c = c.lerp(s.cloud, smoothstep(1.0 - s.cover, 1.25 - s.cover, f + 0.15) * smoothstep(0.0, 0.12, up));
        }
        for l in &self.lights {
            if let Light::Sun(dir, colour) = l {
                let a = dir.dot(d).max(0.0);
                c = c + *colour * (0.12 * a.powi(60) + 3.0 * smoothstep(0.9994, 0.9997, a));
            }
        }
        c
    }

    /// Linear colour along a ray, of the hit or the sky.
    pub fn colour(&self, o: V3, d: V3, hit: Option<&Hit>, pixel: f64) -> V3 {
        hit.map_or_else(|| self.sky_at(d), |h| self.shade(o, d, h, pixel))
    }

    /// Converts a linear colour to display values in [0, 1]: exposure, highlight compression, gamma.
    pub fn display(&self, c: V3) -> V3 {
        c.map(|v| {
            let x = (v * self.exposure).max(0.0);
            (x * (1.0 + x / 6.0) / (1.0 + x)).min(1.0).powf(1.0 / 2.2)
        })
    }
}
