//! Crashes at any point: accepted photos are finished, nothing is lost, and nothing is made twice.

use super::lossy_disk::LossyDisk;
use super::*;

on_both! {
    an_interrupted_acceptance_is_atomic,
    an_interrupted_making_is_done_once,
    an_interrupted_deletion_is_atomic,
    workers_and_uploads_that_die_at_random_lose_and_duplicate_nothing,
}

/// More polls than any operation here takes.
const MAX_POLLS: u32 = 400;

/// Waits until the database has committed or rolled back an interrupted transaction.
async fn settle(library: &Library) {
    let mut tx = library.database().write().await.unwrap();
    if tx.has_row_locks() {
        sqlx::query("LOCK TABLE jobs, photos").execute(tx.connection()).await.unwrap();
    }
}

/// Adds a webhook, whose deliveries count the photos that were made.
async fn hear_of_made_photos(library: &Library) {
    let new = NewWebhook { url: "x".into(), secret: "whsec_".into(), events: vec![EventType::PhotoDone] };
    library.add_webhook(None, &new).await.unwrap();
}

/// Asserts that all referenced blobs are intact, and that `gc` leaves no others.
async fn is_consistent(bed: &Bed, library: &Library, photos: usize) {
    assert_eq!(library.fsck().await.unwrap(), []);
    library.gc_older_than(Duration::ZERO).await.unwrap();
    let (mut referred, page) = (Vec::new(), library.list(None, None, 10_000).await.unwrap());
    assert_eq!(page.photos.len(), photos);
    for photo in page.photos {
        assert_eq!(photo.bytes, photo.blobs.values().map(|blob| blob.bytes).sum::<u64>());
        referred.extend(photo.blobs.into_values().map(|blob| blob.name));
    }
    referred.sort();
    let mut there = bed.blobs(library).await;
    there.sort();
    assert_eq!(there, referred);
}

async fn an_interrupted_acceptance_is_atomic(bed: Bed) {
    let library = bed.node_with(Limits { queue: 1000, ..Limits::default() }).await;
    let mut completed = 0;
    for polls in 0..MAX_POLLS {
        let answer = cut(library.accept(upload(polls, owner("ann"))), polls).await;
        settle(&library).await;
        let id = upload(polls, owner("ann")).id;
        let there = library.find(id).await.unwrap().is_some();
        assert!(answer.is_none() || there, "after {polls} polls what was answered is not there");
        assert_eq!(library.job(JobKind::Make, id, None).await.is_ok(), there, "after {polls} polls a photo has no job, or a job no photo");
        let again = library.accept(upload(polls, owner("ann"))).await.unwrap().outcome;
        assert_eq!(again, if there { Outcome::Known } else { Outcome::New });
        completed += u32::from(answer.is_some());
        make_next(&library).await;
        if completed == 3 {
            is_consistent(&bed, &library, polls as usize + 1).await;
            return;
        }
    }
    panic!("it never completes");
}

async fn an_interrupted_making_is_done_once(bed: Bed) {
    let library = bed.node_with(Limits { attempts: 1000, ..Limits::default() }).await;
    hear_of_made_photos(&library).await;
    let id = library.accept(photo(1)).await.unwrap().photo.id;
    for polls in 0..MAX_POLLS {
        let work = async {
            let Some(lease) = library.take(&[JobKind::Make], LEASE).await.unwrap() else { return };
            library.renew(&lease, None).await.unwrap();
            library.finish(&lease, made(&library, &lease).await).await.unwrap();
        };
        let answer = cut(work, polls).await;
        settle(&library).await;
        let photo = library.get(id).await.unwrap();
        let is_done = photo.state == PhotoState::Done;
        assert_eq!(library.job(JobKind::Make, id, None).await.is_ok(), !is_done, "after {polls} polls");
        if is_done {
            // an answer of PostgreSQL may be there before the next poll
            let fewest = if bed.url.is_some() { 1 } else { 3 };
            assert!(polls > fewest, "{polls}");
            is_consistent(&bed, &library, 1).await;
            assert_eq!(count(&library, "deliveries").await, 1);
            if answer.is_some() {
                return;
            }
            // interrupted after the commit: once more
            library.remake(&photo, Class::Batch, &Requester::default()).await.unwrap();
            make_next(&library).await;
            return;
        }
        // its worker is dead
        bed.jump(61_000);
        assert!(library.take(&[], LEASE).await.unwrap().is_none());
        bed.jump(60_000);
    }
    panic!("it never completes");
}

async fn an_interrupted_deletion_is_atomic(bed: Bed) {
    let library = bed.node().await;
    for polls in 0..MAX_POLLS {
        let photo = match library.find(upload(1, owner("ann")).id).await.unwrap() {
            Some(photo) => photo,
            None => done(&library, 1, owner("ann")).await,
        };
        let answer = cut(library.delete(photo.id, None), polls).await;
        settle(&library).await;
        match library.find(photo.id).await.unwrap() {
            Some(left) => assert!(answer.is_none() && library.verify(&left).await.unwrap().is_empty(), "after {polls} polls"),
            None if answer.is_some() => {
                is_consistent(&bed, &library, 0).await;
                return;
            }
            None => is_consistent(&bed, &library, 0).await,
        }
    }
    panic!("it never completes");
}

fn random(seed: &mut u64) -> u32 {
    *seed ^= *seed << 13;
    *seed ^= *seed >> 7;
    *seed ^= *seed << 17;
    (*seed >> 33) as u32
}

/// Accepts photos, and retries each until it succeeds, while calls are often interrupted.
async fn uploads(library: Library, photos: std::ops::Range<u32>, mut seed: u64) {
    for n in photos {
        let requester = owner(&(n % 7).to_string());
        while !matches!(cut(library.accept(upload(n, requester.clone())), random(&mut seed) % 60).await, Some(Ok(_))) {}
    }
}

/// Makes photos until all are done, while it often dies.
async fn works(library: Library, bed: Arc<Bed>, all: u64, mut seed: u64) {
    while library.statistics().await.unwrap().photos.get(&PhotoState::Done) != Some(&all) {
        let polls = random(&mut seed) % 120;
        let work = async {
            let Some(lease) = library.take(&[JobKind::Make], LEASE).await.unwrap() else { return false };
            if random(&mut seed).is_multiple_of(8) {
                let why = if polls.is_multiple_of(2) { Retry::Stopping } else { Retry::Fault("no memory".into()) };
                let _ = library.retry(&lease, &why).await;
            } else {
                let _ = library.finish(&lease, made(&library, &lease).await).await;
            }
            true
        };
        // with nothing waiting, let leases of dead workers expire
        if cut(work, polls).await == Some(false) {
            // slowly, or live workers lose their leases before they finish
            tokio::time::sleep(Duration::from_millis(20)).await;
            bed.jump(1_000);
        }
    }
}

async fn workers_and_uploads_that_die_at_random_lose_and_duplicate_nothing(bed: Bed) {
    const PHOTOS: u32 = 200;
    let bed = Arc::new(bed);
    let limits = Limits { queue: 10_000, attempts: 10_000, ..Limits::default() };
    let nodes = bed.two_nodes(limits).await;
    hear_of_made_photos(&nodes[0]).await;
    let mut tasks = Vec::new();
    for n in 0..4_u32 {
        let node = &nodes[n as usize % 2];
        let part = PHOTOS / 4;
        tasks.push(tokio::spawn(uploads(node.clone(), n * part..(n + 1) * part, 0x9e37_79b9 + u64::from(n))));
        tasks.push(tokio::spawn(works(node.clone(), Arc::clone(&bed), PHOTOS.into(), 0x1234_5678 + u64::from(n))));
    }
    for task in tasks {
        task.await.unwrap();
    }
    let library = &nodes[0];
    let statistics = library.statistics().await.unwrap();
    let made = count(library, "deliveries").await;
    assert_eq!((made, statistics.waiting.len(), statistics.working.len()), (PHOTOS.into(), 0, 0), "each was made once");
    is_consistent(&bed, library, PHOTOS as usize).await;
    for n in 0..PHOTOS {
        let photo = library.get(upload(n, owner(&(n % 7).to_string())).id).await.unwrap();
        let container = library.blobs().read(Part::Container, photo.blob(Part::Container).unwrap()).await.unwrap();
        assert_eq!(container, [b"made of ".as_slice(), &bytes(n)].concat());
    }
}

/// A node whose blob folder loses unsynced data.
async fn on_lossy_disk(bed: &Bed) -> (Library, Arc<LossyDisk>) {
    let files = Arc::new(LossyDisk::default());
    let blobs = BlobStore::folder_of(files.clone(), Path::new("/blobs")).unwrap();
    (bed.node_of(blobs, Limits::default()).await, files)
}

#[tokio::test]
async fn accepted_uploads_survive_a_power_failure() {
    for steps in 0.. {
        let bed = Bed::sqlite();
        let (library, files) = on_lossy_disk(&bed).await;
        files.end_after(steps);
        let accepted = library.accept(photo(1)).await;
        files.crash();
        if let Ok(accepted) = accepted {
            assert!(library.verify(&accepted.photo).await.unwrap().is_empty(), "after {steps} steps");
            let lease = library.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
            let result = made(&library, &lease).await;
            let finished = library.finish(&lease, result).await.unwrap();
            files.crash();
            assert!(library.verify(&finished).await.unwrap().is_empty());
            assert!(steps > 2, "{steps}");
            return;
        }
        assert!(library.find(photo(1).id).await.unwrap().is_none(), "after {steps} steps what was refused is there");
    }
}

#[tokio::test]
async fn a_full_disk_refuses_uploads_and_delays_makings() {
    let bed = Bed::sqlite();
    let (library, files) = on_lossy_disk(&bed).await;
    library.accept(photo(1)).await.unwrap();
    let lease = library.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
    files.fill(true);
    assert!(matches!(library.accept(photo(2)).await, Err(LibraryError::StorageFull)));
    assert!(matches!(library.finish(&lease, made(&library, &lease).await).await, Err(LibraryError::StorageFull)));
    library.retry(&lease, &Retry::Fault("the disk is full".into())).await.unwrap();
    files.fill(false);
    bed.jump(1_000);
    make_next(&library).await;
    library.accept(photo(2)).await.unwrap();
    make_next(&library).await;
    let left = library.gc_older_than(Duration::ZERO).await.unwrap();
    assert_eq!(left, Collected::default(), "partial files are deleted");
}
