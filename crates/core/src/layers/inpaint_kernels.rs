//! Inpainting kernels over rows of pixels, in forms that vectorise; every processor returns the same bits.
#![allow(clippy::float_cmp, reason = "weights that are exactly 0 or 1 take a shorter way")]

use std::ops::Range;

use crate::scene::{Class, Plane};
use crate::simd::dispatch;

/// How far in front of the layer a source may lie, in δ.
const IN_FRONT: f64 = 0.015;
/// Distance behind the layer, in δ, at which the weight of a source is one half.
const BEHIND: f64 = 0.06;

/// One row of pixels that can be sources of hidden colour.
#[derive(Clone, Copy)]
pub struct Sources<'a> {
    /// The row's `v` in the tile, in half tiles.
    pub v: f64,
    /// δ of the visible surface, infinite where the pixel is not a source.
    pub surface: &'a [f32],
    /// Colours of the photo.
    pub rgb: &'a [[u8; 3]],
}

impl Sources<'_> {
    /// An empty row.
    pub const NONE: Self = Self { v: 0.0, surface: &[], rgb: &[] };
}

/// Number of columns whose weights are computed together; even.
const BLOCK: usize = 32;

/// Weight of a source that lies behind the layer by `behind`, in δ.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn weight(behind: f64) -> f64 {
    let far = if behind > 0.0 { behind } else { 0.0 } / BEHIND;
    let weight = 1.0 / (1.0 + far * far);
    if behind < -IN_FRONT { 0.0 } else { weight }
}

/// Summary of the weights of a block of sources.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Weights {
    /// All weights are 0.
    Zero,
    /// The block is full, and all weights are 1.
    One,
    /// The weights differ, or the block is not full.
    Each,
}

/// Computes the weights of at most one block of sources in a row, for a layer on `plane`. Weights past the end of the row are 0.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn weigh(us: &[f64], v: f64, plane: &Plane, surface: &[f32], weights: &mut [f64; BLOCK]) -> Weights {
    let (a, b, cv) = (plane.a, plane.b, plane.c * v);
    let (mut any_behind, mut any_in_front, mut all_in_front) = (false, false, true);
    for ((w, u), &d) in weights.iter_mut().zip(us).zip(surface) {
        *w = f64::from((a + b * u + cv) as f32) - f64::from(d);
        any_behind |= *w > 0.0;
        any_in_front |= *w < -IN_FRONT;
        all_in_front &= *w < -IN_FRONT;
    }
    if all_in_front {
        weights.fill(0.0);
        return Weights::Zero;
    }
    let (weights, past) = weights.split_at_mut(surface.len().min(BLOCK));
    past.fill(0.0);
    if any_behind {
        for w in weights {
            *w = weight(*w);
        }
    } else if any_in_front || !past.is_empty() {
        // nothing lies behind, so no division is needed
        for w in weights {
            *w = if *w < -IN_FRONT { 0.0 } else { 1.0 };
        }
    } else {
        weights.fill(1.0);
        return Weights::One;
    }
    Weights::Each
}

/// Colour times weight, and weight.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn weighted(c: [u8; 3], w: f64) -> [f32; 4] {
    [f64::from(c[0]), f64::from(c[1]), f64::from(c[2]), 1.0].map(|c| (c * w) as f32)
}

dispatch!(
    /// Sums 2×2 sources of one or two rows for a layer on `plane`: colour times weight, and weight, in the form that [`pull`] takes.
    pub gather, gather_body, (us: &[f64], plane: &Plane, rows: [Sources; 2], out: &mut [[f32; 4]])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn gather_body(us: &[f64], plane: &Plane, [first, second]: [Sources; 2], out: &mut [[f32; 4]]) {
    let (mut upper, mut lower) = ([0f64; BLOCK], [0f64; BLOCK]);
    // fixed-size copies, so that the compiler knows the length
    let (mut colours, mut below) = ([[0u8; 3]; BLOCK], [[0u8; 3]; BLOCK]);
    let part = |row: Sources, at: usize| -> Range<usize> { at.min(row.surface.len())..(at + BLOCK).min(row.surface.len()) };
    for (i, (out, us)) in out.chunks_mut(BLOCK / 2).zip(us.chunks(BLOCK)).enumerate() {
        let mut kinds = [Weights::Zero; 2];
        for ((row, weights), kind) in [(first, &mut upper), (second, &mut lower)].into_iter().zip(&mut kinds) {
            *kind = weigh(us, row.v, plane, &row.surface[part(row, i * BLOCK)], weights);
        }
        if kinds == [Weights::Zero; 2] {
            out.fill([0.0; 4]);
            continue;
        }
        for (row, colours) in [(first, &mut colours), (second, &mut below)] {
            let part = part(row, i * BLOCK);
            colours[..part.len()].copy_from_slice(&row.rgb[part]);
        }
        let pairs = colours.as_chunks::<2>().0.iter().zip(below.as_chunks::<2>().0);
        if kinds == [Weights::One; 2] {
            for (o, ([a, b], [c, d])) in out.iter_mut().zip(pairs) {
                *o = mean([a, b, c, d]);
            }
            continue;
        }
        let weights = upper.as_chunks::<2>().0.iter().zip(lower.as_chunks::<2>().0);
        for ((o, ([a, b], [c, d])), ([wa, wb], [wc, wd])) in out.iter_mut().zip(pairs).zip(weights) {
            let sum = (wa + wb) + (wc + wd);
            *o = if sum == 4.0 {
                mean([a, b, c, d])
            } else if sum == 0.0 {
                [0.0; 4]
            } else {
                saturated(add(&add(&add(&weighted(*a, *wa), &weighted(*b, *wb)), &weighted(*c, *wc)), &weighted(*d, *wd)))
            };
        }
    }
}

/// Mean of four sources of weight 1.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn mean([a, b, c, d]: [&[u8; 3]; 4]) -> [f32; 4] {
    let mean = |k: usize| (u32::from(a[k]) + u32::from(b[k]) + u32::from(c[k]) + u32::from(d[k])) as f32 * 0.25;
    [mean(0), mean(1), mean(2), 1.0]
}

/// Sum of two texels.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn add(a: &[f32; 4], b: &[f32; 4]) -> [f32; 4] {
    std::array::from_fn(|i| a[i] + b[i])
}

/// Scales a texel to a weight of at most 1, so that one source suffices where there are no others.
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
    /// Sums 2×2 texels of one or two rows of a finer level; weights above 1 are scaled to 1.
    pub pull, pull_body, (first: &[[f32; 4]], second: Option<&[[f32; 4]]>, out: &mut [[f32; 4]])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
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
    // the last texel of an odd number has no neighbour
    if let ([t], Some(o)) = (last, out.get_mut(firsts.len())) {
        *o = saturated(second.and_then(<[_]>::last).map_or(*t, |below| add(t, below)));
    }
}

/// Two rows of the next coarser level: the row that contains a texel, and the nearer of the rows beside it. Both are empty if there is no
/// coarser level.
#[derive(Clone, Copy)]
pub struct Coarser<'a> {
    /// The row that contains the texel; contributes three quarters.
    pub near: &'a [[f32; 4]],
    /// The row beside it; contributes one quarter.
    pub other: &'a [[f32; 4]],
}

/// Full colour of texel `x` of a row: its own at weight 1, the coarser level's at weight 0, interpolated bilinearly between texel centres.
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
    /// Computes the full colours of a row's texels from column `x` on.
    pub push, push_body, (coarser: Coarser, x: usize, texels: &mut [[f32; 4]])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn push_body(coarser: Coarser, x: usize, texels: &mut [[f32; 4]]) {
    for (x, t) in (x..).zip(texels) {
        // a colour of weight 1 is already full
        if t[3] != 1.0 {
            *t = full(t, x, coarser);
        }
    }
}

dispatch!(
    /// Appends to `out` the colours of the hidden texels of a row with the classes `class`. `us` and `row` start at the first texel, which
    /// is in column `x` of the window of `coarser`.
    pub colours, colours_body,
    (us: &[f64], plane: &Plane, row: Sources, coarser: Coarser, x: usize, class: &[u8], out: &mut Vec<[u8; 3]>)
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn colours_body(us: &[f64], plane: &Plane, row: Sources, coarser: Coarser, x: usize, class: &[u8], out: &mut Vec<[u8; 3]>) {
    let (a, b, cv) = (plane.a, plane.b, plane.c * row.v);
    let pixels = class.iter().zip(us).zip(row.surface).zip(row.rgb);
    for (x, (((_, u), &d), rgb)) in (x..).zip(pixels).filter(|(_, (((c, _), _), _))| **c == Class::Hidden as u8) {
        let behind = f64::from((a + b * u + cv) as f32) - f64::from(d);
        // most sources are in front, so no division is needed
        let weight = if behind < -IN_FRONT { 0.0 } else { weight(behind) };
        out.push(if weight == 1.0 {
            *rgb
        } else {
            let [r, g, b, _] = full(&weighted(*rgb, weight), x, coarser);
            // rounds to nearest; the cast clamps to 0..=255
            [r, g, b].map(|v| (f64::from(v) + 0.5) as u8)
        });
    }
}
