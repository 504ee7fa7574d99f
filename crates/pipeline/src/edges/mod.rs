//! Edge snapping. Depth networks blur depth edges into ramps. Ramps would get planes of their own and show as ghost contours, so their
//! pixels are given to one side or the other by colour.

mod extremes;
mod kernel;
mod widen;
mod window_rows;

pub use self::widen::widen;

use rayon::prelude::*;

use fearless_simd::Level;

use self::extremes::extremes;
use self::kernel::Tables;
use self::window_rows::Band;
use tmpi_core::{DisparityMap, Photo};

/// Radius of the window in which a ramp is detected.
const RADIUS: usize = 3;
/// Range of δ in the window above which a pixel may lie on a ramp.
const RAMP: f32 = 0.03;
/// Range of δ in the window above which an edge is strong; weaker ones may be slopes.
const STRONG: f32 = 0.15;
/// Share of a step that must lie within 3×3 pixels of a ramp.
const STEEP: f32 = 0.2;
/// Range of δ above which the median runs.
const EDGE: f32 = 0.02;
/// Standard deviation of colour distance (RGB in 0..=1) in weights.
const SIGMA_COLOUR: f32 = 0.1;
/// Standard deviation of position in weights, in pixels.
const SIGMA_PLACE: f32 = 3.0;
/// Weight of a ramp pixel's own δ against the colours of the two sides, as a logarithm.
const OWN: f32 = 4.0;
/// Radius of the median's window.
const MEDIAN: usize = 2;
/// Share of the range of δ in a pixel's window within which other pixels are on the same side.
const SIDE: f32 = 0.3;
/// Share of weight on its own side above which [`median`] keeps a pixel.
const KEPT: f32 = 0.65;
/// A share that no pixel reaches.
const NONE: f32 = 2.0;

/// Rows per task.
const ROWS: usize = 16;

/// What decides whether a rim pixel joins the foreground.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rim {
    /// Its colour.
    Photo,
    /// Its colour, or its chroma alone. Video halves the resolution of chroma: the pixels outside of a thing have some of its chroma, and
    /// the brightness of the background. `tmpi-lab tears --size 320x240 --late 2 --shown 1` finds 1.2 % of the pictures torn; if a tenth of
    /// the colour decided instead, 13.5 %.
    Video,
}

/// Gives the pixels of ramps to the near or the far side, runs [`full_median`], then [`join_rims`].
pub fn snap(photo: &Photo, delta: &DisparityMap, rim: Rim) -> DisparityMap {
    let (level, tables) = (Level::new(), Tables::new());
    let snapped = each(photo, delta, RADIUS, |band, y, lo, hi, out| kernel::sides(level, band, &tables, y, lo, hi, out));
    join_rims(photo, &full_median(photo, &snapped), rim)
}

/// Gives pixels on the far side of an edge to the near side if more than a quarter of their colour is the near side's. Otherwise
/// they stay behind as a dotted contour wherever the near side moves away. In exact maps their share of the near side's colour is separated
/// better by matting (`tmpi-lab bench --only without`).
pub fn join_rims(photo: &Photo, delta: &DisparityMap, rim: Rim) -> DisparityMap {
    let tables = Tables::new();
    each(photo, delta, RADIUS, |band, y, lo, hi, out| kernel::joins(band, &tables, rim, y, lo, hi, out))
}

/// Share, 0 to 1, of the pixels near strong depth edges that lie on a ramp between the two sides: their δ is between the sides over 7×7
/// and over 3×3 pixels, and much of the step lies within the 3×3. Exact maps have almost none, however many surfaces meet there.
pub fn ramp_share(delta: &DisparityMap) -> f64 {
    let w = delta.width as usize;
    let ((lo, hi), (near_lo, near_hi)) = (extremes(&delta.delta, w, RADIUS), extremes(&delta.delta, w, 1));
    let between = |d: f32, lo: f32, hi: f32| (d - lo) > 0.1 * (hi - lo) && (d - lo) < 0.9 * (hi - lo);
    let (mut ramp, mut edge) = (0usize, 0usize);
    for (i, &d) in delta.delta.iter().enumerate() {
        let step = hi[i] - lo[i];
        if step > STRONG {
            edge += 1;
            let steep = near_hi[i] - near_lo[i] > STEEP * step;
            ramp += usize::from(steep && between(d, lo[i], hi[i]) && between(d, near_lo[i], near_hi[i]));
        }
    }
    if edge == 0 { 0.0 } else { ramp as f64 / edge as f64 }
}

/// [`ramp_share`] above which a map counts as blurred. True depth has at most 0.03 on seven Middlebury maps, and 0.3 or more once it is
/// enlarged from half the size or blurred by 3×3; maps of a large depth network have 0.27 to 0.4. `tmpi-lab bench --only ramps` shows
/// what snapping gains on either side of this value.
pub const BLURRED: f64 = 0.15;

/// Colour-weighted median over 5×5 pixels where δ has an edge, for pixels whose colour does not support their own side: the part of
/// [`snap`] that sharp maps need. It helps measured depth, and is nearly harmless on exact depth.
pub fn median(photo: &Photo, delta: &DisparityMap) -> DisparityMap {
    let level = Level::new();
    each(photo, delta, MEDIAN, |band, y, lo, hi, out| kernel::medians(level, band, KEPT, y, lo, hi, out))
}

/// Like [`median`], for all pixels where δ has an edge.
pub fn full_median(photo: &Photo, delta: &DisparityMap) -> DisparityMap {
    let level = Level::new();
    each(photo, delta, MEDIAN, |band, y, lo, hi, out| kernel::medians(level, band, NONE, y, lo, hi, out))
}

/// Runs `f` over each row with the extremes of δ within `radius` of its pixels. The output starts as a copy of the row.
fn each(photo: &Photo, delta: &DisparityMap, radius: usize, f: impl Fn(&Band, usize, &[f32], &[f32], &mut [f32]) + Sync) -> DisparityMap {
    let w = delta.width as usize;
    let (lo, hi) = extremes(&delta.delta, w, radius);
    let mut out = delta.delta.clone();
    out.par_chunks_mut(w * ROWS).enumerate().for_each_init(Band::default, |band, (i, rows)| {
        let first = i * ROWS;
        band.load(photo, delta, first..first + rows.len() / w);
        for (y, row) in (first..).zip(rows.chunks_mut(w)) {
            f(band, y, &lo[y * w..][..w], &hi[y * w..][..w], row);
        }
    });
    DisparityMap { width: delta.width, height: delta.height, delta: out }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step(ramp: f32) -> (Photo, DisparityMap) {
        let (w, h) = (48u32, 24u32);
        let photo = Photo::from_fn(w, h, |x, _| if x < 24 { [40, 60, 90] } else { [200, 150, 60] });
        (photo, DisparityMap::from_fn(w, h, |x, _| 0.2 + 0.6 * (x as f32 - 24.0 + 0.5 + ramp / 2.0).max(0.0).min(ramp) / ramp))
    }

    #[test]
    fn ramps_are_distinguished_from_steps() {
        assert!(ramp_share(&step(4.0).1) > BLURRED && ramp_share(&step(1e-3).1) < BLURRED);
        // three surfaces that meet within a window are no ramp
        let stairs = DisparityMap { width: 48, height: 24, delta: (0..48 * 24).map(|i| ((i % 48) / 2) as f32 / 24.0).collect() };
        assert!(ramp_share(&stairs) < 1e-9);
    }

    #[test]
    fn a_rim_of_mixed_colours_joins_the_near_side() {
        let (far, near) = ([40u8, 60, 90], [200u8, 150, 60]);
        for (share, joins) in [(0.2, false), (0.3, true)] {
            let (mut photo, sharp) = step(1e-3);
            let mixed: [u8; 3] = std::array::from_fn(|i| (f32::from(far[i]) + share * (f32::from(near[i]) - f32::from(far[i]))) as u8);
            photo.rgb.iter_mut().enumerate().filter(|(i, _)| i % 48 == 23).for_each(|(_, c)| *c = mixed);
            let joined = join_rims(&photo, &sharp, Rim::Photo);
            let edge = if joins { 23 } else { 24 };
            assert!(joined.delta.iter().enumerate().all(|(i, d)| (d - if i % 48 < edge { 0.2 } else { 0.8 }).abs() < 1e-6), "{share}");
            // without a mixed colour nothing joins
            assert_eq!(join_rims(&step(1e-3).0, &sharp, Rim::Photo), sharp);
        }
    }

    #[test]
    fn a_rim_with_some_of_the_near_chroma_joins_in_video() {
        let (mut photo, sharp) = step(1e-3);
        // half of the chroma, and the brightness of the far side
        photo.rgb.iter_mut().enumerate().filter(|(i, _)| i % 48 == 23).for_each(|(_, c)| *c = [75, 61, 29]);
        assert_eq!(join_rims(&photo, &sharp, Rim::Photo), sharp);
        let joined = join_rims(&photo, &sharp, Rim::Video);
        assert!(joined.delta.iter().enumerate().all(|(i, d)| (d - if i % 48 < 23 { 0.2 } else { 0.8 }).abs() < 1e-6));
    }

    /// A pixel's window, by definition.
    struct Window {
        own: ([f64; 3], f64),
        /// Column and row offsets, colour, δ.
        all: Vec<(i64, i64, [f64; 3], f64)>,
    }

    impl Window {
        fn new(photo: &Photo, map: &DisparityMap, (x, y): (i64, i64), radius: i64) -> Self {
            let at = |x: i64, y: i64| {
                (photo.at(x as u32, y as u32).map(f64::from), f64::from(map.delta[(y * i64::from(map.width) + x) as usize]))
            };
            let inside = |x: i64, y: i64| (0..i64::from(map.width)).contains(&x) && (0..i64::from(map.height)).contains(&y);
            let places = (-radius..=radius).flat_map(|dy| (-radius..=radius).map(move |dx| (dx, dy)));
            let all = places.filter(|(dx, dy)| inside(x + dx, y + dy)).map(|(dx, dy)| {
                let (colour, delta) = at(x + dx, y + dy);
                (dx, dy, colour, delta)
            });
            Self { own: at(x, y), all: all.collect() }
        }

        fn range(&self) -> (f64, f64) {
            self.all.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |r, w| (r.0.min(w.3), r.1.max(w.3)))
        }

        fn likeness(&self, colour: [f64; 3]) -> f64 {
            let d2: f64 = (0..3).map(|c| (colour[c] - self.own.0[c]).powi(2)).sum();
            (-d2 / (255.0 * 255.0 * 2.0 * f64::from(SIGMA_COLOUR).powi(2))).exp()
        }

        fn side(&self) -> f64 {
            let (lo, hi) = self.range();
            let t = (self.own.1 - lo) / (hi - lo);
            if hi - lo <= f64::from(RAMP) || t <= 0.1 || t >= 0.9 {
                return self.own.1;
            }
            let of = |is: &dyn Fn(f64) -> bool| {
                let weights = self.all.iter().filter(|w| is(w.3)).map(|w| {
                    let r2 = (w.0 * w.0 + w.1 * w.1) as f64;
                    (self.likeness(w.2) * (-r2 / (2.0 * f64::from(SIGMA_PLACE).powi(2))).exp() + 1e-20, w.3)
                });
                weights.fold((0.0, 0.0, 0.0), |s, (w, d)| (s.0 + w, s.1 + w * d, s.2 + 1.0))
            };
            let low = of(&|d| d <= lo + 0.2 * (hi - lo));
            let high = of(&|d| d >= lo + 0.8 * (hi - lo));
            let side = if (low.0 / low.2).ln() + f64::from(OWN) * (1.0 - 2.0 * t) > (high.0 / high.2).ln() { low } else { high };
            side.1 / side.0
        }

        fn median(&self, kept: f32) -> f64 {
            let (lo, hi) = self.range();
            if hi - lo <= f64::from(EDGE) {
                return self.own.1;
            }
            let mut values: Vec<(f64, f64)> = self.all.iter().map(|w| (w.3, self.likeness(w.2) + 1e-6)).collect();
            let own: f64 = values.iter().filter(|v| (v.0 - self.own.1).abs() <= f64::from(SIDE) * (hi - lo)).map(|v| v.1).sum();
            if own > f64::from(kept) * values.iter().map(|v| v.1).sum::<f64>() {
                return self.own.1;
            }
            values.sort_by(|a, b| a.0.total_cmp(&b.0));
            let (total, mut sum) = (values.iter().map(|v| v.1).sum::<f64>(), 0.0);
            let reached = values.iter().find(|v| {
                sum += v.1;
                sum >= 0.5 * total
            });
            reached.unwrap().0
        }

        fn join(&self) -> f64 {
            let (lo, hi) = self.range();
            let (far_to, near_from) = (lo + 0.2 * (hi - lo), lo + 0.8 * (hi - lo));
            let touches = self.all.iter().any(|w| w.0.abs().max(w.1.abs()) <= 1 && w.3 >= near_from);
            if hi - lo <= f64::from(RAMP) || self.own.1 > far_to || !touches {
                return self.own.1;
            }
            let near: Vec<_> = self.all.iter().filter(|w| w.3 >= near_from).collect();
            let far: Vec<_> = self.all.iter().filter(|w| w.3 <= far_to && w.0.abs().max(w.1.abs()) > 1).collect();
            if far.is_empty() {
                return self.own.1;
            }
            let mean = |of: &[&(i64, i64, [f64; 3], f64)], c: usize| of.iter().map(|w| w.2[c]).sum::<f64>() / of.len() as f64;
            let both = (0..3).map(|c| (self.own.0[c], mean(&near, c), mean(&far, c)));
            let (dot, norm) = both.fold((0.0, 0.0), |s, (o, f, b)| (s.0 + (o - b) * (f - b), s.1 + (f - b) * (f - b)));
            let joins = norm > 144.0 && dot > 0.25 * norm;
            if joins { near.iter().map(|w| w.3).sum::<f64>() / near.len() as f64 } else { self.own.1 }
        }
    }

    #[test]
    fn every_step_agrees_with_its_definition_in_f64() {
        let (w, h) = (61u32, 43u32);
        // sides of different colours, with noise, and a ramp between them
        let noise = |i: u32, seed: u32| f64::from(i.wrapping_add(seed * 7919).wrapping_mul(2_654_435_761) >> 16) / 65_536.0;
        let near = |i: u32| 8.0 * (f64::from(i / w) / 9.0).sin() + 30.0 - f64::from(i % w);
        let photo = Photo {
            width: w,
            height: h,
            rgb: (0..w * h)
                .map(|i| [1, 2, 3].map(|c| ((if near(i) > 0.0 { 150.0 } else { 70.0 }) + 60.0 * (noise(i, c) - 0.5)) as u8))
                .collect(),
        };
        let ramp = |i: u32, rough: f64| (0.2 + 0.6 * (near(i) / 5.0 + 0.5).clamp(0.0, 1.0) + rough * (noise(i, 9) - 0.5)) as f32;
        for rough in [0.0, 0.02, 0.4] {
            let map = DisparityMap { width: w, height: h, delta: (0..w * h).map(|i| ramp(i, rough)).collect() };
            let (level, tables) = (Level::new(), Tables::new());
            let sides = each(&photo, &map, RADIUS, |band, y, lo, hi, out| kernel::sides(level, band, &tables, y, lo, hi, out));
            let (medians, full) = (median(&photo, &map), full_median(&photo, &map));
            let joins = each(&photo, &map, RADIUS, |band, y, lo, hi, out| kernel::joins(band, &tables, Rim::Photo, y, lo, hi, out));
            let compare = |name: &str, got: &DisparityMap, radius: i64, want: &dyn Fn(&Window) -> f64| {
                let off = (0..i64::from(w * h)).filter(|&i| {
                    let window = Window::new(&photo, &map, (i % i64::from(w), i / i64::from(w)), radius);
                    (f64::from(got.delta[i as usize]) - want(&window)).abs() > 1e-5
                });
                let off = off.count();
                let moved = got.delta.iter().zip(&map.delta).filter(|(a, b)| (**a - **b).abs() > 1e-3).count();
                // if a test is almost even, rounding may decide it
                assert!(off <= 4, "{name} at {rough}: {off} off");
                moved
            };
            let careful = compare("median", &medians, 2, &|w| w.median(KEPT));
            let all = compare("full median", &full, 2, &|w| w.median(NONE));
            assert!(careful <= all, "{careful} {all}");
            let moved = compare("side", &sides, 3, &Window::side) + careful;
            assert!(moved + compare("join", &joins, 3, &Window::join) > 100, "{rough}: {moved}");
        }
    }
}
