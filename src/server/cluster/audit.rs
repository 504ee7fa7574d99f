//! Whether the records and blobs of a store fit together, and what is left over of what was deleted, broken off or made twice.

use std::collections::HashSet;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::index::{self, Listed};
use super::ports::{Blobs, Ledger};
use super::records::{self, End, Marker, Photo};
use crate::server::id::PhotoId;
use crate::server::part::Part;
use crate::server::records as outcome;
use crate::server::time::wall_ms;

/// Digits of the time that begins the name of a making.
const TIME: usize = 13;

/// What a store has, lacks and has left over. Lists are of names of records and blobs, in order.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Audit {
    /// Accepted photos.
    pub photos: usize,
    /// Those that are made.
    pub done: usize,
    /// Those that cannot be made.
    pub failed: usize,
    /// Those that are to be made.
    pub pending: usize,
    /// Those of them that were accepted longer ago than was asked for.
    pub overdue: Vec<String>,
    /// What this program does not understand, and why; it is left alone, and what belongs to it.
    pub unread: Vec<String>,
    /// Accepted photos without a marker among what is pending; any node that runs marks them again.
    pub unmarked: Vec<String>,
    /// Markers of accepted photos that are damaged, so that no node takes them up.
    pub damaged: Vec<String>,
    /// Of these two, those that were marked again.
    pub mended: usize,
    /// The index is said to have all photos; before that nodes enter by and by those that a version before accepted.
    pub built: bool,
    /// Accepted photos that the index lacks, or of which it says other bytes than they have: no list shows them, or a quota counts them wrong.
    pub unlisted: Vec<String>,
    /// Those of them that were entered.
    pub listed: usize,
    /// Blobs that should be there.
    pub missing: Vec<String>,
    /// Uploads and containers that are shorter or longer than their records say.
    pub cut: Vec<String>,
    /// Records and blobs that nothing leads to, older than was asked for.
    pub left_over: Vec<String>,
    /// Those of them that were removed.
    pub removed: usize,
    /// Folders that were empty for as long, and were removed; an object store has none.
    pub folders: usize,
}

/// What is done about what an audit finds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Remedy {
    /// Nothing.
    Tell,
    /// What waits and no node would take up is marked again, and what the index lacks is entered.
    Mend,
    /// What is left over is removed.
    Remove,
}

impl Audit {
    /// True where nothing is lost, everything was understood, and what was amiss with markers and a whole index is mended.
    #[must_use]
    pub const fn is_sound(&self) -> bool {
        let is_listed = !self.built || self.unlisted.len() == self.listed;
        is_listed
            && self.unread.is_empty()
            && self.missing.is_empty()
            && self.cut.is_empty()
            && self.unmarked.len() + self.damaged.len() == self.mended
    }
}

/// Looks through a store, and puts right or removes what `remedy` says; what is left over for less than `age` stays. Nodes may run
/// meanwhile: uploads that take longer than `age` would lose their files. Blocks; called within a runtime.
///
/// # Errors
/// The address is not understood, or the store cannot be reached.
pub fn audit(store: &str, age: Duration, remedy: Remedy) -> io::Result<Audit> {
    if let Some(path) = store.strip_prefix("file://")
        && !std::path::Path::new(path).is_dir()
    {
        return Err(io::Error::new(io::ErrorKind::NotFound, "there is no such folder"));
    }
    let (blobs, ledger) = super::open::ports_at(store)?;
    let before_ms = wall_ms().saturating_sub(age.as_millis() as u64);
    let mut audit = Auditor { blobs: Arc::clone(&blobs), ledger, before_ms, remedy, audit: Audit::default() }.run()?;
    if remedy == Remedy::Remove {
        audit.folders = blobs.tidy(age)?;
    }
    Ok(audit)
}

struct Auditor {
    blobs: Arc<dyn Blobs>,
    ledger: Arc<dyn Ledger>,
    before_ms: u64,
    remedy: Remedy,
    audit: Audit,
}

/// What is to be there.
#[derive(Default)]
struct Wanted {
    names: HashSet<String>,
    /// Begins of names that may come and go: of what is being made.
    open: HashSet<(PhotoId, String)>,
    /// Photos of which the record is not understood.
    unknown: HashSet<PhotoId>,
}

impl Auditor {
    fn run(mut self) -> io::Result<Audit> {
        // what is there first, then what it is for: what comes meanwhile is not taken for left over
        let mut there = Vec::new();
        for folder in [records::ENDS, records::PENDING, records::BLOBS, index::LISTS] {
            there.extend(self.ledger.all(folder)?);
        }
        let names: HashSet<&str> = there.iter().map(String::as_str).collect();
        let mut wanted = Wanted::default();
        wanted.names.extend([index::BUILT, index::BUILDING].map(str::to_owned));
        self.audit.built = names.contains(index::BUILT);
        for name in self.ledger.all(records::PHOTOS)? {
            self.photo(&name, &names, &mut wanted)?;
        }
        for name in there.iter().filter(|name| !wanted.names.contains(*name)) {
            self.other(name, &wanted)?;
        }
        let Audit { overdue, unread, unmarked, damaged, unlisted, missing, cut, left_over, .. } = &mut self.audit;
        for list in [overdue, unread, unmarked, damaged, unlisted, missing, cut, left_over] {
            list.sort_unstable();
        }
        if self.remedy == Remedy::Remove {
            for name in &self.audit.left_over {
                if name.starts_with(records::BLOBS) { self.blobs.discard(name) } else { self.ledger.remove(name) }?;
                self.audit.removed += 1;
            }
        }
        Ok(self.audit)
    }

    /// A record; none where it is gone, or is not understood, which is told.
    fn record<T: DeserializeOwned>(&mut self, name: &str) -> io::Result<Option<T>> {
        let Some((bytes, _)) = self.ledger.get(name)? else { return Ok(None) };
        match records::read(name, &bytes) {
            Ok(record) => Ok(Some(record)),
            Err(error) => {
                self.audit.unread.push(error.to_string());
                Ok(None)
            }
        }
    }

    /// Looks at a photo and what belongs to it.
    fn photo(&mut self, name: &str, there: &HashSet<&str>, wanted: &mut Wanted) -> io::Result<()> {
        let Some(id) = name.strip_prefix(records::PHOTOS).and_then(|id| id.parse::<PhotoId>().ok()) else {
            self.audit.unread.push(format!("the record {name}: its name is no photo's"));
            return Ok(());
        };
        let unread = self.audit.unread.len();
        let Some(photo) = self.record::<Photo>(name)? else {
            // one that was deleted meanwhile has nothing that is wanted
            if self.audit.unread.len() > unread {
                wanted.unknown.insert(id);
            }
            return Ok(());
        };
        self.audit.photos += 1;
        let (end_name, marker) = (End::name(id, &photo.making), Marker::name_of(id, &photo.making));
        let end = self.record::<End>(&end_name)?;
        if self.audit.unread.len() > unread {
            wanted.unknown.insert(id);
            return Ok(());
        }
        let mut blobs = vec![records::blob(id, &photo.source, Part::Upload)];
        blobs.extend(photo.accepted.depth_bytes.map(|_| records::blob(id, &photo.source, Part::Depth)));
        blobs.extend(photo.strokes.clone());
        self.lengths(id, &photo, end.as_ref())?;
        match &end {
            Some(End { outcome: outcome::End::Done(_), blobs: of, .. }) => {
                self.audit.done += 1;
                blobs.extend([Part::Atlas, Part::Disparity, Part::Thumbnail, Part::Report].map(|part| format!("{of}.{}", part.name())));
            }
            Some(_) => self.audit.failed += 1,
            None => {
                self.audit.pending += 1;
                if self.is_old(&photo.making) {
                    self.audit.overdue.push(name.to_owned());
                }
                self.marker(name, id, &photo.making)?;
                wanted.open.insert((id, photo.making.clone()));
                wanted.open.extend(photo.before.clone().map(|before| (id, before)));
                wanted.names.insert(marker);
            }
        }
        wanted.names.insert(end_name);
        self.entries(name, id, (&photo, end.as_ref()), there, wanted)?;
        for blob in blobs {
            if !there.contains(blob.as_str()) && !self.ledger.all(&records::blobs(id))?.contains(&blob) {
                self.audit.missing.push(blob.clone());
            }
            wanted.names.insert(blob);
        }
        Ok(())
    }

    /// Looks whether what was uploaded and the container are as long as their records say, without reading them: by the last byte of each.
    fn lengths(&mut self, id: PhotoId, photo: &Photo, end: Option<&End>) -> io::Result<()> {
        let uploaded = [(Part::Upload, Some(photo.accepted.photo_bytes)), (Part::Depth, photo.accepted.depth_bytes)];
        let uploaded = uploaded.into_iter().filter_map(|(part, bytes)| Some((records::blob(id, &photo.source, part), bytes?)));
        let made = end.and_then(|end| match &end.outcome {
            outcome::End::Done(done) => Some((format!("{}.{}", end.blobs, Part::Atlas.name()), done.atlas_bytes)),
            outcome::End::Failed(_) => None,
        });
        for (name, bytes) in uploaded.chain(made) {
            let last = bytes.saturating_sub(1);
            // and one more, which must not be there
            match self.blobs.read_range(&name, last..bytes + 1) {
                Ok(there) if there.len() as u64 == bytes - last => {}
                Ok(_) => self.audit.cut.push(name),
                // that is told of it, or it was deleted meanwhile
                Err(e) if e.kind() == io::ErrorKind::NotFound => {}
                Err(e) => return Err(e),
            }
        }
        Ok(())
    }

    /// Looks at the entries of a photo in the index. While it is made, those may come and go that say what was made before.
    fn entries(
        &mut self,
        name: &str,
        id: PhotoId,
        (photo, end): (&Photo, Option<&End>),
        there: &HashSet<&str>,
        wanted: &mut Wanted,
    ) -> io::Result<()> {
        let names = index::names(id, &photo.accepted, index::made(end.map(|end| &end.outcome)));
        let mut is_lacking = false;
        for entry in names {
            let is_there = there.contains(entry.as_str()) || end.is_none() && there.iter().any(|there| is_of_one(there, &entry));
            // it may have come meanwhile
            is_lacking |= !is_there && self.ledger.get(&entry)?.is_none();
            wanted.names.insert(entry);
        }
        if is_lacking {
            self.audit.unlisted.push(name.to_owned());
            if self.remedy == Remedy::Mend {
                index::enter(&*self.ledger, id, &photo.accepted, index::made(end.map(|end| &end.outcome)))?;
                self.audit.listed += 1;
            }
        }
        Ok(())
    }

    /// Looks at the marker of an accepted photo that has not ended.
    fn marker(&mut self, photo: &str, id: PhotoId, making: &str) -> io::Result<()> {
        let (name, fresh) = (Marker::name_of(id, making), serde_json::to_vec_pretty(&Marker::new(id, making))?);
        let mends = self.remedy == Remedy::Mend;
        let Some((bytes, seen)) = self.ledger.get(&name)? else {
            // it may have ended meanwhile
            if self.ledger.get(&End::name(id, making))?.is_none() {
                self.audit.unmarked.push(photo.to_owned());
                self.audit.mended += usize::from(mends && self.ledger.create(&name, &fresh)?);
            }
            return Ok(());
        };
        match records::read::<Marker>(&name, &bytes) {
            Err(_) if records::is_damaged::<Marker>(&bytes) => {
                self.audit.damaged.push(name.clone());
                self.audit.mended += usize::from(mends && self.ledger.swap(&name, &seen, &fresh)?.is_some());
            }
            Err(error) => self.audit.unread.push(error.to_string()),
            Ok(_) => {}
        }
        Ok(())
    }

    /// Looks at a record or blob that no photo leads to.
    fn other(&mut self, name: &str, wanted: &Wanted) -> io::Result<()> {
        if let Some(Listed { place: (at_ms, id), .. }) = Listed::read(name) {
            let is_open = wanted.open.iter().any(|(of, _)| *of == id);
            if !wanted.unknown.contains(&id) && !is_open && at_ms < self.before_ms {
                self.audit.left_over.push(name.to_owned());
            }
            return Ok(());
        }
        let Some((id, making)) = owner(name) else {
            self.audit.unread.push(format!("{name}: its name is none of this program's"));
            return Ok(());
        };
        let is_open = wanted.open.iter().any(|(of, open)| *of == id && making.starts_with(open.as_str()));
        if wanted.unknown.contains(&id) || is_open || !self.is_old(making) {
            return Ok(());
        }
        let unread = self.audit.unread.len();
        if name.starts_with(records::ENDS) {
            self.record::<End>(name)?;
        } else if name.starts_with(records::PENDING) {
            self.record::<Marker>(name)?;
        }
        if self.audit.unread.len() == unread {
            self.audit.left_over.push(name.to_owned());
        }
        Ok(())
    }

    fn is_old(&self, making: &str) -> bool {
        // a making's name begins with its time in milliseconds since 1970
        making.get(..TIME).and_then(|ms| ms.parse::<u64>().ok()).is_some_and(|ms| ms < self.before_ms)
    }
}

/// True for two entries of one photo in one folder, whatever bytes they say.
fn is_of_one(one: &str, other: &str) -> bool {
    one.starts_with(index::OWNERS) && one.rsplit_once('.').map(|(of, _)| of) == other.rsplit_once('.').map(|(of, _)| of)
}

/// Photo and making of which a record or blob is; of a blob with who made it.
fn owner(name: &str) -> Option<(PhotoId, &str)> {
    let (folder, rest) = name.split_once('/')?;
    let (id, making) = match folder {
        "pending" => rest.rsplit_once('.').map(|(making, id)| (id, making))?,
        "ends" => rest.split_once('.')?,
        _ => {
            let (id, rest) = rest.split_once('/')?;
            (id, rest.split_once('.')?.0)
        }
    };
    Some((id.parse().ok()?, making))
}
