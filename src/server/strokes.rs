//! Touch-up of photos: strokes over what a depth network got wrong, kept beside the photo, which is made again with them.

use std::io;
use std::sync::Arc;

use axum::http::{HeaderMap, StatusCode};

use super::app::Stored;
use super::entry::{Entry, Status};
use super::id::PhotoId;
use super::jobs::{Class, Jobs};
use super::problem::Problem;
use super::settings::still_as_seen;
use super::store::{End, Part, State};
use tmpi_pipeline::strokes::{Stroke, read, write};

/// Strokes as they are sent and kept, tagged by their bytes.
#[must_use]
pub fn stored(strokes: &[Stroke]) -> Stored {
    Stored::new(write(strokes))
}

impl Jobs {
    /// The strokes of a photo; none where they are damaged, which is logged: the photo can be made without.
    ///
    /// # Errors
    /// The disk fails.
    pub fn strokes(&self, id: PhotoId) -> io::Result<Vec<Stroke>> {
        let bytes = match self.store.read(id, Part::Strokes) {
            Ok(bytes) => bytes,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(e) => return Err(e),
        };
        Ok(read(&bytes).unwrap_or_else(|error| {
            tracing::error!(%id, %error, "damaged strokes are left out");
            Vec::new()
        }))
    }

    /// Gives a photo other strokes and has it made again; blocks until that is on disk. False where they are those that it has.
    ///
    /// # Errors
    /// 404 where the photo is deleted, 412 where `headers` name other strokes than it has, 409 while it is being made, 429 where the queue is
    /// full, 503 while the server stops, 500 and 507 where the disk fails; nothing has changed then.
    pub fn touch_up(&self, entry: &Arc<Entry>, headers: &HeaderMap, strokes: &[Stroke]) -> Result<bool, Problem> {
        // in a store of many nodes of two who change a photo one succeeds
        let _membership = self.cluster.is_none().then(|| self.membership());
        let gate = entry.gate();
        if entry.is_deleted() {
            return Err(Problem::not_found("the photo was deleted"));
        }
        let before = self.strokes(entry.id).map_err(|e| Problem::store(&e))?;
        still_as_seen(headers, &stored(&before).etag)?;
        if before == strokes {
            return Ok(false);
        }
        if let Some(cluster) = &self.cluster {
            drop(gate);
            return self.again_shared(cluster, entry, Some(write(strokes))).map(|()| true);
        }
        let put = |strokes: &[Stroke]| self.store.write(entry.id, &[(Part::Strokes, &write(strokes))]);
        self.put_again(entry, || put(strokes), || put(&before))?;
        drop(gate);
        entry.ask();
        entry.set_class(Class::default());
        self.queue_again(entry);
        Ok(true)
    }

    /// Has a photo made again with the program and the network of now; blocks until that is on disk.
    ///
    /// # Errors
    /// As [`Jobs::touch_up`].
    pub fn make_again(&self, entry: &Arc<Entry>, class: Class) -> Result<(), Problem> {
        // in a store of many nodes of two who change a photo one succeeds
        let _membership = self.cluster.is_none().then(|| self.membership());
        let gate = entry.gate();
        if entry.is_deleted() {
            return Err(Problem::not_found("the photo was deleted"));
        }
        if let Some(cluster) = &self.cluster {
            drop(gate);
            return self.again_shared(cluster, entry, None);
        }
        self.put_again(entry, || Ok(()), || Ok(()))?;
        drop(gate);
        entry.ask();
        entry.set_class(class);
        self.queue_again(entry);
        Ok(())
    }

    /// Sets a photo back to its beginning, on disk and here, with what `change` writes and, where the disk fails, `undo` puts back; membership
    /// and gate are held.
    fn put_again(
        &self,
        entry: &Entry,
        change: impl FnOnce() -> io::Result<()>,
        undo: impl FnOnce() -> io::Result<()>,
    ) -> Result<(), Problem> {
        let now = match entry.status() {
            Status::Queued | Status::Working => return Err(not_ready()),
            Status::Done(done) => Some(End::Done(done)),
            Status::Failed(failed) => Some(End::Failed(failed)),
            // on disk it is as it was before anybody looked
            Status::Damaged(_) | Status::Deleted => None,
        };
        self.room()?;
        // first of all it is no longer done: a crash must not leave results of other strokes than those beside them
        if let Err(error) = self.store.write_state(entry.id, &State::default()).and_then(|()| change()) {
            // where that fails as well, it is made again at the next start, as it was
            let _ = undo().and_then(|()| self.store.write_state(entry.id, &State::new(entry.attempts(), now)));
            return Err(Problem::store(&error));
        }
        entry.set_attempts(0);
        entry.set(Status::Queued);
        Ok(())
    }
}

/// The answer to who wants to have made again what is being made.
pub(super) fn not_ready() -> Problem {
    let detail = "the photo is being made; it can be made again once it is done";
    Problem::new(StatusCode::CONFLICT, "not-ready", detail).retry_after(1)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::Path;

    use super::super::forgetful::Forgetful;
    use super::super::limits::Limits;
    use super::super::maker::{Fault, Maker, Product};
    use super::super::store::{Accepted, Done, Store, digest};
    use super::*;
    use tmpi_pipeline::strokes::Ask;
    use tmpi_pipeline::{MakeError, Options, Sink};

    struct Never;

    impl Maker for Never {
        fn check(&self, _: &[u8], _: Option<&[u8]>, _: &Options) -> Result<(), MakeError> {
            Ok(())
        }

        fn make(&self, _: &[u8], _: Option<&[u8]>, _: &Options, _: &dyn Sink) -> Result<Product, Fault> {
            Err(Fault::Cancelled)
        }
    }

    fn started(files: &Arc<Forgetful>) -> Arc<Jobs> {
        let (store, found) = Store::open_in(files.clone(), Path::new("/data"), "", None).unwrap();
        // nobody makes anything
        let limits = Arc::new(Limits { workers: 0, ..Limits::default() });
        Jobs::start(store, found, Arc::new(Never), limits, Arc::default()).unwrap()
    }

    fn stroke(by: f64) -> Vec<Stroke> {
        vec![Stroke { points: vec![[0.5, 0.5]], radius: 0.1, ask: Ask::By(by) }]
    }

    /// A photo that is done, without strokes.
    fn photo(jobs: &Jobs, files: &Forgetful) -> PhotoId {
        use super::super::files::Files as _;
        let id = PhotoId::of(&[1; 32], None, "", "");
        let accepted = Accepted { version: 1, at_ms: 1, photo_bytes: 5, depth_bytes: None, options: BTreeMap::new(), owner: None };
        let incoming = jobs.store.begin().unwrap();
        files.write(&incoming.path(Part::Upload), b"photo").unwrap();
        jobs.store.accept(incoming, id, &accepted).unwrap();
        let done = Done { at_ms: 1, width: 2, height: 2, atlas_bytes: 5, atlas_hash: digest(b"atlas") };
        let results = [(Part::Atlas, b"atlas".as_slice()), (Part::Disparity, b"d"), (Part::Thumbnail, b"t"), (Part::Report, b"r")];
        jobs.store.write(id, &results).unwrap();
        jobs.store.write_state(id, &State::new(0, Some(End::Done(done)))).unwrap();
        files.sync_dir(Path::new("/")).unwrap();
        id
    }

    #[test]
    fn a_crash_never_leaves_results_of_other_strokes() {
        for steps in 0.. {
            let files = Arc::new(Forgetful::new());
            let id = photo(&started(&files), &files);
            let jobs = started(&files);
            let entry = jobs.get(id).unwrap();
            files.end_after(steps);
            let promised = jobs.touch_up(&entry, &HeaderMap::new(), &stroke(0.1)).is_ok();
            files.crash();
            let jobs = started(&files);
            let (found, strokes) = (jobs.get(id).unwrap(), jobs.strokes(id).unwrap());
            let done = matches!(found.status(), Status::Done(_));
            assert!(!done || strokes.is_empty(), "after {steps} steps what was made without strokes stands beside them");
            assert!(!promised || (!done && strokes == stroke(0.1)), "after {steps} steps what was promised is not there");
            if promised {
                assert!(steps > 4, "{steps}");
                return;
            }
        }
    }

    #[test]
    fn what_the_disk_refuses_changes_nothing() {
        for failing in 0..6 {
            let files = Arc::new(Forgetful::new());
            let id = photo(&started(&files), &files);
            let jobs = started(&files);
            let entry = jobs.get(id).unwrap();
            files.fail_once_after(failing);
            assert_eq!(jobs.touch_up(&entry, &HeaderMap::new(), &stroke(0.1)).unwrap_err().status, 500, "change {failing}");
            assert!(matches!(entry.status(), Status::Done(_)) && jobs.counts().queued == 0);
            drop((entry, jobs));
            let jobs = started(&files);
            let done = matches!(jobs.get(id).unwrap().status(), Status::Done(_));
            assert!(!done || jobs.strokes(id).unwrap().is_empty(), "change {failing}");
        }
    }

    #[test]
    fn damaged_strokes_are_left_out() {
        let files = Arc::new(Forgetful::new());
        let jobs = started(&files);
        let id = photo(&jobs, &files);
        jobs.store.write(id, &[(Part::Strokes, b"{\"strokes\": [")]).unwrap();
        assert_eq!(jobs.strokes(id).unwrap(), []);
    }
}
