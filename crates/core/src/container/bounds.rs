//! Limits that readers enforce, whatever a container claims; writers enforce the same limits.

use super::{ContainerError, MAX_PIXELS, MAX_SIDE, columns};
use crate::layers::work_of;
use crate::{Grid, Intrinsics, Tile, ViewBox};

/// Maximum number of planes in all tiles.
pub const PLANES: usize = 4_000_000;
/// Maximum number of pixels and blocks read to derive the texels. A 50-megapixel photo with four planes per tile reads about 6e9, of which
/// blocks are a sixth.
const WORK: u64 = 9_400_000_000;
/// The same per pixel of the photo. Tiles of 8 pixels, as in the smallest level, with 20 planes each read 17 000.
const WORK_PER_PIXEL: u64 = 20_000;
/// Number of pixels that even the smallest photo may read.
const MIN_WORK: u64 = 50_000_000;
/// Maximum size of the index in bytes.
pub const INDEX: usize = 1 << 20;
/// Maximum number of sections.
pub const SECTIONS: usize = 64;

/// Maximum number of pixels and blocks read to derive the texels of a grid.
fn max_work(grid: &Grid) -> u64 {
    WORK.min(MIN_WORK + u64::from(grid.width) * u64::from(grid.height) * WORK_PER_PIXEL)
}

/// Checks a grid, intrinsics and view box.
pub fn frame(grid: &Grid, k: &Intrinsics, v: &ViewBox) -> Result<(), ContainerError> {
    let sides = 1..=MAX_SIDE;
    if !sides.contains(&grid.width) || !sides.contains(&grid.height) || u64::from(grid.width) * u64::from(grid.height) > MAX_PIXELS {
        return Err(ContainerError::Bound(format!(
            "a photo of {}×{}, over {MAX_PIXELS} pixels or {MAX_SIDE} a side",
            grid.width, grid.height
        )));
    }
    // with tiles that overlap by more than half, labels would be many times as large as the photo
    if !sides.contains(&grid.size) || grid.stride < grid.size.div_ceil(2) || grid.stride > grid.size {
        return Err(ContainerError::Bound(format!("tiles of {} pixels every {}", grid.size, grid.stride)));
    }
    if !k.is_valid() || ![v.x, v.y, v.z].iter().all(|e| e.is_finite() && *e >= 0.0) {
        return Err(ContainerError::Bound("an invalid camera".into()));
    }
    Ok(())
}

/// Checks the number of planes in all tiles, including background planes.
pub fn planes(grid: &Grid, count: usize) -> Result<(), ContainerError> {
    let least = grid.tiles() as usize;
    let most = PLANES.min(least * columns::MAX_PLANES);
    if (least..=most).contains(&count) {
        Ok(())
    } else {
        Err(ContainerError::Bound(format!("{count} planes; the grid allows {least} to {most}")))
    }
}

/// Checks how many pixels deriving the texels reads. Needs no labels.
pub fn work(grid: &Grid, tiles: &[Tile]) -> Result<(), ContainerError> {
    let (found, most) = (work_of(grid, (0..).map(|i: usize| tiles.get(i).map_or(0, |t| t.planes.len() as u64))), max_work(grid));
    if found > most {
        return Err(ContainerError::Bound(format!(
            "too many planes for a photo of this size: deriving its layers reads {found} pixels, over {most}"
        )));
    }
    Ok(())
}

/// Checks a geometry before it is written.
#[cfg(feature = "write")]
pub fn geometry(g: &crate::Geometry) -> Result<(), ContainerError> {
    frame(&g.grid, &g.intrinsics, &g.view_box)?;
    planes(&g.grid, g.planes())?;
    work(&g.grid, &g.tiles)
}

/// True if readers accept these planes for this grid, even with a background plane in each tile.
pub fn readable(grid: &Grid, tiles: &[Tile]) -> bool {
    let count = tiles.iter().map(|t| t.planes.len() + 1).sum();
    planes(grid, count).is_ok() && work(grid, tiles).is_ok()
}

/// Maximum number of planes per tile, without background planes, that readers accept for every photo of this grid; 0 if the tiles are too
/// small for the photo's size.
pub fn most_planes(grid: &Grid) -> u32 {
    let (one, most) = (work_of(grid, std::iter::repeat(0)), max_work(grid));
    let tiles = grid.tiles().max(1) as usize;
    // a background plane counts, too
    let by_count = (PLANES / tiles).saturating_sub(1);
    let by_work = (most / one.max(1)).saturating_sub(1) as usize;
    by_count.min(by_work).min(columns::MAX_PLANES - 1) as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Plane;

    fn tiles(grid: &Grid, planes: u32) -> Vec<Tile> {
        let tile = || Tile { planes: vec![Plane { a: 0.0, b: 0.0, c: 0.5 }; planes as usize], ..Tile::default() };
        (0..grid.tiles()).map(|_| tile()).collect()
    }

    #[test]
    fn most_planes_are_readable_and_one_more_is_not() {
        for (w, h, size) in [(600, 400, 8), (300, 200, 8), (4000, 3000, 64), (4000, 3000, 16), (8192, 6000, 64)] {
            let grid = Grid::new(w, h, size);
            let most = most_planes(&grid);
            assert!(most > 0, "{w}×{h} in tiles of {size}");
            assert!(work(&grid, &tiles(&grid, most)).is_ok());
            if most < columns::MAX_PLANES as u32 - 1 {
                assert!(work(&grid, &tiles(&grid, most + 1)).is_err(), "{w}×{h} in tiles of {size}: {most}");
            }
        }
        assert_eq!(most_planes(&Grid::new(8192, 6000, 8)), 0);
        assert_eq!(most_planes(&Grid::full(4000, 3000)) as usize, columns::MAX_PLANES - 1);
    }

    #[test]
    fn the_largest_photo_is_accepted_and_one_pixel_more_is_not() {
        let at = |width, height, size, stride| {
            let grid = Grid { width, height, size, stride };
            frame(&grid, &Intrinsics::centred(width.max(1), height.max(1), 50.0), &ViewBox::cube(0.03)).is_ok()
        };
        let (wide, high) = (10_000, (MAX_PIXELS / 10_000) as u32);
        assert_eq!(u64::from(wide) * u64::from(high), MAX_PIXELS);
        assert!(at(wide, high, 64, 56) && !at(wide, high + 1, 64, 56));
        assert!(at(MAX_SIDE, 1, 64, 56) && !at(MAX_SIDE + 1, 1, 64, 56) && at(1, MAX_SIDE, 64, 56) && !at(1, MAX_SIDE + 1, 64, 56));
        assert!(!at(0, 1, 64, 56) && !at(1, 0, 64, 56));
        assert!(at(100, 100, 64, 32) && !at(100, 100, 64, 31) && at(100, 100, 64, 64) && !at(100, 100, 64, 65));
        assert!(at(100, 100, MAX_SIDE, MAX_SIDE) && !at(100, 100, MAX_SIDE + 1, MAX_SIDE + 1) && !at(100, 100, 0, 0));
    }

    #[test]
    fn invalid_cameras_are_rejected() {
        let grid = Grid::new(100, 80, 64);
        let k = Intrinsics::centred(100, 80, 50.0);
        let seen = |k: Intrinsics, v: ViewBox| frame(&grid, &k, &v).is_ok();
        let none = ViewBox { x: 0.0, y: 0.0, z: 0.0 };
        assert!(seen(k, none));
        for bad in [f64::NAN, f64::INFINITY, -0.01] {
            assert!(!seen(k, ViewBox { x: bad, ..none }) && !seen(k, ViewBox { y: bad, ..none }) && !seen(k, ViewBox { z: bad, ..none }));
            assert!(!seen(Intrinsics { fx: bad, ..k }, none), "{bad}");
        }
    }
}
