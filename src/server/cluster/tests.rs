use std::sync::atomic::AtomicUsize;

use super::*;

/// What the ports promise, on any store.
fn keeps_its_promises(blobs: &dyn Blobs, ledger: &(dyn Ledger + Sync)) {
    blobs.put("blobs/a/one", vec![7; 300_000]).unwrap();
    blobs.put("blobs/a/one", b"new".to_vec()).unwrap();
    assert_eq!(blobs.read("blobs/a/one").unwrap(), b"new");
    assert_eq!(blobs.read("blobs/a/none").unwrap_err().kind(), io::ErrorKind::NotFound);
    blobs.discard("blobs/a/one").unwrap();
    blobs.discard("blobs/a/one").unwrap();
    assert_eq!(blobs.read("blobs/a/one").unwrap_err().kind(), io::ErrorKind::NotFound);
    for round in 0..5 {
        let (name, won) = (format!("ends/race{round}"), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for n in 0..16 {
                let (name, won) = (&name, &won);
                scope.spawn(move || {
                    if ledger.create(name, format!("{n}").as_bytes()).unwrap() {
                        won.fetch_add(1, Ordering::SeqCst);
                    }
                });
            }
        });
        assert_eq!(won.load(Ordering::SeqCst), 1, "of 16 who create a record one succeeds");
    }
    let (_, tag) = ledger.get("ends/race0").unwrap().unwrap();
    let swapped = AtomicUsize::new(0);
    std::thread::scope(|scope| {
        for n in 100..116 {
            let (tag, swapped) = (&tag, &swapped);
            scope.spawn(move || {
                if ledger.swap("ends/race0", tag, format!("{n}").as_bytes()).unwrap() {
                    swapped.fetch_add(1, Ordering::SeqCst);
                }
            });
        }
    });
    assert_eq!(swapped.load(Ordering::SeqCst), 1, "of 16 who change what they saw one succeeds");
    ledger.remove("ends/race0").unwrap();
    ledger.remove("ends/race0").unwrap();
    assert!(ledger.get("ends/race0").unwrap().is_none() && !ledger.swap("ends/race0", &tag, b"1").unwrap());
    for n in [3, 1, 2] {
        assert!(ledger.create(&format!("pending/{n}.x"), b"{}").unwrap());
    }
    assert_eq!(ledger.page("pending/", None, 2).unwrap(), ["pending/1.x", "pending/2.x"]);
    assert_eq!(ledger.page("pending/", Some("pending/2.x"), 2).unwrap(), ["pending/3.x"]);
    assert!(ledger.page("nothing/", None, 2).unwrap().is_empty());
}

#[test]
fn a_folder_keeps_what_the_ports_promise() {
    let dir = tempfile::tempdir().unwrap();
    let folder = folder::Folder::open(dir.path()).unwrap();
    keeps_its_promises(&folder, &folder);
    assert_eq!(std::fs::read_dir(dir.path().join("coming")).unwrap().count(), 0, "nothing is left behind");
}

#[test]
fn an_object_store_keeps_what_the_ports_promise() {
    let Some(engine) = tmpi_testing::Engine::s3() else { return };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _within = runtime.enter();
    let [(_, endpoint), (_, key), (_, secret), (_, region)] = tmpi_testing::Engine::s3_variables(engine.addr);
    let builder = object_store::aws::AmazonS3Builder::new().with_endpoint(endpoint).with_bucket_name("photos").with_region(region);
    let builder = builder.with_access_key_id(key).with_secret_access_key(secret);
    let objects = objects::Objects::of(builder, "a/prefix", true).unwrap();
    keeps_its_promises(&objects, &objects);
}

fn node(dir: &Path, lease_ms: u64) -> Cluster {
    let store = format!("file://{}", dir.display());
    let limits = Limits { lease: Duration::from_millis(lease_ms), ..Limits::default() };
    Cluster::open(&Sharing { store, role: Role::All }, &limits).unwrap()
}

fn accepted(cluster: &Cluster) -> PhotoId {
    let id = PhotoId::of(&[1; 32], None, "", "");
    let accepted = Accepted { version: 1, at_ms: 1, photo_bytes: 5, depth_bytes: None, options: std::collections::BTreeMap::new() };
    let photo = || vec![(Part::Upload, b"photo".to_vec())];
    assert!(cluster.accept(id, &accepted, &Settings::default(), photo()).unwrap());
    assert!(!cluster.accept(id, &accepted, &Settings::default(), photo()).unwrap(), "it is there already");
    id
}

fn hint(cluster: &Cluster) -> Hint {
    let names = cluster.ledger.page(records::PENDING, None, 9).unwrap();
    assert_eq!(names.len(), 1, "{names:?}");
    Hint { marker: names[0].clone() }
}

#[test]
fn a_making_is_one_nodes_until_its_lease_has_run_out() {
    let dir = tempfile::tempdir().unwrap();
    let (one, two) = (node(dir.path(), 150), node(dir.path(), 150));
    accepted(&one);
    let hint = hint(&one);
    let claim::Claim::Ours(first) = one.claim(&hint).unwrap() else { panic!("it is nobody's") };
    assert!(matches!(two.claim(&hint).unwrap(), claim::Claim::Over), "the other has it");
    assert!(one.extend(&first).unwrap());
    std::thread::sleep(Duration::from_millis(200));
    let claim::Claim::Ours(second) = two.claim(&hint).unwrap() else { panic!("nothing was heard of the other") };
    assert_eq!(second.marker().claims, 2);
    assert!(!one.extend(&first).unwrap() && two.extend(&second).unwrap());
    two.crashed(&second).unwrap();
    let claim::Claim::Ours(third) = one.claim(&hint).unwrap() else { panic!("it was given back") };
    assert_eq!((third.marker().claims, third.marker().attempts), (3, 1));
    let pause = one.put_back(&third).unwrap();
    assert!(pause > Duration::ZERO && matches!(two.claim(&hint).unwrap(), claim::Claim::Later(_)), "the fault is not mended yet");
}

#[test]
fn of_two_who_made_a_photo_one_result_counts() {
    let dir = tempfile::tempdir().unwrap();
    let nodes = [node(dir.path(), 50), node(dir.path(), 50)];
    let id = accepted(&nodes[0]);
    let hint = hint(&nodes[0]);
    let held = nodes.each_ref().map(|node| {
        let claim::Claim::Ours(held) = node.claim(&hint).unwrap() else { panic!("nothing was heard of the other") };
        std::thread::sleep(Duration::from_millis(80));
        held
    });
    let end = |at: usize, bytes: &[u8]| {
        let (node, held) = (&nodes[at], &held[at]);
        let of = node.name_of(held);
        let done = crate::server::records::Done { at_ms: 7, width: 1, height: 1, atlas_bytes: 3, atlas_hash: digest(bytes) };
        let (end, blobs) = (crate::server::records::End::Done(done), format!("{}{of}", records::blobs(id)));
        node.end(held, &of, &End { version: records::VERSION, end, blobs }, &[(Part::Atlas, bytes.to_vec())]).unwrap()
    };
    assert_eq!([end(1, b"two"), end(0, b"one")], ["done", "second"], "whoever ends it first");
    for node in &nodes {
        node.look(id).unwrap().unwrap();
        assert_eq!(node.fetch(id, Part::Atlas).unwrap(), b"two");
        assert!(matches!(node.claim(&hint).unwrap(), claim::Claim::Over));
    }
    let left = nodes[0].ledger.page(&records::blobs(id), None, 9).unwrap();
    assert_eq!(left.len(), 2, "the upload and one atlas: {left:?}");
}

#[test]
fn what_is_lost_from_the_queue_is_found_by_the_sweep() {
    let dir = tempfile::tempdir().unwrap();
    let one = node(dir.path(), 9000);
    accepted(&one);
    // another node, of which the queue knows nothing
    let two = node(dir.path(), 9000);
    assert!(two.queue.lease(Duration::ZERO).is_none());
    two.sweep().unwrap();
    let lease = two.queue.lease(Duration::ZERO).expect("the sweep queues it");
    assert_eq!(lease.hint(), &hint(&one));
    let claim::Claim::Ours(_held) = two.claim(lease.hint()).unwrap() else { panic!("it is nobody's") };
    lease.acknowledge();
    two.sweep().unwrap();
    assert!(two.queue.lease(Duration::ZERO).is_none(), "it is worked on");
}

#[test]
fn a_deleted_photo_leaves_nothing_behind() {
    let dir = tempfile::tempdir().unwrap();
    let one = node(dir.path(), 9000);
    let id = accepted(&one);
    one.look(id).unwrap().unwrap();
    assert!(one.again(id, Some(b"strokes".to_vec())).unwrap());
    one.look(id).unwrap().unwrap();
    one.remove(id).unwrap();
    assert!(one.look(id).unwrap().is_none());
    for folder in [records::PHOTOS, "ends/", records::PENDING, &records::blobs(id)] {
        assert_eq!(one.ledger.page(folder, None, 9).unwrap(), [""; 0], "{folder}");
    }
}

#[test]
fn records_of_later_versions_are_not_taken_for_ours() {
    let later = br#"{"version": 2, "end": {}, "blobs": ""}"#;
    let error = records::read::<End>("ends/x", later).unwrap_err();
    assert!(error.to_string().contains("version 2 is later than 1"), "{error}");
}
