use super::*;

on_both! {
    a_repeated_upload_is_known,
    one_of_two_simultaneous_uploads_is_new,
    a_repeated_upload_retries_failed_photos_and_heals_damaged_ones,
    a_remade_photo_keeps_its_results_until_it_is_done,
    the_quota_of_photos_is_never_exceeded,
    the_quota_of_bytes_is_never_exceeded,
    a_full_queue_and_a_greedy_owner_are_refused,
    a_settings_change_needs_the_version_it_saw,
}

async fn a_repeated_upload_is_known(bed: Bed) {
    let library = bed.node().await;
    let first = library.accept(upload(1, owner("ann"))).await.unwrap();
    assert_eq!((first.outcome, first.photo.state, first.photo.bytes), (Outcome::New, PhotoState::Queued, 7));
    assert_eq!(first.photo.title(), Some("Photo 1"));
    assert_eq!(library.accept(upload(1, owner("ann"))).await.unwrap().outcome, Outcome::Known);
    let photo = make_next(&library).await;
    assert_eq!((photo.state, photo.details.clone().unwrap()["width"].as_i64()), (PhotoState::Done, Some(640)));
    assert_eq!(library.accept(upload(1, owner("ann"))).await.unwrap().outcome, Outcome::Known);
    // the same photo, at the head of the list
    let again = library.get(photo.id).await.unwrap();
    assert!(again.listed_at > again.accepted_at || again.listed_at == photo.listed_at);
    assert_eq!(Photo { listed_at: photo.listed_at, ..again }, photo);
    let container = library.blobs().read(Part::Container, photo.blob(Part::Container).unwrap()).await.unwrap();
    assert_eq!(container, "made of photo 1");
    assert_eq!(library.blobs().read_range(photo.blob(Part::Container).unwrap(), 8..13).await.unwrap(), "photo");
    assert_eq!(bed.blobs(&library).await.len(), 3);
}

async fn one_of_two_simultaneous_uploads_is_new(bed: Bed) {
    let nodes = bed.two_nodes(Limits::default()).await;
    let outcomes = at_once(&nodes, 16, |node, _| async move { node.accept(photo(1)).await.unwrap().outcome }).await;
    assert_eq!(outcomes.into_iter().filter(|outcome| *outcome == Outcome::New).count(), 1);
    assert_eq!(bed.blobs(&nodes[0]).await.len(), 1, "blobs of concurrent uploads are deleted");
    make_next(&nodes[1]).await;
    assert!(nodes[0].take(&JobKind::ALL, LEASE).await.unwrap().is_none());
}

async fn a_repeated_upload_retries_failed_photos_and_heals_damaged_ones(bed: Bed) {
    let library = bed.node().await;
    library.accept(photo(1)).await.unwrap();
    let lease = library.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
    let problem = Problem::new("lost", "the upload is damaged");
    library.fail(&lease, &problem).await.unwrap();
    assert_eq!(library.get(lease.photo.id).await.unwrap().problem, Some(problem));
    assert_eq!(library.accept(photo(1)).await.unwrap().outcome, Outcome::Retried);
    let photo_done = make_next(&library).await;
    assert_eq!(bed.blobs(&library).await.len(), 3, "the previous upload is deleted");
    // the damage is not marked yet
    let container = library.blobs().path(photo_done.blob(Part::Container).unwrap()).unwrap();
    std::fs::write(&container, b"made of photo 2").unwrap();
    assert_eq!(library.accept(photo(1)).await.unwrap().outcome, Outcome::Healed);
    let healed = make_next(&library).await;
    assert_eq!((healed.state, healed.version), (PhotoState::Done, 3));
    assert!(library.verify(&healed).await.unwrap().is_empty() && !container.exists());
    // now it is
    assert!(library.mark_damaged(&healed, "container is damaged").await.unwrap());
    assert!(!library.mark_damaged(&healed, "once more").await.unwrap());
    assert_eq!(library.accept(photo(1)).await.unwrap().outcome, Outcome::Healed);
}

async fn a_remade_photo_keeps_its_results_until_it_is_done(bed: Bed) {
    let library = bed.node().await;
    let before = done(&library, 1, owner("ann")).await;
    let strokes = || Content::of_bytes(b"[]".as_slice());
    let again = library.touch_up(&before, strokes(), &owner("ann")).await.unwrap();
    assert_eq!((again.state, again.version), (PhotoState::Queued, 2));
    assert!(again.blobs.contains_key(&Part::Strokes) && again.blobs[&Part::Container] == before.blobs[&Part::Container]);
    assert!(matches!(library.touch_up(&before, strokes(), &owner("ann")).await, Err(LibraryError::NotReady)));
    let after = make_next(&library).await;
    assert_ne!(after.blobs[&Part::Container].name, before.blobs[&Part::Container].name);
    assert!(matches!(library.remake(&before, Class::Batch, &owner("ann")).await, Err(LibraryError::Changed)), "an older version");
    assert_eq!(bed.blobs(&library).await.len(), 4);
    library.remake(&after, Class::Batch, &owner("ann")).await.unwrap();
    assert_eq!(make_next(&library).await.version, 3);
}

/// Number of accepted uploads out of 16 concurrent ones at two nodes.
async fn taken(bed: &Bed, limits: Limits) -> usize {
    let nodes = bed.two_nodes(limits).await;
    let uploads = at_once(&nodes, 16, |node, n| async move { node.accept(upload(10 + n, owner("ann"))).await }).await;
    let is_taken = |upload: &Result<Accepted>| match upload {
        Ok(_) => true,
        Err(LibraryError::QuotaExceeded { .. }) => false,
        Err(error) => panic!("{error}"),
    };
    let taken = uploads.into_iter().filter(is_taken).count();
    assert_eq!(bed.blobs(&nodes[0]).await.len(), taken, "what is refused is deleted");
    nodes[0].accept(upload(99, owner("bob"))).await.unwrap();
    let mut local = upload(98, Requester { owner: Some(Owner::local_user()), ..Requester::default() });
    local.id = PhotoId::from_bytes([9; 16]);
    nodes[0].accept(local).await.unwrap();
    taken
}

async fn the_quota_of_photos_is_never_exceeded(bed: Bed) {
    assert_eq!(taken(&bed, Limits { quota_photos: Some(5), ..Limits::default() }).await, 5);
}

async fn the_quota_of_bytes_is_never_exceeded(bed: Bed) {
    // each has 8 bytes
    assert_eq!(taken(&bed, Limits { quota_bytes: Some(47), ..Limits::default() }).await, 5);
}

async fn a_full_queue_and_a_greedy_owner_are_refused(bed: Bed) {
    let library = bed.node_with(Limits { queue: 4, ..Limits::default() }).await;
    let share = |answer: Result<Accepted>| match answer {
        Err(LibraryError::QueueFull { share, retry_after, .. }) => {
            assert!((1..=120).contains(&retry_after.as_secs()), "{retry_after:?}");
            Some(share)
        }
        answer => answer.map(|_| None).unwrap(),
    };
    let mut answers = Vec::new();
    for (n, requester) in
        [owner("ann"), owner("ann"), owner("ann"), address("192.0.2.1"), address("192.0.2.1"), address("192.0.2.1")].into_iter().enumerate()
    {
        answers.push(share(library.accept(upload(n as u32, requester)).await));
    }
    assert_eq!(answers, [None, None, Some(QueueLimit::Owner), None, None, Some(QueueLimit::All)]);
    make_next(&library).await;
    assert_eq!(share(library.accept(upload(7, address("192.0.2.1"))).await), Some(QueueLimit::Address));
    assert_eq!(share(library.accept(upload(7, owner("bob"))).await), None);
    assert_eq!(bed.blobs(&library).await.len(), 5 + 2, "what is refused is deleted");
}

async fn a_settings_change_needs_the_version_it_saw(bed: Bed) {
    let library = bed.node().await;
    let seen = library.accept(photo(1)).await.unwrap().photo;
    let changed = library.set_settings(&seen, &json!({"title": "Attic"})).await.unwrap();
    assert_eq!((changed.title(), changed.settings_version), (Some("Attic"), 2));
    assert!(matches!(library.set_settings(&seen, &json!({})).await, Err(LibraryError::Changed)));
    assert_eq!(library.get(seen.id).await.unwrap(), changed);
    library.delete(seen.id, None).await.unwrap();
    assert!(matches!(library.set_settings(&changed, &json!({})).await, Err(LibraryError::NotFound(_))));
}
