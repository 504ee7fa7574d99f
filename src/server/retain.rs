//! Photos that go by themselves: those that are too old, and, where all take too much room, those that were looked at least recently.
//!
//! When photos were looked at is kept in `DIR/looked.json` at each sweep, so that a restart forgets little. In a store of several nodes photos go
//! by their age alone, and the index there says which: no node knows when all of them were looked at.
//!
//! No clock is believed that jumps ahead, see trusted.rs. In a store it is the store's clock that counts, also for when a photo was accepted.

use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::app::App;
use super::cluster::{Cluster, Place, side_by_side};
use super::entry::Entry;
use super::id::PhotoId;
use super::jobs::Jobs;
use super::limits::Limits;
use super::problem::Problem;
use super::time::{rfc3339, wall_ms};
use super::trusted::TrustedClock;

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

/// Among the times at which photos were looked at, that of the sweep.
const SWEPT: &str = "swept";

/// Sweeps now and then, where photos are to go.
pub async fn sweep(app: App) {
    if app.limits.retain.is_none() && app.limits.retain_bytes.is_none() {
        return;
    }
    let mut swept = None;
    if app.jobs.cluster.is_none() {
        swept = remember(&app).await;
    } else if app.limits.retain_bytes.is_some() {
        tracing::warn!("--retain-mib is for one node alone; photos of a store go by their age");
    }
    let (mut pause, mut clock) = (FIRST.min(app.limits.retain_sweep), None);
    loop {
        tokio::time::sleep(pause).await;
        pause = app.limits.retain_sweep;
        let done = match app.jobs.cluster.clone() {
            Some(cluster) => once_there(&app, &cluster, &mut clock).await,
            None => once(&app, swept, &mut clock).await,
        };
        if let Err(problem) = done {
            tracing::warn!(detail = %problem.detail, "photos that are to go stay until the next sweep");
        }
    }
}

/// One sweep of a node alone; the one before its start was at `swept`, in milliseconds since 1970.
async fn once(app: &App, swept: Option<u64>, clock: &mut Option<TrustedClock>) -> Result<(), Problem> {
    let shared = Arc::clone(app);
    let all = app.change(move || shared.jobs.all().iter().map(|entry| Candidate::of(entry)).collect::<Vec<_>>()).await?;
    let (told, at) = (wall_ms(), Instant::now());
    // photos have the time of a clock that nothing was held against
    let latest = swept.or_else(|| all.iter().map(|photo| photo.at_ms).max());
    let now_ms = clock.get_or_insert_with(|| TrustedClock::start(told, latest, at)).time(told, at);
    // after them: a disk that is full takes nothing before
    go(app, &all, overdue(all.clone(), &app.limits, now_ms)).await?;
    keep(app, &all, now_ms).await
}

/// The same in a store of several nodes: what is behind the place of the youngest that is too old.
async fn once_there(app: &App, cluster: &Arc<Cluster>, clock: &mut Option<TrustedClock>) -> Result<(), Problem> {
    let Some(time) = app.limits.retain else { return Ok(()) };
    let (of, before) = (Arc::clone(cluster), *clock);
    let asked = tokio::task::spawn_blocking(move || store_time(&of, before));
    let (now_ms, after) = asked.await.map_err(|e| Problem::internal("asking for the time", &e))?.map_err(|e| Problem::store(&e))?;
    *clock = Some(after);
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

/// The time by the store's clock as far as that is believed, and what is known of it from now on.
fn store_time(cluster: &Cluster, clock: Option<TrustedClock>) -> io::Result<(u64, TrustedClock)> {
    let latest = match &clock {
        Some(clock) => Some(clock.last()),
        None => cluster.latest_ms()?,
    };
    let (told, at) = (cluster.now_ms(latest)?, Instant::now());
    let mut clock = clock.unwrap_or_else(|| TrustedClock::start(told, latest, at));
    Ok((clock.time(told, at), clock))
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
    // the clock of the node that took it may have been behind
    let is_old = |(id, _): &(PhotoId, Reason)| -> io::Result<bool> {
        let accepted = cluster.accepted_ms(*id)?;
        Ok(accepted.and_then(|at_ms| ends_ms(&limits, at_ms)).is_none_or(|end| end <= now_ms))
    };
    let are_old = side_by_side(&going, is_old).into_iter().collect::<io::Result<Vec<bool>>>()?;
    let going = going.into_iter().zip(are_old).filter(|(_, is_old)| *is_old).map(|(photo, _)| photo).collect();
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

/// Keeps when photos were looked at, where that counts, and the time of the sweep.
async fn keep(app: &App, all: &[Candidate], now_ms: u64) -> Result<(), Problem> {
    let counted = if app.limits.retain_bytes.is_some() { all } else { &[] };
    let mut seen: BTreeMap<String, u64> = counted.iter().map(|photo| (photo.id.to_string(), photo.seen_ms)).collect();
    seen.insert(SWEPT.into(), now_ms);
    let text = serde_json::to_vec(&seen).map_err(|e| Problem::internal("when photos were looked at", &e))?;
    let shared = Arc::clone(app);
    app.change(move || shared.jobs.store.write_looked(&text)).await?.map_err(|e| Problem::store(&e))
}

/// Takes up when photos were looked at before the start; gives the time of the last sweep.
async fn remember(app: &App) -> Option<u64> {
    let shared = Arc::clone(app);
    let read = tokio::task::spawn_blocking(move || {
        let bytes = shared.jobs.store.read_looked()?;
        let mut seen: BTreeMap<String, u64> = serde_json::from_slice(&bytes)?;
        let swept = seen.remove(SWEPT);
        for (id, ms) in seen {
            if let Some(entry) = id.parse().ok().and_then(|id| shared.jobs.get(id)) {
                entry.look(ms);
            }
        }
        Ok::<_, io::Error>(swept)
    });
    match read.await {
        Ok(Ok(swept)) => swept,
        Ok(Err(error)) if error.kind() != io::ErrorKind::NotFound => {
            tracing::warn!(%error, "when photos were looked at is not known; it counts when they were made");
            None
        }
        _ => None,
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
    use crate::server::cluster::memory::{self, Memory, put, settings};
    use crate::server::jobs::among_tests::node;
    use crate::server::part::Part;

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
    fn no_photo_of_a_store_goes_too_early_whichever_clock_is_wrong() {
        let (store, limits) = (Memory::default(), Limits { retain: Some(Duration::from_hours(48)), ..Limits::default() });
        store.built();
        let node = node(&store, &limits);
        // the node's clock is right, or three days behind that of the store
        let (wall, now) = (wall_ms(), wall_ms() + 3 * DAY_MS);
        store.tells(now);
        let old = put(&store, 1, wall, None, true).1;
        put(&store, 2, now - DAY_MS, None, true);
        let (behind, accepted) = memory::accepted(3, wall, None);
        assert!(node.cluster.accept(behind, &accepted, &settings(3), vec![(Part::Upload, b"photo".to_vec())]).unwrap());
        memory::finish(&node.cluster, behind);
        let going = |now_ms: u64| {
            let Old { going, is_end, .. } =
                old_there(&node.jobs, &node.cluster, &limits, now_ms, Some(youngest(Duration::from_hours(48), now_ms))).unwrap();
            assert!(is_end);
            going.into_iter().map(|(id, _)| id).collect::<Vec<_>>()
        };
        assert_eq!(going(now), [old], "not what came just now");
        assert_eq!(going(now + 3 * DAY_MS).len(), 3);
    }

    #[test]
    fn a_store_whose_clock_jumps_ahead_is_not_believed_nor_after_a_restart() {
        let store = Memory::default();
        store.built();
        let node = node(&store, &Limits::default());
        let (now, years) = (20_000 * DAY_MS, 4_000 * DAY_MS);
        store.tells(now);
        put(&store, 1, now - DAY_MS, None, true);
        let near = |ms: u64| (now..now + 60_000).contains(&ms);
        let (first, clock) = store_time(&node.cluster, None).unwrap();
        assert_eq!(first, now);
        let (second, clock) = store_time(&node.cluster, Some(clock)).unwrap();
        assert!(near(second));
        store.tells(now + years);
        assert!(near(store_time(&node.cluster, Some(clock)).unwrap().0));
        // and a photo that is taken meanwhile
        put(&store, 2, now + years, None, true);
        assert!(near(store_time(&node.cluster, None).unwrap().0), "a node that starts");
        store.tells(now + 7);
        assert_eq!(store_time(&node.cluster, None).unwrap().0, now + 7);
        store.is_away(true);
        assert!(store_time(&node.cluster, None).is_err());
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
