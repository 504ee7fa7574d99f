//! Widening. Depth networks often draw things a few pixels too small. The rim that they leave on the background stays behind as an outline
//! when the view moves. A plain background shows where the thing really ends: the rim's colours are foreign to it.

use std::ops::{Range, RangeInclusive};

use rayon::prelude::*;

use super::SIDE;
use super::extremes::{extreme, highest};
use tmpi_core::{DisparityMap, Photo};

/// How far an edge moves at most, in pixels.
const REACH: usize = 6;
/// Smallest step of δ at an edge that moves.
const STEP: f32 = 0.05;
/// Radius of the window whose colours count.
const WINDOW: usize = 9;
/// Distance between the rows, and between the columns, of the window that are looked at.
const STRIDE: usize = 2;
/// Most pixels of the window that are looked at.
const SAMPLES: usize = (2 * WINDOW + 1).div_ceil(STRIDE).pow(2);
/// Fewest pixels that tell the background's colours.
const FEWEST: u32 = 4;
/// Greatest distance, in levels, between two colours that are alike.
const FOREIGN: u32 = 8;
/// Square of that distance before a rough background, as a multiple of the variance of its colours.
const ROUGH: u32 = 4;
/// A side has a colour if more than one in this many of its pixels are like it.
const ONE_IN: u32 = 10;
/// Greatest distance, in levels, between the background's mean colour and that of a rim that sharpening has left.
const RIM: u32 = 64;
/// Greatest root mean square distance, in levels, of a plain background's colours from their mean.
const PLAIN: u32 = 32;
/// Fewest neighbours on the near side of a pixel that joins it, so that edges stay smooth.
const NEIGHBOURS: usize = 2;

/// Gives a pixel outside an edge to the near side if a plain background lies there, and the pixel's colour is foreign to it and either
/// like the near side's or close to the background's, as a sharpened rim is. An edge moves by at most [`REACH`] pixels, and no δ becomes
/// smaller. The map must not have ramps: run [`snap`](super::snap) first.
///
/// `tmpi-lab ghosts` shows what this gains.
pub fn widen(photo: &Photo, delta: &DisparityMap) -> DisparityMap {
    let (w, h) = (delta.width as usize, delta.height as usize);
    let mut edges = Edges { photo, given: &delta.delta, around: extreme(&delta.delta, w, REACH, highest), out: delta.delta.clone(), w, h };
    let mut front: Vec<usize> = {
        let beside = extreme(&delta.delta, w, 1, highest);
        (0..w * h).into_par_iter().filter(|&i| beside[i] - delta.delta[i] > STEP).collect()
    };
    for _ in 0..REACH {
        let joined: Vec<(usize, f32)> = front.par_iter().filter_map(|&i| Some((i, edges.joins(i)?))).collect();
        for &(i, near) in &joined {
            edges.out[i] = near;
        }
        front = joined.iter().flat_map(|&(i, _)| edges.window(i, 1, 1)).collect();
        front.sort_unstable();
        front.dedup();
    }
    DisparityMap { width: delta.width, height: delta.height, delta: edges.out }
}

struct Edges<'a> {
    photo: &'a Photo,
    /// δ as given.
    given: &'a [f32],
    /// The largest given δ within [`REACH`] of each pixel.
    around: Vec<f32>,
    /// δ so far.
    out: Vec<f32>,
    w: usize,
    h: usize,
}

impl Edges<'_> {
    /// Every `step`th pixel of a window, from its first row and column.
    fn window(&self, i: usize, radius: usize, step: usize) -> impl Iterator<Item = usize> + use<> {
        let reach = |at: usize, size: usize| -> Range<usize> { at.saturating_sub(radius)..(at + radius + 1).min(size) };
        let (w, columns, rows) = (self.w, reach(i % self.w, self.w), reach(i / self.w, self.h));
        rows.step_by(step).flat_map(move |y| columns.clone().step_by(step).map(move |x| y * w + x))
    }

    /// δ of the near side that a pixel joins, if it does.
    fn joins(&self, i: usize) -> Option<f32> {
        let own = self.given[i];
        let near = self.window(i, 1, 1).map(|j| self.out[j]).fold(own, highest);
        let step = near - own;
        if self.out[i] > own || step <= STEP {
            return None;
        }
        let near_from = own + (1.0 - SIDE) * step;
        let beside = self.window(i, 1, 1).map(|j| self.out[j]).filter(|&d| d >= near_from);
        let (sum, count) = beside.fold((0.0, 0), |(sum, count), d| (sum + d, count + 1));
        let joins = count >= NEIGHBOURS
            && self.off_background(i, own - SIDE * step..=own + SIDE * step).is_some_and(|off| self.is_like_near(i, near_from, off));
        joins.then(|| sum / count as f32)
    }

    /// Square of a colour's distance from the background around it, if it is foreign to it: to the pixels at the `depth` of the background,
    /// and with nothing nearer within [`REACH`].
    fn off_background(&self, i: usize, depth: RangeInclusive<f32>) -> Option<u32> {
        let is_background = |j: &usize| self.around[*j] <= *depth.end() && self.given[*j] >= *depth.start();
        let (mut background, mut count) = ([[0u8; 3]; SAMPLES], 0);
        for (to, j) in background.iter_mut().zip(self.window(i, WINDOW, STRIDE).filter(is_background)) {
            *to = self.photo.rgb[j];
            count += 1;
        }
        let (background, n) = (&background[..count], count as u32);
        let sums = background.iter().fold([0u32; 3], |sums, colour| [0, 1, 2].map(|c| sums[c] + u32::from(colour[c])));
        let squares: u32 = background.iter().flatten().map(|&c| u32::from(c).pow(2)).sum();
        // n² times the variance
        let spread = n * squares - sums.iter().map(|s| s * s).sum::<u32>();
        if n < FEWEST || spread > (n * PLAIN).pow(2) {
            return None;
        }
        // the colours of a rough background are farther from each other
        let alike_to = FOREIGN.pow(2).max(ROUGH * spread / n.pow(2));
        let own = self.photo.rgb[i];
        let alike = background.iter().filter(|colour| distance(own, **colour) <= alike_to).count() as u32;
        (alike * ONE_IN <= n).then(|| distance(own, sums.map(|s| (s / n) as u8)))
    }

    /// Whether a foreign colour is that of the near side as given (at most half as far from it as from the background), or that of a rim
    /// that sharpening has left. Any other colour may be another part of the background, such as sky between a tree and the ground. `off` is
    /// the square of the colour's distance from the background.
    fn is_like_near(&self, i: usize, near_from: f32, off: u32) -> bool {
        let own = self.photo.rgb[i];
        let near = self.window(i, WINDOW, STRIDE).filter(|&j| self.given[j] >= near_from);
        let (count, alike) =
            near.fold((0, 0), |(count, alike), j| (count + 1, alike + u32::from(4 * distance(own, self.photo.rgb[j]) <= off)));
        off <= RIM.pow(2) || alike * ONE_IN > count
    }
}

/// Square of the distance between two colours, in levels.
fn distance(a: [u8; 3], b: [u8; 3]) -> u32 {
    a.iter().zip(b).map(|(a, b)| u32::from(a.abs_diff(b)).pow(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_testing::pictures;

    const WIDTH: u32 = 80;
    const HEIGHT: u32 = 60;

    /// A disc of many colours, 20 px in radius, before a background of one colour with noise of up to `rough` levels to either side. δ
    /// takes it for `less` px smaller.
    fn disc(less: f32, rough: u8) -> (Photo, DisparityMap, Vec<f32>) {
        let out = |x: u32, y: u32| (x as f32 - 40.0).hypot(y as f32 - 30.0) - 20.0;
        let noise = |x: u32, y: u32, c: u32| pictures::noise(x, y + 100 * c) * f32::from(rough) * 2.0;
        let colour = |x: u32, y: u32| match (out(x, y) < 0.0, (x / 2 + y / 3) % 3) {
            (false, _) => [0, 1, 2].map(|c| 110 + noise(x, y, c) as u8),
            (true, 0) => [230, 40, 40],
            (true, 1) => [20, 20, 20],
            (true, _) => [240, 240, 230],
        };
        let map = |less: f32| DisparityMap::from_fn(WIDTH, HEIGHT, |x, y| if out(x, y) < -less { 0.8 } else { 0.2 });
        (Photo::from_fn(WIDTH, HEIGHT, colour), map(less), map(0.0).delta)
    }

    fn wrong(map: &DisparityMap, truth: &[f32]) -> usize {
        map.delta.iter().zip(truth).filter(|(a, b)| (*a - *b).abs() > 1e-3).count()
    }

    #[test]
    fn a_thing_that_is_too_small_grows_to_where_a_plain_background_begins() {
        for (less, rough) in [(1.5, 0), (3.0, 0), (4.0, 0), (3.0, 5)] {
            let (photo, map, truth) = disc(less, rough);
            let (before, after) = (wrong(&map, &truth), wrong(&widen(&photo, &map), &truth));
            assert!(before > 100 && after <= before / 10, "{less} px too small, {rough} levels: {before} wrong before, {after} after");
        }
    }

    #[test]
    fn an_edge_that_is_right_stays() {
        for rough in [0, 5, 10, 15, 20, 25, 30] {
            let (photo, map, _) = disc(0.0, rough);
            assert_eq!(wrong(&widen(&photo, &map), &map.delta), 0, "{rough} levels");
        }
    }

    #[test]
    fn an_edge_before_a_background_that_is_not_plain_stays() {
        let (photo, map, _) = disc(3.0, 60);
        assert_eq!(wrong(&widen(&photo, &map), &map.delta), 0);
    }

    #[test]
    fn a_thing_between_the_two_stays() {
        let (wall, between, near) = (0.1, 0.4, 0.8);
        for width in [1, 2, 4, 6] {
            let (photo, map) = (
                Photo::from_fn(WIDTH, HEIGHT, |x, _| if x < 30 { [20; 3] } else { [if x < 30 + width { 230 } else { 110 }; 3] }),
                DisparityMap::from_fn(WIDTH, HEIGHT, |x, _| {
                    if x < 30 {
                        near
                    } else if x < 30 + width {
                        between
                    } else {
                        wall
                    }
                }),
            );
            assert_eq!(wrong(&widen(&photo, &map), &map.delta), 0, "{width} px wide");
        }
    }

    #[test]
    fn another_part_of_the_background_stays() {
        // sky between a tree and the ground
        let photo = Photo::from_fn(WIDTH, HEIGHT, |x, y| match y {
            0..20 if x > 20 => [30, 60, 30],
            0..25 => [250, 245, 230],
            _ => [70, 130, 40],
        });
        let map = DisparityMap::from_fn(WIDTH, HEIGHT, |x, y| if y < 20 && x > 20 { 0.4 } else { 0.1 });
        assert_eq!(wrong(&widen(&photo, &map), &map.delta), 0);
    }

    #[test]
    fn colours_that_have_joined_do_not_make_others_join() {
        // the tree's edge fades into sky
        let sky = |share: f32| [30.0 + 220.0 * share, 60.0 + 185.0 * share, 30.0 + 200.0 * share].map(|c| c as u8);
        let photo = Photo::from_fn(WIDTH, HEIGHT, |_, y| match y {
            0..20 => sky(0.0),
            20..26 => sky(0.25 + 0.15 * (y - 20) as f32),
            _ => [250, 40, 200],
        });
        let map = |near: u32| DisparityMap::from_fn(WIDTH, HEIGHT, |_, y| if y < near { 0.8 } else { 0.2 });
        assert_eq!(wrong(&widen(&photo, &map(20)), &map(21).delta), 0);
    }

    #[test]
    fn an_edge_moves_as_far_as_its_reach() {
        // so thin that its colour is rare in the background's window
        let spike = |to: u32| move |x: u32, y: u32| x < if (30..32).contains(&y) { to } else { 30 };
        let (thing, reached) = (spike(50), spike(30 + REACH as u32));
        let photo = Photo::from_fn(WIDTH, HEIGHT, |x, y| [if thing(x, y) { 60 } else { 110 }; 3]);
        let map = DisparityMap::from_fn(WIDTH, HEIGHT, |x, _| if x < 30 { 0.8 } else { 0.2 });
        let truth = DisparityMap::from_fn(WIDTH, HEIGHT, |x, y| if reached(x, y) { 0.8 } else { 0.2 });
        let widened = widen(&photo, &map);
        assert_eq!(wrong(&widened, &truth.delta), 0);
        assert!(widened.delta.iter().zip(&map.delta).all(|(after, before)| after >= before));
    }

    #[test]
    fn a_rim_that_sharpening_has_left_joins() {
        for (brighter, joins) in [(4, false), (6, true), (36, true), (37, false)] {
            let rim = 110 + brighter;
            let photo = Photo::from_fn(WIDTH, HEIGHT, |x, _| {
                [match x {
                    0..30 => 20,
                    30..32 => rim,
                    _ => 110,
                }; 3]
            });
            let map = |near: u32| DisparityMap::from_fn(WIDTH, HEIGHT, |x, _| if x < near { 0.8 } else { 0.2 });
            assert_eq!(wrong(&widen(&photo, &map(30)), &map(if joins { 32 } else { 30 }).delta), 0, "{brighter} levels");
        }
    }

    #[test]
    fn what_is_behind_the_background_does_not_count() {
        let photo = Photo::from_fn(WIDTH, HEIGHT, |x, _| {
            [match x {
                0..30 => 20,
                30..36 => 110,
                _ => 250,
            }; 3]
        });
        let map = |near: u32| {
            DisparityMap::from_fn(WIDTH, HEIGHT, |x, _| {
                if x < near {
                    0.8
                } else if x < 36 {
                    0.5
                } else {
                    0.1
                }
            })
        };
        assert_eq!(wrong(&widen(&photo, &map(27)), &map(30).delta), 0);
    }

    #[test]
    fn a_pixel_that_touches_only_a_corner_stays() {
        let square = |x, y| x < 30 && y < 30;
        let photo = Photo::from_fn(WIDTH, HEIGHT, |x, y| [if square(x, y) || (x, y) == (30, 30) { 20 } else { 110 }; 3]);
        let map = DisparityMap::from_fn(WIDTH, HEIGHT, |x, y| if square(x, y) { 0.8 } else { 0.2 });
        assert_eq!(wrong(&widen(&photo, &map), &map.delta), 0);
    }

    #[test]
    fn maps_of_one_pixel_row_or_value_stay() {
        for (w, h) in [(1, 1), (1, 40), (40, 1), (5, 5)] {
            let photo = Photo::from_fn(w, h, |x, y| [(x * 90 + y * 40) as u8; 3]);
            let flat = DisparityMap::from_fn(w, h, |_, _| 0.5);
            assert_eq!(wrong(&widen(&photo, &flat), &flat.delta), 0);
            let steep = DisparityMap::from_fn(w, h, |x, y| ((x + y) % 2) as f32);
            assert_eq!(wrong(&widen(&photo, &steep), &steep.delta), 0);
        }
    }
}
