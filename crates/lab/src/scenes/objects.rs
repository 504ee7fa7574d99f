//! Compound objects for scenes: people, trees, furniture, vessels, cars, fences.

use super::cutout::CutoutShape;
use super::math::{DOWN, Frame, Rng, V3, v3};
use super::shape::Shape;
use super::texture::{Pattern, Texture, colour, hsv};
use super::world::World;

pub(super) struct Build<'a> {
    pub w: &'a mut World,
    pub rng: &'a Rng,
}

impl Build<'_> {
    /// Adds an object that is not part of another.
    pub fn put(&mut self, texture: Texture, frame: Frame, shape: Shape) {
        let group = self.w.group();
        self.w.add(group, frame, shape, texture);
    }

    /// Adds a box of half extents `half`; `at` is the centre of its footprint.
    pub fn block(&mut self, texture: Texture, at: V3, half: V3, yaw: f64) {
        self.put(texture, Frame::yaw(at - DOWN * half.y, yaw), Shape::Cuboid(half));
    }

    fn ball(&mut self, g: u32, centre: V3, r: V3, t: Texture) {
        self.w.add(g, Frame::at(centre), Shape::Ellipsoid(r), t);
    }

    /// A box in a frame whose origin is the centre of the object's footprint.
    fn slab(&mut self, g: u32, f: &Frame, at: V3, half: V3, t: &Texture) {
        let frame = Frame { origin: f.point_out(at), axes: f.axes };
        self.w.add(g, frame, Shape::Cuboid(half), t.clone());
    }

    /// Sometimes places a model of similar size instead of an object of `size` metres at `at`, if there are models. Returns whether it did;
    /// otherwise the caller builds the object.
    pub fn place_model(&mut self, at: V3, size: f64, yaw: f64) -> bool {
        let Some(model) = self.rng.assets.models.similar(self.rng, size) else { return false };
        let (g, turned) = (self.w.group(), yaw + f64::from(self.rng.int(0, 3)) * std::f64::consts::FRAC_PI_2);
        let (scale, surface) = (self.rng.range(0.85, 1.15), Texture::plain(self.rng, v3(1.0, 1.0, 1.0)).glossy(0.1));
        for part in model.parts.iter() {
            self.w.add(g, Frame::yaw(at, turned), Shape::Mesh(part.clone(), scale), surface.clone());
        }
        true
    }

    fn skin(&self) -> V3 {
        let v = self.rng.range(0.3, 0.95);
        let s = self.rng.range(0.25, 0.6);
        hsv(self.rng.range(0.02, 0.09), s, v)
    }

    fn cloth(&self) -> Texture {
        let scale = self.rng.log_range(0.05, 0.3);
        if self.rng.chance(0.35) { Texture::any(self.rng, scale) } else { Texture::plain(self.rng, colour(self.rng)) }
    }

    /// A person made of ellipsoids and bars, with feet at `at`.
    pub fn person(&mut self, at: V3, height: f64, yaw: f64) {
        if self.place_model(at, height, yaw) {
            return;
        }
        let g = self.w.group();
        let f = Frame::yaw(at, yaw);
        let s = height / 1.75;
        let p = |x: f64, y: f64, z: f64| f.point_out(v3(x * s, -y * s, z * s));
        let (skin, shirt, legs) = (Texture::plain(self.rng, self.skin()), self.cloth(), self.cloth());
        let hair_colour = hsv(self.rng.range(0.03, 0.12), self.rng.range(0.1, 0.7), self.rng.range(0.03, 0.5));
        let hair = Texture::of(self.rng, Pattern::Noise, 0.05, [hair_colour, hair_colour * 0.5, hair_colour]);
        let broad = self.rng.range(0.85, 1.3);
        let sit = self.rng.chance(0.2);
        let drop = if sit { 0.45 } else { 0.0 };
        self.ball(g, p(0.0, 1.62 - drop, 0.0), v3(0.085, 0.12, 0.1) * s, skin.clone());
        self.ball(g, p(0.0, 1.66 - drop, -0.02), v3(0.095, 0.105, 0.11) * s, hair);
        self.w.bar(g, p(0.0, 1.55 - drop, 0.0), p(0.0, 1.4 - drop, 0.0), (0.05 * s, 0.06 * s), skin.clone());
        let chest = Frame { origin: p(0.0, 1.2 - drop, 0.0), axes: f.axes };
        self.w.add(g, chest, Shape::Ellipsoid(v3(0.2 * broad, 0.34, 0.13 * broad) * s), shirt.clone());
        self.ball(g, p(0.0, 0.95 - drop, 0.0), v3(0.16 * broad, 0.15, 0.13 * broad) * s, legs.clone());
        for side in [-1.0, 1.0] {
            let (a, b, c) = (self.rng.range(0.0, 0.35), self.rng.range(-0.25, 0.3), self.rng.range(-0.35, 0.6));
            let elbow = p(side * (0.24 * broad + a), 1.13 - drop + a * 0.7, b);
            let hand = p(side * (0.2 + a), 1.13 - drop + c, b + self.rng.range(0.0, 0.25));
            self.w.bar(g, p(side * 0.19 * broad, 1.4 - drop, 0.0), elbow, (0.055 * s, 0.045 * s), shirt.clone());
            self.w.bar(g, elbow, hand, (0.042 * s, 0.032 * s), skin.clone());
            self.ball(g, hand, v3(0.045, 0.045, 0.045) * s, skin.clone());
            let (kx, kz) = (self.rng.range(0.06, 0.16), if sit { 0.42 } else { self.rng.range(-0.15, 0.25) });
            let knee = p(side * kx, if sit { 0.5 } else { 0.48 }, kz);
            let foot = p(side * kx, 0.05, if sit { kz } else { kz * self.rng.range(-0.5, 1.2) });
            self.w.bar(g, p(side * 0.09, 0.92 - drop, 0.0), knee, (0.085 * s, 0.065 * s), legs.clone());
            self.w.bar(g, knee, foot, (0.06 * s, 0.045 * s), legs.clone());
            self.ball(g, foot, v3(0.05, 0.05, 0.12) * s, legs.clone());
        }
    }

    /// A flat figure at `at` that roughly faces the direction `toward` (unit, horizontal), `height` metres high.
    pub fn cutout(&mut self, at: V3, height: f64, toward: V3, cutout: CutoutShape, aspect: f64) {
        let g = self.w.group();
        let yaw = self.rng.range(-0.6, 0.6);
        let (s, c) = yaw.sin_cos();
        let right = v3(toward.z * c - toward.x * s, 0.0, -toward.x * c - toward.z * s).unit();
        let t = Texture::any(self.rng, height * self.rng.log_range(0.05, 0.5));
        self.w.card(g, at - DOWN * (height * 0.5), right, DOWN, (height * 0.5 * aspect, height * 0.5), cutout, t);
    }

    pub fn tree(&mut self, at: V3, height: f64) {
        let g = self.w.group();
        let bark = hsv(self.rng.range(0.04, 0.1), 0.4, self.rng.range(0.15, 0.45));
        let trunk = Texture::of(self.rng, Pattern::Noise, 0.1, [bark, bark * 0.5, bark]);
        let lean = v3(self.rng.range(-0.08, 0.08), -1.0, self.rng.range(-0.08, 0.08));
        let top = at + lean * (height * 0.6);
        let r = height * self.rng.range(0.02, 0.05);
        self.w.bar(g, at, top, (r, r * 0.5), trunk.clone());
        let leaf = hsv(self.rng.range(0.16, 0.38), self.rng.range(0.3, 0.8), self.rng.range(0.2, 0.6));
        let crown = Texture::of(self.rng, Pattern::Foliage, height * self.rng.range(0.04, 0.15), [leaf, leaf * 0.5, leaf * 0.3]);
        match self.rng.int(0, 3) {
            0 => {
                let half = height * self.rng.range(0.3, 0.42);
                let shape = Shape::Cylinder(half, 0.02, half * self.rng.range(0.4, 0.7));
                self.w.add(g, Frame::at(at - DOWN * (height - half)), shape, crown);
            }
            1 | 2 => {
                for _ in 0..self.rng.int(4, 9) {
                    let size = height * self.rng.range(0.12, 0.25);
                    let spread = height * 0.2;
                    let off = v3(self.rng.range(-1.0, 1.0), self.rng.range(-1.2, 0.6), self.rng.range(-1.0, 1.0)) * spread;
                    self.ball(g, top + off - DOWN * (height * 0.12), v3(size, size * 0.8, size), crown.clone());
                }
            }
            _ => {
                for _ in 0..self.rng.int(8, 24) {
                    let size = height * self.rng.range(0.06, 0.16);
                    let off = v3(self.rng.range(-1.0, 1.0), self.rng.range(-1.2, 0.8), self.rng.range(-1.0, 1.0)) * (height * 0.26);
                    let cutout = CutoutShape::Crown(self.rng.range(3.0, 7.0), self.rng.next() as u32);
                    let frame = Frame::turned(top + off - DOWN * (height * 0.1), &self.rng.rotation());
                    self.w.add(g, frame, Shape::Card(size, size, cutout), crown.clone());
                }
            }
        }
    }

    /// Bare twigs that fork `depth` times; `span` is the first one.
    pub fn twigs(&mut self, g: u32, from: V3, span: V3, radius: f64, depth: u32, bark: &Texture) {
        let to = from + span;
        let (length, along) = (span.norm(), span.unit());
        self.w.bar(g, from, to, (radius, radius * 0.7), bark.clone());
        if depth == 0 {
            return;
        }
        for _ in 0..self.rng.int(2, 3) {
            let bend = v3(self.rng.range(-1.0, 1.0), self.rng.range(-1.0, 0.7), self.rng.range(-1.0, 1.0)) * 0.75;
            let start = from + (to - from) * self.rng.range(0.4, 1.0);
            let next = (along + bend).unit() * (length * self.rng.range(0.5, 0.8));
            self.twigs(g, start, next, radius * 0.6, depth - 1, bark);
        }
    }

    pub fn table(&mut self, at: V3, yaw: f64) {
        if self.place_model(at, 1.2, yaw) {
            return;
        }
        let (f, g) = (Frame::yaw(at, yaw), self.w.group());
        let t = Texture::any(self.rng, 0.3);
        let (x, z, h) = (self.rng.range(0.3, 0.9), self.rng.range(0.3, 0.6), self.rng.range(0.4, 0.9));
        self.slab(g, &f, v3(0.0, -h, 0.0), v3(x, 0.025, z), &t);
        for (i, k) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
            self.slab(g, &f, v3(i * (x - 0.05), -h * 0.5, k * (z - 0.05)), v3(0.025, h * 0.5, 0.025), &t);
        }
        for _ in 0..self.rng.int(0, 5) {
            let p = v3(self.rng.range(-x, x) * 0.85, -h - 0.025, self.rng.range(-z, z) * 0.85);
            self.vessel(f.point_out(p), 1.0);
        }
    }

    pub fn chair(&mut self, at: V3, yaw: f64) {
        let (f, g) = (Frame::yaw(at, yaw), self.w.group());
        let t = Texture::any(self.rng, 0.2);
        let (w, h) = (self.rng.range(0.19, 0.26), self.rng.range(0.4, 0.75));
        self.slab(g, &f, v3(0.0, -h, 0.0), v3(w, 0.025, w), &t);
        let bars = self.rng.chance(0.4);
        for (i, k) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
            let foot = f.point_out(v3(i * w * 0.95, 0.0, k * w * 0.95));
            self.w.bar(g, foot, f.point_out(v3(i * w * 0.9, -h, k * w * 0.9)), (0.018, 0.018), t.clone());
        }
        let back = self.rng.range(0.35, 0.6);
        if bars {
            for i in -3..=3 {
                let x = f64::from(i) / 3.0 * w * 0.9;
                self.w.bar(g, f.point_out(v3(x, -h, w)), f.point_out(v3(x, -h - back, w + 0.06)), (0.012, 0.012), t.clone());
            }
            self.slab(g, &f, v3(0.0, -h - back, w + 0.06), v3(w, 0.03, 0.015), &t);
        } else {
            self.slab(g, &f, v3(0.0, -h - back * 0.55, w), v3(w, back * 0.45, 0.02), &t);
        }
    }

    pub fn sofa(&mut self, at: V3, yaw: f64) {
        let (f, g) = (Frame::yaw(at, yaw), self.w.group());
        let t = Texture::any(self.rng, 0.25);
        let w = self.rng.range(0.45, 1.2);
        self.slab(g, &f, v3(0.0, -0.21, 0.0), v3(w, 0.21, 0.45), &t);
        self.slab(g, &f, v3(0.0, -0.45, 0.4), v3(w, 0.42, 0.12), &t);
        for i in [-1.0, 1.0] {
            self.slab(g, &f, v3(i * w, -0.3, 0.0), v3(0.1, 0.3, 0.45), &t);
        }
        for _ in 0..self.rng.int(0, 3) {
            let c = self.cloth();
            let p = f.point_out(v3(self.rng.range(-w, w) * 0.7, -0.6, 0.15));
            self.put(c, Frame::yaw(p, yaw + self.rng.range(-0.5, 0.5)), Shape::Ellipsoid(v3(0.22, 0.2, 0.09)));
        }
    }

    /// A cupboard or an open shelf with books; its back is at `at`, and its front faces local −z.
    pub fn shelf(&mut self, at: V3, yaw: f64, half_width: f64, height: f64, boards: u32) {
        let (f, g) = (Frame::yaw(at, yaw), self.w.group());
        let t = Texture::any(self.rng, 0.4);
        let deep = self.rng.range(0.12, 0.25);
        self.slab(g, &f, v3(0.0, -height * 0.5, -0.01), v3(half_width, height * 0.5, 0.01), &t);
        for i in [-1.0, 1.0] {
            self.slab(g, &f, v3(i * half_width, -height * 0.5, -deep), v3(0.015, height * 0.5, deep), &t);
        }
        let gap = height / f64::from(boards);
        for b in 0..=boards {
            let y = -gap * f64::from(b);
            self.slab(g, &f, v3(0.0, y, -deep), v3(half_width, 0.015, deep), &t);
            if b == boards {
                break;
            }
            let mut x = -half_width + 0.03;
            while x < half_width - 0.06 {
                if self.rng.chance(0.12) {
                    x += self.rng.range(0.03, 0.25);
                    continue;
                }
                if self.rng.chance(0.2) {
                    let p = f.point_out(v3(x + 0.06, y - 0.015, -deep * self.rng.range(0.6, 1.7)));
                    self.vessel(p, (gap / 0.35).min(1.2));
                    x += 0.16;
                    continue;
                }
                let (w, h) = (self.rng.log_range(0.012, 0.09), gap * self.rng.range(0.5, 0.88) * 0.5);
                let d = deep * self.rng.range(0.5, 0.95);
                let tex = Texture::any(self.rng, self.rng.log_range(0.03, 0.2));
                let g = self.w.group();
                self.slab(g, &f, v3(x + w, y - 0.015 - h, -d), v3(w * 0.96, h, d), &tex);
                x += 2.0 * w;
            }
        }
    }

    /// A cup, bottle, plate, bowl, box, fruit or potted plant at `at`.
    pub fn vessel(&mut self, at: V3, s: f64) {
        if self.place_model(at, 0.2 * s, 0.0) {
            return;
        }
        let (g, t) = (self.w.group(), Texture::any(self.rng, self.rng.log_range(0.02, 0.12) * s));
        let up = |h: f64| at - DOWN * (h * s);
        let cyl = |w: &mut World, mid: f64, half: f64, top: f64, bottom: f64, t: Texture| {
            w.add(g, Frame::at(up(mid)), Shape::Cylinder(half * s, top * s, bottom * s), t);
        };
        match self.rng.int(0, 7) {
            0 => {
                cyl(self.w, 0.05, 0.05, 0.045, 0.035, t.clone());
                self.w.add(g, Frame::yaw(up(0.05) + v3(0.045, 0.0, 0.0) * s, 0.0), Shape::Torus(0.028 * s, 0.007 * s), t);
            }
            1 => {
                let r = self.rng.range(0.025, 0.05);
                cyl(self.w, 0.09, 0.09, r, r, t.clone());
                cyl(self.w, 0.21, 0.03, r * 0.35, r, t.clone());
                cyl(self.w, 0.27, 0.03, r * 0.35, r * 0.35, t);
            }
            2 | 3 => {
                let r = self.rng.range(0.08, 0.16);
                cyl(self.w, 0.008, 0.008, r, r * 0.7, t);
                for _ in 0..self.rng.int(0, 7) {
                    let food = Texture::any(self.rng, 0.03);
                    let size = v3(self.rng.range(0.01, 0.05), self.rng.range(0.008, 0.03), self.rng.range(0.01, 0.05)) * s;
                    let off = v3(self.rng.range(-0.6, 0.6) * r, -0.018, self.rng.range(-0.6, 0.6) * r) * s;
                    self.put(food, Frame::at(at + off), Shape::Ellipsoid(size));
                }
            }
            4 => cyl(self.w, 0.04, 0.04, self.rng.range(0.07, 0.14), 0.05, t),
            5 => {
                let r = self.rng.range(0.025, 0.06) * s;
                self.ball(g, at - DOWN * r, v3(r, r * self.rng.range(0.8, 1.1), r), t);
            }
            6 => {
                let half = v3(self.rng.range(0.03, 0.12), self.rng.range(0.02, 0.15), self.rng.range(0.03, 0.1)) * s;
                self.w.add(g, Frame::yaw(at - DOWN * half.y, self.rng.range(-3.0, 3.0)), Shape::Cuboid(half), t);
            }
            _ => {
                cyl(self.w, 0.06, 0.06, 0.06, 0.045, t);
                let leaf = hsv(self.rng.range(0.2, 0.36), 0.7, self.rng.range(0.2, 0.6));
                for _ in 0..self.rng.int(4, 12) {
                    let tex = Texture::of(self.rng, Pattern::Noise, 0.05, [leaf, leaf * 0.6, leaf]);
                    let tip = v3(self.rng.range(-0.12, 0.12), -self.rng.range(0.1, 0.3), self.rng.range(-0.12, 0.12)) * s;
                    let f = Frame::along(up(0.12) + tip * 0.5, tip);
                    self.w.add(g, f, Shape::Card(0.02 * s, tip.norm() * 0.5, CutoutShape::Disc), tex);
                }
            }
        }
    }

    pub fn car(&mut self, at: V3, yaw: f64) {
        if self.place_model(at, 4.4, yaw) {
            return;
        }
        let (f, g) = (Frame::yaw(at, yaw), self.w.group());
        let body = Texture::plain(self.rng, colour(self.rng)).glossy(0.5);
        let glass = Texture::plain(self.rng, v3(0.02, 0.03, 0.04)).glossy(0.8);
        let long = self.rng.range(1.9, 2.4);
        let tall = if self.rng.chance(0.2) { 1.6 } else { 0.55 };
        self.slab(g, &f, v3(0.0, -0.6, 0.0), v3(0.85, 0.32, long), &body);
        self.slab(g, &f, v3(0.0, -0.9 - tall * 0.5, 0.2), v3(0.72, tall * 0.5, long * 0.55), &glass);
        self.slab(g, &f, v3(0.0, -0.93 - tall, 0.2), v3(0.72, 0.04, long * 0.5), &body);
        let tyre = Texture::plain(self.rng, v3(0.02, 0.02, 0.02));
        for (i, k) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
            let m = |x: f64| f.point_out(v3(i * x, -0.32, k * long * 0.62));
            self.w.bar(g, m(0.68), m(0.88), (0.32, 0.32), tyre.clone());
        }
    }

    /// Posts with rails or pickets from `a` to `b`.
    pub fn fence(&mut self, a: V3, b: V3, height: f64) {
        let g = self.w.group();
        let t = Texture::any(self.rng, 0.2);
        let length = (b - a).norm();
        let step = self.rng.log_range(0.08, 1.5) * height;
        let r = height * self.rng.log_range(0.006, 0.03);
        let n = ((length / step) as u32).clamp(2, 80);
        for i in 0..=n {
            let p = a.lerp(b, f64::from(i) / f64::from(n));
            self.w.bar(g, p, p - DOWN * height, (r, r), t.clone());
        }
        for h in (0..self.rng.int(1, 4)).map(|_| self.rng.range(0.15, 1.0)).collect::<Vec<_>>() {
            self.w.bar(g, a - DOWN * (height * h), b - DOWN * (height * h), (r * 0.8, r * 0.8), t.clone());
        }
    }
}
