//! Frames whose geometry is done, and their tiles.

use std::fmt::Display;
use std::sync::{Arc, OnceLock};

use bytes::Bytes;
use tokio::sync::OnceCell;

use tmpi_core::container::{self, Carried, Carries, ContainerError};
use tmpi_core::live::chunk::{self, Area};
use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::{LiveError, wire, write};
use tmpi_core::{Geometry, Photo, Scene, Texels};

use crate::server::Problem;

/// Quality of the picture in the container of a frame, 1 to 100.
const QUALITY: u8 = 90;

/// The last frame whose geometry is done.
pub struct Still {
    /// Its picture.
    pub photo: Photo,
    /// Its tiles.
    pub tiles: Arc<Tiles>,
    /// Its container, once somebody asked for it.
    atlas: OnceCell<Bytes>,
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

    /// The frame as a container, written once for all who ask.
    ///
    /// # Errors
    /// 500 where it cannot be written.
    pub async fn container(self: &Arc<Self>) -> Result<Bytes, Problem> {
        let wrong = |error: &dyn Display| Problem::internal("writing the container of a frame", error);
        let written = self.atlas.get_or_try_init(|| {
            let still = Arc::clone(self);
            async move {
                let bytes = tokio::task::spawn_blocking(move || contained(still.photo.clone(), &still.tiles.geometry)).await;
                bytes.map_err(|e| wrong(&e))?.map(Bytes::from).map_err(|e| wrong(&e))
            }
        });
        written.await.cloned()
    }
}

fn contained(photo: Photo, geometry: &Geometry) -> Result<Vec<u8>, ContainerError> {
    let carried = Carried::from_photo(&photo, QUALITY)?;
    let (grid, intrinsics, view_box) = (geometry.grid, geometry.intrinsics, geometry.view_box);
    let scene = Scene { grid, intrinsics, view_box, photo, layers: Vec::new(), texels: Texels::default() };
    container::encode(geometry, &scene, &carried, Carries::default()).map(|(bytes, _)| bytes)
}

/// The newest frame of a room whose geometry is done.
pub struct Newest {
    /// The epoch that it is of.
    pub epoch: u64,
    /// Its number.
    pub number: u64,
    /// It as a container.
    pub container: Bytes,
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
