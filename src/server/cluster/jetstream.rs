//! Hints by a work queue of `JetStream`, so that a photo is begun at once and by one node.
//!
//! It may be away, forget everything or give a hint twice: each node sweeps the store besides, and whoever follows a hint takes the
//! same lease there. Whoever finds the queue missing makes it again. Hints that nobody could send, or that went lost with the disks
//! they lay on, are as if they had never been.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use async_nats::connection::State;
use async_nats::jetstream::consumer::{PullConsumer, pull};
use async_nats::jetstream::message::PublishMessage;
use async_nats::jetstream::stream::{Config, DiscardPolicy, RetentionPolicy, StorageType};
use async_nats::jetstream::{AckKind, Context, ContextBuilder, Message};
use async_nats::{Client, Error};
use futures_util::StreamExt as _;
use serde::{Deserialize, Serialize};
use tokio::runtime::Handle;
use tokio::sync::{Notify, Semaphore, watch};
use tokio::time::{sleep, timeout};

use super::local::{LocalQueue, Receipt};
use super::ports::{Figure, Hint, Lease, Queue};
use super::records;
use crate::server::telemetry::{counter, gauge};

/// Version of hints; nodes of different ones leave each other's to the sweep.
const VERSION: u32 = 1;
/// Name of the consumer that all nodes share.
const MAKERS: &str = "makers";
/// Time for which a hint of the same name is not queued again.
const TWICE: Duration = Duration::from_mins(2);
/// Age at which hints go: what they tell of was swept up long ago.
const OLDEST: Duration = Duration::from_hours(1);
/// Hints that are kept; the oldest make room.
const HINTS: i64 = 100_000;
/// Bytes of a hint.
const HINT_BYTES: usize = 512;
/// Times that a hint is given; then it is left to the sweep.
const DELIVERIES: i64 = 16;
/// Hints that are worked on at a time, by all nodes.
const UNDER_WAY: i64 = 65_536;
/// Longest wait for an answer.
const ANSWER: Duration = Duration::from_secs(5);
/// Time for which a hint is asked for, and how late the word may be that there is none.
const PULL: Duration = Duration::from_secs(5);
const LATE: Duration = Duration::from_secs(1);
/// Time for which a hint that came waits for a worker.
const TAKEN: Duration = Duration::from_millis(250);
/// Pause before the queue is looked for again, doubled up to its longest; and between two looks at one that is well.
const PAUSE: Duration = Duration::from_millis(250);
const MOST_PAUSE: Duration = Duration::from_secs(15);
const LOOK: Duration = Duration::from_secs(15);
/// Time for which a queue is waited for that is missing when a hint is to be sent.
const AGAIN: Duration = Duration::from_secs(1);
/// Hints that are being sent; more are left to the sweep.
const SENDING: usize = 256;

/// A hint as it travels.
#[derive(Debug, Serialize, Deserialize)]
struct Told {
    version: u32,
    marker: String,
}

/// The queue as it was found: another one has other times.
#[derive(Clone)]
struct Found {
    consumer: Option<PullConsumer>,
    created: (i128, i128),
}

/// Hints by `JetStream`, besides those of this node's own sweep.
#[derive(Clone)]
pub struct JetStream(Arc<Inner>);

struct Inner {
    context: Context,
    client: Client,
    runtime: Handle,
    stream: Config,
    subject: String,
    lease: Duration,
    /// Where this node's workers take their hints; none where it makes nothing.
    here: Option<LocalQueue>,
    found: watch::Sender<Option<Found>>,
    /// Something failed that a missing queue would explain.
    missing: Notify,
    sending: Arc<Semaphore>,
    counts: Counts,
}

#[derive(Debug, Default)]
struct Counts {
    sent: AtomicU64,
    lost: AtomicU64,
    taken: AtomicU64,
    redelivered: AtomicU64,
    dropped: AtomicU64,
    told_missing: AtomicBool,
}

impl std::fmt::Debug for JetStream {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("JetStream").field("subject", &self.0.subject).finish_non_exhaustive()
    }
}

impl JetStream {
    /// The queue of the store `key`, kept `replicas` times; hints come to `here`. `links` counts up with each connection. Called within a
    /// runtime, on which its tasks run until that ends.
    pub fn new(client: Client, links: watch::Receiver<u64>, key: &str, replicas: usize, lease: Duration, here: Option<LocalQueue>) -> Self {
        let subject = format!("tmpi.jobs.{key}");
        let stream = Config {
            name: format!("tmpi-jobs-{key}"),
            subjects: vec![subject.clone()],
            retention: RetentionPolicy::WorkQueue,
            storage: StorageType::File,
            discard: DiscardPolicy::Old,
            num_replicas: replicas,
            duplicate_window: TWICE,
            max_age: OLDEST,
            max_messages: HINTS,
            max_message_size: HINT_BYTES as i32 * 2,
            ..Config::default()
        };
        let inner = Arc::new(Inner {
            context: ContextBuilder::new().timeout(ANSWER).ack_timeout(ANSWER).build(client.clone()),
            client,
            runtime: Handle::current(),
            stream,
            subject,
            lease,
            here,
            found: watch::Sender::new(None),
            missing: Notify::new(),
            sending: Arc::new(Semaphore::new(SENDING)),
            counts: Counts::default(),
        });
        tokio::spawn(Arc::clone(&inner).look_after(links.clone()));
        if let Some(here) = inner.here.clone() {
            tokio::spawn(Arc::clone(&inner).pull(links, here));
        }
        Self(inner)
    }
}

impl Inner {
    /// Finds the queue or makes it.
    async fn set_up(&self) -> Result<Found, Error> {
        self.is_connected()?;
        let stream = self.context.get_or_create_stream(self.stream.clone()).await?;
        let created = stream.cached_info().created.unix_timestamp_nanos();
        if self.here.is_none() {
            return Ok(Found { consumer: None, created: (created, 0) });
        }
        let config = pull::Config {
            durable_name: Some(MAKERS.into()),
            ack_wait: self.lease,
            max_deliver: DELIVERIES,
            max_ack_pending: UNDER_WAY,
            ..pull::Config::default()
        };
        let consumer = stream.get_or_create_consumer(MAKERS, config).await?;
        let of = consumer.cached_info().created.unix_timestamp_nanos();
        Ok(Found { consumer: Some(consumer), created: (created, of) })
    }

    /// Looks now and then, when something fails and with each connection whether there is a queue, and makes it where there is none.
    async fn look_after(self: Arc<Self>, mut links: watch::Receiver<u64>) {
        let mut pause = PAUSE;
        loop {
            let found = match timeout(2 * ANSWER, self.set_up()).await {
                Ok(found) => found.map_err(|error| error.to_string()),
                Err(_) => Err("no answer".into()),
            };
            let is_found = found.is_ok();
            if let Some(here) = &self.here {
                here.is_fed(is_found);
            }
            let rest = match found {
                Ok(found) => {
                    let is_other = |now: &Option<Found>| now.as_ref().is_none_or(|now| now.created != found.created);
                    if is_other(&self.found.borrow()) {
                        tracing::info!(stream = self.stream.name, "photos are told of by JetStream");
                        self.counts.told_missing.store(false, Ordering::Relaxed);
                        self.found.send_replace(Some(found));
                    }
                    pause = PAUSE;
                    LOOK
                }
                Err(error) => {
                    // told once, until it is found
                    if !self.counts.told_missing.swap(true, Ordering::Relaxed) {
                        tracing::warn!(error, "no queue of JetStream; photos are found by looking");
                    }
                    self.found.send_replace(None);
                    let rest = pause;
                    pause = (pause * 2).min(MOST_PAUSE);
                    rest
                }
            };
            // what fails again and again is not looked for all the time
            sleep(PAUSE).await;
            tokio::select! {
                () = sleep(rest) => {}
                () = self.missing.notified(), if is_found => {}
                linked = links.changed() => if linked.is_err() { return },
            }
        }
    }

    /// Asks for a hint whenever a worker waits for one.
    async fn pull(self: Arc<Self>, mut links: watch::Receiver<u64>, here: LocalQueue) {
        let (mut found, mut idle) = (self.found.subscribe(), here.idle());
        loop {
            if idle.wait_for(|n| *n > 0).await.is_err() {
                return;
            }
            let consumer = found.borrow_and_update().as_ref().and_then(|found| found.consumer.clone());
            let Some(consumer) = consumer else {
                if found.changed().await.is_err() {
                    return;
                }
                continue;
            };
            links.mark_unchanged();
            let next = tokio::select! {
                next = timeout(PULL + LATE, next(&consumer)) => next,
                // what was asked for is heard of no more
                _ = found.changed() => continue,
                linked = links.changed() => if linked.is_err() { return } else { continue },
            };
            match next {
                Ok(Ok(Some(message))) => self.hand_over(&here, message).await,
                Ok(Ok(None)) => {}
                // not even the word that there is none: nobody is there who would say it
                Ok(Err(_)) | Err(_) => {
                    self.missing.notify_one();
                    sleep(PAUSE).await;
                }
            }
        }
    }

    /// Gives what came to a worker, or back where none takes it.
    async fn hand_over(&self, here: &LocalQueue, message: Message) {
        let again = message.info().is_ok_and(|info| info.delivered > 1);
        self.counts.redelivered.fetch_add(u64::from(again), Ordering::Relaxed);
        let Some(hint) = read(&message.payload) else {
            self.counts.dropped.fetch_add(1, Ordering::Relaxed);
            say(&self.runtime, message, AckKind::Term);
            return;
        };
        let receipt = Said { message, runtime: self.runtime.clone() };
        let taken = here.hand_over(hint.clone(), Box::new(receipt));
        if matches!(timeout(TAKEN, taken).await, Ok(Ok(()))) {
            self.counts.taken.fetch_add(1, Ordering::Relaxed);
        } else if let Some(receipt) = here.take_back(&hint) {
            receipt.back(Duration::ZERO);
        }
    }

    /// What is asked while nobody hears it would wait for its time to run out.
    fn is_connected(&self) -> Result<(), Error> {
        if self.client.connection_state() == State::Connected { Ok(()) } else { Err("not connected".into()) }
    }

    async fn send(&self, hint: &Hint) -> Result<(), Error> {
        self.is_connected()?;
        let told = serde_json::to_vec(&Told { version: VERSION, marker: hint.marker.clone() })?;
        let message = PublishMessage::build().payload(told.into()).message_id(&hint.marker);
        timeout(ANSWER, async {
            self.context.send_publish(self.subject.clone(), message).await?.await?;
            Ok(())
        })
        .await?
    }

    /// Sends a hint, once more where the queue was found missing.
    async fn tell(&self, hint: &Hint) {
        let mut sent = self.send(hint).await;
        if sent.is_err() {
            let mut found = self.found.subscribe();
            found.mark_unchanged();
            self.missing.notify_one();
            let _ = timeout(AGAIN, found.changed()).await;
            sent = self.send(hint).await;
        }
        match sent {
            Ok(()) => drop(self.counts.sent.fetch_add(1, Ordering::Relaxed)),
            Err(error) => self.lose(hint, &error.to_string()),
        }
    }

    fn lose(&self, hint: &Hint, error: &str) {
        self.counts.lost.fetch_add(1, Ordering::Relaxed);
        tracing::debug!(marker = hint.marker, error, "not told of; the sweep finds it");
        if let Some(here) = &self.here {
            here.push(hint);
        }
    }
}

/// The next hint; none where there is none within [`PULL`].
async fn next(consumer: &PullConsumer) -> Result<Option<Message>, Error> {
    let mut messages = consumer.batch().max_messages(1).expires(PULL).messages().await?;
    messages.next().await.transpose()
}

/// What a message tells; none where it is no hint of this version.
fn read(bytes: &[u8]) -> Option<Hint> {
    let told: Told = Some(bytes).filter(|b| b.len() <= HINT_BYTES).and_then(|b| serde_json::from_slice(b).ok())?;
    (told.version == VERSION && records::is_marker(&told.marker)).then_some(Hint { marker: told.marker })
}

/// Tells the queue what becomes of a hint, as far as it hears it.
fn say(runtime: &Handle, message: Message, kind: AckKind) {
    runtime.spawn(async move {
        if let Err(error) = message.ack_with(kind).await {
            tracing::debug!(%error, "the queue was not told");
        }
    });
}

struct Said {
    message: Message,
    runtime: Handle,
}

impl std::fmt::Debug for Said {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Said").finish_non_exhaustive()
    }
}

impl Receipt for Said {
    fn extend(&self) {
        say(&self.runtime, self.message.clone(), AckKind::Progress);
    }

    fn done(&self) {
        say(&self.runtime, self.message.clone(), AckKind::Ack);
    }

    fn back(&self, delay: Duration) {
        say(&self.runtime, self.message.clone(), AckKind::Nak(Some(delay)));
    }
}

impl Queue for JetStream {
    fn offer(&self, hint: &Hint) {
        let Ok(place) = Arc::clone(&self.0.sending).try_acquire_owned() else {
            return self.0.lose(hint, "as many are being sent as may");
        };
        let (inner, hint) = (Arc::clone(&self.0), hint.clone());
        self.0.runtime.spawn(async move {
            inner.tell(&hint).await;
            drop(place);
        });
    }

    fn push(&self, hint: &Hint) {
        if let Some(here) = &self.0.here {
            here.push(hint);
        }
    }

    fn has(&self, hint: &Hint) -> bool {
        // where nothing is made nothing is taken up
        self.0.here.as_ref().is_none_or(|here| here.has(hint))
    }

    fn keep(&self, pending: &[String], listed: Instant) {
        if let Some(here) = &self.0.here {
            here.keep(pending, listed);
        }
    }

    fn lease(&self, wait: Duration) -> Option<Box<dyn Lease>> {
        let Some(here) = &self.0.here else {
            std::thread::sleep(wait);
            return None;
        };
        here.lease(wait)
    }

    fn counts(&self) -> Vec<Figure> {
        let of = |count: &AtomicU64| count.load(Ordering::Relaxed) as f64;
        let Counts { sent, lost, taken, redelivered, dropped, .. } = &self.0.counts;
        let found = f64::from(u8::from(self.0.found.borrow().is_some()));
        vec![
            gauge("tmpi_hints_queue", "Whether the queue of JetStream is there", found),
            counter("tmpi_hints_sent", "Hints that JetStream took", of(sent)),
            counter("tmpi_hints_lost", "Hints that JetStream did not take; the sweep finds what they tell of", of(lost)),
            counter("tmpi_hints_taken", "Hints of JetStream that a worker took", of(taken)),
            counter("tmpi_hints_redelivered", "Hints that JetStream gave again", of(redelivered)),
            counter("tmpi_hints_dropped", "Messages of JetStream that were no hints", of(dropped)),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::id::PhotoId;

    #[test]
    fn what_is_no_hint_is_none() {
        let marker = records::Marker::name_of(PhotoId::of(&[1; 32], None, "", ""), "0000000000007-00ff-1");
        let told = |version: u32, marker: &str| serde_json::to_vec(&Told { version, marker: marker.to_owned() }).unwrap();
        assert_eq!(read(&told(1, &marker)), Some(Hint { marker: marker.clone() }));
        let up = marker.replace("pending/", "pending/../photos/");
        let long = marker.replace("pending/", &format!("pending/{}", "0".repeat(HINT_BYTES)));
        for wrong in [told(2, &marker), told(1, &up), told(1, &long), told(1, "pending/"), told(1, ""), b"{}".to_vec(), Vec::new()] {
            assert_eq!(read(&wrong), None, "{}", String::from_utf8_lossy(&wrong));
        }
    }
}
