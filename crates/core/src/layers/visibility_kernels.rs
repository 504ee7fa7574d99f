//! Visibility and pruning kernels over rows of pixels, in forms that vectorise; every processor returns the same bits.

use crate::scene::{Class, Plane};
use crate::simd::dispatch;

/// The visible surface of a tile: coordinates of its columns, labels of all pixels, and planes.
#[derive(Clone, Copy)]
pub struct Columns<'a> {
    /// `u` of the columns, in half tiles.
    pub us: &'a [f64],
    /// Label of each pixel, row-major.
    pub labels: &'a [u8],
    /// Planes of the tile.
    pub planes: &'a [Plane],
}

impl Columns<'_> {
    /// Computes δ of the visible surface along row `y` of the tile, whose coordinate is `v`; `planes` is scratch memory.
    pub fn visible(&self, y: usize, v: f64, planes: &mut Vec<[f64; 2]>, out: &mut [f32]) {
        let labels = &self.labels[y * self.us.len()..][..self.us.len()];
        // most rows lie on one plane
        if let Some(label) = only_label(labels) {
            disparities(self.us, v, &self.planes[usize::from(label)], out);
            return;
        }
        planes.clear();
        planes.extend(self.planes.iter().map(|p| [p.b, p.c * v]));
        for ((o, &l), u) in out.iter_mut().zip(labels).zip(self.us) {
            let [b, cv] = planes[l as usize];
            *o = (self.planes[l as usize].a + b * u + cv) as f32;
        }
    }
}

/// The label that all pixels of a row have; `None` if they differ, or if there are none.
fn only_label(labels: &[u8]) -> Option<u8> {
    let first = *labels.first()?;
    // without an early exit, which would not vectorise
    let differs = labels.iter().fold(0, |differs, label| differs | (label ^ first));
    (differs == 0).then_some(first)
}

dispatch!(
    /// Computes δ of `plane` at the columns `us` of row `v`.
    pub disparities, disparities_body, (us: &[f64], v: f64, plane: &Plane, out: &mut [f32])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn disparities_body(us: &[f64], v: f64, plane: &Plane, out: &mut [f32]) {
    let (a, b, cv) = (plane.a, plane.b, plane.c * v);
    for (o, u) in out.iter_mut().zip(us) {
        *o = (a + b * u + cv) as f32;
    }
}

dispatch!(
    /// Marks with 1 the pixels where a layer lies behind the visible surface. `own` is δ of the layer and `visible` that of the surface;
    /// pixels with the layer's own `label` are not marked. Returns the number of marks.
    pub behind, behind_body, (own: &[f32], visible: &[f32], labels: &[u8], label: Option<u8>, mask: &mut [u8]) -> usize
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn behind_body(own: &[f32], visible: &[f32], labels: &[u8], label: Option<u8>, mask: &mut [u8]) -> usize {
    // labels end at 63, so no pixel has 255
    let label = label.unwrap_or(u8::MAX);
    for (((m, &d), &v), &l) in mask.iter_mut().zip(own).zip(visible).zip(labels) {
        *m = u8::from(l != label) & u8::from(d < v) & u8::from(d >= 0.0);
    }
    // in bytes, which vectorise best, as long as they hold the count
    mask.chunks(128).map(|part| usize::from(part.iter().sum::<u8>())).sum()
}

dispatch!(
    /// Sets class and alpha of the texels: visible where a pixel has the layer's label, otherwise hidden or empty as in the mask.
    pub classify, classify_body, (labels: &[u8], label: Option<u8>, hidden: &[u8], class: &mut [u8], alpha: &mut [u8])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
#[allow(clippy::needless_bitwise_bool, reason = "without a branch")]
fn classify_body(labels: &[u8], label: Option<u8>, hidden: &[u8], class: &mut [u8], alpha: &mut [u8]) {
    // labels end at 63, so no pixel has 255
    let label = label.unwrap_or(u8::MAX);
    for (((c, a), &l), &hidden) in class.iter_mut().zip(alpha).zip(labels).zip(hidden) {
        // no multiplication: not every processor has one for vectors of bytes
        let behind = if hidden == 0 { Class::Empty as u8 } else { Class::Hidden as u8 };
        *c = if l == label { Class::Photo as u8 } else { behind };
        *a = if (l == label) | (hidden != 0) { u8::MAX } else { 0 };
    }
}

/// For each texel of a row, counts the opaque ones among it and its two neighbours.
#[inline(never)]
pub fn sums_of_three(alpha: &[u8], sums: &mut [u8]) {
    for (s, a) in sums.iter_mut().zip(alpha) {
        *s = a >> 7;
    }
    for (s, a) in sums.iter_mut().zip(alpha.get(1..).unwrap_or_default()) {
        *s += a >> 7;
    }
    for (s, a) in sums.iter_mut().skip(1).zip(alpha) {
        *s += a >> 7;
    }
}

/// For each empty texel of a row, counts the opaque texels in its 3×3 neighbourhood, from the sums of up to three rows. Returns false if
/// all counts are 0.
#[inline(never)]
pub fn ring(class: &[u8], sums: [&[u8]; 3], ring: &mut [u8]) -> bool {
    ring.fill(0);
    for sums in sums {
        for (r, s) in ring.iter_mut().zip(sums) {
            *r += s;
        }
    }
    let mut any = 0;
    for (r, &c) in ring.iter_mut().zip(class) {
        *r = if c == Class::Empty as u8 { *r } else { 0 };
        any |= *r;
    }
    any != 0
}

dispatch!(
    /// Marks with 1 the pixels of a row where `surface` lies behind `plane`, or in front of it by at most `slack`.
    pub open, open_body, (us: &[f64], v: f64, plane: &Plane, surface: &[f32], slack: f64, mask: &mut [u8])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn open_body(us: &[f64], v: f64, plane: &Plane, surface: &[f32], slack: f64, mask: &mut [u8]) {
    let (a, b, cv) = (plane.a, plane.b, plane.c * v);
    for ((m, &d), u) in mask.iter_mut().zip(surface).zip(us) {
        *m = u8::from(f64::from(d) <= f64::from((a + b * u + cv) as f32) + slack);
    }
}

/// Number of lanes in the reduction.
const LANES: usize = 8;

dispatch!(
    /// The maximum of some columns and rows from the first value on, at least 0; rows are `stride` values apart.
    pub nearest, nearest_body, (surface: &[f32], stride: usize, columns: usize, rows: usize) -> f32
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn nearest_body(surface: &[f32], stride: usize, columns: usize, rows: usize) -> f32 {
    let mut most = [0f32; LANES];
    for row in surface.chunks(stride).take(rows) {
        let (chunks, rest) = row[..columns].as_chunks::<LANES>();
        for chunk in chunks {
            for (m, &d) in most.iter_mut().zip(chunk) {
                *m = if d > *m { d } else { *m };
            }
        }
        for (m, &d) in most.iter_mut().zip(rest) {
            *m = if d > *m { d } else { *m };
        }
    }
    most.into_iter().fold(0.0, |m, d| if d > m { d } else { m })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// Compares rows of any length with one pixel at a time.
        #[test]
        fn rows_agree_with_single_pixels(
            n in 1usize..40, seed in prop::collection::vec(0f32..1.0, 40), label in prop::option::of(0u8..3),
            a in -0.2f64..1.0, b in -0.3f64..0.3, c in -0.3f64..0.3, v in -3f64..3.0,
        ) {
            let plane = Plane { a, b, c };
            let us: Vec<f64> = (0..n).map(|i| (i as f64 + 0.5 - 17.0) / 32.0).collect();
            let labels: Vec<u8> = (0..n).map(|i| (seed[i] * 3.0) as u8).collect();
            let surface = &seed[..n];
            let mut own = vec![0f32; n];
            disparities(&us, v, &plane, &mut own);
            let (mut mask, mut hidden) = (vec![9u8; n], vec![9u8; n]);
            open(&us, v, &plane, surface, 0.004, &mut mask);
            let count = behind(&own, surface, &labels, label, &mut hidden);
            let mut want_count = 0;
            for i in 0..n {
                prop_assert_eq!(own[i].to_bits(), (plane.disparity(us[i], v) as f32).to_bits());
                prop_assert_eq!(mask[i], u8::from(f64::from(surface[i]) <= f64::from(own[i]) + 0.004));
                let is = Some(labels[i]) != label && own[i] < surface[i] && own[i] >= 0.0;
                prop_assert_eq!(hidden[i], u8::from(is));
                want_count += usize::from(is);
            }
            prop_assert_eq!(count, want_count);
            prop_assert_eq!(nearest(surface, n, n, 1).to_bits(), surface.iter().copied().fold(0.0, f32::max).to_bits());
            let (stride, columns) = (n.div_ceil(3), n.div_ceil(5));
            let rows = n / stride;
            let inside = (0..rows * stride).filter(|i| i % stride < columns).map(|i| surface[i]);
            prop_assert_eq!(nearest(surface, stride, columns, rows).to_bits(), inside.fold(0.0, f32::max).to_bits());
        }
    }
}
