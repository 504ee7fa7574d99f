//! Regions of a container: the tiles over a rectangle of the photo, as a container of their own.
//!
//! Planes, labels and visible texels are the same bit for bit. Hidden texels are derived without the tiles that were cut off, as at the
//! photo's own border, and where pruning searches far, in blocks that start at the region's corner.

use std::ops::Range;

use super::{ContainerError, EncodedPhoto, decode, smaller_level};
use crate::{Geometry, Grid, Intrinsics, Photo, Rect};

/// A rectangle of whole tiles in a grid; neither range is empty.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct TileRect {
    /// Columns of tiles.
    pub columns: Range<u32>,
    /// Rows of tiles.
    pub rows: Range<u32>,
}

impl TileRect {
    /// The fewest whole tiles that cover `region`; `None` if it is empty or extends beyond the photo.
    pub fn over(grid: &Grid, region: Rect) -> Option<Self> {
        let within = |from: u32, length: u32, side: u32| length > 0 && u64::from(from) + u64::from(length) <= u64::from(side);
        if !within(region.x, region.w, grid.width) || !within(region.y, region.h, grid.height) {
            return None;
        }
        let range = |from: u32, length: u32, tiles: u32| {
            let first = (from / grid.stride).min(tiles - 1);
            // tiles overlap, so the tile before may already reach the end
            let last = (from + length).saturating_sub(grid.size).div_ceil(grid.stride).max(first);
            first..last + 1
        };
        Some(Self { columns: range(region.x, region.w, grid.columns()), rows: range(region.y, region.h, grid.rows()) })
    }

    /// [`TileRect::over`] for the grid of a container.
    ///
    /// # Errors
    /// [`ContainerError::Broken`], [`ContainerError::Bound`] or [`ContainerError::Newer`].
    pub fn over_region(container: &[u8], region: Rect) -> Result<Option<Self>, ContainerError> {
        let (_, grid) = decode::declared(container)?;
        Ok(Self::over(&grid, region))
    }
}

/// Codec for the photo of a region.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RegionPhoto {
    /// JPEG with the quality of smaller levels.
    #[default]
    Jpeg,
    /// Lossless WebP.
    Lossless,
}

/// Makes a container of some tiles at `1 / 2^level` of their size, as in [`super::level`]. The grid starts at the corner of a tile, and the
/// principal point moves with it, so poses keep their meaning. If `tiles` has all tiles, the result is the container itself, or its level.
/// Does not carry refined alphas and hidden colours, which are derived again.
///
/// # Errors
/// [`ContainerError::Broken`], also if `tiles` is empty or out of range; [`ContainerError::Bound`], [`ContainerError::Newer`] or
/// [`ContainerError::Encode`].
pub fn region(container: &[u8], tiles: &TileRect, level: u8, as_: RegionPhoto) -> Result<Vec<u8>, ContainerError> {
    let (_, grid) = decode::declared(container)?;
    let within = |range: &Range<u32>, count: u32| range.start < range.end && range.end <= count;
    if !within(&tiles.columns, grid.columns()) || !within(&tiles.rows, grid.rows()) {
        return Err(ContainerError::broken("tiles out of range"));
    }
    if (tiles.columns.end - tiles.columns.start, tiles.rows.end - tiles.rows.start) == (grid.columns(), grid.rows()) {
        return smaller_level::level(container, level);
    }
    let (photo, geometry) = decode::read_rows(container, tiles.rows.clone())?;
    let (rect, geometry) = cut(geometry, tiles);
    let photo = crop(&photo, rect);
    let (photo, geometry, _) = smaller_level::smaller(photo, geometry, level);
    let photo_file = match as_ {
        RegionPhoto::Jpeg => EncodedPhoto::from_photo(&photo, smaller_level::QUALITY)?,
        RegionPhoto::Lossless => EncodedPhoto::lossless(&photo)?,
    };
    smaller_level::encode_geometry(&geometry, &photo_file)
}

/// The rectangle of the tiles in pixels, and the geometry of these tiles.
fn cut(geometry: Geometry, tiles: &TileRect) -> (Rect, Geometry) {
    let Geometry { grid, intrinsics: k, view_box, tiles: all, matte_band } = geometry;
    let (rect, part) = grid.part(tiles.columns.clone(), tiles.rows.clone());
    let columns = grid.columns();
    let kept = |i: u32| tiles.columns.contains(&(i % columns)) && tiles.rows.contains(&(i / columns));
    let tiles = (0..).zip(all).filter(|(i, _)| kept(*i)).map(|(_, t)| t).collect();
    let intrinsics = Intrinsics { cx: k.cx - f64::from(rect.x), cy: k.cy - f64::from(rect.y), ..k };
    (rect, Geometry { grid: part, intrinsics, view_box, tiles, matte_band })
}

fn crop(photo: &Photo, r: Rect) -> Photo {
    let row = |y: u32| &photo.rgb[y as usize * photo.width as usize + r.x as usize..][..r.w as usize];
    Photo { width: r.w, height: r.h, rgb: (r.y..r.y + r.h).flat_map(row).copied().collect() }
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{bare_in, discs as scene};
    use super::*;
    use proptest::prelude::*;
    use std::sync::OnceLock;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        #[test]
        fn planes_and_labels_of_a_region_are_those_of_the_whole(at in any::<[u16; 4]>(), level in 0u8..3) {
            static WHOLE: OnceLock<[Vec<u8>; 2]> = OnceLock::new();
            let [one, bands] = WHOLE.get_or_init(|| [None, Some(2)].map(|rows| bare_in(rows, &scene(301, 419))));
            let (photo, whole) = decode::read(one).unwrap();
            let grid = whole.grid;
            let side = |from: u16, length: u16, side: u32| {
                let from = u32::from(from) % side;
                (from, 1 + u32::from(length) % (side - from))
            };
            let ((x, w), (y, h)) = (side(at[0], at[1], grid.width), side(at[2], at[3], grid.height));
            let wanted = Rect { x, y, w, h };
            let tiles = TileRect::over_region(one, wanted).unwrap().unwrap();
            let (rect, _) = grid.part(tiles.columns.clone(), tiles.rows.clone());
            prop_assert!(rect.contains(&wanted));
            // with one tile less on any side, the region is not covered
            for less in [
                TileRect { columns: tiles.columns.start + 1..tiles.columns.end, ..tiles.clone() },
                TileRect { columns: tiles.columns.start..tiles.columns.end - 1, ..tiles.clone() },
                TileRect { rows: tiles.rows.start + 1..tiles.rows.end, ..tiles.clone() },
                TileRect { rows: tiles.rows.start..tiles.rows.end - 1, ..tiles.clone() },
            ] {
                let covers = |l: &TileRect| grid.part(l.columns.clone(), l.rows.clone()).0.contains(&wanted);
                prop_assert!(less.columns.is_empty() || less.rows.is_empty() || !covers(&less));
            }
            let file = region(one, &tiles, level, RegionPhoto::Lossless).unwrap();
            let (part_photo, part) = decode::read(&file).unwrap();
            if rect.area() < grid.width as usize * grid.height as usize {
                prop_assert_eq!(&file, &region(bands, &tiles, level, RegionPhoto::Lossless).unwrap());
            }
            prop_assert_eq!(crate::container::decode(&file).unwrap().validate(), Ok(()));
            if level > 0 {
                let halved = |s: u32| (0..level).fold(s, |s, _| s.div_ceil(2));
                prop_assert_eq!((part.grid.width, part.grid.height), (halved(rect.w), halved(rect.h)));
                return Ok(());
            }
            prop_assert_eq!((part_photo, part.grid.width, part.grid.height), (crop(&photo, rect), rect.w, rect.h));
            prop_assert_eq!((part.intrinsics.cx, part.intrinsics.cy), (whole.intrinsics.cx - f64::from(rect.x), whole.intrinsics.cy - f64::from(rect.y)));
            for (i, tile) in (0..).zip(&part.tiles) {
                let (column, row) = (tiles.columns.start + i % part.grid.columns(), tiles.rows.start + i / part.grid.columns());
                prop_assert_eq!(tile, &whole.tiles[(row * grid.columns() + column) as usize]);
            }
        }
    }

    #[test]
    fn rectangles_outside_the_photo_have_no_tiles() {
        let grid = Grid::new(200, 100, 64);
        for (x, y, w, h) in
            [(0, 0, 0, 1), (0, 0, 1, 0), (199, 0, 2, 1), (0, 99, 1, 2), (200, 0, 1, 1), (u32::MAX, 0, 1, 1), (0, 0, u32::MAX, 1)]
        {
            assert_eq!(TileRect::over(&grid, Rect { x, y, w, h }), None);
        }
        let all = TileRect { columns: 0..grid.columns(), rows: 0..grid.rows() };
        assert_eq!(TileRect::over(&grid, Rect { x: 0, y: 0, w: 200, h: 100 }), Some(all));
        // inside an overlap, either tile would do
        assert_eq!(TileRect::over(&grid, Rect { x: 57, y: 0, w: 3, h: 9 }), Some(TileRect { columns: 1..2, rows: 0..1 }));
        let whole = bare_in(None, &scene(70, 40));
        for columns in [0..3, 1..1, 5..6] {
            assert!(region(&whole, &TileRect { columns, rows: 0..1 }, 0, RegionPhoto::Jpeg).is_err());
        }
    }
}
