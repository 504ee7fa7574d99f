//! How much one owner may have.

use std::collections::HashMap;
use std::hash::{BuildHasher, RandomState};
use std::ops::ControlFlow;
use std::time::Duration;

use axum::http::StatusCode;

use super::{Inner, Jobs};
use crate::server::access::Owner;
use crate::server::cluster::Cluster;
use crate::server::id::PhotoId;
use crate::server::problem::Problem;
use crate::server::records::Accepted;

/// Tries of an upload that met others of its owner at other nodes, and the longest pause before the second, in milliseconds.
const TRIES: u32 = 5;
const PAUSE_MS: u64 = 40;

/// A photo that counts already though it is not in the index yet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Coming {
    owner: Owner,
    id: PhotoId,
    bytes: u64,
}

/// Room for a photo that is kept for it until this is dropped.
pub(super) struct Reserved<'a> {
    jobs: &'a Jobs,
    coming: Coming,
}

impl Drop for Reserved<'_> {
    fn drop(&mut self) {
        let mut inner = self.jobs.lock();
        // one of them alone: a twin may be on its way, too
        if let Some(at) = inner.coming.iter().position(|coming| *coming == self.coming) {
            inner.coming.swap_remove(at);
        }
    }
}

impl Inner {
    /// What is coming of an owner.
    fn coming_of(&self, owner: &Owner) -> HashMap<PhotoId, u64> {
        self.coming.iter().filter(|coming| coming.owner == *owner).map(|coming| (coming.id, coming.bytes)).collect()
    }
}

impl Jobs {
    /// Looks whether `owner` may have one more photo, of at least so many bytes. This machine's own user may, and who is not known is not
    /// counted. Blocks where a store has the photos.
    ///
    /// # Errors
    /// 403 that names the limit, 503 where the store cannot be reached.
    pub fn quota(&self, owner: Option<&Owner>, bytes: u64) -> Result<(), Problem> {
        let Some(owner) = self.counted(owner) else { return Ok(()) };
        let inner = self.lock();
        let Some(cluster) = &self.cluster else { return self.fits(&inner, owner, bytes) };
        let coming = inner.coming_of(owner);
        drop(inner);
        self.fits_there(cluster, owner, None, bytes, coming)
    }

    /// The same, and keeps the room for the photo `id` while it is taken into a store of several nodes: in its index. It is entered there first
    /// and then all are counted, so that of any number of uploads that come to several nodes at a time the last to be entered sees all others,
    /// and no more get in than may. Who was too much is taken out again and tries anew, as the others may have done; in the end it is refused,
    /// though there may be room by then. What an upload that broke off left in the index counts until the list is read an hour later.
    ///
    /// # Errors
    /// As [`Jobs::quota`].
    pub(super) fn reserve(&self, cluster: &Cluster, id: PhotoId, accepted: &Accepted) -> Result<Option<Reserved<'_>>, Problem> {
        let (owner, bytes) = (accepted.owner.as_ref(), accepted.bytes());
        let Some(owner) = self.counted(owner) else { return Ok(None) };
        let coming = Coming { owner: owner.clone(), id, bytes };
        // what came to this node before this one is counted with it or is in the index by the time that is read; what comes later counts this one
        let mut inner = self.lock();
        let before = inner.coming_of(owner);
        inner.coming.push(coming.clone());
        drop(inner);
        let reserved = Reserved { jobs: self, coming };
        let store = |e: std::io::Error| Problem::store(&e);
        let mut again = 1;
        loop {
            // what has no room is not entered at all
            self.fits_there(cluster, owner, Some(id), bytes, before.clone())?;
            let is_new = cluster.enter_early(id, accepted).map_err(store)?;
            match self.fits_there(cluster, owner, Some(id), bytes, HashMap::new()) {
                Err(refused) if refused.status == StatusCode::FORBIDDEN.as_u16() => {
                    if is_new {
                        cluster.leave_early(id, accepted).map_err(store)?;
                    }
                    if again == TRIES {
                        return Err(refused);
                    }
                    let pause = RandomState::new().hash_one(again) % (PAUSE_MS << again);
                    std::thread::sleep(Duration::from_millis(pause));
                    again += 1;
                }
                other => return other.map(|()| Some(reserved)),
            }
        }
    }

    /// An owner who may not have any number.
    fn counted<'a>(&self, owner: Option<&'a Owner>) -> Option<&'a Owner> {
        let limited = self.limits.quota_photos.is_some() || self.limits.quota_bytes.is_some();
        owner.filter(|owner| limited && !owner.is_own())
    }

    /// Refuses a photo that is too much beside what the owner has.
    fn fits(&self, inner: &Inner, owner: &Owner, bytes: u64) -> Result<(), Problem> {
        let theirs = || inner.by_owner.get(owner).into_iter().flat_map(|all| all.values());
        self.beside("", theirs().count(), theirs().map(|entry| entry.bytes()).fold(0, u64::saturating_add), bytes)
    }

    /// The same of what the store's index says, beside what was `coming` before that is read; no further than it is known to be too much.
    fn fits_there(
        &self,
        cluster: &Cluster,
        owner: &Owner,
        id: Option<PhotoId>,
        bytes: u64,
        mut coming: HashMap<PhotoId, u64>,
    ) -> Result<(), Problem> {
        let (mut photos, mut taken, mut is_whole) = (0, 0_u64, true);
        let count = |of: PhotoId, size: u64| {
            coming.remove(&of);
            if id != Some(of) {
                photos += 1;
                taken = taken.saturating_add(size);
            }
            let too_many = self.limits.quota_photos.is_some_and(|most| photos > most);
            is_whole = !too_many && self.limits.quota_bytes.is_none_or(|most| taken.saturating_add(bytes) <= most);
            if is_whole { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        };
        cluster.each_of(owner, count).map_err(|e| Problem::store(&e))?;
        if !is_whole {
            return self.beside("at least ", photos, taken, bytes);
        }
        let coming = coming.iter().filter(|(of, _)| id != Some(**of));
        let (photos, taken) = coming.fold((photos, taken), |(photos, taken), (_, bytes)| (photos + 1, taken.saturating_add(*bytes)));
        self.beside("", photos, taken, bytes)
    }

    /// Refuses a photo that is too much beside so many, which take so many bytes, both said with `about` before them.
    fn beside(&self, about: &str, photos: usize, taken: u64, bytes: u64) -> Result<(), Problem> {
        let refused = |detail: String| Err(Problem::new(StatusCode::FORBIDDEN, "quota", detail));
        match (self.limits.quota_photos, self.limits.quota_bytes) {
            (Some(most), _) if photos >= most => refused(format!(
                "you have {about}{photos} photos, and {most} is the limit (--quota-photos): delete one, and there is room for another"
            )),
            (_, Some(most)) if taken.saturating_add(bytes) > most => refused(format!(
                "your photos take {about}{taken} bytes, this one {bytes}, and {most} is the limit (--quota-mib): \
                 delete some, and there is room"
            )),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Barrier;

    use super::super::among_tests::{Node, node};
    use super::*;
    use crate::server::cluster::memory::{MADE, Memory, accepted, put};
    use crate::server::limits::Limits;

    /// A store that has one photo of `owner`.
    fn store(owner: &Owner) -> Memory {
        let store = Memory::default();
        store.built();
        put(&store, 100, 1, Some(owner), true);
        store
    }

    /// Takes the photo `n` in, if there is room.
    fn upload(node: &Node, store: &Memory, n: u32, owner: &Owner) -> bool {
        let (id, upload) = accepted(n, 2, Some(owner));
        node.jobs.reserve(&node.cluster, id, &upload).is_ok_and(|_room| put(store, n, 2, Some(owner), true).1 == id)
    }

    /// How many of 16 uploads at a time get in; what is made of them is there at once, or not yet.
    fn taken(nodes: &[&Node], store: &Memory, owner: &Owner, are_made: bool) -> usize {
        let start = Barrier::new(16);
        std::thread::scope(|scope| {
            let uploads: Vec<_> = (0..16)
                .map(|n| {
                    let (node, start) = (nodes[n as usize % nodes.len()], &start);
                    scope.spawn(move || {
                        start.wait();
                        let (id, accepted) = accepted(n, 2, Some(owner));
                        if are_made { upload(node, store, n, owner) } else { node.jobs.reserve(&node.cluster, id, &accepted).is_ok() }
                    })
                })
                .collect();
            uploads.into_iter().map(|upload| upload.join().unwrap()).filter(|is_in| *is_in).count()
        })
    }

    #[test]
    fn of_uploads_that_come_to_a_node_at_a_time_no_more_get_in_than_may() {
        let photos = Limits { quota_photos: Some(5), ..Limits::default() };
        // the one that is there with what was made of it, and four of 5 bytes: how much is made of those nobody knows yet
        let bytes = Limits { quota_bytes: Some(5 + MADE + 4 * 5 + 4), ..Limits::default() };
        for (limits, are_made) in [(photos, true), (bytes, false)] {
            let owner = Owner::of_secret("a");
            let store = store(&owner);
            let node = node(&store, &limits);
            let taken = taken(&[&node], &store, &owner, are_made);
            assert!((1..=4).contains(&taken), "{taken}");
            assert!(node.jobs.lock().coming.is_empty());
        }
    }

    #[test]
    fn of_uploads_that_come_to_several_nodes_at_a_time_no_more_get_in_than_may() {
        for _ in 0..20 {
            let owner = Owner::of_secret("a");
            let store = store(&owner);
            let of = || node(&store, &Limits { quota_photos: Some(5), ..Limits::default() });
            let nodes = [of(), of(), of(), of()];
            let taken = taken(&nodes.each_ref(), &store, &owner, true);
            assert!((1..=4).contains(&taken), "{taken}");
            let left = nodes[0].jobs.quota(Some(&owner), 1);
            assert_eq!(left.is_ok(), taken < 4, "who was refused counts no longer");
        }
    }

    #[test]
    fn who_was_counted_before_another_was_entered_is_counted_again() {
        let (a, b) = (Owner::of_secret("a"), Owner::of_secret("b"));
        let store = store(&a);
        let of = || node(&store, &Limits { quota_photos: Some(2), ..Limits::default() });
        let (one, two) = (of(), of());
        // just before the first is entered
        let there = store.clone();
        let owner = a.clone();
        store.meanwhile("lists/owners/", move || assert!(upload(&two, &there, 2, &owner)));
        assert!(!upload(&one, &store, 1, &a));
        assert!(!store.has(accepted(1, 2, None).0) && store.has(accepted(2, 2, None).0));
        assert!(upload(&one, &store, 3, &b), "others");
        let listed: Vec<_> = store.entries().into_iter().filter(|(_, place)| place.1 == accepted(1, 2, None).0).collect();
        assert!(listed.is_empty(), "{listed:?}");
    }

    #[test]
    fn what_comes_counts_once_until_it_has_come_or_has_failed() {
        let (a, b) = (Owner::of_secret("a"), Owner::of_secret("b"));
        let store = Memory::default();
        store.built();
        let node = node(&store, &Limits { quota_photos: Some(1), ..Limits::default() });
        let reserve = |n: u32, owner: &Owner| {
            let (id, upload) = accepted(n, 2, Some(owner));
            node.jobs.reserve(&node.cluster, id, &upload)
        };
        let first = reserve(1, &a).unwrap();
        assert_eq!(reserve(2, &a).err().map(|e| e.status), Some(403));
        assert_eq!(node.jobs.quota(Some(&a), 5).unwrap_err().status, 403);
        let twin = reserve(1, &a).unwrap();
        assert!(reserve(3, &b).is_ok(), "others");
        drop((first, twin));
        assert!(node.jobs.lock().coming.is_empty());
        assert!(reserve(2, &a).is_err(), "it is entered: what became of it nobody knows");
        put(&store, 1, 2, Some(&a), true);
        assert!(reserve(2, &a).is_err() && reserve(1, &a).is_ok());
    }
}
