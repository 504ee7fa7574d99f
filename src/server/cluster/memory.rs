//! A store in memory for tests, which ends in the middle of things or is away.

use std::collections::BTreeMap;
use std::ops::Bound;
use std::path::Path;
use std::sync::atomic::AtomicUsize;

use super::ports::unreachable;
use super::*;
use crate::server::access::Owner;
use crate::server::limits::Limits;
use crate::server::records::{Done, End as Outcome};
use crate::server::store::digest;

/// Bytes of what was made of each photo.
pub const MADE: u64 = 100;

/// Of which that is.
pub const ATLAS: [u8; MADE as usize] = [7; MADE as usize];

/// Records and blobs with the number of their version.
type There = BTreeMap<String, (Vec<u8>, u64)>;

/// What is in it stays when a node that has it is gone.
#[derive(Clone, Debug, Default)]
pub struct Memory(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    there: Mutex<There>,
    /// Changes that are still made.
    left: AtomicUsize,
    away: AtomicBool,
    meanwhile: Meanwhile,
}

/// Begin of the names of records, and what others do while one of them is read or created.
type Turn = (&'static str, Box<dyn FnOnce() + Send>);

#[derive(Default)]
struct Meanwhile(Mutex<Option<Turn>>);

impl std::fmt::Debug for Meanwhile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Meanwhile")
    }
}

impl Default for Inner {
    fn default() -> Self {
        Self { there: Mutex::default(), left: AtomicUsize::new(usize::MAX), away: AtomicBool::new(false), meanwhile: Meanwhile::default() }
    }
}

impl Memory {
    /// Each change after so many more fails, as if the process had ended.
    pub fn end_after(&self, changes: usize) {
        self.0.left.store(changes, Ordering::SeqCst);
    }

    /// Whether fewer changes were made than could have been.
    pub fn has_left(&self) -> bool {
        self.0.left.load(Ordering::SeqCst) > 0
    }

    /// From now on nothing can be reached, or everything can.
    pub fn is_away(&self, away: bool) {
        self.0.away.store(away, Ordering::SeqCst);
    }

    /// Says that the index has all photos.
    pub fn built(&self) {
        self.create(index::BUILT, b"{\"version\": 1}").unwrap();
    }

    /// Puts what was made of the photo `n` there.
    pub fn make(&self, n: u32, (at_ms, id): Place) {
        for part in [Part::Atlas, Part::Disparity, Part::Thumbnail, Part::Report] {
            self.put(&records::blob(id, &format!("{at_ms:013}-ab-{n}-ab-0"), part), ATLAS.to_vec()).unwrap();
        }
    }

    /// Loses the atlas of the photo `n`.
    pub fn lose(&self, n: u32, (at_ms, id): Place) {
        self.discard(&records::blob(id, &format!("{at_ms:013}-ab-{n}-ab-0"), Part::Atlas)).unwrap();
    }

    /// Puts something in place of the record of a photo, or takes that away.
    pub fn spoil(&self, id: PhotoId, record: Option<&[u8]>) {
        match record {
            Some(record) => self.put(&Photo::name(id), record.to_vec()).unwrap(),
            None => Ledger::remove(self, &Photo::name(id)).unwrap(),
        }
    }

    /// Whether the record of a photo is there.
    pub fn has(&self, id: PhotoId) -> bool {
        self.get(&Photo::name(id)).unwrap().is_some()
    }

    /// Places of the entries that are there, by their names.
    pub fn entries(&self) -> Vec<(String, Place)> {
        let names = self.all(index::LISTS).unwrap();
        names.into_iter().filter_map(|name| index::Listed::read(&name).map(|listed| (name, listed.place))).collect()
    }

    /// Has others do `what` once, before the next record is created or while the next is read of which the name begins so.
    pub fn meanwhile(&self, of: &'static str, what: impl FnOnce() + Send + 'static) {
        *lock(&self.0.meanwhile.0) = Some((of, Box::new(what)));
    }

    fn others(&self, name: &str) {
        let due = lock(&self.0.meanwhile.0).take_if(|(of, _)| name.starts_with(*of));
        if let Some((_, what)) = due {
            what();
        }
    }

    fn there(&self) -> io::Result<MutexGuard<'_, There>> {
        if self.0.away.load(Ordering::SeqCst) { Err(unreachable("it is away")) } else { Ok(self.0.there.lock().unwrap()) }
    }

    fn change<T>(&self, change: impl FnOnce(&mut There) -> T) -> io::Result<T> {
        let mut there = self.there()?;
        let left =
            self.0.left.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |n| if n == usize::MAX { Some(n) } else { n.checked_sub(1) });
        left.map_err(|_| unreachable("the process has ended"))?;
        Ok(change(&mut there))
    }
}

impl Ledger for Memory {
    fn create(&self, name: &str, bytes: &[u8]) -> io::Result<bool> {
        self.others(name);
        if self.there()?.contains_key(name) {
            return Ok(false);
        }
        self.change(|there| {
            let is_new = !there.contains_key(name);
            there.entry(name.to_owned()).or_insert_with(|| (bytes.to_vec(), 0));
            is_new
        })
    }

    fn get(&self, name: &str) -> io::Result<Option<(Vec<u8>, Tag)>> {
        let read = self.there()?.get(name).map(|(bytes, version)| (bytes.clone(), Tag(version.to_string())));
        self.others(name);
        Ok(read)
    }

    fn swap(&self, name: &str, seen: &Tag, bytes: &[u8]) -> io::Result<Option<Tag>> {
        self.change(|there| {
            let (now, version) = there.get_mut(name).filter(|(_, version)| version.to_string() == seen.0)?;
            (*now, *version) = (bytes.to_vec(), *version + 1);
            Some(Tag(version.to_string()))
        })
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        self.change(|there| drop(there.remove(name)))
    }

    fn page(&self, folder: &str, after: Option<&str>, limit: usize) -> io::Result<Vec<String>> {
        let there = self.there()?;
        let first = after.filter(|after| *after > folder).map_or(Bound::Included(folder), Bound::Excluded);
        let names = there.range::<str, _>((first, Bound::Unbounded)).map(|(name, _)| name);
        Ok(names.take_while(|name| name.starts_with(folder)).take(limit).cloned().collect())
    }
}

impl Blobs for Memory {
    fn put(&self, name: &str, bytes: Vec<u8>) -> io::Result<()> {
        self.change(|there| drop(there.insert(name.to_owned(), (bytes, 0))))
    }

    fn read(&self, name: &str) -> io::Result<Vec<u8>> {
        self.get(name)?.map(|(bytes, _)| bytes).ok_or_else(|| io::ErrorKind::NotFound.into())
    }

    fn discard(&self, name: &str) -> io::Result<()> {
        self.remove(name)
    }
}

/// A node of the store, with nothing that works by itself; `dir` takes what it would have in a folder.
pub fn cluster(store: &Memory, dir: &Path) -> Cluster {
    let sharing = Sharing { store: format!("file://{}", dir.join("unused").display()), role: Role::Serve, nats: None };
    let limits = Limits { lease: Duration::from_mins(1), sweep: Duration::from_millis(50), ..Limits::default() };
    let mut cluster = Cluster::open(&sharing, &limits).unwrap();
    (cluster.blobs, cluster.ledger) = (Arc::new(store.clone()), Arc::new(store.clone()));
    cluster
}

/// What is accepted of a photo of 5 bytes.
pub fn accepted(n: u32, at_ms: u64, owner: Option<&Owner>) -> (PhotoId, Accepted) {
    let mut bytes = [0; 16];
    // in no order of age
    bytes[..4].copy_from_slice(&n.wrapping_mul(2_654_435_761).to_be_bytes());
    let options = BTreeMap::from([("planes".to_owned(), n.to_string())]);
    let accepted = Accepted { version: 1, at_ms, photo_bytes: 5, depth_bytes: None, options, owner: owner.cloned() };
    (PhotoId::from_bytes(bytes), accepted)
}

/// Settings of such a photo.
pub fn settings(n: u32) -> Settings {
    Settings { title: Some(format!("Photo {n}")), ..Settings::default() }
}

/// What was made of it.
pub fn done(at_ms: u64) -> Done {
    Done { at_ms: at_ms + 1, width: 4, height: 3, atlas_bytes: MADE, atlas_hash: digest(&ATLAS) }
}

/// Puts the records of a photo that was made into a store, as a version before did, or with its entries; gives its place.
pub fn put(ledger: &dyn Ledger, n: u32, at_ms: u64, owner: Option<&Owner>, entered: bool) -> Place {
    let (id, accepted) = accepted(n, at_ms, owner);
    if entered {
        index::enter(ledger, id, &accepted, MADE).unwrap();
    }
    let making = format!("{at_ms:013}-ab-{n}");
    let end = End { version: 1, outcome: Outcome::Done(done(at_ms)), blobs: format!("{}{making}-ab-0", records::blobs(id)) };
    ledger.create(&End::name(id, &making), &serde_json::to_vec(&end).unwrap()).unwrap();
    let source = making.clone();
    let photo = Photo { version: 1, accepted, settings: settings(n), source, making, before: None, strokes: None };
    assert!(ledger.create(&Photo::name(id), &serde_json::to_vec(&photo).unwrap()).unwrap());
    (at_ms, id)
}

/// Enters a photo as if it had been accepted then, and by that owner.
pub fn enter(ledger: &dyn Ledger, n: u32, at_ms: u64, owner: Option<&Owner>) {
    let (id, accepted) = accepted(n, at_ms, owner);
    index::enter(ledger, id, &accepted, MADE).unwrap();
}
