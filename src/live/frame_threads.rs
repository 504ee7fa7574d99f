//! The threads of a room: one decodes every frame in order; the other makes the geometry of the newest decoded frame.
//!
//! Between them is a slot for one frame, not a queue. Viewers show a frame that is replaced there with the previous geometry.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread;
use std::time::Instant;

use bytes::Bytes;
use tokio::sync::mpsc;

use tmpi_core::live::schema;
use tmpi_core::{DisparityMap, Photo};
use tmpi_live::video::{Decoder, FAILED, VideoError};
use tmpi_live::{Frame, FramePipeline, depth_codec};

use super::PANICS;
use super::room::{FrameWithTiles, Room};

/// Most frames that wait to be decoded: more than the publisher's credit, so a full queue is a fault.
const WAITING: usize = 4;

pub struct EncodedFrame {
    pub frame: u64,
    pub data: Bytes,
    /// Its measured depth, packed.
    pub depth: Option<Bytes>,
    pub at: Instant,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DecodeOutcome {
    Picture,
    /// It is damaged, or refers to a damaged frame.
    Broken(String),
    /// It uses a feature that the decoder does not support.
    Unsupported(String),
    /// Not about a single frame: making geometry has panicked [`PANICS`] times in a row.
    Panics,
}

/// A room's threads, which end when this is dropped.
pub struct FrameThreads {
    frames: SyncSender<EncodedFrame>,
}

/// The newest frame that waits for its geometry.
#[derive(Default)]
struct LatestFrame {
    frame: Mutex<Waiting>,
    filled: Condvar,
}

#[derive(Default)]
struct Waiting {
    frame: Option<(Frame, Instant)>,
    ended: bool,
}

impl FrameThreads {
    /// Starts the threads for `epoch`. `geometry` makes a driver, and another one after a panic. `done` receives the outcome of each frame
    /// in order.
    pub fn start(
        (room, epoch): (Arc<Room>, u64),
        mut decoder: Box<dyn Decoder>,
        geometry: impl Fn() -> FramePipeline + Send + 'static,
        done: mpsc::Sender<DecodeOutcome>,
    ) -> std::io::Result<Self> {
        let (frames, coded): (_, Receiver<EncodedFrame>) = sync_channel(WAITING);
        let latest = Arc::new(LatestFrame::default());
        let (to, from, counted) = (Arc::clone(&latest), latest, Arc::clone(&room));
        let panics = done.clone();
        thread::Builder::new().name("tmpi-geometry".into()).spawn(move || {
            geometries((&room, epoch), &geometry, &from);
            if !from.ended() {
                // the receiver may have gone
                let _ = panics.blocking_send(DecodeOutcome::Panics);
            }
        })?;
        thread::Builder::new().name("tmpi-video".into()).spawn(move || {
            // ends the other thread when this one ends, even by a panic
            let to = EndOnDrop(to);
            // use arrival times: the publisher's clock may stand still
            let began = Instant::now();
            for EncodedFrame { frame, data, depth, at } in coded {
                // treat a panic as an undecodable frame
                let decoded = catch_unwind(AssertUnwindSafe(|| decoded(decoder.as_mut(), &data, depth.as_deref())));
                let outcome = match decoded.unwrap_or_else(|_| Err(VideoError::Broken(FAILED.into()))) {
                    Ok(picture) => {
                        if let Some((photo, depth)) = picture {
                            to.0.put(Frame { number: frame, at: at.saturating_duration_since(began), photo, depth }, at, &counted);
                        }
                        DecodeOutcome::Picture
                    }
                    Err(error) => {
                        tracing::debug!(%error, frame, "decoding a frame");
                        match error {
                            VideoError::Unsupported(what) => DecodeOutcome::Unsupported(what),
                            error => DecodeOutcome::Broken(error.to_string()),
                        }
                    }
                };
                if done.blocking_send(outcome).is_err() {
                    break;
                }
            }
        })?;
        Ok(Self { frames })
    }

    /// Queues a frame; false if the queue is full or the threads have ended.
    pub fn take(&self, coded: EncodedFrame) -> bool {
        self.frames.try_send(coded).is_ok()
    }
}

/// Ends the geometry thread on drop.
struct EndOnDrop(Arc<LatestFrame>);

impl Drop for EndOnDrop {
    fn drop(&mut self) {
        self.0.end();
    }
}

impl LatestFrame {
    fn put(&self, frame: Frame, at: Instant, room: &Room) {
        let mut waiting = self.frame.lock().unwrap_or_else(PoisonError::into_inner);
        if waiting.frame.replace((frame, at)).is_some() {
            room.count(|s| s.frames_without_geometry += 1);
        }
        self.filled.notify_one();
    }

    fn end(&self) {
        self.frame.lock().unwrap_or_else(PoisonError::into_inner).ended = true;
        self.filled.notify_one();
    }

    fn ended(&self) -> bool {
        self.frame.lock().unwrap_or_else(PoisonError::into_inner).ended
    }

    fn next(&self) -> Option<(Frame, Instant)> {
        let waiting = self.frame.lock().unwrap_or_else(PoisonError::into_inner);
        let mut waiting = self.filled.wait_while(waiting, |w| w.frame.is_none() && !w.ended).unwrap_or_else(PoisonError::into_inner);
        waiting.frame.take().filter(|_| !waiting.ended)
    }
}

/// Decodes a frame's picture and measured depth; `None` if it holds no picture.
fn decoded(decoder: &mut dyn Decoder, data: &[u8], packed: Option<&[u8]>) -> Result<Option<(Photo, Option<DisparityMap>)>, VideoError> {
    let Some(photo) = decoder.decode(data)? else { return Ok(None) };
    let depth = packed.map(|packed| depth_codec::unpack(packed, photo.width, photo.height)).transpose();
    let depth = depth.map_err(|e| VideoError::Broken(e.to_string()))?;
    Ok(Some((photo, depth)))
}

/// Makes the geometry of frames until no more frames come or [`PANICS`] frames in a row panic.
fn geometries(place: (&Room, u64), make: &impl Fn() -> FramePipeline, latest: &LatestFrame) {
    let (mut driver, mut panics) = (None, 0);
    while let Some((frame, at)) = latest.next() {
        // a change of size made frames of the epoch before it useless
        if !place.0.has_epoch(place.1) {
            continue;
        }
        let number = frame.number;
        if catch_unwind(AssertUnwindSafe(|| made(place, driver.get_or_insert_with(make), frame, at))).is_ok() {
            panics = 0;
            continue;
        }
        panics += 1;
        tracing::error!(frame = number, panics, "the geometry of a frame panicked");
        place.0.count(|s| s.frames_without_geometry += 1);
        if panics >= PANICS {
            return;
        }
        // its state may be inconsistent; a new driver sends all tiles
        driver = None;
    }
}

/// Makes the geometry of a frame and passes it on.
fn made((room, epoch): (&Room, u64), driver: &mut FramePipeline, frame: Frame, at: Instant) {
    let update = match driver.next(&frame) {
        Ok(update) => update,
        Err(error) => {
            tracing::warn!(%error, frame = frame.number, "geometry of a frame");
            return;
        }
    };
    let ms = at.elapsed().as_secs_f64() * 1e3;
    // store all tiles before sending the changed ones: a viewer that joins now gets all
    if let Some(geometry) = driver.geometry() {
        let tiles = geometry.tiles.len() as u64;
        room.set_newest_frame(epoch, FrameWithTiles::new(frame.number, frame.photo, geometry.clone()), |s| {
            s.tiles += tiles;
            s.tiles_left_out += tiles - update.sent.len() as u64;
            s.geometry_ms = ms;
        });
    }
    // sends each tile only once
    if !update.chunks.is_empty() {
        room.push_tiles(epoch, schema::Geometry { frame: frame.number, chunks: update.chunks });
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tmpi_core::live::schema::message::Kind;
    use tmpi_core::live::{TileState, read};
    use tmpi_live::Settings;
    use tmpi_pipeline::Models;

    use super::*;
    use crate::live::RoomLimits;
    use crate::live::room::NextStep;

    #[test]
    fn after_a_cut_under_a_budget_viewers_have_all_new_tiles() {
        const SIZE: (u32, u32) = (160, 120);
        let settings = Settings { frame_ms: 1e-3, ..Settings::default() };
        // depth is brightness
        let bright = |photo: &Photo| Ok(DisparityMap::from_fn(photo.width, photo.height, |x, y| f32::from(photo.at(x, y)[0]) / 255.0));
        let models = Models { depth: Arc::new(("bright", bright)), theta: None, psi: None };
        let (room, mut driver) = (Room::new(RoomLimits::default()), FramePipeline::new(models, settings.clone()));
        let epoch = room.publish(TileState::hello(&settings.empty(SIZE.0, SIZE.1)), 0, 1);
        let mut viewer = room.join(crate::live::room::ViewerKind::Local).unwrap();
        let mut model = TileState::new(&TileState::hello(&settings.empty(SIZE.0, SIZE.1))).unwrap();
        let mut read_all = |model: &mut TileState| loop {
            let bytes = match room.next(&mut viewer) {
                NextStep::Send(bytes) => bytes,
                NextStep::Hello(_) | NextStep::Tiles => match room.tiles(&mut viewer) {
                    Some(bytes) => bytes,
                    None => continue,
                },
                _ => return,
            };
            if let Ok(Kind::Geometry(tiles) | Kind::Snapshot(tiles)) = read(bytes) {
                model.take(&tiles).unwrap();
            }
        };
        // a wall that rises to the right, then a brighter one that falls
        let mut next = |number: u64, falls: bool| {
            let level = |x: u32| if falls { 219 - x / 4 } else { 20 + x / 4 };
            let photo = Photo::from_fn(SIZE.0, SIZE.1, |x, _| [level(x) as u8; 3]);
            room.push(epoch, crate::live::ring::MessageKind::Key, Bytes::from_static(&[0; 10]));
            made((&room, epoch), &mut driver, Frame { number, at: Duration::from_millis(33 * number), photo, depth: None }, Instant::now());
        };
        next(0, false);
        read_all(&mut model);
        let before = model.geometry().expect("all tiles of the first frame").clone();
        for number in 1..4 {
            next(number, true);
            read_all(&mut model);
        }
        let tiles = &model.geometry().unwrap().tiles;
        assert!(tiles.iter().zip(&before.tiles).all(|(now, then)| now.planes != then.planes), "a tile of the scene before the cut is left");
        let (_, newest) = room.newest_frame().expect("the room goes on");
        assert_eq!(tiles, &newest.tiles.geometry.tiles);
    }

    struct Panics;

    impl Decoder for Panics {
        fn decode(&mut self, _: &[u8]) -> Result<Option<Photo>, VideoError> {
            panic!("as planned")
        }
    }

    #[test]
    fn panics_of_the_decoder_are_reported() {
        let room = Arc::new(Room::new(RoomLimits::default()));
        let epoch = room.publish(TileState::hello(&Settings::default().empty(160, 120)), 0, 1);
        let (done, mut told) = mpsc::channel(16);
        let threads = FrameThreads::start((room, epoch), Box::new(Panics), || -> FramePipeline { panic!("as planned") }, done).unwrap();
        for frame in 0..3 {
            assert!(threads.take(EncodedFrame { frame, data: Bytes::new(), depth: None, at: Instant::now() }));
            assert!(matches!(told.blocking_recv(), Some(DecodeOutcome::Broken(_))));
        }
    }
}
