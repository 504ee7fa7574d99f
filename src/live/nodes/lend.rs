//! What a node asks of the owner of a room for who comes by plain HTTP: the newest frame as a container, or pieces of a group of pictures.
//!
//! An answer is a packet of the sort [`Sort::Answer`]; `number` says what came of it ([`Code`]), `after` which frame, group or message it is.

use std::sync::Arc;
use std::time::Duration;

use async_nats::Subject;
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use tokio::sync::Semaphore;
use tokio::time::{Instant, timeout_at};

use super::table::Owner;
use super::wire::{Packet, Sort};
use super::{Ask, Nodes};
use crate::live::gops::{Group, Part};
use crate::live::room::{Newest, Room};

/// Answers of a room that are made at a time; who asks for more than that asks again.
const AT_ONCE: usize = 64;
/// Bytes of the pieces of a group that go in one answer, unless one piece alone has more; and parts of such an answer, which wait to be read.
const BATCH: (usize, usize) = (256 << 10, 64);
/// Time for which the owner waits for a piece that has not come yet.
const HOLD: Duration = Duration::from_millis(500);
/// Time that an answer may take, and how often it is asked for.
const ANSWER: (Duration, u32) = (Duration::from_secs(4), 3);

/// What is asked for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Get {
    /// The newest frame as a container.
    Frame,
    /// The number of the newest group of pictures.
    Latest,
    /// Messages of a group of pictures, from one of them on.
    Group(u64, u64),
}

/// What came of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u64)]
enum Code {
    /// There is no such thing.
    Gone,
    /// Here it is, or some of it.
    Found,
    /// Nothing more yet.
    Wait,
    /// That was all of the group.
    End,
    /// The group will be the next one to begin.
    NotYet,
}

/// Answers the nodes that ask for what is not handed on to all.
pub struct Lender {
    room: Arc<Room>,
    epoch: u64,
    making: Arc<Semaphore>,
}

impl Lender {
    /// Of a room that is this node's with `epoch`.
    pub fn new(room: Arc<Room>, epoch: u64) -> Self {
        Self { room, epoch, making: Arc::new(Semaphore::new(AT_ONCE)) }
    }

    /// Answers by itself, and holds up nobody.
    pub fn lend(&self, nodes: &Arc<Nodes>, get: Get, reply: Subject) {
        // whoever is not answered asks again
        let Ok(permit) = Arc::clone(&self.making).try_acquire_owned() else { return };
        let (nodes, room, epoch) = (Arc::clone(nodes), Arc::clone(&self.room), self.epoch);
        tokio::spawn(async move {
            let most = BATCH.0.min(BATCH.1 * nodes.client.max_payload());
            let (code, after, bytes) = match get {
                Get::Frame => match room.newest().await {
                    Ok(Some(newest)) if newest.epoch == epoch => (Code::Found, newest.number, newest.container),
                    _ => (Code::Gone, 0, Bytes::new()),
                },
                Get::Latest => match room.last_group().filter(|g| g.epoch == epoch) {
                    Some(group) => (Code::Found, group.number, Bytes::new()),
                    None => (Code::Gone, 0, Bytes::new()),
                },
                Get::Group(number, at) => batch(&room, Group { epoch, number }, at, most).await,
            };
            nodes.send(&reply, &Packet { sort: Sort::Answer, number: code as u64, after, bytes }).await;
            drop(permit);
        });
    }
}

/// Messages of a group from `at` on, each after its length, and the number of the one that comes next.
async fn batch(room: &Room, group: Group, at: u64, most: usize) -> (Code, u64, Bytes) {
    let (mut changes, until) = (room.watch(), Instant::now() + HOLD);
    let (mut next, mut out) = (at, Vec::new());
    loop {
        changes.mark_unchanged();
        let code = match room.group(group, usize::try_from(next).unwrap_or(usize::MAX)) {
            Part::Message(bytes) if out.is_empty() || out.len() + bytes.len() < most => {
                out.extend((bytes.len() as u32).to_le_bytes());
                out.extend_from_slice(&bytes);
                next += 1;
                continue;
            }
            // what was found goes first
            _ if next > at => Code::Found,
            Part::End => Code::End,
            Part::Gone => Code::Gone,
            part => {
                if timeout_at(until, changes.changed()).await.is_ok_and(|changed| changed.is_ok()) {
                    continue;
                }
                if part == Part::NotYet { Code::NotYet } else { Code::Wait }
            }
        };
        return (code, next, out.into());
    }
}

/// The owner of a room, of whom another node asks.
pub struct Borrower {
    nodes: Arc<Nodes>,
    room: String,
    owner: Owner,
}

/// The owner does not answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Silent;

impl Borrower {
    /// Of a room that another node has.
    pub fn of(nodes: &Arc<Nodes>, room: &str) -> Option<Self> {
        let owner = nodes.owner(room)?;
        Some(Self { nodes: Arc::clone(nodes), room: room.to_owned(), owner })
    }

    async fn get(&self, get: Get) -> Result<Packet, Silent> {
        let ask = Ask { node: self.nodes.me.clone(), room: self.room.clone(), epoch: self.owner.epoch, key: false, get: Some(get) };
        for _ in 0..ANSWER.1 {
            if let Some(packet) = self.nodes.request(&self.owner, &ask, Sort::Answer, ANSWER.0).await {
                return Ok(packet);
            }
            if self.nodes.owner(&self.room).as_ref() != Some(&self.owner) {
                break;
            }
        }
        Err(Silent)
    }

    /// The newest frame as a container; none where there is none yet.
    ///
    /// # Errors
    /// [`Silent`].
    pub async fn newest(&self) -> Result<Option<Newest>, Silent> {
        let packet = self.get(Get::Frame).await?;
        let found = packet.number == Code::Found as u64;
        Ok(found.then_some(Newest { epoch: self.owner.epoch, number: packet.after, container: packet.bytes }))
    }

    /// The newest group of pictures.
    ///
    /// # Errors
    /// [`Silent`].
    pub async fn latest(&self) -> Result<Option<Group>, Silent> {
        let packet = self.get(Get::Latest).await?;
        Ok((packet.number == Code::Found as u64).then_some(Group { epoch: self.owner.epoch, number: packet.after }))
    }

    /// Messages of a group from `at` on, each after its length, with the number of the next one.
    ///
    /// # Errors
    /// [`Silent`].
    pub async fn group(&self, group: Group, at: u64) -> Result<(Part, u64), Silent> {
        if group.epoch != self.owner.epoch {
            return Ok((Part::Gone, at));
        }
        let packet = self.get(Get::Group(group.number, at)).await?;
        let code = [Code::Found, Code::Wait, Code::End, Code::NotYet].into_iter().find(|c| *c as u64 == packet.number);
        let part = match code {
            Some(Code::Found) if packet.after > at => Part::Message(packet.bytes),
            Some(Code::Wait) => Part::Wait,
            Some(Code::End) => Part::End,
            Some(Code::NotYet) => Part::NotYet,
            _ => Part::Gone,
        };
        Ok((part, packet.after))
    }
}
