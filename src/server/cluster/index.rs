//! The index of the store: names that sort newest first, so that no node needs to know all photos for a page of the list or an owner's sum.
//!
//! ```text
//! lists/all/LEFT.ID                   a photo; LEFT: milliseconds from when it was accepted to a day far away, so that later ones come first
//! lists/owners/OWNER/LEFT.ID.BYTES    the same among its owner's, with the bytes that count for a quota; of several the greatest counts
//! lists/built                         all photos are in it: Built; of a store that versions before wrote once a node has looked through it
//! lists/building                      how far that node, or another one, has come: Building
//! ```
//!
//! Entries are hints, of which the names say all; the photo's record is the truth. They are written before the record, so that no accepted photo
//! lacks them, and again when a making ends; they are removed after the record. Whoever reads one looks at the record: where there is none, or
//! one of another time, the entry is passed over, and removed once no upload can be on its way any more.

use std::io;
use std::ops::ControlFlow;
use std::sync::atomic::Ordering;

use serde::{Deserialize, Serialize};

use super::Cluster;
use super::claim::ORPHAN;
use super::look::side_by_side;
use super::ports::Ledger;
use super::records::{self, End, VERSION};
use crate::server::access::Owner;
use crate::server::id::PhotoId;
use crate::server::records::{self as outcome, Accepted};
use crate::server::time::now_ms;

/// Folder of the index.
pub const LISTS: &str = "lists/";
/// Folder of all photos, newest first.
pub const ALL: &str = "lists/all/";
/// Folder of the folders of owners.
pub const OWNERS: &str = "lists/owners/";
/// Record that says that the index has all photos.
pub const BUILT: &str = "lists/built";
/// Record of how far that has come.
pub const BUILDING: &str = "lists/building";

/// Milliseconds since 1970 of the day from which entries count back: in the year 2286, the last that 13 digits tell.
const FAR: u64 = 9_999_999_999_999;
/// What an entry holds: its name says the rest.
const ENTRY: &[u8] = b"{\"version\": 1}";
/// Behind all entries of a photo, and before those of the next.
const BEHIND: &str = ".:";
/// Names that are read at a time.
const PAGE: usize = 1000;
/// Entries of one photo among its owner's that are looked for.
const SIZES: usize = 16;

/// When a photo was accepted, in milliseconds since 1970, and which it is: its place in the lists.
pub type Place = (u64, PhotoId);

/// The index has all photos.
#[derive(Debug, Serialize, Deserialize)]
pub struct Built {
    /// [`VERSION`].
    pub version: u32,
}

/// How far photos were entered that versions before had accepted.
#[derive(Debug, Serialize, Deserialize)]
pub struct Building {
    /// [`VERSION`].
    pub version: u32,
    /// Name of the record of the last of them.
    pub after: String,
}

/// What the name of an entry says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Listed {
    /// Which photo, and when it was accepted.
    pub place: Place,
    /// Bytes that count for its owner; 0 in the list of all.
    pub bytes: u64,
}

impl Listed {
    /// What a name says; none where it is no entry's.
    pub fn read(name: &str) -> Option<Self> {
        let (rest, bytes) = if let Some(rest) = name.strip_prefix(ALL) {
            (rest, 0)
        } else {
            let (_, rest) = name.strip_prefix(OWNERS)?.split_once('/')?;
            let (rest, bytes) = rest.rsplit_once('.')?;
            (rest, bytes.parse().ok()?)
        };
        let (left, id) = rest.split_once('.')?;
        let left: u64 = left.parse().ok().filter(|_| left.len() == 13)?;
        Some(Self { place: (FAR - left, id.parse().ok()?), bytes })
    }
}

/// Begin of the name of an entry within its folder.
pub fn stem((at_ms, id): Place) -> String {
    format!("{:013}.{id}", FAR.saturating_sub(at_ms))
}

/// Folder of an owner's photos; none where the owner is no text of this program's, which must not lead anywhere else.
fn folder_of(owner: &Owner) -> Option<String> {
    let text = owner.text();
    let is_hash = (1..=64).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_hexdigit());
    is_hash.then(|| format!("{OWNERS}{text}/"))
}

/// Bytes that a photo counts for beyond its upload, by how its making ended.
pub fn made(end: Option<&outcome::End>) -> u64 {
    if let Some(outcome::End::Done(done)) = end { done.atlas_bytes } else { 0 }
}

/// Names of a photo's entries, of which what was made has `made` bytes.
pub fn names(id: PhotoId, accepted: &Accepted, made: u64) -> Vec<String> {
    let all = format!("{ALL}{}", stem((accepted.at_ms, id)));
    [Some(all), theirs(id, accepted, made)].into_iter().flatten().collect()
}

/// Name of a photo's entry among its owner's.
fn theirs(id: PhotoId, accepted: &Accepted, made: u64) -> Option<String> {
    let folder = accepted.owner.as_ref().and_then(folder_of)?;
    Some(format!("{folder}{}.{}", stem((accepted.at_ms, id)), accepted.bytes().saturating_add(made)))
}

/// Enters a photo; where it is entered already, nothing happens.
///
/// # Errors
/// The store cannot be reached.
pub fn enter(ledger: &dyn Ledger, id: PhotoId, accepted: &Accepted, made: u64) -> io::Result<()> {
    names(id, accepted, made).iter().try_for_each(|name| ledger.create(name, ENTRY).map(drop))
}

/// Removes the entries at a place, among all and among `owner`'s, but those to `keep`.
///
/// # Errors
/// The store cannot be reached.
pub fn leave(ledger: &dyn Ledger, place: Place, owner: Option<&Owner>, keep: &[String]) -> io::Result<()> {
    let stem = stem(place);
    let mut there = vec![format!("{ALL}{stem}")];
    if let Some(folder) = owner.and_then(folder_of) {
        let first = format!("{folder}{stem}");
        let theirs = ledger.page(&folder, Some(&first), SIZES)?;
        there.extend(theirs.into_iter().take_while(|name| name.strip_prefix(&first).is_some_and(|rest| rest.starts_with('.'))));
    }
    there.iter().filter(|name| !keep.contains(name)).try_for_each(|name| ledger.remove(name))
}

impl Cluster {
    /// Entries behind `after`, newest first, of all photos or of `owner`'s, by at most `limit` names; each photo once. Also whether those were
    /// the last.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub(in crate::server) fn listed(&self, owner: Option<&Owner>, after: Option<Place>, limit: usize) -> io::Result<(Vec<Listed>, bool)> {
        let Some(folder) = owner.map_or_else(|| Some(ALL.to_owned()), folder_of) else { return Ok((Vec::new(), true)) };
        let mut after = after.map(|place| format!("{folder}{}{BEHIND}", stem(place)));
        loop {
            let mut names = self.heard(self.ledger.page(&folder, after.as_deref(), limit))?;
            let mut listed: Vec<Listed> = names.iter().filter_map(|name| Listed::read(name)).collect();
            let last = names.len() < limit;
            // names that are no entries' are passed over, however many
            if !listed.is_empty() || last {
                listed.dedup_by_key(|entry| entry.place);
                return Ok((listed, last));
            }
            after = names.pop();
        }
    }

    /// Goes through `owner`'s entries, newest first, each photo once with its bytes; a thousand names are asked for at a time.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub(in crate::server) fn each_of(&self, owner: &Owner, mut each: impl FnMut(PhotoId, u64) -> ControlFlow<()>) -> io::Result<()> {
        let Some(folder) = folder_of(owner) else { return Ok(()) };
        let (mut after, mut last) = (None::<String>, None::<Listed>);
        loop {
            let names = self.heard(self.ledger.page(&folder, after.as_deref(), PAGE))?;
            for next in names.iter().filter_map(|name| Listed::read(name)) {
                match &mut last {
                    // what was made again, and not all of it is removed yet
                    Some(listed) if listed.place == next.place => listed.bytes = listed.bytes.max(next.bytes),
                    _ => {
                        if let Some(listed) = last.replace(next)
                            && each(listed.place.1, listed.bytes).is_break()
                        {
                            return Ok(());
                        }
                    }
                }
            }
            if names.len() < PAGE {
                if let Some(listed) = last {
                    // nothing follows
                    let _ = each(listed.place.1, listed.bytes);
                }
                return Ok(());
            }
            after = names.last().cloned();
        }
    }

    /// Enters a photo among its owner's alone, before it is accepted; false where it is entered already.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub(in crate::server) fn enter_early(&self, id: PhotoId, accepted: &Accepted) -> io::Result<bool> {
        let Some(name) = theirs(id, accepted, 0) else { return Ok(false) };
        self.heard(self.ledger.create(&name, ENTRY))
    }

    /// Takes that back.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub(in crate::server) fn leave_early(&self, id: PhotoId, accepted: &Accepted) -> io::Result<()> {
        let Some(name) = theirs(id, accepted, 0) else { return Ok(()) };
        self.heard(self.ledger.remove(&name))?;
        // a twin of the same millisecond may have been accepted meanwhile, and had the same entry
        self.heard(self.enter_now(id))
    }

    /// Removes the entries at a place where no photo is, once an upload that wrote them cannot be on its way any more.
    pub(in crate::server) fn left(&self, owner: Option<&Owner>, place: Place) {
        if u128::from(now_ms().saturating_sub(place.0)) < ORPHAN.as_millis() {
            return;
        }
        match leave(&*self.ledger, place, owner, &[]) {
            Ok(()) => tracing::info!(id = %place.1, "a photo that is gone was taken off the list"),
            Err(error) => tracing::debug!(id = %place.1, %error, "it stays on the list"),
        }
    }

    /// Has a photo's entries say what `making` made of it, and no other ones stay; where another making counts by now, nothing happens.
    pub(super) fn settle_entries(&self, id: PhotoId, accepted: &Accepted, making: &str, end: &End) {
        let keep = names(id, accepted, made(Some(&end.outcome)));
        if keep.len() > 1
            && let Err(error) = self.settle(id, accepted, making, &keep)
        {
            tracing::warn!(%id, %error, "an entry is left behind, which counts the photo as larger than it is");
        }
    }

    fn settle(&self, id: PhotoId, accepted: &Accepted, making: &str, keep: &[String]) -> io::Result<()> {
        if self.read_up(id)?.is_none_or(|now| now.photo.making != making) {
            return Ok(());
        }
        leave(&*self.ledger, (accepted.at_ms, id), accepted.owner.as_ref(), keep)?;
        // what another making entered meanwhile went with them; and who settled late may have removed what this one did
        self.enter_now(id)
    }

    /// True once the index is known to have all photos of the store.
    pub(in crate::server) fn is_built(&self) -> bool {
        self.built.load(Ordering::Acquire)
    }

    /// Enters the next photos of a store that versions before wrote, a thousand at a time; true once there are no more. Of several nodes that do
    /// so at a time each goes on from where the others are.
    ///
    /// # Errors
    /// The store cannot be reached, or the record of how far it has come is not understood.
    pub(super) fn build_on(&self) -> io::Result<bool> {
        self.heard(self.build_page(PAGE)).inspect(|built| self.built.store(*built, Ordering::Release))
    }

    pub(super) fn build_page(&self, limit: usize) -> io::Result<bool> {
        if self.ledger.get(BUILT)?.is_some() {
            return Ok(true);
        }
        let seen = self.ledger.get(BUILDING)?;
        let before = seen.as_ref().map(|(bytes, _)| records::read::<Building>(BUILDING, bytes)).transpose()?;
        let names = self.ledger.page(records::PHOTOS, before.as_ref().map(|before| before.after.as_str()), limit)?;
        let ids: Vec<PhotoId> = names.iter().filter_map(|name| name.strip_prefix(records::PHOTOS)?.parse().ok()).collect();
        side_by_side(&ids, |id| self.enter_now(*id)).into_iter().collect::<io::Result<()>>()?;
        let Some(last) = names.last().filter(|_| names.len() == limit) else {
            // of any number who come to the end one creates it
            self.ledger.create(BUILT, &serde_json::to_vec_pretty(&Built { version: VERSION })?)?;
            self.ledger.remove(BUILDING)?;
            return Ok(true);
        };
        let now = serde_json::to_vec_pretty(&Building { version: VERSION, after: last.clone() })?;
        // where another was faster, it is gone on from there
        match seen {
            Some((_, tag)) => drop(self.ledger.swap(BUILDING, &tag, &now)?),
            None => drop(self.ledger.create(BUILDING, &now)?),
        }
        Ok(false)
    }

    /// Enters a photo as it is in the store now: a version before may have accepted it.
    fn enter_now(&self, id: PhotoId) -> io::Result<()> {
        match self.read_up(id) {
            Ok(Some(known)) => enter(&*self.ledger, id, &known.photo.accepted, made(known.end.as_ref().map(|end| &end.outcome))),
            Ok(None) => Ok(()),
            Err(error) if error.kind() == io::ErrorKind::InvalidData => {
                tracing::error!(%id, %error, "it is not on the list");
                Ok(())
            }
            Err(error) => Err(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn accepted(at_ms: u64, owner: Option<Owner>) -> Accepted {
        Accepted { version: 1, at_ms, photo_bytes: 5, depth_bytes: Some(2), options: std::collections::BTreeMap::new(), owner }
    }

    proptest! {
        #[test]
        fn names_say_what_they_are_of_and_later_photos_come_first(
            a in 0..FAR, b in 0..FAR, ids in any::<[[u8; 16]; 2]>(), made in 0..u64::MAX / 2, owned in any::<bool>(),
        ) {
            let owner = owned.then(|| Owner::of_secret("a"));
            let of = |at_ms, id: [u8; 16]| names(PhotoId::from_bytes(id), &accepted(at_ms, owner.clone()), made);
            let (one, two) = (of(a, ids[0]), of(b, ids[1]));
            prop_assert_eq!(one.len(), 1 + usize::from(owned));
            for (name, bytes) in one.iter().zip([0, 7 + made]) {
                prop_assert_eq!(Listed::read(name), Some(Listed { place: (a, PhotoId::from_bytes(ids[0])), bytes }));
            }
            for (one, two) in one.iter().zip(&two) {
                prop_assert_eq!(one.cmp(two), (b, ids[0]).cmp(&(a, ids[1])));
            }
        }

        #[test]
        fn other_names_are_no_entries(name in "(lists/(all|owners/[0-9a-f]{0,3})/)?[0-9a-f.:/]{0,60}") {
            if let Some(listed) = Listed::read(&name) {
                prop_assert!(name.contains(&stem(listed.place)));
            }
        }
    }

    #[test]
    fn an_owner_that_is_no_hash_has_no_folder() {
        for text in ["\"\"", "\"../../photos\"", "\"a/b\"", "\"ü\""] {
            assert_eq!(folder_of(&serde_json::from_str(text).unwrap()), None, "{text}");
        }
        assert!(folder_of(&Owner::of_secret("a")).is_some());
    }
}
