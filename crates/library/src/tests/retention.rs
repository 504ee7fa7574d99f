use super::*;

/// A day in milliseconds.
const DAY: i64 = 86_400_000;

on_both! {
    photos_expire_by_age_but_not_by_a_clock_that_jumps,
    the_least_recently_viewed_photos_are_deleted_for_space,
    exports_expire,
}

async fn photos_expire_by_age_but_not_by_a_clock_that_jumps(bed: Bed) {
    const ALMOST_A_DAY: i64 = DAY - 60_000;
    let limits = Limits { retain: Some(Duration::from_hours(47)), ..Limits::default() };
    let library = bed.node_with(limits.clone()).await;
    let old = done(&library, 1, owner("a")).await;
    assert_eq!(library.ends_at(old.accepted_at), Some(old.accepted_at + DAY / 24 * 47));
    let expect = async |by_age, bytes, why: &str| {
        for expected in [Swept { by_age, bytes, ..Swept::default() }, Swept::default()] {
            // a new process knows what the ones before saw
            assert_eq!(bed.node_with(limits.clone()).await.sweep().await.unwrap(), expected, "{why}");
        }
    };
    expect(0, 0, "it is young").await;
    bed.jump(ALMOST_A_DAY);
    let young = done(&library, 2, owner("b")).await;
    let waits = library.accept(photo(3)).await.unwrap().photo;
    expect(0, 0, "it is a day old").await;
    bed.jump(ALMOST_A_DAY);
    expect(1, old.bytes, "it is almost two days old").await;
    assert!(library.find(old.id).await.unwrap().is_none());
    bed.jump(400 * DAY);
    expect(0, 0, "a year ahead from one sweep to the next").await;
    bed.jump(-400 * DAY);
    expect(0, 0, "corrected").await;
    bed.jump(ALMOST_A_DAY);
    expect(0, 0, "not trusted again yet").await;
    bed.jump(60_000);
    expect(1, young.bytes, "a day later").await;
    assert!(library.find(waits.id).await.unwrap().is_some());
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
    let left: Vec<_> = library.list(None, None, 9).await.unwrap().photos.iter().map(|photo| photo.id).collect();
    assert!(left.contains(&photos[0].id) && !left.contains(&photos[1].id) && left.len() == 4);
    assert_eq!(sweeper.sweep().await.unwrap(), Swept::default());
}

async fn exports_expire(bed: Bed) {
    let library = bed.node_with(Limits { exports_for: Duration::from_hours(1), ..Limits::default() }).await;
    let photo = done(&library, 1, owner("ann")).await;
    for key in ["a", "b"] {
        order(&library, &photo, JobKind::Film, key, &owner("ann")).await.unwrap();
        write_next(&library, b"film").await;
    }
    assert_eq!(library.sweep().await.unwrap(), Swept::default());
    bed.jump(DAY / 48);
    library.note_export_fetch(&library.job(JobKind::Film, photo.id, Some("a")).await.unwrap()).await.unwrap();
    bed.jump(DAY / 48);
    assert_eq!(library.sweep().await.unwrap(), Swept { exports: 1, ..Swept::default() });
    assert!(
        library.job(JobKind::Film, photo.id, Some("a")).await.is_ok() && library.job(JobKind::Film, photo.id, Some("b")).await.is_err()
    );
    assert_eq!(bed.blobs(&library).await.len(), 4);
}
