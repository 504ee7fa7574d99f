//! A plane of a tile.

use super::Intrinsics;

/// Plane with disparity affine in the image, `δ(u,v) = a + b·u + c·v`; `u, v` in pixels from the tile's centre, in units
/// of half a tile. `b = c = 0` is the paper's fronto-parallel plane.
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
    /// Step of the grid that planes lie on in a container, 2⁻¹⁴: an error of δ of at most three half steps anywhere on the tile, half a step of each coefficient.
    pub const STEP: f64 = 1.0 / 16_384.0;

    /// Fronto-parallel plane of disparity `a`.
    #[must_use]
    pub const fn fronto_parallel(a: f64) -> Self {
        Self { a, b: 0.0, c: 0.0 }
    }

    /// δ at `(u, v)` in units of half a tile from the tile's centre.
    #[must_use]
    pub fn disparity(&self, u: f64, v: f64) -> f64 {
        self.a + self.b * u + self.c * v
    }

    /// `m` with `δ = mᵀ (x, y, 1)` in normalised image coordinates, so that the plane is `mᵀ X = 1` in space.
    ///
    /// `centre` and `half` (tile centre and half tile size) are in reference pixels.
    #[must_use]
    pub fn normal(&self, centre: (f64, f64), half: f64, k: &Intrinsics) -> [f64; 3] {
        let (bx, by) = (self.b / half, self.c / half);
        [bx * k.fx, by * k.fy, self.a + bx * (k.cx - centre.0) + by * (k.cy - centre.1)]
    }

    /// The nearest plane on the container's grid of [`Plane::STEP`]; values beyond ±2 are clamped, NaN becomes 0.
    #[must_use]
    pub fn quantised(&self) -> Self {
        let q = |v: f64| f64::from(Self::to_grid(v)) * Self::STEP;
        Self { a: q(self.a), b: q(self.b), c: q(self.c) }
    }

    /// Grid index of one coefficient.
    #[must_use]
    pub fn to_grid(v: f64) -> i16 {
        // `as` saturates, and maps NaN to 0
        (v / Self::STEP).round() as i16
    }

    /// True where all coefficients are finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.a.is_finite() && self.b.is_finite() && self.c.is_finite()
    }
}
