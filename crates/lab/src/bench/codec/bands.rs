//! How many pixels a band of labels should have: bytes, and time of reading, over sizes of bands.

use serde::Serialize;

use super::candidates::Source;
use super::timed;
use crate::bench::BenchError;
use tmpi_core::container;

/// Pixels of a band that are compared; none for one stream.
const PIXELS: [Option<u64>; 7] = [None, Some(4_000_000), Some(2_000_000), Some(1_000_000), Some(500_000), Some(250_000), Some(125_000)];

/// A container with labels in bands of one size.
#[derive(Clone, Debug, Serialize)]
pub struct BandRow {
    /// Pixels that a band was to have at least.
    pub pixels: Option<u64>,
    /// Bands that came of it.
    pub bands: usize,
    /// Bytes of the whole container.
    pub bytes: usize,
    /// Wall milliseconds of reading planes and labels, on all processors.
    pub read_ms: f64,
    /// Processor milliseconds of the same.
    pub read_cpu_ms: f64,
}

/// Measures all sizes that differ on this scene.
pub fn compare(source: &Source, repeats: usize) -> Result<Vec<BandRow>, BenchError> {
    let grid = &source.geometry.grid;
    let mut all: Vec<BandRow> = Vec::new();
    for pixels in PIXELS {
        let rows = pixels.and_then(|p| container::rows_for(grid, p));
        let bands = rows.map_or(1, |r| grid.rows().div_ceil(r) as usize);
        if all.iter().any(|r| r.bands == bands) {
            continue;
        }
        let bytes = source.container_in(rows)?;
        let ((read_ms, read_cpu_ms), _) = timed(repeats, || Ok(container::read_geometry(&bytes)?))?;
        all.push(BandRow { pixels, bands, bytes: bytes.len(), read_ms, read_cpu_ms });
    }
    Ok(all)
}
