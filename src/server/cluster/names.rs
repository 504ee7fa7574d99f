//! Names of a folder of files as they were read, so that not each page of a long list reads the whole folder.

use std::collections::BinaryHeap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use super::lock;

/// For how long a folder's stamp must have been seen before the folder is read: what is changed later then has another stamp, also where the
/// file system tells whole seconds.
const SETTLES: Duration = Duration::from_secs(3);
/// For how long pages go on in what the first of them read.
const MOMENT: Duration = Duration::from_secs(5);
/// Bytes of the names that are kept of one folder, and of all.
const MOST: usize = 16 << 20;
const MOST_OF_ALL: usize = 32 << 20;
/// Bytes that a name takes beside its own.
const BESIDE: usize = size_of::<String>();

/// Names in the order of their bytes.
type Sorted = Arc<Vec<String>>;

/// Names of folders that were read last.
#[derive(Debug)]
pub struct Names {
    kept: Mutex<Vec<Kept>>,
    settles: Duration,
}

#[derive(Debug)]
struct Kept {
    folder: String,
    names: Sorted,
    bytes: usize,
    /// When the folder was changed last, as the file system said before it was read; when that was seen first, and when it was read.
    stamp: SystemTime,
    seen: Instant,
    read: Instant,
}

/// What is read of a folder: all of its names, or, where these are too many to be kept, the first after one.
pub struct Reading<'a> {
    after: Option<&'a str>,
    limit: usize,
    all: Option<Vec<String>>,
    bytes: usize,
    /// The last of them on top.
    first: BinaryHeap<String>,
    /// There are folders within it, of which the stamps are their own.
    pub is_deep: bool,
}

impl<'a> Reading<'a> {
    pub fn new(after: Option<&'a str>, limit: usize) -> Self {
        Self { after, limit, all: Some(Vec::new()), bytes: 0, first: BinaryHeap::new(), is_deep: false }
    }

    /// Takes a name, which may come in any order.
    pub fn take(&mut self, name: String) {
        self.bytes += name.len() + BESIDE;
        match &mut self.all {
            Some(all) => all.push(name),
            None => self.choose(name),
        }
        if self.bytes > MOST
            && let Some(all) = self.all.take()
        {
            for name in all {
                self.choose(name);
            }
        }
    }

    fn choose(&mut self, name: String) {
        if self.after.is_some_and(|after| name.as_str() <= after) {
            return;
        }
        self.first.push(name);
        if self.first.len() > self.limit {
            self.first.pop();
        }
    }
}

impl Default for Names {
    fn default() -> Self {
        Self { kept: Mutex::default(), settles: SETTLES }
    }
}

impl Names {
    /// The page where it is known: of a folder that was not changed since it was read, or of the moment of which the page before was, which
    /// gave the name `after`.
    pub fn page(&self, folder: &str, stamp: Option<SystemTime>, after: Option<&str>, limit: usize) -> Option<Vec<String>> {
        let mut kept = lock(&self.kept);
        let at = kept.iter().position(|of| of.folder == folder)?;
        // what is asked for stays longest
        let of = kept.remove(at);
        let is_same = Some(of.stamp) == stamp && of.read.saturating_duration_since(of.seen) >= self.settles;
        let goes_on =
            || of.read.elapsed() < MOMENT && after.is_some_and(|after| of.names.binary_search_by(|name| name.as_str().cmp(after)).is_ok());
        let names = (is_same || goes_on()).then(|| Arc::clone(&of.names));
        kept.push(of);
        drop(kept);
        Some(page_of(&names?, after, limit))
    }

    /// Takes what was read at `read` of a folder, which had `stamp` before; gives the page that was asked for.
    pub fn keep(&self, folder: &str, stamp: Option<SystemTime>, read: Instant, reading: Reading<'_>) -> Vec<String> {
        let Reading { after, limit, all, bytes, first, is_deep } = reading;
        let Some(mut all) = all else { return first.into_sorted_vec() };
        all.sort_unstable();
        let names = Arc::new(all);
        let mut kept = lock(&self.kept);
        let before = kept.iter().position(|of| of.folder == folder).map(|at| kept.remove(at));
        if let Some(stamp) = stamp.filter(|_| !is_deep) {
            let seen = before.filter(|before| before.stamp == stamp).map_or(read, |before| before.seen);
            kept.push(Kept { folder: folder.to_owned(), names: Arc::clone(&names), bytes, stamp, seen, read });
            let mut all: usize = kept.iter().map(|of| of.bytes).sum();
            while all > MOST_OF_ALL {
                all -= kept.remove(0).bytes;
            }
        }
        drop(kept);
        page_of(&names, after, limit)
    }
}

fn page_of(names: &[String], after: Option<&str>, limit: usize) -> Vec<String> {
    let from = after.map_or(0, |after| names.partition_point(|name| name.as_str() <= after));
    names[from..].iter().take(limit).cloned().collect()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::folder::Folder;
    use super::super::ports::Ledger;
    use super::*;

    fn put(folder: &Folder, n: usize) {
        assert!(folder.create(&format!("photos/{n:05}"), b"{}").unwrap());
    }

    fn first(folder: &Folder) -> usize {
        folder.page("photos/", None, usize::MAX).unwrap().len()
    }

    /// The stamp of the folder of photos, which may be set.
    fn stamp(dir: &Path, set: Option<SystemTime>) -> SystemTime {
        let at = std::fs::File::open(dir.join("photos")).unwrap();
        set.map_or_else(|| at.metadata().unwrap().modified().unwrap(), |to| at.set_modified(to).map(|()| to).unwrap())
    }

    #[test]
    fn what_another_changes_is_seen_at_once() {
        let dir = tempfile::tempdir().unwrap();
        let [one, two] = [0; 2].map(|_| Folder::open(dir.path()).unwrap());
        for n in 0..300 {
            put(&one, n);
            assert_eq!(first(&two), n + 1);
        }
        for n in 0..50 {
            one.remove(&format!("photos/{n:05}")).unwrap();
            assert_eq!(first(&two), 299 - n);
        }
    }

    #[test]
    fn pages_go_on_in_what_the_first_of_them_read() {
        let dir = tempfile::tempdir().unwrap();
        let [one, two] = [0; 2].map(|_| Folder::open(dir.path()).unwrap());
        for n in 0..10 {
            put(&one, 2 * n);
        }
        let (mut all, mut after) = (Vec::new(), None::<String>);
        for n in 0..3 {
            let page = one.page("photos/", after.as_deref(), 4).unwrap();
            after = page.last().cloned();
            all.extend(page);
            // behind what was given
            put(&two, 2 * (9 - n) + 1);
        }
        let even: Vec<String> = (0..10).map(|n| format!("photos/{:05}", 2 * n)).collect();
        assert_eq!(all, even, "the folder is not read again for each page");
        assert_eq!((first(&one), first(&two)), (13, 13));
        // by a name that no page gave it is read
        put(&two, 100);
        assert_eq!(one.page("photos/", Some("photos/00019:"), 9).unwrap(), ["photos/00100"]);
    }

    #[test]
    fn a_folder_that_rests_is_read_once() {
        let dir = tempfile::tempdir().unwrap();
        let names = Names { settles: Duration::from_millis(30), ..Names::default() };
        let folder = Folder::open(dir.path()).unwrap().with_names(names);
        for n in 0..3 {
            put(&folder, n);
        }
        assert_eq!(first(&folder), 3);
        std::thread::sleep(Duration::from_millis(40));
        assert_eq!(first(&folder), 3);
        // a change that does not show by the stamp tells whether it was read
        let before = stamp(dir.path(), None);
        put(&folder, 3);
        stamp(dir.path(), Some(before));
        assert_eq!(first(&folder), 3);
        stamp(dir.path(), Some(before + Duration::from_secs(1)));
        assert_eq!(first(&folder), 4);
    }

    #[test]
    fn a_folder_that_was_read_a_moment_ago_is_read_again_though_its_stamp_is_the_same() {
        let dir = tempfile::tempdir().unwrap();
        let folder = Folder::open(dir.path()).unwrap();
        put(&folder, 0);
        let before = stamp(dir.path(), None);
        assert_eq!(first(&folder), 1);
        // as where a file system tells whole seconds
        put(&folder, 1);
        stamp(dir.path(), Some(before));
        assert_eq!(first(&folder), 2);
    }

    #[test]
    fn of_more_names_than_are_kept_a_page_has_the_first() {
        let long = "x".repeat(1 << 16);
        let many = MOST / long.len() + 2;
        let name = |n: usize| format!("{n:05}{long}");
        let names = Names::default();
        let mut reading = Reading::new(Some(&long), 3);
        (0..many).rev().for_each(|n| reading.take(name(n)));
        assert!(reading.all.is_none());
        let page = names.keep("a/", Some(SystemTime::now()), Instant::now(), reading);
        assert!(page.is_empty(), "all are before that");
        let after = name(4);
        let mut reading = Reading::new(Some(&after), 3);
        (0..many).rev().for_each(|n| reading.take(name(n)));
        assert_eq!(names.keep("a/", Some(SystemTime::now()), Instant::now(), reading), [5, 6, 7].map(name));
        assert!(lock(&names.kept).is_empty());
    }
}
