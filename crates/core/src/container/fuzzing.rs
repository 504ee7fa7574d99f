//! Doors to what lies within a container, for [`crate::fuzzing`].

use super::{ContainerError, bounds, columns, decode, labels, planes as coded};
use crate::Grid;

/// What the index says that a container holds.
pub struct Size {
    /// Pixels of the photo.
    pub pixels: u64,
    /// Texels of all layers at most.
    pub texels: u64,
}

/// Size by the index alone.
pub fn size(bytes: &[u8]) -> Result<Size, ContainerError> {
    let (index, grid) = decode::declared(bytes)?;
    let planes = u64::from(index.planes).min(u64::from(grid.tiles()) * columns::MOST_PLANES as u64).min(bounds::PLANES as u64);
    let tile = u64::from(grid.size.min(grid.width)) * u64::from(grid.size.min(grid.height));
    Ok(Size { pixels: u64::from(grid.width) * u64::from(grid.height), texels: planes * tile })
}

/// A grid as photos have it.
#[must_use]
pub fn grid(width: u32, height: u32, size: u32) -> Grid {
    Grid::new(width, height, size)
}

/// Reads labels, and what is written of them.
pub fn labels(grid: &Grid, counts: &[u8], stream: &[u8]) {
    let Ok(read) = labels::decode(grid, counts, stream) else { return };
    let mut rest = read.as_slice();
    for (t, count) in (0..grid.tiles()).zip(counts) {
        let (own, after) = rest.split_at(grid.rect(t).area());
        assert!(own.iter().all(|l| l < count), "tile {t} has a label that is not below {count}");
        rest = after;
    }
    assert!(rest.is_empty());
    let again = labels::decode(grid, counts, &labels::encode(grid, counts, &read));
    assert!(again.is_ok_and(|a| a == read), "labels that were written are not read");
}

/// Reads planes, and writes them again.
pub fn planes(grid: &Grid, count: usize, data: &[u8]) {
    if let Ok(tiles) = columns::read(grid, count, data) {
        assert!(tiles.iter().flat_map(|t| t.planes.iter().chain(&t.background)).all(crate::Plane::is_finite));
        assert_eq!(columns::write(&tiles), data, "planes that were read are written otherwise");
    }
    let layout = coded::Layout::of(grid, count);
    // the same bytes as a stream
    if let Ok(raw) = coded::decode(layout, data) {
        assert!(columns::read(grid, count, &raw).is_ok(), "planes that were decoded cannot be read");
        let again = coded::encode(layout, &raw).and_then(|data| coded::decode(layout, &data));
        assert!(again.is_ok_and(|a| a == raw), "planes that were coded are decoded otherwise");
    }
}
