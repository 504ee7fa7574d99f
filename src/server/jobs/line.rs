//! Jobs that wait, in classes: what somebody waits for first, but none for ever.
//!
//! Photos are begun by the threads that make them, files by those that write them. Each begins the highest class of its own that waits – a
//! fourth time in a row it is the next lower one's turn –, and what nobody waits for at the moment, files and batches, only while nothing of a
//! higher class waits, whoever begins that: unless three such were begun meanwhile, or it has waited for [`HOLD`].

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::server::entry::Entry;
use crate::server::exports::Ordered;
use crate::server::id::PhotoId;

/// Jobs of higher classes that are begun before one that waits behind them.
const PASSED: u32 = 3;
/// Longest time that a class gives way to what other threads do not begin.
const HOLD: Duration = Duration::from_secs(30);

/// How urgent a job is; the first is the most urgent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Class {
    /// An upload, or a photo that its owner has made again.
    #[default]
    Interactive,
    /// A file that is stored until it is fetched.
    Export,
    /// A photo of many.
    Batch,
}

impl Class {
    const ALL: [Self; 3] = [Self::Interactive, Self::Export, Self::Batch];

    /// Name, as in metrics.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Interactive => "interactive",
            Self::Export => "export",
            Self::Batch => "batch",
        }
    }

    /// The class that clients name for a photo: `interactive` or `batch`.
    #[must_use]
    pub fn of_photo(name: &str) -> Option<Self> {
        [Self::Interactive, Self::Batch].into_iter().find(|class| class.name() == name)
    }

    /// True where it is begun only while nothing above it waits.
    const fn gives_way(self) -> bool {
        matches!(self, Self::Export | Self::Batch)
    }
}

/// What waits.
#[derive(Clone)]
pub enum Job {
    /// A photo to be made.
    Photo(Arc<Entry>),
    /// A file to be written.
    File(Arc<Ordered>),
}

/// Who takes jobs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hand {
    /// A thread that makes photos.
    Maker,
    /// A thread that writes files.
    Writer,
}

impl Hand {
    fn may(self, class: Class) -> bool {
        (self == Self::Writer) == (class == Class::Export)
    }
}

/// What a thread gets.
pub enum Next {
    /// This job.
    Job(Job),
    /// Nothing, unless something else happens, until then.
    Later(Instant),
    /// Nothing.
    Nothing,
}

#[derive(Default)]
struct Waits {
    jobs: VecDeque<(Instant, Job)>,
    /// Jobs of higher classes that were begun since one of this class was, while some waited.
    passed: u32,
}

/// The line of jobs that wait.
#[derive(Default)]
pub struct Line {
    waits: [Waits; 3],
    /// How often a photo is among those, so that nobody looks through them for one.
    photos: HashMap<PhotoId, usize>,
}

impl Line {
    fn of(&mut self, class: Class) -> &mut Waits {
        &mut self.waits[class as usize]
    }

    /// Puts a job behind those of its class.
    pub fn push(&mut self, class: Class, job: Job) {
        if let Job::Photo(entry) = &job {
            *self.photos.entry(entry.id).or_default() += 1;
        }
        self.of(class).jobs.push_back((Instant::now(), job));
    }

    /// Puts a photo behind those of its class.
    pub fn push_photo(&mut self, entry: &Arc<Entry>) {
        self.push(entry.class(), Job::Photo(Arc::clone(entry)));
    }

    /// The next job for a thread at `now`. Where `alone` is false others begin the photos that wait, and files do not wait for them.
    pub fn take(&mut self, hand: Hand, alone: bool, now: Instant) -> Next {
        let mine = || Class::ALL.into_iter().filter(|class| hand.may(*class) && !self.waits[*class as usize].jobs.is_empty());
        let is_due = |class: Class| self.waits[class as usize].passed >= PASSED;
        let Some(class) = mine().find(|class| is_due(*class)).or_else(|| mine().next()) else { return Next::Nothing };
        let is_behind = Class::ALL.into_iter().any(|other| other < class && !self.waits[other as usize].jobs.is_empty());
        if alone && class.gives_way() && !is_due(class) && is_behind {
            let until = self.waits[class as usize].jobs.front().map_or(now, |(since, _)| *since + HOLD);
            if now < until {
                return Next::Later(until);
            }
        }
        let Some((_, job)) = self.of(class).jobs.pop_front() else { return Next::Nothing };
        if let Job::Photo(entry) = &job {
            self.is_out(entry.id);
        }
        self.of(class).passed = 0;
        for lower in Class::ALL.into_iter().filter(|lower| *lower > class) {
            let lower = self.of(lower);
            lower.passed = if lower.jobs.is_empty() { 0 } else { lower.passed + 1 };
        }
        Next::Job(job)
    }

    /// One of a photo was taken out.
    fn is_out(&mut self, id: PhotoId) {
        if let Some(times) = self.photos.get_mut(&id) {
            *times -= 1;
            if *times == 0 {
                self.photos.remove(&id);
            }
        }
    }

    /// True where a photo waits.
    #[must_use]
    pub fn has(&self, id: PhotoId) -> bool {
        self.photos.contains_key(&id)
    }

    /// Photos that wait, the most urgent class first.
    pub fn photos(&self) -> impl Iterator<Item = &Arc<Entry>> {
        self.waits.iter().flat_map(|w| &w.jobs).filter_map(|(_, job)| if let Job::Photo(entry) = job { Some(entry) } else { None })
    }

    /// Count of photos that wait.
    #[must_use]
    pub fn count(&self) -> usize {
        self.waits[Class::Interactive as usize].jobs.len() + self.waits[Class::Batch as usize].jobs.len()
    }

    /// Jobs of each class that wait.
    #[must_use]
    pub fn waiting(&self) -> [(&'static str, usize); 3] {
        Class::ALL.map(|class| (class.name(), self.waits[class as usize].jobs.len()))
    }

    /// True where nothing waits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.waits.iter().all(|w| w.jobs.is_empty())
    }

    /// Takes a photo out.
    pub fn remove_photo(&mut self, id: PhotoId) {
        if self.photos.remove(&id).is_none() {
            return;
        }
        for waits in &mut self.waits {
            waits.jobs.retain(|(_, job)| !matches!(job, Job::Photo(entry) if entry.id == id));
        }
    }

    /// Takes a file out.
    pub fn remove_file(&mut self, file: &Arc<Ordered>) {
        self.of(Class::Export).jobs.retain(|(_, job)| !matches!(job, Job::File(other) if Arc::ptr_eq(other, file)));
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::server::settings::Settings;
    use crate::server::store::Accepted;

    fn photo(n: u8, class: Class) -> Arc<Entry> {
        let accepted = Accepted { version: 1, at_ms: 1, photo_bytes: 1, depth_bytes: None, options: BTreeMap::new(), owner: None };
        let entry = Entry::new(PhotoId::of(&[n; 32], None, "", ""), accepted, Settings::default());
        entry.set_class(class);
        Arc::new(entry)
    }

    /// Line with so many of each class.
    fn line(counts: [u8; 3]) -> Line {
        let mut line = Line::default();
        for (class, count) in Class::ALL.into_iter().zip(counts) {
            for n in 0..count {
                match class {
                    Class::Export => line.push(class, Job::File(Arc::new(Ordered::for_tests(&n.to_string())))),
                    _ => line.push_photo(&photo(n, class)),
                }
            }
        }
        line
    }

    /// Class of what a thread gets: `.` for nothing.
    fn taken(line: &mut Line, hand: Hand, now: Instant) -> char {
        match line.take(hand, true, now) {
            Next::Job(Job::Photo(entry)) => entry.class().name().chars().next().unwrap(),
            Next::Job(Job::File(_)) => 'e',
            Next::Later(_) | Next::Nothing => '.',
        }
    }

    fn all(line: &mut Line, hands: &[Hand]) -> String {
        let now = Instant::now();
        let mut text = String::new();
        while !line.is_empty() {
            for hand in hands {
                text.push(taken(line, *hand, now));
            }
            assert!(text.len() < 100, "it ends: {text}");
        }
        text
    }

    #[test]
    fn what_somebody_waits_for_comes_first_and_each_fourth_is_another() {
        assert_eq!(all(&mut line([3, 0, 3]), &[Hand::Maker]), "iiibbb");
        assert_eq!(all(&mut line([9, 0, 3]), &[Hand::Maker]), "iiibiiibiiib");
        assert_eq!(all(&mut line([0, 2, 0]), &[Hand::Writer]), "ee");
        assert_eq!(all(&mut line([4, 0, 0]), &[Hand::Maker]), "iiii");
    }

    #[test]
    fn files_and_batches_give_way_to_what_is_above_them_but_not_for_ever() {
        // asked in turns, the writer gets its file after three photos, then when none waits
        assert_eq!(all(&mut line([5, 2, 0]), &[Hand::Writer, Hand::Maker]), ".i.i.iei.ie.");
        // a batch waits for files that are to be written, too
        assert_eq!(all(&mut line([0, 2, 1]), &[Hand::Maker, Hand::Writer]), ".e.eb.");
        // of what another thread does not begin nothing is waited for longer than so
        let mut stuck = line([1, 1, 0]);
        let now = Instant::now();
        assert_eq!(taken(&mut stuck, Hand::Writer, now), '.');
        assert_eq!(taken(&mut stuck, Hand::Writer, now + HOLD), 'e');
        assert!(matches!(line([1, 1, 0]).take(Hand::Writer, false, now), Next::Job(_)), "others begin the photos");
    }

    #[test]
    fn a_thread_takes_its_own_and_what_is_taken_out_is_gone() {
        assert_eq!(taken(&mut line([1, 0, 1]), Hand::Writer, Instant::now()), '.');
        assert_eq!(taken(&mut line([0, 1, 0]), Hand::Maker, Instant::now()), '.');
        let mut line = line([2, 0, 0]);
        let first = Arc::clone(line.photos().next().unwrap());
        line.remove_photo(first.id);
        assert_eq!((line.count(), line.photos().any(|e| e.id == first.id)), (1, false));
        assert_eq!(line.waiting(), [("interactive", 1), ("export", 0), ("batch", 0)]);
    }

    #[test]
    fn it_is_known_of_a_photo_whether_it_waits_however_often_it_does() {
        let mut line = line([2, 0, 1]);
        let ids: Vec<PhotoId> = line.photos().map(|e| e.id).collect();
        // as one that was made again before its thread let it go
        let twice = Arc::clone(line.photos().next().unwrap());
        line.push_photo(&twice);
        line.remove_file(&Arc::new(Ordered::for_tests("other")));
        let mut left = line.count();
        while left > 0 {
            assert!(ids.iter().all(|id| line.has(*id) == line.photos().any(|e| e.id == *id)), "{left}");
            assert_ne!(taken(&mut line, Hand::Maker, Instant::now()), '.');
            left -= 1;
        }
        assert!(!ids.iter().any(|id| line.has(*id)));
        line.push_photo(&twice);
        line.push_photo(&twice);
        line.remove_photo(twice.id);
        assert!(!line.has(twice.id) && line.count() == 0);
    }
}
