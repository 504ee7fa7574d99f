//! What is in the data directory already: read at start, and later what could not be read then.

use std::io;
use std::sync::PoisonError;

use rayon::prelude::*;
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};

use super::{Accepted, End, Found, KEPT_SETTINGS, PAUSE, Part, State, Store, TEMPORARY};
use crate::server::id::PhotoId;
use crate::server::options;
use crate::server::records::VERSION;
use crate::server::settings::Settings;
use crate::server::time::now_ms;

/// Threads that read records at start.
const READERS: usize = 32;
/// Reads of a record that fails to be read, as where no file descriptor is left.
const READS: u32 = 3;

impl Store {
    pub(super) fn ids(&self) -> io::Result<Vec<PhotoId>> {
        let name = |name: String| {
            let id = name.parse().ok();
            if id.is_none() {
                tracing::warn!(name, "not a photo, left alone");
            }
            id
        };
        Ok(self.files.names(&self.photos)?.into_iter().filter_map(name).collect())
    }

    /// Photos, oldest first; those that cannot be read now are remembered.
    pub(super) fn look_at(&self, ids: &[PhotoId]) -> Vec<Found> {
        let look = || ids.par_iter().map(|id| self.look(*id).map_err(|e| (*id, e))).collect::<Vec<_>>();
        // a disk answers many at a time, and each waits for several answers
        let looked = match rayon::ThreadPoolBuilder::new().num_threads(READERS.min(ids.len().max(1))).build() {
            Ok(readers) => readers.install(look),
            Err(_) => look(),
        };
        let mut found = Vec::with_capacity(looked.len());
        for photo in looked {
            match photo {
                Ok(photo) => found.push(photo),
                Err((id, error)) => {
                    tracing::error!(%id, %error, "cannot be read, left alone");
                    self.unread().push(id);
                }
            }
        }
        found.sort_by_key(|f| (f.accepted.at_ms, f.id));
        found
    }

    /// Photos that could not be read before and can be now.
    pub fn look_again(&self) -> Vec<Found> {
        let ids = std::mem::take(&mut *self.unread());
        self.look_at(&ids)
    }

    /// Count of photos that cannot be read.
    #[must_use]
    pub fn unreadable(&self) -> usize {
        self.unread().len()
    }

    pub(super) fn unread(&self) -> std::sync::MutexGuard<'_, Vec<PhotoId>> {
        self.unread.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A record; none where it is missing or damaged, which is logged.
    fn record<T: DeserializeOwned>(&self, id: PhotoId, part: Part) -> io::Result<Option<T>> {
        let mut reads = 0;
        let bytes = loop {
            reads += 1;
            match self.read(id, part) {
                Ok(bytes) => break bytes,
                Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
                Err(e) if reads == READS => return Err(e),
                Err(_) => std::thread::sleep(PAUSE),
            }
        };
        let record = serde_json::from_slice(&bytes);
        if let Err(error) = &record {
            tracing::error!(%id, part = part.name(), %error, "a damaged record");
        }
        Ok(record.ok())
    }

    fn look(&self, id: PhotoId) -> io::Result<Found> {
        let folder = self.folder(id);
        let names = self.files.names(&folder)?;
        let has = |part: Part| names.iter().any(|n| n == part.name());
        for name in names.iter().filter(|n| n.strip_suffix(TEMPORARY).is_some()) {
            self.files.remove(&folder.join(name))?;
        }
        let accepted = match self.record(id, Part::Options)? {
            Some(accepted) => accepted,
            None => self.by_default(id)?,
        };
        // what cannot be told to be done is made again
        let mut state: State = if has(Part::State) { self.record(id, Part::State)?.unwrap_or_default() } else { State::default() };
        let results = [Part::Atlas, Part::Disparity, Part::Thumbnail, Part::Report];
        if matches!(state.end, Some(End::Done(_))) && !results.into_iter().all(has) {
            tracing::error!(%id, "a result is missing; it is made again");
            state = State::default();
        }
        let settings = if has(Part::Settings) { self.settings(id)? } else { Settings::default() };
        Ok(Found { id, accepted, state, settings })
    }

    /// What was accepted, where its record is damaged but the id tells that it was an upload without options.
    fn by_default(&self, id: PhotoId) -> io::Result<Accepted> {
        let photo = self.read(id, Part::Upload)?;
        let depth = match self.read(id, Part::Depth) {
            Ok(depth) => Some(depth),
            Err(e) if e.kind() == io::ErrorKind::NotFound => None,
            Err(e) => return Err(e),
        };
        let options = options::to_text(&tmpi_pipeline::Options::default());
        let hash = |bytes: &Vec<u8>| <[u8; 32]>::from(Sha256::digest(bytes));
        if PhotoId::of(&hash(&photo), depth.as_ref().map(hash).as_ref(), &options::canonical(&options), &self.pipeline) != id {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "its options are lost: upload the photo again"));
        }
        let depth_bytes = depth.map(|d| d.len() as u64);
        Ok(Accepted { version: VERSION, at_ms: now_ms(), photo_bytes: photo.len() as u64, depth_bytes, options, owner: None })
    }

    /// Settings as far as they are understood; those of a later version, or damaged ones, are kept beside what is written here.
    fn settings(&self, id: PhotoId) -> io::Result<Settings> {
        let bytes = self.read(id, Part::Settings)?;
        Settings::read(&bytes).or_else(|error| {
            tracing::error!(%id, error, "settings; what is understood of them is used");
            let kept = self.folder(id).join(KEPT_SETTINGS);
            if self.files.read(&kept).is_err() {
                self.files.write(&kept, &bytes)?;
            }
            Ok(Settings::understood(&bytes))
        })
    }
}
