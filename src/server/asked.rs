//! What is asked of the photos on the way to an answer; where several nodes share a store, it may be asked on a thread that waits for it.

use std::sync::Arc;

use super::access::{Guard, Owner};
use super::app::Shared;
use super::entry::Entry;
use super::id::PhotoId;
use super::jobs::{Page, Whose};
use super::problem::Problem;

/// Photos that are looked at at a time for whose they are.
const LIST_PART: usize = 256;

impl Shared {
    /// Brings a photo up to date where several nodes share a store, for who only reads or else who changes it: whoever has what this gives finds
    /// it by its id, however many others are asked for meanwhile.
    ///
    /// # Errors
    /// 503 where the store cannot be reached and the photo is not known here.
    pub async fn look_up(&self, id: PhotoId, reads: bool) -> Result<Option<Arc<Entry>>, Problem> {
        let Some(cluster) = self.jobs.cluster.clone() else { return Ok(None) };
        let known = self.jobs.get(id);
        if reads && known.is_some() && cluster.is_fresh(id) {
            return Ok(known);
        }
        // whoever reads does not wait for a store that is away
        if reads && cluster.is_away() {
            return Err(Problem::away());
        }
        let jobs = Arc::clone(&self.jobs);
        let looked = tokio::task::spawn_blocking(move || {
            let seen = jobs.refresh(&cluster, id);
            // what was seen before goes on
            if reads && let Some(known) = jobs.get(id) { Ok(Some(known)) } else { seen }
        });
        looked.await.map_err(|e| Problem::internal("looking a photo up", &e))?.map_err(|e| Problem::store(&e))
    }

    /// Photos behind `after`, newest first, that whoever asks may list; at most `limit`.
    ///
    /// # Errors
    /// 500 where the list cannot be read.
    pub async fn list(&self, after: Option<(u64, PhotoId)>, limit: usize) -> Result<Page, Problem> {
        let Some(guard) = &self.guard else { return self.page(Whose::All, after, limit).await };
        let whose = if Guard::has_all() { Whose::All } else { Whose::Of(Guard::owner()) };
        let (mut photos, mut after, part) = (Vec::new(), after, LIST_PART.min(limit + 1));
        loop {
            // a part at a time, so that nobody waits for the list
            let page = self.page(whose.clone(), after, part).await?;
            after = page.photos.last().map(|entry| entry.key());
            photos.extend(page.photos.into_iter().filter(|entry| guard.allows(entry)));
            if photos.len() > limit || !page.more {
                let more = photos.len() > limit;
                photos.truncate(limit);
                return Ok(Page { photos, more });
            }
        }
    }

    async fn page(&self, whose: Whose, after: Option<(u64, PhotoId)>, limit: usize) -> Result<Page, Problem> {
        if self.jobs.cluster.is_none() {
            return Ok(self.jobs.listed(&whose, after, limit));
        }
        let jobs = Arc::clone(&self.jobs);
        let listed = tokio::task::spawn_blocking(move || jobs.listed(&whose, after, limit));
        listed.await.map_err(|e| Problem::internal("reading the list", &e))
    }

    /// Looks whether `owner` may have one more photo, of at least so many bytes.
    ///
    /// # Errors
    /// As [`super::jobs::Jobs::quota`].
    pub async fn quota(&self, owner: Option<&Owner>, bytes: u64) -> Result<(), Problem> {
        if self.jobs.cluster.is_none() {
            return self.jobs.quota(owner, bytes);
        }
        let (jobs, owner) = (Arc::clone(&self.jobs), owner.cloned());
        let looked = tokio::task::spawn_blocking(move || jobs.quota(owner.as_ref(), bytes));
        looked.await.map_err(|e| Problem::internal("counting an owner's photos", &e))?
    }
}
