//! Photos that go by themselves: those that are too old, and, where all take too much room, those that were looked at least recently.
//!
//! When photos were looked at is kept in `DIR/looked.json` at each sweep, so that a restart forgets little. In a store of several nodes photos go
//! by their age alone, and the index there says which: no node knows when all of them were looked at.
//!
//! The age of a photo goes by the clock of the machine that sweeps.

use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use super::app::App;
use super::cluster::{Cluster, Place};
use super::entry::Entry;
use super::id::PhotoId;
use super::jobs::Jobs;
use super::limits::Limits;
use super::problem::Problem;
use super::time::{rfc3339, wall_ms};

/// The first sweep after a start.
const FIRST: Duration = Duration::from_mins(1);

/// Why a photo goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    /// It is as old as photos may become.
    Age,
    /// All take more room than they may, and it was not looked at for longest.
    Room,
}

impl Reason {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::Age, Self::Room];

    /// As it is counted.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Age => "age",
            Self::Room => "room",
        }
    }
}

/// When a photo goes that was accepted at `at_ms`, milliseconds since 1970; none where none goes by its age.
#[must_use]
pub fn ends_ms(limits: &Limits, at_ms: u64) -> Option<u64> {
    limits.retain.map(|time| at_ms.saturating_add(time.as_millis() as u64))
}

/// A photo as a sweep sees it.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    id: PhotoId,
    at_ms: u64,
    seen_ms: u64,
    bytes: u64,
    /// Nothing is being made of it.
    rests: bool,
}

impl Candidate {
    fn of(entry: &Entry) -> Self {
        let rests = entry.status().is_final();
        Self { id: entry.id, at_ms: entry.accepted.at_ms, seen_ms: entry.seen_ms(), bytes: entry.bytes(), rests }
    }
}

/// Which photos are to go, and why.
fn overdue(mut all: Vec<Candidate>, limits: &Limits, now_ms: u64) -> Vec<(PhotoId, Reason)> {
    let mut going = Vec::new();
    all.retain(|photo| {
        let over = photo.rests && ends_ms(limits, photo.at_ms).is_some_and(|end| end <= now_ms);
        if over {
            going.push((photo.id, Reason::Age));
        }
        !over
    });
    let Some(room) = limits.retain_bytes else { return going };
    let mut taken: u64 = all.iter().map(|photo| photo.bytes).sum();
    all.sort_by_key(|photo| (photo.seen_ms, photo.id));
    for photo in all.iter().filter(|photo| photo.rests) {
        if taken <= room {
            break;
        }
        taken -= photo.bytes;
        going.push((photo.id, Reason::Room));
    }
    going
}

/// Sweeps now and then, where photos are to go.
pub async fn sweep(app: App) {
    if app.limits.retain.is_none() && app.limits.retain_bytes.is_none() {
        return;
    }
    if app.jobs.cluster.is_none() {
        remember(&app).await;
    } else if app.limits.retain_bytes.is_some() {
        tracing::warn!("--retain-mib is for one node alone; photos of a store go by their age");
    }
    let mut pause = FIRST.min(app.limits.retain_sweep);
    loop {
        tokio::time::sleep(pause).await;
        pause = app.limits.retain_sweep;
        let done = match app.jobs.cluster.clone() {
            Some(cluster) => once_there(&app, &cluster).await,
            None => once(&app).await,
        };
        if let Err(problem) = done {
            tracing::warn!(detail = %problem.detail, "photos that are to go stay until the next sweep");
        }
    }
}

/// One sweep of a node alone.
async fn once(app: &App) -> Result<(), Problem> {
    let shared = Arc::clone(app);
    let all = app.change(move || shared.jobs.all().iter().map(|entry| Candidate::of(entry)).collect::<Vec<_>>()).await?;
    // after them: a disk that is full takes nothing before
    go(app, &all, overdue(all.clone(), &app.limits, wall_ms())).await?;
    keep(app, &all).await
}

/// The same in a store of several nodes: what is behind the place of the youngest that is too old.
async fn once_there(app: &App, cluster: &Arc<Cluster>) -> Result<(), Problem> {
    let Some(time) = app.limits.retain else { return Ok(()) };
    let now_ms = wall_ms();
    let mut after = Some(youngest(time, now_ms));
    loop {
        let (shared, cluster, limits) = (Arc::clone(app), Arc::clone(cluster), Arc::clone(&app.limits));
        let part = tokio::task::spawn_blocking(move || old_there(&shared.jobs, &cluster, &limits, now_ms, after));
        // held until they are gone: so long they are found by their ids
        let Old { held, all, going, is_end } =
            part.await.map_err(|e| Problem::internal("looking for old photos", &e))?.map_err(|e| Problem::store(&e))?;
        after = held.last().map(|(place, _)| *place).or(after);
        go(app, &all, going).await?;
        if is_end {
            return Ok(());
        }
    }
}

/// The place before that of the youngest photo that is too old.
fn youngest(time: Duration, now_ms: u64) -> Place {
    // behind all of one millisecond
    (now_ms.saturating_sub(time.as_millis() as u64).saturating_add(1), PhotoId::from_bytes([u8::MAX; 16]))
}

/// Photos of a store that are old by their records.
struct Old {
    held: Vec<(Place, Option<Arc<Entry>>)>,
    all: Vec<Candidate>,
    /// Those of them that are to go.
    going: Vec<(PhotoId, Reason)>,
    /// No others follow.
    is_end: bool,
}

/// Looks at some photos behind `after`.
fn old_there(jobs: &Jobs, cluster: &Cluster, limits: &Limits, now_ms: u64, after: Option<Place>) -> io::Result<Old> {
    /// Photos that are looked at at a time.
    const PART: usize = 256;
    let (held, is_end) = jobs.part(cluster, None, after, PART)?;
    let all: Vec<Candidate> = held.iter().filter_map(|(_, entry)| Some(Candidate::of(entry.as_ref()?))).collect();
    // in a store those that are given here are not all that take room
    let limits = Limits { retain_bytes: None, ..limits.clone() };
    let going = overdue(all.clone(), &limits, now_ms);
    Ok(Old { held, all, going, is_end })
}

/// Has those of some photos go that are to.
async fn go(app: &App, all: &[Candidate], going: Vec<(PhotoId, Reason)>) -> Result<(), Problem> {
    let of: BTreeMap<PhotoId, (u64, u64)> = all.iter().map(|photo| (photo.id, (photo.at_ms, photo.bytes))).collect();
    let (mut count, mut freed) = (0_usize, 0);
    for (id, reason) in going {
        let Some((at_ms, bytes)) = of.get(&id).copied() else { continue };
        let shared = Arc::clone(app);
        // what was deleted since and uploaded again is new
        if app.change(move || shared.jobs.delete_of(id, Some(at_ms))).await?? {
            app.forget(id).await;
            tracing::info!(%id, reason = reason.name(), bytes, "a photo has gone by itself");
            app.telemetry.retired(reason.name(), bytes);
            (count, freed) = (count + 1, freed + bytes);
        }
    }
    if count > 0 {
        tracing::info!(count, freed, "sweep of photos");
    }
    Ok(())
}

/// Keeps when photos were looked at, where that counts.
async fn keep(app: &App, all: &[Candidate]) -> Result<(), Problem> {
    if app.limits.retain_bytes.is_none() {
        return Ok(());
    }
    let seen: BTreeMap<String, u64> = all.iter().map(|photo| (photo.id.to_string(), photo.seen_ms)).collect();
    let text = serde_json::to_vec(&seen).map_err(|e| Problem::internal("when photos were looked at", &e))?;
    let shared = Arc::clone(app);
    app.change(move || shared.jobs.store.write_looked(&text)).await?.map_err(|e| Problem::store(&e))
}

/// Takes up when photos were looked at before the start.
async fn remember(app: &App) {
    let shared = Arc::clone(app);
    let read = tokio::task::spawn_blocking(move || {
        let bytes = shared.jobs.store.read_looked()?;
        let seen: BTreeMap<String, u64> = serde_json::from_slice(&bytes)?;
        for (id, ms) in seen {
            if let Some(entry) = id.parse().ok().and_then(|id| shared.jobs.get(id)) {
                entry.look(ms);
            }
        }
        Ok::<_, io::Error>(())
    });
    if let Ok(Err(error)) = read.await
        && error.kind() != io::ErrorKind::NotFound
    {
        tracing::warn!(%error, "when photos were looked at is not known; it counts when they were made");
    }
}

/// The date on which a photo goes, where photos go by their age.
#[must_use]
pub fn expires(limits: &Limits, at_ms: u64) -> Option<String> {
    ends_ms(limits, at_ms).map(rfc3339)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::server::cluster::memory::{Memory, put};
    use crate::server::jobs::among_tests::node;

    const DAY_MS: u64 = 86_400_000;

    fn photo(n: u8, at_ms: u64, seen_ms: u64, bytes: u64) -> Candidate {
        Candidate { id: PhotoId::from_bytes([n; 16]), at_ms, seen_ms, bytes, rests: true }
    }

    fn names(going: &[(PhotoId, Reason)]) -> Vec<(String, Reason)> {
        going.iter().map(|(id, reason)| (id.to_string()[..2].to_owned(), *reason)).collect()
    }

    #[test]
    fn the_old_go_and_then_those_that_nobody_looks_at() {
        let limits = Limits { retain: Some(Duration::from_hours(48)), retain_bytes: Some(100), ..Limits::default() };
        let now = 10 * DAY_MS;
        let working = Candidate { rests: false, ..photo(5, 0, 0, 10) };
        let all = vec![
            photo(1, 7 * DAY_MS, now, 500),
            photo(2, 9 * DAY_MS, 5, 60),
            photo(3, 9 * DAY_MS, 3, 50),
            photo(4, 8 * DAY_MS + 1, 9, 40),
            working,
        ];
        let going = overdue(all.clone(), &limits, now);
        assert_eq!(names(&going), [("01".into(), Reason::Age), ("03".into(), Reason::Room), ("02".into(), Reason::Room)]);
        assert!(overdue(all, &Limits::default(), now).is_empty(), "off where nobody asked for it");
        assert_eq!(ends_ms(&limits, 7), Some(2 * DAY_MS + 7));
    }

    #[test]
    fn the_old_photos_of_a_store_go() {
        let (store, limits) = (Memory::default(), Limits { retain: Some(Duration::from_hours(48)), ..Limits::default() });
        store.built();
        let node = node(&store, &limits);
        let now = 20_000 * DAY_MS;
        let old = put(&store, 1, now - 2 * DAY_MS, None, true).1;
        put(&store, 2, now - 2 * DAY_MS + 1, None, true);
        let part = old_there(&node.jobs, &node.cluster, &limits, now, Some(youngest(Duration::from_hours(48), now))).unwrap();
        assert!(part.is_end);
        assert_eq!(part.going, [(old, Reason::Age)]);
    }

    proptest! {
        #[test]
        fn no_more_goes_than_has_to(
            photos in prop::collection::vec((0..9_u64, 0..50_u64, any::<bool>()), 0..20),
            room in 0..300_u64,
        ) {
            let all: Vec<_> = (0_u8..).zip(&photos).map(|(n, (seen, bytes, rests))| Candidate { rests: *rests, ..photo(n, 0, *seen, *bytes) }).collect();
            let limits = Limits { retain_bytes: Some(room), ..Limits::default() };
            let going: Vec<PhotoId> = overdue(all.clone(), &limits, DAY_MS).into_iter().map(|(id, _)| id).collect();
            let taken = |without: &[PhotoId]| all.iter().filter(|p| !without.contains(&p.id)).map(|p| p.bytes).sum::<u64>();
            let of = |id: &PhotoId| all.iter().find(|p| p.id == *id).unwrap();
            prop_assert!(going.iter().all(|id| of(id).rests));
            // it is enough, or all that may go
            prop_assert!(taken(&going) <= room || going.len() == all.iter().filter(|p| p.rests).count());
            if let Some((last, before)) = going.split_last() {
                prop_assert!(taken(before) > room);
                let latest = of(last).seen_ms;
                prop_assert!(all.iter().filter(|p| p.rests && !going.contains(&p.id)).all(|p| p.seen_ms >= latest));
            }
        }
    }
}
