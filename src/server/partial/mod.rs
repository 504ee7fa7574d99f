//! Uploads in parts, which go on where they were interrupted: draft-ietf-httpbis-resumable-upload.
//!
//! One request at a time brings a part of an upload: another that comes, be it to ask how far it is, ends the one before, whose connection
//! may be long dead. An upload that is whole goes the way of an upload at once, as if it had just come. With several nodes it lies on
//! the node that it began at.

mod extent;
pub mod header;
mod kept;

use std::collections::HashMap;
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::body::{Body, BodyDataStream};
use axum::extract::{DefaultBodyLimit, Request};
use axum::http::StatusCode;
use axum::http::header::{CONTENT_TYPE, HeaderValue};
use futures_util::StreamExt as _;
use tokio::io::{AsyncReadExt as _, AsyncSeekExt as _, AsyncWriteExt as _};
use tokio::sync::OwnedMutexGuard;
use tokio_util::io::ReaderStream;
use tokio_util::sync::CancellationToken;
use tracing::Instrument as _;

pub use extent::{Extent, Said};
pub use kept::Record;

use super::access::{Owner, random};
use super::admission::{self, Admission};
use super::app::App;
use super::body;
use super::files;
use super::id::{PhotoId, hex};
use super::jobs::Jobs;
use super::maker::HeadOf;
use super::problem::Problem;
use super::share::{Share, Shares, asker};
use super::time::now_ms;
use super::upload;
use kept::Kept;

/// Bytes after which what came is made durable.
const STEP: u64 = 4 << 20;
/// Bytes that are gathered before they are written, and read at a time.
const BUFFER: usize = 256 << 10;
/// How long the request before may take to end.
const TURN: Duration = Duration::from_secs(10);
/// For how long it is told at most that an upload has become a photo.
const TOLD: Duration = Duration::from_hours(1);
/// Pause between two looks at what is over.
const EXPIRE: Duration = Duration::from_mins(1);
/// Uploads that are told to have become photos, for each that may be under way.
const TOLD_EACH: usize = 16;

/// All uploads in parts of a server.
#[derive(Debug)]
pub struct Partials {
    kept: Kept,
    most: usize,
    most_of_owner: usize,
    time: Duration,
    shares: Shares,
    all: Mutex<HashMap<String, Arc<Partial>>>,
}

/// One of them.
#[derive(Debug)]
pub struct Partial {
    /// 256 random bits, as hex digits.
    pub id: String,
    record: Mutex<Record>,
    turn: Arc<tokio::sync::Mutex<()>>,
    /// Ends the request that has the turn.
    ends: Mutex<CancellationToken>,
    share: Mutex<Option<Share>>,
}

/// Leave to change an upload, for one request at a time.
pub struct Turn {
    of: Arc<Partial>,
    ended: CancellationToken,
    _alone: OwnedMutexGuard<()>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Record {
    fn ends_ms(&self, time: Duration) -> u64 {
        let time = if self.photo.is_some() { time.min(TOLD) } else { time };
        self.touched_ms + time.as_millis() as u64
    }
}

impl Partial {
    fn new(id: String, record: Record, share: Option<Share>) -> Arc<Self> {
        let (turn, ends) = (Arc::default(), Mutex::default());
        Arc::new(Self { id, record: Mutex::new(record), turn, ends, share: Mutex::new(share) })
    }

    /// What is known of it.
    #[must_use]
    pub fn record(&self) -> Record {
        lock(&self.record).clone()
    }

    /// Has the request that is at it end, and its turn.
    ///
    /// # Errors
    /// 423 where that one is about to have the upload accepted.
    pub async fn enter(self: &Arc<Self>) -> Result<Turn, Problem> {
        let ended = CancellationToken::new();
        std::mem::replace(&mut *lock(&self.ends), ended.clone()).cancel();
        match tokio::time::timeout(TURN, Arc::clone(&self.turn).lock_owned()).await {
            Ok(turn) => Ok(Turn { of: Arc::clone(self), ended, _alone: turn }),
            Err(_) => Err(Problem::new(StatusCode::LOCKED, "upload-locked", "another request is at this upload").retry_after(1)),
        }
    }

    fn is_over(&self, time: Duration, now_ms: u64) -> bool {
        now_ms >= lock(&self.record).ends_ms(time)
    }
}

impl Partials {
    /// Those on the disk of `jobs`, for which room is kept.
    ///
    /// # Errors
    /// They cannot be read.
    pub fn open(jobs: &Jobs) -> io::Result<Self> {
        let limits = &jobs.limits;
        let (files, dir) = jobs.store.uploads();
        let (kept, found) = Kept::open(files, dir)?;
        for (id, record) in found.iter().filter(|(_, record)| record.photo.is_none()) {
            jobs.hold_found(record.owner.as_ref(), id, record.extent.length.unwrap_or(record.extent.offset));
        }
        let all = found.into_iter().map(|(id, record)| (id.clone(), Partial::new(id, record, None))).collect();
        let (most, most_of_owner, time) = (limits.partials, limits.partials_of_owner, limits.partial_time);
        Ok(Self { kept, most, most_of_owner, time, shares: Shares::half_of(most), all: Mutex::new(all) })
    }

    /// One by its id.
    #[must_use]
    pub fn get(&self, id: &str) -> Option<Arc<Partial>> {
        lock(&self.all).get(id).cloned()
    }

    /// How many are under way.
    #[must_use]
    pub fn count(&self) -> usize {
        under_way(&lock(&self.all), |_| true)
    }

    /// When one is removed of which nothing comes any more, milliseconds since 1970.
    #[must_use]
    pub fn ends_ms(&self, record: &Record) -> u64 {
        record.ends_ms(self.time)
    }

    /// Begins one; blocks.
    ///
    /// # Errors
    /// 429 where there are as many as may be, half of them of this address, or as many of the owner as one may have; 403 where its `bytes` are
    /// more than they may have; 500 and 507 where the disk fails.
    fn begin(&self, jobs: &Jobs, share: Option<Share>, record: &Record, bytes: u64) -> Result<Arc<Partial>, Problem> {
        let full = |detail: String| Problem::new(StatusCode::TOO_MANY_REQUESTS, "uploads-full", detail).retry_after(60);
        let many = || full(format!("{} uploads in parts are kept already, or half of them for this address", self.most));
        let share = share.ok_or_else(many)?;
        jobs.store.room().map_err(|e| Problem::store(&e))?;
        let id = hex(&random().map_err(|e| Problem::internal("an id", &e))?);
        self.forget_some();
        // this machine's own user is not bound
        let owner = record.owner.clone().filter(|owner| !owner.is_own());
        let partial = Partial::new(id.clone(), record.clone(), Some(share));
        {
            // counted and entered at once, before its folder is made: of those that begin side by side no more get in than may
            let mut all = lock(&self.all);
            if under_way(&all, |_| true) >= self.most {
                return Err(many());
            }
            if owner.is_some() && under_way(&all, |record| record.owner == owner) >= self.most_of_owner {
                let most = self.most_of_owner;
                return Err(full(format!(
                    "{most} of your uploads in parts are under way (--partial-uploads-per-owner): end or delete one"
                )));
            }
            all.insert(id.clone(), Arc::clone(&partial));
        }
        let begun = jobs.hold(owner.as_ref(), &id, bytes);
        let begun = begun.and_then(|()| self.kept.begin(&id, record).map_err(|e| Problem::store(&e)));
        begun.map(|()| Arc::clone(&partial)).inspect_err(|_| {
            lock(&self.all).remove(&id);
            jobs.let_go_of(&id);
        })
    }

    /// Forgets what has long become photos, where that is too much.
    fn forget_some(&self) {
        let mut told: Vec<_> = lock(&self.all).values().filter(|p| lock(&p.record).photo.is_some()).cloned().collect();
        told.sort_by_key(|p| lock(&p.record).touched_ms);
        let many = told.len().saturating_sub(TOLD_EACH * self.most);
        told.iter().take(many).for_each(|partial| self.remove(partial));
    }

    fn end(&self, jobs: &Jobs, partial: &Partial) {
        self.remove(partial);
        jobs.let_go_of(&partial.id);
    }

    fn remove(&self, partial: &Partial) {
        lock(&self.all).remove(&partial.id);
        lock(&partial.share).take();
        if let Err(error) = self.kept.remove(&partial.id) {
            // the next start removes it
            tracing::warn!(%error, "an upload in parts cannot be removed now");
        }
    }

    /// Keeps how far an upload is; what it counts is synced.
    fn keep(&self, partial: &Partial, change: impl FnOnce(&mut Record)) -> Result<(), Problem> {
        let mut record = partial.record();
        change(&mut record);
        record.touched_ms = now_ms();
        self.kept.write(&partial.id, &record).map_err(|e| Problem::store(&e))?;
        *lock(&partial.record) = record;
        Ok(())
    }
}

/// How many of them are under way that `are` meant.
fn under_way(all: &HashMap<String, Arc<Partial>>, are: impl Fn(&Record) -> bool) -> usize {
    let counts = |record: &Record| record.photo.is_none() && are(record);
    all.values().filter(|partial| counts(&lock(&partial.record))).count()
}

/// Begins an upload of `owner`, and has the turn at it; `bytes` of it are to come, as far as that is told.
///
/// # Errors
/// 403, 429, 500, 507.
pub async fn begin(
    app: &App,
    query: Vec<(String, String)>,
    content_type: Option<String>,
    owner: Option<Owner>,
    bytes: u64,
) -> Result<Turn, Problem> {
    let (touched_ms, version) = (now_ms(), kept::VERSION);
    let record = Record { version, touched_ms, extent: Extent::NOTHING, query, content_type, owner, photo: None };
    let (shared, share) = (Arc::clone(app), app.partials.shares.take(asker()));
    let begun = tokio::task::spawn_blocking(move || shared.partials.begin(&shared.jobs, share, &record, bytes));
    begun.await.map_err(|e| Problem::internal("beginning an upload", &e))??.enter().await
}

impl Turn {
    /// The upload.
    #[must_use]
    pub fn partial(&self) -> &Partial {
        &self.of
    }

    /// Takes a part; true where the upload is whole with it. What came before something went wrong stays.
    ///
    /// # Errors
    /// 400 and 409 where the part does not go with what is there, 413, 408 and 400 as with all bodies, 409 where another request had this
    /// one end, 500 and 507 where the disk fails. 400, 413 and 415 where its first bytes tell that it becomes no photo here: it is removed.
    pub async fn append(self, app: &App, said: Said, body: Body) -> Result<(Self, bool), Problem> {
        let most = app.limits.body as u64;
        let mut extent = self.of.record().extent;
        extent.begin(&said, most).map_err(|refused| header::refusal(refused, &extent))?;
        // as far as that is told: the whole, or the end of this part
        let end = extent.offset.saturating_add(said.content.unwrap_or_default());
        self.hold(app, extent.length.unwrap_or(end)).await?;
        let app = Arc::clone(app);
        // goes on where nobody waits for the answer any more: what came until the connection was lost is kept
        let work = async move { self.take(&app, extent, said.complete, body.into_data_stream()).await };
        tokio::spawn(work.in_current_span()).await.map_err(|e| Problem::internal("taking a part of an upload", &e))?
    }

    async fn take(self, app: &App, mut extent: Extent, complete: bool, mut stream: BodyDataStream) -> Result<(Self, bool), Problem> {
        let disk = |e: io::Error| Problem::store(&e);
        app.jobs.store.room().map_err(disk)?;
        let most = app.limits.body as u64;
        let options = tokio::fs::OpenOptions::from(files::private());
        let mut file = options.clone().write(true).open(app.partials.kept.data(&self.of.id)).await.map_err(disk)?;
        file.seek(io::SeekFrom::Start(extent.offset)).await.map_err(disk)?;
        let mut file = tokio::io::BufWriter::with_capacity(BUFFER, file);
        let mut counted = extent.offset;
        let mut look = match self.look(app, extent.offset).await {
            Ok(look) => look,
            Err(refused) => return Err(self.refuse(app, refused).await),
        };
        let ended = loop {
            let next = tokio::select! {
                biased;
                () = self.ended.cancelled() => {
                    let detail = "another request of this upload came, and this one ended";
                    break Err(Problem::new(StatusCode::CONFLICT, "upload-superseded", detail));
                }
                next = stream.next() => next,
            };
            let bytes = match next {
                None => break Ok(()),
                Some(Err(e)) => break Err(body::problem(&e)),
                Some(Ok(bytes)) => bytes,
            };
            if let Err(refused) = extent.take(bytes.len() as u64, most) {
                break Err(header::refusal(refused, &extent));
            }
            if let Err(refused) = look(&bytes) {
                return Err(self.refuse(app, refused).await);
            }
            file.write_all(&bytes).await.map_err(disk)?;
            if extent.offset - counted >= STEP {
                counted = extent.offset;
                if extent.length.is_none()
                    && let Err(refused) = self.hold(app, counted).await
                {
                    break Err(refused);
                }
                self.keep(app, &mut file, extent).await?;
            }
        };
        // what is told has to be durable, and what cannot be told, too: the client asks for it
        let whole = ended.and_then(|()| extent.end(complete).map_err(|refused| header::refusal(refused, &extent)));
        self.keep(app, &mut file, extent).await?;
        if whole.is_ok() {
            self.hold(app, extent.offset).await?;
        }
        whole.map(|whole| (self, whole))
    }

    /// Keeps room for so many bytes of the whole beside what its owner has.
    async fn hold(&self, app: &App, bytes: u64) -> Result<(), Problem> {
        let (shared, partial) = (Arc::clone(app), Arc::clone(&self.of));
        let hold = move || {
            let owner = lock(&partial.record).owner.clone();
            shared.jobs.hold(owner.as_ref(), &partial.id, bytes)
        };
        // a store is asked, and blocks
        tokio::task::spawn_blocking(hold).await.map_err(|e| Problem::internal("counting an owner's uploads", &e))?
    }

    /// What looks at the bytes from `offset` on, and has seen those before them; a form is looked at once it is whole.
    async fn look(&self, app: &App, offset: u64) -> Result<impl FnMut(&[u8]) -> Result<(), Problem> + use<>, Problem> {
        let Record { query, content_type, .. } = self.of.record();
        let options = upload::options_of(&query)?;
        let photo_alone = !content_type.is_some_and(|kind| upload::is_form(&kind));
        let mut admission = Some(Admission::new(&app.jobs.maker)).filter(|_| photo_alone && offset < admission::MOST as u64);
        let mut look = move |bytes: &[u8]| admission.as_mut().map_or(Ok(()), |admission| admission.see(bytes, HeadOf::Photo(&options)));
        if photo_alone && (1..admission::MOST as u64).contains(&offset) {
            let disk = |e: io::Error| Problem::internal("an upload in parts", &e);
            let file = tokio::fs::File::open(app.partials.kept.data(&self.of.id)).await.map_err(disk)?;
            let mut before = Vec::new();
            file.take(offset).read_to_end(&mut before).await.map_err(disk)?;
            look(&before)?;
        }
        Ok(look)
    }

    /// Removes an upload that becomes no photo; a fault of the server's changes nothing.
    async fn refuse(self, app: &App, refused: Problem) -> Problem {
        if refused.status().is_client_error() {
            self.cancel(app).await;
        }
        refused
    }

    /// Makes what came durable.
    async fn keep(&self, app: &App, file: &mut tokio::io::BufWriter<tokio::fs::File>, extent: Extent) -> Result<(), Problem> {
        let disk = |e: io::Error| Problem::store(&e);
        file.flush().await.map_err(disk)?;
        file.get_ref().sync_data().await.map_err(disk)?;
        let (shared, partial) = (Arc::clone(app), Arc::clone(&self.of));
        let kept = tokio::task::spawn_blocking(move || {
            shared.jobs.store.room().map_err(|e| Problem::store(&e))?;
            shared.partials.keep(&partial, |record| record.extent = extent)
        });
        kept.await.map_err(|e| Problem::internal("keeping an upload", &e))?
    }

    /// The whole upload as a request, as if it had just come.
    ///
    /// # Errors
    /// 500 where its bytes cannot be read.
    pub async fn whole(&self, app: &App) -> Result<(Request, Vec<(String, String)>), Problem> {
        let disk = |e: io::Error| Problem::internal("an upload in parts", &e);
        let Record { extent, query, content_type, .. } = self.of.record();
        let file = tokio::fs::File::open(app.partials.kept.data(&self.of.id)).await.map_err(disk)?;
        if file.metadata().await.map_err(disk)?.len() < extent.offset {
            return Err(Problem::internal("an upload in parts", &"there is less of it than was kept"));
        }
        let bytes = ReaderStream::with_capacity(file.take(extent.offset), BUFFER);
        let mut request = Request::new(Body::from_stream(bytes));
        // what it may have was seen to when its parts came
        DefaultBodyLimit::disable().apply(&mut request);
        if let Some(kind) = content_type.and_then(|kind| HeaderValue::try_from(kind).ok()) {
            request.headers_mut().insert(CONTENT_TYPE, kind);
        }
        Ok((request, query))
    }

    /// The upload has become a photo: its bytes go, and that is told for a while.
    pub async fn became(self, app: &App, photo: PhotoId) {
        let shared = Arc::clone(app);
        let told = tokio::task::spawn_blocking(move || {
            let (partials, partial) = (&shared.partials, &self.of);
            lock(&partial.share).take();
            shared.jobs.let_go_of(&partial.id);
            let kept = partials.keep(partial, |record| record.photo = Some(photo.to_string())).is_ok();
            // else it is accepted once more, which changes nothing
            if kept && let Err(error) = partials.kept.free(&partial.id) {
                tracing::warn!(%error, "an upload that is a photo now cannot be removed");
            }
        });
        if let Err(error) = told.await {
            tracing::error!(%error, "an upload in parts");
        }
    }

    /// Removes the upload.
    pub async fn cancel(self, app: &App) {
        let shared = Arc::clone(app);
        if let Err(error) = tokio::task::spawn_blocking(move || shared.partials.end(&shared.jobs, &self.of)).await {
            tracing::error!(%error, "removing an upload in parts");
        }
    }
}

/// Removes now and then the uploads of which nothing has come for too long.
pub async fn expire(app: App) {
    let partials = || &app.partials;
    loop {
        tokio::time::sleep(EXPIRE.min(partials().time / 2)).await;
        let (now, time) = (now_ms(), partials().time);
        let over: Vec<_> = lock(&partials().all).values().filter(|p| p.is_over(time, now)).cloned().collect();
        for partial in over {
            // one that is being sent is not over by the time that it is its turn
            let Ok(turn) = Arc::clone(&partial.turn).try_lock_owned() else { continue };
            if partial.is_over(time, now_ms()) {
                let bytes = partial.record().extent.offset;
                tracing::info!(bytes, "an upload in parts of which nothing came is removed");
                let turn = Turn { of: Arc::clone(&partial), ended: CancellationToken::new(), _alone: turn };
                turn.cancel(&app).await;
            }
        }
    }
}
