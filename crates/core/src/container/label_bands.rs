//! Labels of large photos: bands of whole rows of tiles. Each band is a stream with its own models, so bands can be decoded in parallel.

use std::ops::Range;

use super::crc::crc32;
use super::schema::Band;
use super::{ContainerError, labels};
use crate::parallel;
use crate::scene::Grid;

/// Minimum number of pixels per band: smaller bands cost bytes, because each trains its own models; larger ones leave processors idle. A
/// photo with less than twice as many stays a single stream.
#[cfg(feature = "write")]
const PIXELS: u64 = 1_000_000;

/// Rows of tiles per band for a photo of this grid; `None` for a single stream.
#[cfg(feature = "write")]
pub fn rows(grid: &Grid) -> Option<u32> {
    band_rows(grid, PIXELS)
}

/// Rows of tiles per band for bands of about equal size and at least `pixels` pixels; `None` for a single stream.
pub fn band_rows(grid: &Grid, pixels: u64) -> Option<u32> {
    let most = u64::from(grid.width) * u64::from(grid.height) / pixels.max(1);
    let bands = most.min(u64::from(grid.rows())) as u32;
    (bands > 1).then(|| grid.rows().div_ceil(bands))
}

/// One band of a section.
struct Part<'a> {
    grid: Grid,
    counts: &'a [u8],
    /// Number of pixels in its tiles.
    labels: usize,
}

/// Cuts a grid into bands with these numbers of rows, which add up to the grid's.
fn parts<'a>(grid: &Grid, counts: &'a [u8], rows: impl Iterator<Item = u32>) -> Vec<Part<'a>> {
    let columns = grid.columns();
    let cut = rows.scan(0, |first, rows| {
        let from = std::mem::replace(first, *first + rows);
        let (_, part) = grid.part(0..columns, from..*first);
        let counts = &counts[(from * columns) as usize..(*first * columns) as usize];
        Some(Part { grid: part, counts, labels: part.tile_pixels() })
    });
    cut.collect()
}

/// Encodes the labels of all tiles, in the order of [`labels::encode`], in bands of `rows` rows of tiles, at least 1.
#[cfg(feature = "write")]
pub fn encode(grid: &Grid, counts: &[u8], all: &[u8], rows: u32) -> (Vec<u8>, Vec<Band>) {
    let each = (0..grid.rows()).step_by(rows.max(1) as usize).map(|first| rows.max(1).min(grid.rows() - first));
    let mut rest = all;
    let mut work = Vec::new();
    for part in parts(grid, counts, each) {
        let own = rest.split_off(..part.labels).unwrap_or_default();
        work.push((part, own));
    }
    let streams: Vec<Vec<u8>> = parallel::map_init(work.len(), || (), |(), i| labels::encode(&work[i].0.grid, work[i].0.counts, work[i].1));
    let band = |(part, data): (&Part, &Vec<u8>)| Band { rows: part.grid.rows(), length: data.len() as u32, check: crc32(data) };
    let bands = work.iter().map(|(part, _)| part).zip(&streams).map(band).collect();
    (streams.concat(), bands)
}

/// Decodes the labels of all tiles, in the order of [`labels::decode`]. Labels of bands without a row in `wanted` stay 0.
pub fn decode(grid: &Grid, counts: &[u8], bands: &[Band], data: &[u8], wanted: &Range<u32>) -> Result<Vec<u8>, ContainerError> {
    let sum = |of: fn(&Band) -> u32| bands.iter().map(|b| u64::from(of(b))).sum::<u64>();
    if bands.iter().any(|b| b.rows == 0) || sum(|b| b.rows) != u64::from(grid.rows()) || counts.len() != grid.tiles() as usize {
        return Err(ContainerError::broken("labels: the bands do not match the grid's rows of tiles"));
    }
    if sum(|b| b.length) != data.len() as u64 {
        return Err(ContainerError::broken("labels: the lengths of the bands do not add up to the section"));
    }
    let parts = parts(grid, counts, bands.iter().map(|b| b.rows));
    let mut labels = vec![0; parts.iter().map(|p| p.labels).sum()];
    let (mut room, mut rest) = (labels.as_mut_slice(), data);
    let (mut work, mut row) = (Vec::with_capacity(bands.len()), 0);
    for (i, (part, band)) in parts.iter().zip(bands).enumerate() {
        let own = room.split_off_mut(..part.labels).unwrap_or_default();
        let data = rest.split_off(..band.length as usize).unwrap_or_default();
        let first = row;
        row += band.rows;
        if first < wanted.end && wanted.start < row {
            work.push((i, part, band, own, data));
        }
    }
    parallel::try_each(work, |(i, part, band, own, data)| {
        if crc32(data) != band.check {
            return Err(ContainerError::broken(format!("labels: band {} of {} is damaged", i + 1, bands.len())));
        }
        labels::decode_by(&mut labels::Models::new(), &part.grid, part.counts, data, own)
    })?;
    Ok(labels)
}

#[cfg(test)]
mod tests {
    use super::super::labels::testing::maps;
    use super::*;
    use proptest::prelude::*;

    const ALL: Range<u32> = 0..u32::MAX;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]

        #[test]
        fn labels_round_trip_in_bands(w in 1u32..150, h in 1u32..150, size in 8u32..70, seed in 0u32..100, rows in 1u32..6) {
            let grid = Grid::new(w, h, size);
            let (counts, labels) = maps(&grid, seed);
            let (data, bands) = encode(&grid, &counts, &labels, rows);
            prop_assert_eq!(bands.len(), grid.rows().div_ceil(rows) as usize);
            prop_assert_eq!(decode(&grid, &counts, &bands, &data, &ALL).unwrap(), labels);
        }

        #[test]
        fn an_error_names_the_damaged_band(seed in 0u32..100, at in any::<u16>(), flip in 1u8..) {
            let grid = Grid::new(130, 200, 32);
            let (counts, labels) = maps(&grid, seed);
            let (mut data, bands) = encode(&grid, &counts, &labels, 2);
            let at = usize::from(at) % data.len();
            data[at] ^= flip;
            let ends = bands.iter().scan(0, |end, b| { *end += b.length as usize; Some(*end) });
            let number = 1 + ends.take_while(|end| *end <= at).count();
            let error = decode(&grid, &counts, &bands, &data, &ALL).unwrap_err().to_string();
            prop_assert!(error.contains(&format!("band {number} of {}", bands.len())), "{error}");
        }

        #[test]
        fn unwanted_bands_are_not_decoded(seed in 0u32..100, first in 0u32..8, count in 1u32..4) {
            let grid = Grid::new(130, 200, 32);
            let (counts, labels) = maps(&grid, seed);
            let (mut data, bands) = encode(&grid, &counts, &labels, 2);
            let wanted = first.min(grid.rows() - 1)..(first + count).min(grid.rows());
            let touched = |b: usize| (2 * b as u32) < wanted.end && wanted.start < 2 * b as u32 + 2;
            let ends: Vec<usize> = bands.iter().scan(0, |end, b| { *end += b.length as usize; Some(*end) }).collect();
            for b in (0..bands.len()).filter(|b| !touched(*b)) {
                data[ends[b] - 1] ^= 1;
            }
            let read = decode(&grid, &counts, &bands, &data, &wanted).unwrap();
            let mut at = 0;
            for t in 0..grid.tiles() {
                let own = at..at + grid.rect(t).area();
                at = own.end;
                if touched((t / grid.columns() / 2) as usize) {
                    prop_assert_eq!(&read[own.clone()], &labels[own]);
                } else {
                    prop_assert!(read[own].iter().all(|l| *l == 0));
                }
            }
        }

        #[test]
        fn inconsistent_bands_are_rejected(rows in prop::collection::vec(0u32..5, 0..6), lengths in prop::collection::vec(any::<u32>(), 6)) {
            let grid = Grid::new(130, 200, 32);
            let (counts, labels) = maps(&grid, 3);
            let (data, good) = encode(&grid, &counts, &labels, 2);
            let bands: Vec<Band> = rows.iter().zip(&lengths).map(|(&rows, &length)| Band { rows, length, check: 0 }).collect();
            prop_assert!(decode(&grid, &counts, &bands, &data, &ALL).is_err());
            for cut in 0..good.len() {
                prop_assert!(decode(&grid, &counts, &good[..cut], &data, &ALL).is_err());
            }
            prop_assert!(decode(&grid, &counts, &good, &data[..data.len() - 1], &ALL).is_err());
        }
    }

    #[test]
    fn small_photos_and_single_tiles_stay_one_stream() {
        assert_eq!(rows(&Grid::new(630, 350, 64)), None);
        assert_eq!(rows(&Grid::full(8000, 6000)), None);
        let large = Grid::new(4032, 3024, 64);
        let each = rows(&large).unwrap();
        assert!(each > 1 && each < large.rows());
    }
}
