//! What all handlers share.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use sha2::{Digest, Sha256};
use tokio_util::sync::CancellationToken;

use super::cache::Cache;
use super::entry::{Entry, Status};
use super::id::{PhotoId, hex};
use super::jobs::Jobs;
use super::limits::Limits;
use super::pool::Pool;
use super::problem::Problem;
use super::store::{Done, Part};
use super::telemetry::Telemetry;
use tmpi_core::container::{self, RegionPhoto, Tiles};
use tmpi_core::{Rect, Scene};
use tmpi_render::Renderer;

/// A made photo: its id and when it was made, so that nothing of a deleted one is taken for the next of the same id.
pub type Version = (PhotoId, u64);

/// Shared state; cheap to clone.
pub type App = Arc<Shared>;

/// A file of a made photo.
#[derive(Clone)]
pub struct Stored {
    /// Its bytes.
    pub bytes: Bytes,
    /// Strong entity tag with its quotes.
    pub etag: Arc<str>,
}

impl Stored {
    /// Tagged by its bytes.
    #[must_use]
    pub fn new(bytes: Vec<u8>) -> Self {
        let etag = format!("\"{}\"", hex(&Sha256::digest(&bytes)[..16])).into();
        Self { bytes: bytes.into(), etag }
    }

    /// With its size in bytes.
    #[must_use]
    pub fn sized(bytes: Vec<u8>) -> (Self, usize) {
        let size = bytes.len();
        (Self::new(bytes), size)
    }
}

/// State of the server.
pub struct Shared {
    /// Photos and their jobs.
    pub jobs: Arc<Jobs>,
    /// Limits.
    pub limits: Arc<Limits>,
    /// Counters.
    pub telemetry: Arc<Telemetry>,
    /// Decoded scenes.
    pub scenes: Cache<Version, Arc<Scene>>,
    /// Containers, pictures and reports.
    pub files: Cache<(Version, Part), Stored>,
    /// Smaller levels and parts of containers.
    pub levels: Cache<(Version, u8, Option<Tiles>), Stored>,
    /// Encoded views by photo and entity tag.
    pub views: Cache<(Version, String), Bytes>,
    /// Where views are drawn.
    pub pool: Pool,
    /// What draws them.
    pub renderer: Arc<dyn Renderer>,
    /// Directory that replaces the embedded pages, for work on them.
    pub pages: Option<PathBuf>,
    /// The `OpenAPI` document.
    pub openapi: Bytes,
    /// Set when the server stops.
    pub stop: CancellationToken,
}

impl Shared {
    /// The photo of a path.
    ///
    /// # Errors
    /// 404.
    pub fn photo(&self, id: &str) -> Result<Arc<Entry>, Problem> {
        let known = id.parse().ok().and_then(|id| self.jobs.get(id));
        known.ok_or_else(|| Problem::not_found(format!("there is no photo {id:?}")))
    }

    /// What was made of a photo.
    ///
    /// # Errors
    /// 409 with a `Retry-After` where it is not finished, the photo's own problem where it could not be made, 404 where it
    /// is deleted.
    pub fn done(entry: &Entry) -> Result<(Version, Done), Problem> {
        match entry.status() {
            Status::Done(done) => Ok(((entry.id, done.at_ms), done)),
            Status::Failed(failed) => Err(failed.problem),
            Status::Deleted => Err(Problem::not_found("the photo was deleted")),
            Status::Queued | Status::Working => {
                Err(Problem::new(axum::http::StatusCode::CONFLICT, "not-ready", "the photo is not finished yet").retry_after(1))
            }
        }
    }

    /// Forgets whatever is kept in memory of a photo.
    pub fn forget(&self, photo: PhotoId) {
        self.scenes.retain(|(of, _)| *of != photo);
        self.views.retain(|((of, _), _)| *of != photo);
        self.files.retain(|((of, _), _)| *of != photo);
        self.levels.retain(|((of, _), ..)| *of != photo);
    }

    /// A file of a made photo.
    ///
    /// # Errors
    /// 404 where it was deleted meanwhile, 500.
    pub async fn file(self: &Arc<Self>, version: Version, part: Part) -> Result<Stored, Problem> {
        let read = async {
            let jobs = Arc::clone(&self.jobs);
            let read = tokio::task::spawn_blocking(move || jobs.store.read(version.0, part));
            let bytes = read.await.map_err(|e| Problem::internal("reading a file", &e))?.map_err(|e| match e.kind() {
                std::io::ErrorKind::NotFound => Problem::not_found("the photo was deleted"),
                _ => Problem::store(&e),
            })?;
            Ok(Stored::sized(bytes))
        };
        self.files.get((version, part), read).await
    }

    /// The container of a made photo at `1 / 2^level` of its size, 0 to [`tmpi_core::container::LEVELS`].
    ///
    /// # Errors
    /// As [`Shared::file`]; 503 where too much is under way.
    pub async fn level(self: &Arc<Self>, version: Version, level: u8) -> Result<Stored, Problem> {
        if level == 0 {
            return self.file(version, Part::Atlas).await;
        }
        let make = async {
            let container = self.file(version, Part::Atlas).await?.bytes;
            let bytes = self.pool.run(move || container::level(&container, level)).await?.map_err(|e| Problem::from(&e))?;
            Ok::<_, Problem>(Stored::sized(bytes))
        };
        self.levels.get((version, level, None), make).await
    }

    /// The same of the tiles over `region` alone.
    ///
    /// # Errors
    /// As [`Shared::level`]; 400 where the region is not within the photo.
    pub async fn region(self: &Arc<Self>, version: Version, level: u8, region: Rect) -> Result<Stored, Problem> {
        let container = self.file(version, Part::Atlas).await?.bytes;
        let tiles = Tiles::over_region(&container, region).map_err(|e| Problem::from(&e))?;
        let tiles = tiles.ok_or_else(|| Problem::parameter("region", "must hold a pixel and lie within the photo"))?;
        // regions over the same tiles are one
        let key = (version, level, Some(tiles.clone()));
        let make = async {
            let cut = move || container::region(&container, &tiles, level, RegionPhoto::default());
            let bytes = self.pool.run(cut).await?.map_err(|e| Problem::from(&e))?;
            Ok::<_, Problem>(Stored::sized(bytes))
        };
        self.levels.get(key, make).await
    }

    /// The decoded scene of a made photo, and how long decoding took if it was not at hand.
    ///
    /// # Errors
    /// As [`Shared::file`]; 503 where too much is under way.
    pub async fn scene(self: &Arc<Self>, version: Version) -> Result<(Arc<Scene>, Option<Duration>), Problem> {
        let mut took = None;
        let decode = async {
            let container = self.file(version, Part::Atlas).await?.bytes;
            let start = std::time::Instant::now();
            let scene = self.pool.run(move || container::decode(&container)).await?.map_err(|e| Problem::from(&e))?;
            took = Some(start.elapsed());
            let size = scene.memory();
            Ok::<_, Problem>((Arc::new(scene), size))
        };
        let scene = self.scenes.get(version, decode).await?;
        Ok((scene, took))
    }
}
