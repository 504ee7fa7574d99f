//! Motion compensation of labels, in frames without new tiles.
//!
//! A room sends tiles about every third frame. In between, a moving object would leave its labels behind, and a side view would show its
//! leading edge at the depth of the background, torn off the rest. A viewer therefore estimates where the object went, also around the
//! position predicted from its last motion, and moves its labels along, into neighbouring tiles as well. `tmpi-lab live-bench --only
//! measured --late N` measures the benefit. This needs no data from the server and leaves no trace: received labels are shown as they are.

use std::time::Duration;

use super::MAX_PLANES;
use crate::layers::{Dilation, Surface, dilate};
use crate::scene::packed_rgb::difference;
use crate::simd::dispatch;
use crate::{Geometry, Plane, Rect, Tile, TileFrame, grown};

/// Search range for the motion of an object, in pixels to each side.
const REACH: i32 = 12;
/// Range of the dense search around no motion and around each predicted motion. The rest of the range is searched at every second pixel.
const DENSE_REACH: i32 = 3;
/// Maximum predicted motion along each axis, in pixels.
const MAX_PREDICTED: i32 = 48;
/// Difference in levels, summed over the channels, above which a pixel has changed; more than the noise of video.
const COLOUR_STEP: u32 = 30;
/// Cap on the difference of one pixel, because covered and uncovered pixels have no counterpart.
const MAX_DIFFERENCE: u32 = 120;
/// Difference in δ from which one object lies in front of another.
const DEPTH_STEP: f32 = 0.05;
/// Maximum number of an object's pixels that vote on its motion.
const VOTERS: usize = 300;
/// Maximum number of voters in the first pass, over all candidate motions.
const FIRST_VOTERS: usize = 60;
/// Number of voters counted between two checks for an early exit.
const VOTERS_AT_ONCE: usize = 12;
/// Minimum number of changed pixels of an object; with fewer, it stays where it is.
const MIN_CHANGED: usize = 12;
/// A motion is accepted only if it reduces the difference to less than this share.
const MAX_REMAINING: f64 = 0.7;
/// Minimum number of pixels on none of their tile's planes for which the tile gets a new plane; fewer are as often noise of depth.
const MIN_UNPLACED: usize = 40;

/// Motion of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MotionVector {
    /// Pixels to the right and down.
    x: i32,
    y: i32,
    /// Duration of the motion.
    time: Duration,
}

impl MotionVector {
    /// The motion scaled to another duration: pixels to the right and down.
    fn within(&self, time: Duration) -> (i32, i32) {
        let share = if self.time.is_zero() { 1.0 } else { time.as_secs_f64() / self.time.as_secs_f64() };
        let far = |pixels: i32| (f64::from(pixels) * share).round().clamp(f64::from(-MAX_PREDICTED), f64::from(MAX_PREDICTED)) as i32;
        (far(self.x), far(self.y))
    }
}

/// Two frames; the tiles belong to the first.
pub struct MotionSearch<'a> {
    geometry: &'a Geometry,
    /// Time from the first frame to the second.
    time: Duration,
    /// δ of the visible surface at each pixel.
    delta: &'a [f32],
    /// Colours of the first and the second frame, as words.
    was: &'a [u32],
    now: &'a [u32],
    /// 1 where a pixel has changed, otherwise 0.
    changed: Vec<u8>,
    /// `changed`, dilated by one pixel.
    near_change: Dilation,
}

impl<'a> MotionSearch<'a> {
    /// Compares two frames that are `time` apart. Both frames, and the visible `surface`, have the size of the geometry's grid.
    pub fn new(geometry: &'a Geometry, surface: &'a Surface, (was, now): (&'a [u32], &'a [u32]), time: Duration) -> Self {
        let mut changed = vec![0; now.len()];
        mark_changed(was, now, &mut changed);
        let (width, height) = (geometry.grid.width, geometry.grid.height);
        let mut near_change = Dilation::default();
        dilate(&changed, width, Rect { x: 0, y: 0, w: width, h: height }, (1, 1), &mut near_change);
        Self { geometry, time, delta: surface.all(), was, now, changed, near_change }
    }

    /// Motion of the nearer objects of a tile; `None` if they did not move. Also searches around the positions predicted from the motions
    /// `before` of this tile and its neighbours.
    pub fn vector(&self, index: u32, before: &[Option<MotionVector>]) -> Option<MotionVector> {
        let grid = &self.geometry.grid;
        let (columns, rows) = (grid.columns(), grid.rows());
        let around = |at: u32, most: u32| at.saturating_sub(1)..=(at + 1).min(most - 1);
        let mut guesses = Vec::new();
        for row in around(index / columns, rows) {
            for vector in around(index % columns, columns).filter_map(|column| before.get((row * columns + column) as usize)?.as_ref()) {
                let guess = vector.within(self.time);
                // adjacent positions are within its search range
                if guesses.iter().all(|g: &(i32, i32)| (g.0 - guess.0).abs().max((g.1 - guess.1).abs()) > 1) {
                    guesses.push(guess);
                }
            }
        }
        let reach = |of: fn(&(i32, i32)) -> i32| guesses.iter().map(|g| of(g).abs() + DENSE_REACH).fold(REACH, i32::max) as u32;
        let part = grown(grid.rect(index), reach(|g| g.0), reach(|g| g.1), grid);
        self.search(part, &guesses).map(|(x, y)| MotionVector { x, y, time: self.time })
    }

    /// The tile in the second frame, from the motion of its nearer objects; `None` if it does not change. If something enters from a
    /// neighbouring tile and lies on none of this tile's planes, the tile gets a fronto-parallel plane for it.
    pub fn moved(&self, index: u32, MotionVector { x: dx, y: dy, .. }: MotionVector) -> Option<Tile> {
        let (grid, tile) = (&self.geometry.grid, self.geometry.tiles.get(index as usize)?);
        let rect = grid.rect(index);
        let place = TileFrame::of(grid, index);
        let mut moved = tile.clone();
        // pixels that match no plane, and the δ that moves there: nearer and farther than what the tile shows there
        let mut unplaced = [Vec::new(), Vec::new()];
        let pixels = (rect.y..rect.y + rect.h).flat_map(|y| (rect.x..rect.x + rect.w).map(move |x| (x, y)));
        for (i, (x, y)) in pixels.enumerate() {
            let here = (y * grid.width + x) as usize;
            if self.near_change.out[here] == 0 {
                continue;
            }
            // what enters from outside the frame continues the frame's border
            let side = |at: u32, d: i32, most: u32| (at as i32 - d).clamp(0, most as i32 - 1) as u32;
            let from = (side(y, dy, grid.height) * grid.width + side(x, dx, grid.width)) as usize;
            let (shown, comes) = (self.delta[here], self.delta[from]);
            if (comes - shown).abs() <= DEPTH_STEP {
                continue;
            }
            let off = |l: usize| (place.disparity(&tile.planes[l], x, y) - comes).abs();
            let best = (0..tile.planes.len()).min_by(|a, b| off(*a).total_cmp(&off(*b))).unwrap_or_default();
            if off(best) < 0.5 * (comes - shown).abs() {
                moved.labels[i] = best as u8;
            } else {
                unplaced[usize::from(comes < shown)].push((i, comes));
            }
        }
        for unplaced in unplaced.iter().filter(|h| h.len() >= MIN_UNPLACED) {
            add_plane(&mut moved, unplaced);
        }
        (moved != *tile).then_some(moved)
    }

    /// Index of a pixel in the frames; `None` outside.
    fn at(&self, x: i32, y: i32) -> Option<usize> {
        let (w, h) = (self.geometry.grid.width as i32, self.geometry.grid.height as i32);
        ((0..w).contains(&x) && (0..h).contains(&y)).then_some((y * w + x) as usize)
    }

    /// Motion of the nearer objects in a part of the frame, in pixels to the right and down. `None` if they did not move or were not found.
    fn search(&self, part: Rect, guesses: &[(i32, i32)]) -> Option<(i32, i32)> {
        let width = self.geometry.grid.width;
        let mut changed = Vec::new();
        for y in part.y..part.y + part.h {
            let from = (y * width + part.x) as usize;
            let row = &self.changed[from..from + part.w as usize];
            if row.iter().fold(0, |any, c| any | c) == 0 {
                continue;
            }
            let row = (part.x..).zip(row).filter(|(_, c)| **c != 0);
            changed.extend(row.map(|(x, _)| (x as i32, y as i32, self.delta[(y * width + x) as usize])));
        }
        let far = changed.iter().map(|p| p.2).fold(f32::INFINITY, f32::min);
        changed.retain(|p| p.2 > far + DEPTH_STEP);
        if changed.len() < MIN_CHANGED {
            return None;
        }
        let some = |most: usize| changed.iter().step_by(changed.len().div_ceil(most)).copied().collect::<Vec<_>>();
        // prefers the shorter of equally good motions; stops counting once the cost reaches `enough`
        let cost = |voters: &[(i32, i32, f32)], (dx, dy): (i32, i32), enough: u32| -> u32 {
            let left = |&(x, y, _): &(i32, i32, f32)| {
                let to = self.at(x + dx, y + dy);
                to.map_or(MAX_DIFFERENCE, |to| {
                    difference(self.was[y as usize * width as usize + x as usize], self.now[to]).min(MAX_DIFFERENCE)
                })
            };
            let mut sum = (dx * dx + dy * dy) as u32;
            for some in voters.chunks(VOTERS_AT_ONCE) {
                sum += some.iter().map(left).sum::<u32>();
                if sum >= enough {
                    break;
                }
            }
            sum
        };
        let square = |(x, y): (i32, i32), reach: i32, step: usize| {
            let side = move || (-reach..=reach).step_by(step);
            side().flat_map(move |dy| side().map(move |dx| (x + dx, y + dy)))
        };
        let least = |voters: &[(i32, i32, f32)], motion_vectors: &mut dyn Iterator<Item = (i32, i32)>| {
            let (mut best, mut best_cost) = ((0, 0), u32::MAX);
            for vector in motion_vectors {
                let vector_cost = cost(voters, vector, best_cost);
                if vector_cost < best_cost {
                    (best, best_cost) = (vector, vector_cost);
                }
            }
            best
        };
        let guessed = guesses.iter().flat_map(|guess| square(*guess, DENSE_REACH, 1));
        let about = least(&some(FIRST_VOTERS), &mut guessed.chain(square((0, 0), REACH, 2)).chain(square((0, 0), DENSE_REACH, 1)));
        let voters = some(VOTERS);
        let vector = least(&voters, &mut square(about, 1, 1));
        (vector != (0, 0) && f64::from(cost(&voters, vector, u32::MAX)) < MAX_REMAINING * f64::from(cost(&voters, (0, 0), u32::MAX)))
            .then_some(vector)
    }
}

/// Adds a plane to a tile for some pixels, at the mean of their δ.
fn add_plane(tile: &mut Tile, unplaced: &[(usize, f32)]) {
    if tile.planes.len() >= MAX_PLANES {
        return;
    }
    let mean = unplaced.iter().map(|(_, delta)| f64::from(*delta)).sum::<f64>() / unplaced.len() as f64;
    let plane = Plane::fronto_parallel(mean).quantised();
    // planes are sorted from far to near
    let at = tile.planes.iter().take_while(|p| p.a <= plane.a).count();
    tile.planes.insert(at, plane);
    tile.labels.iter_mut().filter(|label| usize::from(**label) >= at).for_each(|label| *label += 1);
    for (i, _) in unplaced {
        tile.labels[*i] = at as u8;
    }
}

dispatch!(
    /// Marks with 1 the pixels that differ by more than [`COLOUR_STEP`], and with 0 the others.
    mark_changed, mark_changed_body, (was: &[u32], now: &[u32], changed: &mut [u8])
);

#[inline(always)]
fn mark_changed_body(was: &[u32], now: &[u32], changed: &mut [u8]) {
    for (changed, (was, now)) in changed.iter_mut().zip(was.iter().zip(now)) {
        *changed = u8::from(difference(*was, *now) > COLOUR_STEP);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::live::{FrameTiming, Layers};
    use crate::scene::packed_rgb::of_word;
    use crate::{Grid, Intrinsics, Photo, ViewBox};

    const W: u32 = 96;
    const H: u32 = 64;

    /// A wall, and in front of it an object of 24 × 30 pixels with its corner at `(x, y)`; labels match.
    fn frame(x: u32, y: u32) -> (Geometry, Vec<u32>) {
        frame_on([0.2, 0.7], (x, y))
    }

    /// The same on planes of these disparities.
    fn frame_on(deltas: [f64; 2], (x, y): (u32, u32)) -> (Geometry, Vec<u32>) {
        let inside = |i: u32| (x..x + 24).contains(&(i % W)) && (y..y + 30).contains(&(i / W));
        let wave = |a: u32, b: u32| (127.0 + 100.0 * (f64::from(a) / 3.0).sin() * (f64::from(b) / 4.0).cos()) as u8;
        let rgb = |i| if inside(i) { [200, wave(i % W - x, i / W - y), 40, 0] } else { [20, 40, wave(i % W, i / W) / 2, 0] };
        let colours = (0..W * H).map(|i| u32::from_le_bytes(rgb(i))).collect();
        let grid = Grid::new(W, H, 64);
        let planes = deltas.map(Plane::fronto_parallel).to_vec();
        let of = |t: u32| {
            let r = grid.rect(t);
            let labels = (0..r.area() as u32).map(|i| inside((r.y + i / r.w) * W + r.x + i % r.w).into()).collect();
            Tile { planes: planes.clone(), labels, background: None }
        };
        let tiles = (0..grid.tiles()).map(of).collect();
        (Geometry { grid, intrinsics: Intrinsics::centred(W, H, 50.0), view_box: ViewBox::cube(0.03), tiles, matte_band: 0 }, colours)
    }

    #[test]
    fn labels_follow_an_object() {
        let moves = [(40, 16), (41, 16), (45, 16), (36, 19), (48, 8), (40, 27), (28, 28)];
        for (deltas, to) in [[0.2, 0.7], [0.0, 1.0], [0.5, 0.56]].into_iter().flat_map(|d| moves.map(|to| (d, to))) {
            // adjacent to the border between two tiles
            let (geometry, was) = frame_on(deltas, (40, 16));
            let surface = geometry.surface();
            let (other, now) = frame_on(deltas, to);
            let motion = MotionSearch::new(&geometry, &surface, (&was, &now), Duration::ZERO);
            for (t, (tile, other)) in (0..).zip(geometry.tiles.iter().zip(&other.tiles)) {
                let moved = motion.vector(t, &[]).and_then(|vector| motion.moved(t, vector));
                let off = moved.as_ref().unwrap_or(tile).labels.iter().zip(&other.labels).filter(|(a, b)| a != b).count();
                assert_eq!(off, 0, "pixels of tile {t} at {deltas:?}, to {to:?}");
            }
        }
    }

    #[test]
    fn an_object_with_steady_motion_is_found_beyond_the_search_range() {
        let (geometry, was) = frame(10, 16);
        let surface = geometry.surface();
        let (thirtieth, tiles) = (Duration::from_micros(33_333), geometry.grid.tiles());
        let labels = |motion: &MotionSearch, before: &[Option<MotionVector>]| -> Vec<_> {
            (0..tiles)
                .map(|t| {
                    motion.vector(t, before).and_then(|vector| motion.moved(t, vector)).unwrap_or(geometry.tiles[t as usize].clone()).labels
                })
                .collect()
        };
        let first = frame(20, 18).1;
        let motion = MotionSearch::new(&geometry, &surface, (&was, &first), thirtieth);
        let motion_vectors: Vec<_> = (0..tiles).map(|t| motion.vector(t, &[])).collect();
        let (other, third) = frame(40, 22);
        let motion = MotionSearch::new(&geometry, &surface, (&was, &third), 3 * thirtieth);
        let expected: Vec<_> = other.tiles.into_iter().map(|t| t.labels).collect();
        assert!(labels(&motion, &[]) != expected, "not found without the previous motions");
        assert!(labels(&motion, &motion_vectors) == expected, "found with the previous motions");
    }

    #[test]
    fn a_tile_gets_a_plane_for_an_object_that_enters_it() {
        // into a tile that has only the wall
        let border = Grid::new(W, H, 64).rect(1).x;
        let (mut geometry, was) = frame(border - 25, 16);
        let (other, now) = frame(border - 14, 18);
        assert!(!geometry.tiles[1].labels.contains(&1) && other.tiles[1].labels.contains(&1));
        geometry.tiles[1].planes.truncate(1);
        let surface = geometry.surface();
        let motion = MotionSearch::new(&geometry, &surface, (&was, &now), Duration::ZERO);
        let moved = motion.vector(1, &[]).and_then(|vector| motion.moved(1, vector)).unwrap();
        assert_eq!(moved.labels, other.tiles[1].labels);
        let off = |i: usize| (moved.planes[i].a - other.tiles[1].planes[i].a).abs();
        assert!(moved.planes.len() == 2 && off(0) < 1e-3 && off(1) < 1e-3, "{:?}", moved.planes);
        // and what the object uncovers, in a tile that has only the object's plane
        let mut tile = geometry.tiles[0].clone();
        tile.planes.remove(0);
        tile.labels.fill(0);
        add_plane(&mut tile, &[(3, 0.2), (4, 0.21)]);
        assert!(tile.planes[0].a < tile.planes[1].a && (tile.planes[0].a - 0.205).abs() < 1e-3, "{:?}", tile.planes);
        assert_eq!(tile.labels[..6], [1, 1, 1, 0, 0, 1]);
        tile.planes = vec![tile.planes[0]; MAX_PLANES];
        let full = tile.clone();
        add_plane(&mut tile, &[(3, 0.7)]);
        assert!(tile == full, "no more than MAX_PLANES");
    }

    #[test]
    fn labels_of_late_tiles_catch_up_with_an_object() {
        let photo = |colours: &[u32]| Photo { width: W, height: H, rgb: colours.iter().map(|c| of_word(*c)).collect() };
        let frames: Vec<_> = [40, 44, 48, 52].map(|x| frame(x, 16)).into();
        let time = Some(Duration::from_millis(33));
        let labels = |geometry: &Geometry| geometry.tiles.iter().map(|t| t.labels.clone()).collect::<Vec<_>>();
        for (late, of) in [(0, 3), (1, 2), (2, 1), (3, 0)] {
            let mut layers = Layers::with_memory();
            for (n, (_, colours)) in (0u64..).zip(&frames) {
                let last = n == 3;
                let when = FrameTiming { frame: n, tiles: last.then(|| n - late), elapsed: time };
                let geometry = if last { &frames[of].0 } else { &frames[0].0 };
                layers.update(geometry, |_| last, photo(colours), when);
            }
            let shown = layers.moved_geometry().unwrap_or(&frames[of].0);
            assert!(labels(shown) == labels(&frames[3].0), "tiles of {late} frames before");
        }
    }

    #[test]
    fn labels_stay_without_a_recognisable_motion() {
        let (geometry, was) = frame(30, 16);
        let surface = geometry.surface();
        let of = |now: &[u32]| {
            let motion = MotionSearch::new(&geometry, &surface, (&was, now), Duration::ZERO);
            (0..geometry.grid.tiles()).filter_map(|t| motion.moved(t, motion.vector(t, &[])?)).count()
        };
        assert_eq!(of(&was), 0);
        // noise, a change of light, and an unrelated picture
        let each = |f: &dyn Fn(usize, [u8; 3]) -> [u8; 3]| -> Vec<u32> {
            let other = |(i, word): (usize, &u32)| f(i, of_word(*word));
            was.iter().enumerate().map(other).map(|[r, g, b]| u32::from_le_bytes([r, g, b, 0])).collect()
        };
        assert_eq!(of(&each(&|i, p| p.map(|v| v.saturating_add((i * 7 % 8) as u8)))), 0);
        assert_eq!(of(&each(&|_, p| p.map(|v| v / 2))), 0);
        assert_eq!(of(&each(&|i, _| [(i * 31 % 251) as u8, (i * 17 % 241) as u8, (i * 13 % 239) as u8])), 0);
    }
}
