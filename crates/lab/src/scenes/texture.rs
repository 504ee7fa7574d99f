//! Procedural textures: the colour of a surface from local position and normal.

use super::math::{Rng, V3, fbm, hash3, smoothstep, v3};
use super::photo_texture::Patch;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pattern {
    Plain,
    Noise,
    Marble,
    Stripes,
    Checks,
    Plaid,
    Dots,
    Bricks,
    Tiles,
    Planks,
    Windows,
    Print,
    Text,
    Foliage,
    Speckle,
    Gradient,
}

impl Pattern {
    pub const STRONG: [Self; 9] =
        [Self::Stripes, Self::Checks, Self::Plaid, Self::Dots, Self::Print, Self::Text, Self::Marble, Self::Tiles, Self::Planks];
    pub const TABLETOPS: [Self; 9] =
        [Self::Planks, Self::Plain, Self::Noise, Self::Plaid, Self::Checks, Self::Marble, Self::Tiles, Self::Stripes, Self::Speckle];
    pub const BACKDROPS: [Self; 8] =
        [Self::Plain, Self::Noise, Self::Gradient, Self::Foliage, Self::Bricks, Self::Windows, Self::Print, Self::Stripes];
    pub const GROUNDS: [Self; 8] =
        [Self::Speckle, Self::Speckle, Self::Noise, Self::Noise, Self::Foliage, Self::Tiles, Self::Stripes, Self::Bricks];
    pub const QUIET: [Self; 6] = [Self::Plain, Self::Plain, Self::Noise, Self::Noise, Self::Speckle, Self::Gradient];
}

/// Periods that a patch spans, so that its details have the size of the pattern's.
const PERIODS: f64 = 4.0;
const LUMA: V3 = v3(0.2126, 0.7152, 0.0722);

/// Appearance of a surface. Lengths are in the object's frame.
#[derive(Clone, Debug)]
pub(super) struct Texture {
    pub pattern: Pattern,
    /// Linear RGB.
    pub colours: [V3; 3],
    /// Length of one period.
    pub scale: f64,
    turn: (f64, f64),
    shift: (f64, f64),
    seed: u32,
    /// Strength of low-frequency dirt in the brightness.
    dirt: f64,
    /// Emitted light, as a factor on the colour.
    pub glow: f64,
    /// Strength of highlights.
    pub gloss: f64,
    /// A piece of a photograph instead of the pattern, and the weight of the photograph's own colours.
    patch: Option<(Patch, f64)>,
}

/// A random colour with the distribution of photographs, in linear RGB.
pub(super) fn colour(rng: &Rng) -> V3 {
    let (h, s, v) = match rng.int(0, 9) {
        0..=2 => (rng.range(0.02, 0.13), rng.range(0.1, 0.65), rng.range(0.1, 0.85)), // wood, skin, earth, brick
        3 => (rng.range(0.2, 0.4), rng.range(0.2, 0.7), rng.range(0.1, 0.6)),         // green
        4 => (rng.range(0.52, 0.66), rng.range(0.1, 0.8), rng.range(0.15, 0.85)),     // blue
        5 | 6 => (rng.unit(), rng.range(0.0, 0.1), rng.range(0.03, 0.95)),            // grey, white, black
        7 => (rng.range(0.95, 1.03), rng.range(0.5, 0.95), rng.range(0.2, 0.85)),     // red
        _ => (rng.unit(), rng.range(0.1, 0.8), rng.range(0.1, 0.95)),
    };
    hsv(h, s, v)
}

/// Linear RGB of hue, saturation and value.
pub(super) fn hsv(h: f64, s: f64, v: f64) -> V3 {
    let f = |n: f64| {
        let k = (n + h * 6.0).rem_euclid(6.0);
        v - v * s * k.min(4.0 - k).clamp(0.0, 1.0)
    };
    v3(f(5.0), f(3.0), f(1.0)).map(|c| c.powf(2.2))
}

impl Texture {
    pub fn new(rng: &Rng, pattern: Pattern, scale: f64) -> Self {
        let base = colour(rng);
        let second = if rng.chance(0.5) { base * rng.range(0.3, 0.85) } else { colour(rng) };
        Self::of(rng, pattern, scale, [base, second, colour(rng)])
    }

    pub fn of(rng: &Rng, pattern: Pattern, scale: f64, colours: [V3; 3]) -> Self {
        let angle: f64 = if rng.chance(0.75) { 0.0 } else { rng.range(-1.6, 1.6) };
        Self {
            pattern,
            colours,
            scale,
            turn: angle.sin_cos(),
            shift: (rng.unit(), rng.unit()),
            seed: rng.next() as u32,
            dirt: if rng.chance(0.7) { rng.range(0.0, 0.5) } else { 0.0 },
            glow: 0.0,
            gloss: if rng.chance(0.25) { rng.range(0.1, 0.6) } else { 0.0 },
            patch: if rng.chance(0.5) { rng.patch().map(|p| (p, if rng.chance(0.5) { 1.0 } else { rng.range(0.0, 0.5) })) } else { None },
        }
    }

    pub fn any(rng: &Rng, scale: f64) -> Self {
        let p = if rng.chance(0.38) { rng.pick(&Pattern::STRONG) } else { rng.pick(&Pattern::QUIET) };
        Self::new(rng, p, scale)
    }

    pub fn plain(rng: &Rng, c: V3) -> Self {
        let p = rng.pick(&[Pattern::Plain, Pattern::Noise]);
        Self::of(rng, p, 0.2, [c, c * 0.75, c * 0.5])
    }

    /// A picture, upright and centred on a card; its longer side has the length `span`.
    pub fn picture(rng: &Rng, picture: Patch, span: f64) -> Self {
        let plain = Self::of(rng, Pattern::Plain, span / PERIODS, [V3::default(); 3]);
        let (u, v) = picture.middle();
        Self { turn: (0.0, 1.0), shift: (u * PERIODS, v * PERIODS), gloss: 0.0, patch: Some((picture, 1.0)), ..plain }
    }

    pub fn glowing(mut self, glow: f64) -> Self {
        self.patch = None;
        self.glow = glow;
        self
    }

    pub fn glossy(mut self, gloss: f64) -> Self {
        self.gloss = gloss;
        self
    }

    /// Linear colour at local point `p` with local normal `n`; `width` is the length of a pixel there.
    pub fn at(&self, p: V3, n: V3, width: f64) -> V3 {
        let (ax, ay, az) = (n.x.abs(), n.y.abs(), n.z.abs());
        let (u, v) = if ay >= ax && ay >= az {
            (p.x, p.z)
        } else if ax >= az {
            (p.z, p.y)
        } else {
            (p.x, p.y)
        };
        let (s, c) = self.turn;
        let (u, v) = ((u * c - v * s) / self.scale + self.shift.0, (u * s + v * c) / self.scale + self.shift.1);
        let q = p * (1.0 / self.scale);
        let w = width / self.scale;
        if let Some((patch, hue)) = &self.patch {
            let c = patch.at(u / PERIODS, v / PERIODS, w / PERIODS);
            let m = patch.mean;
            let bright = c.dot(LUMA) / m.dot(LUMA).max(0.02);
            let own = self.colours[0] * bright.min(3.0);
            return own.lerp(c, *hue);
        }
        let base = self.pattern_at(u, v, q, w);
        if self.dirt == 0.0 {
            return base;
        }
        base * (1.0 - self.dirt * fbm(q * 0.37, 3, w * 0.37, self.seed.wrapping_add(77)))
    }

    fn pattern_at(&self, u: f64, v: f64, q: V3, w: f64) -> V3 {
        let [c0, c1, c2] = self.colours;
        let seed = self.seed;
        // weight of details of relative size `size`: 0 if a pixel does not resolve them
        let keep = |size: f64| 1.0 - smoothstep(0.35, 1.1, w / size);
        let mean = |a: V3, b: V3, share: f64, k: f64, hit: bool| a.lerp(b, share).lerp(if hit { b } else { a }, k);
        let (iu, iv) = (u.floor() as i64, v.floor() as i64);
        let (fu, fv) = (u - u.floor(), v - v.floor());
        match self.pattern {
            Pattern::Plain => c0,
            Pattern::Noise => c0.lerp(c1, smoothstep(0.3, 0.7, fbm(q, 4, w, seed))),
            Pattern::Speckle => c0.lerp(c1, smoothstep(0.25, 0.75, fbm(q * 8.0, 3, w * 8.0, seed))),
            Pattern::Gradient => c0.lerp(c1, 0.5 - 0.5 * (v * 0.9).cos()),
            Pattern::Marble => {
                let s = 0.5 + 0.5 * (std::f64::consts::TAU * (u + 2.0 * fbm(q, 4, w, seed))).sin();
                c0.lerp(c1, 0.5).lerp(c0.lerp(c1, s), keep(0.5))
            }
            Pattern::Stripes => {
                let other = if hash3(iu, 0, 0, seed) < 0.25 { c2 } else { c1 };
                mean(c0, other, 0.5, keep(0.5), fu < 0.5)
            }
            Pattern::Checks => mean(c0, c1, 0.5, keep(0.7), (iu + iv).rem_euclid(2) == 0),
            Pattern::Plaid => {
                let a = mean(c0, c1, 0.4, keep(0.4), fu < 0.4);
                a.lerp(c2, 0.45 * (0.3 * (1.0 - keep(0.3)) + if fv < 0.3 { keep(0.3) } else { 0.0 }))
            }
            Pattern::Dots => {
                let h = hash3(iu, iv, 0, seed);
                let r = 0.15 + 0.3 * h;
                let c = if hash3(iu, iv, 1, seed) < 0.3 { c2 } else { c1 };
                mean(c0, c, 0.3, keep(0.5), (fu - 0.5).hypot(fv - 0.5) < r)
            }
            Pattern::Bricks => {
                let row = (v * 3.0).floor();
                let x = u + 0.5 * row.rem_euclid(2.0);
                let (fx, fy) = (x - x.floor(), v * 3.0 - row);
                let tone = 0.7 + 0.5 * hash3(x.floor() as i64, row as i64, 2, seed);
                let brick = c0.lerp(c1, 0.4 * hash3(x.floor() as i64, row as i64, 3, seed)) * tone;
                let k = keep(0.12);
                let mortar = if fx < 0.05 || fy < 0.14 { k } else { 0.17 * (1.0 - k) };
                c0.lerp(brick, keep(0.33)).lerp(c2, mortar)
            }
            Pattern::Tiles => {
                let tone = 0.85 + 0.3 * hash3(iu, iv, 4, seed);
                let line = if fu < 0.04 || fv < 0.04 { keep(0.08) } else { 0.08 * (1.0 - keep(0.08)) };
                (c0 * (1.0 + (tone - 1.0) * keep(1.0))).lerp(c1, line)
            }
            Pattern::Planks => {
                let tone = 0.75 + 0.5 * hash3(iu, (v * 0.2 + hash3(iu, 9, 9, seed)).floor() as i64, 5, seed);
                let grain = fbm(v3(u * 9.0, v * 0.7, iu as f64 * 7.3), 3, w * 9.0, seed);
                let gap = if fu < 0.03 { keep(0.06) } else { 0.0 };
                (c0.lerp(c0 * 0.6, grain) * (1.0 + (tone - 1.0) * keep(1.0))).lerp(c0 * 0.2, gap)
            }
            Pattern::Windows => {
                let h = hash3(iu, iv, 6, seed);
                let inside = (0.2..0.8).contains(&fu) && (0.22..0.82).contains(&fv);
                let bar = inside && ((fu - 0.5).abs() < 0.02 || (fv - 0.5).abs() < 0.02);
                let frame = !inside && (0.15..0.85).contains(&fu) && (0.17..0.87).contains(&fv);
                let glass = c1 * (0.4 + 0.9 * h) * (0.7 + 0.6 * fv);
                let detail = if bar || frame {
                    c2
                } else if inside {
                    glass
                } else {
                    c0 * (0.9 + 0.2 * fbm(q * 6.0, 2, w * 6.0, seed))
                };
                c0.lerp(c1, 0.36).lerp(detail, keep(0.5))
            }
            Pattern::Print => self.print(u, v, w),
            Pattern::Text => {
                let row = (v * 6.0).floor();
                let word = (u * 5.0 + hash3(0, row as i64, 7, seed)).floor();
                let ink = v * 6.0 - row > 0.45 && hash3(word as i64, row as i64, 8, seed) < 0.65 && hash3(iu, iv, 9, seed) < 0.7;
                let letters = hash3((u * 40.0).floor() as i64, row as i64, 10, seed) < 0.75;
                mean(c0, c1, 0.25, keep(0.17), ink && letters)
            }
            Pattern::Foliage => {
                let f = fbm(q * 3.0, 4, w * 3.0, seed);
                let leaf = c0.lerp(c1, smoothstep(0.35, 0.65, f));
                leaf.lerp(c2 * 0.15, smoothstep(0.5, 0.3, f) * 0.8)
            }
        }
    }

    /// Nested rectangles of varying hue, as on packaging and posters.
    fn print(&self, u: f64, v: f64, w: f64) -> V3 {
        let (mut u, mut v, mut size) = (u, v, 1.0);
        let (mut a, mut b) = (u.floor() as i64, v.floor() as i64);
        for level in 0..4 {
            if size < w * 1.5 || (level > 0 && hash3(a, b, 20 + level, self.seed) < 0.3) {
                break;
            }
            let split = 0.3 + 0.4 * hash3(a, b, 30 + level, self.seed);
            let (fu, fv) = (u - u.floor(), v - v.floor());
            if hash3(a, b, 40 + level, self.seed) < 0.5 {
                let left = fu < split;
                u = if left { fu / split } else { (fu - split) / (1.0 - split) };
                a = a * 2 + i64::from(left);
                v = fv;
            } else {
                let top = fv < split;
                v = if top { fv / split } else { (fv - split) / (1.0 - split) };
                b = b * 2 + i64::from(top);
                u = fu;
            }
            a += 13 * level;
            size *= 0.6;
        }
        let h = hash3(a, b, 50, self.seed);
        let c = if h < 0.7 {
            self.colours[(h * 4.28) as usize % 3]
        } else {
            hsv(hash3(a, b, 51, self.seed), 0.7 * hash3(a, b, 52, self.seed), hash3(a, b, 53, self.seed))
        };
        let disc = hash3(a, b, 54, self.seed) < 0.3 && (u - u.floor() - 0.5).hypot(v - v.floor() - 0.5) < 0.35;
        if disc { v3(1.0, 1.0, 1.0) - c.map(|x| x.min(1.0)) } else { c }
    }
}
