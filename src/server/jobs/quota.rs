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
        let Some(cluster) = &self.cluster else { return self.fits(&self.lock(), owner, None, bytes) };
        let coming = self.lock().coming_of(owner);
        self.fits_there(cluster, owner, None, bytes, coming)
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
            self.fits(&inner, owner, Some(id), bytes)?;
            inner.coming.push(coming.clone());
            drop(inner);
            return Ok(Some(Reserved { jobs: self, coming }));
        };
        // what came before this one is counted with it or is in the index by the time that is read; what comes later counts this one
        let before = inner.coming_of(owner);
        inner.coming.push(coming.clone());
        drop(inner);
        let reserved = Reserved { jobs: self, coming };
        self.fits_there(cluster, owner, Some(id), bytes, before)?;
        Ok(Some(reserved))
    }

    /// An owner who may not have any number.
    fn counted<'a>(&self, owner: Option<&'a Owner>) -> Option<&'a Owner> {
        let limited = self.limits.quota_photos.is_some() || self.limits.quota_bytes.is_some();
        owner.filter(|owner| limited && !owner.is_own())
    }

    /// Refuses a photo, `id` where that is known, that is too much beside what the owner has and what comes.
    fn fits(&self, inner: &Inner, owner: &Owner, id: Option<PhotoId>, bytes: u64) -> Result<(), Problem> {
        let coming = inner.coming.iter().filter(|coming| coming.owner == *owner).map(|coming| (coming.id, coming.bytes));
        let there = inner.by_owner.get(owner).into_iter().flat_map(|all| all.values()).map(|entry| (entry.id, entry.bytes()));
        // each once, as it is in the index where it is there
        let theirs: HashMap<PhotoId, u64> = coming.chain(there).filter(|(of, _)| id != Some(*of)).collect();
        self.beside("", theirs.len(), theirs.values().sum(), bytes)
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
                "your photos take {about}{taken} bytes, this one {bytes}, and {most} is the limit (--quota-mib): delete some, and there is room"
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
