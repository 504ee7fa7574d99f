//! Entry points into the container's codecs for the fuzz targets of `tmpi`.

use super::{ContainerError, bounds, columns, decode, labels, planes as coded};
use crate::Grid;

/// Sizes that the index declares.
pub struct Size {
    /// Number of pixels in the photo.
    pub pixels: u64,
    /// Maximum number of texels in all layers.
    pub texels: u64,
}

/// Reads the declared sizes from the index.
pub fn size(bytes: &[u8]) -> Result<Size, ContainerError> {
    let (index, grid) = decode::declared(bytes)?;
    let planes = u64::from(index.planes).min(u64::from(grid.tiles()) * columns::MAX_PLANES as u64).min(bounds::PLANES as u64);
    let tile = u64::from(grid.size.min(grid.width)) * u64::from(grid.size.min(grid.height));
    Ok(Size { pixels: u64::from(grid.width) * u64::from(grid.height), texels: planes * tile })
}

/// Decodes labels, then encodes and decodes them again.
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
    assert!(again.is_ok_and(|a| a == read), "encoded labels decode differently");
}

/// Decodes planes, and encodes them again.
pub fn planes(grid: &Grid, count: usize, data: &[u8]) {
    if let Ok(tiles) = columns::read(grid, count, data) {
        assert!(tiles.iter().flat_map(|t| t.planes.iter().chain(&t.background)).all(crate::Plane::is_finite));
        assert_eq!(columns::write(&tiles), data, "decoded planes encode differently");
    }
    let layout = coded::Layout::of(grid, count);
    // the same bytes as an entropy-coded stream
    if let Ok(raw) = coded::decode(&mut coded::Models::new(), layout, data) {
        assert!(columns::read(grid, count, &raw).is_ok(), "decoded planes cannot be parsed");
        let again = coded::encode(&mut coded::Models::new(), layout, &raw);
        let again = again.and_then(|data| coded::decode(&mut coded::Models::new(), layout, &data));
        assert!(again.is_ok_and(|a| a == raw), "encoded planes decode differently");
    }
}
