//! Who has which room: what every node says of itself, and which of two keeps a room that both took.
//!
//! Nothing here waits or sends, so that every course of things can be tested: time comes in with each call.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::live::{Bounds, is_name};

/// Version of what nodes say to each other; others are not understood.
pub const VERSION: u32 = 1;
/// Pause between two words of a node.
pub const BEAT: Duration = Duration::from_millis(300);
/// Silence after which a node's rooms are free: four words that did not come.
pub const LOST: Duration = Duration::from_millis(1200);
/// Time that others have to object to a claim.
pub const WINDOW: Duration = Duration::from_millis(150);
/// Time for which it is remembered what a silent node had, for whoever cannot ask.
const REMEMBERED: Duration = Duration::from_mins(1);
/// Nodes that are listened to.
const NODES: usize = 64;
/// Rooms of a node, those that it has and those that it watches.
const ROOMS: usize = Bounds::MOST_ROOMS;
/// Milliseconds by which an epoch may be ahead of this node's clock: one that were the last could never be followed by another.
const AHEAD: u64 = 24 * 3600 * 1000;

/// What a node says of itself: every [`BEAT`], and at once where something changed or somebody else claims what it has.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Presence {
    /// [`VERSION`].
    pub version: u32,
    /// Its name and a number of this run.
    pub node: String,
    /// Rooms whose publisher is here, or that it claims.
    pub rooms: Vec<Held>,
    /// Rooms of others that are watched here.
    pub watched: Vec<Watched>,
    /// It stops: all this is free at once.
    #[serde(default)]
    pub leaving: bool,
}

/// A room of a node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Held {
    /// Its name.
    pub room: String,
    /// Its epoch; the higher one wins.
    pub epoch: u64,
    /// False: it is only claimed yet.
    pub open: bool,
}

/// A room that is watched.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Watched {
    /// Its name.
    pub room: String,
    /// How many watch it.
    pub viewers: u32,
}

/// Who has a room.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Owner {
    /// The node.
    pub node: String,
    /// The epoch.
    pub epoch: u64,
}

/// What is to be done after something was heard.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Heard {
    /// Say at once what this node has: somebody claims some of it, or has it too and must yield.
    pub answer: bool,
    /// Rooms of this node that another one has by right.
    pub lost: Vec<String>,
}

/// How a claim stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It is not decided before then.
    Wait(Instant),
    /// The room is this node's.
    Won,
    /// It is another one's.
    Taken,
}

struct Mine {
    epoch: u64,
    open: bool,
    began: Instant,
    lost: bool,
}

struct Other {
    heard: Instant,
    held: BTreeMap<String, (u64, bool)>,
    watched: BTreeMap<String, u32>,
}

/// All nodes, as far as they have been heard.
pub struct Table {
    me: String,
    mine: BTreeMap<String, Mine>,
    others: BTreeMap<String, Other>,
}

impl Table {
    /// Of a node that has heard nothing.
    pub fn new(me: String) -> Self {
        Self { me, mine: BTreeMap::new(), others: BTreeMap::new() }
    }

    /// Takes what another node says; none where that cannot be: it is to be counted and forgotten. `clock` is in milliseconds since 1970.
    pub fn hear(&mut self, said: Presence, now: Instant, clock: u64) -> Option<Heard> {
        let names = said.rooms.iter().map(|h| &h.room).chain(said.watched.iter().map(|w| &w.room));
        let fits = said.version == VERSION && is_id(&said.node) && said.rooms.len() <= ROOMS && said.watched.len() <= ROOMS;
        if !fits || !names.into_iter().all(|n| is_name(n)) || said.rooms.iter().any(|h| h.epoch == 0 || h.epoch > clock + AHEAD) {
            return None;
        }
        if said.node == self.me {
            return Some(Heard::default());
        }
        if said.leaving {
            self.others.remove(&said.node);
            return Some(Heard::default());
        }
        self.others.retain(|_, o| now.saturating_duration_since(o.heard) < REMEMBERED);
        if !self.others.contains_key(&said.node) && self.others.len() >= NODES {
            return None;
        }
        let mut heard = Heard::default();
        for Held { room, epoch, open } in &said.rooms {
            let Some(mine) = self.mine.get_mut(room) else { continue };
            let theirs_is_higher = (*epoch, said.node.as_str()) > (mine.epoch, self.me.as_str());
            match (mine.open, *open) {
                (true, true) if theirs_is_higher => {
                    self.mine.remove(room);
                    heard.lost.push(room.clone());
                }
                (true, _) => heard.answer = true,
                (false, true) => mine.lost = true,
                // of two that claim at once, one is left
                (false, false) => {
                    mine.lost |= theirs_is_higher;
                    heard.answer |= !theirs_is_higher;
                }
            }
        }
        let held = said.rooms.into_iter().map(|h| (h.room, (h.epoch, h.open))).collect();
        let watched = said.watched.into_iter().map(|w| (w.room, w.viewers)).collect();
        self.others.insert(said.node, Other { heard: now, held, watched });
        Some(heard)
    }

    /// Notes that a node watches a room, which it says by asking for it.
    pub fn watches(&mut self, node: &str, room: &str) {
        if let Some(other) = self.others.get_mut(node).filter(|o| o.watched.len() < ROOMS) {
            other.watched.entry(room.to_owned()).or_insert(1);
        }
    }

    fn living(&self, now: Instant) -> impl Iterator<Item = (&String, &Other)> {
        self.others.iter().filter(move |(_, o)| now.saturating_duration_since(o.heard) < LOST)
    }

    /// The node that has a room, this one left out.
    pub fn owner(&self, room: &str, now: Instant) -> Option<Owner> {
        let open = self.living(now).filter_map(|(node, o)| o.held.get(room).filter(|h| h.1).map(|h| (h.0, node)));
        open.max().map(|(epoch, node)| Owner { node: node.clone(), epoch })
    }

    /// Nodes that watch a room, and how many do so there.
    pub fn audience(&self, room: &str, now: Instant) -> (usize, u32) {
        let watched = self.living(now).filter_map(|(_, o)| o.watched.get(room));
        watched.fold((0, 0), |(nodes, viewers), v| (nodes + 1, viewers.saturating_add(*v)))
    }

    /// Whether a node was the last to have a room that could be heard of, however long it has been silent since.
    pub fn is_of_another(&self, room: &str) -> bool {
        self.others.values().any(|o| o.held.contains_key(room))
    }

    /// Claims a room with an epoch above `floor` and all that were heard of; none where somebody else claims it just now.
    pub fn claim(&mut self, room: &str, floor: u64, now: Instant, clock: u64) -> Option<u64> {
        let claimed = self.living(now).any(|(_, o)| o.held.get(room).is_some_and(|h| !h.1));
        if claimed || self.mine.contains_key(room) {
            return None;
        }
        let heard = self.others.values().filter_map(|o| o.held.get(room)).map(|h| h.0).max().unwrap_or(0);
        let epoch = clock.max(heard + 1).max(floor + 1);
        self.mine.insert(room.to_owned(), Mine { epoch, open: false, began: now, lost: false });
        Some(epoch)
    }

    /// How a claim of this node stands: it is won where nobody objects and whoever had the room has been silent for [`LOST`].
    pub fn judge(&mut self, room: &str, now: Instant) -> Verdict {
        let others = self.others.values().filter(|o| o.held.get(room).is_some_and(|h| h.1)).map(|o| o.heard + LOST).max();
        let Some(mine) = self.mine.get_mut(room).filter(|m| !m.lost) else { return Verdict::Taken };
        let until = others.map_or(mine.began + WINDOW, |o| o.max(mine.began + WINDOW));
        if now < until {
            return Verdict::Wait(until);
        }
        mine.open = true;
        Verdict::Won
    }

    /// Takes a claimed room without waiting for anyone: nobody can be asked.
    pub fn open(&mut self, room: &str) {
        if let Some(mine) = self.mine.get_mut(room) {
            mine.open = true;
        }
    }

    /// Whether this node has a room with this epoch.
    pub fn holds(&self, room: &str, epoch: u64) -> bool {
        self.mine.get(room).is_some_and(|m| m.open && m.epoch == epoch)
    }

    /// Gives a room back, where it is still held with that epoch.
    pub fn release(&mut self, room: &str, epoch: u64) {
        if self.mine.get(room).is_some_and(|m| m.epoch == epoch) {
            self.mine.remove(room);
        }
    }

    /// What this node says, with the rooms of others that are `watched` here.
    pub fn presence(&self, watched: Vec<Watched>, leaving: bool) -> Presence {
        let rooms = self.mine.iter().filter(|(_, m)| !m.lost);
        let rooms = rooms.map(|(room, m)| Held { room: room.clone(), epoch: m.epoch, open: m.open }).collect();
        Presence { version: VERSION, node: self.me.clone(), rooms, watched, leaving }
    }
}

/// Names of nodes are parts of subjects, as those of rooms.
fn is_id(node: &str) -> bool {
    is_name(node)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const CLOCK: u64 = 1_800_000_000_000;

    fn says(table: &Table) -> Presence {
        table.presence(Vec::new(), false)
    }

    fn tables() -> (Table, Table, Instant) {
        (Table::new("a".into()), Table::new("b".into()), Instant::now())
    }

    #[test]
    fn a_room_that_is_free_is_won_after_the_time_to_object() {
        let (mut a, mut b, now) = tables();
        let epoch = a.claim("attic", 0, now, CLOCK).unwrap();
        assert_eq!(epoch, CLOCK);
        assert_eq!(a.judge("attic", now), Verdict::Wait(now + WINDOW));
        assert_eq!(b.hear(says(&a), now, CLOCK), Some(Heard::default()));
        assert_eq!(b.owner("attic", now), None, "it is claimed only");
        assert_eq!(b.claim("attic", 0, now, CLOCK), None, "who comes later leaves it");
        assert_eq!(a.judge("attic", now + WINDOW), Verdict::Won);
        b.hear(says(&a), now + WINDOW, CLOCK).unwrap();
        assert_eq!(b.owner("attic", now + WINDOW), Some(Owner { node: "a".into(), epoch }));
        assert_eq!(a.claim("attic", 0, now, CLOCK), None, "once is enough");
        a.release("attic", epoch - 1);
        assert!(a.holds("attic", epoch));
        a.release("attic", epoch);
        assert!(!a.holds("attic", epoch));
    }

    #[test]
    fn a_living_owner_objects_and_a_silent_one_is_followed() {
        let (mut a, mut b, now) = tables();
        let first = a.claim("attic", 0, now, CLOCK).unwrap();
        a.open("attic");
        b.hear(says(&a), now, CLOCK).unwrap();
        // a clock that is behind takes nothing away from the order
        let second = b.claim("attic", 0, now + BEAT, CLOCK - 5000).unwrap();
        assert!(second > first);
        assert_eq!(b.judge("attic", now + BEAT + WINDOW), Verdict::Wait(now + LOST), "it may still be there");
        assert!(a.hear(says(&b), now + BEAT, CLOCK).unwrap().answer);
        b.hear(says(&a), now + BEAT, CLOCK).unwrap();
        assert_eq!(b.judge("attic", now + LOST * 2), Verdict::Taken);
        b.release("attic", second);
        // now it is silent
        let later = now + LOST * 2;
        let third = b.claim("attic", 0, later, CLOCK).unwrap();
        assert_eq!(b.judge("attic", later + WINDOW), Verdict::Won);
        // and back, as if nothing had been: the lower epoch yields
        assert!(b.hear(says(&a), later + WINDOW, CLOCK).unwrap().answer);
        let heard = a.hear(says(&b), later + WINDOW, CLOCK).unwrap();
        assert_eq!((heard.lost, third > first), (vec!["attic".to_owned()], true));
        assert!(!a.holds("attic", first) && b.holds("attic", third));
    }

    #[test]
    fn a_node_that_leaves_or_is_silent_has_nothing() {
        let (mut a, mut b, now) = tables();
        a.claim("attic", 0, now, CLOCK).unwrap();
        a.open("attic");
        b.hear(Presence { watched: vec![Watched { room: "cellar".into(), viewers: 3 }], ..says(&a) }, now, CLOCK).unwrap();
        assert_eq!((b.audience("cellar", now), b.audience("attic", now)), ((1, 3), (0, 0)));
        assert!(b.owner("attic", now + LOST.saturating_sub(BEAT)).is_some() && b.owner("attic", now + LOST).is_none());
        assert!(b.is_of_another("attic"), "but who cannot ask remembers it");
        assert_eq!(b.audience("cellar", now + LOST), (0, 0));
        b.hear(a.presence(Vec::new(), true), now, CLOCK).unwrap();
        assert!(b.owner("attic", now).is_none() && !b.is_of_another("attic"));
    }

    #[test]
    fn what_cannot_be_is_not_taken() {
        let (a, mut b, now) = tables();
        let held = |room: &str, epoch| Presence { rooms: vec![Held { room: room.into(), epoch, open: true }], ..says(&a) };
        for wrong in [
            held("no.room", CLOCK),
            held("*", CLOCK),
            held("", CLOCK),
            held("attic", 0),
            held("attic", u64::MAX),
            held("attic", CLOCK + AHEAD + 1),
            Presence { version: 2, ..says(&a) },
            Presence { node: "a.b".into(), ..says(&a) },
            Presence { rooms: vec![held("attic", CLOCK).rooms[0].clone(); ROOMS + 1], ..says(&a) },
        ] {
            assert_eq!(b.hear(wrong.clone(), now, CLOCK), None, "{wrong:?}");
        }
        assert!(b.hear(held("attic", CLOCK + AHEAD), now, CLOCK).is_some());
        for n in 1..NODES {
            assert!(b.hear(Presence { node: format!("n{n}"), ..says(&a) }, now, CLOCK).is_some());
        }
        assert_eq!(b.hear(Presence { node: "more".into(), ..says(&a) }, now, CLOCK), None, "as many as are listened to");
        assert!(b.hear(Presence { node: "more".into(), ..says(&a) }, now + REMEMBERED, CLOCK).is_some());
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]

        /// However late words come, once all have been heard one node has the room.
        #[test]
        fn of_nodes_that_claim_at_once_one_is_left(
            starts in prop::collection::vec((0u64..200, 0u64..300), 2..5),
            delays in prop::collection::vec(0u64..250, 64),
        ) {
            let (now, mut delay) = (Instant::now(), delays.iter().cycle());
            let mut tables: Vec<Table> = (0..starts.len()).map(|n| Table::new(format!("n{n}"))).collect();
            let mut way: Vec<(u64, usize, Presence)> = Vec::new();
            let mut wins = 0;
            for ms in 0..6000u64 {
                let at = now + Duration::from_millis(ms);
                let mut speak = vec![false; tables.len()];
                let (come, rest) = way.into_iter().partition(|(due, _, _)| *due <= ms);
                way = rest;
                for (_, to, said) in come {
                    speak[to] |= tables[to].hear(said, at, CLOCK + ms).unwrap().answer;
                }
                for (n, (start, skew)) in starts.iter().enumerate() {
                    let mut claimed = false;
                    if ms == *start {
                        claimed = tables[n].claim("attic", 0, at, CLOCK + ms - skew).is_some();
                    }
                    let open = tables[n].mine.get("attic").is_some_and(|m| m.open);
                    if !open && tables[n].mine.contains_key("attic") {
                        match tables[n].judge("attic", at) {
                            Verdict::Won => (wins, claimed) = (wins + 1, true),
                            Verdict::Taken => drop(tables[n].mine.remove("attic")),
                            Verdict::Wait(_) => {}
                        }
                    }
                    speak[n] |= claimed || ms % BEAT.as_millis() as u64 == 0;
                }
                for from in (0..tables.len()).filter(|n| speak[*n]) {
                    for to in (0..tables.len()).filter(|to| *to != from) {
                        way.push((ms + delay.next().unwrap(), to, tables[from].presence(Vec::new(), false)));
                    }
                }
            }
            let owners = tables.iter().filter(|t| t.mine.contains_key("attic")).count();
            prop_assert!(owners == 1 && wins >= 1, "{owners} owners");
        }
    }
}
