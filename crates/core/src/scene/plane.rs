//! A plane of a tile.

use super::Intrinsics;

/// A plane with disparity affine in the image, `δ(u,v) = a + b·u + c·v`. `u` and `v` are offsets from the tile's centre in units of half a
/// tile. `b = c = 0` is the paper's fronto-parallel plane.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Plane {
    /// Disparity at the tile's centre.
    pub a: f64,
    /// Change of disparity over half a tile to the right.
    pub b: f64,
    /// Change of disparity over half a tile downwards.
    pub c: f64,
}

impl Plane {
    /// Quantisation step of plane coefficients in a container, 2⁻¹⁴. Each coefficient is off by at most half a step, so δ is off by at most
    /// three half steps anywhere on the tile.
    pub const STEP: f64 = 1.0 / 16_384.0;

    /// A fronto-parallel plane of disparity `a`.
    pub const fn fronto_parallel(a: f64) -> Self {
        Self { a, b: 0.0, c: 0.0 }
    }

    /// δ at `(u, v)`, in units of half a tile from the tile's centre.
    pub fn disparity(&self, u: f64, v: f64) -> f64 {
        self.a + self.b * u + self.c * v
    }

    /// The vector `m` with `δ = mᵀ (x, y, 1)` in normalised image coordinates, so that the plane is `mᵀ X = 1` in space.
    ///
    /// `centre` and `half` (the tile's centre and half its size) are in reference pixels.
    pub fn normal(&self, centre: (f64, f64), half: f64, k: &Intrinsics) -> [f64; 3] {
        let (bx, by) = (self.b / half, self.c / half);
        [bx * k.fx, by * k.fy, self.a + bx * (k.cx - centre.0) + by * (k.cy - centre.1)]
    }

    /// The nearest plane with coefficients that are multiples of [`Plane::STEP`]. Clamps values beyond ±2; NaN becomes 0.
    pub fn quantised(&self) -> Self {
        let q = |v: f64| f64::from(Self::to_grid(v)) * Self::STEP;
        Self { a: q(self.a), b: q(self.b), c: q(self.c) }
    }

    /// One coefficient in units of [`Plane::STEP`], rounded.
    pub fn to_grid(v: f64) -> i16 {
        // `as` saturates, and maps NaN to 0
        (v / Self::STEP).round() as i16
    }

    /// True if all coefficients are finite.
    pub fn is_finite(&self) -> bool {
        self.a.is_finite() && self.b.is_finite() && self.c.is_finite()
    }
}
