//! Change events. A receiver that has missed events gets [`Event::Gap`], and should read what it follows again.
//!
//! With SQLite, the events of a committed transaction go to the receivers of this process. With PostgreSQL, they go to every node,
//! including this one, by `NOTIFY` within the transaction.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use sqlx::postgres::PgListener;
use tokio::sync::broadcast;
use tokio::task::JoinSet;
use tokio::time::timeout;

use crate::error::Result;
use crate::ids::PhotoId;
use crate::recent_photos::RecentPhotos;

/// PostgreSQL's channel.
pub(crate) const CHANNEL: &str = "tmpi_library";
/// Number of events by which a receiver may lag.
const BEHIND: usize = 1024;
/// Longest notification in bytes: PostgreSQL's limit is 8 000.
const MAX_BYTES: usize = 7_900;
/// Pause before reconnecting.
const RECONNECT: Duration = Duration::from_millis(500);
/// Silence after which the connection is checked, and the timeout of the check.
const SILENCE: Duration = Duration::from_secs(15);
const ANSWER: Duration = Duration::from_secs(5);

/// An event.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Event {
    /// A photo was accepted or changed, or one of its exports was.
    Photo(PhotoId),
    /// A worker reports progress.
    Progress {
        /// The photo.
        photo: PhotoId,
        /// The worker's report, a JSON object.
        progress: Value,
    },
    /// A photo was deleted.
    Deleted(PhotoId),
    /// A key, or links to a photo, were revoked: check the access of open connections again.
    Revoked,
    /// A delivery to a webhook waits.
    Delivery,
    /// Some events were lost: read again what you follow.
    Gap,
}

/// Receives events.
#[derive(Debug)]
pub struct Subscription(broadcast::Receiver<Event>);

impl Subscription {
    /// The next event; `None` once the library is closed.
    pub async fn next(&mut self) -> Option<Event> {
        match self.0.recv().await {
            Ok(event) => Some(event),
            Err(broadcast::error::RecvError::Lagged(_)) => Some(Event::Gap),
            Err(broadcast::error::RecvError::Closed) => None,
        }
    }

    /// The next event if one has arrived already.
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
    /// The last progress of each photo, for new followers.
    progress: Mutex<HashMap<PhotoId, Value>>,
    recent: RecentPhotos,
}

impl Receivers {
    fn deliver(&self, event: Event) {
        let mut progress = self.progress.lock().unwrap_or_else(PoisonError::into_inner);
        match &event {
            Event::Progress { photo, progress: said } => drop(progress.insert(*photo, said.clone())),
            Event::Photo(photo) | Event::Deleted(photo) => {
                progress.remove(photo);
                self.recent.forget(*photo);
            }
            Event::Gap => progress.clear(),
            // links to a photo end by a change of its row
            Event::Revoked => self.recent.clear(),
            Event::Delivery => {}
        }
        drop(progress);
        // fails without receivers
        let _ = self.sender.send(event);
    }
}

/// Sends events, and receives those of other nodes.
#[derive(Clone, Debug)]
pub(crate) struct Events {
    receivers: Arc<Receivers>,
    /// The task that receives those of other nodes, which ends with the last clone.
    listener: Option<Arc<JoinSet<()>>>,
}

impl Events {
    /// Connects the receivers of this process; with a PostgreSQL `url`, those of all nodes.
    pub async fn open(url: Option<&str>) -> Result<Self> {
        let receivers =
            Arc::new(Receivers { sender: broadcast::Sender::new(BEHIND), progress: Mutex::default(), recent: RecentPhotos::default() });
        let listener = match url {
            Some(url) => {
                let mut task = JoinSet::new();
                task.spawn(listen(url.to_owned(), connect(url).await?, Arc::clone(&receivers)));
                Some(Arc::new(task))
            }
            None => None,
        };
        Ok(Self { receivers, listener })
    }

    pub fn subscribe(&self) -> Subscription {
        Subscription(self.receivers.sender.subscribe())
    }

    /// The last progress of a photo.
    pub fn progress(&self, photo: PhotoId) -> Option<Value> {
        self.receivers.progress.lock().unwrap_or_else(PoisonError::into_inner).get(&photo).cloned()
    }

    /// Photos that were read a moment ago. `None` if other nodes may change them: their events arrive later than their changes.
    pub fn recent(&self) -> Option<&RecentPhotos> {
        self.listener.is_none().then_some(&self.receivers.recent)
    }

    /// Sends the events of a committed transaction to this process's receivers. Those of other nodes arrive through the listener.
    pub fn committed(&self, events: Vec<Event>) {
        if self.listener.is_none() {
            for event in events {
                self.receivers.deliver(event);
            }
        }
    }

    /// The payload of a notification. A progress that is too long becomes [`Event::Photo`].
    pub fn payload(event: &Event) -> Result<String> {
        let text = crate::photo::to_json(event)?;
        match event {
            Event::Progress { photo, .. } if text.len() > MAX_BYTES => crate::photo::to_json(&Event::Photo(*photo)),
            _ => Ok(text),
        }
    }
}

async fn connect(url: &str) -> Result<PgListener> {
    let mut listener = PgListener::connect(url).await?;
    listener.listen(CHANNEL).await?;
    Ok(listener)
}

async fn listen(url: String, mut listener: PgListener, receivers: Arc<Receivers>) {
    loop {
        let error = loop {
            let heard = match timeout(SILENCE, listener.try_recv()).await {
                Ok(heard) => heard,
                // a half-open connection is silent, too
                Err(_) => match timeout(ANSWER, sqlx::query("SELECT 1").execute(&mut listener)).await {
                    Ok(Ok(_)) => continue,
                    Ok(Err(error)) => Err(error),
                    Err(_) => Err(sqlx::Error::Io(std::io::ErrorKind::TimedOut.into())),
                },
            };
            match heard {
                // an event of a newer version is a gap
                Ok(Some(notification)) => receivers.deliver(serde_json::from_str(notification.payload()).unwrap_or(Event::Gap)),
                Ok(None) => receivers.deliver(Event::Gap),
                Err(error) => break error,
            }
        };
        tracing::warn!(%error, "lost the connection for events");
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
        assert_eq!(Events::payload(&event(MAX_BYTES)).unwrap(), Events::payload(&Event::Photo(photo)).unwrap());
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
