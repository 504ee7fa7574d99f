//! The kernel for opaque pixels: one source for all vector instruction sets, with identical bits from each.

use fearless_simd::{Simd, f32x8, prelude::*, u8x32, u16x16, u32x8};

use super::lanes::{LANES, Pixels, Run, Soften};

/// Added to a number in 0 to 2²³, this leaves the number's integer part in the mantissa.
const WHOLE: f32 = 8_388_608.0;

/// Draws the opaque ones among eight pixels, and returns which of the others are soft.
#[inline(always)]
pub(super) fn opaque<S: Simd>(simd: S, run: &Run, pixels: Pixels) -> Soften {
    let Pixels { depth, out } = pixels;
    let step = f32x8::load_array(simd, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]) + run.at as f32;
    let delta = at_least_0(along(step, run.span.delta));
    let before = f32x8::load_array_ref(simd, depth);
    let nearer = !delta.simd_le(before);
    if nearer.all_false() {
        return Soften::default();
    }
    let z = f32x8::splat(simd, 1.0) / along(step, run.span.lambda);
    let (x, y) = (place(along(step, run.span.x) * z, run.last[0]), place(along(step, run.span.y) * z, run.last[1]));
    let four = neighbours(simd, run, x, y);
    let [a, b, c, d] = four;
    let alpha = u32x8::splat(simd, u32::from_le_bytes([0, 0, 0, 255]));
    let full = (a & b & c & d & alpha).simd_eq(alpha);
    let empty = ((a | b | c | d) & alpha).simd_eq(0);
    let drawn = full & nearer;
    if drawn.any_true() {
        // in the photo's own view, every pixel centre is a texel centre
        let exact = ((x | y) & 255).simd_eq(0).all_true();
        let mixed = if exact { a } else { mix(simd, four, x, y) };
        let old = u32x8::load_array(simd, bytemuck::cast::<_, [u32; LANES]>(*out).map(u32::from_le));
        *out = bytemuck::cast(drawn.select(mixed, old).to_array().map(u32::to_le));
        *depth = drawn.select(delta, before).to_array();
    }
    let lanes = (nearer & !(full | empty)).to_bitmask() as u32;
    if lanes == 0 {
        return Soften::default();
    }
    Soften { lanes, delta: delta.to_array(), x: x.to_array(), y: y.to_array() }
}

/// A linear function at positions `step` of the span.
#[inline(always)]
fn along<S: Simd>(step: f32x8<S>, f: [f32; 2]) -> f32x8<S> {
    step * f[1] + f[0]
}

/// `v`, or 0 where it is less than 0 or NaN.
#[inline(always)]
fn at_least_0<S: Simd>(v: f32x8<S>) -> f32x8<S> {
    let zero = f32x8::splat(v.token(), 0.0);
    v.simd_gt(zero).select(v, zero)
}

/// Distance of a position in texels from the first texel's centre, in 256ths, clamped to 0..=`last`.
#[inline(always)]
fn place<S: Simd>(v: f32x8<S>, last: f32) -> u32x8<S> {
    let (v, last) = (at_least_0(v - 0.5), f32x8::splat(v.token(), last));
    (v.simd_lt(last).select(v, last) * 256.0 + WHOLE).to_bits() & 0x007f_ffff
}

/// The four texels around each lane's position, as little-endian words.
#[inline(always)]
fn neighbours<S: Simd>(simd: S, run: &Run, x: u32x8<S>, y: u32x8<S>) -> [u32x8<S>; 4] {
    let texels: &[u32] = bytemuck::cast_slice(run.texels);
    let (column, row) = (x >> 8, y >> 8);
    let right = column - column[0];
    let first = row[0] as usize * run.stride + column[0] as usize;
    // all in one row and within eight columns: two loads per row cost less than one per lane
    if ((right & !7) | (row - row[0])).simd_eq(0).all_true() {
        let bytes = (right * 0x0404_0404 + 0x0302_0100).bitcast();
        let upper = [picked(simd, texels, first, bytes), picked(simd, texels, first + 1, bytes)];
        let below = first + run.stride;
        return [upper[0], upper[1], picked(simd, texels, below, bytes), picked(simd, texels, below + 1, bytes)];
    }
    let at = (row * run.stride as u32 + column).to_array();
    let mut four = [[0u32; LANES]; 4];
    for (i, at) in at.into_iter().enumerate() {
        let (at, below) = (at as usize, at as usize + run.stride);
        let (upper, lower) = (&texels[at..at + 2], &texels[below..below + 2]);
        (four[0][i], four[1][i], four[2][i], four[3][i]) = (upper[0], upper[1], lower[0], lower[1]);
    }
    let [a, b, c, d] = four;
    [words(simd, a), words(simd, b), words(simd, c), words(simd, d)]
}

#[inline(always)]
fn words<S: Simd>(simd: S, texels: [u32; LANES]) -> u32x8<S> {
    u32x8::load_array(simd, texels.map(u32::from_le))
}

/// Picks one of the eight texels from `at` on for each lane; `bytes` are the positions of its bytes among theirs.
#[inline(always)]
fn picked<S: Simd>(simd: S, texels: &[u32], at: usize, bytes: u8x32<S>) -> u32x8<S> {
    let mut eight = [0; LANES];
    eight.copy_from_slice(&texels[at..at + LANES]);
    words(simd, eight).bitcast::<u8x32<S>>().swizzle_dyn(bytes).bitcast()
}

/// Interpolates four opaque texels per lane: even and odd bytes in 16 bits each, which hold the sums.
#[inline(always)]
fn mix<S: Simd>(simd: S, four: [u32x8<S>; 4], x: u32x8<S>, y: u32x8<S>) -> u32x8<S> {
    let (fx, fy) = (x & 255, y & 255);
    // both factors are below 256, so 16 bits hold their product
    let product: u32x8<S> = (halves(fx) * halves(fy)).bitcast();
    let both = (product + 128) >> 8;
    let (right, down) = (fx - both, fy - both);
    let first = u32x8::splat(simd, 256) - (fx + down);
    let even = u32x8::splat(simd, 0x00ff_00ff);
    let (mut sum_even, mut sum_odd) = (u16x16::splat(simd, 128), u16x16::splat(simd, 128));
    for (t, weight) in four.into_iter().zip([first, right, down, both]) {
        let weight = halves(weight | (weight << 16));
        sum_even += halves(t & even) * weight;
        sum_odd += (halves(t) >> 8) * weight;
    }
    (sum_even >> 8).bitcast::<u32x8<S>>() | (sum_odd.bitcast::<u32x8<S>>() & !even)
}

#[inline(always)]
fn halves<S: Simd>(words: u32x8<S>) -> u16x16<S> {
    words.bitcast()
}
