use std::path::Path;
use std::sync::atomic::AtomicUsize;

use super::ports::unreachable;
use super::*;
use crate::server::limits::Limits;
use crate::server::store::digest;

mod lengths;

/// What the ports promise, on any store; so many write at once.
fn keeps_its_promises(blobs: &dyn Blobs, ledger: &(dyn Ledger + Sync), writers: usize) {
    blobs.put("blobs/a/one", vec![7; 300_000]).unwrap();
    blobs.put("blobs/a/one", b"new".to_vec()).unwrap();
    assert_eq!(blobs.read("blobs/a/one").unwrap(), b"new");
    assert_eq!(blobs.read("blobs/a/none").unwrap_err().kind(), io::ErrorKind::NotFound);
    let long: Vec<u8> = (0..100_000_u32).map(|n| (n.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    blobs.put("blobs/a/long", long.clone()).unwrap();
    for (from, to) in [(0, 100_000), (0, 1), (99_999, 100_000), (5, 70_000), (99_990, 100_001), (1, 1 << 40), (7, 7), (100_000, 100_001)] {
        let within = |at: u64| at.min(100_000) as usize;
        assert_eq!(blobs.read_range("blobs/a/long", from..to).unwrap(), long[within(from)..within(to)], "{from}..{to}");
    }
    assert!(blobs.read_range("blobs/a/long", 100_000..100_009).unwrap().is_empty(), "behind the end");
    assert!(blobs.read_range("blobs/a/long", 1 << 40..1 << 41).unwrap().is_empty(), "far behind it");
    for range in [0..9, 7..7, 9..10] {
        assert_eq!(blobs.read_range("blobs/a/none", range).unwrap_err().kind(), io::ErrorKind::NotFound);
    }
    blobs.discard("blobs/a/long").unwrap();
    blobs.discard("blobs/a/one").unwrap();
    blobs.discard("blobs/a/one").unwrap();
    assert_eq!(blobs.read("blobs/a/one").unwrap_err().kind(), io::ErrorKind::NotFound);
    for round in 0..5 {
        let (name, won) = (format!("ends/race{round}"), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for n in 0..writers {
                let (name, won) = (&name, &won);
                scope.spawn(move || {
                    if ledger.create(name, format!("{n}").as_bytes()).unwrap() {
                        won.fetch_add(1, Ordering::SeqCst);
                    }
                });
            }
        });
        assert_eq!(won.load(Ordering::SeqCst), 1, "of all who create a record one succeeds");
    }
    let (_, tag) = ledger.get("ends/race0").unwrap().unwrap();
    let swapped = AtomicUsize::new(0);
    std::thread::scope(|scope| {
        for n in 100..100 + writers {
            let (tag, swapped) = (&tag, &swapped);
            scope.spawn(move || {
                let bytes = format!("{n}");
                if let Some(new) = ledger.swap("ends/race0", tag, bytes.as_bytes()).unwrap() {
                    assert_eq!(ledger.get("ends/race0").unwrap().unwrap(), (bytes.into_bytes(), new));
                    swapped.fetch_add(1, Ordering::SeqCst);
                }
            });
        }
    });
    assert_eq!(swapped.load(Ordering::SeqCst), 1, "of all who change what they saw one succeeds");
    ledger.remove("ends/race0").unwrap();
    ledger.remove("ends/race0").unwrap();
    assert!(ledger.get("ends/race0").unwrap().is_none() && ledger.swap("ends/race0", &tag, b"1").unwrap().is_none());
    for n in [3, 1, 2] {
        assert!(ledger.create(&format!("pending/{n}.x"), b"{}").unwrap());
    }
    assert_eq!(ledger.page("pending/", None, 2).unwrap(), ["pending/1.x", "pending/2.x"]);
    assert_eq!(ledger.page("pending/", Some("pending/2.x"), 2).unwrap(), ["pending/3.x"]);
    assert!(ledger.page("nothing/", None, 2).unwrap().is_empty());
    assert_eq!(ledger.all("pending/").unwrap(), ["pending/1.x", "pending/2.x", "pending/3.x"]);
    assert!(ledger.all("nothing/").unwrap().is_empty());
}

#[test]
fn a_folder_keeps_what_the_ports_promise() {
    let dir = tempfile::tempdir().unwrap();
    let folder = folder::Folder::open(dir.path()).unwrap();
    keeps_its_promises(&folder, &folder, 16);
    assert_eq!(std::fs::read_dir(dir.path().join("coming")).unwrap().count(), 0, "nothing is left behind");
}

#[test]
fn an_object_store_keeps_what_the_ports_promise() {
    let Some(engine) = tmpi_testing::Engine::s3() else { return };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _within = runtime.enter();
    let objects = objects_at(engine.addr, "photos");
    // moto checks a condition and writes in two steps: of two at once both may succeed
    keeps_its_promises(&objects, &objects, 1);
}

fn objects_at(addr: std::net::SocketAddr, bucket: &str) -> objects::Objects {
    let [(_, endpoint), (_, key), (_, secret), (_, region)] = tmpi_testing::Engine::s3_variables(addr);
    let builder = object_store::aws::AmazonS3Builder::new().with_endpoint(endpoint).with_bucket_name(bucket).with_region(region);
    let builder = builder.with_access_key_id(key).with_secret_access_key(secret);
    objects::Objects::s3(&builder, "a/prefix", true).unwrap()
}

#[test]
fn azure_keeps_what_the_ports_promise() {
    let Some(engine) = tmpi_testing::Engine::azure() else { return };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _within = runtime.enter();
    let objects = azure_at(engine.addr, "photos");
    keeps_its_promises(&objects, &objects, 16);
    let gone = azure_at(engine.addr, "no-such-container");
    is_away(&gone, &gone);
}

fn azure_at(addr: std::net::SocketAddr, container: &str) -> objects::Objects {
    use tmpi_testing::engines::{AZURE_ACCOUNT, AZURE_KEY};
    let builder = object_store::azure::MicrosoftAzureBuilder::new().with_account(AZURE_ACCOUNT).with_access_key(AZURE_KEY);
    let builder = builder.with_endpoint(format!("http://{addr}/{AZURE_ACCOUNT}")).with_container_name(container);
    objects::Objects::azure(&builder, "a/prefix", true).unwrap()
}

#[test]
fn google_keeps_what_the_ports_promise() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _within = runtime.enter();
    let at = google::start(&runtime);
    let of = |bucket: &str| {
        let builder = object_store::gcp::GoogleCloudStorageBuilder::new().with_base_url(&format!("http://{at}"));
        objects::Objects::google(&builder.with_bearer_token("a token").with_bucket_name(bucket), "a/prefix", true).unwrap()
    };
    let objects = of("photos");
    keeps_its_promises(&objects, &objects, 16);
    let gone = of("no-such-bucket");
    is_away(&gone, &gone);
}

#[test]
fn a_bucket_or_a_folder_that_is_gone_says_nothing_of_what_was_in_it() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path().join("mounted");
    let folder = folder::Folder::open(&at).unwrap();
    assert!(folder.create("photos/a", b"{}").unwrap() && folder.get("photos/none").unwrap().is_none());
    std::fs::rename(&at, dir.path().join("away")).unwrap();
    is_away(&folder, &folder);
    let Some(engine) = tmpi_testing::Engine::s3() else { return };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _within = runtime.enter();
    let objects = objects_at(engine.addr, "no-such-bucket");
    is_away(&objects, &objects);
}

/// Each port says that the store is away.
fn is_away(blobs: &dyn Blobs, ledger: &dyn Ledger) {
    let answers = [
        blobs.read("blobs/a").err(),
        blobs.read_range("blobs/a", 0..9).err(),
        blobs.put("blobs/a", vec![1]).err(),
        ledger.get("photos/a").err(),
        ledger.create("photos/b", b"{}").err(),
        ledger.swap("photos/a", &Tag("\"0\"".into()), b"{}").err(),
        ledger.page(records::PHOTOS, None, 9).err(),
    ];
    for (n, error) in answers.into_iter().enumerate() {
        assert_eq!(error.map(|e| e.kind()), Some(io::ErrorKind::HostUnreachable), "question {n}");
    }
}

fn node(dir: &Path, lease_ms: u64) -> Cluster {
    let store = format!("file://{}", dir.display());
    let limits = Limits { lease: Duration::from_millis(lease_ms), ..Limits::default() };
    Cluster::open(&Sharing { store, role: Role::All, nats: None }, &limits).unwrap()
}

fn accepted(cluster: &Cluster) -> PhotoId {
    let id = PhotoId::of(&[1; 32], None, "", "");
    let accepted =
        Accepted { version: 1, at_ms: 1, photo_bytes: 5, depth_bytes: None, options: std::collections::BTreeMap::new(), owner: None };
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

/// Tries until the lease of another has run out.
fn claimed(cluster: &Cluster, hint: &Hint) -> claim::Held {
    let end = Instant::now() + Duration::from_secs(20);
    loop {
        if let claim::Claim::Ours(held) = cluster.claim(hint).unwrap() {
            return held;
        }
        assert!(Instant::now() < end, "nothing is heard of the other");
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn a_making_is_one_nodes_until_its_lease_has_run_out() {
    let dir = tempfile::tempdir().unwrap();
    let (one, two) = (node(dir.path(), 400), node(dir.path(), 400));
    accepted(&one);
    let hint = hint(&one);
    let first = claimed(&one, &hint);
    let began = Instant::now();
    while began.elapsed() < Duration::from_secs(1) {
        assert!(matches!(two.claim(&hint).unwrap(), claim::Claim::Over), "the other has it, and is heard of");
        assert!(one.extend(&first).unwrap());
        std::thread::sleep(Duration::from_millis(50));
    }
    let began = Instant::now();
    let second = claimed(&two, &hint);
    assert!(began.elapsed() >= Duration::from_millis(400));
    assert_eq!(second.marker().claims, 2);
    assert!(!one.extend(&first).unwrap() && two.extend(&second).unwrap());
    two.crashed(&second).unwrap();
    let claim::Claim::Ours(third) = one.claim(&hint).unwrap() else { panic!("it was given back") };
    assert_eq!((third.marker().claims, third.marker().attempts), (3, 1));
    let pause = one.put_back(&third).unwrap();
    assert!(pause > Duration::ZERO && matches!(one.claim(&hint).unwrap(), claim::Claim::Later(_)));
    assert!(matches!(two.claim(&hint).unwrap(), claim::Claim::Later(_)), "the fault is not mended yet");
}

#[test]
fn a_lease_does_not_run_out_while_nobody_can_look() {
    let dir = tempfile::tempdir().unwrap();
    let (one, two) = (node(dir.path(), 200), node(dir.path(), 200));
    accepted(&one);
    let hint = hint(&one);
    let first = claimed(&one, &hint);
    assert!(matches!(two.claim(&hint).unwrap(), claim::Claim::Over));
    // the store is away, or this process stands still, for longer than a lease
    std::thread::sleep(Duration::from_millis(500));
    assert!(matches!(two.claim(&hint).unwrap(), claim::Claim::Over), "the other may be well");
    assert!(one.extend(&first).unwrap());
}

/// A ledger of which the answers are lost on their way back, once it is told to.
#[derive(Debug)]
struct Forgetful {
    there: folder::Folder,
    loses: Arc<AtomicUsize>,
    fails: Arc<AtomicUsize>,
}

impl Forgetful {
    /// The answer to a write: a client that was not answered tries again, and meets its own outcome.
    fn lost(&self) -> bool {
        counted_down(&self.loses)
    }
}

fn counted_down(count: &AtomicUsize) -> bool {
    count.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |n| n.checked_sub(1)).is_ok()
}

impl Ledger for Forgetful {
    fn create(&self, name: &str, bytes: &[u8]) -> io::Result<bool> {
        Ok(self.there.create(name, bytes)? && !self.lost())
    }

    fn get(&self, name: &str) -> io::Result<Option<(Vec<u8>, Tag)>> {
        self.there.get(name)
    }

    fn swap(&self, name: &str, seen: &Tag, bytes: &[u8]) -> io::Result<Option<Tag>> {
        let written = self.there.swap(name, seen, bytes)?.filter(|_| !self.lost());
        if counted_down(&self.fails) { Err(unreachable("no answer, and no second try")) } else { Ok(written) }
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        self.there.remove(name)
    }

    fn page(&self, folder: &str, after: Option<&str>, limit: usize) -> io::Result<Vec<String>> {
        self.there.page(folder, after, limit)
    }
}

#[test]
fn an_answer_that_is_lost_on_its_way_loses_no_photo_and_no_lease() {
    let dir = tempfile::tempdir().unwrap();
    let (loses, fails) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicUsize::new(0)));
    let there = folder::Folder::open(dir.path()).unwrap();
    let mut one = node(dir.path(), 9000);
    one.ledger = Arc::new(Forgetful { there, loses: Arc::clone(&loses), fails: Arc::clone(&fails) });
    // of the marker, of the entry in the index, and of the photo's record
    loses.store(3, Ordering::SeqCst);
    let id = accepted(&one);
    let hint = hint(&one);
    loses.store(1, Ordering::SeqCst);
    let claim::Claim::Ours(held) = one.claim(&hint).unwrap() else { panic!("it is this node's") };
    loses.store(1, Ordering::SeqCst);
    assert!(one.extend(&held).unwrap() && one.extend(&held).unwrap());
    fails.store(1, Ordering::SeqCst);
    assert!(one.extend(&held).is_err(), "nobody knows what became of it");
    assert!(one.extend(&held).unwrap(), "it was written, by this node");
    let of = one.name_of(&held);
    let failed = crate::server::records::Failed { at_ms: 7, problem: crate::server::problem::Problem::not_found("") };
    let end = End { version: records::VERSION, outcome: crate::server::records::End::Failed(failed), blobs: of.clone() };
    loses.store(1, Ordering::SeqCst);
    assert_eq!(one.end(&held, &of, &end, &[]).unwrap(), "failed");
    one.look(id).unwrap().unwrap();
    loses.store(1, Ordering::SeqCst);
    assert!(one.set(id, &Settings { title: Some("A name".into()), ..Settings::default() }).unwrap());
    one.look(id).unwrap().unwrap();
    // of the marker, and of the change
    loses.store(2, Ordering::SeqCst);
    assert!(one.again(id, None).unwrap());
    let photo = one.look(id).unwrap().unwrap().photo;
    assert_eq!(one.pending().unwrap(), [Marker::name_of(id, &photo.making)]);
}

#[test]
fn records_that_cannot_be_read_hide_no_others_and_stay_as_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let one = node(dir.path(), 9000);
    let later = br#"{"version": 2, "what": "is this"}"#;
    let foreign: Vec<(String, Vec<u8>)> =
        (0..600).map(|n| (format!("pending/0000000000000-{n:04}"), if n % 2 == 0 { later.to_vec() } else { vec![n as u8; n] })).collect();
    for (name, bytes) in &foreign {
        assert!(one.ledger.create(name, bytes).unwrap());
    }
    accepted(&one);
    let two = node(dir.path(), 9000);
    let swept = |cluster: &Cluster| cluster.sweep(&cluster.pending().unwrap(), Instant::now()).unwrap();
    // more than a sweep reads: the next one goes on behind them
    swept(&two);
    swept(&two);
    let lease = two.queue.lease(Duration::ZERO).expect("it is found behind those");
    let claim::Claim::Ours(_held) = two.claim(lease.hint()).unwrap() else { panic!("it is nobody's") };
    for (name, bytes) in &foreign {
        assert_eq!(one.ledger.get(name).unwrap().unwrap().0, *bytes, "{name}");
    }
    let hint = Hint { marker: foreign[0].0.clone() };
    let error = two.claim(&hint).err().expect("it is not understood");
    assert!(error.kind() == io::ErrorKind::InvalidData && error.to_string().contains("update this node"), "{error}");
}

#[test]
fn of_two_who_made_a_photo_one_result_counts() {
    let dir = tempfile::tempdir().unwrap();
    let nodes = [node(dir.path(), 50), node(dir.path(), 50)];
    let id = accepted(&nodes[0]);
    let hint = hint(&nodes[0]);
    let held = nodes.each_ref().map(|node| claimed(node, &hint));
    let end = |at: usize, bytes: &[u8]| {
        let (node, held) = (&nodes[at], &held[at]);
        let of = node.name_of(held);
        let done = crate::server::records::Done { at_ms: 7, width: 1, height: 1, atlas_bytes: 3, atlas_hash: digest(bytes) };
        let (outcome, blobs) = (crate::server::records::End::Done(done), format!("{}{of}", records::blobs(id)));
        node.end(held, &of, &End { version: records::VERSION, outcome, blobs }, &[(Part::Atlas, bytes.to_vec())]).unwrap()
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
    let swept = || two.sweep(&two.pending().unwrap(), Instant::now()).unwrap();
    swept();
    let lease = two.queue.lease(Duration::ZERO).expect("the sweep queues it");
    assert_eq!(lease.hint(), &hint(&one));
    let claim::Claim::Ours(_held) = two.claim(lease.hint()).unwrap() else { panic!("it is nobody's") };
    lease.acknowledge();
    swept();
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
    one.remove(id, None).unwrap();
    assert!(one.look(id).unwrap().is_none());
    for folder in [records::PHOTOS, "ends/", records::PENDING, index::LISTS, &records::blobs(id)] {
        assert_eq!(one.ledger.page(folder, None, 9).unwrap(), [""; 0], "{folder}");
    }
}

#[test]
fn what_is_left_over_is_removed_and_what_is_missing_or_foreign_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let one = node(dir.path(), 9000);
    let id = accepted(&one);
    let url = format!("file://{}", dir.path().display());
    let with = |remedy: Remedy| audit(&url, Duration::from_hours(24), remedy).unwrap();
    let looked = |remove: bool| with(if remove { Remedy::Remove } else { Remedy::Tell });
    let sound = looked(true);
    assert_eq!(sound, Audit { photos: 1, pending: 1, ..Audit::default() });
    let old = |n: u32| format!("0000000000007-ab-{n}");
    let foreign = b"{\"version\": 9}".to_vec();
    let left_over = [Marker::name_of(id, &old(1)), End::name(id, &old(2)), records::blob(id, &old(3), Part::Atlas)];
    one.ledger.create(&left_over[0], &serde_json::to_vec(&Marker::new(id, &old(1))).unwrap()).unwrap();
    let failed = crate::server::records::Failed { at_ms: 7, problem: crate::server::problem::Problem::not_found("") };
    let end = End { version: 1, outcome: crate::server::records::End::Failed(failed), blobs: String::new() };
    one.ledger.create(&left_over[1], &serde_json::to_vec(&end).unwrap()).unwrap();
    one.blobs.put(&left_over[2], vec![7]).unwrap();
    // on its way in, of a later version, and what belongs to it
    let coming = records::blob(id, &one.making(), Part::Upload);
    one.blobs.put(&coming, vec![7]).unwrap();
    one.ledger.create(&End::name(id, &old(4)), &foreign).unwrap();
    let other = PhotoId::of(&[2; 32], None, "", "");
    one.ledger.create(&Photo::name(other), &foreign).unwrap();
    one.blobs.put(&records::blob(other, &old(5), Part::Upload), vec![7]).unwrap();
    let mut expected: Vec<String> = left_over.to_vec();
    expected.sort_unstable();
    let (told, removed) = (looked(false), looked(true));
    assert_eq!((&told.left_over, told.removed, told.unread.len(), told.photos), (&expected, 0, 2, 1), "{told:?}");
    assert_eq!((removed.left_over, removed.removed), (expected, 3));
    assert!(looked(true).left_over.is_empty() && one.blobs.read(&coming).is_ok());
    assert!(one.blobs.read(&records::blob(other, &old(5), Part::Upload)).is_ok());
    let photo = one.look(id).unwrap().unwrap().photo;
    one.ledger.remove(&Marker::name_of(id, &photo.making)).unwrap();
    one.blobs.discard(&records::blob(id, &photo.source, Part::Upload)).unwrap();
    let lost = looked(false);
    assert_eq!((&lost.unmarked, lost.missing.as_slice()), (&vec![Photo::name(id)], &[records::blob(id, &photo.source, Part::Upload)][..]));
    let mended = with(Remedy::Mend);
    assert_eq!((mended.unmarked, mended.mended, looked(false).unmarked.len()), (lost.unmarked, 1, 0));
    // half of a record, and one of a later version
    let marker = Marker::name_of(id, &photo.making);
    let damage = |bytes: &[u8]| {
        one.ledger.remove(&marker).unwrap();
        one.ledger.create(&marker, bytes).unwrap();
    };
    let whole = serde_json::to_vec(&Marker::new(id, &photo.making)).unwrap();
    for (bytes, damaged) in [(&whole[..whole.len() / 2], 1), (&b"{\"version\": 1}"[..], 1), (&foreign[..], 0)] {
        damage(bytes);
        let told = with(Remedy::Tell);
        assert_eq!((told.damaged.len(), told.unread.len()), (damaged, 3 - damaged), "{told:?}");
        assert!(matches!(one.claim(&Hint { marker: marker.clone() }), Err(e) if e.kind() == io::ErrorKind::InvalidData));
        assert_eq!(with(Remedy::Mend).mended, damaged);
    }
    assert_eq!(one.ledger.get(&marker).unwrap().unwrap().0, foreign, "what is of a later version is left alone");
    damage(&whole[..9]);
    with(Remedy::Mend);
    assert!(matches!(one.claim(&Hint { marker }), Ok(claim::Claim::Ours(_))));
}

#[test]
fn folders_that_are_empty_for_long_go_and_come_back_when_they_are_needed() {
    let dir = tempfile::tempdir().unwrap();
    let one = node(dir.path(), 9000);
    let id = accepted(&one);
    let folder = dir.path().join(records::blobs(id));
    let tidied = || audit(&format!("file://{}", dir.path().display()), Duration::from_hours(24), Remedy::Remove).unwrap().folders;
    one.remove(id, None).unwrap();
    assert_eq!((tidied(), folder.is_dir()), (0, true), "it may be needed just now");
    std::fs::File::open(&folder).unwrap().set_modified(std::time::SystemTime::now() - Duration::from_hours(25)).unwrap();
    assert_eq!((tidied(), folder.is_dir()), (1, false));
    accepted(&one);
    assert_eq!((tidied(), folder.is_dir()), (0, true));
}

#[test]
fn records_of_later_versions_are_not_taken_for_ours() {
    let later = br#"{"version": 2, "outcome": {}, "blobs": ""}"#;
    let error = records::read::<End>("ends/x", later).unwrap_err();
    assert!(error.to_string().contains("version 2 is later than 1"), "{error}");
}
