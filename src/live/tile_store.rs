//! The tiles of a room as encoded chunks. A chunk is kept while it has the newest version of any tile.

use std::collections::BTreeMap;

use bytes::Bytes;

use tmpi_core::Grid;
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::schema::{self, Chunk, Hello};
use tmpi_core::live::{MAX_MESSAGE, TileState, chunk, write};

/// Chunks by version and area, and for each tile the chunk with its newest version.
pub struct Chunks {
    grid: Grid,
    tiles: Vec<Option<Key>>,
    kept: BTreeMap<Key, (Chunk, u32)>,
    coded: Option<Bytes>,
}

/// Most bytes of newer chunks that are sent as they came: below the write buffer of a viewer.
const NEWER_BYTES: usize = 1 << 20;

/// Version, row, column, rows and columns.
type Key = (u64, u32, u32, u32, u32);

impl Chunks {
    /// Starts without chunks; `None` if `hello` is invalid.
    pub fn new(hello: &Hello) -> Option<Self> {
        let tiles = TileState::new(hello).ok()?.tiles();
        let grid = Grid { width: hello.width, height: hello.height, size: hello.tile_size, stride: hello.tile_stride };
        Some(Self { grid, tiles: vec![None; tiles as usize], kept: BTreeMap::new(), coded: None })
    }

    /// Takes the chunks of a message; false if one lies outside the grid.
    pub fn take(&mut self, message: &schema::Geometry) -> bool {
        self.coded = None;
        message.chunks.iter().all(|chunk| self.take_chunk(chunk))
    }

    fn take_chunk(&mut self, chunk: &Chunk) -> bool {
        let area = chunk::area(chunk);
        let within = |from: u32, count: u32, all: u32| count > 0 && from.checked_add(count).is_some_and(|end| end <= all);
        if !within(area.column, area.columns, self.grid.columns()) || !within(area.row, area.rows, self.grid.rows()) {
            return false;
        }
        let key = (chunk.version, area.row, area.column, area.rows, area.columns);
        if self.kept.contains_key(&key) {
            return true;
        }
        let mut newest = 0;
        for index in area.tiles(&self.grid) {
            let Some(tile) = self.tiles.get_mut(index as usize) else { continue };
            if tile.is_some_and(|known| known.0 >= chunk.version) {
                continue;
            }
            newest += 1;
            if let Some(before) = tile.replace(key)
                && let Some(counted) = self.kept.get_mut(&before)
            {
                counted.1 -= 1;
                if counted.1 == 0 {
                    self.kept.remove(&before);
                }
            }
        }
        if newest > 0 {
            self.kept.insert(key, (chunk.clone(), newest));
        }
        true
    }

    /// The version of the newest chunk: its frame.
    pub fn newest(&self) -> Option<u64> {
        self.kept.keys().next_back().map(|key| key.0)
    }

    /// Chunks with tiles newer than frame `known`, oldest first; `None` if a snapshot of all tiles would be shorter, because the chunks
    /// have more tiles than the grid or too many bytes.
    pub fn newer(&self, known: u64) -> Option<Vec<Chunk>> {
        let newer = || self.kept.iter().skip_while(|(key, _)| key.0 <= known);
        let tiles: usize = newer().map(|((.., rows, columns), _)| *rows as usize * *columns as usize).sum();
        let bytes: usize = newer().map(|(_, (chunk, _))| chunk.plane_data.len() + chunk.label_data.len()).sum();
        (tiles <= self.tiles.len() && bytes <= NEWER_BYTES).then(|| newer().map(|(_, (chunk, _))| chunk.clone()).collect())
    }

    /// SNAPSHOT of all chunks, oldest first; `None` without chunks, or if it would exceed [`MAX_MESSAGE`].
    pub fn snapshot(&mut self) -> Option<Bytes> {
        if self.coded.is_none() && !self.kept.is_empty() {
            let chunks = self.kept.values().map(|(chunk, _)| chunk.clone()).collect();
            let frame = self.newest().unwrap_or(0);
            self.coded = Some(write(Kind::Snapshot(schema::Geometry { frame, chunks })));
        }
        self.coded.clone().filter(|bytes| bytes.len() <= MAX_MESSAGE)
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use tmpi_core::live::chunk::Area;
    use tmpi_core::live::read;
    use tmpi_core::{Geometry, Intrinsics, Plane, Tile, ViewBox};

    pub fn geometry(depth: f64) -> Geometry {
        let grid = Grid { width: 160, height: 120, size: 64, stride: 56 };
        let intrinsics = Intrinsics { fx: 100.0, fy: 100.0, cx: 80.0, cy: 60.0 };
        let view_box = ViewBox { x: 0.03, y: 0.03, z: 0.03 };
        let plane = Plane { a: depth, b: 0.0, c: 0.0 };
        let pixels = |index| grid.rect(index).area();
        let tiles = (0..grid.tiles()).map(|i| Tile { planes: vec![plane], labels: vec![0; pixels(i)], background: None }).collect();
        Geometry { grid, intrinsics, view_box, tiles, matte_band: 0 }
    }

    pub fn message(geometry: &Geometry, area: Area, version: u64) -> schema::Geometry {
        let chunk = chunk::encode(&geometry.grid, area, &geometry.tiles, version).unwrap();
        schema::Geometry { frame: version, chunks: vec![chunk] }
    }

    #[test]
    fn a_snapshot_equals_all_messages_and_keeps_at_most_one_chunk_per_tile() {
        let (first, all) = (geometry(0.5), Area::all(&geometry(0.5).grid));
        let hello = TileState::hello(&first);
        let (mut chunks, mut model) = (Chunks::new(&hello).unwrap(), TileState::new(&hello).unwrap());
        assert_eq!(chunks.snapshot(), None);
        let mut send = |chunks: &mut Chunks, message: &schema::Geometry| {
            assert!(chunks.take(message));
            model.take(message).unwrap();
            let mut fresh = TileState::new(&hello).unwrap();
            let Kind::Snapshot(snapshot) = read(chunks.snapshot().unwrap()).unwrap() else { panic!("a snapshot") };
            fresh.take(&snapshot).unwrap();
            assert_eq!(fresh.geometry().unwrap().tiles, model.geometry().unwrap().tiles);
            snapshot.chunks.len()
        };
        assert_eq!(send(&mut chunks, &message(&first, all, 1)), 1);
        let one = |n: u32| Area { column: n % all.columns, row: n / all.columns % all.rows, columns: 1, rows: 1 };
        for version in 2..60 {
            let kept = send(&mut chunks, &message(&geometry(0.3 + 0.01 * version as f64), one(version as u32), version));
            assert!(kept <= first.grid.tiles() as usize, "{kept}");
        }
        // a late message changes nothing
        send(&mut chunks, &message(&geometry(0.9), all, 3));
        // all tiles of a version that one tile has already: the others are taken
        send(&mut chunks, &message(&geometry(0.3 + 0.01 * 59.0), all, 59));
        assert_eq!(send(&mut chunks, &message(&geometry(0.2), all, 60)), 1);
    }

    #[test]
    fn newer_chunks_are_sent_unchanged_unless_a_snapshot_is_smaller() {
        let first = geometry(0.5);
        let all = Area::all(&first.grid);
        let mut chunks = Chunks::new(&TileState::hello(&first)).unwrap();
        assert_eq!((chunks.newest(), chunks.newer(0)), (None, Some(vec![])));
        let sent: Vec<_> = (0..4).map(|n| message(&first, Area { column: n % 2, row: 0, columns: 1, rows: 1 }, 2 + u64::from(n))).collect();
        chunks.take(&message(&first, all, 1));
        assert!(sent.iter().all(|m| chunks.take(m)));
        assert_eq!((chunks.newest(), chunks.newer(5)), (Some(5), Some(vec![])));
        assert_eq!(chunks.newer(4).unwrap(), sent[3].chunks);
        assert_eq!(chunks.newer(1).unwrap(), [&sent[2].chunks[..], &sent[3].chunks].concat(), "replaced chunks are gone");
        assert_eq!(chunks.newer(0), None, "all tiles, and two once more");
    }

    #[test]
    fn chunks_outside_the_grid_are_refused() {
        let geometry = geometry(0.5);
        let mut chunks = Chunks::new(&TileState::hello(&geometry)).unwrap();
        let good = message(&geometry, Area::all(&geometry.grid), 1);
        for change in [
            (|c: &mut Chunk| c.columns += 1) as fn(&mut Chunk),
            |c| c.rows = 0,
            |c| c.column = u32::MAX,
            |c| (c.row, c.rows) = (u32::MAX, u32::MAX),
        ] {
            let mut bad = good.clone();
            change(&mut bad.chunks[0]);
            assert!(!chunks.take(&bad));
        }
        assert_eq!(chunks.snapshot(), None);
        assert!(Chunks::new(&Hello::default()).is_none());
    }
}
