//! Frames that came earlier, made again of the groups of pictures that are kept: the video from its key frame on is decoded, and the tiles that
//! were told up to then are put over those that the group began with. So a frame is to the bit what it was when it was the newest; one that had
//! no tiles of its own has those of the frames before it, as it was shown.

use std::str::FromStr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::http::StatusCode;
use bytes::Bytes;

use tmpi_core::container::{self, Carried, Carries, ContainerError};
use tmpi_core::live::wire::Hello;
use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::{LiveError, Model, chunk, read};
use tmpi_core::{Geometry, Grid, Intrinsics, Photo, Scene, Texels, Tile, ViewBox};
use tmpi_live::video::{self, VideoError};

use super::gops::{Group, Past};
use super::room::{Room, Still};
use crate::server::{IMMUTABLE, Problem, REVALIDATE, RoomViews};

/// Quality of the picture of a frame that is asked for by itself.
const QUALITY: u8 = 90;
/// Time that decoding may take: a node that asks for another one waits a little longer.
const LONGEST: Duration = Duration::from_secs(3);
/// Memory for making a frame again, in bytes a pixel: the pictures that a decoder of H.264 may keep, the frame, its tiles and their texels.
const BYTES: u64 = 48;
/// As [`IMMUTABLE`], for whoever asked alone.
const PRIVATE: &str = "private, max-age=31536000, immutable";

/// Which frame is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// The newest whose tiles are done.
    Latest,
    /// That of a number.
    Frame {
        /// The epoch that it is of; none: whichever it is now.
        epoch: Option<u64>,
        /// Its number.
        number: u64,
    },
}

impl FromStr for Wanted {
    type Err = ();

    /// `latest`, `NUMBER` or `EPOCH-NUMBER`.
    fn from_str(text: &str) -> Result<Self, ()> {
        if text == "latest" {
            return Ok(Self::Latest);
        }
        if let Ok(Group { epoch, number }) = text.parse() {
            return Ok(Self::Frame { epoch: Some(epoch), number });
        }
        text.parse().map(|number| Self::Frame { epoch: None, number }).map_err(|_| ())
    }
}

impl Wanted {
    /// How long caches may have the answer (`Cache-Control`); `shared`: whoever asks showed a token in the address, and so may share it with others.
    pub const fn lasts(self, shared: bool) -> &'static str {
        match self {
            // the next one follows: nobody keeps it
            Self::Latest => "no-store",
            // the next publisher of the room begins to count anew
            Self::Frame { epoch: None, .. } => REVALIDATE,
            Self::Frame { .. } if shared => IMMUTABLE,
            Self::Frame { .. } => PRIVATE,
        }
    }

    /// Its number, if that is asked for.
    pub const fn number(self) -> Option<u64> {
        match self {
            Self::Latest => None,
            Self::Frame { number, .. } => Some(number),
        }
    }
}

/// A frame that is there.
pub enum Found {
    /// The newest.
    Newest(Arc<Still>),
    /// One before it, of that number, which has to be made again.
    Past(u64, Past),
}

/// Why a frame is not there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Missing {
    /// None is done yet.
    #[error("no frame is done yet")]
    None,
    /// It is of another epoch than the room's, which is told.
    #[error("the room is in epoch {0} now")]
    Epoch(u64),
    /// It is not done yet.
    #[error("that frame is not done yet: the newest is {newest}")]
    Later {
        /// The newest that is.
        newest: u64,
    },
    /// It is not kept any more.
    #[error("that frame is not kept{}; the newest is {newest}", .oldest.map(|n| format!(": the first of those that are is {n}")).unwrap_or_default())]
    Gone {
        /// The first that is.
        oldest: Option<u64>,
        /// The newest.
        newest: u64,
    },
}

impl From<Missing> for Problem {
    fn from(missing: Missing) -> Self {
        Self::not_found(missing.to_string())
    }
}

/// Why a frame cannot be made again.
#[derive(Debug, thiserror::Error)]
pub enum PastError {
    /// It took too long.
    #[error("decoding up to that frame takes longer than {} s", LONGEST.as_secs())]
    Slow,
    /// The publisher sent no picture by that number.
    #[error("that frame holds no picture")]
    Empty,
    /// It came before something was known of every tile.
    #[error("that frame has no tiles")]
    Flat,
    /// It cannot be decoded, or not from its key frame on.
    #[error("that frame cannot be decoded: {0}")]
    Video(#[from] VideoError),
    /// Tiles cannot be read.
    #[error(transparent)]
    Live(#[from] LiveError),
    /// The container cannot be written.
    #[error(transparent)]
    Container(#[from] ContainerError),
}

impl From<PastError> for Problem {
    fn from(error: PastError) -> Self {
        match error {
            PastError::Slow => Self::new(StatusCode::SERVICE_UNAVAILABLE, "busy", error.to_string()).retry_after(5),
            PastError::Empty | PastError::Flat | PastError::Video(_) => Self::not_found(error.to_string()),
            PastError::Live(_) | PastError::Container(_) => Self::internal("making a frame again", &error),
        }
    }
}

/// A frame as a container.
pub struct Made {
    /// The epoch that it is of.
    pub epoch: u64,
    /// Its number.
    pub number: u64,
    /// The container.
    pub container: Bytes,
}

/// A frame of a room that is here, whose name is `name`: made once for all who ask, those that came earlier under the bounds of views.
///
/// # Errors
/// 404 where it is not there, 503 where too much waits or decoding takes too long, 500.
pub async fn frame((name, room): (&str, &Room), wanted: Wanted, views: &RoomViews) -> Result<Made, Problem> {
    let (epoch, found) = room.find(wanted)?;
    match found {
        Found::Newest(still) => {
            let container = container_of(&still).await.map_err(|e| Problem::internal("writing a container", &e))?;
            Ok(Made { epoch, number: still.tiles.frame, container })
        }
        Found::Past(number, past) => {
            let pixels = u64::from(past.hello.width) * u64::from(past.hello.height);
            let make = move || made(number, &past).map_err(Problem::from);
            let container = views.frame((name, epoch, number), BYTES * pixels, make).await?;
            Ok(Made { epoch, number, container })
        }
    }
}

/// A frame as a container, made once for all who ask.
async fn container_of(still: &Arc<Still>) -> Result<Bytes, String> {
    let made = still.atlas.get_or_try_init(|| {
        let still = Arc::clone(still);
        async move {
            let made = tokio::task::spawn_blocking(move || contained(still.photo.clone(), &still.tiles.geometry)).await;
            made.map_err(|e| e.to_string())?.map(Bytes::from).map_err(|e| e.to_string())
        }
    });
    made.await.cloned()
}

fn contained(photo: Photo, geometry: &Geometry) -> Result<Vec<u8>, ContainerError> {
    let carried = Carried::from_photo(&photo, QUALITY)?;
    let (grid, intrinsics, view_box) = (geometry.grid, geometry.intrinsics, geometry.view_box);
    let scene = Scene { grid, intrinsics, view_box, photo, layers: Vec::new(), texels: Texels::default() };
    container::encode(geometry, &scene, &carried, Carries::default()).map(|(bytes, _)| bytes)
}

/// The container of frame `number`.
fn made(number: u64, past: &Past) -> Result<Vec<u8>, PastError> {
    let until = Instant::now() + LONGEST;
    let known = past.before.as_ref().map(|tiles| tiles.frame);
    let (mut units, mut chunks) = (Vec::new(), Vec::new());
    for bytes in &past.messages {
        match read(bytes.clone())? {
            Kind::Video(video) if video.frame <= number => {
                if video.key {
                    units.clear();
                }
                units.push(video.data);
            }
            Kind::Geometry(tiles) if tiles.frame <= number && known.is_none_or(|known| tiles.frame > known) => chunks.extend(tiles.chunks),
            _ => {}
        }
    }
    let photo = decoded(&past.hello, &units, until)?;
    let mut geometry = match &past.before {
        Some(tiles) => tiles.geometry.clone(),
        None => empty(&past.hello)?,
    };
    for chunk in &chunks {
        for (index, tile) in chunk::decode(&geometry.grid, chunk)? {
            geometry.tiles[index as usize] = tile;
        }
    }
    if geometry.tiles.iter().any(|tile| tile.planes.is_empty()) {
        return Err(PastError::Flat);
    }
    Ok(contained(photo, &geometry)?)
}

/// The last picture of units that begin with a key frame. What is damaged is passed over, as it was when it came.
fn decoded(hello: &Hello, units: &[Bytes], until: Instant) -> Result<Photo, PastError> {
    let mut decoder = video::decoder(&hello.codec, (hello.width, hello.height))?;
    let mut last = Ok(None);
    for unit in units {
        if Instant::now() > until {
            return Err(PastError::Slow);
        }
        last = decoder.decode(unit);
    }
    last?.ok_or(PastError::Empty)
}

/// Tiles of which nothing is known.
fn empty(hello: &Hello) -> Result<Geometry, LiveError> {
    // with the checks of whoever reads it
    let tiles = vec![Tile::default(); Model::new(hello)?.tiles() as usize];
    let grid = Grid { width: hello.width, height: hello.height, size: hello.tile_size, stride: hello.tile_stride };
    let intrinsics = Intrinsics { fx: hello.fx, fy: hello.fy, cx: hello.cx, cy: hello.cy };
    let view_box = ViewBox { x: hello.view_x, y: hello.view_y, z: hello.view_z };
    Ok(Geometry { grid, intrinsics, view_box, tiles })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_asked_for_by_number_alone_or_with_its_epoch() {
        let frame = |epoch, number| Ok(Wanted::Frame { epoch, number });
        assert_eq!("latest".parse(), Ok(Wanted::Latest));
        assert_eq!(("7".parse(), "170-7".parse()), (frame(None, 7), frame(Some(170), 7)));
        for wrong in ["", "x", "-7", "7-", "7-x", "07-7", "Latest", "99999999999999999999"] {
            assert_eq!(wrong.parse::<Wanted>(), Err(()), "{wrong}");
        }
        // only an address that no other frame can have lasts
        let lasts = |text: &str, shared| text.parse::<Wanted>().map(|w| w.lasts(shared));
        assert_eq!([lasts("latest", true), lasts("7", true)], [Ok("no-store"), Ok("no-cache")]);
        assert_eq!([lasts("170-7", true), lasts("170-7", false)], [Ok(IMMUTABLE), Ok(PRIVATE)]);
    }

    #[test]
    fn decoding_that_takes_too_long_ends() {
        let hello = Hello { codec: "jpeg".into(), width: 16, height: 16, ..Hello::default() };
        let units = vec![Bytes::from_static(b"no JPEG")];
        let at = |until| decoded(&hello, &units, until).unwrap_err();
        let over = Instant::now();
        std::thread::sleep(Duration::from_millis(1));
        assert!(matches!(at(over), PastError::Slow));
        assert!(matches!(at(Instant::now() + LONGEST), PastError::Video(_)));
        assert!(matches!(decoded(&hello, &[], Instant::now()), Err(PastError::Empty)));
        let problem = Problem::from(PastError::Slow);
        assert_eq!((problem.status, problem.retry_after), (503, Some(5)));
    }
}
