//! How a node finds the store that it shares with others, and the others themselves.

use std::collections::HashSet;
use std::hash::{BuildHasher, RandomState};
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize};
use std::sync::{Arc, Mutex};

use async_nats::Event;
use tokio::runtime::Handle;
use tokio::sync::watch;

use super::bus::Bus;
use super::jetstream::JetStream;
use super::local::{Idle, LocalQueue};
use super::ports::{Blobs, Ledger, Queue};
use super::{Cluster, LOCKS, folder, objects};
use crate::nats;
use crate::server::limits::Limits;
use crate::server::store::digest;

/// What a node does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Role {
    /// Answers requests and makes photos.
    #[default]
    All,
    /// Answers requests; other nodes make photos.
    Serve,
    /// Makes photos; answers questions about its health alone.
    Work,
}

/// What a node shares with others.
#[derive(Clone, Debug)]
pub struct Sharing {
    /// `s3://BUCKET/PREFIX`, `gs://BUCKET/PREFIX`, `az://CONTAINER/PREFIX` or `file:///FOLDER`.
    pub store: String,
    /// What this node does.
    pub role: Role,
    /// How the nodes hear of photos at once; without it they look every few seconds.
    pub nats: Option<Nats>,
}

/// How nodes of a store tell each other.
#[derive(Clone, Debug)]
pub struct Nats {
    /// Where.
    pub at: nats::Config,
    /// Servers that keep each hint, by which photos are begun; 1 to 5.
    pub replicas: usize,
}

/// Messages of a subscription that wait to be read.
const WAITING: usize = 256;
/// Digits of the name of a store in subjects.
const KEY: usize = 16;

impl Cluster {
    /// Connects with the others; a store or NATS that cannot be reached now may come later. Called within a runtime, on a thread that may
    /// block.
    ///
    /// # Errors
    /// The addresses are not understood, or a folder cannot be made.
    pub fn open(sharing: &Sharing, limits: &Limits) -> io::Result<Self> {
        let (blobs, ledger) = ports_at(&sharing.store)?;
        let makes = sharing.role != Role::Serve;
        let here = makes.then(LocalQueue::default);
        let (queue, bus) = match &sharing.nats {
            Some(nats) => {
                let (queue, bus) = connect(nats, &sharing.store, limits, here)?;
                (Arc::new(queue) as Arc<dyn Queue>, Some(bus))
            }
            None => (here.map_or_else(|| Arc::new(Idle) as Arc<dyn Queue>, |here| Arc::new(here)), None),
        };
        Ok(Self {
            blobs,
            ledger,
            queue,
            bus,
            node: format!("{:016x}", RandomState::new().hash_one(std::process::id())),
            next: AtomicU64::new(0),
            known: Mutex::default(),
            damaged: Mutex::default(),
            looking: [const { Mutex::new(()) }; LOCKS],
            away: Mutex::default(),
            built: AtomicBool::new(false),
            beyond: AtomicUsize::new(0),
            sightings: Mutex::default(),
            cursor: Mutex::default(),
            unmarked: Mutex::new(HashSet::new()),
            barren: Mutex::default(),
            elsewhere: Mutex::default(),
            makes,
            serves: sharing.role != Role::Work,
            lease: limits.lease,
            // often enough to see whether a lease is kept
            sweep: limits.sweep.min(limits.lease / 4),
        })
    }
}

/// Connects with the other nodes of a store, now or once NATS can be reached.
fn connect(nats: &Nats, store: &str, limits: &Limits, here: Option<LocalQueue>) -> io::Result<(JetStream, Bus)> {
    // nodes that name their store otherwise do not hear each other, and go on by looking
    let key: String = digest(store.trim_end_matches('/').as_bytes()).chars().take(KEY).collect();
    let (linked, links) = watch::channel(0);
    let linked = Arc::new(linked);
    let options = nats.at.options().subscription_capacity(WAITING).event_callback(move |event| {
        if event == Event::Connected {
            linked.send_modify(|n| *n += 1);
        }
        async move { tracing::info!(%event, "NATS, for photos") }
    });
    let runtime = Handle::current();
    let client = runtime.block_on(options.connect(nats.at.servers.clone())).map_err(io::Error::other)?;
    let _in_runtime = runtime.enter();
    let queue = JetStream::new(client.clone(), links, &key, nats.replicas, limits.lease, here);
    Ok((queue, Bus::new(client, &key)))
}

/// Whether a store may have this address, with what the environment says of it; neither is asked nor made.
///
/// # Errors
/// It may not.
pub fn check_store(store: &str) -> io::Result<()> {
    if store.strip_prefix("file://").is_some_and(|folder| !folder.is_empty()) {
        return Ok(());
    }
    let runtime = tokio::runtime::Builder::new_current_thread().build()?;
    let _within = runtime.enter();
    ports_at(store).map(drop)
}

/// Blobs and ledger of a store.
pub(super) fn ports_at(store: &str) -> io::Result<(Arc<dyn Blobs>, Arc<dyn Ledger>)> {
    let unknown = || {
        io::Error::new(
            io::ErrorKind::InvalidInput,
            "a store is s3://BUCKET/PREFIX, gs://BUCKET/PREFIX, az://CONTAINER/PREFIX or file:///FOLDER",
        )
    };
    match store.split_once("://") {
        Some(("file", path)) => {
            let folder = Arc::new(folder::Folder::open(Path::new(path))?);
            Ok((folder.clone(), folder))
        }
        Some((scheme, place)) => {
            let (bucket, prefix) = place.split_once('/').unwrap_or((place, ""));
            let objects = Arc::new(objects::Objects::open(scheme, bucket, prefix).ok_or_else(unknown)??);
            Ok((objects.clone(), objects))
        }
        None => Err(unknown()),
    }
}
