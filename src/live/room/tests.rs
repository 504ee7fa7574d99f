use std::collections::BTreeSet;

use tmpi_core::live::chunk::{self, Area};
use tmpi_core::live::{Model, read};
use tmpi_core::{Geometry, Photo};

use super::*;
use crate::live::nodes::{geometry, message};

const EPOCH: u64 = 7;

/// A room as its publisher's socket and its worker see it.
struct Made {
    room: Room,
    tiles: Geometry,
    frame: u64,
}

impl Made {
    fn new() -> Self {
        let (room, tiles) = (Room::new(Bounds::default()), geometry(0.5));
        assert_eq!(room.publish(Model::hello(&tiles), 0, EPOCH), EPOCH);
        let mut made = Self { room, tiles, frame: 0 };
        made.next(true, 10, Some(Area::all(&made.tiles.grid)));
        made
    }

    /// A frame of so many bytes, in which the tiles of an area changed.
    fn next(&mut self, key: bool, bytes: usize, changed: Option<Area>) {
        self.frame += 1;
        self.room.push(EPOCH, if key { What::Key } else { What::Frame { layer: 0 } }, vec![0; bytes].into());
        // as it is coded, to the bit
        let depth = 0.125 + self.frame as f64 / 64.0;
        for tile in changed.into_iter().flat_map(|area| area.tiles(&self.tiles.grid)) {
            self.tiles.tiles[tile as usize] = geometry(depth).tiles[tile as usize].clone();
        }
        let photo = Photo { width: 1, height: 1, rgb: vec![[0; 3]] };
        self.room.keep(EPOCH, Still::new(self.frame, photo, self.tiles.clone()), |_| {});
        if let Some(area) = changed {
            self.room.push_tiles(EPOCH, message(&self.tiles, area, self.frame));
        }
    }

    fn one(&self, tile: u32) -> Area {
        let columns = self.tiles.grid.columns();
        Area { column: tile % columns, row: tile / columns, columns: 1, rows: 1 }
    }
}

/// Someone who watches.
struct Reader {
    viewer: Viewer,
    model: Model,
    frames: usize,
}

impl Reader {
    fn new(made: &Made) -> Self {
        let mut reader = Self { viewer: made.room.join().unwrap(), model: Model::new(&Model::hello(&made.tiles)).unwrap(), frames: 0 };
        reader.read(&made.room);
        reader
    }

    /// Takes a message; the tiles that it holds.
    fn take(&mut self, bytes: Bytes) -> BTreeSet<u32> {
        let (Kind::Geometry(tiles) | Kind::Snapshot(tiles)) = read(bytes).unwrap() else { panic!("tiles") };
        let grid = geometry(0.5).grid;
        let held = tiles.chunks.iter().flat_map(|c| chunk::area(c).tiles(&grid).collect::<Vec<_>>()).collect();
        self.model.take(&tiles).unwrap();
        held
    }

    /// Reads all that is there; the tiles that it was sent for what it was not, each time.
    fn read(&mut self, room: &Room) -> Vec<BTreeSet<u32>> {
        let mut told = Vec::new();
        loop {
            match room.next(&mut self.viewer) {
                // frames are no messages here
                Next::Send(bytes) if read(bytes.clone()).is_ok_and(|kind| matches!(kind, Kind::Geometry(_))) => drop(self.take(bytes)),
                Next::Send(_) => self.frames += 1,
                Next::Hello(_) | Next::Tiles => {
                    let sent = room.tiles(&mut self.viewer).map(|bytes| self.take(bytes.unwrap()));
                    told.push(sent.unwrap_or_default());
                }
                Next::Wait => return told,
                Next::Closed => panic!("the room is closed"),
            }
        }
    }
}

#[test]
fn after_a_skip_come_the_tiles_that_changed_since_and_all_is_known_as_to_one_who_comes_then() {
    let mut made = Made::new();
    let mut slow = Reader::new(&made);
    assert!(slow.model.geometry().is_some(), "who comes is sent all tiles");
    made.next(false, 10, Some(made.one(1)));
    assert_eq!(slow.read(&made.room), [] as [BTreeSet<u32>; 0]);
    // it does not read for a mebibyte, in which two tiles change, one of them twice
    for changed in [Some(4), None, Some(2), None, Some(4)] {
        made.next(false, 300_000, changed.map(|tile| made.one(tile)));
    }
    made.next(true, 10, None);
    made.next(false, 10, None);
    let frames = slow.frames;
    assert_eq!(slow.read(&made.room), [BTreeSet::from([2, 4])]);
    assert_eq!(slow.frames, frames + 2, "it goes on with the key frame");
    let fresh = Reader::new(&made);
    assert_eq!(fresh.model.geometry().unwrap().tiles, made.tiles.tiles);
    assert_eq!(slow.model.geometry().unwrap().tiles, made.tiles.tiles);
}

#[test]
fn a_skip_in_which_no_tile_changed_sends_none_and_one_over_a_cut_sends_all_once() {
    let mut made = Made::new();
    let mut slow = Reader::new(&made);
    for _ in 0..5 {
        made.next(false, 300_000, None);
    }
    made.next(true, 10, None);
    assert_eq!(slow.read(&made.room), [BTreeSet::new()]);
    // all tiles change, then all again: what is sent is no longer than all of them
    let all = Area::all(&made.tiles.grid);
    for changed in [Some(all), Some(made.one(3)), Some(all), Some(made.one(5)), None] {
        made.next(false, 300_000, changed);
    }
    made.next(true, 10, None);
    let mut other = Reader::new(&made);
    assert_eq!(slow.read(&made.room), [(0..made.tiles.grid.tiles()).collect()]);
    assert_eq!(other.read(&made.room), [] as [BTreeSet<u32>; 0]);
    assert_eq!(slow.model.geometry().unwrap().tiles, made.tiles.tiles);
}

#[test]
fn another_publisher_begins_with_all_tiles_whatever_was_known_of_the_last_one() {
    let mut made = Made::new();
    let mut viewer = Reader::new(&made);
    let all: BTreeSet<u32> = (0..made.tiles.grid.tiles()).collect();
    made.room.unpublish();
    assert_eq!(made.room.publish(Model::hello(&made.tiles), 0, 0), EPOCH + 1);
    made.room.push(EPOCH + 1, What::Key, vec![0; 10].into());
    let photo = Photo { width: 1, height: 1, rgb: vec![[0; 3]] };
    made.room.keep(EPOCH + 1, Still::new(0, photo, made.tiles.clone()), |_| {});
    made.frame = 0;
    assert_eq!(viewer.read(&made.room), [all]);
}
