//! What nodes of one store tell each other at once, by plain messages of NATS: how the making of a photo goes on, and that a photo changed.
//!
//! Nothing depends on it: what is not heard is found by looking, and what is heard of ends and changes is looked up in the store.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use async_nats::Client;
use async_nats::connection::State;
use futures_util::StreamExt as _;
use serde::{Deserialize, Serialize};
use tokio::sync::mpsc;
use tokio::time::{sleep, timeout};

use super::ports::Figure;
use super::records;
use crate::server::id::PhotoId;
use crate::server::telemetry::{counter, gauge};
use tmpi_pipeline::{Progress, STAGES};

/// Version of notes; nodes of different ones do not hear each other.
const VERSION: u32 = 1;
/// Notes that wait to be sent, and to be read here; more are left out.
const WAITING: usize = 1024;
/// Bytes of a note.
const NOTE_BYTES: usize = 8 << 10;
/// Stages of a making, at most.
const MOST_STAGES: usize = 64;
/// Longest time for sending a note.
const SEND: Duration = Duration::from_secs(1);

/// A note as it travels.
#[derive(Debug, Serialize, Deserialize)]
struct Told {
    version: u32,
    #[serde(with = "records::id")]
    id: PhotoId,
    making: String,
    what: What,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum What {
    Making { claim: u32, stages: Vec<Stage> },
    Waiting { claim: u32 },
    Changed,
}

#[derive(Debug, Serialize, Deserialize)]
struct Stage {
    name: String,
    step: u32,
    steps: u32,
    elapsed_ms: f64,
}

/// Word of a photo.
#[derive(Clone, Debug, PartialEq)]
pub struct Note {
    /// The photo.
    pub id: PhotoId,
    /// Its making.
    pub making: String,
    /// What of it.
    pub news: News,
}

/// What there is to tell of a photo.
#[derive(Clone, Debug, PartialEq)]
pub enum News {
    /// It is being made, the `claim`-th time that a node took it up, and all stages that this one has entered.
    Making {
        /// Number of that claim; a later one counts.
        claim: u32,
        /// Stages in order.
        stages: Vec<Progress>,
    },
    /// Who took it up gave it back.
    Waiting {
        /// As above.
        claim: u32,
    },
    /// It ended, was changed, is to be made again, or was deleted: the store tells which.
    Changed,
}

impl Note {
    fn write(&self) -> serde_json::Result<Vec<u8>> {
        let stage = |p: &Progress| Stage { name: p.stage.to_owned(), step: p.step, steps: p.steps, elapsed_ms: p.elapsed_ms };
        let what = match &self.news {
            News::Making { claim, stages } => What::Making { claim: *claim, stages: stages.iter().map(stage).collect() },
            News::Waiting { claim } => What::Waiting { claim: *claim },
            News::Changed => What::Changed,
        };
        serde_json::to_vec(&Told { version: VERSION, id: self.id, making: self.making.clone(), what })
    }

    /// What a message tells; none where it cannot be meant.
    fn read(bytes: &[u8]) -> Option<Self> {
        let told: Told = Some(bytes).filter(|b| b.len() <= NOTE_BYTES).and_then(|b| serde_json::from_slice(b).ok())?;
        let known = |s: Stage| {
            let stage = STAGES.into_iter().find(|name| *name == s.name)?;
            let fits =
                (1..=s.steps).contains(&s.step) && s.steps as usize <= MOST_STAGES && s.elapsed_ms.is_finite() && s.elapsed_ms >= 0.0;
            fits.then_some(Progress { stage, step: s.step, steps: s.steps, elapsed_ms: s.elapsed_ms })
        };
        let news = match told.what {
            What::Making { claim, stages } if stages.len() <= MOST_STAGES => {
                News::Making { claim, stages: stages.into_iter().map(known).collect::<Option<_>>()? }
            }
            What::Making { .. } => return None,
            What::Waiting { claim } => News::Waiting { claim },
            What::Changed => News::Changed,
        };
        (told.version == VERSION && records::is_making(&told.making)).then_some(Self { id: told.id, making: told.making, news })
    }
}

/// This node's ear and mouth.
#[derive(Debug)]
pub struct Bus {
    client: Client,
    notes: mpsc::Sender<Vec<u8>>,
    heard: Mutex<Option<Receiver<Note>>>,
    told: AtomicU64,
    dropped: Arc<AtomicU64>,
}

impl Bus {
    /// Of the nodes of the store `key`. Called within a runtime, on which its tasks run until that ends.
    pub fn new(client: Client, key: &str) -> Self {
        let subject = format!("tmpi.photos.{key}");
        let (notes, to_send) = mpsc::channel(WAITING);
        let (hear, heard) = sync_channel(WAITING);
        let dropped = Arc::new(AtomicU64::new(0));
        tokio::spawn(speak(client.clone(), subject.clone(), to_send));
        tokio::spawn(listen(client.clone(), subject, hear, Arc::clone(&dropped)));
        Self { client, notes, heard: Mutex::new(Some(heard)), told: AtomicU64::new(0), dropped }
    }

    /// Tells the other nodes, as far as they can be reached now.
    pub fn tell(&self, note: &Note) {
        // one that is not told is found by looking
        if self.is_connected()
            && let Ok(bytes) = note.write()
            && self.notes.try_send(bytes).is_ok()
        {
            self.told.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// What others tell, for the one who asks first.
    pub fn heard(&self) -> Option<Receiver<Note>> {
        self.heard.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    fn is_connected(&self) -> bool {
        self.client.connection_state() == State::Connected
    }

    /// Names, meanings and values of what is counted.
    pub fn counts(&self) -> Vec<Figure> {
        let of = |count: &AtomicU64| count.load(Ordering::Relaxed) as f64;
        vec![
            gauge("tmpi_nats_connected", "Whether other nodes of the store can be heard", f64::from(u8::from(self.is_connected()))),
            counter("tmpi_notes_told", "Notes to other nodes", of(&self.told)),
            counter("tmpi_notes_dropped", "Notes of others that were none, or more than could be read", of(&self.dropped)),
        ]
    }
}

async fn speak(client: Client, subject: String, mut notes: mpsc::Receiver<Vec<u8>>) {
    while let Some(note) = notes.recv().await {
        // while NATS takes nothing, notes are left out
        let _ = timeout(SEND, client.publish(subject.clone(), note.into())).await;
    }
}

async fn listen(client: Client, subject: String, hear: SyncSender<Note>, dropped: Arc<AtomicU64>) {
    loop {
        if let Ok(mut notes) = client.subscribe(subject.clone()).await {
            while let Some(message) = notes.next().await {
                let heard = Note::read(&message.payload).is_some_and(|note| hear.try_send(note).is_ok());
                dropped.fetch_add(u64::from(!heard), Ordering::Relaxed);
            }
        }
        sleep(SEND).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn notes_are_read_as_they_were_written_and_what_cannot_be_is_none() {
        let stage = |stage, step| Progress { stage, step, steps: 9, elapsed_ms: 7.5 };
        let making = News::Making { claim: 2, stages: vec![stage(STAGES[0], 1), stage(STAGES[1], 2)] };
        let note = |news: News| Note { id: PhotoId::of(&[1; 32], None, "", ""), making: "0000000000007-ab-1".into(), news };
        for news in [making.clone(), News::Waiting { claim: 7 }, News::Changed] {
            assert_eq!(Note::read(&note(news.clone()).write().unwrap()), Some(note(news)));
        }
        let stages = |stages: Vec<Progress>| note(News::Making { claim: 1, stages });
        for wrong in [
            stages(vec![stage("no stage", 1)]),
            stages(vec![stage(STAGES[0], 0)]),
            stages(vec![stage(STAGES[0], 10)]),
            stages(vec![Progress { elapsed_ms: -1.0, ..stage(STAGES[0], 1) }]),
            stages(vec![stage(STAGES[0], 1); MOST_STAGES + 1]),
            Note { making: "../x".into(), ..note(News::Changed) },
            Note { making: String::new(), ..note(News::Changed) },
        ] {
            assert_eq!(Note::read(&wrong.write().unwrap()), None, "{wrong:?}");
        }
        let text = String::from_utf8(note(making).write().unwrap()).unwrap();
        for (what, by) in [("\"version\":1", "\"version\":2"), ("making", "baking"), ("\"id\":\"", "\"id\":\"0"), ("}", "")] {
            assert!(text.contains(what), "{text}");
            assert_eq!(Note::read(text.replace(what, by).as_bytes()), None, "{by}");
        }
        assert_eq!(Note::read(format!("{text}{}", " ".repeat(NOTE_BYTES)).as_bytes()), None, "too long");
    }
}
