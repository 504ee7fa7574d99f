use std::collections::BTreeSet;

use super::*;

on_both! {
    pages_are_newest_first_of_one_owner_or_all,
    pages_stay_in_place_while_photos_come_and_go,
    deleting_leaves_neither_rows_nor_blobs,
    revoking_links_ends_earlier_ones,
    statistics_count_all,
    a_recent_row_follows_every_change,
}

/// All pages of a list.
async fn all(library: &Library, owner: Option<&Owner>, limit: usize) -> Vec<Photo> {
    let (mut photos, mut after) = (Vec::new(), None);
    loop {
        let page = library.list(owner, after, limit).await.unwrap();
        assert!(page.photos.len() == limit || page.next.is_none());
        photos.extend(page.photos);
        after = match page.next {
            // as in a URL
            Some(next) => Some(next.to_string().parse().unwrap()),
            None => return photos,
        };
    }
}

async fn pages_are_newest_first_of_one_owner_or_all(bed: Bed) {
    let library = bed.node().await;
    for n in 0..20 {
        library.accept(upload(n, owner(if n % 3 == 0 { "ann" } else { "bob" }))).await.unwrap();
    }
    let [ann, eve] = ["ann", "eve"].map(|name| owner(name).owner);
    for limit in [1, 3, 7, 100] {
        let photos = all(&library, None, limit).await;
        assert!(photos.len() == 20 && photos.windows(2).all(|two| (two[0].listed_at, two[0].id) > (two[1].listed_at, two[1].id)));
        let theirs: Vec<_> = photos.iter().filter(|photo| photo.owner == ann).cloned().collect();
        assert_eq!(all(&library, ann.as_ref(), limit).await, theirs, "{limit}");
        assert_eq!(theirs.len(), 7);
    }
    assert_eq!(all(&library, eve.as_ref(), 9).await, []);
    // a photo that is uploaded again comes first, but keeps its age
    let before = all(&library, None, 100).await.into_iter().find(|photo| photo.title() == Some("Photo 0")).unwrap();
    let again = library.accept(upload(0, owner("ann"))).await.unwrap().photo;
    assert_eq!((again.id, again.accepted_at), (before.id, before.accepted_at));
    assert_eq!(all(&library, None, 7).await[0].listed_at, again.listed_at);
}

async fn pages_stay_in_place_while_photos_come_and_go(bed: Bed) {
    let library = bed.node_with(Limits { queue: 1000, ..Limits::default() }).await;
    let mut there = BTreeSet::new();
    for n in 0..60 {
        there.insert(library.accept(photo(n)).await.unwrap().photo.id);
    }
    let (mut seen, mut after, mut n) = (Vec::new(), None, 100);
    loop {
        let page = library.list(None, after, 7).await.unwrap();
        seen.extend(page.photos.iter().map(|photo| photo.id));
        let Some(next) = page.next else { break };
        after = Some(next);
        library.accept(photo(n)).await.unwrap();
        // including the one after which the next page begins
        let gone = page.photos.last().unwrap().id;
        library.delete(gone, None).await.unwrap();
        n += 1;
    }
    assert_eq!(seen.len(), 60);
    assert_eq!(seen.into_iter().collect::<BTreeSet<_>>(), there, "each once, and none that came later");
}

async fn deleting_leaves_neither_rows_nor_blobs(bed: Bed) {
    let library = bed.node().await;
    let photo = done(&library, 1, owner("ann")).await;
    for key in ["a", "b"] {
        order(&library, &photo, JobKind::Export, key, &owner("ann")).await.unwrap();
    }
    write_next(&library, b"file").await;
    let late = library.take(&[JobKind::Export], LEASE).await.unwrap().unwrap();
    assert_eq!(bed.blobs(&library).await.len(), 4);
    assert!(library.delete(photo.id, None).await.unwrap());
    assert!(bed.blobs(&library).await.is_empty());
    assert!(matches!(library.get(photo.id).await, Err(LibraryError::NotFound("photo"))));
    assert!(matches!(library.job(JobKind::Export, photo.id, Some("a")).await, Err(LibraryError::NotFound("job"))));
    assert!(matches!(library.finish_export(&late, Content::of_bytes(b"file".as_slice())).await, Err(LibraryError::LeaseLost)));
    assert!(bed.blobs(&library).await.is_empty());
    assert_eq!(library.accept(upload(1, owner("ann"))).await.unwrap().outcome, Outcome::New);
}

async fn revoking_links_ends_earlier_ones(bed: Bed) {
    let library = bed.node().await;
    let before = library.accept(upload(1, owner("ann"))).await.unwrap().photo;
    let secret = bed.node().await.secret().clone();
    let link = secret.sign(Grant::View, Subject::Photo(&before), u64::MAX);
    let allows = |grant, photo: &Photo| library.secret().allows(grant, Subject::Photo(photo), &link, photo.accepted_at);
    assert!(allows(Grant::View, &before) && !allows(Grant::Edit, &before), "by any node");
    library.revoke_links(before.id).await.unwrap();
    let after = library.get(before.id).await.unwrap();
    assert!(!allows(Grant::View, &after));
    library.delete(before.id, None).await.unwrap();
    bed.jump(1);
    let again = library.accept(upload(1, owner("ann"))).await.unwrap().photo;
    assert!(!allows(Grant::View, &again), "another upload of it");
    assert!(matches!(library.revoke_links(PhotoId::from_bytes([0; 16])).await, Err(LibraryError::NotFound(_))));
}

async fn a_recent_row_follows_every_change(bed: Bed) {
    let library = bed.node().await;
    let id = library.accept(photo(1)).await.unwrap().photo.id;
    let followed = async |what: &str| {
        // the second time from memory, if it is kept
        for _ in 0..2 {
            assert_eq!(library.find_recent(id).await.unwrap(), library.find(id).await.unwrap(), "{what}");
        }
    };
    followed("accepted").await;
    let lease = library.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
    followed("taken").await;
    let made = library.finish(&lease, made(&library, &lease).await).await.unwrap();
    followed("made").await;
    library.set_settings(&made, &json!({"title": "Another"})).await.unwrap();
    followed("renamed").await;
    library.revoke_links(id).await.unwrap();
    followed("links revoked").await;
    bed.jump(1);
    library.move_to_front(id).await.unwrap();
    followed("moved to the front").await;
    library.mark_damaged(&made, "a test").await.unwrap();
    followed("damaged").await;
    // by another process, a moment later
    bed.node().await.revoke_links(id).await.unwrap();
    let shown = async {
        while library.find_recent(id).await.unwrap() != library.find(id).await.unwrap() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(Duration::from_secs(10), shown).await.expect("a change by another process shows");
    library.delete(id, None).await.unwrap();
    followed("deleted").await;
}

async fn statistics_count_all(bed: Bed) {
    let library = bed.node().await;
    let bytes: u64 = [done(&library, 1, owner("a")).await.bytes, done(&library, 2, owner("b")).await.bytes].iter().sum();
    library.accept(photo(3)).await.unwrap();
    library.accept(Upload { class: Class::Batch, ..photo(4) }).await.unwrap();
    let lease = library.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
    bed.jump(5_000);
    library.0.clock.lock().unwrap().take();
    let statistics = library.statistics().await.unwrap();
    let photos = [(PhotoState::Queued, 1), (PhotoState::Working, 1), (PhotoState::Done, 2)];
    assert_eq!(statistics.photos.into_iter().collect::<Vec<_>>(), photos);
    assert_eq!(statistics.bytes, bytes + 14);
    assert_eq!(statistics.waiting.into_iter().collect::<Vec<_>>(), [((JobKind::Make, Class::Batch), 1)]);
    assert_eq!(statistics.working[&JobKind::Make], 1);
    assert!(statistics.longest_wait >= Duration::from_secs(5), "{:?}", statistics.longest_wait);
    drop(lease);
}
