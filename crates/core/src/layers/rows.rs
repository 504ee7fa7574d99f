//! What visibility and inpainting do along rows of pixels, in forms that vectorise; the same bits come out on every processor.
#![allow(clippy::float_cmp, reason = "weights that are exactly 0 or 1 take a shorter way")]

use std::ops::Range;

use crate::scene::{Class, Plane, Rect};
use crate::simd::dispatch;

/// How far in front of the layer a source may lie, in δ.
const IN_FRONT: f64 = 0.015;
/// Distance behind the layer, in δ, at which a source's weight has fallen to a half.
const BEHIND: f64 = 0.06;

/// The visible surface of a tile: places of its columns, labels of all pixels, planes.
#[derive(Clone, Copy)]
pub struct Columns<'a> {
    /// Horizontal places of the columns in half tiles.
    pub us: &'a [f64],
    /// Plane that each pixel lies on, row-major.
    pub labels: &'a [u8],
    /// The planes.
    pub planes: &'a [Plane],
}

impl Columns<'_> {
    /// δ of the visible surface along row `y` of the tile, whose place is `v`; `planes` is scratch.
    pub fn visible(&self, y: usize, v: f64, planes: &mut Vec<[f64; 2]>, out: &mut [f32]) {
        let labels = &self.labels[y * self.us.len()..][..self.us.len()];
        match labels.first() {
            // most rows lie on one plane
            Some(&first) if labels.iter().all(|&l| l == first) => disparities(self.us, v, &self.planes[first as usize], out),
            _ => {
                planes.clear();
                planes.extend(self.planes.iter().map(|p| [p.b, p.c * v]));
                for ((o, &l), u) in out.iter_mut().zip(labels).zip(self.us) {
                    let [b, cv] = planes[l as usize];
                    *o = (self.planes[l as usize].a + b * u + cv) as f32;
                }
            }
        }
    }
}

dispatch!(
    /// δ of `plane` at places `us` of the row `v`.
    pub disparities, disparities_body, disparities_avx2, (us: &[f64], v: f64, plane: &Plane, out: &mut [f32])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn disparities_body(us: &[f64], v: f64, plane: &Plane, out: &mut [f32]) {
    let (a, b, cv) = (plane.a, plane.b, plane.c * v);
    for (o, u) in out.iter_mut().zip(us) {
        *o = (a + b * u + cv) as f32;
    }
}

/// Lanes of the reductions.
const LANES: usize = 8;

dispatch!(
    /// Marks with 1 what lies behind the visible surface: δ of a layer `own`, of the surface `visible`, the labels of the pixels
    /// and the layer's. Gives the count of marks and the greatest distance in δ.
    pub behind, behind_body, behind_avx2, (own: &[f32], visible: &[f32], labels: &[u8], label: Option<u8>, mask: &mut [u8]) -> (usize, f64)
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn behind_body(own: &[f32], visible: &[f32], labels: &[u8], label: Option<u8>, mask: &mut [u8]) -> (usize, f64) {
    // labels end at 63, so 255 is no pixel's
    let label = label.unwrap_or(u8::MAX);
    for (((m, &d), &v), &l) in mask.iter_mut().zip(own).zip(visible).zip(labels) {
        *m = u8::from(l != label) & u8::from(d < v) & u8::from(d >= 0.0);
    }
    let count = mask.iter().map(|&m| usize::from(m)).sum();
    if count == 0 {
        return (0, 0.0);
    }
    let mut step = [0f64; LANES];
    let chunks = mask.chunks(LANES).zip(own.chunks(LANES)).zip(visible.chunks(LANES));
    for ((m, d), v) in chunks {
        for (((s, &m), &d), &v) in step.iter_mut().zip(m).zip(d).zip(v) {
            let by = if m != 0 { f64::from(v) - f64::from(d) } else { 0.0 };
            *s = if by > *s { by } else { *s };
        }
    }
    (count, step.into_iter().fold(0.0, f64::max))
}

dispatch!(
    /// Classes and alpha of texels: the photo's where a pixel's label is the layer's, else hidden or empty by the mask.
    pub classify, classify_body, classify_avx2, (labels: &[u8], label: Option<u8>, hidden: &[u8], class: &mut [u8], alpha: &mut [u8])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn classify_body(labels: &[u8], label: Option<u8>, hidden: &[u8], class: &mut [u8], alpha: &mut [u8]) {
    // labels end at 63, so 255 is no pixel's
    let label = label.unwrap_or(u8::MAX);
    for (((c, a), &l), &hidden) in class.iter_mut().zip(alpha).zip(labels).zip(hidden) {
        let class = if l == label { Class::Photo as u8 } else { hidden * Class::Hidden as u8 };
        *c = class;
        *a = if class == Class::Empty as u8 { 0 } else { u8::MAX };
    }
}

/// Opaque texels among each one of a row and its neighbours.
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

/// For each empty texel of a row the count of opaque ones among itself and its neighbours, by the sums of up to three rows; false
/// where all are 0.
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
    pub open, open_body, open_avx2, (us: &[f64], v: f64, plane: &Plane, surface: &[f32], slack: f64, mask: &mut [u8])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn open_body(us: &[f64], v: f64, plane: &Plane, surface: &[f32], slack: f64, mask: &mut [u8]) {
    let (a, b, cv) = (plane.a, plane.b, plane.c * v);
    for ((m, &d), u) in mask.iter_mut().zip(surface).zip(us) {
        *m = u8::from(f64::from(d) <= f64::from((a + b * u + cv) as f32) + slack);
    }
}

dispatch!(
    /// The greatest of some values, at least 0.
    pub nearest, nearest_body, nearest_avx2, (surface: &[f32]) -> f32
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn nearest_body(surface: &[f32]) -> f32 {
    let mut most = [0f32; LANES];
    let (chunks, rest) = surface.as_chunks::<LANES>();
    for chunk in chunks {
        for (m, &d) in most.iter_mut().zip(chunk) {
            *m = if d > *m { d } else { *m };
        }
    }
    rest.iter().chain(&most).fold(0.0, |m, &d| if d > m { d } else { m })
}

/// Pixels of a row that may be sources of hidden colour.
#[derive(Clone, Copy)]
pub struct Sources<'a> {
    /// Place of the row.
    pub v: f64,
    /// δ of the visible surface, infinite where a pixel is no source.
    pub surface: &'a [f32],
    /// The photo's colours.
    pub rgb: &'a [[u8; 3]],
}

impl Sources<'_> {
    /// No pixel.
    pub const NONE: Self = Self { v: 0.0, surface: &[], rgb: &[] };
}

/// Columns whose weights are found at once; even.
const BLOCK: usize = 32;

/// Weight of a source that lies `behind` the layer by so much in δ.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn weight(behind: f64) -> f64 {
    let far = if behind > 0.0 { behind } else { 0.0 } / BEHIND;
    let weight = 1.0 / (1.0 + far * far);
    if behind < -IN_FRONT { 0.0 } else { weight }
}

/// Weights of the sources in a row, at most a block of them, for a layer on `plane`; 0 where there is none.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn weigh(us: &[f64], v: f64, plane: &Plane, surface: &[f32], weights: &mut [f64; BLOCK]) {
    let (a, b, cv) = (plane.a, plane.b, plane.c * v);
    let mut any_behind = false;
    for ((w, u), &d) in weights.iter_mut().zip(us).zip(surface) {
        *w = f64::from((a + b * u + cv) as f32) - f64::from(d);
        any_behind |= *w > 0.0;
    }
    let (weights, past) = weights.split_at_mut(surface.len().min(BLOCK));
    past.fill(0.0);
    if any_behind {
        for w in weights {
            *w = weight(*w);
        }
    } else {
        // nothing lies behind: no division
        for w in weights {
            *w = if *w < -IN_FRONT { 0.0 } else { 1.0 };
        }
    }
}

/// Colour times weight, and weight.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn weighted(c: [u8; 3], w: f64) -> [f32; 4] {
    [f64::from(c[0]), f64::from(c[1]), f64::from(c[2]), 1.0].map(|c| (c * w) as f32)
}

dispatch!(
    /// Sums of 2×2 sources of one or two rows for a layer on `plane`, as [`pull`] has them: colour times weight, and weight.
    pub gather, gather_body, gather_avx2, (us: &[f64], plane: &Plane, rows: [Sources; 2], out: &mut [[f32; 4]])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn gather_body(us: &[f64], plane: &Plane, [first, second]: [Sources; 2], out: &mut [[f32; 4]]) {
    let (mut upper, mut lower) = ([0f64; BLOCK], [0f64; BLOCK]);
    // a block of each row, so that its length is known
    let (mut colours, mut below) = ([[0u8; 3]; BLOCK], [[0u8; 3]; BLOCK]);
    let part = |row: Sources, at: usize| -> Range<usize> { at.min(row.surface.len())..(at + BLOCK).min(row.surface.len()) };
    for (i, (out, us)) in out.chunks_mut(BLOCK / 2).zip(us.chunks(BLOCK)).enumerate() {
        for (row, weights, colours) in [(first, &mut upper, &mut colours), (second, &mut lower, &mut below)] {
            let part = part(row, i * BLOCK);
            colours[..part.len()].copy_from_slice(&row.rgb[part.clone()]);
            weigh(us, row.v, plane, &row.surface[part], weights);
        }
        let pairs = colours.as_chunks::<2>().0.iter().zip(below.as_chunks::<2>().0);
        let weights = upper.as_chunks::<2>().0.iter().zip(lower.as_chunks::<2>().0);
        for ((o, ([a, b], [c, d])), ([wa, wb], [wc, wd])) in out.iter_mut().zip(pairs).zip(weights) {
            let sum = (wa + wb) + (wc + wd);
            *o = if sum == 4.0 {
                let mean = |k: usize| (u32::from(a[k]) + u32::from(b[k]) + u32::from(c[k]) + u32::from(d[k])) as f32 * 0.25;
                [mean(0), mean(1), mean(2), 1.0]
            } else if sum == 0.0 {
                [0.0; 4]
            } else {
                saturated(add(&add(&add(&weighted(*a, *wa), &weighted(*b, *wb)), &weighted(*c, *wc)), &weighted(*d, *wd)))
            };
        }
    }
}

/// Sum of two texels.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn add(a: &[f32; 4], b: &[f32; 4]) -> [f32; 4] {
    std::array::from_fn(|i| a[i] + b[i])
}

/// A texel of weight at most 1, so that one source suffices where there is no other.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn saturated(t: [f32; 4]) -> [f32; 4] {
    if t[3] > 1.0 {
        let s = 1.0 / f64::from(t[3]);
        t.map(|v| (f64::from(v) * s) as f32)
    } else {
        t
    }
}

dispatch!(
    /// Sums of 2×2 texels of one or two rows of a finer level; weights beyond 1 are saturated.
    pub pull, pull_body, pull_avx2, (first: &[[f32; 4]], second: Option<&[[f32; 4]]>, out: &mut [[f32; 4]])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn pull_body(first: &[[f32; 4]], second: Option<&[[f32; 4]]>, out: &mut [[f32; 4]]) {
    let (firsts, last) = first.as_chunks::<2>();
    if let Some(second) = second {
        for ((o, [a, b]), [c, d]) in out.iter_mut().zip(firsts).zip(second.as_chunks::<2>().0) {
            *o = saturated(add(&add(&add(a, b), c), d));
        }
    } else {
        for (o, [a, b]) in out.iter_mut().zip(firsts) {
            *o = saturated(add(a, b));
        }
    }
    // of an odd count the last stands alone
    if let ([t], Some(o)) = (last, out.get_mut(firsts.len())) {
        *o = saturated(second.and_then(<[_]>::last).map_or(*t, |below| add(t, below)));
    }
}

/// Two rows of the next coarser level: the one that a texel lies in, and the one beside it that is nearer; empty where there is no
/// coarser level.
#[derive(Clone, Copy)]
pub struct Coarser<'a> {
    /// Three quarters of the colour.
    pub near: &'a [[f32; 4]],
    /// One quarter.
    pub other: &'a [[f32; 4]],
}

/// Full colour of texel `x` of a row: its own where the weight is 1, the coarser level's, bilinear between texel centres, where it
/// is 0.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn full(t: &[f32; 4], x: usize, Coarser { near, other }: Coarser) -> [f32; 4] {
    let weight = f64::from(t[3]);
    if weight < 1.0 && !near.is_empty() {
        let last = near.len() - 1;
        let beside = if x.is_multiple_of(2) { (x / 2).saturating_sub(1) } else { x / 2 + 1 };
        let (x0, x1) = ((x / 2).min(last), beside.min(last));
        let (a, b, c, d) = (&near[x0], &near[x1], &other[x0], &other[x1]);
        let mut out: [f32; 4] = std::array::from_fn(|i| {
            let up = 0.5625 * f64::from(a[i]) + 0.1875 * (f64::from(b[i]) + f64::from(c[i])) + 0.0625 * f64::from(d[i]);
            (f64::from(t[i]) + (1.0 - weight) * up) as f32
        });
        out[3] = 1.0;
        out
    } else if weight > 0.0 {
        t.map(|v| (f64::from(v) / weight) as f32)
    } else {
        *t
    }
}

dispatch!(
    /// Full colours of the texels of a row from column `x` on.
    pub push, push_body, push_avx2, (coarser: Coarser, x: usize, texels: &mut [[f32; 4]])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn push_body(coarser: Coarser, x: usize, texels: &mut [[f32; 4]]) {
    for (x, t) in (x..).zip(texels) {
        // a colour of weight 1 is full
        if t[3] != 1.0 {
            *t = full(t, x, coarser);
        }
    }
}

dispatch!(
    /// Appends the colours of the hidden texels of a row, whose classes are `class`, to `out`. `us` and `row` begin with the first of
    /// them, which lies in column `x` of the window that `coarser` is of.
    pub colours, colours_body, colours_avx2,
    (us: &[f64], plane: &Plane, row: Sources, coarser: Coarser, x: usize, class: &[u8], out: &mut Vec<[u8; 3]>)
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn colours_body(us: &[f64], plane: &Plane, row: Sources, coarser: Coarser, x: usize, class: &[u8], out: &mut Vec<[u8; 3]>) {
    let (a, b, cv) = (plane.a, plane.b, plane.c * row.v);
    let pixels = class.iter().zip(us).zip(row.surface).zip(row.rgb);
    for (x, (((_, u), &d), rgb)) in (x..).zip(pixels).filter(|(_, (((c, _), _), _))| **c == Class::Hidden as u8) {
        let weight = weight(f64::from((a + b * u + cv) as f32) - f64::from(d));
        out.push(if weight == 1.0 {
            *rgb
        } else {
            let [r, g, b, _] = full(&weighted(*rgb, weight), x, coarser);
            // rounded; the cast takes what lies outside to 0 and 255
            [r, g, b].map(|v| (f64::from(v) + 0.5) as u8)
        });
    }
}

/// A dilated mask, and what is needed to come to it.
#[derive(Default)]
pub struct Dilation {
    line: Vec<u8>,
    column: Vec<u8>,
    /// The part that was asked for.
    pub out: Vec<u8>,
}

/// Box dilation of the mask `open`, `width` pixels wide, by `radius` pixels to the right and left, up and down; what comes out is
/// the part `inner` of it.
pub fn dilate(open: &[u8], width: u32, inner: Rect, radius: (u32, u32), Dilation { line, column, out }: &mut Dilation) {
    let (width, rx, ry) = (width as usize, radius.0 as usize, radius.1 as usize);
    let (x0, y0, w, h) = (inner.x as usize, inner.y as usize, inner.w as usize, inner.h as usize);
    let height = open.len() / width.max(1);
    // rows that any row of the part looks at, each dilated sideways
    let first = y0.saturating_sub(ry);
    let last = (y0 + h + ry).min(height);
    let above = ry.saturating_sub(y0);
    column.clear();
    column.resize((h + 2 * ry) * w, 0);
    for (from, to) in open[first * width..last * width].chunks(width).zip(column[above * w..].chunks_mut(w)) {
        line.clear();
        line.resize(w + 2 * rx, 0);
        // column `x0 − rx` of the mask is the line's first
        let (skip, start) = ((rx).saturating_sub(x0), x0.saturating_sub(rx));
        let count = (width - start).min(line.len() - skip);
        line[skip..skip + count].copy_from_slice(&from[start..start + count]);
        spread(line, 1, 2 * rx + 1);
        to.copy_from_slice(&line[..w]);
    }
    // the same downwards, whole rows at a time
    spread(column, w, 2 * ry + 1);
    out.clear();
    out.extend_from_slice(&column[..h * w]);
}

/// Every value becomes that of any of the `count` values that follow in steps of `stride`, itself the first: by doubling.
fn spread(values: &mut [u8], stride: usize, count: usize) {
    let mut reached = 1;
    while reached < count {
        let by = reached.min(count - reached) * stride;
        let n = values.len().saturating_sub(by);
        or_from(values, by, n);
        reached += by / stride;
    }
}

dispatch!(
    /// Adds to each of the first `n` values the one `by` places later.
    or_from, or_from_body, or_from_avx2, (values: &mut [u8], by: usize, n: usize)
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn or_from_body(values: &mut [u8], by: usize, n: usize) {
    const BLOCK: usize = 32;
    // values that come later are read before they change, also where a block meets the one it reads
    let mut at = 0;
    while at + BLOCK <= n {
        let mut later = [0u8; BLOCK];
        later.copy_from_slice(&values[at + by..at + by + BLOCK]);
        for (v, l) in values[at..at + BLOCK].iter_mut().zip(later) {
            *v |= l;
        }
        at += BLOCK;
    }
    for i in at..n {
        values[i] |= values[i + by];
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        #[test]
        fn dilation_is_a_box(
            mask in prop::collection::vec(prop::bool::weighted(0.05).prop_map(u8::from), 15 * 11),
            rx in 0u32..20, ry in 0u32..20, x in 0u32..15, y in 0u32..11,
        ) {
            let inner = Rect { x, y, w: (15 - x).min(7), h: (11 - y).min(4) };
            let mut d = Dilation::default();
            dilate(&mask, 15, inner, (rx, ry), &mut d);
            prop_assert_eq!(d.out.len(), inner.area());
            for (i, got) in d.out.into_iter().enumerate() {
                let (px, py) = (x + i as u32 % inner.w, y + i as u32 / inner.w);
                let near = |j: u32| px.abs_diff(j % 15) <= rx && py.abs_diff(j / 15) <= ry;
                let want = (0..15 * 11).any(|j| mask[j as usize] != 0 && near(j));
                prop_assert_eq!(got, u8::from(want), "at {}, {}", px, py);
            }
        }

        /// Rows of any length against a pixel at a time.
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
            let (count, step) = behind(&own, surface, &labels, label, &mut hidden);
            let (mut want_count, mut want_step) = (0, 0f64);
            for i in 0..n {
                prop_assert_eq!(own[i].to_bits(), (plane.disparity(us[i], v) as f32).to_bits());
                prop_assert_eq!(mask[i], u8::from(f64::from(surface[i]) <= f64::from(own[i]) + 0.004));
                let is = Some(labels[i]) != label && own[i] < surface[i] && own[i] >= 0.0;
                prop_assert_eq!(hidden[i], u8::from(is));
                if is {
                    want_count += 1;
                    want_step = want_step.max(f64::from(surface[i]) - f64::from(own[i]));
                }
            }
            prop_assert_eq!((count, step.to_bits()), (want_count, want_step.to_bits()));
            prop_assert_eq!(nearest(surface).to_bits(), surface.iter().copied().fold(0.0, f32::max).to_bits());
        }
    }
}
