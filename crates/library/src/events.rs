//! What others are told at once. A receiver that misses something is told so, and reads again what it follows.
//!
//! With SQLite the events of a transaction go to the receivers of this process once it is committed. With PostgreSQL they go by `NOTIFY` within the
//! transaction to every node, this one included.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use sqlx::postgres::PgListener;
use tokio::sync::broadcast;
use tokio::task::JoinHandle;
use tokio::time::timeout;

use crate::error::Result;
use crate::names::PhotoId;

/// PostgreSQL's channel.
pub(crate) const CHANNEL: &str = "tmpi_library";
/// Events that a receiver may be behind.
const BEHIND: usize = 1024;
/// Bytes of a notification: PostgreSQL's limit is 8 000.
const MOST_BYTES: usize = 7_900;
/// Pause before a lost connection is tried again.
const RECONNECT: Duration = Duration::from_millis(500);
/// Silence after which the connection is tried, and time for the answer.
const SILENCE: Duration = Duration::from_secs(15);
const ANSWER: Duration = Duration::from_secs(5);

/// What has happened.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Event {
    /// A photo was accepted or changed, or one of its exports was.
    Photo(PhotoId),
    /// A worker says how far it is.
    Progress {
        /// With which photo.
        photo: PhotoId,
        /// In the worker's own words, a JSON object.
        progress: Value,
    },
    /// A photo was deleted.
    Deleted(PhotoId),
    /// Somebody's key or session ended before its time, or links to a photo were taken back: whoever was let in is to be asked again.
    Revoked,
    /// Some events were lost: read again what you follow.
    Gap,
}

/// Receives events.
#[derive(Debug)]
pub struct Subscription(broadcast::Receiver<Event>);

impl Subscription {
    /// The next event; none once the library is closed.
    pub async fn next(&mut self) -> Option<Event> {
        match self.0.recv().await {
            Ok(event) => Some(event),
            Err(broadcast::error::RecvError::Lagged(_)) => Some(Event::Gap),
            Err(broadcast::error::RecvError::Closed) => None,
        }
    }

    /// The next event that is here already; none where there is none.
    pub fn try_next(&mut self) -> Option<Event> {
        match self.0.try_recv() {
            Ok(event) => Some(event),
            Err(broadcast::error::TryRecvError::Lagged(_)) => Some(Event::Gap),
            Err(broadcast::error::TryRecvError::Empty | broadcast::error::TryRecvError::Closed) => None,
        }
    }
}

#[derive(Debug)]
struct Receivers {
    sender: broadcast::Sender<Event>,
    /// What workers said last, for whoever begins to follow a photo.
    progress: Mutex<HashMap<PhotoId, Value>>,
}

impl Receivers {
    fn deliver(&self, event: Event) {
        let mut progress = self.progress.lock().unwrap_or_else(PoisonError::into_inner);
        match &event {
            Event::Progress { photo, progress: said } => drop(progress.insert(*photo, said.clone())),
            Event::Photo(photo) | Event::Deleted(photo) => drop(progress.remove(photo)),
            Event::Gap => progress.clear(),
            Event::Revoked => {}
        }
        drop(progress);
        // nobody listens: nobody is to be told
        let _ = self.sender.send(event);
    }
}

/// Sends events, and hears those of other nodes.
#[derive(Clone, Debug)]
pub(crate) struct Events {
    receivers: Arc<Receivers>,
    listener: Option<Arc<Listener>>,
}

#[derive(Debug)]
struct Listener(JoinHandle<()>);

impl Drop for Listener {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl Events {
    /// Within one process; or with a PostgreSQL `url` among all nodes.
    pub async fn open(url: Option<&str>) -> Result<Self> {
        let receivers = Arc::new(Receivers { sender: broadcast::Sender::new(BEHIND), progress: Mutex::default() });
        let listener = match url {
            Some(url) => {
                let first = connect(url).await?;
                Some(Arc::new(Listener(tokio::spawn(listen(url.to_owned(), first, Arc::clone(&receivers))))))
            }
            None => None,
        };
        Ok(Self { receivers, listener })
    }

    pub fn subscribe(&self) -> Subscription {
        Subscription(self.receivers.sender.subscribe())
    }

    /// What a worker said last of a photo.
    pub fn progress(&self, photo: PhotoId) -> Option<Value> {
        self.receivers.progress.lock().unwrap_or_else(PoisonError::into_inner).get(&photo).cloned()
    }

    /// Tells this process's receivers of what is committed. Other nodes' events come by the listener.
    pub fn committed(&self, events: Vec<Event>) {
        if self.listener.is_none() {
            for event in events {
                self.receivers.deliver(event);
            }
        }
    }

    /// The payload of a notification; a progress that is too long only says that there is news.
    pub fn payload(event: &Event) -> Result<String> {
        let text = crate::photo::to_json(event)?;
        match event {
            Event::Progress { photo, .. } if text.len() > MOST_BYTES => crate::photo::to_json(&Event::Photo(*photo)),
            _ => Ok(text),
        }
    }
}

async fn connect(url: &str) -> Result<PgListener> {
    let mut listener = PgListener::connect(url).await?;
    listener.listen(CHANNEL).await?;
    Ok(listener)
}

async fn listen(url: String, first: PgListener, receivers: Arc<Receivers>) {
    let mut listener = first;
    loop {
        let error = loop {
            let heard = match timeout(SILENCE, listener.try_recv()).await {
                Ok(heard) => heard,
                // a connection that is half open says nothing, either
                Err(_) => match timeout(ANSWER, sqlx::query("SELECT 1").execute(&mut listener)).await {
                    Ok(Ok(_)) => continue,
                    Ok(Err(error)) => Err(error),
                    Err(_) => Err(sqlx::Error::Io(std::io::ErrorKind::TimedOut.into())),
                },
            };
            match heard {
                Ok(Some(notification)) => match serde_json::from_str(notification.payload()) {
                    Ok(event) => receivers.deliver(event),
                    // a node of a later version
                    Err(_) => receivers.deliver(Event::Gap),
                },
                Ok(None) => receivers.deliver(Event::Gap),
                Err(error) => break error,
            }
        };
        tracing::warn!(%error, "the connection for events is lost");
        listener = loop {
            tokio::time::sleep(RECONNECT).await;
            if let Ok(fresh) = connect(&url).await {
                break fresh;
            }
        };
        receivers.deliver(Event::Gap);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_progress_becomes_a_short_notice() {
        let photo = PhotoId::from_bytes([1; 16]);
        let event = |length| Event::Progress { photo, progress: Value::from("x".repeat(length)) };
        assert!(Events::payload(&event(10)).unwrap().contains("xxxxxxxxxx"));
        assert_eq!(Events::payload(&event(MOST_BYTES)).unwrap(), Events::payload(&Event::Photo(photo)).unwrap());
    }

    #[tokio::test]
    async fn a_slow_receiver_learns_that_it_missed_events() {
        let events = Events::open(None).await.unwrap();
        let mut slow = events.subscribe();
        events.committed((0..=BEHIND).map(|_| Event::Revoked).collect());
        assert_eq!(slow.next().await, Some(Event::Gap));
        assert_eq!(slow.next().await, Some(Event::Revoked));
    }
}
