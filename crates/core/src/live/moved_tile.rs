//! A tile whose labels follow an object.

use super::MAX_PLANES;
use super::label_motion::DEPTH_STEP;
use crate::rim::{has_chroma_share, has_share};
use crate::scene::packed_rgb::of_word;
use crate::{Geometry, Plane, Rect, Tile, TileFrame};

/// Difference in δ up to which a plane of the tile stands for the plane that a pixel comes from.
const SAME: f32 = 0.05;
/// Minimum number of pixels on none of their tile's planes for which the tile gets the plane that they come from; fewer are as often noise
/// of depth.
const MIN_UNPLACED: usize = 40;
/// Number of times that pixels beside a moved object join it, one pixel farther out each time.
const RIMS: usize = 2;
/// Radius of the window whose colours decide whether a pixel joins.
const WINDOW: usize = 3;

/// The tiles and pictures that labels move in.
#[derive(Clone, Copy)]
pub(super) struct Labels<'a> {
    pub geometry: &'a Geometry,
    /// δ of the visible surface at each pixel.
    pub delta: &'a [f32],
    /// Colours of the new frame, as words.
    pub now: &'a [u32],
    /// 1 where a pixel or one beside it has changed, otherwise 0.
    pub near_change: &'a [u8],
}

/// Pixels of a tile that come from one plane of another place, and lie on none of the tile's.
struct Unplaced {
    plane: Plane,
    /// Index among the tile's pixels, δ that comes there, and δ shown there.
    pixels: Vec<(usize, f32, f32)>,
}

impl Labels<'_> {
    /// Tile `index` after its nearer objects moved by `by` pixels to the right and down; `None` if it does not change. If something enters
    /// that lies on none of the tile's planes, the tile gets the plane that it comes from.
    pub(super) fn moved(&self, index: u32, by: (i32, i32)) -> Option<Tile> {
        let tile = self.geometry.tiles.get(index as usize)?;
        let mut moved = tile.clone();
        let unplaced = self.move_labels(index, by, &mut moved);
        for unplaced in unplaced {
            self.place(index, &mut moved, unplaced);
        }
        if moved == *tile {
            return None;
        }
        for _ in 0..RIMS {
            self.join_rims(index, &mut moved);
        }
        Some(moved)
    }

    /// Gives pixels the plane that they come from, if they are enough and the tile has room for it; otherwise the nearest of its planes.
    fn place(&self, index: u32, tile: &mut Tile, Unplaced { plane, pixels }: Unplaced) {
        if pixels.len() >= MIN_UNPLACED && tile.planes.len() < MAX_PLANES {
            return add_plane(tile, plane, pixels.iter().map(|p| p.0));
        }
        for (i, comes, shown) in pixels {
            let (best, off) = self.nearest_plane(index, tile, i, comes);
            if off < 0.5 * (comes - shown).abs() {
                tile.labels[i] = best;
            }
        }
    }

    /// Moves the labels of pixels that one of the tile's planes fits; returns the others.
    fn move_labels(&self, index: u32, (dx, dy): (i32, i32), moved: &mut Tile) -> Vec<Unplaced> {
        let grid = &self.geometry.grid;
        let rect = grid.rect(index);
        // what enters from outside the frame continues the frame's border
        let side = |at: u32, d: i32, most: u32| (at as i32 - d).clamp(0, most as i32 - 1) as u32;
        let mut unplaced: Vec<((u32, u8), Unplaced)> = Vec::new();
        let pixels = (rect.y..rect.y + rect.h).flat_map(|y| (rect.x..rect.x + rect.w).map(move |x| (x, y)));
        for (i, (x, y)) in pixels.enumerate() {
            let here = (y * grid.width + x) as usize;
            if self.near_change[here] == 0 {
                continue;
            }
            let (u, v) = (side(x, dx, grid.width), side(y, dy, grid.height));
            let (shown, comes) = (self.delta[here], self.delta[(v * grid.width + u) as usize]);
            if (comes - shown).abs() <= DEPTH_STEP {
                continue;
            }
            let (best, off) = self.nearest_plane(index, &self.geometry.tiles[index as usize], i, comes);
            if off <= SAME {
                moved.labels[i] = best;
                continue;
            }
            let from = (u, v);
            let Some(source) = self.label_at(from) else { continue };
            let at = unplaced.iter().position(|(of, _)| *of == source).unwrap_or_else(|| {
                let plane = self.moved_plane(source, (dx, dy), index);
                unplaced.push((source, Unplaced { plane, pixels: Vec::new() }));
                unplaced.len() - 1
            });
            unplaced[at].1.pixels.push((i, comes, shown));
        }
        unplaced.into_iter().map(|(_, unplaced)| unplaced).collect()
    }

    /// The tile that shows a pixel of the frame, the last one with it, and the pixel's label there.
    fn label_at(&self, (x, y): (u32, u32)) -> Option<(u32, u8)> {
        let grid = &self.geometry.grid;
        let index = (y / grid.stride).min(grid.rows() - 1) * grid.columns() + (x / grid.stride).min(grid.columns() - 1);
        let rect = grid.rect(index);
        let label = self.geometry.tiles.get(index as usize)?.labels.get(((y - rect.y) * rect.w + x - rect.x) as usize)?;
        Some((index, *label))
    }

    /// A plane of another tile, moved along, in the coordinates of tile `to`.
    fn moved_plane(&self, (from, label): (u32, u8), (dx, dy): (i32, i32), to: u32) -> Plane {
        let grid = &self.geometry.grid;
        let (old, new) = (TileFrame::of(grid, from), TileFrame::of(grid, to));
        let Plane { a, b, c } = self.geometry.tiles[from as usize].planes[usize::from(label)];
        let (u, v) = ((new.centre.0 - f64::from(dx) - old.centre.0) / old.half, (new.centre.1 - f64::from(dy) - old.centre.1) / old.half);
        Plane { a: a + b * u + c * v, b, c }.quantised()
    }

    /// The plane of a tile whose δ at pixel `i` is nearest to this, and by how much it is off.
    fn nearest_plane(&self, index: u32, tile: &Tile, i: usize, delta: f32) -> (u8, f32) {
        let (rect, frame) = (self.geometry.grid.rect(index), TileFrame::of(&self.geometry.grid, index));
        let (x, y) = (rect.x + i as u32 % rect.w, rect.y + i as u32 / rect.w);
        let off = |plane: &Plane| (frame.disparity(plane, x, y) - delta).abs();
        let planes = (0u8..).zip(&tile.planes).map(|(label, plane)| (label, off(plane)));
        planes.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((0, f32::INFINITY))
    }

    /// Gives changed pixels beside an object to it if their colours have a share of the object's. Otherwise they stay behind as specks.
    fn join_rims(&self, index: u32, tile: &mut Tile) {
        let grid = &self.geometry.grid;
        let rect = grid.rect(index);
        let delta = tile.disparities(grid, index);
        let (w, h) = (rect.w as usize, rect.h as usize);
        let first = rect.y as usize * grid.width as usize + rect.x as usize;
        let pixel = |at: usize| first + at / w * grid.width as usize + at % w;
        let window = |at: usize, by: usize| window(rect, at, by);
        let joined = (0..w * h).filter(|at| self.near_change[pixel(*at)] != 0).filter_map(|at| {
            let own = delta[at];
            let nearest = window(at, 1).max_by(|a, b| delta[*a].total_cmp(&delta[*b]))?;
            let step = delta[nearest] - own;
            if step <= DEPTH_STEP {
                return None;
            }
            let (mut near, mut far) = (Side::default(), Side::default());
            for other in window(at, WINDOW) {
                let beside = (other % w).abs_diff(at % w) <= 1 && (other / w).abs_diff(at / w) <= 1;
                if delta[other] >= own + 0.8 * step {
                    near.add(of_word(self.now[pixel(other)]));
                } else if delta[other] <= own + 0.2 * step && !beside {
                    far.add(of_word(self.now[pixel(other)]));
                }
            }
            joins(of_word(self.now[pixel(at)]), &near, &far).then(|| (at, tile.labels[nearest]))
        });
        for (at, label) in joined.collect::<Vec<_>>() {
            tile.labels[at] = label;
        }
    }
}

/// Indices of the pixels of a tile within `by` rows and columns of one.
fn window(rect: Rect, at: usize, by: usize) -> impl Iterator<Item = usize> {
    let (w, h) = (rect.w as usize, rect.h as usize);
    let side = |at: usize, most: usize| at.saturating_sub(by)..(at + by + 1).min(most);
    let columns = side(at % w, w);
    side(at / w, h).flat_map(move |y| columns.clone().map(move |x| y * w + x))
}

/// Colours of one side of a border.
#[derive(Default)]
struct Side {
    sum: [f32; 3],
    count: f32,
}

impl Side {
    fn add(&mut self, colour: [u8; 3]) {
        for (sum, c) in self.sum.iter_mut().zip(colour) {
            *sum += f32::from(c);
        }
        self.count += 1.0;
    }
}

/// Whether a colour has a share of the near side's.
fn joins(colour: [u8; 3], near: &Side, far: &Side) -> bool {
    // not finite if a side has no colours
    let sides = [0, 1, 2].map(|i| (near.sum[i] / near.count, far.sum[i] / far.count));
    let (above, step) = ([0, 1, 2].map(|i| f32::from(colour[i]) - sides[i].1), sides.map(|(near, far)| near - far));
    has_share(above, step) || has_chroma_share(above, step)
}

/// Adds a plane to a tile for some of its pixels.
fn add_plane(tile: &mut Tile, plane: Plane, pixels: impl Iterator<Item = usize>) {
    // planes are sorted from far to near
    let at = tile.planes.iter().take_while(|p| p.a <= plane.a).count();
    tile.planes.insert(at, plane);
    tile.labels.iter_mut().filter(|label| usize::from(**label) >= at).for_each(|label| *label += 1);
    for i in pixels {
        tile.labels[i] = at as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Grid, Intrinsics, ViewBox};

    const W: u32 = 64;
    const FAR: [u8; 3] = [20, 40, 60];
    const NEAR: [u8; 3] = [220, 140, 90];

    /// One tile: a far plane, and a near one to the left of column `x`.
    fn geometry(x: u32) -> Geometry {
        let grid = Grid::new(W, W, 64);
        let planes = [0.2, 0.7].map(Plane::fronto_parallel).to_vec();
        let labels = (0..W * W).map(|i| u8::from(i % W < x)).collect();
        let tiles = vec![Tile { planes, labels, background: None }];
        Geometry { grid, intrinsics: Intrinsics::centred(W, W, 50.0), view_box: ViewBox::cube(0.03), tiles, matte_band: 0 }
    }

    /// Columns of the near plane in each row after a motion of 3 pixels to the right, in a frame whose column `20 + n` has the colour
    /// `rim[n]`, and the others to the right the far colour.
    fn near_columns(rim: &[[u8; 3]]) -> Vec<u32> {
        let geometry = geometry(20 - 3);
        let surface = geometry.surface();
        let colour = |x: u32| if x < 20 { NEAR } else { rim.get(x as usize - 20).copied().unwrap_or(FAR) };
        let now: Vec<u32> = (0..W * W).map(|i| colour(i % W)).map(|[r, g, b]| u32::from_le_bytes([r, g, b, 0])).collect();
        let changed = vec![1; (W * W) as usize];
        let labels = Labels { geometry: &geometry, delta: surface.all(), now: &now, near_change: &changed };
        let moved = labels.moved(0, (3, 0)).unwrap();
        moved.labels.chunks(W as usize).map(|row| row.iter().map(|l| u32::from(*l)).sum()).collect()
    }

    #[test]
    fn pixels_with_a_share_of_the_objects_colour_join_it() {
        let mixed = |share: f32| [0, 1, 2].map(|c| (f32::from(FAR[c]) + share * (f32::from(NEAR[c]) - f32::from(FAR[c]))) as u8);
        for (rim, columns) in [(&[][..], 20), (&[0.3], 21), (&[0.15], 20), (&[0.6, 0.3], 22), (&[-0.1], 20)] {
            let rim: Vec<[u8; 3]> = rim.iter().map(|share| mixed(*share)).collect();
            assert_eq!(near_columns(&rim), vec![columns; W as usize], "{rim:?}");
        }
        // half of the object's chroma, and the brightness of the wall or less
        for luma in [0.0, 20.0] {
            let step = [0, 1, 2].map(|c| f32::from(NEAR[c]) - f32::from(FAR[c]));
            let grey = 0.2126 * step[0] + 0.7152 * step[1] + 0.0722 * step[2];
            let rim = [0, 1, 2].map(|c| (f32::from(FAR[c]) + 0.5 * (step[c] - grey) - luma).max(0.0) as u8);
            assert_eq!(near_columns(&[rim]), vec![21; W as usize], "{rim:?}");
        }
    }

    #[test]
    fn a_moved_plane_keeps_its_place_on_the_object() {
        let mut geometry = geometry(0);
        geometry.grid = Grid::new(160, 64, 64);
        let tilted = Plane { a: 0.5, b: 0.1, c: -0.05 };
        geometry.tiles = vec![Tile { planes: vec![tilted], ..Tile::default() }; geometry.grid.tiles() as usize];
        let labels = Labels { geometry: &geometry, delta: &[], now: &[], near_change: &[] };
        let moved = labels.moved_plane((0, 0), (9, -4), 1);
        let at = |plane: &Plane, tile: u32, x: u32, y: u32| TileFrame::of(&geometry.grid, tile).disparity(plane, x, y);
        for (x, y) in [(60, 10), (75, 30), (90, 50)] {
            let (is, should) = (at(&moved, 1, x, y), at(&tilted, 0, x - 9, y + 4));
            assert!((is - should).abs() < 2e-4, "{is} {should}");
        }
    }

    #[test]
    fn a_full_tile_gets_no_plane() {
        let mut geometry = geometry(20);
        let surface = geometry.surface();
        // the object's plane is missing
        for (planes, expected) in [(1, 2), (MAX_PLANES, MAX_PLANES)] {
            geometry.tiles[0].planes = vec![Plane::fronto_parallel(0.2); planes];
            geometry.tiles[0].labels.fill(0);
            let (now, changed) = (vec![0; (W * W) as usize], vec![1; (W * W) as usize]);
            let labels = Labels { geometry: &geometry, delta: surface.all(), now: &now, near_change: &changed };
            let plane = Plane::fronto_parallel(0.7);
            let mut tile = geometry.tiles[0].clone();
            labels.place(0, &mut tile, Unplaced { plane, pixels: (0..MIN_UNPLACED).map(|i| (i, 0.7, 0.2)).collect() });
            assert_eq!(tile.planes.len(), expected);
            assert!(tile.labels.iter().all(|l| usize::from(*l) < expected));
        }
    }

    #[test]
    fn planes_stay_sorted_and_labels_keep_theirs() {
        let mut tile = geometry(0).tiles.remove(0);
        add_plane(&mut tile, Plane::fronto_parallel(0.4), [3, 4].into_iter());
        assert_eq!(tile.planes.iter().map(|p| p.a).collect::<Vec<_>>(), [0.2, 0.4, 0.7]);
        assert_eq!(tile.labels[..6], [0, 0, 0, 1, 1, 0]);
        tile.labels[0] = 2;
        add_plane(&mut tile, Plane::fronto_parallel(0.1), [5].into_iter());
        assert_eq!(tile.labels[..7], [3, 1, 1, 2, 2, 0, 1]);
    }
}
