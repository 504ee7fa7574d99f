use std::collections::HashSet;
use std::time::{Duration, Instant};

use super::*;
use crate::server::access::Owner;
use crate::server::cluster::Place;
use crate::server::cluster::memory::{self, ATLAS, MADE, Memory, accepted, done, put, settings};
use crate::server::part::Part;
use crate::server::store::Origin;

/// A node of a store that makes nothing.
pub(in crate::server) struct Node {
    pub jobs: Arc<Jobs>,
    pub cluster: Arc<Cluster>,
    _dir: tempfile::TempDir,
}

pub(in crate::server) fn node(store: &Memory, limits: &Limits) -> Node {
    let dir = tempfile::tempdir().unwrap();
    let cluster = Arc::new(memory::cluster(store, dir.path()));
    let (copies, _) = Store::open(&dir.path().join("copies"), "").unwrap();
    let copies = copies.of_origin(Arc::clone(&cluster) as Arc<dyn Origin>, 1 << 20);
    let limits = Arc::new(Limits { workers: 0, ..limits.clone() });
    let never = Arc::new(crate::server::maker::Never);
    let jobs = Jobs::start_among(Some(Arc::clone(&cluster)), copies, Vec::new(), never, limits, Arc::default()).unwrap();
    Node { jobs, cluster, _dir: dir }
}

fn until(what: &str, mut is_so: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_secs(20);
    while !is_so() {
        assert!(Instant::now() < end, "{what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

impl Node {
    /// Photos that are known here, once those went that nobody needs.
    fn known(&self) -> usize {
        self.jobs.let_go(&self.cluster);
        self.jobs.counts().known
    }

    fn refresh(&self, id: PhotoId) -> Option<Arc<Entry>> {
        self.jobs.refresh(&self.cluster, id).unwrap()
    }

    /// All pages of a list.
    fn pages(&self, whose: &Whose, limit: usize) -> Vec<Place> {
        let (mut all, mut after) = (Vec::new(), None);
        loop {
            let page = self.jobs.listed(whose, after, limit);
            assert!(page.photos.len() == limit || page.photos.len() < limit && !page.more);
            after = page.photos.last().map(|entry| entry.key());
            all.extend(page.photos.iter().map(|entry| entry.key()));
            if !page.more {
                return all;
            }
        }
    }
}

/// Newest first, and of one millisecond by their ids.
fn sorted(mut places: Vec<Place>) -> Vec<Place> {
    places.sort_unstable_by_key(|(at_ms, id)| (std::cmp::Reverse(*at_ms), *id));
    places
}

#[test]
fn pages_are_what_the_store_has_and_a_node_knows_no_more_than_it_may() {
    const MOST: usize = 50;
    let store = Memory::default();
    store.built();
    let owners = ["a", "b"].map(Owner::of_secret);
    let mut all = Vec::new();
    for n in 0..3000_u32 {
        let owner = owners.get(n as usize % 3);
        all.push((put(&store, n, u64::from(n * 7 % 1900), owner, true), owner));
    }
    let of =
        |owner: Option<&Owner>| sorted(all.iter().filter(|(_, of)| owner.is_none() || *of == owner).map(|(place, _)| *place).collect());
    let node = node(&store, &Limits { known_photos: MOST, ..Limits::default() });
    for limit in [7, 64, 200] {
        assert!(node.pages(&Whose::All, limit) == of(None), "{limit}");
        until("those that nobody needs go", || node.known() <= MOST);
    }
    for owner in &owners {
        assert!(node.pages(&Whose::Of(Some(owner.clone())), 100) == of(Some(owner)));
    }
    assert!(node.pages(&Whose::Of(None), 9).is_empty() && node.pages(&Whose::Of(Some(Owner::of_secret("c"))), 9).is_empty());
    // one after the other: as nobody holds any, there are never more
    for (n, ((at_ms, id), owner)) in (0..).zip(&all) {
        let entry = node.refresh(*id).unwrap();
        let (_, accepted) = accepted(n, *at_ms, *owner);
        assert_eq!((&entry.accepted, entry.settings(), entry.status()), (&accepted, settings(n), Status::Done(done(*at_ms))));
        drop(entry);
        assert!(node.jobs.counts().known <= MOST + 1);
    }
    until("those that nobody needs go", || node.known() <= MOST);
    let counts = node.jobs.counts();
    assert_eq!(counts.done, counts.known);
    for n in 0..200 {
        assert!(node.refresh(PhotoId::from_bytes([n; 16])).is_none() || n == 0, "there is none");
    }
    assert!(node.jobs.counts().known <= MOST + 1);
}

#[test]
fn what_waits_or_is_followed_or_in_use_stays() {
    let store = Memory::default();
    store.built();
    let node = node(&store, &Limits { known_photos: 8, ..Limits::default() });
    let places: Vec<Place> = (0..100).map(|n| put(&store, n, u64::from(n), None, true)).collect();
    let watch = node.refresh(places[0].1).unwrap().watch();
    let held = node.refresh(places[1].1).unwrap();
    let (waits, upload) = accepted(200, 200, None);
    assert!(node.cluster.accept(waits, &upload, &settings(200), vec![(Part::Upload, b"photo".to_vec())]).unwrap());
    until("what waits is found by looking", || node.jobs.has(waits));
    let read = || {
        for (_, id) in &places[2..] {
            assert!(node.refresh(*id).is_some());
        }
        until("the others go", || node.known() <= 8 + 3);
    };
    read();
    assert!(node.jobs.get(places[0].1).is_some_and(|entry| entry.is_followed()));
    assert!(node.jobs.get(places[1].1).is_some_and(|entry| Arc::ptr_eq(&entry, &held)));
    assert_eq!((node.jobs.position(waits), node.jobs.counts().queued), (Some(0), 1));
    drop((watch, held));
    read();
    until("they go as well", || {
        read();
        !node.jobs.has(places[0].1) && !node.jobs.has(places[1].1)
    });
    assert!(node.jobs.has(waits));
}

#[test]
fn a_photo_stays_until_a_file_of_it_that_was_ordered_has_ended() {
    let store = Memory::default();
    store.built();
    let node = node(&store, &Limits { known_photos: 8, ..Limits::default() });
    let places: Vec<Place> = (0..40).map(|n| put(&store, n, u64::from(n), None, true)).collect();
    let id = places[0].1;
    let recipe = crate::server::exports::Recipe::parse("format=zip", &node.jobs.limits).unwrap();
    let (file, new) = node.jobs.order(&node.refresh(id).unwrap(), &done(places[0].0), "results", &recipe).unwrap();
    assert!(new);
    let read = || {
        for (_, id) in &places[1..] {
            assert!(node.refresh(*id).is_some());
        }
        until("the others go", || node.known() <= 8 + 1);
    };
    read();
    assert!(node.jobs.has(id));
    node.jobs.forget_file(&file);
    drop(file);
    until("it goes as well", || {
        read();
        !node.jobs.has(id)
    });
}

#[test]
fn no_more_photos_that_wait_are_known_than_may_wait_and_the_rest_is_counted() {
    let store = Memory::default();
    store.built();
    let dir = tempfile::tempdir().unwrap();
    let other = memory::cluster(&store, dir.path());
    for n in 0..30 {
        let (id, upload) = accepted(n, u64::from(n), None);
        assert!(other.accept(id, &upload, &settings(n), vec![(Part::Upload, b"photo".to_vec())]).unwrap());
    }
    let node = node(&store, &Limits { queue: 10, ..Limits::default() });
    until("all that wait are counted", || node.jobs.counts().queued == 30);
    assert!(node.jobs.counts().known == 10 && node.jobs.free_places() == 0);
}

#[test]
fn markers_without_a_photo_that_can_be_read_keep_no_place_from_others() {
    let (store, dir) = (Memory::default(), tempfile::tempdir().unwrap());
    store.built();
    let other = memory::cluster(&store, dir.path());
    let accept = |n| {
        let (id, upload) = accepted(n, u64::from(n), None);
        assert!(other.accept(id, &upload, &settings(n), vec![(Part::Upload, b"photo".to_vec())]).unwrap());
        id
    };
    for n in 0..8 {
        store.spoil(accept(n), (n % 2 == 0).then_some(b"{"));
    }
    let waiting: Vec<PhotoId> = (10..12).map(accept).collect();
    let node = node(&store, &Limits { queue: 3, ..Limits::default() });
    until("those are found that can be read", || waiting.iter().all(|id| node.jobs.has(*id)));
    until("nothing else counts", || node.jobs.counts().queued == 2);
    assert_eq!(node.jobs.counts().known, 2);
}

#[test]
fn photos_that_are_asked_for_take_no_more_places_than_there_are_and_go_again() {
    let store = Memory::default();
    store.built();
    let dir = tempfile::tempdir().unwrap();
    let other = memory::cluster(&store, dir.path());
    let ids: Vec<PhotoId> = (0..30)
        .map(|n| {
            let (id, upload) = accepted(n, u64::from(n), None);
            assert!(other.accept(id, &upload, &settings(n), vec![(Part::Upload, b"photo".to_vec())]).unwrap());
            id
        })
        .collect();
    let node = node(&store, &Limits { queue: 2, known_photos: 4, ..Limits::default() });
    let mut places = HashSet::new();
    for id in &ids {
        let entry = node.refresh(*id).unwrap();
        assert_eq!(entry.status(), Status::Queued);
        assert!(node.jobs.waiting()[0].1 <= 2);
        places.insert(node.jobs.position(*id));
    }
    // who has no place waits behind those that have one
    assert!(places.contains(&Some(2)) && !places.contains(&None), "{places:?}");
    until("those go that have no place", || node.known() <= 4);
    until("all that wait are counted", || node.jobs.counts().queued == 30);
    assert_eq!(node.jobs.waiting()[0].1, 2);
}

/// Whether the lists are as the records say, and all entries that are left are of photos that are there.
fn are_right(store: &Memory, owner: &Owner, photos: &[Place], context: &str) {
    let node = node(store, &Limits::default());
    let there = sorted(photos.iter().filter(|(_, id)| store.has(*id)).copied().collect());
    for whose in [Whose::All, Whose::Of(Some(owner.clone()))] {
        assert_eq!(node.pages(&whose, 2), there, "{context}: {whose:?}");
    }
    let left: HashSet<Place> = store.entries().into_iter().map(|(_, place)| place).collect();
    assert_eq!(left, there.into_iter().collect(), "{context}");
}

#[test]
fn a_crash_while_a_photo_is_accepted_or_deleted_leaves_the_lists_right() {
    let owner = Owner::of_secret("a");
    for deletes in [false, true] {
        for steps in 0.. {
            let (store, dir) = (Memory::default(), tempfile::tempdir().unwrap());
            store.built();
            let one = memory::cluster(&store, dir.path());
            let mut photos: Vec<Place> = (0..3).map(|n| put(&store, n, u64::from(n), Some(&owner), true)).collect();
            let (id, upload) = accepted(9, 2, Some(&owner));
            photos.push((2, id));
            let accept = || one.accept(id, &upload, &settings(9), vec![(Part::Upload, b"photo".to_vec())]);
            if deletes {
                assert!(accept().unwrap());
            }
            store.end_after(steps);
            let done = if deletes { one.remove(id, None).is_ok() } else { accept().is_ok_and(|new| new) };
            let whole = store.has_left();
            store.end_after(usize::MAX);
            assert!(!done || store.has(id) != deletes, "what was answered holds, after {steps} steps");
            are_right(&store, &owner, &photos, &format!("after {steps} steps, deletes: {deletes}"));
            if whole {
                assert!(steps > 4, "{steps}");
                break;
            }
        }
    }
}

#[test]
fn until_the_index_has_all_what_is_known_is_listed_besides() {
    let store = Memory::default();
    let places: Vec<Place> = (0..5).map(|n| put(&store, n, u64::from(n), None, n < 3)).collect();
    // nothing can be entered
    store.end_after(0);
    let node = node(&store, &Limits::default());
    assert_eq!(node.pages(&Whose::All, 2), sorted(places[..3].to_vec()));
    let held = node.refresh(places[4].1).unwrap();
    let expected = sorted([&places[..3], &places[4..]].concat());
    for limit in [1, 2, 9] {
        assert_eq!(node.pages(&Whose::All, limit), expected, "{limit}");
    }
    drop(held);
    store.end_after(usize::MAX);
    until("the index has all", || node.cluster.is_built());
    assert_eq!(node.pages(&Whose::All, 2), sorted(places));
}

#[test]
fn while_the_store_is_away_what_is_known_is_listed() {
    let store = Memory::default();
    store.built();
    let places: Vec<Place> = (0..20).map(|n| put(&store, n, u64::from(n / 3), None, true)).collect();
    let node = node(&store, &Limits::default());
    let known: Vec<Place> = places[4..9].to_vec();
    for (_, id) in &known {
        node.refresh(*id).unwrap();
    }
    store.is_away(true);
    assert_eq!(node.pages(&Whose::All, 2), sorted(known));
    store.is_away(false);
    until("the store is back", || !node.cluster.is_away());
    assert_eq!(node.pages(&Whose::All, 7), sorted(places));
}

#[test]
fn a_quota_counts_all_of_an_owners_photos_however_few_are_known() {
    let (store, owner) = (Memory::default(), Owner::of_secret("a"));
    store.built();
    for n in 0..60 {
        put(&store, n, u64::from(n), Some(&owner), true);
    }
    let of = |limits: Limits| node(&store, &Limits { known_photos: 8, ..limits });
    let refused = |node: &Node, bytes| node.jobs.quota(Some(&owner), bytes).err().map(|e| (e.status, e.detail.contains("60 photos")));
    let many = of(Limits { quota_photos: Some(60), ..Limits::default() });
    assert_eq!(refused(&many, 1), Some((403, true)));
    assert_eq!(refused(&of(Limits { quota_photos: Some(61), ..Limits::default() }), 1), None);
    let taken = 60 * (5 + MADE);
    let large = of(Limits { quota_bytes: Some(taken + 9), ..Limits::default() });
    assert_eq!((refused(&large, 9), refused(&large, 10).map(|(status, _)| status)), (None, Some(403)));
    // what is known to be too much is not counted to its end
    let few = of(Limits { quota_photos: Some(3), ..Limits::default() });
    assert!(few.jobs.quota(Some(&owner), 1).unwrap_err().detail.contains("at least 4 photos"));
    // the photo itself does not stand in its own way
    let (third, upload) = accepted(3, 3, Some(&owner));
    assert!(many.jobs.reserve(&many.cluster, third, &upload).is_ok());
    assert!(many.jobs.quota(Some(&Owner::of_secret("b")), 1).is_ok());
    store.is_away(true);
    assert_eq!(many.jobs.quota(Some(&owner), 1).unwrap_err().status, 503);
}

#[test]
fn copies_go_of_photos_that_others_deleted_though_nobody_asks_for_them() {
    let (store, dir) = (Memory::default(), tempfile::tempdir().unwrap());
    store.built();
    let node = node(&store, &Limits { known_photos: 1, ..Limits::default() });
    let places: Vec<Place> = (0..3).map(|n| put(&store, n, u64::from(n), None, true)).collect();
    for (n, place) in (0..).zip(&places) {
        store.make(n, *place);
        let _held = node.refresh(place.1).unwrap();
        assert_eq!(node.jobs.store.read(place.1, Part::Atlas).unwrap(), ATLAS);
    }
    let copied = || [0, 1, 2].map(|n: usize| node.jobs.store.is_copied(places[n].1));
    memory::cluster(&store, dir.path()).remove(places[1].1, None).unwrap();
    assert_eq!(copied(), [true; 3]);
    node.cluster.drop_copies(&node.jobs).unwrap();
    assert_eq!(copied(), [true, false, true]);
    store.is_away(true);
    assert!(node.cluster.drop_copies(&node.jobs).is_err());
    assert_eq!(copied(), [true, false, true], "a store that is away says nothing");
}

#[test]
fn an_entry_in_a_wrong_place_shows_nothing_and_takes_nothing_away() {
    let (store, [a, b]) = (Memory::default(), ["a", "b"].map(Owner::of_secret));
    store.built();
    let place = put(&store, 1, 7, Some(&a), true);
    // of another owner, and of another time
    memory::enter(&store, 1, 7, Some(&b));
    memory::enter(&store, 1, 9, Some(&a));
    let node = node(&store, &Limits::default());
    for _ in 0..2 {
        let of = |owner: &Owner| node.pages(&Whose::Of(Some(owner.clone())), 5);
        assert_eq!((node.pages(&Whose::All, 5), of(&a), of(&b)), (vec![place], vec![place], vec![]));
    }
    let left: Vec<Place> = store.entries().into_iter().map(|(_, place)| place).collect();
    assert_eq!(left, [place; 3], "what never was there is removed");
}

#[test]
fn who_deletes_one_upload_leaves_a_later_one_of_the_same_photo() {
    let (store, dir) = (Memory::default(), tempfile::tempdir().unwrap());
    store.built();
    let node = node(&store, &Limits::default());
    let (_, id) = put(&store, 1, 5, None, true);
    let _held = node.refresh(id).unwrap();
    let other = memory::cluster(&store, dir.path());
    other.remove(id, None).unwrap();
    assert!(!node.cluster.remove(id, Some(5)).unwrap(), "it is gone");
    put(&store, 1, 6, None, true);
    assert!(!node.jobs.delete_of(id, Some(5)).unwrap() && store.has(id));
    let _held = node.refresh(id).unwrap();
    assert!(node.jobs.delete_of(id, Some(6)).unwrap() && !store.has(id));
}

#[test]
fn an_upload_again_heals_what_the_store_has_lost_whoever_knows_of_it() {
    let store = Memory::default();
    store.built();
    let place = put(&store, 1, 5, None, true);
    store.make(1, place);
    let node = node(&store, &Limits::default());
    let (id, upload) = accepted(1, 5, None);
    let again = || {
        let incoming = node.jobs.store.begin().unwrap();
        std::fs::write(incoming.path(Part::Upload), b"photo").unwrap();
        let submitted = node.jobs.submit(incoming, id, upload.clone(), settings(1)).unwrap();
        assert!(!submitted.new);
        (submitted.healed, submitted.entry.status())
    };
    assert_eq!(again(), (false, Status::Done(done(5))));
    std::fs::write(node.jobs.store.path(id, Part::Atlas), b"half").unwrap();
    assert_eq!(again(), (false, Status::Done(done(5))), "a copy that is damaged is fetched again");
    store.lose(1, place);
    node.jobs.store.forget(id);
    assert_eq!(again(), (true, Status::Queued));
    assert_eq!(node.cluster.pending().unwrap().len(), 1);
}
