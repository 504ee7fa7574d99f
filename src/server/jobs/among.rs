//! The list where several nodes share a store: a page of the store's index, and what the store has of each photo on it.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;

use super::{Jobs, Page, Whose};
use crate::server::access::Owner;
use crate::server::cluster::{Cluster, Place, side_by_side, stem};
use crate::server::entry::Entry;
use crate::server::id::PhotoId;

/// Entries that are read at a time.
const PART: usize = 256;

/// Places with the photos that are there, and whether those places were the last.
type Read = (Vec<(Place, Option<Arc<Entry>>)>, bool);

impl Jobs {
    /// At most `limit` photos, newest first, behind `after` where that is given; blocks where a store has them. Where that cannot be reached,
    /// those that are known here.
    #[must_use]
    pub fn listed(&self, whose: &Whose, after: Option<Place>, limit: usize) -> Page {
        let Some(cluster) = &self.cluster else {
            return match whose {
                Whose::All => self.list(after, limit),
                Whose::Of(owner) => self.list_of(owner.as_ref(), after, limit),
            };
        };
        if !cluster.is_away() {
            match self.listed_there(cluster, whose, after, limit) {
                Ok(page) => return page,
                Err(error) => tracing::debug!(%error, "what is known here is listed"),
            }
        }
        page(self.known(whose, after), limit)
    }

    /// The same as the store has it, with what is known here besides until its index has all photos.
    ///
    /// # Errors
    /// The store cannot be reached.
    fn listed_there(&self, cluster: &Cluster, whose: &Whose, after: Option<Place>, limit: usize) -> io::Result<Page> {
        let owner = match whose {
            Whose::All => None,
            Whose::Of(Some(owner)) => Some(owner),
            Whose::Of(None) => return Ok(page(BTreeMap::new(), limit)),
        };
        let (mut photos, mut at) = (Vec::new(), after);
        // one more tells whether there are more
        while photos.len() <= limit {
            let (entries, last) = self.part(cluster, owner, at, (limit + 1 - photos.len()).min(PART))?;
            photos.extend(entries.iter().filter_map(|(_, entry)| entry.clone()));
            at = entries.last().map(|(place, _)| *place).or(at);
            if last {
                break;
            }
        }
        let mut photos: BTreeMap<_, _> = photos.into_iter().map(|entry| (order(entry.key()), entry)).collect();
        if !cluster.is_built() {
            photos.extend(self.known(whose, after));
        }
        Ok(page(photos, limit))
    }

    /// What the store has at the places behind `after`, by at most `limit` names, and whether those were the last; nothing at a place from which
    /// the photo is gone.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub(in crate::server) fn part(&self, cluster: &Cluster, owner: Option<&Owner>, after: Option<Place>, limit: usize) -> io::Result<Read> {
        let (listed, last) = cluster.listed(owner, after, limit)?;
        let fresh: Vec<_> = listed.iter().map(|listed| self.fresh_at(cluster, listed.place)).collect();
        let others: Vec<Place> = listed.iter().zip(&fresh).filter(|(_, entry)| entry.is_none()).map(|(listed, _)| listed.place).collect();
        let mut looked = side_by_side(&others, |place| self.at(cluster, owner, *place)).into_iter();
        let is_theirs = |entry: &Arc<Entry>| owner.is_none_or(|_| entry.accepted.owner.as_ref() == owner);
        let read = listed.iter().zip(fresh).map(|(listed, fresh)| {
            // each that is not fresh was looked up, in this order
            let there = fresh.map_or_else(|| looked.next().unwrap_or(Ok(None)), |entry| Ok(Some(entry)))?;
            Ok((listed.place, there.filter(is_theirs)))
        });
        Ok((read.collect::<io::Result<_>>()?, last))
    }

    /// The photo at a place, where that is known here and need not be looked up.
    fn fresh_at(&self, cluster: &Cluster, place: Place) -> Option<Arc<Entry>> {
        self.get(place.1).filter(|entry| stem(entry.key()) == stem(place) && cluster.is_fresh(entry.id))
    }

    /// Looks up the photo at a place of the list of all, or of `owner`'s.
    fn at(&self, cluster: &Cluster, owner: Option<&Owner>, place: Place) -> io::Result<Option<Arc<Entry>>> {
        let there = match self.refresh(cluster, place.1) {
            // it is told wherever somebody asks for it, and hides no others
            Err(error) if error.kind() == io::ErrorKind::InvalidData => return Ok(None),
            // one that was deleted and uploaded again is elsewhere
            there => there?.filter(|entry| stem(entry.key()) == stem(place)),
        };
        if there.is_none() {
            cluster.left(owner, place);
        }
        Ok(there)
    }

    /// The photos that are known here behind `after`, in the order of the store's index.
    fn known(&self, whose: &Whose, after: Option<Place>) -> BTreeMap<(Reverse<u64>, PhotoId), Arc<Entry>> {
        let inner = self.lock();
        let of = match whose {
            Whose::All => Some(&inner.by_age),
            Whose::Of(owner) => owner.as_ref().and_then(|owner| inner.by_owner.get(owner)),
        };
        let behind = of.into_iter().flatten().map(|(key, entry)| (order(*key), Arc::clone(entry)));
        behind.filter(|(place, _)| after.is_none_or(|after| *place > order(after))).collect()
    }
}

/// The order of the store's index: newest first, and of one millisecond by their ids.
const fn order((at_ms, id): Place) -> (Reverse<u64>, PhotoId) {
    (Reverse(at_ms), id)
}

fn page(photos: BTreeMap<(Reverse<u64>, PhotoId), Arc<Entry>>, limit: usize) -> Page {
    let more = photos.len() > limit;
    Page { photos: photos.into_values().take(limit).collect(), more }
}
