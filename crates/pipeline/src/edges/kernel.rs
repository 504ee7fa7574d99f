//! Kernels of edge snapping, which run row by row.

use fearless_simd::{Level, Simd, f32x8, prelude::*};
use tmpi_core::rim::{has_chroma_share, has_share};
use tmpi_core::simd::dispatch;

use super::window_rows::{Band, LANES, Lanes, REACH, exp2};
use super::{EDGE, MEDIAN, OWN, RADIUS, RAMP, Rim, SIDE, SIGMA_COLOUR, SIGMA_PLACE};

/// Added to each weight of a side, so that sides far from a colour still compare.
const TINY: f32 = 1e-20;
/// Room for the values of the median's window.
const VALUES: usize = 40;
/// Most values that are compared at once.
const ROOM: usize = 32;

/// Base-2 logarithm of the weight per squared level of colour.
const FALL: f32 = -std::f32::consts::LOG2_E / (255.0 * 255.0 * 2.0 * SIGMA_COLOUR * SIGMA_COLOUR);

/// What does not depend on the pixel.
pub(super) struct Tables {
    /// exp(−r²/2σ²) by row and column of the window; 0 outside it.
    place: [Lanes; 2 * RADIUS + 1],
    /// [`TINY`] inside the window, 0 outside it.
    tiny: Lanes,
    /// 1 inside the window, 0 outside it.
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

/// Sets all bits of each lane where `is` holds.
#[inline(always)]
fn mask(is: impl Fn(usize) -> bool) -> [u32; LANES] {
    std::array::from_fn(|k| u32::from(is(k)).wrapping_neg())
}

/// Adds values where their mask is set, by masking their bits: otherwise the sum becomes a masked store, which is slow.
#[inline(always)]
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
fn likeness<S: Simd>(simd: S, own: [f32; 3], colour: &[Lanes; 3]) -> f32x8<S> {
    let square = |c: usize| {
        let d = f32x8::load_array_ref(simd, &colour[c]) - f32x8::splat(simd, own[c]);
        d * d
    };
    exp2((square(0) + square(1) + square(2)) * FALL)
}

/// Sums over the pixels around one that are on one side of a ramp, near or far: weight, weighted δ, count.
type Side = [f32; 3];

/// Gives the pixels of row `y` that lie on ramps the δ of the side they belong to. `lo` and `hi` are the extremes of their windows.
pub(super) fn sides(level: Level, band: &Band, tables: &Tables, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
    fearless_simd::dispatch!(level, simd => sides_body(simd, band, tables, y, lo, hi, out));
}

#[inline(always)]
fn sides_body<S: Simd>(simd: S, band: &Band, tables: &Tables, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
    for (x, ((o, &lo), &hi)) in out.iter_mut().zip(lo).zip(hi).enumerate() {
        let step = hi - lo;
        if step <= RAMP {
            continue;
        }
        let t = (*o - lo) / step;
        if t <= 0.1 || t >= 0.9 {
            continue;
        }
        let (low, high) = gathered(simd, band, tables, (x, y), lo + 0.2 * step, lo + 0.8 * step);
        let score = |s: &Side| if s[2] > 0.0 { (s[0] / s[2]).ln() } else { f32::NEG_INFINITY };
        let side = if score(&low) + OWN * (1.0 - 2.0 * t) > score(&high) { low } else { high };
        if side[2] > 0.0 {
            *o = side[1] / side[0];
        }
    }
}

/// The two sides of a pixel's window: δ at most `low_to`, and δ at least `high_from`.
#[inline(always)]
fn gathered<S: Simd>(simd: S, band: &Band, tables: &Tables, (x, y): (usize, usize), low_to: f32, high_from: f32) -> (Side, Side) {
    let own = band.colour(x, y);
    let lanes = |of: &Lanes| f32x8::load_array_ref(simd, of);
    let (tiny, within, zero) = (lanes(&tables.tiny), lanes(&tables.within), f32x8::splat(simd, 0.0));
    let (mut low, mut high) = ([zero; 3], [zero; 3]);
    for row in band.near(y, RADIUS) {
        let s = band.strip(x, row);
        let weight = likeness(simd, own, &s.colour) * lanes(&tables.place[row + RADIUS - y]) + tiny;
        let delta = lanes(&s.delta);
        let product = weight * delta;
        let (is_low, is_high) = (delta.simd_le(low_to), delta.simd_ge(high_from));
        for (i, values) in [weight, product, within].into_iter().enumerate() {
            low[i] += is_low.select(values, zero);
            high[i] += is_high.select(values, zero);
        }
    }
    (low.map(|l| total(&l.to_array())), high.map(|l| total(&l.to_array())))
}

/// Colour-weighted median at the pixels of row `y` where δ has an edge, except those with more than `kept` of the weight on their own
/// side.
pub(super) fn medians(level: Level, band: &Band, kept: f32, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
    fearless_simd::dispatch!(level, simd => medians_body(simd, band, kept, y, lo, hi, out));
}

#[inline(always)]
fn medians_body<S: Simd>(simd: S, band: &Band, kept: f32, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
    for (x, ((o, &lo), &hi)) in out.iter_mut().zip(lo).zip(hi).enumerate() {
        if hi - lo <= EDGE {
            continue;
        }
        let own = band.colour(x, y);
        let (mut values, mut weights) = ([f32::INFINITY; VALUES], [0f32; VALUES]);
        let mut n = 0;
        for row in band.near(y, MEDIAN) {
            let s = band.strip(x, row);
            let like = likeness(simd, own, &s.colour).to_array();
            for k in REACH - MEDIAN..=REACH + MEDIAN {
                let inside = !s.delta[k].is_nan();
                let to = n + k + MEDIAN - REACH;
                values[to] = if inside { s.delta[k] } else { f32::INFINITY };
                weights[to] = if inside { like[k] + 1e-6 } else { 0.0 };
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
            *o = weighted_median(simd, values, weights);
        }
    }
}

/// The smallest value that, with all values up to it, has half of the weight; at most [`ROOM`] values.
#[inline(always)]
fn weighted_median<S: Simd>(simd: S, values: &[f32], weights: &[f32]) -> f32 {
    let mut of = [[f32::INFINITY; LANES]; ROOM / LANES];
    of.as_flattened_mut()[..values.len()].copy_from_slice(values);
    let up_to = up_to(simd, values, weights, &of);
    let (up_to, of) = (up_to.as_flattened(), of.as_flattened());
    let half = 0.5 * up_to.iter().copied().fold(0.0, |a, b| if b > a { b } else { a });
    up_to.iter().zip(of).fold(f32::INFINITY, |least, (sum, &v)| if *sum >= half && v < least { v } else { least })
}

/// Weight of all `values` up to each value of `of`. For a few dozen values, comparing all with all vectorises; sorting does not.
#[inline(always)]
fn up_to<S: Simd>(simd: S, values: &[f32], weights: &[f32], of: &[Lanes; ROOM / LANES]) -> [Lanes; ROOM / LANES] {
    let (of, zero) = (of.map(|of| f32x8::load_array(simd, of)), f32x8::splat(simd, 0.0));
    let mut sums = [zero; ROOM / LANES];
    for (&v, &w) in values.iter().zip(weights) {
        let (v, w) = (f32x8::splat(simd, v), f32x8::splat(simd, w));
        for (sum, of) in sums.iter_mut().zip(of) {
            *sum += v.simd_le(of).select(w, zero);
        }
    }
    sums.map(f32x8::to_array)
}

dispatch!(
    /// Gives far pixels of row `y` that touch the near side, and whose colour has a share of its ([`Rim`]), the near side's δ.
    pub(super) joins, joins_body, (band: &Band, tables: &Tables, rim: Rim, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32])
);

#[inline(always)]
fn joins_body(band: &Band, tables: &Tables, rim: Rim, y: usize, lo: &[f32], hi: &[f32], out: &mut [f32]) {
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
        let sides = [0, 1, 2].map(|i| (near[i] / near[4], far[i] / far[4]));
        let (own, step) = (band.colour(x, y), sides.map(|(near, far)| near - far));
        let above = [0, 1, 2].map(|i| own[i] - sides[i].1);
        if has_share(above, step) || rim == Rim::Video && has_chroma_share(above, step) {
            *o = near[3] / near[4];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::NONE;
    use super::*;
    use tmpi_core::{DisparityMap, Photo};

    /// [`gathered`] with a loop over lanes and plain `f32`s, in the same order.
    fn sides_of(band: &Band, tables: &Tables, (x, y): (usize, usize), low_to: f32, high_from: f32) -> (Side, Side) {
        let own = band.colour(x, y);
        let (mut low, mut high) = ([[0f32; LANES]; 3], [[0f32; LANES]; 3]);
        for row in band.near(y, RADIUS) {
            let s = band.strip(x, row);
            for k in 0..LANES {
                let d: [f32; 3] = std::array::from_fn(|c| s.colour[c][k] - own[c]);
                let like = super::super::window_rows::tests::exp2_of((d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) * FALL);
                let weight = like * tables.place[row + RADIUS - y][k] + tables.tiny[k];
                for (i, value) in [weight, weight * s.delta[k], tables.within[k]].into_iter().enumerate() {
                    low[i][k] += if s.delta[k] <= low_to { value } else { 0.0 };
                    high[i][k] += if s.delta[k] >= high_from { value } else { 0.0 };
                }
            }
        }
        (low.map(|l| total(&l)), high.map(|l| total(&l)))
    }

    #[test]
    fn every_vector_level_gives_the_bits_of_single_pixels() {
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
        for level in levels() {
            for (x, y) in (0..w as usize).flat_map(|x| (0..h as usize).map(move |y| (x, y))) {
                let bits = |(low, high): (Side, Side)| [low.map(f32::to_bits), high.map(f32::to_bits)];
                let got = fearless_simd::dispatch!(level, simd => gathered(simd, &band, &tables, (x, y), 0.3, 0.6));
                assert_eq!(bits(got), bits(sides_of(&band, &tables, (x, y), 0.3, 0.6)), "{level:?} {x} {y}");
            }
        }
        // whole rows, at the baseline level and at all others
        let (lo, hi) = (vec![0.1; w as usize], vec![0.9; w as usize]);
        let mut moved = [0; 2];
        for (y, row) in delta.delta.chunks(w as usize).enumerate() {
            let by = |level: Level| {
                let (mut sided, mut filtered) = (row.to_vec(), row.to_vec());
                sides(level, &band, &tables, y, &lo, &hi, &mut sided);
                medians(level, &band, NONE, y, &lo, &hi, &mut filtered);
                [sided, filtered].map(|r| r.into_iter().map(f32::to_bits).collect::<Vec<_>>())
            };
            let want = by(Level::baseline());
            for level in levels() {
                assert!(by(level) == want, "{level:?}, row {y}");
            }
            for (moved, want) in moved.iter_mut().zip(want) {
                *moved += want.iter().zip(row).filter(|(a, b)| **a != b.to_bits()).count();
            }
        }
        // with rough colours most medians are the pixel's own value
        assert!(moved[0] > 500 && moved[1] > 20, "{moved:?}");
    }

    /// All vector levels of this processor.
    fn levels() -> Vec<Level> {
        let mut all = vec![Level::baseline(), Level::new()];
        #[cfg(target_arch = "x86_64")]
        all.extend([Level::new().as_sse4_2().map(Level::Sse4_2), Level::new().as_avx2().map(Level::Avx2)].into_iter().flatten());
        all
    }
}
