//! What is done about each pixel, row by row.

use super::band::{Band, LANES, Lanes, REACH, ROUND, SERIES, exp2};
use super::{EDGE, JOIN, MEDIAN, OWN, RADIUS, RAMP, SIDE, SIGMA_COLOUR, SIGMA_PLACE};
use tmpi_core::simd::dispatch;

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

/// Of the pixels around one that are on the near and on the far side of a ramp: weight, weighted δ, count.
type Side = [f32; 3];

/// Gives the pixels of row `y` that lie on ramps the δ of the side that they belong to; `lo`, `hi`: extremes of their windows.
pub(super) fn sides(band: &Band, tables: &Tables, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
        // SAFETY: both features were just found.
        #[allow(unsafe_code, reason = "the call is guarded by the test for the features that it needs")]
        return unsafe { sides_avx2(band, tables, y, lo, hi, out) };
    }
    sides_portable(band, tables, y, lo, hi, out);
}

/// The same by lanes that the compiler makes of it what it can.
fn sides_portable(band: &Band, tables: &Tables, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
    sides_body(band, y, lo, hi, out, |x, own, low_to, high_from| gathered(band, tables, (x, y), own, low_to, high_from));
}

fn gathered(band: &Band, tables: &Tables, (x, y): (usize, usize), own: [f32; 3], low_to: f32, high_from: f32) -> (Side, Side) {
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
    (low.map(|l| total(&l)), high.map(|l| total(&l)))
}

// whether the compiler makes vectors of the lanes changes from build to build; these are, and give the same bits
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn sides_avx2(band: &Band, tables: &Tables, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
    use std::arch::x86_64::{
        _CMP_GE_OQ, _CMP_LE_OQ, _mm256_add_ps, _mm256_and_ps, _mm256_cmp_ps, _mm256_mul_ps, _mm256_set1_ps, _mm256_setzero_ps,
        _mm256_sub_ps,
    };
    sides_body(band, y, lo, hi, out, |x, own, low_to, high_from| {
        let [red, green, blue] = own.map(|c| _mm256_set1_ps(c));
        let (low_to, high_from, fall) = (_mm256_set1_ps(low_to), _mm256_set1_ps(high_from), _mm256_set1_ps(FALL));
        let (tiny, within) = (lanes_avx2(&tables.tiny), lanes_avx2(&tables.within));
        let mut low = [_mm256_setzero_ps(); 3];
        let mut high = [_mm256_setzero_ps(); 3];
        for row in band.near(y, RADIUS) {
            let s = band.strip(x, row);
            let square = |of: &Lanes, own| {
                let d = _mm256_sub_ps(lanes_avx2(of), own);
                _mm256_mul_ps(d, d)
            };
            let distance = _mm256_add_ps(_mm256_add_ps(square(&s.colour[0], red), square(&s.colour[1], green)), square(&s.colour[2], blue));
            let like = exp2_avx2(_mm256_mul_ps(distance, fall));
            let weight = _mm256_add_ps(_mm256_mul_ps(like, lanes_avx2(&tables.place[row + RADIUS - y])), tiny);
            let delta = lanes_avx2(&s.delta);
            let product = _mm256_mul_ps(weight, delta);
            let (is_low, is_high) = (_mm256_cmp_ps::<_CMP_LE_OQ>(delta, low_to), _mm256_cmp_ps::<_CMP_GE_OQ>(delta, high_from));
            for (i, values) in [weight, product, within].into_iter().enumerate() {
                low[i] = _mm256_add_ps(low[i], _mm256_and_ps(values, is_low));
                high[i] = _mm256_add_ps(high[i], _mm256_and_ps(values, is_high));
            }
        }
        (low.map(|l| total(&from_lanes_avx2(l))), high.map(|l| total(&from_lanes_avx2(l))))
    });
}

/// [`super::band::exp2`] of eight values, the same bits.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn exp2_avx2(x: std::arch::x86_64::__m256) -> std::arch::x86_64::__m256 {
    use std::arch::x86_64::{
        _mm256_add_epi32, _mm256_add_ps, _mm256_castps_si256, _mm256_castsi256_ps, _mm256_max_epu32, _mm256_mul_ps, _mm256_set1_epi32,
        _mm256_set1_ps, _mm256_slli_epi32, _mm256_sub_ps,
    };
    let round = _mm256_set1_ps(ROUND);
    let whole = _mm256_add_ps(x, round);
    let f = _mm256_sub_ps(x, _mm256_sub_ps(whole, round));
    let mut p = _mm256_set1_ps(SERIES[0]);
    for c in &SERIES[1..] {
        p = _mm256_add_ps(_mm256_mul_ps(p, f), _mm256_set1_ps(*c));
    }
    let least = _mm256_set1_epi32((ROUND - 126.0).to_bits().cast_signed());
    let power = _mm256_slli_epi32::<23>(_mm256_max_epu32(_mm256_castps_si256(whole), least));
    _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(p), power))
}

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn sides_body(band: &Band, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32], gather: impl Fn(usize, [f32; 3], f32, f32) -> (Side, Side)) {
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
        let (low, high) = gather(x, own, lo + 0.2 * step, lo + 0.8 * step);
        let score = |s: &Side| if s[2] > 0.0 { (s[0] / s[2]).ln() } else { f32::NEG_INFINITY };
        let side = if score(&low) + OWN * (1.0 - 2.0 * t) > score(&high) { low } else { high };
        if side[2] > 0.0 {
            *o = side[1] / side[0];
        }
    }
}

/// Colour-weighted median of the pixels of row `y` where δ has an edge, but for those that have more than `kept` of the weight on their side.
pub(super) fn medians(band: &Band, kept: f32, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
        // SAFETY: both features were just found.
        #[allow(unsafe_code, reason = "the call is guarded by the test for the features that it needs")]
        return unsafe { medians_avx2(band, kept, y, lo, hi, out) };
    }
    medians_body(band, kept, y, lo, hi, out, up_to);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn medians_avx2(band: &Band, kept: f32, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
    // left to the compiler, the sums are drawn together in half registers: three times the time
    medians_body(band, kept, y, lo, hi, out, |values, weights, of| {
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
fn medians_body(band: &Band, kept: f32, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32], up_to: impl Fn(&[f32], &[f32], &Sums) -> Sums) {
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
        let (values, weights) = (&values[..n], &weights[..n]);
        let near = SIDE * (hi - lo);
        let mut own = 0.0;
        for (v, w) in values.iter().zip(weights) {
            own += if (v - *o).abs() <= near { *w } else { 0.0 };
        }
        if own <= kept * weights.iter().sum::<f32>() {
            *o = weighted_median(values, weights, &up_to);
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_core::{DisparityMap, Photo};

    #[test]
    fn sides_are_the_same_bits_with_and_without_vectors() {
        let (w, h) = (61u32, 23u32);
        let mut state = 7u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1u64 << 24) as f32
        };
        let photo = Photo { width: w, height: h, rgb: (0..w * h).map(|_| std::array::from_fn(|_| (next() * 255.0) as u8)).collect() };
        let delta = DisparityMap { width: w, height: h, delta: (0..w * h).map(|_| next()).collect() };
        let (mut band, tables) = (Band::default(), Tables::new());
        band.load(&photo, &delta, 0..h as usize);
        let (lo, hi) = (vec![0.1; w as usize], vec![0.9; w as usize]);
        let mut moved = 0;
        for (y, row) in delta.delta.chunks(w as usize).enumerate() {
            let (mut one, mut other) = (row.to_vec(), row.to_vec());
            sides(&band, &tables, y, &lo, &hi, &mut one);
            sides_portable(&band, &tables, y, &lo, &hi, &mut other);
            assert!(one.iter().zip(&other).all(|(a, b)| a.to_bits() == b.to_bits()), "row {y}");
            moved += one.iter().zip(row).filter(|(a, b)| a.to_bits() != b.to_bits()).count();
        }
        assert!(moved > 500, "{moved}");
    }
}
