use std::collections::BTreeSet;

use super::*;

/// A day in milliseconds.
const DAY: i64 = 86_400_000;

on_both! {
    many_workers_make_a_photo_once,
    owners_and_addresses_take_turns,
    interactive_jobs_come_first_but_not_always,
    a_dead_workers_job_is_taken_again_and_its_result_discarded,
    a_worker_keeps_its_lease_when_the_clock_jumps,
    a_photo_that_crashes_its_workers_fails,
    a_fault_of_the_server_only_costs_time,
    a_position_counts_the_jobs_ahead,
    a_deleted_photos_worker_loses_its_lease,
    a_check_takes_a_damaged_photo_out_of_service,
    waiting_workers_are_notified_of_a_job,
}

async fn many_workers_make_a_photo_once(bed: Bed) {
    let nodes = bed.two_nodes(Limits::default()).await;
    nodes[0].accept(photo(1)).await.unwrap();
    let work = |node: Library, _| async move {
        let lease = node.take(&[JobKind::Make], LEASE).await.unwrap()?;
        Some(node.finish(&lease, made(&node, &lease).await).await.unwrap())
    };
    assert_eq!(at_once(&nodes, 16, work).await.into_iter().flatten().count(), 1);
}

async fn owners_and_addresses_take_turns(bed: Bed) {
    let library = bed.node().await;
    for n in 0..10 {
        library.accept(upload(n, owner("ann"))).await.unwrap();
    }
    let mut order = String::new();
    for n in 10..13 {
        // a stranger is a new owner with each upload
        let stranger = Requester { owner: owner(&n.to_string()).owner, ..address("192.0.2.1") };
        for requester in [owner("bob"), stranger] {
            bed.jump(1);
            library.accept(upload(n, requester)).await.unwrap();
        }
    }
    for _ in 0..9 {
        let photo = make_next(&library).await;
        order.push(match photo.owner {
            Some(of) if of == Owner::of_secret("ann") => 'a',
            Some(of) if of == Owner::of_secret("bob") => 'b',
            _ => 's',
        });
    }
    assert_eq!(order, "absabsabs");
    bed.jump(1);
    library.accept(upload(20, owner("bob"))).await.unwrap();
    make_next(&library).await;
    assert_eq!(make_next(&library).await.owner, owner("bob").owner, "behind one of the other's seven");
}

async fn interactive_jobs_come_first_but_not_always(bed: Bed) {
    let library = bed.node().await;
    let mut n = 0;
    for (accepted, order) in [("bibibi", "iiibbb"), ("bbiiiiii", "ibiiibii")] {
        for class in accepted.chars() {
            let class = if class == 'b' { Class::Batch } else { Class::Interactive };
            library.accept(Upload { class, ..upload(n, owner(&n.to_string())) }).await.unwrap();
            n += 1;
        }
        let mut made = String::new();
        for _ in order.chars() {
            made.push_str(&make_next(&library).await.class.name()[..1]);
        }
        assert_eq!(made, order, "every fourth is taken in the opposite order");
    }
}

async fn a_dead_workers_job_is_taken_again_and_its_result_discarded(bed: Bed) {
    let (slow, other) = (bed.node().await, bed.node().await);
    slow.accept(photo(1)).await.unwrap();
    let late = slow.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
    assert!(other.take(&[JobKind::Make], LEASE).await.unwrap().is_none());
    bed.jump(61_000);
    assert!(other.take(&[JobKind::Make], LEASE).await.unwrap().is_none(), "it is put back for a moment");
    bed.jump(1_000);
    let lease = other.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
    assert_eq!(lease.job.attempts, 1);
    assert!(matches!(slow.renew(&late, None).await, Err(LibraryError::LeaseLost)));
    assert!(matches!(slow.finish(&late, made(&slow, &late).await).await, Err(LibraryError::LeaseLost)), "before the other has finished");
    let photo = other.finish(&lease, made(&other, &lease).await).await.unwrap();
    assert!(matches!(slow.finish(&late, made(&slow, &late).await).await, Err(LibraryError::LeaseLost)), "and after");
    assert!(matches!(slow.fail(&late, &Problem::new("x", "y")).await, Err(LibraryError::LeaseLost)));
    assert!(matches!(slow.retry(&late, &Retry::Stopping).await, Err(LibraryError::LeaseLost)));
    assert_eq!(slow.get(photo.id).await.unwrap(), photo);
    assert_eq!(bed.blobs(&slow).await.len(), 3, "the late results are deleted");
}

async fn a_worker_keeps_its_lease_when_the_clock_jumps(bed: Bed) {
    for jump in [DAY, -DAY] {
        let library = bed.node().await;
        let n = if jump > 0 { 1 } else { 2 };
        library.accept(photo(n)).await.unwrap();
        let lease = library.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
        bed.jump(jump);
        assert!(library.take(&[JobKind::Make], LEASE).await.unwrap().is_none(), "{jump}");
        library.renew(&lease, Some(&json!({"stage": "depth"}))).await.unwrap();
        library.finish(&lease, made(&library, &lease).await).await.unwrap();
        // once its process is gone, another takes the job, however late the lease seems to end
        library.accept(photo(10 + n)).await.unwrap();
        drop(library.take(&[JobKind::Make], LEASE).await.unwrap().unwrap());
        bed.jump(jump);
        library.take(&[JobKind::Make], LEASE).await.unwrap();
        bed.jump(1_000);
        let again = library.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
        assert_eq!(again.job.attempts, 1, "{jump}");
        // and a delayed job is not forgotten
        library.retry(&again, &Retry::Fault("the disk is full".into())).await.unwrap();
        bed.jump(jump);
        make_next(&library).await;
    }
}

async fn a_photo_that_crashes_its_workers_fails(bed: Bed) {
    let library = bed.node_with(Limits { attempts: 3, ..Limits::default() }).await;
    let id = library.accept(photo(1)).await.unwrap().photo.id;
    for died in 1..=3 {
        let lease = library.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
        assert_eq!(lease.job.attempts, died - 1);
        if died == 2 {
            // the whole process, this time
            drop(lease);
            bed.jump(61_000);
            library.take(&[JobKind::Make], LEASE).await.unwrap();
        } else {
            library.retry(&lease, &Retry::Died("signal 9".into())).await.unwrap();
        }
        bed.jump(10_000);
    }
    let photo = library.get(id).await.unwrap();
    let problem = Problem::new("gave-up", "it crashed its worker process 3 times");
    assert_eq!((photo.state, photo.problem), (PhotoState::Failed, Some(problem)));
    assert!(library.take(&[JobKind::Make], LEASE).await.unwrap().is_none());
}

async fn a_fault_of_the_server_only_costs_time(bed: Bed) {
    let library = bed.node().await;
    let id = library.accept(photo(1)).await.unwrap().photo.id;
    let mut lease = library.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
    let mut pauses = Vec::new();
    for _ in 0..9 {
        library.retry(&lease, &Retry::Fault("no memory".into())).await.unwrap();
        assert_eq!(library.job(JobKind::Make, id, None).await.unwrap().problem, Some(Problem::new("fault", "no memory")));
        let mut pause = 0;
        lease = loop {
            bed.jump(250);
            pause += 250;
            if let Some(lease) = library.take(&[JobKind::Make], LEASE).await.unwrap() {
                break lease;
            }
        };
        pauses.push(pause);
    }
    // the database's clock runs on meanwhile
    let doubled = [500, 1_000, 2_000, 4_000, 8_000, 16_000, 32_000, 60_000, 60_000];
    assert!(pauses.iter().zip(doubled).all(|(is, most)| (most / 2..=most).contains(is)), "{pauses:?}");
    assert_eq!((lease.job.attempts, lease.job.problem.clone()), (0, None));
    library.retry(&lease, &Retry::Stopping).await.unwrap();
    make_next(&library).await;
}

async fn a_position_counts_the_jobs_ahead(bed: Bed) {
    let library = bed.node().await;
    let mut ids = Vec::new();
    for (n, requester) in [owner("ann"), owner("ann"), owner("bob")].into_iter().enumerate() {
        ids.push(library.accept(upload(n as u32, requester)).await.unwrap().photo.id);
    }
    let mut ahead = Vec::new();
    for id in &ids {
        ahead.push(library.position(*id).await.unwrap().unwrap());
    }
    assert_eq!(ahead, [0, 2, 1], "the other's first comes before one's second");
    make_next(&library).await;
    assert_eq!((library.position(ids[0]).await.unwrap(), library.position(ids[1]).await.unwrap()), (None, Some(1)));
}

async fn a_deleted_photos_worker_loses_its_lease(bed: Bed) {
    let library = bed.node().await;
    library.accept(photo(1)).await.unwrap();
    let lease = library.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
    let result = made(&library, &lease).await;
    assert!(!library.delete(lease.photo.id, Some(lease.photo.accepted_at + 1)).await.unwrap(), "another upload");
    assert!(library.delete(lease.photo.id, Some(lease.photo.accepted_at)).await.unwrap());
    assert!(matches!(library.finish(&lease, result).await, Err(LibraryError::LeaseLost)));
    assert!(bed.blobs(&library).await.is_empty() && !library.delete(lease.photo.id, None).await.unwrap());
}

async fn a_check_takes_a_damaged_photo_out_of_service(bed: Bed) {
    let library = bed.node().await;
    let (good, bad) = (done(&library, 1, owner("a")).await, done(&library, 2, owner("b")).await);
    std::fs::remove_file(library.blobs().path(bad.blob(Part::Container).unwrap()).unwrap()).unwrap();
    assert_eq!(library.verify_next(Duration::from_hours(1)).await.unwrap(), None, "they have just been written");
    bed.jump(1000 * 3600 * 2);
    let mut checked = BTreeSet::new();
    while let Some(photo) = library.verify_next(Duration::from_hours(1)).await.unwrap() {
        assert!(checked.insert(photo.id), "each is checked once");
    }
    assert_eq!(checked, BTreeSet::from([good.id, bad.id]));
    assert_eq!(library.get(good.id).await.unwrap().state, PhotoState::Done);
    let bad = library.get(bad.id).await.unwrap();
    assert_eq!(bad.state, PhotoState::Damaged);
    assert!(bad.problem.unwrap().detail.starts_with("container is damaged: it is missing"));
}

async fn waiting_workers_are_notified_of_a_job(bed: Bed) {
    let nodes = bed.two_nodes(Limits::default()).await;
    let work = |node: Library, _| async move {
        let lease = node.next(&[JobKind::Make], LEASE, std::future::pending()).await.unwrap().unwrap();
        node.finish(&lease, made(&node, &lease).await).await.unwrap().id
    };
    let accept = async {
        let mut ids = BTreeSet::new();
        for n in 0..3 {
            ids.insert(nodes[0].accept(photo(n)).await.unwrap().photo.id);
        }
        ids
    };
    let (finished, accepted) = tokio::join!(at_once(&nodes[1..], 3, work), accept);
    assert_eq!(BTreeSet::from_iter(finished), accepted);
}
