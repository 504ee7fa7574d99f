//! Edge snapping: depth networks blur depth edges into ramps; ramps would land on planes of their own and show as ghost
//! contours, so their pixels are given to one side or the other by colour (RECIPE, step 1).

use rayon::prelude::*;

use crate::simd::dispatch;
use crate::tmpi::{DisparityMap, Photo};

/// Half the window that a ramp is looked for in.
const RADIUS: usize = 3;
/// Range of δ in the window above which a pixel can lie on a ramp.
const RAMP: f32 = 0.03;
/// Range of δ in the window that makes an edge a strong one: weaker ones may be slopes.
const STRONG: f32 = 0.15;
/// Range of δ above which the median runs.
const EDGE: f32 = 0.02;
/// Spread of colour distance (RGB in 0..=1) and of place in pixels.
const SIGMA_COLOUR: f32 = 0.1;
const SIGMA_PLACE: f32 = 3.0;
/// Worth of a ramp pixel's own δ against the colours of the two sides, in log weight.
const OWN: f32 = 4.0;
/// Half the window of the median.
const MEDIAN: usize = 2;
/// Share of the way from background to foreground colour beyond which a rim pixel joins the foreground.
const JOIN: f32 = 0.25;

/// Gives the pixels of ramps to the near or the far side, then runs [`median`], then joins rim pixels to the near side.
#[must_use]
pub fn snap(photo: &Photo, delta: &DisparityMap) -> DisparityMap {
    let colour = ColourWeight::new();
    let snapped = each(delta, RADIUS, RAMP, |w| side(photo, &colour, w));
    let filtered = median_with(photo, &colour, &snapped);
    each(&filtered, RADIUS, RAMP, |w| join(photo, w))
}

/// Share of the pixels near strong depth edges that lie on a ramp between the two sides. True depth has 0.05 to 0.24 on seven
/// Middlebury maps and 0.63 to 0.94 once blurred by 5×5; maps of a large depth network have 0.25 to 0.43 where they have strong
/// edges at all.
#[must_use]
pub fn ramp_share(delta: &DisparityMap) -> f64 {
    let (lo, hi) = extremes(delta, RADIUS);
    let (mut ramp, mut edge) = (0usize, 0usize);
    for ((&d, lo), hi) in delta.delta.iter().zip(lo).zip(hi) {
        if hi - lo > STRONG {
            edge += 1;
            let t = (d - lo) / (hi - lo);
            ramp += usize::from(t > 0.1 && t < 0.9);
        }
    }
    if edge == 0 { 0.0 } else { ramp as f64 / edge as f64 }
}

/// [`ramp_share`] above which a map counts as blurred.
pub const BLURRED: f64 = 0.24;

/// Colour-weighted median over 5×5 pixels where δ has an edge; worth doing on true depth too.
#[must_use]
pub fn median(photo: &Photo, delta: &DisparityMap) -> DisparityMap {
    median_with(photo, &ColourWeight::new(), delta)
}

fn median_with(photo: &Photo, colour: &ColourWeight, delta: &DisparityMap) -> DisparityMap {
    each(delta, MEDIAN, EDGE, |w| {
        let own = photo.at(w.x as u32, w.y as u32);
        let (mut values, mut weights, mut n) = ([f32::INFINITY; LANES], [0f32; LANES], 0);
        w.each(MEDIAN, |x, y, d| {
            (values[n], weights[n]) = (d, colour.of(own, photo.at(x as u32, y as u32)) + 1e-6);
            n += 1;
        });
        Some(weighted_median(&values, &weights))
    })
}

/// Room for the window of the median.
const LANES: usize = 32;

dispatch!(
    /// The least value that, with all that are no greater, has half of the weight.
    weighted_median, weighted_median_body, weighted_median_avx2, (values: &[f32; LANES], weights: &[f32; LANES]) -> f32
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn weighted_median_body(values: &[f32; LANES], weights: &[f32; LANES]) -> f32 {
    // for a few dozen values, to compare all with all vectorises, which sorting them does not
    let mut up_to = [0f32; LANES];
    for (sums, of) in up_to.as_chunks_mut::<8>().0.iter_mut().zip(values.as_chunks::<8>().0) {
        let mut sum = [0f32; 8];
        for (v, w) in values.iter().zip(weights) {
            for k in 0..8 {
                let more = sum[k] + w;
                sum[k] = if *v <= of[k] { more } else { sum[k] };
            }
        }
        *sums = sum;
    }
    let half = 0.5 * up_to.iter().copied().fold(0.0, |a, b| if b > a { b } else { a });
    up_to.iter().zip(values).fold(f32::INFINITY, |least, (sum, &v)| if *sum >= half && v < least { v } else { least })
}

/// A pixel and its surroundings.
struct Window<'a> {
    delta: &'a DisparityMap,
    x: usize,
    y: usize,
    lo: f32,
    hi: f32,
}

impl Window<'_> {
    #[inline(always)]
    #[allow(clippy::inline_always, reason = "a call a pixel of the window costs more than what is done there")]
    fn each(&self, radius: usize, mut f: impl FnMut(usize, usize, f32)) {
        let (w, h) = (self.delta.width as usize, self.delta.height as usize);
        let columns = self.x.saturating_sub(radius)..(self.x + radius + 1).min(w);
        for y in self.y.saturating_sub(radius)..(self.y + radius + 1).min(h) {
            for (x, &d) in columns.clone().zip(&self.delta.delta[y * w..][columns.clone()]) {
                f(x, y, d);
            }
        }
    }

    fn own(&self) -> f32 {
        self.delta.delta[self.y * self.delta.width as usize + self.x]
    }
}

/// Runs `f` where the range of δ within `radius` exceeds `range`; none keeps the pixel.
fn each(delta: &DisparityMap, radius: usize, range: f32, f: impl Fn(&Window) -> Option<f32> + Sync) -> DisparityMap {
    let w = delta.width as usize;
    let (lo, hi) = extremes(delta, radius);
    let mut out = delta.delta.clone();
    out.par_chunks_mut(w).enumerate().for_each(|(y, row)| {
        for (x, o) in row.iter_mut().enumerate() {
            let (lo, hi) = (lo[y * w + x], hi[y * w + x]);
            if hi - lo > range
                && let Some(d) = f(&Window { delta, x, y, lo, hi })
            {
                *o = d;
            }
        }
    });
    DisparityMap { width: delta.width, height: delta.height, delta: out }
}

/// Least and greatest value of a `(2r+1)²` window.
fn extremes(delta: &DisparityMap, radius: usize) -> (Vec<f32>, Vec<f32>) {
    let (w, h) = (delta.width as usize, delta.height as usize);
    // not `f32::min`, whose care for NaN costs the vector instruction; the map is finite
    rayon::join(
        || extreme(&delta.delta, w, h, radius, |a, b| if b < a { b } else { a }),
        || extreme(&delta.delta, w, h, radius, |a, b| if b > a { b } else { a }),
    )
}

/// One of the extremes, by rows and then by columns.
fn extreme(d: &[f32], w: usize, h: usize, r: usize, pick: impl Fn(f32, f32) -> f32 + Sync) -> Vec<f32> {
    let merge = |to: &mut [f32], from: &[f32]| {
        for (o, v) in to.iter_mut().zip(from) {
            *o = pick(*o, *v);
        }
    };
    let mut rows = vec![0.0; d.len()];
    rows.par_chunks_mut(w).zip(d.par_chunks(w)).for_each(|(out, line)| {
        out.copy_from_slice(line);
        for off in 1..=r.min(w - 1) {
            merge(&mut out[..w - off], &line[off..]);
            merge(&mut out[off..], &line[..w - off]);
        }
    });
    let mut out = vec![0.0; d.len()];
    out.par_chunks_mut(w).enumerate().for_each(|(y, out)| {
        out.copy_from_slice(&rows[y * w..(y + 1) * w]);
        for yy in y.saturating_sub(r)..(y + r + 1).min(h) {
            merge(out, &rows[yy * w..(yy + 1) * w]);
        }
    });
    out
}

/// exp(−dc²/2σ²) by squared colour distance and exp(−r²/2σ²) by squared distance in pixels, tabulated.
struct ColourWeight {
    colour: Vec<f32>,
    place: [f32; 2 * RADIUS * RADIUS + 1],
}

impl ColourWeight {
    const SHIFT: u32 = 6;

    fn new() -> Self {
        let scale = 1.0 / (255.0 * 255.0 * 2.0 * SIGMA_COLOUR * SIGMA_COLOUR);
        let last = (3u32 * 255 * 255) >> Self::SHIFT;
        Self {
            colour: (0..=last).map(|i| (-(((i << Self::SHIFT) + (1 << Self::SHIFT) / 2) as f32) * scale).exp()).collect(),
            place: std::array::from_fn(|i| (-(i as f32) / (2.0 * SIGMA_PLACE * SIGMA_PLACE)).exp()),
        }
    }

    fn of(&self, a: [u8; 3], b: [u8; 3]) -> f32 {
        let d = |i: usize| u32::from(a[i].abs_diff(b[i])).pow(2);
        self.colour[((d(0) + d(1) + d(2)) >> Self::SHIFT) as usize]
    }
}

/// δ of the side that a ramp pixel belongs to.
fn side(photo: &Photo, colour: &ColourWeight, w: &Window) -> Option<f32> {
    let step = w.hi - w.lo;
    let t = (w.own() - w.lo) / step;
    if t <= 0.1 || t >= 0.9 {
        return None;
    }
    let own = photo.at(w.x as u32, w.y as u32);
    // per side: weight, weighted δ, count
    let mut sides = [[0f32; 3]; 2];
    let (low_to, high_from) = (w.lo + 0.2 * step, w.lo + 0.8 * step);
    w.each(RADIUS, |x, y, d| {
        if d > low_to && d < high_from {
            return;
        }
        let s = usize::from(d > low_to);
        let place = colour.place[x.abs_diff(w.x).pow(2) + y.abs_diff(w.y).pow(2)];
        let weight = colour.of(own, photo.at(x as u32, y as u32)) * place + 1e-20;
        sides[s][0] += weight;
        sides[s][1] += weight * d;
        sides[s][2] += 1.0;
    });
    let score = |s: &[f32; 3]| if s[2] > 0.0 { (s[0] / s[2]).ln() } else { f32::NEG_INFINITY };
    let low = score(&sides[0]) + OWN * (1.0 - 2.0 * t) > score(&sides[1]);
    let s = sides[usize::from(!low)];
    (s[2] > 0.0).then(|| s[1] / s[0])
}

/// δ of the near side where a far pixel that touches it has a colour mixed with it.
fn join(photo: &Photo, w: &Window) -> Option<f32> {
    let step = w.hi - w.lo;
    if (w.own() - w.lo) > 0.2 * step {
        return None;
    }
    let near_from = w.lo + 0.8 * step;
    let mut touches = false;
    w.each(1, |_, _, d| touches |= d >= near_from);
    if !touches {
        return None;
    }
    let (mut near, mut far) = ([0f32; 5], [0f32; 5]);
    w.each(RADIUS, |x, y, d| {
        let to = if d >= near_from {
            &mut near
        } else if d <= w.lo + 0.2 * step && x.abs_diff(w.x).max(y.abs_diff(w.y)) > 1 {
            &mut far
        } else {
            return;
        };
        let c = photo.at(x as u32, y as u32);
        for i in 0..3 {
            to[i] += f32::from(c[i]);
        }
        to[3] += d;
        to[4] += 1.0;
    });
    if near[4] == 0.0 || far[4] == 0.0 {
        return None;
    }
    let own = photo.at(w.x as u32, w.y as u32);
    let (mut dot, mut norm) = (0f32, 0f32);
    for i in 0..3 {
        let (f, b) = (near[i] / near[4], far[i] / far[4]);
        dot += (f32::from(own[i]) - b) * (f - b);
        norm += (f - b) * (f - b);
    }
    // sides of about one colour say nothing
    (norm > 12.0 * 12.0 && dot > JOIN * norm).then(|| near[3] / near[4])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step(ramp: f32) -> (Photo, DisparityMap) {
        let (w, h) = (48u32, 24u32);
        let photo =
            Photo { width: w, height: h, rgb: (0..w * h).map(|i| if i % w < 24 { [40, 60, 90] } else { [200, 150, 60] }).collect() };
        let d = (0..w * h).map(|i| 0.2 + 0.6 * ((i % w) as f32 - 24.0 + 0.5 + ramp / 2.0).max(0.0).min(ramp) / ramp).collect();
        (photo, DisparityMap { width: w, height: h, delta: d })
    }

    #[test]
    fn a_ramp_becomes_a_step_at_the_colour_edge() {
        let (photo, blurred) = step(4.0);
        let sharp = snap(&photo, &blurred);
        for (i, &d) in sharp.delta.iter().enumerate() {
            let want = if i % 48 < 24 { 0.2 } else { 0.8 };
            assert!((d - want).abs() < 0.1, "column {}: {d}", i % 48);
        }
    }

    #[test]
    fn a_true_step_and_a_slope_stay() {
        let (photo, sharp) = step(1e-3);
        assert_eq!(snap(&photo, &sharp), sharp);
        let slope = DisparityMap { delta: (0..48 * 24).map(|i| (i % 48) as f32 * 0.002).collect(), ..sharp };
        assert_eq!(snap(&photo, &slope), slope);
    }

    #[test]
    fn ramps_are_told_from_steps() {
        assert!(ramp_share(&step(12.0).1) > BLURRED && ramp_share(&step(1e-3).1) < BLURRED);
    }

    #[test]
    fn the_median_is_the_one_of_sorted_values() {
        let mut random = 7u32;
        let mut next = || {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (random >> 8) as f32 / (1 << 24) as f32
        };
        for n in 1..=25 {
            let (mut values, mut weights) = ([f32::INFINITY; LANES], [0f32; LANES]);
            for i in 0..n {
                // some are equal
                (values[i], weights[i]) = ((next() * 12.0).round() / 12.0, next() + 1e-6);
            }
            let mut sorted: Vec<(f32, f32)> = values.iter().copied().zip(weights).take(n).collect();
            sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
            let (total, mut sum) = (sorted.iter().map(|v| f64::from(v.1)).sum::<f64>(), 0.0);
            let want = sorted.iter().find(|v| {
                sum += f64::from(v.1);
                sum >= 0.5 * total
            });
            assert_eq!(Some(weighted_median(&values, &weights)), want.map(|v| v.0));
        }
    }

    #[test]
    fn tiny_photos_pass() {
        for (w, h) in [(1, 1), (1, 9), (9, 1)] {
            let photo = Photo { width: w, height: h, rgb: vec![[9, 9, 9]; (w * h) as usize] };
            let d = DisparityMap { width: w, height: h, delta: (0..w * h).map(|i| (i % 2) as f32).collect() };
            assert!(snap(&photo, &d).delta.iter().all(|d| d.is_finite()));
        }
    }
}
