//! What a node asks of the owner of a room for who comes by plain HTTP: a frame as a container, or pieces of a group of pictures.
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
use crate::live::past::{self, Made, Missing, Wanted};
use crate::live::room::Room;
use crate::server::{Problem, RoomViews};

/// Answers of a room that are made at a time; who asks for more than that asks again.
const AT_ONCE: usize = 64;
/// Bytes of the pieces of a group that go in one answer, unless one piece alone has more; and parts of such an answer, which wait to be read.
const BATCH: (usize, usize) = (256 << 10, 64);
/// Time for which the owner waits for a piece that has not come yet.
const HOLD: Duration = Duration::from_millis(500);
/// Bytes of the reason why there is no frame, at most.
const REASON: usize = 4 << 10;
/// Time that an answer may take, and how often it is asked for.
const ANSWER: (Duration, u32) = (Duration::from_secs(4), 3);

/// What is asked for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Get {
    /// A frame as a container: that of the number, or the newest.
    Frame(Option<u64>),
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
    /// There is no such frame now: the bytes say why, as JSON of a [`Problem`].
    Refused,
}

/// Answers the nodes that ask for what is not handed on to all.
pub struct Lender {
    name: Arc<str>,
    room: Arc<Room>,
    views: RoomViews,
    epoch: u64,
    making: Arc<Semaphore>,
}

impl Lender {
    /// Of a room that is this node's with `epoch`; `views` makes what came earlier.
    pub fn new((name, room): (&str, Arc<Room>), epoch: u64, views: RoomViews) -> Self {
        Self { name: name.into(), room, views, epoch, making: Arc::new(Semaphore::new(AT_ONCE)) }
    }

    /// Answers by itself, and holds up nobody.
    pub fn lend(&self, nodes: &Arc<Nodes>, get: Get, reply: Subject) {
        // whoever is not answered asks again
        let Ok(permit) = Arc::clone(&self.making).try_acquire_owned() else { return };
        let (nodes, room, epoch) = (Arc::clone(nodes), Arc::clone(&self.room), self.epoch);
        let (name, views) = (Arc::clone(&self.name), self.views.clone());
        tokio::spawn(async move {
            let most = BATCH.0.min(BATCH.1 * nodes.client.max_payload());
            let (code, after, bytes) = match get {
                Get::Frame(number) => frame((&name, &room), epoch, number, &views).await,
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

async fn frame(room: (&str, &Room), epoch: u64, number: Option<u64>, views: &RoomViews) -> (Code, u64, Bytes) {
    let wanted = number.map_or(Wanted::Latest, |number| Wanted::Frame { epoch: Some(epoch), number });
    match past::frame(room, wanted, views).await {
        Ok(made) if made.epoch == epoch => (Code::Found, made.number, made.container),
        Ok(made) => refused(&Missing::Epoch(made.epoch).into()),
        Err(problem) => refused(&problem),
    }
}

fn refused(problem: &Problem) -> (Code, u64, Bytes) {
    (Code::Refused, u64::MAX, serde_json::to_vec(problem).unwrap_or_default().into())
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

    /// A frame as a container, or why there is none.
    ///
    /// # Errors
    /// [`Silent`].
    pub async fn frame(&self, wanted: Wanted) -> Result<Result<Made, Problem>, Silent> {
        let epoch = self.owner.epoch;
        if let Wanted::Frame { epoch: Some(asked), .. } = wanted
            && asked != epoch
        {
            return Ok(Err(Missing::Epoch(epoch).into()));
        }
        let packet = self.get(Get::Frame(wanted.number())).await?;
        if packet.number == Code::Found as u64 {
            return Ok(Ok(Made { epoch, number: packet.after, container: packet.bytes }));
        }
        // what is no reason of ours is none
        let reason = Some(&packet.bytes).filter(|bytes| packet.number == Code::Refused as u64 && bytes.len() <= REASON);
        let problem =
            reason.and_then(|bytes| serde_json::from_slice::<Problem>(bytes).ok()).filter(|p| matches!(p.status, 404 | 500 | 503));
        Ok(Err(problem.unwrap_or_else(|| Problem::not_found("that frame is not kept"))))
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
