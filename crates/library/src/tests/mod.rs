//! One suite for both databases. Without PostgreSQL its half is skipped with a message.

mod accept;
mod blobs;
mod change_notifications;
mod crash;
mod credentials;
mod exports;
mod lossy_disk;
mod opening;
mod photos;
mod queue;
mod retention;
mod room_leases;
mod webhooks;

use std::collections::BTreeMap;
use std::future::Future;
use std::net::IpAddr;
use std::path::Path;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use serde_json::json;

use crate::database::Database;
use crate::*;

/// A lease that expires only when a test shifts the clock.
pub const LEASE: Duration = Duration::from_mins(1);

/// Defines each test for SQLite and for PostgreSQL.
macro_rules! on_both {
    ($($name:ident),* $(,)?) => {
        mod sqlite {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
            async fn $name() {
                super::$name(crate::tests::Bed::sqlite()).await;
            })*
        }
        mod postgres {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
            async fn $name() {
                if let Some(bed) = crate::tests::Bed::postgres() {
                    super::$name(bed).await;
                }
            })*
        }
    };
}
pub(crate) use on_both;

/// An empty database and an empty folder of blobs, for any number of nodes.
pub struct Bed {
    dir: tempfile::TempDir,
    pub url: Option<String>,
    clock: Arc<AtomicI64>,
}

impl Bed {
    pub fn sqlite() -> Self {
        Self { dir: tempfile::tempdir().unwrap(), url: None, clock: Arc::default() }
    }

    pub fn postgres() -> Option<Self> {
        #[cfg(unix)]
        let url = tmpi_testing::database();
        #[cfg(not(unix))]
        let url = {
            eprintln!("skipped, no postgres: tests start it on Unix alone");
            None
        };
        url.map(|url| Self { url: Some(url), ..Self::sqlite() })
    }

    pub fn path(&self) -> &Path {
        self.dir.path()
    }

    /// A node.
    pub async fn node(&self) -> Library {
        self.node_with(Limits::default()).await
    }

    pub async fn node_with(&self, limits: Limits) -> Library {
        let blobs = BlobStore::folder(&self.path().join("blobs"), Reserve { bytes: Some(0), files: Some(0) }).unwrap();
        self.node_of(blobs, limits).await
    }

    pub async fn node_of(&self, blobs: BlobStore, limits: Limits) -> Library {
        Box::pin(self.try_node_of(blobs, limits)).await.unwrap()
    }

    pub async fn try_node_of(&self, blobs: BlobStore, limits: Limits) -> Result<Library> {
        let mut database = match &self.url {
            Some(url) => Database::postgres(url).await.unwrap(),
            None => Database::sqlite(&self.path().join("library.db")).await.unwrap(),
        };
        database.skew = Arc::clone(&self.clock);
        Library::of(database, blobs, Config { limits, ..Config::of_folder(self.path()) }).await
    }

    pub async fn two_nodes(&self, limits: Limits) -> [Library; 2] {
        [self.node_with(limits.clone()).await, self.node_with(limits).await]
    }

    /// Shifts the database's clock.
    pub fn jump(&self, by: i64) {
        self.clock.fetch_add(by, Ordering::SeqCst);
    }

    /// Names of all blobs.
    pub async fn blobs(&self, library: &Library) -> Vec<String> {
        let mut all = Vec::new();
        for prefix in crate::blobs::prefixes() {
            all.extend(library.blobs().list(&prefix).await.unwrap().into_iter().map(|blob| blob.name));
        }
        all
    }
}

/// A caller with an address of its own.
pub fn owner(name: &str) -> Requester {
    Requester { owner: Some(Owner::of_secret(name)), ..Requester::default() }
}

pub fn address(text: &str) -> Requester {
    Requester { address: Some(text.parse::<IpAddr>().unwrap()), ..Requester::default() }
}

/// The bytes of the `n`th photo.
pub fn bytes(n: u32) -> Vec<u8> {
    format!("photo {n}").into_bytes()
}

/// An upload of the `n`th photo.
pub fn upload(n: u32, requester: Requester) -> Upload {
    let photo = Content::of_bytes(bytes(n));
    let content = PhotoId::of_content(photo.digest(), None, "", requester.owner.as_ref().map_or("", Owner::as_str));
    Upload {
        id: content,
        requester,
        class: Class::Interactive,
        options: BTreeMap::from([("quality".to_owned(), "80".to_owned())]),
        settings: json!({"title": format!("Photo {n}")}),
        photo,
        depth: None,
    }
}

/// An upload of the `n`th photo without an owner.
pub fn photo(n: u32) -> Upload {
    upload(n, Requester::default())
}

/// A worker's results for a photo, which it reads.
pub async fn made(library: &Library, lease: &Lease) -> PhotoResults {
    let read = library.blobs().read(Part::Upload, lease.photo.blob(Part::Upload).unwrap()).await.unwrap();
    let container = [b"made of ".as_slice(), &read].concat();
    let report = Content::of_bytes(b"{}".as_slice());
    let contents = Contents::from([(Part::Container, Content::of_bytes(container)), (Part::Report, report)]);
    PhotoResults { contents, details: json!({"width": 640, "height": 480}) }
}

/// Makes the next photo, once no transaction that ends holds its row any more.
pub async fn make_next(library: &Library) -> Photo {
    let taken = async {
        loop {
            if let Some(lease) = library.take(&[JobKind::Make], LEASE).await.unwrap() {
                return lease;
            }
            tokio::task::yield_now().await;
        }
    };
    let lease = tokio::time::timeout(Duration::from_secs(10), taken).await.expect("a photo waits to be made");
    library.finish(&lease, made(library, &lease).await).await.unwrap()
}

/// Accepts and makes the `n`th photo.
pub async fn done(library: &Library, n: u32, requester: Requester) -> Photo {
    library.accept(upload(n, requester)).await.unwrap();
    make_next(library).await
}

/// Orders a file of a photo.
pub async fn order(library: &Library, photo: &Photo, kind: JobKind, key: &str, requester: &Requester) -> Result<OrderedExport> {
    let payload = json!({"format": key});
    library.order_export(&NewExport { photo, key, kind, payload, class: Class::Batch, requester }).await
}

/// Writes the next file.
pub async fn write_next(library: &Library, file: &[u8]) -> Job {
    let lease = library.take(&[JobKind::Export, JobKind::Film], LEASE).await.unwrap().unwrap();
    library.finish_export(&lease, Content::of_bytes(file.to_vec())).await.unwrap()
}

/// Runs a task this many times simultaneously, at all nodes in turn.
pub async fn at_once<T, F>(nodes: &[Library], times: u32, task: impl Fn(Library, u32) -> F) -> Vec<T>
where
    T: Send + 'static,
    F: Future<Output = T> + Send + 'static,
{
    let tasks: Vec<_> = (0..times).map(|n| tokio::spawn(task(nodes[n as usize % nodes.len()].clone(), n))).collect();
    let mut all = Vec::new();
    for task in tasks {
        all.push(task.await.unwrap());
    }
    all
}

/// Number of rows of a table.
pub async fn count(library: &Library, table: &str) -> i64 {
    let select = sqlx::AssertSqlSafe(format!("SELECT COUNT(*) AS count FROM {table}"));
    sqlx::Row::get(&sqlx::query(select).fetch_one(library.database().reader()).await.unwrap(), "count")
}

/// Drops a future after this many polls, as if its process was killed; `None` if it was dropped.
pub struct Cut<F> {
    future: Option<Pin<Box<F>>>,
    polls: u32,
}

pub fn cut<F: Future>(future: F, polls: u32) -> Cut<F> {
    Cut { future: Some(Box::pin(future)), polls }
}

impl<F: Future> Future for Cut<F> {
    type Output = Option<F::Output>;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        if self.polls == 0 {
            self.future = None;
        }
        self.polls = self.polls.saturating_sub(1);
        match &mut self.future {
            Some(future) => future.as_mut().poll(context).map(Some),
            None => Poll::Ready(None),
        }
    }
}
