use super::*;

/// A day in milliseconds.
const DAY: i64 = 86_400_000;

on_both! {
    photos_expire_by_age_but_not_by_a_clock_that_jumps,
    the_least_recently_viewed_photos_are_deleted_for_space,
    exports_and_sessions_expire,
}

async fn photos_expire_by_age_but_not_by_a_clock_that_jumps(bed: Bed) {
    let limits = Limits { retain: Some(Duration::from_hours(47)), ..Limits::default() };
    let library = bed.node_with(limits.clone()).await;
    let old = done(&library, 1, owner("a")).await;
    bed.jump(DAY);
    let young = done(&library, 2, owner("b")).await;
    let waits = library.accept(photo(3)).await.unwrap().photo;
    assert_eq!(library.ends_at(old.accepted_at), Some(old.accepted_at + DAY / 24 * 47));
    // a new process trusts its clock if the newest photo is less than a day old
    bed.jump(DAY - 60_000);
    let swept = bed.node_with(limits.clone()).await.sweep().await.unwrap();
    assert_eq!((swept.by_age, swept.bytes), (1, old.bytes));
    assert!(library.find(old.id).await.unwrap().is_none());
    let swept = library.sweep().await.unwrap();
    bed.jump(400 * DAY);
    assert_eq!((swept, library.sweep().await.unwrap()), (Swept::default(), Swept::default()), "a year ahead from one sweep to the next");
    assert_eq!(bed.node_with(limits).await.sweep().await.unwrap(), Swept::default(), "and for a new process");
    for id in [young.id, waits.id] {
        assert!(library.find(id).await.unwrap().is_some());
    }
}

async fn the_least_recently_viewed_photos_are_deleted_for_space(bed: Bed) {
    let library = bed.node().await;
    let mut photos = Vec::new();
    for n in 0..5 {
        photos.push(done(&library, n, owner(&n.to_string())).await);
        bed.jump(1_000);
    }
    library.accept(photo(9)).await.unwrap();
    let all: u64 = photos.iter().map(|photo| photo.bytes).sum::<u64>() + 7;
    // space for all but one, less a byte
    let limits = Limits { retain_bytes: Some(all - photos[0].bytes - 1), ..Limits::default() };
    let sweeper = bed.node_with(limits).await;
    sweeper.note_view(photos[0].id);
    let swept = sweeper.sweep().await.unwrap();
    assert_eq!((swept.by_space, swept.bytes), (2, photos[1].bytes + photos[2].bytes));
    let left: Vec<_> = library.list(&Filter::default(), None, 9).await.unwrap().photos.iter().map(|photo| photo.id).collect();
    assert!(left.contains(&photos[0].id) && !left.contains(&photos[1].id) && left.len() == 4);
    assert_eq!(sweeper.sweep().await.unwrap(), Swept::default());
}

async fn exports_and_sessions_expire(bed: Bed) {
    let library = bed.node_with(Limits { exports_for: Duration::from_hours(1), ..Limits::default() }).await;
    let photo = done(&library, 1, owner("ann")).await;
    let (requester, ann) = (owner("ann"), owner("ann").owner.unwrap());
    for key in ["a", "b"] {
        let order =
            NewExport { photo: &photo, key, kind: JobKind::Film, payload: json!({}), class: Class::Interactive, requester: &requester };
        library.order_export(&order).await.unwrap();
        let lease = library.take(&[JobKind::Film], LEASE).await.unwrap().unwrap();
        library.finish_export(&lease, Content::of_bytes(b"film".as_slice())).await.unwrap();
    }
    library.open_session(&ann, None, Duration::from_mins(1)).await.unwrap();
    assert_eq!(library.sweep().await.unwrap(), Swept::default());
    bed.jump(DAY / 48);
    library.note_export_fetch(&library.job(JobKind::Film, photo.id, Some("a")).await.unwrap()).await.unwrap();
    bed.jump(DAY / 48);
    assert_eq!(library.sweep().await.unwrap(), Swept { exports: 1, ..Swept::default() });
    assert!(
        library.job(JobKind::Film, photo.id, Some("a")).await.is_ok() && library.job(JobKind::Film, photo.id, Some("b")).await.is_err()
    );
    assert_eq!(bed.blobs(&library).await.len(), 4);
    let left = sqlx::query("SELECT hash FROM sessions").fetch_all(library.database().reader()).await;
    assert_eq!(left.unwrap().len(), 0);
}
