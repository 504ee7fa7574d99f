//! Shapes of flat cut-outs: the opaque subset of the square [−1, 1]². y points down.

use std::sync::Arc;

use super::math::{Rng, fbm, v3};

/// A limb `(x0, y0, x1, y1, r0, r1)`: a line from `(x0, y0)` to `(x1, y1)` with radius `r0` at its start and `r1` at its end.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limb(pub f64, pub f64, pub f64, pub f64, pub f64, pub f64);

#[derive(Clone, Debug)]
pub(super) enum CutoutShape {
    Full,
    Disc,
    /// The ring between this radius and 1.
    Ring(f64),
    /// Radius as a function of the angle: a mean plus waves `(amplitude, phase)` of 1, 2, 3 … periods.
    Blob(f64, Arc<[(f64, f64)]>),
    /// Union of limbs, with noise of this amplitude and seed on the outline.
    Limbs(Arc<[Limb]>, f64, u32),
    /// A crown of leaves: noise above a threshold that increases outwards; grain and seed.
    Crown(f64, u32),
    /// A rectangular frame of this thickness.
    Window(f64),
}

impl CutoutShape {
    pub fn contains(&self, x: f64, y: f64) -> bool {
        let r = x.hypot(y);
        match self {
            Self::Full => true,
            Self::Disc => r <= 1.0,
            Self::Ring(inner) => r <= 1.0 && r >= *inner,
            Self::Window(t) => x.abs() > 1.0 - t || y.abs() > 1.0 - t,
            Self::Blob(mean, waves) => {
                let angle = y.atan2(x);
                let edge: f64 = waves.iter().zip(1i32..).map(|(&(a, phase), k)| a * (f64::from(k) * angle + phase).cos()).sum();
                r <= mean + edge
            }
            Self::Limbs(limbs, shake, seed) => {
                let wobble = if *shake > 0.0 { (fbm(v3(x * 14.0, y * 14.0, 0.0), 2, 0.0, *seed) - 0.5) * 2.0 * shake } else { 0.0 };
                limbs.iter().any(|&Limb(x0, y0, x1, y1, r0, r1)| {
                    let (dx, dy) = (x1 - x0, y1 - y0);
                    let t = (((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy).max(1e-12)).clamp(0.0, 1.0);
                    (x - x0 - t * dx).hypot(y - y0 - t * dy) <= r0 + (r1 - r0) * t + wobble
                })
            }
            Self::Crown(grain, seed) => r <= 1.0 && fbm(v3(x * grain, y * grain, 0.5), 3, 0.0, *seed) > 0.32 + 0.3 * r * r,
        }
    }

    pub fn blob(rng: &Rng) -> Self {
        let rough = rng.range(0.02, 0.16);
        let waves: Vec<_> = (1..7).map(|k| (rng.range(-rough, rough) / f64::from(k).sqrt(), rng.range(0.0, 6.3))).collect();
        Self::Blob(0.72, waves.into())
    }

    /// A standing person.
    pub fn person(rng: &Rng) -> Self {
        let mut limbs = vec![Limb(0.0, -0.85, 0.0, -0.8, 0.11, 0.12), Limb(0.0, -0.75, 0.0, -0.6, 0.06, 0.08)];
        let (shoulder, waist) = (rng.range(0.18, 0.3), rng.range(0.14, 0.28));
        limbs.push(Limb(0.0, -0.48, 0.0, -0.05, shoulder, waist));
        for side in [-1.0, 1.0] {
            let (elbow, hand) = (rng.range(-0.3, 1.4), rng.range(-1.6, 2.4));
            let (ex, ey) = (side * (shoulder + 0.28 * elbow.sin().abs()), -0.55 + 0.3 * elbow.cos());
            limbs.push(Limb(side * shoulder * 0.8, -0.56, ex, ey, 0.08, 0.06));
            limbs.push(Limb(ex, ey, ex + side * 0.25 * hand.sin(), ey + 0.28 * hand.cos(), 0.06, 0.05));
            let knee = side * rng.range(0.05, 0.3);
            limbs.push(Limb(side * 0.1, 0.0, knee, 0.45, 0.13, 0.09));
            limbs.push(Limb(knee, 0.45, knee * rng.range(0.6, 1.4), 0.92, 0.09, 0.06));
        }
        if rng.chance(0.3) {
            // a skirt or a coat
            limbs.push(Limb(0.0, -0.1, 0.0, rng.range(0.2, 0.5), waist, waist * 1.5));
        }
        Self::Limbs(limbs.into(), rng.range(0.0, 0.03), rng.next() as u32)
    }

    /// Head and shoulders.
    pub fn portrait(rng: &Rng) -> Self {
        let head = rng.range(0.3, 0.42);
        let (tilt, hair) = (rng.range(-0.12, 0.12), rng.range(0.0, 0.12));
        let limbs = vec![
            Limb(tilt, -0.5, tilt * 0.7, -0.3, head + hair, head),
            Limb(tilt * 0.5, -0.1, 0.0, 0.4, head * 0.55, head * 0.6),
            Limb(-0.6, 0.75, 0.6, 0.75, 0.4, 0.4),
            Limb(-0.5, 1.1, 0.5, 1.1, 0.5, 0.5),
        ];
        Self::Limbs(limbs.into(), rng.range(0.0, 0.06), rng.next() as u32)
    }

    /// A four-legged animal seen from the side.
    pub fn animal(rng: &Rng) -> Self {
        let s = rng.sign();
        let body = rng.range(0.2, 0.36);
        let mut limbs = vec![Limb(-0.45 * s, -0.1, 0.4 * s, -0.1, body, body * rng.range(0.7, 1.0))];
        for x in [-0.55, -0.4, 0.35, 0.5] {
            let foot = x + rng.range(-0.15, 0.15);
            limbs.push(Limb(x * s, 0.0, foot * s, 0.92, 0.12, 0.05));
        }
        let (hx, hy) = (rng.range(0.6, 0.8), rng.range(-0.8, -0.3));
        limbs.push(Limb(0.4 * s, -0.2, hx * s, hy, 0.17, 0.1));
        limbs.push(Limb(hx * s, hy, (hx + 0.15) * s, hy + 0.1, 0.14, 0.08));
        limbs.push(Limb(-0.6 * s, -0.2, -0.9 * s, rng.range(-0.5, 0.4), 0.04, 0.03));
        Self::Limbs(limbs.into(), rng.range(0.0, 0.04), rng.next() as u32)
    }

    /// A random subject.
    pub fn subject(rng: &Rng) -> Self {
        match rng.int(0, 9) {
            0..=2 => Self::person(rng),
            3 | 4 => Self::animal(rng),
            5 => Self::portrait(rng),
            6 if rng.chance(0.5) => Self::Ring(rng.range(0.5, 0.95)),
            6 => Self::Disc,
            7 => Self::Crown(rng.range(3.0, 9.0), rng.next() as u32),
            _ => Self::blob(rng),
        }
    }
}
