//! How much one owner may have.

use std::collections::HashMap;
use std::ops::ControlFlow;

use axum::http::StatusCode;

use super::{Inner, Jobs};
use crate::server::access::Owner;
use crate::server::cluster::Cluster;
use crate::server::id::PhotoId;
use crate::server::problem::Problem;

/// A photo that counts already though it is not in the index yet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Coming {
    owner: Owner,
    id: PhotoId,
    bytes: u64,
}

/// What an upload in parts takes, or is going to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Held {
    owner: Owner,
    bytes: u64,
    /// It is whole, and about to be a photo: it counts as that.
    ends: bool,
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
    /// Bytes of an owner's uploads in parts, but for the one that asks and, where the last word is said, those that end.
    fn held_of(&self, owner: &Owner, asks: Option<&str>, last: bool) -> u64 {
        let counts = |(upload, held): &(&String, &Held)| held.owner == *owner && asks != Some(upload.as_str()) && !(last && held.ends);
        self.held.iter().filter(counts).fold(0, |all, (_, held)| all.saturating_add(held.bytes))
    }

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
        self.fits_beside(owner, None, bytes, false)
    }

    /// The same of a photo that is here whole: uploads in parts that end beside it count once they are photos.
    ///
    /// # Errors
    /// As [`Jobs::quota`].
    pub(super) fn last_quota(&self, owner: Option<&Owner>, bytes: u64) -> Result<(), Problem> {
        self.counted(owner).map_or(Ok(()), |owner| self.fits_beside(owner, None, bytes, true))
    }

    fn fits_beside(&self, owner: &Owner, asks: Option<&str>, bytes: u64, last: bool) -> Result<(), Problem> {
        let inner = self.lock();
        let held = inner.held_of(owner, asks, last);
        let Some(cluster) = &self.cluster else { return self.fits(&inner, owner, None, bytes, held) };
        let coming = inner.coming_of(owner);
        drop(inner);
        self.fits_there(cluster, owner, None, bytes, coming, held)
    }

    /// Keeps room for so many bytes of an upload in parts, all in all, until it [is let go](Jobs::unhold): beside photos and other such uploads
    /// at this node they are no more than one may have. Blocks where a store has the photos.
    ///
    /// # Errors
    /// As [`Jobs::quota`]: as much as before is kept then.
    pub fn hold(&self, owner: Option<&Owner>, upload: &str, bytes: u64) -> Result<(), Problem> {
        let Some(owner) = self.counted(owner) else { return Ok(()) };
        let held = Held { owner: owner.clone(), bytes, ends: false };
        let mut inner = self.lock();
        if inner.held.get(upload).is_some_and(|before| before.bytes >= bytes && !before.ends) {
            return Ok(());
        }
        let others = inner.held_of(owner, Some(upload), false);
        if self.cluster.is_none() {
            self.fits(&inner, owner, None, bytes, others)?;
            inner.held.insert(upload.to_owned(), held);
            return Ok(());
        }
        // kept already while the store is asked, so that others see it
        let before = inner.held.insert(upload.to_owned(), held);
        drop(inner);
        let fits = self.fits_beside(owner, Some(upload), bytes, false);
        if fits.is_err() {
            let mut inner = self.lock();
            match before {
                Some(before) => drop(inner.held.insert(upload.to_owned(), before)),
                None => drop(inner.held.remove(upload)),
            }
        }
        fits
    }

    /// Keeps room for what is there of an upload in parts that was accepted before a start.
    pub fn hold_found(&self, owner: Option<&Owner>, upload: &str, bytes: u64) {
        if let Some(owner) = self.counted(owner) {
            self.lock().held.insert(upload.to_owned(), Held { owner: owner.clone(), bytes, ends: false });
        }
    }

    /// An upload in parts is about to be a photo, or it did not come to that.
    pub fn ends(&self, upload: &str, ends: bool) {
        if let Some(held) = self.lock().held.get_mut(upload) {
            held.ends = ends;
        }
    }

    /// Lets go of the room of an upload in parts.
    pub fn unhold(&self, upload: &str) {
        self.lock().held.remove(upload);
    }

    /// The same, and keeps the room for the photo `id` while it is taken into a store without `membership` held; a twin of it needs no other.
    ///
    /// In a store of several nodes the index there is asked. Uploads of one owner that come to several nodes at the same time may not see each
    /// other: there may be as many photos too many as there are other nodes that take one while this one is taken. What an upload that broke off
    /// left in the index counts until the list is read an hour later.
    ///
    /// # Errors
    /// As [`Jobs::quota`].
    pub(super) fn reserve(&self, owner: Option<&Owner>, id: PhotoId, bytes: u64) -> Result<Option<Reserved<'_>>, Problem> {
        let Some(owner) = self.counted(owner) else { return Ok(None) };
        let coming = Coming { owner: owner.clone(), id, bytes };
        let mut inner = self.lock();
        let Some(cluster) = &self.cluster else {
            let held = inner.held_of(owner, None, true);
            self.fits(&inner, owner, Some(id), bytes, held)?;
            inner.coming.push(coming.clone());
            drop(inner);
            return Ok(Some(Reserved { jobs: self, coming }));
        };
        // what came before this one is counted with it or is in the index by the time that is read; what comes later counts this one
        let (before, held) = (inner.coming_of(owner), inner.held_of(owner, None, true));
        inner.coming.push(coming.clone());
        drop(inner);
        let reserved = Reserved { jobs: self, coming };
        self.fits_there(cluster, owner, Some(id), bytes, before, held)?;
        Ok(Some(reserved))
    }

    /// An owner who may not have any number.
    fn counted<'a>(&self, owner: Option<&'a Owner>) -> Option<&'a Owner> {
        let limited = self.limits.quota_photos.is_some() || self.limits.quota_bytes.is_some();
        owner.filter(|owner| limited && !owner.is_own())
    }

    /// Refuses a photo, `id` where that is known, that is too much beside what the owner has, what comes, and `held` bytes of uploads in parts.
    fn fits(&self, inner: &Inner, owner: &Owner, id: Option<PhotoId>, bytes: u64, held: u64) -> Result<(), Problem> {
        let coming = inner.coming.iter().filter(|coming| coming.owner == *owner).map(|coming| (coming.id, coming.bytes));
        let there = inner.by_owner.get(owner).into_iter().flat_map(|all| all.values()).map(|entry| (entry.id, entry.bytes()));
        // each once, as it is in the index where it is there
        let theirs: HashMap<PhotoId, u64> = coming.chain(there).filter(|(of, _)| id != Some(*of)).collect();
        self.beside("", theirs.len(), theirs.values().sum::<u64>().saturating_add(held), bytes)
    }

    /// The same of what the store's index says, beside what was `coming` before that is read; no further than it is known to be too much.
    fn fits_there(
        &self,
        cluster: &Cluster,
        owner: &Owner,
        id: Option<PhotoId>,
        bytes: u64,
        mut coming: HashMap<PhotoId, u64>,
        held: u64,
    ) -> Result<(), Problem> {
        let (mut photos, mut taken, mut is_whole) = (0, held, true);
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
                "your photos and uploads under way take {about}{taken} bytes, this one {bytes}, and {most} is the limit (--quota-mib): \
                 delete some, and there is room"
            )),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Barrier;

    use super::super::list::tests::{index, put};
    use super::*;
    use crate::server::limits::Limits;

    fn id(n: u8) -> PhotoId {
        PhotoId::of(&[n; 32], None, "", "")
    }

    #[test]
    fn of_uploads_that_come_at_a_time_no_more_get_in_than_may() {
        for limits in [Limits { quota_photos: Some(5), ..Limits::default() }, Limits { quota_bytes: Some(25), ..Limits::default() }] {
            let (jobs, owner, start) = (index(&limits), Owner::of_secret("a"), Barrier::new(16));
            put(&jobs, 100, 1, Some(owner.clone()));
            let taken = std::thread::scope(|scope| {
                let uploads: Vec<_> = (0..16)
                    .map(|n| {
                        let (jobs, owner, start) = (&jobs, &owner, &start);
                        scope.spawn(move || {
                            start.wait();
                            let reserved = jobs.reserve(Some(owner), id(n), 5);
                            // as the store does, which takes its time
                            std::thread::yield_now();
                            reserved.is_ok_and(|_room| put(jobs, n, 2, Some(owner.clone())).id == id(n))
                        })
                    })
                    .collect();
                uploads.into_iter().map(|upload| upload.join().unwrap()).filter(|is_in| *is_in).count()
            });
            assert_eq!(taken, 4);
            assert!(jobs.lock().coming.is_empty());
        }
    }

    #[test]
    fn uploads_in_parts_take_room_until_they_are_photos_or_gone() {
        let jobs = index(&Limits { quota_bytes: Some(20), ..Limits::default() });
        let (a, b) = (Owner::of_secret("a"), Owner::of_secret("b"));
        let status = |fits: Result<(), Problem>| fits.err().map(|e| e.status);
        jobs.hold(Some(&a), "one", 8).unwrap();
        assert_eq!(status(jobs.hold(Some(&a), "two", 13)), Some(403));
        assert!(jobs.hold(Some(&b), "of-b", 20).is_ok() && jobs.hold(None, "nobody's", 99).is_ok());
        // all in all, and no less than was told before
        assert!(jobs.hold(Some(&a), "one", 20).is_ok() && jobs.hold(Some(&a), "one", 5).is_ok());
        assert_eq!(status(jobs.hold(Some(&a), "one", 21)), Some(403));
        assert_eq!((status(jobs.quota(Some(&a), 1)), status(jobs.last_quota(Some(&a), 1))), (Some(403), Some(403)), "of uploads at once");
        assert!(jobs.reserve(Some(&a), id(1), 1).is_err());
        jobs.unhold("one");
        jobs.hold(Some(&a), "one", 12).unwrap();
        jobs.hold(Some(&a), "two", 8).unwrap();
        // as it becomes a photo it counts for others, and not beside itself
        jobs.ends("one", true);
        assert!(jobs.last_quota(Some(&a), 12).is_ok() && status(jobs.last_quota(Some(&a), 13)) == Some(403));
        assert!(jobs.reserve(Some(&a), id(1), 12).is_ok() && status(jobs.quota(Some(&a), 1)) == Some(403));
        put(&jobs, 1, 12, Some(a.clone()));
        jobs.unhold("one");
        assert!(jobs.quota(Some(&a), 7).is_ok() && status(jobs.quota(Some(&a), 8)) == Some(403), "two, and the photo of 5 bytes");
        jobs.unhold("two");
        assert!(jobs.quota(Some(&a), 15).is_ok());
        // after a start it is kept whatever there is
        jobs.hold_found(Some(&a), "two", 16);
        assert_eq!(status(jobs.quota(Some(&a), 0)), Some(403));
    }

    #[test]
    fn what_comes_counts_once_until_it_has_come_or_has_failed() {
        let jobs = index(&Limits { quota_photos: Some(1), ..Limits::default() });
        let (a, b) = (Owner::of_secret("a"), Owner::of_secret("b"));
        let first = jobs.reserve(Some(&a), id(1), 5).unwrap();
        assert_eq!(jobs.reserve(Some(&a), id(2), 5).err().map(|e| e.status), Some(403));
        assert_eq!(jobs.quota(Some(&a), 5).unwrap_err().status, 403);
        let twin = jobs.reserve(Some(&a), id(1), 5).unwrap();
        assert!(jobs.reserve(Some(&b), id(2), 5).is_ok() && jobs.reserve(None, id(3), 5).is_ok(), "others");
        drop(first);
        assert!(jobs.reserve(Some(&a), id(2), 5).is_err(), "its twin still comes");
        drop(twin);
        assert!(jobs.reserve(Some(&a), id(2), 5).is_ok());
        put(&jobs, 1, 1, Some(a.clone()));
        assert!(jobs.reserve(Some(&a), id(2), 5).is_err() && jobs.reserve(Some(&a), id(1), 5).is_ok());
    }
}
