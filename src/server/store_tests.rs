use std::collections::BTreeMap;

use sha2::{Digest, Sha256};

use super::super::forgetful::Forgetful;
use super::super::options;
use super::*;

fn accepted(at_ms: u64) -> Accepted {
    Accepted {
        version: 1,
        at_ms,
        photo_bytes: 5,
        depth_bytes: None,
        options: BTreeMap::from([("quality".into(), "90".into())]),
        owner: None,
    }
}

fn put(store: &Store, n: u8, at_ms: u64) -> PhotoId {
    let id = PhotoId::of(&[n; 32], None, "", "");
    let incoming = store.begin().unwrap();
    fs::write(incoming.path(Part::Upload), b"photo").unwrap();
    store.accept(incoming, id, &accepted(at_ms)).unwrap();
    id
}

#[test]
fn what_was_accepted_is_found_again_oldest_first() {
    let dir = tempfile::tempdir().unwrap();
    let (store, found) = Store::open(dir.path(), "").unwrap();
    assert!(found.is_empty());
    let (b, a) = (put(&store, 2, 20), put(&store, 1, 10));
    let state = State::new(2, None);
    store.write_state(b, &state).unwrap();
    drop(store);
    let (store, found) = Store::open(dir.path(), "").unwrap();
    assert_eq!(found.iter().map(|f| f.id).collect::<Vec<_>>(), [a, b]);
    assert_eq!((&found[0].state, &found[1].state), (&State::default(), &state));
    assert_eq!(found[0].accepted, accepted(10));
    assert_eq!(store.read(a, Part::Upload).unwrap(), b"photo");
}

#[test]
fn leftovers_go_and_strangers_stay() {
    let dir = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(dir.path(), "").unwrap();
    let id = put(&store, 1, 1);
    std::mem::forget(store.begin().unwrap());
    fs::write(store.folder(id).join("atlas.tmpi.tmp"), b"half").unwrap();
    fs::create_dir(store.photos.join("stranger")).unwrap();
    drop(store);
    let (store, found) = Store::open(dir.path(), "").unwrap();
    assert_eq!(found.len(), 1);
    assert_eq!(fs::read_dir(&store.incoming).unwrap().count(), 0);
    assert!(!store.folder(id).join("atlas.tmpi.tmp").exists());
    assert!(store.photos.join("stranger").exists());
}

#[test]
fn an_upload_that_is_given_up_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(dir.path(), "").unwrap();
    let incoming = store.begin().unwrap();
    fs::write(incoming.path(Part::Upload), b"photo").unwrap();
    drop(incoming);
    assert_eq!(fs::read_dir(&store.incoming).unwrap().count(), 0);
}

#[test]
fn removal_is_for_good_and_writes_after_it_fail() {
    let dir = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(dir.path(), "").unwrap();
    let id = put(&store, 1, 1);
    store.remove(id).unwrap();
    assert!(store.write_state(id, &State::default()).is_err());
    assert!(store.remove(id).is_err());
    drop(store);
    assert!(Store::open(dir.path(), "").unwrap().1.is_empty());
}

#[test]
fn one_damaged_record_hides_nothing_else_and_another_upload_heals_it() {
    let dir = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(dir.path(), "").unwrap();
    let (id, other) = (put(&store, 1, 1), put(&store, 2, 2));
    fs::write(store.path(id, Part::Options), b"{").unwrap();
    drop(store);
    let (store, found) = Store::open(dir.path(), "").unwrap();
    assert_eq!((found.len(), found[0].id, store.unreadable()), (1, other, 1));
    assert_eq!(store.read(id, Part::Upload).unwrap(), b"photo");
    assert!(store.look_again().is_empty());
    assert_eq!(put(&store, 1, 2), id);
    assert_eq!(store.unreadable(), 0);
    drop(store);
    assert_eq!(Store::open(dir.path(), "").unwrap().1.len(), 2);
}

#[test]
fn lost_options_are_those_by_default_where_the_id_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(dir.path(), "").unwrap();
    let text = options::to_text(&tmpi_pipeline::Options::default());
    let id = PhotoId::of(&Sha256::digest(b"photo").into(), None, &options::canonical(&text), "");
    let incoming = store.begin().unwrap();
    fs::write(incoming.path(Part::Upload), b"photo").unwrap();
    store.accept(incoming, id, &accepted(1)).unwrap();
    fs::write(store.path(id, Part::Options), b"").unwrap();
    drop(store);
    let (_, found) = Store::open(dir.path(), "").unwrap();
    assert_eq!((found[0].id, &found[0].accepted.options), (id, &text));
}

#[test]
fn what_became_of_a_photo_is_found_out_anew_where_its_record_or_a_result_is_gone() {
    let dir = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(dir.path(), "").unwrap();
    let id = put(&store, 1, 1);
    let done = Done { at_ms: 1, width: 2, height: 2, atlas_bytes: 1, atlas_hash: digest(b"a") };
    let state = State::new(0, Some(End::Done(done.clone())));
    let results = [Part::Atlas, Part::Disparity, Part::Thumbnail, Part::Report];
    let open = |store: Store| {
        drop(store);
        let (store, mut found) = Store::open(dir.path(), "").unwrap();
        (store, found.remove(0))
    };
    store.write(id, &results.map(|part| (part, b"a".as_slice()))).unwrap();
    store.write_state(id, &state).unwrap();
    assert_eq!(store.damage(id, &done), None);
    let (store, found) = open(store);
    assert_eq!(found.state, state);
    fs::write(store.path(id, Part::State), b"{\"att").unwrap();
    let (store, found) = open(store);
    assert_eq!(found.state, State::default());
    store.write_state(id, &state).unwrap();
    fs::remove_file(store.path(id, Part::Atlas)).unwrap();
    assert_eq!(store.damage(id, &done).as_deref(), Some("atlas.tmpi is missing"));
    let (store, found) = open(store);
    assert_eq!(found.state, State::default());
    // settings of a later version are used as far as they go, and kept
    let later = br#"{"version": 9, "title": "A", "halo": 1}"#;
    fs::write(store.path(id, Part::Settings), later).unwrap();
    let (store, found) = open(store);
    assert_eq!(found.settings.title.as_deref(), Some("A"));
    store.write_settings(id, &found.settings).unwrap();
    assert_eq!(fs::read(store.folder(id).join(KEPT_SETTINGS)).unwrap(), later);
}

/// A photo as it is put, made and deleted, on files that end the process after some changes; tells what was promised by then.
fn life(store: &Store, id: PhotoId) -> Vec<&'static str> {
    let mut promised = Vec::new();
    let begun = store.begin().and_then(|incoming| {
        store.files.write(&incoming.path(Part::Upload), b"photo")?;
        store.accept(incoming, id, &accepted(1))
    });
    if begun.is_err() {
        return promised;
    }
    promised.push("accepted");
    let done = Done { at_ms: 1, width: 2, height: 2, atlas_bytes: 5, atlas_hash: digest(b"atlas") };
    let results = [(Part::Atlas, b"atlas".as_slice()), (Part::Disparity, b"d"), (Part::Thumbnail, b"t"), (Part::Report, b"r")];
    let kept = store.write(id, &results).and_then(|()| store.write_state(id, &State::new(0, Some(End::Done(done)))));
    if kept.is_err() {
        return promised;
    }
    promised.push("done");
    if store.remove(id).is_ok() {
        promised.push("deleted");
    }
    promised
}

#[test]
fn what_was_promised_survives_the_machine_stopping_at_each_step() {
    let id = PhotoId::of(&[1; 32], None, "", "");
    let dir = Path::new("/data");
    for steps in 0.. {
        let files = Arc::new(Forgetful::new());
        let (store, _) = Store::open_in(files.clone(), dir, "", None).unwrap();
        files.sync_dir(Path::new("/")).unwrap();
        files.end_after(steps);
        let promised = life(&store, id);
        std::mem::forget(store);
        files.crash();
        let (store, found) = Store::open_in(files.clone(), dir, "", None).unwrap();
        assert!(files.names(&store.incoming).unwrap().is_empty());
        let state = found.first().map(|f| f.state.end.is_some());
        let context = format!("after {steps} steps, {promised:?} were promised: {state:?}");
        match promised.last() {
            None => assert!(state != Some(true), "{context}"),
            Some(&"accepted") => assert!(state.is_some(), "{context}"),
            Some(&"done") => assert!(state == Some(true) || state.is_none(), "{context}"),
            _ => assert_eq!(state, None, "{context}"),
        }
        if state.is_some() {
            assert_eq!(store.read(id, Part::Upload).unwrap(), b"photo", "{context}");
            assert_eq!(found[0].accepted, accepted(1), "{context}");
        }
        if state == Some(true) {
            assert_eq!(store.read(id, Part::Atlas).unwrap(), b"atlas", "{context}");
            assert_eq!(store.read(id, Part::Report).unwrap(), b"r", "{context}");
        }
        if promised.len() == 3 {
            assert!(steps > 15, "{steps}");
            return;
        }
    }
}

#[test]
fn an_upload_that_was_refused_does_not_appear_at_the_next_start() {
    // every change of accepting fails once, and the process lives on to put it right
    for failing in 0..6 {
        let files = Arc::new(Forgetful::new());
        let (store, _) = Store::open_in(files.clone(), Path::new("/data"), "", None).unwrap();
        let id = PhotoId::of(&[1; 32], None, "", "");
        let incoming = store.begin().unwrap();
        store.files.write(&incoming.path(Part::Upload), b"photo").unwrap();
        files.fail_once_after(failing);
        let refused = store.accept(incoming, id, &accepted(1)).is_err();
        files.end_after(usize::MAX);
        drop(store);
        let (_, found) = Store::open_in(files, Path::new("/data"), "", None).unwrap();
        assert_eq!(found.is_empty(), refused, "change {failing}");
    }
}

#[test]
fn a_full_disk_keeps_nothing_half_written_and_goes_on_once_there_is_room() {
    let files = Arc::new(Forgetful::new());
    let (store, _) = Store::open_in(files.clone(), Path::new("/data"), "", None).unwrap();
    let id = PhotoId::of(&[1; 32], None, "", "");
    let incoming = store.begin().unwrap();
    store.files.write(&incoming.path(Part::Upload), b"photo").unwrap();
    store.accept(incoming, id, &accepted(1)).unwrap();
    store.check().unwrap();
    files.fill(true);
    assert_eq!(store.write(id, &[(Part::Atlas, b"atlas")]).unwrap_err().kind(), io::ErrorKind::StorageFull);
    assert!(!files.exists(&store.folder(id).join("atlas.tmpi.tmp")));
    assert_eq!(store.begin().unwrap_err().kind(), io::ErrorKind::StorageFull);
    assert!(store.check().is_err());
    files.fill(false);
    store.check().unwrap();
    store.write(id, &[(Part::Atlas, b"atlas")]).unwrap();
    files.spoil(&store.path(id, Part::Atlas), b"at");
    assert_eq!(store.read(id, Part::Atlas).unwrap(), b"at");
}

#[test]
fn a_process_that_is_about_to_end_is_waited_for() {
    let dir = tempfile::tempdir().unwrap();
    let (before, _) = Store::open(dir.path(), "").unwrap();
    let ending = std::thread::spawn(move || {
        std::thread::sleep(Duration::from_millis(100));
        drop(before);
    });
    assert!(Store::open(dir.path(), "").is_ok());
    ending.join().unwrap();
}

#[test]
fn one_process_at_a_time() {
    let dir = tempfile::tempdir().unwrap();
    let first = Store::open(dir.path(), "").unwrap();
    assert_eq!(Store::open(dir.path(), "").unwrap_err().kind(), io::ErrorKind::ResourceBusy);
    drop(first);
    Store::open(dir.path(), "").unwrap();
}
