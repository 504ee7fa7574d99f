//! Motion compensation of labels, in frames without new tiles.
//!
//! A room sends tiles about every third frame. In between, a moving object would leave its labels behind, and a side view would show its
//! leading edge at the depth of the background, torn off the rest. A viewer therefore estimates where the object went, also around the
//! position predicted from its last motion, and moves its labels along, into neighbouring tiles as well. `tmpi-lab live-bench --only
//! measured --late N` measures the benefit. This needs no data from the server and leaves no trace: received labels are shown as they are.

use std::time::Duration;

use super::moved_tile::Labels;
use crate::layers::{Dilation, Surface, dilate};
use crate::scene::packed_rgb::difference;
use crate::simd::dispatch;
use crate::{Geometry, Rect, Tile, grown};

/// Search range for the motion of an object, in pixels to each side.
const REACH: i32 = 12;
/// Range of the dense search around no motion and around each predicted motion. The rest of the range is searched at every second pixel.
const DENSE_REACH: i32 = 3;
/// Range and step of the search around a group's common motion.
const WIDE_REACH: (i32, usize) = (24, 3);
/// Maximum predicted motion along each axis, in pixels.
const MAX_PREDICTED: i32 = 96;
/// Difference in levels, summed over the channels, above which a pixel has changed; more than the noise of video.
const COLOUR_STEP: u32 = 30;
/// Cap on the difference of one pixel, because covered and uncovered pixels have no counterpart.
const MAX_DIFFERENCE: u32 = 120;
/// Difference in δ from which one object lies in front of another.
pub(super) const DEPTH_STEP: f32 = 0.05;
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

/// Number of a group's motions that are tried as its common one, the most frequent first.
const TRIED: usize = 16;
/// Maximum number of a group's pixels that vote on its common motion.
const GROUP_VOTERS: usize = 1500;
/// A tile takes the motion of its group if that leaves at most this many times the difference that its own leaves.
const AGREE: f64 = 2.0;

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

/// A changed pixel of an object.
#[derive(Clone, Copy, Debug)]
struct Voter {
    x: i32,
    y: i32,
    delta: f32,
}

/// Motion of the nearer objects of a tile.
#[derive(Default)]
struct TileMotion {
    /// Pixels that vote on it: a few, and more. Empty if too few have changed.
    first: Vec<Voter>,
    voters: Vec<Voter>,
    /// Pixels to the right and down; `None` if they did not move or were not found.
    vector: Option<(i32, i32)>,
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

    /// Motion of the nearer objects of each tile; `None` where they did not move. Also searches around the positions predicted from the
    /// motions `before`. Adjacent tiles with moving objects agree on one motion where it explains their pixels about as well as their own,
    /// because an object is torn where its tiles move apart.
    pub fn vectors(&self, before: &[Option<MotionVector>]) -> Vec<Option<MotionVector>> {
        let mut found: Vec<TileMotion> = (0..self.geometry.grid.tiles()).map(|t| self.of_tile(t, before)).collect();
        self.agree(&mut found);
        let vector = |(x, y): (i32, i32)| MotionVector { x, y, time: self.time };
        found.into_iter().map(|tile| tile.vector.map(vector)).collect()
    }

    /// Tiles around a tile, and the tile itself.
    fn around(&self, index: u32) -> impl Iterator<Item = usize> + use<> {
        let (columns, rows) = (self.geometry.grid.columns(), self.geometry.grid.rows());
        let side = |at: u32, most: u32| at.saturating_sub(1)..(at + 2).min(most);
        let across = side(index % columns, columns);
        side(index / columns, rows).flat_map(move |row| across.clone().map(move |column| (row * columns + column) as usize))
    }

    /// Gives the tiles of each group the motion that explains the whole group best, unless their own explains them much better.
    fn agree(&self, found: &mut [TileMotion]) {
        for group in self.groups(found) {
            let voters: Vec<Voter> = group.iter().flat_map(|t| &found[*t].first).copied().collect();
            let voters: Vec<Voter> = voters.iter().step_by(voters.len().div_ceil(GROUP_VOTERS).max(1)).copied().collect();
            let cost_of = |vector: &(i32, i32)| self.cost(&voters, *vector, u32::MAX);
            let Some(common) = commonest(group.iter().filter_map(|t| found[*t].vector)).into_iter().min_by_key(cost_of) else { continue };
            // an object that speeds up or turns is not where its tiles were searched
            let common = square(common, WIDE_REACH.0, WIDE_REACH.1).min_by_key(cost_of).unwrap_or(common);
            let common = square(common, DENSE_REACH, 1).min_by_key(cost_of).unwrap_or(common);
            for t in group {
                let tile = &mut found[t];
                let own = f64::from(self.cost(&tile.voters, tile.vector.unwrap_or_default(), u32::MAX));
                if f64::from(self.cost(&tile.voters, common, u32::MAX)) <= AGREE * own {
                    tile.vector = Some(common);
                }
            }
        }
    }

    /// Groups of adjacent tiles in which objects change.
    fn groups(&self, found: &[TileMotion]) -> Vec<Vec<usize>> {
        let mut grouped: Vec<bool> = found.iter().map(|tile| tile.voters.is_empty()).collect();
        let mut groups = Vec::new();
        for first in 0..found.len() {
            if std::mem::replace(&mut grouped[first], true) {
                continue;
            }
            let (mut group, mut done) = (vec![first], 0);
            while let Some(&tile) = group.get(done) {
                group.extend(self.around(tile as u32).filter(|other| !std::mem::replace(&mut grouped[*other], true)));
                done += 1;
            }
            groups.push(group);
        }
        groups
    }

    /// Motion of the nearer objects of a tile.
    fn of_tile(&self, index: u32, before: &[Option<MotionVector>]) -> TileMotion {
        let grid = &self.geometry.grid;
        let mut guesses = Vec::new();
        for vector in self.around(index).filter_map(|t| before.get(t)?.as_ref()) {
            let guess = vector.within(self.time);
            // adjacent positions are within its search range
            if guesses.iter().all(|g: &(i32, i32)| (g.0 - guess.0).abs().max((g.1 - guess.1).abs()) > 1) {
                guesses.push(guess);
            }
        }
        let reach = |of: fn(&(i32, i32)) -> i32| guesses.iter().map(|g| of(g).abs() + DENSE_REACH).fold(REACH, i32::max) as u32;
        let part = grown(grid.rect(index), reach(|g| g.0), reach(|g| g.1), grid);
        self.search(part, &guesses)
    }

    /// The tile in the second frame, from the motion of its nearer objects; `None` if it does not change. If something enters that lies on
    /// none of this tile's planes, the tile gets the plane that it comes from.
    pub fn moved(&self, index: u32, vector: MotionVector) -> Option<Tile> {
        let Self { geometry, delta, now, .. } = *self;
        Labels { geometry, delta, now, near_change: &self.near_change.out }.moved(index, (vector.x, vector.y))
    }

    /// Index of a pixel in the frames; `None` outside.
    fn at(&self, x: i32, y: i32) -> Option<usize> {
        let (w, h) = (self.geometry.grid.width as i32, self.geometry.grid.height as i32);
        ((0..w).contains(&x) && (0..h).contains(&y)).then_some((y * w + x) as usize)
    }

    /// Motion of the nearer objects in a part of the frame.
    fn search(&self, part: Rect, guesses: &[(i32, i32)]) -> TileMotion {
        let width = self.geometry.grid.width;
        let mut changed = Vec::new();
        for y in part.y..part.y + part.h {
            let from = (y * width + part.x) as usize;
            let row = &self.changed[from..from + part.w as usize];
            if row.iter().fold(0, |any, c| any | c) == 0 {
                continue;
            }
            let row = (part.x..).zip(row).filter(|(_, c)| **c != 0);
            changed.extend(row.map(|(x, _)| Voter { x: x as i32, y: y as i32, delta: self.delta[(y * width + x) as usize] }));
        }
        let far = changed.iter().map(|p| p.delta).fold(f32::INFINITY, f32::min);
        changed.retain(|p| p.delta > far + DEPTH_STEP);
        if changed.len() < MIN_CHANGED {
            return TileMotion::default();
        }
        let some = |most: usize| changed.iter().step_by(changed.len().div_ceil(most)).copied().collect::<Vec<_>>();
        let least = |voters: &[Voter], motion_vectors: &mut dyn Iterator<Item = (i32, i32)>| {
            let (mut best, mut best_cost) = ((0, 0), u32::MAX);
            for vector in motion_vectors {
                let vector_cost = self.cost(voters, vector, best_cost);
                if vector_cost < best_cost {
                    (best, best_cost) = (vector, vector_cost);
                }
            }
            best
        };
        let guessed = guesses.iter().flat_map(|guess| square(*guess, DENSE_REACH, 1));
        let (first, voters) = (some(FIRST_VOTERS), some(VOTERS));
        let about = least(&first, &mut guessed.chain(square((0, 0), REACH, 2)).chain(square((0, 0), DENSE_REACH, 1)));
        let vector = least(&voters, &mut square(about, 1, 1));
        let moves = vector != (0, 0)
            && f64::from(self.cost(&voters, vector, u32::MAX)) < MAX_REMAINING * f64::from(self.cost(&voters, (0, 0), u32::MAX));
        TileMotion { first, voters, vector: moves.then_some(vector) }
    }

    /// How badly a motion explains the voters' pixels. Prefers the shorter of equally good motions; stops counting once the cost reaches
    /// `enough`.
    fn cost(&self, voters: &[Voter], (dx, dy): (i32, i32), enough: u32) -> u32 {
        let width = self.geometry.grid.width as usize;
        let left = |&Voter { x, y, .. }: &Voter| {
            let to = self.at(x + dx, y + dy);
            to.map_or(MAX_DIFFERENCE, |to| difference(self.was[y as usize * width + x as usize], self.now[to]).min(MAX_DIFFERENCE))
        };
        let mut sum = dx.unsigned_abs() + dy.unsigned_abs();
        for some in voters.chunks(VOTERS_AT_ONCE) {
            sum += some.iter().map(left).sum::<u32>();
            if sum >= enough {
                break;
            }
        }
        sum
    }
}

/// Motions around one, every `step`th along each axis.
fn square((x, y): (i32, i32), reach: i32, step: usize) -> impl Iterator<Item = (i32, i32)> {
    let side = move || (-reach..=reach).step_by(step);
    side().flat_map(move |dy| side().map(move |dx| (x + dx, y + dy)))
}

/// The most frequent motions.
fn commonest(motions: impl Iterator<Item = (i32, i32)>) -> Vec<(i32, i32)> {
    let mut counted: Vec<(usize, (i32, i32))> = Vec::new();
    for motion in motions {
        match counted.iter_mut().find(|(_, known)| *known == motion) {
            Some((count, _)) => *count += 1,
            None => counted.push((1, motion)),
        }
    }
    let mut most = Vec::new();
    // no sorting, whose code would be a large part of the page's decoder
    while most.len() < TRIED
        && let Some((i, _)) = counted.iter().enumerate().max_by_key(|(_, (count, _))| *count)
    {
        most.push(counted.swap_remove(i).1);
    }
    most
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
    use crate::{Grid, Intrinsics, Photo, Plane, ViewBox};

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
            let vectors = motion.vectors(&[]);
            for (t, (tile, other)) in (0..).zip(geometry.tiles.iter().zip(&other.tiles)) {
                let moved = vectors[t as usize].and_then(|vector| motion.moved(t, vector));
                let off = moved.as_ref().unwrap_or(tile).labels.iter().zip(&other.labels).filter(|(a, b)| a != b).count();
                assert_eq!(off, 0, "pixels of tile {t} at {deltas:?}, to {to:?}");
            }
        }
    }

    #[test]
    fn an_object_with_steady_motion_is_found_beyond_the_search_range() {
        let (geometry, was) = frame(10, 16);
        let surface = geometry.surface();
        let thirtieth = Duration::from_micros(33_333);
        let labels = |motion: &MotionSearch, before: &[Option<MotionVector>]| -> Vec<_> {
            let tile = |(t, vector): (u32, Option<MotionVector>)| {
                vector.and_then(|vector| motion.moved(t, vector)).unwrap_or(geometry.tiles[t as usize].clone()).labels
            };
            (0..).zip(motion.vectors(before)).map(tile).collect()
        };
        let first = frame(20, 18).1;
        let motion = MotionSearch::new(&geometry, &surface, (&was, &first), thirtieth);
        let motion_vectors = motion.vectors(&[]);
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
        let moved = motion.vectors(&[])[1].and_then(|vector| motion.moved(1, vector)).unwrap();
        assert_eq!(moved.labels, other.tiles[1].labels);
        let off = |i: usize| (moved.planes[i].a - other.tiles[1].planes[i].a).abs();
        assert!(moved.planes.len() == 2 && off(0) < 1e-3 && off(1) < 1e-3, "{:?}", moved.planes);
    }

    #[test]
    fn tiles_of_an_object_agree_on_its_motion_and_others_keep_theirs() {
        // textured above, plain below: the lower tiles see only vertical edges, which fit any motion up or down
        let (w, h) = (160, 160);
        let grid = Grid::new(w, h, 64);
        let frame = |x: u32, y: u32, other: u32| {
            let inside = move |u: u32, v: u32| (x..x + 40).contains(&u) && (y..y + 120).contains(&v);
            let second = move |u: u32, v: u32| (other..other + 20).contains(&u) && (16..40).contains(&v);
            let wave = |a: u32| (100.0 * (f64::from(a) / 3.0).sin()) as i32;
            let rgb = |i: u32| {
                let (u, v) = (i % w, i / w);
                match (inside(u, v), second(u, v)) {
                    (true, _) if v < y + 40 => [200, (128 + wave(u - x + 2 * (v - y))) as u8, 40, 0],
                    (true, _) => [200, 128, 40, 0],
                    (_, true) => [40, (128 + wave(u - other + v)) as u8, 220, 0],
                    _ => [20, 30, 50, 0],
                }
            };
            let tile = |t: u32| {
                let r = grid.rect(t);
                let near = |i: u32| inside(r.x + i % r.w, r.y + i / r.w) || second(r.x + i % r.w, r.y + i / r.w);
                let labels = (0..r.area() as u32).map(|i| near(i).into()).collect();
                Tile { planes: [0.2, 0.7].map(Plane::fronto_parallel).to_vec(), labels, background: None }
            };
            let tiles: Vec<Tile> = (0..grid.tiles()).map(tile).collect();
            let geometry =
                Geometry { grid, intrinsics: Intrinsics::centred(w, h, 80.0), view_box: ViewBox::cube(0.03), tiles, matte_band: 0 };
            (geometry, (0..w * h).map(|i| u32::from_le_bytes(rgb(i))).collect::<Vec<u32>>())
        };
        let ((geometry, was), (_, now)) = (frame(20, 20, 110), frame(28, 17, 104));
        let surface = geometry.surface();
        let vectors = MotionSearch::new(&geometry, &surface, (&was, &now), Duration::ZERO).vectors(&[]);
        let of = |x: u32, y: u32| {
            let at = (y / grid.stride).min(grid.rows() - 1) * grid.columns() + (x / grid.stride).min(grid.columns() - 1);
            vectors[at as usize].map(|v| (v.x, v.y))
        };
        assert_eq!([of(30, 30), of(30, 80), of(30, 130)], [Some((8, -3)); 3], "all of the object");
        assert_eq!(of(130, 20), Some((-6, 0)), "the other object");
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
            (0..).zip(motion.vectors(&[])).filter_map(|(t, vector)| motion.moved(t, vector?)).count()
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
