//! Frames with their geometry.

use std::fmt::Display;
use std::sync::{Arc, OnceLock};

use bytes::Bytes;
use tokio::sync::OnceCell;

use tmpi_core::container::{self, ContainerError, EncodedPhoto};
use tmpi_core::live::chunk::{self, Area};
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::{schema, write};
use tmpi_core::{Geometry, Photo};

use crate::server::Problem;

/// JPEG quality of the picture in a frame's container.
const QUALITY: u8 = 90;

/// The last frame with its geometry.
pub struct FrameWithTiles {
    pub photo: Photo,
    pub tiles: Arc<Tiles>,
    /// The container, written on first use.
    atlas: OnceCell<Bytes>,
}

pub struct Tiles {
    pub frame: u64,
    pub geometry: Geometry,
    /// The encoded message, made on first use.
    coded: OnceLock<Option<Bytes>>,
}

impl FrameWithTiles {
    pub fn new(frame: u64, photo: Photo, geometry: Geometry) -> Self {
        Self { photo, tiles: Arc::new(Tiles { frame, geometry, coded: OnceLock::new() }), atlas: OnceCell::new() }
    }

    /// The frame as a container, which all callers share.
    pub async fn container(self: &Arc<Self>) -> Result<Bytes, Problem> {
        let wrong = |error: &dyn Display| Problem::internal("writing the container of a frame", error);
        let written = self.atlas.get_or_try_init(|| {
            let still = Arc::clone(self);
            async move {
                let bytes = tokio::task::spawn_blocking(move || contained(&still.photo, &still.tiles.geometry)).await;
                bytes.map_err(|e| wrong(&e))?.map(Bytes::from).map_err(|e| wrong(&e))
            }
        });
        written.await.cloned()
    }
}

fn contained(photo: &Photo, geometry: &Geometry) -> Result<Vec<u8>, ContainerError> {
    container::encode_geometry(geometry, &EncodedPhoto::from_photo(photo, QUALITY)?)
}

impl Tiles {
    /// The tiles as a SNAPSHOT message, which all callers share; `None` if they cannot be encoded.
    pub fn snapshot(&self) -> Option<Bytes> {
        let encode = || {
            let g = &self.geometry;
            let chunk = chunk::encode(&g.grid, Area::all(&g.grid), &g.tiles, self.frame);
            let chunk = chunk.inspect_err(|error| tracing::error!(%error, "encoding the tiles of a room")).ok()?;
            Some(write(Kind::Snapshot(schema::Geometry { frame: self.frame, chunks: vec![chunk] })))
        };
        self.coded.get_or_init(encode).clone()
    }
}
