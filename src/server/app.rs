//! What all handlers share.

use std::fs::File;
use std::io::Read as _;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use sha2::{Digest, Sha256};
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

use super::Config;
use super::access::Guard;
use super::cache::Cache;
use super::entry::{Entry, Status};
use super::exports::{self, Ordered, Recipe, Standing, Wanted};
use super::hosts::Hosts;
use super::id::{PhotoId, hex};
use super::identity;
use super::jobs::Jobs;
pub use super::kept::{Derived, Export, Full, Stored, Version};
use super::limits::Limits;
use super::memory::Way;
use super::network::Download;
use super::pool::{Class, Pool, Slot};
use super::problem::Problem;
use super::proxies::Proxies;
use super::rates::Rates;
use super::share::Places;
use super::source::Source;
use super::store::{Done, Part, damage_of, lost};
use super::telemetry::Telemetry;
use super::time::now_ms;
use super::traces;
use super::upload::Coming;
use crate::live::Rooms;
use tmpi_core::container::{self, RegionPhoto, Tiles};
use tmpi_core::{Rect, Scene};
use tmpi_library::Library;
use tmpi_render::Renderer;

/// Shared state; cheap to clone.
pub type App = Arc<Shared>;

/// Files up to this many bytes are kept in memory; larger ones are read while they are sent.
const SMALL: usize = 256 << 10;
/// Memory of a decoded scene in bytes a pixel, measured on photographs and rounded up.
const SCENE_BYTES: u64 = 13;

/// State of the server.
pub struct Shared {
    /// Photos, jobs, owners, keys and rooms, as the database and the blob store have them.
    pub library: Library,
    /// Photos and their jobs.
    pub jobs: Arc<Jobs>,
    /// Limits.
    pub limits: Arc<Limits>,
    /// Counters.
    pub telemetry: Arc<Telemetry>,
    /// Decoded scenes.
    pub scenes: Cache<Version, Arc<Scene>>,
    /// The better depth network on its way here.
    pub download: Download,
    /// Small files, and those that are open.
    pub files: Cache<(Version, Part), Stored>,
    /// Smaller levels and parts of containers.
    pub levels: Cache<(Version, Derived), Stored>,
    /// Encoded views by photo and what they were made of.
    pub views: Cache<(Version, String), Stored>,
    /// Files to download and films, on disk.
    pub exports: Cache<(Version, String), Export>,
    /// Where views are drawn.
    pub pool: Pool,
    /// Uploads that come in.
    pub uploads: Coming,
    /// How often somebody may ask.
    pub rates: Rates,
    /// Leave to change what is on disk.
    pub changes: Arc<Semaphore>,
    /// Places for event streams.
    pub streams: Places,
    /// Why the data directory could not be written, or what was missing to make photos with, when that was last tried.
    pub storage: Mutex<Option<&'static str>>,
    /// What draws them.
    pub renderer: Arc<dyn Renderer>,
    /// Names under which the server answers.
    pub hosts: Hosts,
    /// Proxies that say whose requests they pass on.
    pub proxies: Proxies,
    /// Whether strangers may list photos.
    pub public_list: bool,
    /// Who may have what; none where everybody may have everything.
    pub guard: Option<Guard>,
    /// What the bytes of everything that is derived depend on besides the container: program and backend.
    pub build: String,
    /// Directory that replaces the embedded pages, for work on them.
    pub pages: Option<PathBuf>,
    /// The `OpenAPI` document.
    pub openapi: Bytes,
    /// Rooms, once the server runs.
    pub rooms: OnceLock<Arc<Rooms>>,
    /// Set at the signal to stop, when everything is still served.
    pub leaving: AtomicBool,
    /// Set when the server stops.
    pub stop: CancellationToken,
    /// Set when an operator asks it to.
    pub asked_to_leave: CancellationToken,
    /// Whether operators have a door of their own.
    pub has_admin: bool,
}

impl Shared {
    /// Of a server that listens at `addr`.
    #[must_use]
    pub fn new(config: Config, addr: SocketAddr, library: Library, jobs: Arc<Jobs>, renderer: Arc<dyn Renderer>, openapi: Bytes) -> Self {
        let Config {
            addr: _,
            admin,
            data: _,
            database: _,
            blobs: _,
            pages,
            hosts,
            proxies,
            public_list,
            private: _,
            keys: _,
            traces: _,
            limits: _,
        } = config;
        let (limits, telemetry) = (Arc::clone(&jobs.limits), Arc::clone(&jobs.telemetry));
        Self {
            library,
            jobs,
            download: Download::default(),
            scenes: Cache::resting(limits.scene_cache, limits.rest),
            files: Cache::resting(limits.file_cache, limits.rest),
            levels: Cache::resting(limits.file_cache / 4, limits.rest),
            views: Cache::resting(limits.view_cache, limits.rest),
            exports: Cache::new(limits.export_cache),
            pool: Pool::new(&limits),
            uploads: Coming::new(&limits),
            rates: Rates::new(&limits),
            changes: Arc::new(Semaphore::new(limits.changes)),
            streams: Places::new(limits.streams),
            storage: Mutex::new(None),
            limits,
            telemetry,
            build: identity::of_server(renderer.name()),
            renderer,
            hosts: Hosts::new(addr, &hosts),
            proxies,
            public_list,
            guard: None,
            pages,
            openapi,
            rooms: OnceLock::new(),
            leaving: AtomicBool::new(false),
            stop: CancellationToken::new(),
            asked_to_leave: CancellationToken::new(),
            has_admin: admin.is_some(),
        }
    }

    /// Why the data directory could not be written, or what was missing to make photos with, when that was last tried.
    #[must_use]
    pub fn storage(&self) -> Option<&'static str> {
        *self.storage.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps the outcome of a try.
    pub fn set_storage(&self, trouble: Option<&'static str>) {
        *self.storage.lock().unwrap_or_else(PoisonError::into_inner) = trouble;
    }

    /// Runs what changes the data directory, where it may have to wait for others that do: it holds a thread only once it is its turn.
    ///
    /// # Errors
    /// 500 where `work` panicked.
    pub async fn change<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> Result<T, Problem> {
        let turn = Arc::clone(&self.changes).acquire_owned().await.map_err(|e| Problem::internal("changing a photo", &e))?;
        let trace = traces::current();
        let changed = tokio::task::spawn_blocking(move || {
            let changed = traces::within(trace, work);
            drop(turn);
            changed
        });
        changed.await.map_err(|e| Problem::internal("changing a photo", &e))
    }

    /// The photo of a path, where whoever asks may have it.
    ///
    /// # Errors
    /// 404.
    pub fn photo(&self, id: &str) -> Result<Arc<Entry>, Problem> {
        let known = id.parse().ok().and_then(|id| self.jobs.get(id));
        let allowed = known.clone().filter(|entry| self.guard.as_ref().is_none_or(|guard| guard.allows(entry)));
        // of what is not known here nothing can be said while the store is away; nor may more be said of what is another's
        if allowed.is_none() && known.is_some() && self.jobs.cluster.as_ref().is_some_and(|cluster| cluster.is_away()) {
            return Err(Problem::away());
        }
        let photo = allowed.ok_or_else(|| Problem::not_found(format!("there is no photo {id:?}")))?;
        photo.look(now_ms());
        Ok(photo)
    }

    /// What was made of a photo.
    ///
    /// # Errors
    /// 409 with a `Retry-After` where it is not finished, the photo's own problem where it could not be made, 404 where it
    /// is deleted.
    pub fn done(entry: &Entry) -> Result<(Version, Done), Problem> {
        match entry.status() {
            Status::Done(done) => Ok(((entry.id, done.at_ms), done)),
            Status::Failed(failed) | Status::Damaged(failed) => Err(failed.problem),
            Status::Deleted => Err(Problem::not_found("the photo was deleted")),
            Status::Queued | Status::Working => {
                Err(Problem::new(axum::http::StatusCode::CONFLICT, "not-ready", "the photo is not finished yet").retry_after(1))
            }
        }
    }

    /// Names the bytes of everything that is made of a photo: other for another photo, another making of it and another program.
    #[must_use]
    pub fn version(&self, done: &Done) -> String {
        identity::of_results(&self.build, done)
    }

    /// A file of a made photo.
    ///
    /// # Errors
    /// 404 where it was deleted meanwhile, 500 also where it is not what was made: it is taken out of service then.
    pub async fn file(&self, version: Version, done: &Done, part: Part) -> Result<Stored, Problem> {
        let jobs = Arc::clone(&self.jobs);
        let whole = (part == Part::Atlas).then(|| done.clone());
        let open = async move {
            let open = tokio::task::spawn_blocking(move || {
                match jobs.store.open_part(version.0, part).and_then(|file| open(file, whole.as_ref())) {
                    Ok(Ok(stored)) if is_made(&jobs, version) => Ok(stored),
                    // what was opened may be of the next making
                    Ok(Ok(_)) => Err(Problem::not_found("the photo is being made again, or was deleted")),
                    Ok(Err(damage)) => Err(damaged(&jobs, version, &damage)),
                    Err(error) => Err(unread(&jobs, version, part, &error)),
                }
            });
            open.await.map_err(|e| Problem::internal("opening a file", &e))?
        };
        self.files.get((version, part), open).await
    }

    /// The container of a made photo, or a smaller one of its tiles over `region` at `1 / 2^level` of the size (0 to
    /// [`tmpi_core::container::LEVELS`]) with some `sections`.
    ///
    /// # Errors
    /// As [`Shared::file`]; 400 where the region is not within the photo, 503 where too much is under way.
    pub async fn container(
        &self,
        version: Version,
        done: &Done,
        (level, region): (u8, Option<Rect>),
        sections: Option<&[&'static str]>,
    ) -> Result<Stored, Problem> {
        if (level, region, sections) == (0, None, None) {
            return self.file(version, done, Part::Atlas).await;
        }
        let tiles = if let Some(region) = region { Some(self.tiles(version, region).await?) } else { None };
        let place = |name: &&str| container::SECTIONS.iter().position(|s| s == name).map(|i| i as u8);
        let mut places = sections.map(|names| names.iter().filter_map(place).collect::<Vec<_>>());
        if let Some(places) = &mut places {
            places.sort_unstable();
            places.dedup();
        }
        // regions over the same tiles, and sections in any order, are one
        let key = Derived { level, tiles, sections: places };
        let made = key.clone();
        let names = sections.map(<[_]>::to_vec);
        let make = async {
            let slot = self.pool.enter(Class::Derived, scene_bytes(done)).await?;
            let (read, jobs) = (self.reading(version), Arc::clone(&self.jobs));
            let make = move || {
                let mut bytes = read()?;
                if let Some(tiles) = &made.tiles {
                    bytes = container::region(&bytes, tiles, made.level, RegionPhoto::default()).map_err(|e| Problem::from(&e))?;
                } else if made.level > 0 {
                    bytes = container::level(&bytes, made.level).map_err(|e| Problem::from(&e))?;
                }
                if let Some(names) = names {
                    bytes = container::select(&bytes, &names).map_err(|e| Problem::from(&e))?;
                }
                Stored::derived(None, bytes, &jobs.store, Full::Memory)
            };
            slot.run(make).await?
        };
        self.levels.get((version, key), make).await
    }

    /// The tiles over a region of a photo.
    async fn tiles(&self, version: Version, region: Rect) -> Result<Tiles, Problem> {
        let slot = self.pool.enter(Class::Derived, 0).await?;
        let read = self.reading(version);
        let tiles = slot.run(move || Tiles::over_region(&read()?, region).map_err(|e| Problem::from(&e))).await??;
        tiles.ok_or_else(|| Problem::parameter("region", "must hold a pixel and lie within the photo"))
    }

    /// What reads the container of a photo, blocking. Where that is not what was made, the photo is taken out of service.
    pub fn reading(&self, version: Version) -> impl Fn() -> Result<Vec<u8>, Problem> + Send + 'static {
        let jobs = Arc::clone(&self.jobs);
        move || {
            let bytes = jobs.store.read(version.0, Part::Atlas).map_err(|e| unread(&jobs, version, Part::Atlas, &e))?;
            match jobs.get(version.0).map(|entry| entry.status()) {
                Some(Status::Done(done)) if done.at_ms == version.1 => match damage_of(&bytes, &done) {
                    None => Ok(bytes),
                    Some(damage) => Err(damaged(&jobs, version, &damage)),
                },
                // made again or deleted meanwhile
                _ => Err(Problem::not_found("the photo is being made again, or was deleted")),
            }
        }
    }

    /// The decoded scene of a made photo, and how long decoding took if it was not at hand. `slot` was entered with
    /// [`scene_bytes`].
    ///
    /// # Errors
    /// As [`Shared::file`].
    pub async fn scene(&self, version: Version, slot: &Slot) -> Result<(Arc<Scene>, Option<Duration>), Problem> {
        let mut took = None;
        let decode = async {
            let start = std::time::Instant::now();
            let read = self.reading(version);
            let scene = slot.run(move || container::decode(&read()?).map_err(|e| Problem::from(&e))).await??;
            took = Some(start.elapsed());
            Ok::<_, Problem>(Arc::new(scene))
        };
        let scene = self.scenes.get(version, decode).await?;
        Ok((scene, took))
    }

    /// Writes a file for who waits for it until it is `gone`, in another process where the server's maker has such; blocks.
    ///
    /// # Errors
    /// As [`exports::written`].
    pub fn written(&self, recipe: &Recipe, of: (&[u8], &Done), gone: &CancellationToken) -> Result<Vec<u8>, Problem> {
        let unwanted = || gone.is_cancelled();
        let wanted = Wanted { unwanted: &unwanted, began: &|| {}, limit: self.limits.export, memory: Way::First, gives_way: false };
        exports::written(&self.jobs, recipe, of, &self.renderer, &wanted)
    }

    /// Lets go of what nobody has asked for over [`Limits::rest`].
    pub async fn settle(&self) {
        self.scenes.settle().await;
        self.files.settle().await;
        self.levels.settle().await;
        self.views.settle().await;
    }

    /// Frees the disk that is taken by what can be made again.
    pub async fn free_disk(&self) {
        self.forget_files(|file| matches!(file.standing(), Standing::Done(_))).await;
        self.exports.clear().await;
        self.views.clear().await;
        self.levels.clear().await;
    }

    /// Frees what is kept of a deleted photo.
    pub async fn forget(&self, photo: PhotoId) {
        self.scenes.forget(photo).await;
        self.views.forget(photo).await;
        self.files.forget(photo).await;
        self.levels.forget(photo).await;
        self.exports.forget(photo).await;
        self.forget_files(move |file| file.photo == photo).await;
    }

    async fn forget_files(&self, is_over: impl Fn(&Ordered) -> bool + Send + 'static) {
        let jobs = Arc::clone(&self.jobs);
        if let Err(error) = tokio::task::spawn_blocking(move || jobs.forget_files(is_over)).await {
            tracing::error!(%error, "forgetting written files");
        }
    }
}

/// Memory that work on the scene of a photo takes, in bytes.
#[must_use]
pub fn scene_bytes(done: &Done) -> u64 {
    SCENE_BYTES * u64::from(done.width) * u64::from(done.height) + done.atlas_bytes
}

/// Whether a making of a photo is still the one in service; its files are overwritten only after it is not.
fn is_made(jobs: &Jobs, version: Version) -> bool {
    matches!(jobs.get(version.0).map(|entry| entry.status()), Some(Status::Done(done)) if done.at_ms == version.1)
}

/// Takes a photo out of service.
fn damaged(jobs: &Jobs, version: Version, damage: &str) -> Problem {
    if jobs.cluster.is_some() && jobs.store.is_copied(version.0) {
        // a copy alone: it is fetched again
        jobs.store.forget(version.0);
        return Problem::new(axum::http::StatusCode::SERVICE_UNAVAILABLE, "damaged-copy", damage).retry_after(1);
    }
    jobs.take_out(version.0, version.1, damage);
    Problem::new(axum::http::StatusCode::INTERNAL_SERVER_ERROR, "damaged", format!("{damage}: upload the photo again, and it is made anew"))
}

/// The answer where a file of a photo cannot be read.
fn unread(jobs: &Jobs, version: Version, part: Part, error: &std::io::Error) -> Problem {
    match lost(part, error) {
        Some(_) if jobs.get(version.0).is_none() => Problem::not_found("the photo was deleted"),
        Some(damage) => damaged(jobs, version, &damage),
        None => Problem::store(error),
    }
}

/// Opens a file, or says how it is damaged; small ones are read. `whole`: what is on record of it.
fn open(mut file: File, whole: Option<&Done>) -> std::io::Result<Result<Stored, String>> {
    let length = file.metadata()?.len();
    if length <= SMALL as u64 {
        let mut bytes = Vec::with_capacity(length as usize);
        file.read_to_end(&mut bytes)?;
        return Ok(match whole.and_then(|done| damage_of(&bytes, done)) {
            Some(damage) => Err(damage),
            None => Ok(Stored::new(bytes)),
        });
    }
    let mut hash = Sha256::new();
    let mut piece = vec![0; SMALL];
    loop {
        let n = file.read(&mut piece)?;
        if n == 0 {
            break;
        }
        hash.update(&piece[..n]);
    }
    let digest = hex(&hash.finalize()[..16]);
    if whole.is_some_and(|done| (done.atlas_bytes, &done.atlas_hash) != (length, &digest)) {
        return Ok(Err(format!("{} is not what was written", Part::Atlas.name())));
    }
    Ok(Ok(Stored::of(Source::File(Arc::new(file), length as usize), format!("\"{digest}\"").into())))
}
