//! Chunks: planes and labels of a rectangle of tiles, coded like a small picture by the coders of the container's sections, which start
//! from a trained prior ([`super::coder_prior`]).

use super::coder_prior::Coders;
use super::schema::Chunk;
use super::{LiveError, MAX_PLANES};
use crate::container::{columns, crc, labels, planes};
use crate::{Grid, Tile};

/// A rectangle of tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Area {
    /// First column.
    pub column: u32,
    /// First row.
    pub row: u32,
    /// Number of columns, at least 1.
    pub columns: u32,
    /// Number of rows, at least 1.
    pub rows: u32,
}

impl Area {
    /// All tiles of a grid.
    pub fn all(grid: &Grid) -> Self {
        Self { column: 0, row: 0, columns: grid.columns(), rows: grid.rows() }
    }

    /// Rectangles that cover exactly the tiles for which `wanted` is true: runs within a row, merged with runs of the same columns in
    /// adjacent rows.
    pub fn covering(grid: &Grid, wanted: impl Fn(u32) -> bool) -> Vec<Self> {
        let (mut areas, columns) = (Vec::<Self>::new(), grid.columns());
        for row in 0..grid.rows() {
            let mut column = 0;
            while column < columns {
                let run = (column..columns).take_while(|c| wanted(row * columns + c)).count() as u32;
                if run > 0 {
                    let above = areas.iter_mut().find(|a| a.column == column && a.columns == run && a.row + a.rows == row);
                    match above {
                        Some(area) => area.rows += 1,
                        None => areas.push(Self { column, row, columns: run, rows: 1 }),
                    }
                }
                column += run + 1;
            }
        }
        areas
    }

    /// Indices of its tiles, row by row.
    pub fn tiles(self, grid: &Grid) -> impl Iterator<Item = u32> {
        let across = grid.columns();
        (self.row..self.row + self.rows).flat_map(move |row| (self.column..self.column + self.columns).map(move |c| row * across + c))
    }

    /// The rectangle as a grid of its own; `None` if it is not within `grid`.
    fn part(self, grid: &Grid) -> Option<Grid> {
        let ends = |from: u32, count: u32, all: u32| count > 0 && from.checked_add(count).is_some_and(|end| end <= all);
        let inside = ends(self.column, self.columns, grid.columns()) && ends(self.row, self.rows, grid.rows());
        inside.then(|| grid.part(self.column..self.column + self.columns, self.row..self.row + self.rows).1)
    }
}

/// The rectangle of tiles that a chunk covers.
pub fn area(chunk: &Chunk) -> Area {
    Area { column: chunk.column, row: chunk.row, columns: chunk.columns, rows: chunk.rows }
}

/// Encodes the tiles of an area, as of frame `version`; `tiles` has all tiles of the grid.
///
/// # Errors
/// [`LiveError::Broken`] if the area is not within the grid, `tiles` does not match the grid, or a tile has no planes, more than
/// [`MAX_PLANES`], or a wrong number of labels.
pub fn encode(grid: &Grid, area: Area, tiles: &[Tile], version: u64) -> Result<Chunk, LiveError> {
    let (planes, plane_data, label_data) = streams(&mut Coders::learned(), grid, area, tiles)?;
    let Area { column, row, columns, rows } = area;
    let (plane_data, label_data) = (plane_data.into(), label_data.into());
    let mut chunk = Chunk { column, row, columns, rows, version, planes, check: 0, plane_data, label_data };
    chunk.check = check(&chunk);
    Ok(chunk)
}

/// Number of planes, and the coded streams of planes and labels.
pub(super) fn streams(coders: &mut Coders, grid: &Grid, area: Area, tiles: &[Tile]) -> Result<(u32, Vec<u8>, Vec<u8>), LiveError> {
    let part = area.part(grid).ok_or_else(|| LiveError::broken("a chunk lies outside the grid"))?;
    if tiles.len() != grid.tiles() as usize {
        return Err(LiveError::broken("the number of tiles does not match the grid"));
    }
    let own: Vec<Tile> = area.tiles(grid).map(|t| tiles[t as usize].clone()).collect();
    let fits = |(i, t): (u32, &Tile)| (1..=MAX_PLANES).contains(&t.planes.len()) && t.labels.len() == part.rect(i).area();
    if !(0..).zip(&own).all(fits) {
        return Err(LiveError::broken(format!("a tile has no planes, more than {MAX_PLANES}, or a wrong number of labels")));
    }
    let planes = own.iter().map(|t| t.planes.len() + usize::from(t.background.is_some())).sum();
    let plane_data = planes::encode(&mut coders.planes, planes::Layout::of(&part, planes), &columns::write(&own))?;
    let counts: Vec<u8> = own.iter().map(|t| t.planes.len() as u8).collect();
    let all: Vec<u8> = own.iter().flat_map(|t| &t.labels).copied().collect();
    let label_data = labels::encode_by(&mut coders.labels, &part, &counts, &all);
    Ok((planes as u32, plane_data, label_data))
}

/// Decodes the tiles of a chunk, with their indices in the grid.
///
/// # Errors
/// [`LiveError`] if the chunk is damaged or not within the grid, or a tile has more than [`MAX_PLANES`] planes.
pub fn decode(grid: &Grid, chunk: &Chunk) -> Result<Vec<(u32, Tile)>, LiveError> {
    let area = area(chunk);
    let part = area.part(grid).ok_or_else(|| LiveError::broken("a chunk lies outside the grid"))?;
    if chunk.check != check(chunk) {
        return Err(LiveError::broken("a chunk is damaged"));
    }
    let (planes, tiles) = (chunk.planes as usize, part.tiles() as usize);
    if !(tiles..=tiles * (MAX_PLANES + 1)).contains(&planes) {
        return Err(LiveError::broken(format!("{planes} planes in {tiles} tiles")));
    }
    let mut coders = Coders::learned();
    let raw = planes::decode(&mut coders.planes, planes::Layout::of(&part, planes), &chunk.plane_data)?;
    let mut own = columns::read(&part, planes, &raw)?;
    if own.iter().any(|t| t.planes.len() > MAX_PLANES) {
        return Err(LiveError::broken(format!("a tile has more than {MAX_PLANES} planes")));
    }
    let counts: Vec<u8> = own.iter().map(|t| t.planes.len() as u8).collect();
    let mut all = vec![0; part.tile_pixels()];
    labels::decode_by(&mut coders.labels, &part, &counts, &chunk.label_data, &mut all)?;
    let mut rest = all.as_slice();
    for (i, t) in (0..).zip(&mut own) {
        t.labels = rest.split_off(..part.rect(i).area()).unwrap_or_default().to_vec();
    }
    Ok(area.tiles(grid).zip(own).collect())
}

/// The checksum over all other fields of a chunk.
fn check(c: &Chunk) -> u32 {
    let Area { column, row, columns, rows } = area(c);
    let head = [column.into(), row.into(), columns.into(), rows.into(), c.version, c.planes.into()].map(u64::to_le_bytes);
    crc::crc32(&[head.as_flattened(), &c.plane_data, &c.label_data].concat())
}
