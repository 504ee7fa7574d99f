//! The section of planes before entropy coding: a count per tile, then columns of 16-bit values, all low bytes before all high bytes.

use super::ContainerError;
use crate::{Grid, Plane, Tile};

/// Flag in a tile's count: the last plane is a background plane.
pub const BACKGROUND: u8 = 0x80;
/// Maximum number of labelled planes per tile.
const MAX_LABELLED: u8 = 64;
/// Maximum number of planes per tile, including the background plane.
pub const MAX_PLANES: usize = MAX_LABELLED as usize + 1;
/// Number of columns: a, b, c.
const COLUMNS: usize = 3;

/// Length of the section in bytes.
pub fn bytes(tiles: usize, planes: usize) -> usize {
    tiles + planes * COLUMNS * 2
}

/// Number of planes from the count byte of a tile.
pub fn planes_of(count: u8) -> usize {
    usize::from(count & !BACKGROUND) + usize::from(count >> 7)
}

/// Planes of a tile in the order of the section.
fn planes(tile: &Tile) -> impl Iterator<Item = &Plane> {
    tile.planes.iter().chain(&tile.background)
}

/// Encodes the planes of all tiles.
pub fn write(tiles: &[Tile]) -> Vec<u8> {
    let mut out: Vec<u8> = tiles.iter().map(|t| t.planes.len() as u8 | if t.background.is_some() { BACKGROUND } else { 0 }).collect();
    for column in [|p: &Plane| p.a, |p: &Plane| p.b, |p: &Plane| p.c] {
        let values: Vec<[u8; 2]> = tiles.iter().flat_map(planes).map(|p| Plane::to_grid(column(p)).to_le_bytes()).collect();
        out.extend(values.iter().map(|v| v[0]));
        out.extend(values.iter().map(|v| v[1]));
    }
    out
}

/// Decodes the planes of all tiles of a grid, `count` in total; leaves the labels empty.
pub fn read(grid: &Grid, count: usize, data: &[u8]) -> Result<Vec<Tile>, ContainerError> {
    let tiles = grid.tiles() as usize;
    if data.len() != bytes(tiles, count) {
        return Err(ContainerError::broken("planes: wrong length"));
    }
    let (counts, columns) = data.split_at(tiles);
    let total: usize = counts.iter().map(|&c| planes_of(c)).sum();
    if total != count || counts.iter().any(|c| !(1..=MAX_LABELLED).contains(&(c & !BACKGROUND))) {
        return Err(ContainerError::broken("planes: wrong count in a tile"));
    }
    let value = |column: usize, i: usize| {
        let at = column * count * 2 + i;
        f64::from(i16::from_le_bytes([columns[at], columns[at + count]])) * Plane::STEP
    };
    let mut all = (0..count).map(|i| Plane { a: value(0, i), b: value(1, i), c: value(2, i) });
    Ok(counts
        .iter()
        .map(|c| Tile {
            planes: all.by_ref().take(usize::from(c & !BACKGROUND)).collect(),
            labels: Vec::new(),
            background: if c & BACKGROUND == 0 { None } else { all.next() },
        })
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A section of two tiles with these count bytes, and of `count` planes.
    fn section(counts: [u8; 2], count: usize) -> Vec<u8> {
        [counts.to_vec(), vec![0; count * COLUMNS * 2]].concat()
    }

    #[test]
    fn counts_add_up_to_the_planes_and_each_is_in_range() {
        let grid = Grid { width: 16, height: 8, size: 8, stride: 8 };
        let read = |counts, count| read(&grid, count, &section(counts, count));
        assert_eq!(read([1, 2 | BACKGROUND], 4).unwrap().iter().map(|t| t.planes.len()).collect::<Vec<_>>(), [1, 2]);
        assert!(read([MAX_LABELLED, MAX_LABELLED | BACKGROUND], 2 * MAX_LABELLED as usize + 1).is_ok());
        // each count is in range, but the total is not
        assert!(read([1, 2], 4).is_err() && read([1, 2], 2).is_err());
        // the total is right, but one count is out of range
        assert!(
            read([0, 2], 2).is_err()
                && read([BACKGROUND, 2], 3).is_err()
                && read([MAX_LABELLED + 1, 1], MAX_LABELLED as usize + 2).is_err()
        );
        assert!(super::read(&grid, 2, &section([1, 1], 3)).is_err());
    }
}
