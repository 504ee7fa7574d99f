//! Labels that follow what moves, in the frames for which none came.
//!
//! A room sends tiles every third frame or so; in those between, a thing would have left its labels behind, and a view from beside would show its
//! foremost edge at the depth of what lies behind it, torn off the rest. A reader looks for where the thing went, also where it would be had it gone on as
//! it did, and moves its labels along, into tiles beside it as well. `tmpi-lab live-bench --only measured --late N` measures what that is worth.
//! Nothing is sent for it, and nothing stays of it: labels that come are shown as they are.

use std::time::Duration;

use super::MAX_PLANES;
use crate::layers::{Dilation, Surface, dilate};
use crate::scene::packed_rgb::apart;
use crate::simd::dispatch;
use crate::{Geometry, Plane, Rect, Tile, TileFrame, grown};

/// Pixels that a thing is looked for at, to each side.
const REACH: i32 = 12;
/// The same around where it would be had it gone on as it did before.
const NEAR: i32 = 3;
/// Pixels that it is looked for at there, at most.
const FARTHEST: i32 = 48;
/// Levels, summed over the channels, by which a pixel is another; more than the noise of video.
const OTHER: u32 = 30;
/// Such a difference counts for no more than this: what is covered or comes in sight has no counterpart.
const MOST: u32 = 120;
/// δ by which one thing lies in front of another.
const APART: f32 = 0.05;
/// Pixels of a thing that say where it went, at most.
const VOTERS: usize = 300;
/// So many of them for all ways that it may have gone.
const FIRST_VOTERS: usize = 60;
/// Of them so many are asked before it is looked whether that is enough.
const VOTERS_AT_ONCE: usize = 12;
/// Changed pixels of a thing below which it is left where it is.
const LEAST: usize = 12;
/// Share of what is left of the difference, by moving, from which on it did not move so.
const BETTER: f64 = 0.7;
/// Pixels that lie on no plane of their tile, from which on they get one: fewer are the noise of depth as often.
const LEAST_UNPLACED: usize = 40;

/// How a thing goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Way {
    /// Pixels to the right and down.
    x: i32,
    y: i32,
    /// In so long a time.
    time: Duration,
}

impl Way {
    /// Pixels to the right and down in another time.
    fn within(&self, time: Duration) -> (i32, i32) {
        let share = if self.time.is_zero() { 1.0 } else { time.as_secs_f64() / self.time.as_secs_f64() };
        let far = |pixels: i32| (f64::from(pixels) * share).round().clamp(f64::from(-FARTHEST), f64::from(FARTHEST)) as i32;
        (far(self.x), far(self.y))
    }
}

/// Two frames, of which the tiles are as of the first.
pub struct Motion<'a> {
    geometry: &'a Geometry,
    /// From the first frame to the second.
    time: Duration,
    /// Of the visible surface, all pixels.
    delta: &'a [f32],
    /// Colours, as words.
    was: &'a [u32],
    now: &'a [u32],
    /// 1 where a pixel is another, else 0.
    changed: Vec<u8>,
    /// The same of it and those that touch it.
    near_change: Dilation,
}

impl<'a> Motion<'a> {
    /// Both frames, the second so much later, are of the geometry's size, and so is its visible `surface`.
    #[must_use]
    pub fn new(geometry: &'a Geometry, surface: &'a Surface, (was, now): (&'a [u32], &'a [u32]), time: Duration) -> Self {
        let mut changed = vec![0; now.len()];
        mark_others(was, now, &mut changed);
        let (width, height) = (geometry.grid.width, geometry.grid.height);
        let mut near_change = Dilation::default();
        dilate(&changed, width, Rect { x: 0, y: 0, w: width, h: height }, (1, 1), &mut near_change);
        Self { geometry, time, delta: surface.all(), was, now, changed, near_change }
    }

    /// How the nearer things of a tile have gone, where they have; they are looked for also where those of it and the tiles beside it would be by
    /// the ways they went `before`.
    #[must_use]
    pub fn way(&self, index: u32, before: &[Option<Way>]) -> Option<Way> {
        let grid = &self.geometry.grid;
        let (columns, rows) = (grid.columns(), grid.rows());
        let around = |at: u32, most: u32| at.saturating_sub(1)..=(at + 1).min(most - 1);
        let mut guesses = Vec::new();
        for row in around(index / columns, rows) {
            for way in around(index % columns, columns).filter_map(|column| before.get((row * columns + column) as usize)?.as_ref()) {
                let guess = way.within(self.time);
                // one beside it is looked for there, too
                if guesses.iter().all(|g: &(i32, i32)| (g.0 - guess.0).abs().max((g.1 - guess.1).abs()) > 1) {
                    guesses.push(guess);
                }
            }
        }
        let reach = |of: fn(&(i32, i32)) -> i32| guesses.iter().map(|g| of(g).abs() + NEAR).fold(REACH, i32::max) as u32;
        let part = grown(grid.rect(index), reach(|g| g.0), reach(|g| g.1), grid);
        self.way_in(part, &guesses).map(|(x, y)| Way { x, y, time: self.time })
    }

    /// A tile in the second frame, by the way that its nearer things went; none where it is as before. What comes into it from a tile beside it and
    /// lies on no plane of its own gets one, without a slant.
    #[must_use]
    pub fn moved(&self, index: u32, Way { x: dx, y: dy, .. }: Way) -> Option<Tile> {
        let (grid, tile) = (&self.geometry.grid, self.geometry.tiles.get(index as usize)?);
        let rect = grid.rect(index);
        let place = TileFrame::of(grid, index);
        let mut moved = tile.clone();
        // places, and δ that comes there: of what is nearer, and farther, than the tile's planes near it
        let mut unplaced = [Vec::new(), Vec::new()];
        let pixels = (rect.y..rect.y + rect.h).flat_map(|y| (rect.x..rect.x + rect.w).map(move |x| (x, y)));
        for (i, (x, y)) in pixels.enumerate() {
            let here = (y * grid.width + x) as usize;
            if self.near_change.out[here] == 0 {
                continue;
            }
            // what comes in from beside the frame is as what is seen there at its border
            let side = |at: u32, d: i32, most: u32| (at as i32 - d).clamp(0, most as i32 - 1) as u32;
            let from = (side(y, dy, grid.height) * grid.width + side(x, dx, grid.width)) as usize;
            let (shown, comes) = (self.delta[here], self.delta[from]);
            if (comes - shown).abs() <= APART {
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
        for unplaced in unplaced.iter().filter(|h| h.len() >= LEAST_UNPLACED) {
            add_plane(&mut moved, unplaced);
        }
        (moved != *tile).then_some(moved)
    }

    /// Place of a pixel in the frames; none beside them.
    fn at(&self, x: i32, y: i32) -> Option<usize> {
        let (w, h) = (self.geometry.grid.width as i32, self.geometry.grid.height as i32);
        ((0..w).contains(&x) && (0..h).contains(&y)).then_some((y * w + x) as usize)
    }

    /// Pixels to the right and down by which the nearer things of a part of the frame have moved; none where they did not, or were not found.
    fn way_in(&self, part: Rect, guesses: &[(i32, i32)]) -> Option<(i32, i32)> {
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
        changed.retain(|p| p.2 > far + APART);
        if changed.len() < LEAST {
            return None;
        }
        let some = |most: usize| changed.iter().step_by(changed.len().div_ceil(most)).copied().collect::<Vec<_>>();
        // of two that are alike the shorter way; from `enough` on it is not told by how much more
        let cost = |voters: &[(i32, i32, f32)], (dx, dy): (i32, i32), enough: u32| -> u32 {
            let left = |&(x, y, _): &(i32, i32, f32)| {
                let to = self.at(x + dx, y + dy);
                to.map_or(MOST, |to| apart(self.was[y as usize * width as usize + x as usize], self.now[to]).min(MOST))
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
        let least = |voters: &[(i32, i32, f32)], ways: &mut dyn Iterator<Item = (i32, i32)>| {
            let (mut best, mut of_best) = ((0, 0), u32::MAX);
            for way in ways {
                let of_it = cost(voters, way, of_best);
                if of_it < of_best {
                    (best, of_best) = (way, of_it);
                }
            }
            best
        };
        let guessed = guesses.iter().flat_map(|guess| square(*guess, NEAR, 1));
        let about = least(&some(FIRST_VOTERS), &mut guessed.chain(square((0, 0), REACH, 2)).chain(square((0, 0), NEAR, 1)));
        let voters = some(VOTERS);
        let way = least(&voters, &mut square(about, 1, 1));
        (way != (0, 0) && f64::from(cost(&voters, way, u32::MAX)) < BETTER * f64::from(cost(&voters, (0, 0), u32::MAX))).then_some(way)
    }
}

/// Gives some pixels of a tile a plane, at the mean of the δ that come with their places.
fn add_plane(tile: &mut Tile, unplaced: &[(usize, f32)]) {
    if tile.planes.len() >= MAX_PLANES {
        return;
    }
    let mean = unplaced.iter().map(|(_, delta)| f64::from(*delta)).sum::<f64>() / unplaced.len() as f64;
    let plane = Plane::fronto_parallel(mean).quantised();
    // planes go from far to near
    let at = tile.planes.iter().take_while(|p| p.a <= plane.a).count();
    tile.planes.insert(at, plane);
    tile.labels.iter_mut().filter(|label| usize::from(**label) >= at).for_each(|label| *label += 1);
    for (i, _) in unplaced {
        tile.labels[*i] = at as u8;
    }
}

dispatch!(
    /// Marks with 1 the pixels that are others by more than [`OTHER`], with 0 the rest.
    mark_others, mark_others_body, (was: &[u32], now: &[u32], changed: &mut [u8])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn mark_others_body(was: &[u32], now: &[u32], changed: &mut [u8]) {
    for (changed, (was, now)) in changed.iter_mut().zip(was.iter().zip(now)) {
        *changed = u8::from(apart(*was, *now) > OTHER);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::live::{Layers, When};
    use crate::scene::packed_rgb::of_word;
    use crate::{Grid, Intrinsics, Photo, ViewBox};

    const W: u32 = 96;
    const H: u32 = 64;

    /// A wall, and before it a thing of 24 × 30 pixels whose corner is at `(x, y)`; labels as of there.
    fn frame(x: u32, y: u32) -> (Geometry, Vec<u32>) {
        let inside = |i: u32| (x..x + 24).contains(&(i % W)) && (y..y + 30).contains(&(i / W));
        let wave = |a: u32, b: u32| (127.0 + 100.0 * (f64::from(a) / 3.0).sin() * (f64::from(b) / 4.0).cos()) as u8;
        let rgb = |i| if inside(i) { [200, wave(i % W - x, i / W - y), 40, 0] } else { [20, 40, wave(i % W, i / W) / 2, 0] };
        let colours = (0..W * H).map(|i| u32::from_le_bytes(rgb(i))).collect();
        let grid = Grid::new(W, H, 64);
        let planes = vec![Plane::fronto_parallel(0.2), Plane::fronto_parallel(0.7)];
        let of = |t: u32| {
            let r = grid.rect(t);
            let labels = (0..r.area() as u32).map(|i| inside((r.y + i / r.w) * W + r.x + i % r.w).into()).collect();
            Tile { planes: planes.clone(), labels, background: None }
        };
        let tiles = (0..grid.tiles()).map(of).collect();
        (Geometry { grid, intrinsics: Intrinsics::centred(W, H, 50.0), view_box: ViewBox::default(), tiles, matted: false }, colours)
    }

    #[test]
    fn labels_go_where_the_thing_went() {
        // up to the border of two tiles
        let (geometry, was) = frame(40, 16);
        let surface = geometry.surface();
        for (x, y) in [(45, 16), (36, 19), (48, 8), (40, 27)] {
            let (other, now) = frame(x, y);
            let motion = Motion::new(&geometry, &surface, (&was, &now), Duration::ZERO);
            for (t, (tile, other)) in (0..).zip(geometry.tiles.iter().zip(&other.tiles)) {
                let moved = motion.way(t, &[]).and_then(|way| motion.moved(t, way));
                let off = moved.as_ref().unwrap_or(tile).labels.iter().zip(&other.labels).filter(|(a, b)| a != b).count();
                assert_eq!(off, 0, "pixels of tile {t}, to {x}, {y}");
            }
        }
    }

    #[test]
    fn a_thing_that_goes_on_as_before_is_found_farther_off_than_it_is_looked_for() {
        let (geometry, was) = frame(10, 16);
        let surface = geometry.surface();
        let (thirtieth, tiles) = (Duration::from_micros(33_333), geometry.grid.tiles());
        let labels = |motion: &Motion, before: &[Option<Way>]| -> Vec<_> {
            (0..tiles)
                .map(|t| motion.way(t, before).and_then(|way| motion.moved(t, way)).unwrap_or(geometry.tiles[t as usize].clone()).labels)
                .collect()
        };
        let first = frame(20, 18).1;
        let motion = Motion::new(&geometry, &surface, (&was, &first), thirtieth);
        let ways: Vec<_> = (0..tiles).map(|t| motion.way(t, &[])).collect();
        let (other, third) = frame(40, 22);
        let motion = Motion::new(&geometry, &surface, (&was, &third), 3 * thirtieth);
        let expected: Vec<_> = other.tiles.into_iter().map(|t| t.labels).collect();
        assert!(labels(&motion, &[]) != expected, "without those before it is not found");
        assert!(labels(&motion, &ways) == expected, "by those before it is");
    }

    #[test]
    fn a_tile_gets_a_plane_for_what_comes_into_it() {
        // to a tile that has the wall alone
        let border = Grid::new(W, H, 64).rect(1).x;
        let (mut geometry, was) = frame(border - 25, 16);
        let (other, now) = frame(border - 14, 18);
        assert!(!geometry.tiles[1].labels.contains(&1) && other.tiles[1].labels.contains(&1));
        geometry.tiles[1].planes.truncate(1);
        let surface = geometry.surface();
        let motion = Motion::new(&geometry, &surface, (&was, &now), Duration::ZERO);
        let moved = motion.way(1, &[]).and_then(|way| motion.moved(1, way)).unwrap();
        assert_eq!(moved.labels, other.tiles[1].labels);
        let off = |i: usize| (moved.planes[i].a - other.tiles[1].planes[i].a).abs();
        assert!(moved.planes.len() == 2 && off(0) < 1e-3 && off(1) < 1e-3, "{:?}", moved.planes);
        // and what the thing leaves behind, in a tile that has the thing's alone
        let mut tile = geometry.tiles[0].clone();
        tile.planes.remove(0);
        tile.labels.fill(0);
        add_plane(&mut tile, &[(3, 0.2), (4, 0.21)]);
        assert!(tile.planes[0].a < tile.planes[1].a && (tile.planes[0].a - 0.205).abs() < 1e-3, "{:?}", tile.planes);
        assert_eq!(tile.labels[..6], [1, 1, 1, 0, 0, 1]);
        tile.planes = vec![tile.planes[0]; MAX_PLANES];
        let full = tile.clone();
        add_plane(&mut tile, &[(3, 0.7)]);
        assert!(tile == full, "no more than there may be");
    }

    #[test]
    fn labels_of_tiles_that_come_late_go_where_the_thing_is_by_then() {
        let photo = |colours: &[u32]| Photo { width: W, height: H, rgb: colours.iter().map(|c| of_word(*c)).collect() };
        let frames: Vec<_> = [40, 44, 48, 52].map(|x| frame(x, 16)).into();
        let time = Some(Duration::from_millis(33));
        let labels = |geometry: &Geometry| geometry.tiles.iter().map(|t| t.labels.clone()).collect::<Vec<_>>();
        for (late, of) in [(0, 3), (1, 2), (2, 1), (3, 0)] {
            let mut layers = Layers::remembering();
            for (n, (_, colours)) in (0u64..).zip(&frames) {
                let last = n == 3;
                let when = When { frame: n, tiles: last.then(|| n - late), gone: time };
                let geometry = if last { &frames[of].0 } else { &frames[0].0 };
                layers.update(geometry, |_| last, photo(colours), when);
            }
            let shown = layers.with_moved().unwrap_or(&frames[of].0);
            assert!(labels(shown) == labels(&frames[3].0), "tiles of {late} frames before");
        }
    }

    #[test]
    fn labels_stay_where_nothing_moved_or_nothing_is_found() {
        let (geometry, was) = frame(30, 16);
        let surface = geometry.surface();
        let of = |now: &[u32]| {
            let motion = Motion::new(&geometry, &surface, (&was, now), Duration::ZERO);
            (0..geometry.grid.tiles()).filter_map(|t| motion.moved(t, motion.way(t, &[])?)).count()
        };
        assert_eq!(of(&was), 0);
        // noise, the light, and another picture
        let each = |f: &dyn Fn(usize, [u8; 3]) -> [u8; 3]| -> Vec<u32> {
            let other = |(i, word): (usize, &u32)| f(i, of_word(*word));
            was.iter().enumerate().map(other).map(|[r, g, b]| u32::from_le_bytes([r, g, b, 0])).collect()
        };
        assert_eq!(of(&each(&|i, p| p.map(|v| v.saturating_add((i * 7 % 8) as u8)))), 0);
        assert_eq!(of(&each(&|_, p| p.map(|v| v / 2))), 0);
        assert_eq!(of(&each(&|i, _| [(i * 31 % 251) as u8, (i * 17 % 241) as u8, (i * 13 % 239) as u8])), 0);
    }
}
