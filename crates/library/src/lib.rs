//! Storage of a server: photos and their jobs, owners and their keys, links, rooms, webhooks.
//!
//! A library is SQLite and a folder on one machine, or PostgreSQL and an object store for several. Rows are the truth; contents lie in the
//! blob store. A blob is written before the row that refers to it and deleted after it, so a crash leaves at most orphans, which
//! [`Library::gc`] removes after a day. Long-running work is a [`Job`] with a [`Lease`] by the database's clock.
//!
//! While the database or the blob store cannot be reached, each call fails with [`LibraryError::Unavailable`], and for what is not there with
//! [`LibraryError::NotFound`]; only its other errors are named with it. This crate knows nothing of HTTP or pixels.
#![allow(clippy::missing_errors_doc, reason = "what each call can fail with is said once, above")]

mod accept;
mod blobs;
mod change_notifications;
mod completion;
mod credentials;
mod database;
mod deliveries;
mod digest;
mod error;
mod exports;
mod garbage_collection;
mod ids;
mod integrity;
mod leases;
mod link_signatures;
mod owner;
mod photo;
mod photos;
mod queue;
mod recent_photos;
mod remake;
mod retention;
mod room_leases;
mod source_validators;
mod statistics;
mod string_enum;
#[cfg(test)]
mod tests;
mod webhooks;

use std::collections::HashSet;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde_json::Value;

pub use accept::{Accepted, Outcome, Upload};
pub use blobs::{BlobStore, Content, Contents, DiskSpace, Reserve};
pub use change_notifications::{Event, Subscription};
pub use completion::{PhotoResults, Retry};
pub use credentials::{KEY_PREFIX, Key, NewKey, Scope};
pub use deliveries::{Attempt, Delivery, DeliveryPage, DeliveryState, DueDelivery, EventData, ExportData, RETRIES, Verdict};
pub use digest::{Digest, hex};
pub use error::{LibraryError, QueueLimit, Quota, Result, Service};
pub use exports::{NewExport, OrderedExport};
pub use garbage_collection::Collected;
pub use ids::PhotoId;
pub use integrity::Damage;
pub use leases::Lease;
pub use link_signatures::{Grant, Link, Secret, Subject};
pub use owner::Owner;
pub use photo::{Blob, Blobs, Class, Part, Photo, PhotoState, Problem};
pub use photos::{Cursor, Page};
pub use queue::{Job, JobKind, JobState, Requester, client_network};
pub use retention::Swept;
pub use room_leases::Origin;
pub use source_validators::Source;
pub use statistics::Statistics;
pub use webhooks::{Disabled, EventType, MAX_WEBHOOKS, NewWebhook, Webhook, WebhookChange};

use database::{Database, Lock};
use leases::OwnLeases;

/// Milliseconds since 1970 by the database's clock. Never compare it with a node's clock.
pub type Millis = i64;

/// How often to read the database's clock. In between, this process's monotonic clock continues it.
const CLOCK: Duration = Duration::from_secs(5);

/// Limits of a library.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Photos that may wait. One owner, and one address, may have half of them.
    pub queue: u64,
    /// Exports and films that may wait, with the same shares.
    pub exports: u64,
    /// Workers that may die on a job before it fails.
    pub attempts: i64,
    /// Photos that an owner may have.
    pub quota_photos: Option<u64>,
    /// Bytes that an owner's photos may take with their results.
    pub quota_bytes: Option<u64>,
    /// Age at which a photo is deleted.
    pub retain: Option<Duration>,
    /// Bytes that all photos may take. Above this the least recently viewed ones are deleted.
    pub retain_bytes: Option<u64>,
    /// How long an export is kept after its last fetch.
    pub exports_for: Duration,
    /// Bytes that all exports may take.
    pub exports_bytes: u64,
    /// Pauses after failed attempts of a delivery to a webhook; after one more it fails.
    pub retries: Vec<Duration>,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            queue: 64,
            exports: 8,
            attempts: 3,
            quota_photos: None,
            quota_bytes: None,
            retain: None,
            retain_bytes: None,
            exports_for: Duration::from_hours(1),
            exports_bytes: 1 << 30,
            retries: RETRIES.to_vec(),
        }
    }
}

/// Location and limits of a library.
#[derive(Clone, PartialEq, Eq)]
pub struct Config {
    /// Folder of this node, for incoming uploads, and by default the database and the blobs.
    pub data: PathBuf,
    /// `postgres://…`; default: SQLite in `data`.
    pub database: Option<String>,
    /// `s3://…`; default: a folder in `data`.
    pub blobs: Option<String>,
    /// The limits.
    pub limits: Limits,
    /// Free disk space to keep for a folder of blobs.
    pub reserve: Reserve,
}

impl fmt::Debug for Config {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // the database's URL may contain a password
        f.debug_struct("Config").field("data", &self.data).field("blobs", &self.blobs).field("limits", &self.limits).finish_non_exhaustive()
    }
}

impl Config {
    /// Everything in one folder.
    pub fn of_folder(data: &Path) -> Self {
        Self { data: data.to_owned(), database: None, blobs: None, limits: Limits::default(), reserve: Reserve::default() }
    }
}

/// Photos, jobs, owners, keys and rooms. Clones share the same library.
#[derive(Clone, Debug)]
pub struct Library(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    database: Database,
    blobs: BlobStore,
    limits: Limits,
    secret: Secret,
    incoming: PathBuf,
    held: OwnLeases,
    /// Number of jobs that this process has taken.
    taken: AtomicU64,
    /// Photos viewed since the last [`Library::save_views`].
    viewed: Mutex<HashSet<PhotoId>>,
    clock: Mutex<Option<(Instant, Millis)>>,
}

impl Library {
    /// Opens a library, creates it if missing, and migrates its schema.
    pub async fn open(config: Config) -> Result<Self> {
        blobs::create_private(&config.data)?;
        let blobs = match &config.blobs {
            Some(url) => BlobStore::objects(url)?,
            None => BlobStore::folder(&config.data.join("blobs"), config.reserve)?,
        };
        let database = match &config.database {
            Some(url) => Database::postgres(url).await?,
            None => Database::sqlite(&config.data.join("library.db")).await?,
        };
        blobs.probe().await?;
        Self::of(database, blobs, config).await
    }

    async fn of(database: Database, blobs: BlobStore, config: Config) -> Result<Self> {
        // on the file system of the blobs, so that files can be moved there
        let incoming = config.data.join("blobs").join("incoming");
        blobs::create_private(&incoming)?;
        Box::pin(pair(&database, &blobs)).await?;
        let secret = link_signatures::secret(&database).await?;
        Ok(Self(Arc::new(Inner {
            database,
            blobs,
            limits: config.limits,
            secret,
            incoming,
            held: OwnLeases::default(),
            taken: AtomicU64::new(0),
            viewed: Mutex::default(),
            clock: Mutex::default(),
        })))
    }

    fn database(&self) -> &Database {
        &self.0.database
    }

    /// The blob store.
    pub fn blobs(&self) -> &BlobStore {
        &self.0.blobs
    }

    /// The limits.
    pub fn limits(&self) -> &Limits {
        &self.0.limits
    }

    /// Makes ids and signs links.
    pub fn secret(&self) -> &Secret {
        &self.0.secret
    }

    /// Folder for incoming uploads; see [`Content::of_file`].
    pub fn incoming(&self) -> &Path {
        &self.0.incoming
    }

    /// Subscribes to events.
    pub fn subscribe(&self) -> Subscription {
        self.database().events().subscribe()
    }

    /// The last progress of a photo that this node has received.
    pub fn progress_of(&self, photo: PhotoId) -> Option<Value> {
        self.database().events().progress(photo)
    }

    /// The database's time, from a reading a few seconds old.
    pub async fn now(&self) -> Result<Millis> {
        let known = *self.0.clock.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((at, now)) = known.filter(|(at, _)| at.elapsed() < CLOCK) {
            return Ok(now + millis(at.elapsed()));
        }
        let now = self.database().now().await?;
        *self.0.clock.lock().unwrap_or_else(PoisonError::into_inner) = Some((Instant::now(), now));
        Ok(now)
    }

    /// Checks that the database and the blob store are writable, and the disk has space beyond its reserve.
    pub async fn check(&self) -> Result<()> {
        self.database().write().await?.commit().await?;
        self.blobs().check_space(0)?;
        self.blobs().probe().await
    }

    /// Closes the connections to the database. Clones of this library fail afterwards.
    pub async fn close(&self) {
        self.database().close().await;
    }
}

/// Time for claiming a new store, in a transaction that PostgreSQL ends when it is idle for 5 s.
const CLAIM_TIME: Duration = Duration::from_secs(4);

/// Refuses a blob store of another library, whose blobs `gc` would delete as orphans, and a second store of this one. Nodes and libraries
/// may start at the same time.
async fn pair(database: &Database, blobs: &BlobStore) -> Result<()> {
    let id = link_signatures::stored_secret(database, "library").await?;
    let known = blobs.library().await?;
    let mut tx = database.write().await?;
    // one node at a time: two that find the database without a store might each bring one
    tx.lock(Lock::Secret).await?;
    let insert = sqlx::query("INSERT INTO secrets (name, value) VALUES ('paired', $1) ON CONFLICT (name) DO NOTHING");
    let is_new = insert.bind(id.as_str()).execute(tx.connection()).await?.rows_affected() > 0;
    let photos = sqlx::query("SELECT id FROM photos LIMIT 1").fetch_optional(tx.connection()).await?;
    let is_own = match known {
        Some(of) => of == id,
        None if is_new && photos.is_none() => {
            let late = || format!("the blob store needs more than {} s to be claimed: start again", CLAIM_TIME.as_secs());
            let claimed = tokio::time::timeout(CLAIM_TIME, blobs.claim(&id)).await;
            claimed.map_err(|_| LibraryError::Invalid(late()))??
        }
        None => {
            tx.rollback().await;
            // another node may have claimed it meanwhile
            if blobs.library().await?.is_some_and(|of| of == id) {
                return Ok(());
            }
            let why = "the database belongs to another blob store: all nodes need the same --blobs";
            return Err(LibraryError::Invalid(why.into()));
        }
    };
    if is_own {
        return tx.commit().await;
    }
    // what was refused must not count as paired
    tx.rollback().await;
    let why = "the blob store belongs to another library, or one has tried to claim it within 15 minutes: give each library its own bucket \
               or prefix";
    Err(LibraryError::Invalid(why.into()))
}

const fn millis(time: Duration) -> Millis {
    time.as_millis() as Millis
}
