//! The photos by age, all or one owner's, a page at a time.

use std::collections::BTreeMap;
use std::ops::Bound;
use std::sync::Arc;

use super::{Jobs, Page};
use crate::server::access::Owner;
use crate::server::entry::Entry;
use crate::server::id::PhotoId;
use crate::server::problem::Problem;
use crate::server::settings::Settings;
use crate::server::time::now_ms;

/// Of whom photos are listed.
#[derive(Clone, Debug)]
pub enum Whose {
    /// Of all.
    All,
    /// Of one owner alone; nobody has none.
    Of(Option<Owner>),
}

/// Photos by when they were accepted, oldest first.
pub(super) type ByAge = BTreeMap<(u64, PhotoId), Arc<Entry>>;

fn page(photos: &ByAge, after: Option<(u64, PhotoId)>, limit: usize) -> Page {
    let end = after.map_or(Bound::Unbounded, Bound::Excluded);
    let mut older = photos.range((Bound::Unbounded, end)).rev().map(|(_, entry)| Arc::clone(entry));
    let photos: Vec<_> = older.by_ref().take(limit).collect();
    Page { photos, more: older.next().is_some() }
}

impl Jobs {
    /// At most `limit` photos, newest first, older than `after` where that is given.
    #[must_use]
    pub fn list(&self, after: Option<(u64, PhotoId)>, limit: usize) -> Page {
        page(&self.lock().by_age, after, limit)
    }

    /// The same of one owner's photos alone, at no cost of others'; nobody has none.
    #[must_use]
    pub fn list_of(&self, owner: Option<&Owner>, after: Option<(u64, PhotoId)>, limit: usize) -> Page {
        let inner = self.lock();
        let theirs = owner.and_then(|owner| inner.by_owner.get(owner));
        theirs.map_or_else(|| Page { photos: Vec::new(), more: false }, |theirs| page(theirs, after, limit))
    }
}

impl Jobs {
    /// A photo that is there already was uploaded once more: it takes what that upload says of it, and is the first of the list. Where several nodes
    /// share a store it keeps its place. Blocks.
    ///
    /// # Errors
    /// [`Problem`] 404 where it was deleted meanwhile; else as [`Jobs::write_settings`].
    pub fn uploaded_again(&self, entry: &Arc<Entry>, told: &Settings) -> Result<(), Problem> {
        let _gate = entry.gate();
        if entry.is_deleted() {
            return Err(Problem::not_found("the photo was deleted meanwhile"));
        }
        let before = entry.settings();
        let mut settings = before.told_again(told);
        if self.cluster.is_none() {
            settings.listed_ms = Some(now_ms());
        }
        if settings != before {
            self.write_settings(entry.id, &settings)?;
            let mut inner = self.lock();
            inner.unlist(entry);
            entry.set_settings(settings);
            inner.list(entry);
        }
        Ok(())
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::path::Path;

    use super::*;
    use crate::server::forgetful::Forgetful;
    use crate::server::limits::Limits;
    use crate::server::maker::Never;
    use crate::server::records::Accepted;
    use crate::server::store::Store;

    /// An empty index without workers.
    pub(in crate::server::jobs) fn index(limits: &Limits) -> Arc<Jobs> {
        let (store, _) = Store::open_in(Arc::new(Forgetful::new()), Path::new("/data"), "", None).unwrap();
        Jobs::start(store, Vec::new(), Arc::new(Never), Arc::new(Limits { workers: 0, ..limits.clone() }), Arc::default()).unwrap()
    }

    /// A photo of 5 bytes in it.
    pub(in crate::server::jobs) fn put(jobs: &Jobs, n: u8, at_ms: u64, owner: Option<Owner>) -> Arc<Entry> {
        let accepted = Accepted { version: 1, at_ms, photo_bytes: 5, depth_bytes: None, options: BTreeMap::new(), owner };
        let entry = Arc::new(Entry::new(PhotoId::of(&[n; 32], None, "", ""), accepted, Settings::default()));
        jobs.lock().insert(&entry);
        entry
    }

    #[test]
    fn one_owners_pages_are_those_of_all_without_the_others() {
        let jobs = index(&Limits::default());
        let owners: Vec<_> = ["a", "b", "c"].map(Owner::of_secret).to_vec();
        let entries: Vec<_> = (0..60)
            // several at a time, and some that are nobody's
            .map(|n| put(&jobs, n, u64::from(n) * 7 % 10, owners.get(usize::from(n / 2) % 4).cloned()))
            .collect();
        jobs.lock().remove(&entries[1]);
        let pages = |limit: usize, list: &dyn Fn(Option<(u64, PhotoId)>) -> Page| {
            let (mut all, mut after) = (Vec::new(), None);
            loop {
                let page = list(after);
                assert!(page.photos.len() == limit || page.photos.len() < limit && !page.more);
                after = page.photos.last().map(|entry| entry.key());
                all.extend(page.photos.iter().map(|entry| (entry.id, entry.accepted.owner.clone())));
                if !page.more {
                    return all;
                }
            }
        };
        for limit in [1, 2, 3, 7, 100] {
            let all = pages(limit, &|after| jobs.list(after, limit));
            assert_eq!(all.len(), 59);
            for owner in &owners {
                let theirs: Vec<_> = all.iter().filter(|(_, of)| of.as_ref() == Some(owner)).cloned().collect();
                assert_eq!(pages(limit, &|after| jobs.list_of(Some(owner), after, limit)), theirs, "{limit}");
            }
        }
        for nobody in [None, Some(&Owner::of_secret("d"))] {
            let page = jobs.list_of(nobody, None, 9);
            assert!(page.photos.is_empty() && !page.more);
        }
    }
}
