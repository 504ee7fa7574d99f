use std::ops::ControlFlow;

use super::memory::{MADE, Memory, accepted, cluster, done, put};
use super::*;
use crate::server::access::Owner;
use crate::server::records::{Done, End as Outcome};

/// Bytes that count for an owner, photo by photo.
fn sizes(cluster: &Cluster, owner: &Owner) -> Vec<u64> {
    let mut sizes = Vec::new();
    let each = |_, bytes| {
        sizes.push(bytes);
        ControlFlow::Continue(())
    };
    cluster.each_of(owner, each).unwrap();
    sizes
}

/// Accepts a photo of 5 bytes.
fn accept(cluster: &Cluster, n: u32, at_ms: u64, owner: &Owner) -> PhotoId {
    let (id, accepted) = accepted(n, at_ms, Some(owner));
    assert!(cluster.accept(id, &accepted, &Settings::default(), vec![(Part::Upload, b"photo".to_vec())]).unwrap());
    id
}

/// Takes up the making of a photo that counts, and how it is to end with `bytes` bytes.
fn held(cluster: &Cluster, id: PhotoId, bytes: u64) -> (claim::Held, String, End) {
    let making = cluster.look(id).unwrap().unwrap().photo.making;
    let claim::Claim::Ours(held) = cluster.claim(&Hint { marker: Marker::name_of(id, &making) }).unwrap() else { panic!("it is nobody's") };
    let of = cluster.name_of(&held);
    let done = Done { atlas_bytes: bytes, ..done(7) };
    let record = End { version: 1, outcome: Outcome::Done(done), blobs: format!("{}{of}", records::blobs(id)) };
    (held, of, record)
}

#[test]
fn what_was_made_counts_for_its_owner_whatever_breaks_off() {
    let owner = Owner::of_secret("a");
    for steps in 0.. {
        let (store, dir) = (Memory::default(), tempfile::tempdir().unwrap());
        let one = cluster(&store, dir.path());
        let id = accept(&one, 1, 1, &owner);
        assert_eq!(sizes(&one, &owner), [5]);
        let (held_now, of, record) = held(&one, id, MADE);
        store.end_after(steps);
        let _ = one.end(&held_now, &of, &record, &[]);
        let whole = store.has_left();
        store.end_after(usize::MAX);
        let is_made = one.look(id).unwrap().unwrap().end.is_some();
        let counted = sizes(&one, &owner);
        assert!(counted == [5 + MADE] || counted == [5] && !is_made, "after {steps} steps: {counted:?}");
        if !whole {
            continue;
        }
        // made again, with less
        assert!(is_made && steps > 2 && one.again(id, None).unwrap());
        let (held_now, of, record) = held(&one, id, 40);
        assert_eq!(one.end(&held_now, &of, &record, &[]).unwrap(), "done");
        assert_eq!(sizes(&one, &owner), [45]);
        assert_eq!(store.entries().len(), 2, "{:?}", store.entries());
        one.remove(id, None).unwrap();
        assert!(store.entries().is_empty() && sizes(&one, &owner).is_empty());
        return;
    }
}

#[test]
fn of_two_results_the_one_that_counts_says_what_the_photo_takes() {
    let (store, dir, owner) = (Memory::default(), tempfile::tempdir().unwrap(), Owner::of_secret("a"));
    let one = cluster(&store, dir.path());
    let id = accept(&one, 1, 1, &owner);
    let (held_now, of, record) = held(&one, id, MADE);
    assert_eq!(one.end(&held_now, &of, &record, &[]).unwrap(), "done");
    let of = one.name_of(&held_now);
    let other = End { outcome: Outcome::Done(Done { atlas_bytes: 999, ..done(8) }), blobs: of.clone(), ..record };
    assert_eq!(one.end(&held_now, &of, &other, &[]).unwrap(), "second");
    assert_eq!((sizes(&one, &owner), store.entries().len()), (vec![5 + MADE], 2));
}

#[test]
fn who_settles_late_takes_nothing_from_a_later_making() {
    let (store, dir, owner) = (Memory::default(), tempfile::tempdir().unwrap(), Owner::of_secret("a"));
    let one = cluster(&store, dir.path());
    let id = accept(&one, 1, 1, &owner);
    let (_, accepted) = accepted(1, 1, Some(&owner));
    let (first, of, before) = held(&one, id, MADE);
    assert_eq!(one.end(&first, &of, &before, &[]).unwrap(), "done");
    one.look(id).unwrap().unwrap();
    assert!(one.again(id, None).unwrap());
    let (second, of, after) = held(&one, id, 40);
    assert_ne!(first.making, second.making);
    assert_eq!(one.end(&second, &of, &after, &[]).unwrap(), "done");
    assert_eq!(sizes(&one, &owner), [45]);
    one.settle_entries(id, &accepted, &first.making, &before);
    assert_eq!(sizes(&one, &owner), [45], "the first woke up");
    // it was past the look when the second came
    for name in index::names(id, &accepted, 40) {
        store.remove(&name).unwrap();
    }
    one.settle_entries(id, &accepted, &second.making, &after);
    assert_eq!((sizes(&one, &owner), store.entries().len()), (vec![45], 2));
}

#[test]
fn a_twin_of_another_time_leaves_no_second_place() {
    let (store, dir, owner) = (Memory::default(), tempfile::tempdir().unwrap(), Owner::of_secret("a"));
    let one = cluster(&store, dir.path());
    let id = accept(&one, 1, 5, &owner);
    for at_ms in [5, 6] {
        let (_, twin) = accepted(1, at_ms, Some(&owner));
        assert!(!one.accept(id, &twin, &Settings::default(), vec![(Part::Upload, b"photo".to_vec())]).unwrap());
        let places: Vec<Place> = store.entries().into_iter().map(|(_, place)| place).collect();
        assert_eq!(places, [(5, id); 2], "{at_ms}");
    }
}

#[test]
fn a_store_of_before_gets_its_index_and_goes_on_where_it_broke_off() {
    let (store, dir, owner) = (Memory::default(), tempfile::tempdir().unwrap(), Owner::of_secret("a"));
    let mut expected = Vec::new();
    for n in 0..2500 {
        let of = (n % 3 == 0).then_some(&owner);
        put(&store, n, u64::from(n * 7 % 900), of, false);
        let (id, accepted) = accepted(n, u64::from(n * 7 % 900), of);
        expected.extend(index::names(id, &accepted, MADE));
    }
    let later = PhotoId::from_bytes([7; 16]);
    store.create(&Photo::name(later), b"{\"version\": 9}").unwrap();
    expected.sort_unstable();
    let one = cluster(&store, dir.path());
    store.end_after(700);
    let broke_off = (0..9).find_map(|_| one.build_page(300).err());
    assert!(broke_off.is_some() && !one.is_built());
    store.end_after(usize::MAX);
    let entered = store.entries().len();
    assert!((600..800).contains(&entered), "{entered}");
    let nodes = [0, 1].map(|_| cluster(&store, dir.path()));
    std::thread::scope(|scope| {
        for node in &nodes {
            scope.spawn(move || {
                let pages = (0..99).take_while(|_| !node.build_page(300).unwrap()).count();
                assert!(pages <= 8, "{pages}: it began anew");
            });
        }
    });
    let names: Vec<String> = store.entries().into_iter().map(|(name, _)| name).collect();
    assert!(names == expected, "{} of {}", names.len(), expected.len());
    assert!(one.build_on().unwrap() && one.is_built());
    assert_eq!(sizes(&one, &owner), [5 + MADE; 834]);
}

#[test]
fn a_photo_that_the_index_lacks_is_told_and_entered_and_what_is_stale_goes() {
    let dir = tempfile::tempdir().unwrap();
    let folder = folder::Folder::open(dir.path()).unwrap();
    let url = format!("file://{}", dir.path().display());
    let with = |remedy: Remedy| audit(&url, Duration::from_hours(24), remedy).unwrap();
    let owner = Owner::of_secret("a");
    let (at_ms, id) = put(&folder, 1, 7, Some(&owner), false);
    for part in [Part::Atlas, Part::Disparity, Part::Thumbnail, Part::Report] {
        folder.put(&records::blob(id, &format!("{at_ms:013}-ab-1-ab-0"), part), vec![7; MADE as usize]).unwrap();
    }
    folder.put(&records::blob(id, &format!("{at_ms:013}-ab-1"), Part::Upload), vec![7; 5]).unwrap();
    let before = with(Remedy::Tell);
    assert!(before.is_sound() && !before.built && before.unlisted == [Photo::name(id)], "{before:?}");
    folder.create(index::BUILT, b"{\"version\": 1}").unwrap();
    assert!(!with(Remedy::Tell).is_sound());
    let mended = with(Remedy::Mend);
    assert!(mended.is_sound() && mended.listed == 1);
    let (_, accepted) = accepted(1, at_ms, Some(&owner));
    let names = index::names(id, &accepted, MADE);
    for name in &names {
        assert!(with(Remedy::Tell).unlisted.is_empty());
        folder.remove(name).unwrap();
        assert_eq!(with(Remedy::Tell).unlisted, [Photo::name(id)], "{name}");
        with(Remedy::Mend);
    }
    // of other bytes, of a photo that is gone, and of one that is just being accepted
    let mut stale = vec![index::names(id, &accepted, 7).pop().unwrap()];
    let gone = memory::accepted(2, 7, Some(&owner));
    stale.extend(index::names(gone.0, &gone.1, 0));
    let coming = memory::accepted(3, now_ms(), Some(&owner));
    for name in stale.iter().chain(&index::names(coming.0, &coming.1, 0)) {
        folder.create(name, b"{\"version\": 1}").unwrap();
    }
    stale.sort_unstable();
    let removed = with(Remedy::Remove);
    assert_eq!((removed.left_over, removed.removed, removed.unread.len()), (stale, 3, 0));
    assert_eq!(folder.all("lists/").unwrap().len(), 5);
    folder.create("lists/all/what", b"{}").unwrap();
    assert_eq!(with(Remedy::Remove).unread.len(), 1, "what is nobody's is told and left alone");
}

#[test]
fn what_is_changed_while_a_photo_is_looked_up_is_newer_than_what_was_seen() {
    let (store, dir) = (Memory::default(), tempfile::tempdir().unwrap());
    let one = cluster(&store, dir.path());
    let (_, id) = put(&store, 1, 7, None, true);
    let changed = Arc::new(Mutex::new(None));
    let at = Arc::clone(&changed);
    store.meanwhile(records::ENDS, move || *lock(&at) = Some(Instant::now()));
    let looked = one.look(id).unwrap().unwrap().looked;
    assert!(lock(&changed).is_some_and(|changed| looked <= changed));
}
