//! Frames whose geometry is done, and their tiles.

use std::sync::{Arc, OnceLock};

use bytes::Bytes;
use tokio::sync::OnceCell;

use tmpi_core::live::chunk::{self, Area};
use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::{LiveError, wire, write};
use tmpi_core::{Geometry, Photo};

/// The last frame whose geometry is done.
pub struct Still {
    /// Its picture.
    pub photo: Photo,
    /// Its tiles.
    pub tiles: Arc<Tiles>,
    /// All of it as a container, made when it is first asked for.
    pub atlas: OnceCell<Bytes>,
}

/// All tiles as of a frame.
pub struct Tiles {
    /// Its number.
    pub frame: u64,
    /// They themselves.
    pub geometry: Geometry,
    /// As a message, coded when it is first wanted.
    coded: OnceLock<Bytes>,
}

impl Still {
    /// Of a frame.
    pub fn new(frame: u64, photo: Photo, geometry: Geometry) -> Self {
        Self { photo, tiles: Arc::new(Tiles { frame, geometry, coded: OnceLock::new() }), atlas: OnceCell::new() }
    }
}

impl Tiles {
    /// They as a message, coded once.
    ///
    /// # Errors
    /// [`LiveError`].
    pub fn snapshot(&self) -> Result<Bytes, LiveError> {
        if let Some(known) = self.coded.get() {
            return Ok(known.clone());
        }
        let g = &self.geometry;
        let chunk = chunk::encode(&g.grid, Area::all(&g.grid), &g.tiles, self.frame)?;
        let bytes = write(Kind::Snapshot(wire::Geometry { frame: self.frame, chunks: vec![chunk] }));
        // two who come at once code the same
        Ok(self.coded.get_or_init(|| bytes).clone())
    }
}
