//! What is done about each pixel, row by row.

use super::band::{Band, LANES, Lanes, REACH, exp2};
use super::{EDGE, JOIN, MEDIAN, OWN, RADIUS, RAMP, SIGMA_COLOUR, SIGMA_PLACE};
use crate::simd::dispatch;

/// Added to each weight of a side, so that sides far from a colour can still be told apart.
const TINY: f32 = 1e-20;
/// Contrast below which sides are of about one colour, in levels.
const CONTRAST: f32 = 12.0;
/// Values of the median's window, and as many as are written beyond them.
const VALUES: usize = 40;
/// Values that are compared at once.
const ROOM: usize = 32;

/// Logarithm to the base 2 of a weight a squared level of colour.
const FALL: f32 = -std::f32::consts::LOG2_E / (255.0 * 255.0 * 2.0 * SIGMA_COLOUR * SIGMA_COLOUR);

/// What does not depend on the pixel.
pub(super) struct Tables {
    /// exp(−r²/2σ²) by row and column of the window; 0 beside it.
    place: [Lanes; 2 * RADIUS + 1],
    /// [`TINY`] within the window, 0 beside it.
    tiny: Lanes,
    /// 1 within the window, 0 beside it.
    within: Lanes,
}

impl Tables {
    pub fn new() -> Self {
        let inside = |k: usize| k <= 2 * RADIUS;
        let of = |i: usize, k: usize| {
            let r2 = i.abs_diff(RADIUS).pow(2) + k.abs_diff(REACH).pow(2);
            if inside(k) { (-(r2 as f32) / (2.0 * SIGMA_PLACE * SIGMA_PLACE)).exp() } else { 0.0 }
        };
        Self {
            place: std::array::from_fn(|i| std::array::from_fn(|k| of(i, k))),
            tiny: std::array::from_fn(|k| if inside(k) { TINY } else { 0.0 }),
            within: std::array::from_fn(|k| f32::from(u8::from(inside(k)))),
        }
    }
}

/// All bits of a lane where `is` holds.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn mask(is: impl Fn(usize) -> bool) -> [u32; LANES] {
    std::array::from_fn(|k| u32::from(is(k)).wrapping_neg())
}

/// Adds values where they count: by their bits, or the sum becomes a store under a mask, which is slow.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn add(sums: &mut Lanes, values: &Lanes, counts: &[u32; LANES]) {
    for ((s, v), m) in sums.iter_mut().zip(values).zip(counts) {
        *s += f32::from_bits(v.to_bits() & m);
    }
}

fn total(lanes: &Lanes) -> f32 {
    lanes.iter().sum()
}

/// exp(−dc²/2σ²) by colour distance.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn likeness(own: [f32; 3], colour: &[Lanes; 3]) -> Lanes {
    std::array::from_fn(|k| {
        let d: [f32; 3] = std::array::from_fn(|c| colour[c][k] - own[c]);
        exp2((d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) * FALL)
    })
}

dispatch!(
    /// Gives the pixels of row `y` that lie on ramps the δ of the side that they belong to; `lo`, `hi`: extremes of their windows.
    pub(super) sides, sides_body, sides_avx2, (band: &Band, tables: &Tables, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn sides_body(band: &Band, tables: &Tables, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
    for (x, ((o, &lo), &hi)) in out.iter_mut().zip(lo).zip(hi).enumerate() {
        let step = hi - lo;
        if step <= RAMP {
            continue;
        }
        let t = (*o - lo) / step;
        if t <= 0.1 || t >= 0.9 {
            continue;
        }
        let own = band.colour(x, y);
        let (low_to, high_from) = (lo + 0.2 * step, lo + 0.8 * step);
        // per side: weight, weighted δ, count
        let mut low = [[0f32; LANES]; 3];
        let mut high = [[0f32; LANES]; 3];
        for row in band.near(y, RADIUS) {
            let s = band.strip(x, row);
            let like = likeness(own, &s.colour);
            let place = &tables.place[row + RADIUS - y];
            let weight: Lanes = std::array::from_fn(|k| like[k] * place[k] + tables.tiny[k]);
            let product: Lanes = std::array::from_fn(|k| weight[k] * s.delta[k]);
            let is_low = mask(|k| s.delta[k] <= low_to);
            let is_high = mask(|k| s.delta[k] >= high_from);
            for (i, values) in [&weight, &product, &tables.within].into_iter().enumerate() {
                add(&mut low[i], values, &is_low);
                add(&mut high[i], values, &is_high);
            }
        }
        let (low, high) = (low.map(|l| total(&l)), high.map(|l| total(&l)));
        let score = |s: &[f32; 3]| if s[2] > 0.0 { (s[0] / s[2]).ln() } else { f32::NEG_INFINITY };
        let side = if score(&low) + OWN * (1.0 - 2.0 * t) > score(&high) { low } else { high };
        if side[2] > 0.0 {
            *o = side[1] / side[0];
        }
    }
}

/// Colour-weighted median of the pixels of row `y` where δ has an edge.
pub(super) fn medians(band: &Band, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
        // SAFETY: both features were just found.
        #[allow(unsafe_code, reason = "the call is guarded by the test for the features that it needs")]
        return unsafe { medians_avx2(band, y, lo, hi, out) };
    }
    medians_body(band, y, lo, hi, out, up_to);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn medians_avx2(band: &Band, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
    // left to the compiler, the sums are drawn together in half registers: three times the time
    medians_body(band, y, lo, hi, out, |values, weights, of| {
        use std::arch::x86_64::{_CMP_LE_OQ, _mm256_add_ps, _mm256_and_ps, _mm256_cmp_ps, _mm256_set1_ps, _mm256_setzero_ps};
        let of = of.map(|of| lanes_avx2(&of));
        let mut sums = [_mm256_setzero_ps(); ROOM / LANES];
        for (&v, &w) in values.iter().zip(weights) {
            let (v, w) = (_mm256_set1_ps(v), _mm256_set1_ps(w));
            for (sum, of) in sums.iter_mut().zip(of) {
                *sum = _mm256_add_ps(*sum, _mm256_and_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(v, of), w));
            }
        }
        sums.map(|sum| from_lanes_avx2(sum))
    });
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn lanes_avx2(of: &Lanes) -> std::arch::x86_64::__m256 {
    let [a, b, c, d, e, f, g, h] = *of;
    std::arch::x86_64::_mm256_setr_ps(a, b, c, d, e, f, g, h)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
#[allow(unsafe_code, reason = "a store has no safe form")]
fn from_lanes_avx2(sum: std::arch::x86_64::__m256) -> Lanes {
    let mut out = [0f32; LANES];
    // SAFETY: eight values have room there.
    unsafe { std::arch::x86_64::_mm256_storeu_ps(out.as_mut_ptr(), sum) };
    out
}

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn medians_body(band: &Band, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32], up_to: impl Fn(&[f32], &[f32], &Sums) -> Sums) {
    for (x, ((o, &lo), &hi)) in out.iter_mut().zip(lo).zip(hi).enumerate() {
        if hi - lo <= EDGE {
            continue;
        }
        let own = band.colour(x, y);
        let (mut values, mut weights) = ([f32::INFINITY; VALUES], [0f32; VALUES]);
        let mut n = 0;
        for row in band.near(y, MEDIAN) {
            let s = band.strip(x, row);
            let like = likeness(own, &s.colour);
            for k in REACH - MEDIAN..=REACH + MEDIAN {
                let there = !s.delta[k].is_nan();
                let to = n + k + MEDIAN - REACH;
                values[to] = if there { s.delta[k] } else { f32::INFINITY };
                weights[to] = if there { like[k] + 1e-6 } else { 0.0 };
            }
            n += 2 * MEDIAN + 1;
        }
        *o = weighted_median(&values[..n], &weights[..n], &up_to);
    }
}

/// A figure for each of [`ROOM`] values.
pub(super) type Sums = [Lanes; ROOM / LANES];

/// The least value that, with all that are no greater, has half of the weight; at most [`ROOM`] values.
#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
pub(super) fn weighted_median(values: &[f32], weights: &[f32], up_to: &impl Fn(&[f32], &[f32], &Sums) -> Sums) -> f32 {
    let mut of = [[f32::INFINITY; LANES]; ROOM / LANES];
    of.as_flattened_mut()[..values.len()].copy_from_slice(values);
    let up_to = up_to(values, weights, &of);
    let (up_to, of) = (up_to.as_flattened(), of.as_flattened());
    let half = 0.5 * up_to.iter().copied().fold(0.0, |a, b| if b > a { b } else { a });
    up_to.iter().zip(of).fold(f32::INFINITY, |least, (sum, &v)| if *sum >= half && v < least { v } else { least })
}

/// Weight of all `values` that are no greater than each of `of`: for a few dozen values, to compare all with all vectorises, which
/// sorting them does not.
pub(super) fn up_to(values: &[f32], weights: &[f32], of: &Sums) -> Sums {
    of.map(|of| {
        let mut sum = [0f32; LANES];
        for (v, &w) in values.iter().zip(weights) {
            for k in 0..LANES {
                let more = sum[k] + w;
                sum[k] = if *v <= of[k] { more } else { sum[k] };
            }
        }
        sum
    })
}

dispatch!(
    /// Gives far pixels of row `y` that touch the near side, and whose colour is mixed with it, the near side's δ.
    pub(super) joins, joins_body, joins_avx2, (band: &Band, tables: &Tables, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn joins_body(band: &Band, tables: &Tables, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
    let last = out.len() - 1;
    for (x, ((o, &lo), &hi)) in out.iter_mut().zip(lo).zip(hi).enumerate() {
        let step = hi - lo;
        let (far_to, near_from) = (lo + 0.2 * step, lo + 0.8 * step);
        if step <= RAMP || *o - lo > 0.2 * step {
            continue;
        }
        let beside = x.saturating_sub(1)..=(x + 1).min(last);
        if !band.near(y, 1).any(|row| beside.clone().any(|x| band.delta(x, row) >= near_from)) {
            continue;
        }
        // per side: colour, δ, count
        let mut near = [[0f32; LANES]; 5];
        let mut far = [[0f32; LANES]; 5];
        for row in band.near(y, RADIUS) {
            let s = band.strip(x, row);
            let touching = row.abs_diff(y) <= 1;
            let is_near = mask(|k| s.delta[k] >= near_from && k <= 2 * RADIUS);
            let is_far = mask(|k| s.delta[k] <= far_to && k <= 2 * RADIUS && !(touching && k.abs_diff(REACH) <= 1));
            let values = [&s.colour[0], &s.colour[1], &s.colour[2], &s.delta, &tables.within];
            for (i, values) in values.into_iter().enumerate() {
                add(&mut near[i], values, &is_near);
                add(&mut far[i], values, &is_far);
            }
        }
        let (near, far) = (near.map(|l| total(&l)), far.map(|l| total(&l)));
        if near[4] < 1.0 || far[4] < 1.0 {
            continue;
        }
        let own = band.colour(x, y);
        let (mut dot, mut norm) = (0f32, 0f32);
        for i in 0..3 {
            let (f, b) = (near[i] / near[4], far[i] / far[4]);
            dot += (own[i] - b) * (f - b);
            norm += (f - b) * (f - b);
        }
        // sides of about one colour say nothing
        if norm > CONTRAST * CONTRAST && dot > JOIN * norm {
            *o = near[3] / near[4];
        }
    }
}
