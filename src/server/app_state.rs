//! State that all handlers share.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use axum::http::HeaderMap;
use bytes::Bytes;
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

use super::access::Guard;
use super::answer_memory::WHOLE;
use super::base_path::BasePath;
use super::blocking_pool::{BlockingPool, Slot, WorkClass};
use super::cache::Cache;
pub use super::cache::Version;
pub use super::cache_entries::{Derived, DiskFullPolicy, Export, StoredFile, TempFolder};
use super::client_slots::{ClientSlots, client_address};
use super::depth_network_download::Download;
use super::fetch_by_url::Sources;
use super::finished_photo::FinishedPhoto;
use super::hosts::{Hosts, origin};
use super::limits::Limits;
use super::maker::Maker;
use super::memory_budget::MemoryBudget;
use super::metrics::Telemetry;
use super::outbound::AddressPolicy;
use super::presets::Presets;
use super::problem::Problem;
use super::proxies::Proxies;
use super::rate_limit::RateLimiter;
use super::{Config, program_digest, traces};
use crate::live::Rooms;
use tmpi_core::container::{self, RegionPhoto, TileRect};
use tmpi_core::{Rect, Scene};
use tmpi_library::{Library, LibraryError, Owner, Part, Photo, PhotoId, PhotoState, Requester};
use tmpi_pipeline::strokes::{self, Stroke};
use tmpi_render::Renderer;

/// Shared state; cheap to clone.
pub type App = Arc<AppState>;

/// Time after which a fault of the server counts as over; failed jobs are retried at least every minute.
const TROUBLE: Duration = Duration::from_mins(2);

/// Bytes of small files and views that clients may read after they have left the caches.
const UNREAD: usize = 64 << 20;

pub struct AppState {
    /// Photos, jobs, owners, keys and rooms, in the database and the blob store.
    pub library: Library,
    pub maker: Arc<dyn Maker>,
    pub memory: MemoryBudget,
    pub limits: Arc<Limits>,
    pub telemetry: Arc<Telemetry>,
    pub scenes: Cache<(), Arc<Scene>>,
    pub download: Download,
    /// Small files, and open ones.
    pub files: Cache<Part, StoredFile>,
    /// Smaller levels and parts of containers.
    pub levels: Cache<Derived, StoredFile>,
    /// Encoded views by version and parameters.
    pub views: Cache<String, StoredFile>,
    /// Files to download and films, on disk.
    pub exports: Cache<String, Export>,
    pub pool: BlockingPool,
    pub uploads: ClientSlots,
    pub rates: RateLimiter,
    /// Permits to read an upload whole.
    pub changes: Arc<Semaphore>,
    pub streams: ClientSlots,
    /// Result of the last check: why the library cannot be written, or what is missing to make photos.
    storage: Mutex<Option<&'static str>>,
    /// The fault of this server that kept the last job from being done, and when.
    trouble: Mutex<Option<(String, Instant)>>,
    /// Folder for unnamed temporary files.
    pub scratch: PathBuf,
    pub renderer: Arc<dyn Renderer>,
    pub hosts: Hosts,
    pub base: BasePath,
    pub proxies: Proxies,
    pub presets: Presets,
    /// Whether remote callers may list photos.
    pub public_list: bool,
    /// Access control; `None` with open access.
    pub guard: Option<Guard>,
    /// Everything besides the container that derived bytes depend on: program and backend.
    pub build: String,
    /// Addresses that webhooks of callers may have.
    pub webhook_addresses: AddressPolicy,
    pub sources: Sources,
    /// `https://HOST` of this server, if it serves TLS under a name.
    pub origin: OnceLock<String>,
    /// Directory that replaces the embedded pages, for development.
    pub pages: Option<PathBuf>,
    pub openapi: Bytes,
    /// Rooms, once the server runs.
    pub rooms: OnceLock<Arc<Rooms>>,
    /// Set at the signal to stop, while everything is still served.
    pub leaving: AtomicBool,
    pub stop: CancellationToken,
    pub asked_to_leave: CancellationToken,
    pub has_admin: bool,
}

impl AppState {
    pub fn new(
        config: Config,
        addr: SocketAddr,
        library: Library,
        maker: Arc<dyn Maker>,
        renderer: Arc<dyn Renderer>,
        telemetry: Arc<Telemetry>,
        openapi: Bytes,
    ) -> Self {
        let limits = config.limits;
        WHOLE.allow(limits.cache.files / 4 * 5 + limits.cache.views + UNREAD);
        Self {
            guard: config.private.then(|| Guard::new(library.clone(), config.base_path.clone())),
            library,
            memory: MemoryBudget::new(limits.job_memory),
            maker,
            download: Download::default(),
            scenes: Cache::with_idle_timeout(limits.cache.scenes, limits.idle),
            files: Cache::with_idle_timeout(limits.cache.files, limits.idle),
            levels: Cache::with_idle_timeout(limits.cache.files / 4, limits.idle),
            views: Cache::with_idle_timeout(limits.cache.views, limits.idle),
            exports: Cache::new(limits.cache.exports),
            pool: BlockingPool::new(&limits),
            uploads: ClientSlots::new(limits.queue.saturating_add(limits.uploads_beyond)),
            rates: RateLimiter::new(&limits.rates),
            changes: Arc::new(Semaphore::new(limits.changes)),
            streams: ClientSlots::new(limits.streams),
            storage: Mutex::default(),
            trouble: Mutex::default(),
            scratch: config.data,
            limits: Arc::new(limits),
            telemetry,
            build: program_digest::of_server(renderer.name()),
            renderer,
            hosts: Hosts::new(addr, &config.hosts),
            base: config.base_path,
            proxies: config.proxies,
            presets: config.presets,
            public_list: config.public_list,
            webhook_addresses: config.webhook_addresses,
            sources: Sources::new(config.source_hosts, config.source_addresses),
            origin: OnceLock::new(),
            pages: config.pages,
            openapi,
            rooms: OnceLock::new(),
            leaving: AtomicBool::new(false),
            stop: CancellationToken::new(),
            asked_to_leave: CancellationToken::new(),
            has_admin: config.admin.is_some(),
        }
    }

    /// Whether the caller may give options besides presets.
    pub fn takes_options(&self, headers: &HeaderMap) -> bool {
        let is_admin = || if self.guard.is_some() { Guard::is_admin() } else { self.hosts.is_own(headers) };
        !self.presets.are_exclusive() || is_admin()
    }

    /// Absolute address of this server as the client of a request sees it, without a slash at its end; `None` without a valid `Host`.
    pub fn address(&self, headers: &HeaderMap) -> Option<String> {
        origin(headers).map(|origin| format!("{origin}{}", self.base))
    }

    /// Sets [`AppState::origin`] of a server that serves TLS at `port`.
    pub fn set_origin(&self, port: u16) {
        let port = if port == 443 { String::new() } else { format!(":{port}") };
        if let Some(name) = self.hosts.first() {
            // a server runs once
            let _ = self.origin.set(format!("https://{name}{port}"));
        }
    }

    /// Result of the last check: why the library cannot be written, or what is missing to make photos.
    pub fn storage(&self) -> Option<&'static str> {
        *self.storage.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn set_storage(&self, trouble: Option<&'static str>) {
        *self.storage.lock().unwrap_or_else(PoisonError::into_inner) = trouble;
    }

    /// The recent fault that kept the last job from being done. Older ones do not count: the job may be deleted.
    pub fn trouble(&self) -> Option<String> {
        let trouble = self.trouble.lock().unwrap_or_else(PoisonError::into_inner);
        trouble.as_ref().filter(|(_, at)| at.elapsed() < TROUBLE).map(|(reason, _)| reason.clone())
    }

    pub fn set_trouble(&self, reason: Option<String>) {
        *self.trouble.lock().unwrap_or_else(PoisonError::into_inner) = reason.map(|reason| (reason, Instant::now()));
    }

    /// Runs blocking `work` that reads an upload whole, when a permit is free.
    pub async fn change<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> Result<T, Problem> {
        let turn = Arc::clone(&self.changes).acquire_owned().await.map_err(|e| Problem::internal("reading an upload", &e))?;
        let done = tokio::task::spawn_blocking(move || {
            let done = work();
            drop(turn);
            done
        });
        done.await.map_err(|e| Problem::internal("reading an upload", &e))
    }

    /// The queue's view of this request's caller.
    pub fn requester(owner: Option<Owner>) -> Requester {
        Requester { owner, address: client_address(), trace: traces::parent() }
    }

    /// The photo of a path, if the caller may access it.
    ///
    /// # Errors
    /// 404; 503 if the library is unreachable.
    pub async fn photo(&self, text: &str) -> Result<Photo, Problem> {
        let none = || Problem::not_found(format!("there is no photo {text:?}"));
        let id = text.parse().map_err(|_| none())?;
        let photo = self.library.find_recent(id).await?.ok_or_else(none)?;
        if self.guard.as_ref().is_some_and(|guard| !guard.allows(&photo)) {
            return Err(none());
        }
        self.library.note_view(id);
        Ok(photo)
    }

    /// The result of a finished photo.
    ///
    /// # Errors
    /// 409 with a `Retry-After` if it is not finished, the photo's own problem if it failed, 404 if it is deleted.
    pub fn finished(photo: &Photo) -> Result<(Version, FinishedPhoto), Problem> {
        match photo.state {
            PhotoState::Done => {
                let done = FinishedPhoto::of(photo).ok_or_else(|| Problem::internal("a photo", &"its details are not understood"))?;
                Ok(((photo.id, done.at_ms), done))
            }
            PhotoState::Failed | PhotoState::Damaged => Err(Problem::of_photo(photo)),
            PhotoState::Queued | PhotoState::Working => {
                Err(Problem::new(axum::http::StatusCode::CONFLICT, "not-ready", "the photo is not finished yet").retry_after(1))
            }
        }
    }

    /// Version of everything made of a photo: differs between photos, remakes and programs.
    pub fn version(&self, done: &FinishedPhoto) -> String {
        program_digest::of_results(&self.build, done)
    }

    /// A result file of a photo.
    ///
    /// # Errors
    /// 404 if it was deleted meanwhile; 500 also if it is damaged, in which case the photo is marked as damaged.
    pub async fn file(&self, photo: &Photo, part: Part) -> Result<StoredFile, Problem> {
        let (version, _) = Self::finished(photo)?;
        let open = async {
            let blob = photo.blob(part)?;
            match StoredFile::of_blob(self.library.blobs(), part, blob).await {
                Ok(stored) => Ok(stored),
                Err(error) => Err(Box::pin(self.unread(photo, error)).await),
            }
        };
        self.files.get((version, part), open).await
    }

    /// The answer if a file cannot be read. Damage marks the photo as damaged.
    async fn unread(&self, photo: &Photo, error: LibraryError) -> Problem {
        if !matches!(error, LibraryError::Damaged { .. }) {
            return error.into();
        }
        match self.library.find(photo.id).await {
            Ok(Some(now)) if now.blobs == photo.blobs => match self.library.mark_damaged(photo, &error.to_string()).await {
                Ok(_) => error.into(),
                Err(error) => error.into(),
            },
            // the damaged file belonged to an earlier version
            Ok(_) => Problem::not_found("the photo is being made again, or was deleted"),
            Err(error) => error.into(),
        }
    }

    /// The strokes of a photo. Damaged ones are logged and count as none, since the photo can be made without.
    pub async fn strokes(&self, photo: &Photo) -> Result<Vec<Stroke>, Problem> {
        let Some(blob) = photo.blobs.get(&Part::Strokes) else { return Ok(Vec::new()) };
        match self.library.blobs().read(Part::Strokes, blob).await {
            Ok(bytes) => Ok(strokes::read(&bytes).unwrap_or_else(|error| {
                tracing::error!(%error, "damaged strokes are left out");
                Vec::new()
            })),
            Err(LibraryError::Damaged { .. }) => Ok(Vec::new()),
            Err(error) => Err(error.into()),
        }
    }

    /// The container of a photo, or a smaller one: its tiles over `region`, at `1 / 2^level` of the size (0 to
    /// [`tmpi_core::container::LEVELS`]), with some `sections`.
    ///
    /// # Errors
    /// As [`AppState::file`]; 400 if the region is not within the photo, 503 if too many are being made.
    pub async fn container(
        &self,
        photo: &Photo,
        (level, region): (u8, Option<Rect>),
        sections: Option<&[&'static str]>,
    ) -> Result<StoredFile, Problem> {
        if (level, region, sections) == (0, None, None) {
            return self.file(photo, Part::Container).await;
        }
        let (version, done) = Self::finished(photo)?;
        let tiles = if let Some(region) = region { Some(self.tiles(photo, region).await?) } else { None };
        let place = |name: &&str| container::SECTIONS.iter().position(|s| s == name).map(|i| i as u8);
        let mut places = sections.map(|names| names.iter().filter_map(place).collect::<Vec<_>>());
        if let Some(places) = &mut places {
            places.sort_unstable();
            places.dedup();
        }
        // regions over the same tiles, and sections in any order, share an entry
        let key = Derived { level, tiles, sections: places };
        let made = key.clone();
        let names = sections.map(<[_]>::to_vec);
        let make = async {
            let slot = self.pool.enter(WorkClass::Derived, done.scene_bytes()).await?;
            let (whole, disk) = (self.container_of(photo).await?, self.temp_folder());
            let make = move || {
                let mut bytes = Vec::from(whole);
                if let Some(tiles) = &made.tiles {
                    bytes = container::region(&bytes, tiles, made.level, RegionPhoto::default()).map_err(|e| Problem::from(&e))?;
                } else if made.level > 0 {
                    bytes = container::level(&bytes, made.level).map_err(|e| Problem::from(&e))?;
                }
                if let Some(names) = names {
                    bytes = container::select(&bytes, &names).map_err(|e| Problem::from(&e))?;
                }
                StoredFile::derived(None, bytes, &disk, DiskFullPolicy::Memory)
            };
            slot.run(make).await?
        };
        self.levels.get((version, key), make).await
    }

    async fn tiles(&self, photo: &Photo, region: Rect) -> Result<TileRect, Problem> {
        let slot = self.pool.enter(WorkClass::Derived, 0).await?;
        let whole = self.container_of(photo).await?;
        let tiles = slot.run(move || TileRect::over_region(&whole, region).map_err(|e| Problem::from(&e))).await??;
        tiles.ok_or_else(|| Problem::parameter("region", "must hold a pixel and lie within the photo"))
    }

    /// The container of a photo. If it is damaged, the photo is marked as damaged.
    pub async fn container_of(&self, photo: &Photo) -> Result<Bytes, Problem> {
        match self.library.blobs().read(Part::Container, photo.blob(Part::Container)?).await {
            Ok(bytes) => Ok(bytes),
            Err(error) => Err(Box::pin(self.unread(photo, error)).await),
        }
    }

    pub fn temp_folder(&self) -> TempFolder {
        TempFolder { blobs: self.library.blobs().clone(), folder: self.scratch.clone() }
    }

    /// The decoded scene of a photo, and the time of decoding if it was not cached. Enter `slot` with [`FinishedPhoto::scene_bytes`].
    pub async fn scene(&self, photo: &Photo, slot: &Slot) -> Result<(Arc<Scene>, Option<Duration>), Problem> {
        let (version, _) = Self::finished(photo)?;
        let mut took = None;
        let decode = async {
            let start = std::time::Instant::now();
            let whole = self.container_of(photo).await?;
            let scene = slot.run(move || container::decode(&whole).map_err(|e| Problem::from(&e))).await??;
            took = Some(start.elapsed());
            Ok::<_, Problem>(Arc::new(scene))
        };
        let scene = self.scenes.get((version, ()), decode).await?;
        Ok((scene, took))
    }

    /// Drops cache entries that were unused for [`Limits::idle`].
    pub async fn evict_idle(&self) {
        self.scenes.evict_idle().await;
        self.files.evict_idle().await;
        self.levels.evict_idle().await;
        self.views.evict_idle().await;
    }

    /// Frees disk space of files that can be made again.
    pub async fn free_temp_space(&self) {
        self.exports.clear().await;
        self.views.clear().await;
        self.levels.clear().await;
    }

    pub async fn evict_photo(&self, photo: PhotoId) {
        self.scenes.evict_photo(photo).await;
        self.views.evict_photo(photo).await;
        self.files.evict_photo(photo).await;
        self.levels.evict_photo(photo).await;
        self.exports.evict_photo(photo).await;
    }
}
