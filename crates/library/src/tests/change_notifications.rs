use super::*;

on_both! {
    events_follow_a_photo_from_acceptance_to_completion,
}

/// The next event about a photo.
async fn next(events: &mut Subscription) -> Event {
    tokio::time::timeout(Duration::from_secs(30), events.next()).await.unwrap().unwrap()
}

async fn events_follow_a_photo_from_acceptance_to_completion(bed: Bed) {
    let worker = bed.node().await;
    // with PostgreSQL another node receives all events
    let node = if bed.url.is_some() { bed.node().await } else { worker.clone() };
    let mut events = node.subscribe();
    let id = worker.accept(photo(1)).await.unwrap().photo.id;
    assert_eq!(next(&mut events).await, Event::Photo(id));
    let lease = worker.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
    assert_eq!(next(&mut events).await, Event::Photo(id));
    let progress = json!({"stage": "depth", "step": 2});
    worker.send_progress(&lease, progress.clone()).await.unwrap();
    assert_eq!(next(&mut events).await, Event::Progress { photo: id, progress: progress.clone() });
    assert_eq!(node.progress_of(id), Some(progress.clone()), "new followers get the last progress");
    worker.renew(&lease, Some(&progress)).await.unwrap();
    assert_eq!(node.job(JobKind::Make, id, None).await.unwrap().progress, Some(progress));
    worker.finish(&lease, made(&worker, &lease).await).await.unwrap();
    assert_eq!(next(&mut events).await, Event::Photo(id));
    assert_eq!((node.progress_of(id), node.get(id).await.unwrap().state), (None, PhotoState::Done));
    worker.delete(id, None).await.unwrap();
    assert_eq!(next(&mut events).await, Event::Deleted(id));
}

#[tokio::test(flavor = "multi_thread")]
async fn after_a_lost_connection_events_resume_with_a_gap() {
    let Some(bed) = Bed::postgres() else { return };
    let (node, other) = (bed.node().await, bed.node().await);
    let mut events = node.subscribe();
    let cut = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = current_database() AND query LIKE 'LISTEN%'";
    sqlx::query(cut).execute(other.database().reader()).await.unwrap();
    assert_eq!(next(&mut events).await, Event::Gap);
    let id = other.accept(photo(1)).await.unwrap().photo.id;
    while next(&mut events).await != Event::Photo(id) {}
}
