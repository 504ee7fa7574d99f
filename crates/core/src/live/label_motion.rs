//! Motion compensation of labels, in frames without new tiles.
//!
//! A room sends tiles about every third frame. In between, a moving object would leave its labels behind, and a side view would show its
//! leading edge at the depth of the background, torn off the rest. A viewer therefore estimates where the object went, also around the
//! position predicted from its last motion, and moves its labels along, into neighbouring tiles as well. `tmpi-lab tears` measures the
//! benefit. This needs no data from the server and leaves no trace: received labels are shown as they are.

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
mod tests;
