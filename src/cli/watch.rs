//! `tmpi make DIR --watch`: follows a folder.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

use anyhow::Context;

use super::batch::{Batch, Item, check_folder};
use super::depth_pairs::is_named_as_map;
use super::make::{MakeArgs, Work};
use super::progress::Bars;
use super::{Usage, reasons};
use crate::server::stop_signal;
use tmpi_pipeline::networks::models;

/// Shortest time between two looks at the folder.
const POLL: Duration = Duration::from_secs(1);
/// Looking takes at most one part in this many of the time.
const SHARE: u32 = 20;
/// A file whose size and time stay the same for this long is complete.
const SETTLE: Duration = Duration::from_secs(2);

pub(super) fn run(args: &MakeArgs) -> anyhow::Result<()> {
    let [folder] = args.photos.as_slice() else { return Err(Usage("--watch follows one folder".into()).into()) };
    if !folder.is_dir() {
        return Err(Usage(format!("--watch follows a folder; {} is none", folder.display())).into());
    }
    check_folder(&args.output)?;
    let models = models::load(&args.models.settings())?;
    let bars = Bars::new(args.quiet);
    let stop = on_signal()?;
    let work = Work { models: &models, depth: None, args, bars: &bars, stop: &stop };
    let mut watch = Watch::default();
    if !args.quiet {
        bars.note(&format!("following {}; Ctrl+C ends", folder.display()));
    }
    while !stop.load(Ordering::Relaxed) {
        let look = Instant::now();
        let Look { items, notes } = watch.look(folder, &args.output, look);
        for line in &notes {
            bars.note(line);
        }
        if items.is_empty() {
            std::thread::park_timeout(POLL.max(look.elapsed() * SHARE));
            continue;
        }
        work.all(&items, |index, result| {
            watch.made(&items[index]);
            if let Err(error) = result {
                bars.note(&format!("tmpi: {}", reasons(&error)));
            }
            Ok(())
        })?;
    }
    Ok(())
}

/// A flag that SIGTERM and SIGINT set; they also wake this thread. A second signal ends the program at once.
fn on_signal() -> anyhow::Result<Arc<AtomicBool>> {
    let (stop, waiting) = (Arc::new(AtomicBool::new(false)), std::thread::current());
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().context("signals")?;
    let set = Arc::clone(&stop);
    std::thread::spawn(move || {
        runtime.block_on(async {
            stop_signal().await;
            set.store(true, Ordering::Relaxed);
            waiting.unpark();
            stop_signal().await;
            #[allow(clippy::disallowed_methods, reason = "the user asked for it; no container is left half written")]
            std::process::exit(1);
        });
    });
    Ok(stop)
}

/// Size and time of a photo and of its depth map.
type Stamps = [Option<(u64, SystemTime)>; 2];

/// What is known of a photo.
struct Known {
    stamps: Stamps,
    /// When it was first seen so.
    since: Instant,
    /// It was made so, or failed, or its container was there before.
    done: bool,
}

/// What a look at the folder tells.
#[derive(Debug, Default, PartialEq, Eq)]
struct Look {
    /// Photos that are complete and not made yet.
    items: Vec<Item>,
    /// What is left out, each line once.
    notes: Vec<String>,
}

/// What earlier looks told.
#[derive(Default)]
struct Watch {
    known: HashMap<PathBuf, Known>,
    told: HashSet<String>,
}

impl Watch {
    /// Looks at the folder at the time `now`.
    fn look(&mut self, folder: &Path, output: &Path, now: Instant) -> Look {
        let all = Batch::of_folder(folder, output);
        let Batch { items, left_out, .. } =
            all.unwrap_or_else(|e| Batch { left_out: vec![format!("tmpi: {}", reasons(&e))], ..Batch::default() });
        let mut look = Look { notes: left_out, ..Look::default() };
        for item in items {
            if item.depth.is_none() && is_named_as_map(&item.photo) {
                look.notes.push(format!("{}: waits for the photo whose depth map it is", item.photo.display()));
            } else if self.is_due(&item, now) {
                look.items.push(item);
            }
        }
        look.notes.retain(|line| self.told.insert(line.clone()));
        look
    }

    /// Whether a photo is complete and not made yet.
    fn is_due(&mut self, item: &Item, now: Instant) -> bool {
        let stamps = [Some(&item.photo), item.depth.as_ref()].map(|file| stamp(file?));
        let seen = |done| Known { stamps, since: now, done };
        let known = self.known.entry(item.photo.clone()).or_insert_with(|| seen(item.output.exists()));
        if known.stamps != stamps {
            *known = seen(false);
        }
        !known.done && now.duration_since(known.since) >= SETTLE
    }

    /// A photo was made, or failed.
    fn made(&mut self, item: &Item) {
        if let Some(known) = self.known.get_mut(&item.photo) {
            known.done = true;
        }
    }
}

/// Size and time of a file; `None` if it is gone.
fn stamp(file: &Path) -> Option<(u64, SystemTime)> {
    let about = std::fs::metadata(file).ok()?;
    Some((about.len(), about.modified().unwrap_or(SystemTime::UNIX_EPOCH)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder that is looked at.
    struct Place {
        root: tempfile::TempDir,
        watch: Watch,
        now: Instant,
    }

    impl Place {
        fn new() -> Self {
            let root = tempfile::tempdir().unwrap();
            std::fs::create_dir(root.path().join("in")).unwrap();
            Self { root, watch: Watch::default(), now: Instant::now() }
        }

        fn write(&self, name: &str, text: &str) {
            std::fs::write(self.root.path().join(name), text).unwrap();
        }

        fn look(&mut self, later: Duration) -> Look {
            self.now += later;
            self.watch.look(&self.root.path().join("in"), &self.root.path().join("out"), self.now)
        }

        /// Names of the photos that are due, each with its map, after `later`; they count as made.
        fn due(&mut self, later: Duration) -> Vec<String> {
            let name = |path: &Path| path.file_name().unwrap().to_string_lossy().into_owned();
            let items = self.look(later).items;
            for item in &items {
                self.watch.made(item);
            }
            items
                .iter()
                .map(|i| i.depth.as_ref().map_or_else(|| name(&i.photo), |map| format!("{} {}", name(&i.photo), name(map))))
                .collect()
        }

        /// A new file lets `due` be made, once it is complete.
        fn gets(&mut self, file: &str, due: &str) {
            self.write(&format!("in/{file}"), "1");
            assert!(self.due(SETTLE).is_empty(), "{file}");
            assert_eq!(self.due(SETTLE), [due], "{file}");
        }
    }

    #[test]
    fn a_photo_is_due_once_it_is_complete_and_again_when_it_changes() {
        let mut place = Place::new();
        place.write("in/a.jpg", "1");
        assert!(place.due(SETTLE).is_empty(), "it may still grow");
        place.write("in/a.jpg", "12");
        assert!(place.due(SETTLE).is_empty(), "it grew");
        assert!(place.due(SETTLE / 2).is_empty());
        assert_eq!(place.due(SETTLE / 2), ["a.jpg"]);
        assert!(place.due(SETTLE).is_empty());
        place.write("in/a.jpg", "123");
        assert!(place.due(POLL).is_empty());
        assert_eq!(place.due(SETTLE), ["a.jpg"]);
    }

    #[test]
    fn a_container_that_is_there_is_left() {
        let mut place = Place::new();
        std::fs::create_dir(place.root.path().join("out")).unwrap();
        place.write("in/a.jpg", "1");
        place.write("out/a.tmpi", "made before");
        assert!(place.due(SETTLE).is_empty() && place.due(SETTLE).is_empty());
        // a picture of the same name changes the name of its container, which is no reason to make it again
        place.gets("a.png", "a.png");
    }

    #[test]
    fn a_depth_map_that_comes_later_makes_its_photo_again_and_one_that_comes_first_waits() {
        let mut place = Place::new();
        place.write("in/b_depth.png", "1");
        let notes = place.look(SETTLE).notes;
        assert!(notes.len() == 1 && notes[0].contains("b_depth.png: waits"), "{notes:?}");
        assert_eq!(place.look(SETTLE), Look::default(), "told once, and never a photo of its own");
        place.gets("b.jpg", "b.jpg b_depth.png");
        place.gets("c.jpg", "c.jpg");
        place.gets("c-depth.pfm", "c.jpg c-depth.pfm");
    }

    #[test]
    fn a_folder_that_is_away_is_told_once_and_found_again() {
        let mut place = Place::new();
        place.write("in/a.jpg", "1");
        place.write("in/a.heic", "1");
        assert!(place.look(SETTLE).notes[0].contains("1 .heic left out"));
        assert_eq!(place.due(SETTLE), ["a.jpg"]);
        let (there, away) = (place.root.path().join("in"), place.root.path().join("away"));
        std::fs::rename(&there, &away).unwrap();
        assert!(place.look(POLL).notes[0].contains("reading"));
        assert_eq!(place.look(POLL), Look::default());
        std::fs::rename(&away, &there).unwrap();
        assert_eq!(place.look(SETTLE), Look::default());
        place.gets("b.jpg", "b.jpg");
    }
}
