use std::collections::BTreeSet;

use futures_util::FutureExt as _;
use tmpi_core::live::chunk::{self, Area};
use tmpi_core::live::{TileState, read};
use tmpi_core::{Geometry, Photo};

use super::*;
use crate::live::tile_store::tests::{geometry, message};

pub const EPOCH: u64 = 7;

/// A room with a publisher and a worker.
pub struct Made {
    pub room: Room,
    pub tiles: Geometry,
    frame: u64,
}

impl Made {
    pub fn new() -> Self {
        let (room, tiles) = (Room::new(RoomLimits::default()), geometry(0.5));
        assert_eq!(room.publish(TileState::hello(&tiles), 0, EPOCH), EPOCH);
        let mut made = Self { room, tiles, frame: 0 };
        made.next(true, 10, Some(Area::all(&made.tiles.grid)));
        made
    }

    /// Pushes a frame of this many bytes, with the changed tiles of an area.
    pub fn next(&mut self, key: bool, bytes: usize, changed: Option<Area>) {
        self.frame += 1;
        let video = schema::Video { frame: self.frame, key, data: vec![0; bytes].into(), ..schema::Video::default() };
        self.room.push(EPOCH, if key { MessageKind::Key } else { MessageKind::Frame { layer: 0 } }, write(Kind::Video(video)));
        // exactly representable when encoded
        let depth = 0.125 + self.frame as f64 / 64.0;
        for tile in changed.into_iter().flat_map(|area| area.tiles(&self.tiles.grid)) {
            self.tiles.tiles[tile as usize] = geometry(depth).tiles[tile as usize].clone();
        }
        let photo = Photo { width: 1, height: 1, rgb: vec![[0; 3]] };
        self.room.set_newest_frame(EPOCH, FrameWithTiles::new(self.frame, photo, self.tiles.clone()), |_| {});
        if let Some(area) = changed {
            self.room.push_tiles(EPOCH, message(&self.tiles, area, self.frame));
        }
    }

    pub fn one(&self, tile: u32) -> Area {
        let columns = self.tiles.grid.columns();
        Area { column: tile % columns, row: tile / columns, columns: 1, rows: 1 }
    }
}

pub struct Watcher {
    viewer: Viewer,
    pub model: TileState,
    frames: usize,
    /// Tiles of each GEOMETRY message of the room.
    pub given: Vec<BTreeSet<u32>>,
}

impl Watcher {
    fn new(made: &Made) -> Self {
        Self::at(&made.room, &made.tiles)
    }

    /// Joins a room with such tiles.
    pub fn at(room: &Room, tiles: &Geometry) -> Self {
        let model = TileState::new(&TileState::hello(tiles)).unwrap();
        let mut watcher = Self { viewer: room.join(ViewerKind::Local).unwrap(), model, frames: 0, given: Vec::new() };
        watcher.read(room);
        watcher
    }

    pub fn held(tiles: &schema::Geometry) -> BTreeSet<u32> {
        let grid = geometry(0.5).grid;
        tiles.chunks.iter().flat_map(|c| chunk::area(c).tiles(&grid).collect::<Vec<_>>()).collect()
    }

    /// Takes a message and returns its tiles.
    fn take(&mut self, bytes: Bytes) -> BTreeSet<u32> {
        let (Kind::Geometry(tiles) | Kind::Snapshot(tiles)) = read(bytes).unwrap() else { panic!("tiles") };
        self.model.take(&tiles).unwrap();
        Self::held(&tiles)
    }

    /// Reads all messages; returns the tiles that it got after each HELLO or skip.
    pub fn read(&mut self, room: &Room) -> Vec<BTreeSet<u32>> {
        let mut told = Vec::new();
        loop {
            match room.next(&mut self.viewer) {
                NextStep::Send(bytes) if matches!(read(bytes.clone()), Ok(Kind::Geometry(_) | Kind::Snapshot(_))) => {
                    let tiles = self.take(bytes);
                    self.given.push(tiles);
                }
                NextStep::Send(_) => self.frames += 1,
                NextStep::Hello(_) | NextStep::Tiles => {
                    let sent = room.tiles(&mut self.viewer).map(|bytes| self.take(bytes));
                    told.push(sent.unwrap_or_default());
                }
                NextStep::Wait => return told,
                NextStep::Closed => panic!("the room is closed"),
            }
        }
    }
}

#[test]
fn after_a_skip_a_viewer_gets_the_changed_tiles() {
    let mut made = Made::new();
    let mut slow = Watcher::new(&made);
    assert!(slow.model.geometry().is_some(), "a new viewer gets all tiles");
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
    let fresh = Watcher::new(&made);
    assert_eq!(fresh.model.geometry().unwrap().tiles, made.tiles.tiles);
    assert_eq!(slow.model.geometry().unwrap().tiles, made.tiles.tiles);
}

#[test]
fn a_skip_sends_only_changed_tiles_and_a_cut_sends_all_once() {
    let mut made = Made::new();
    let mut slow = Watcher::new(&made);
    for _ in 0..5 {
        made.next(false, 300_000, None);
    }
    made.next(true, 10, None);
    assert_eq!(slow.read(&made.room), [BTreeSet::new()]);
    // all tiles change, then all again: the viewer gets each once
    let all = Area::all(&made.tiles.grid);
    for changed in [Some(all), Some(made.one(3)), Some(all), Some(made.one(5)), None] {
        made.next(false, 300_000, changed);
    }
    made.next(true, 10, None);
    let mut other = Watcher::new(&made);
    assert_eq!(slow.read(&made.room), [(0..made.tiles.grid.tiles()).collect()]);
    assert_eq!(other.read(&made.room), [] as [BTreeSet<u32>; 0]);
    assert_eq!(slow.model.geometry().unwrap().tiles, made.tiles.tiles);
}

#[test]
fn another_publisher_begins_with_all_its_tiles() {
    let mut made = Made::new();
    let mut viewer = Watcher::new(&made);
    let mut late = made.room.join(ViewerKind::Local).unwrap();
    assert!(matches!(made.room.next(&mut late), NextStep::Hello(hello) if hello.epoch == EPOCH));
    made.room.unpublish();
    made.tiles = geometry(0.25);
    assert_eq!(made.room.publish(TileState::hello(&made.tiles), 0, 0), EPOCH + 1);
    made.room.push(EPOCH + 1, MessageKind::Key, vec![0; 10].into());
    let photo = Photo { width: 1, height: 1, rgb: vec![[0; 3]] };
    made.room.set_newest_frame(EPOCH + 1, FrameWithTiles::new(0, photo, made.tiles.clone()), |_| {});
    assert!(made.room.tiles(&mut late).is_none(), "not after the HELLO of the last one");
    assert!(matches!(made.room.next(&mut late), NextStep::Hello(hello) if hello.epoch == EPOCH + 1));
    assert!(made.room.tiles(&mut late).is_some());
    assert_eq!(viewer.read(&made.room), [(0..made.tiles.grid.tiles()).collect()]);
}

#[test]
fn tiles_sent_before_the_first_whole_frame_reach_new_viewers() {
    let (room, tiles) = (Room::new(RoomLimits::default()), geometry(0.5));
    room.publish(TileState::hello(&tiles), 0, EPOCH);
    let mut made = Made { room, tiles, frame: 9 };
    let columns = Area { columns: 1, ..Area::all(&made.tiles.grid) };
    for column in 0..made.tiles.grid.columns() {
        made.room.push(EPOCH, MessageKind::Key, vec![0; 10].into());
        made.room.push_tiles(EPOCH, message(&made.tiles, Area { column, ..columns }, u64::from(column)));
    }
    let whole = Watcher::new(&made);
    assert_eq!(whole.model.geometry().map(|g| &g.tiles), Some(&made.tiles.tiles));
    // also after a driver panicked and left its last frame
    made.next(true, 10, None);
    made.tiles = geometry(0.25);
    made.room.push_tiles(EPOCH, message(&made.tiles, Area::all(&made.tiles.grid), made.frame + 1));
    made.room.push(EPOCH, MessageKind::Key, vec![0; 10].into());
    let fresh = Watcher::new(&made);
    assert_eq!(fresh.model.geometry().map(|g| &g.tiles), Some(&made.tiles.tiles));
}

#[test]
fn key_frames_are_requested_at_most_once_a_second_while_a_viewer_waits() {
    let mut made = Made::new();
    let asked = |made: &Made| made.room.keys.notified().now_or_never().is_some();
    let mut healthy = Watcher::new(&made);
    // a group of pictures longer than the ring
    for _ in 0..30 {
        made.next(false, 300_000, None);
        healthy.read(&made.room);
    }
    assert!(!asked(&made), "a viewer that has read everything needs none");
    // the last request was long enough ago
    let a_second_passes = |made: &Made| {
        let mut state = made.room.lock();
        state.asked = state.asked.and_then(|at| at.checked_sub(KEYS));
    };
    let since = Instant::now();
    let mut first = Watcher::new(&made);
    assert!(asked(&made) && first.frames == 0);
    // a viewer that joins within the second is not forgotten
    let mut second = Watcher::new(&made);
    let again = asked(&made);
    assert!(!again || since.elapsed() >= KEYS);
    a_second_passes(&made);
    made.next(false, 10, None);
    second.read(&made.room);
    first.read(&made.room);
    assert!(asked(&made) && !asked(&made));
    // the waiting viewers are hidden, and the healthy one is not behind
    healthy.read(&made.room);
    first.viewer.pause(true);
    second.viewer.pause(true);
    a_second_passes(&made);
    for viewer in [&mut first, &mut second, &mut healthy] {
        viewer.read(&made.room);
    }
    assert!(!asked(&made));
    // a viewer that cannot decode gets nothing before a key frame
    healthy.viewer.skip_to_key();
    let frames = healthy.frames;
    for key in [false, true] {
        made.next(key, 10, None);
        healthy.read(&made.room);
        assert_eq!((asked(&made), healthy.frames), (!key, frames + usize::from(key)));
    }
}

#[test]
fn a_full_room_has_a_place_again_after_a_viewer_leaves() {
    let room = Room::new(RoomLimits::default());
    let viewers: Vec<_> = (0..RoomLimits::VIEWERS).map_while(|_| room.join(ViewerKind::Local)).collect();
    assert_eq!(viewers.len(), RoomLimits::VIEWERS);
    assert!(room.is_full() && room.join(ViewerKind::Local).is_none());
    assert!(room.join(ViewerKind::Edge(0)).is_some(), "an edge takes no viewer's place");
    room.leave(&viewers[0]);
    assert!(!room.is_full() && room.join(ViewerKind::Local).is_some());
}
