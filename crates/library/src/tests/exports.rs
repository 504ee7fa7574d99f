use super::*;

on_both! {
    an_export_is_written_once_and_kept,
    exports_of_the_previous_version_are_deleted,
    a_failed_export_can_be_ordered_again,
    exports_have_their_own_queue_and_disk_limits,
}

async fn an_export_is_written_once_and_kept(bed: Bed) {
    let (library, other) = (bed.node().await, bed.node().await);
    let photo = done(&library, 1, owner("ann")).await;
    let (ann, bob) = (owner("ann"), owner("bob"));
    let (one, two) =
        tokio::join!(order(&library, &photo, JobKind::Export, "zip", &ann), order(&other, &photo, JobKind::Export, "zip", &bob));
    assert_eq!(u8::from(one.unwrap().new) + u8::from(two.unwrap().new), 1);
    let written = write_next(&other, b"file").await;
    assert_eq!((written.key(), written.payload["format"].as_str()), (Some("zip"), Some("zip")));
    assert!(library.take(&[JobKind::Export], LEASE).await.unwrap().is_none());
    let there = order(&library, &photo, JobKind::Export, "zip", &owner("ann")).await.unwrap();
    assert!(!there.new && there.job.state == JobState::Done);
    let file = library.blobs().read(Part::Export, there.job.result.as_ref().unwrap()).await.unwrap();
    assert_eq!(file, "file");
    assert!(library.cancel_export(photo.id, "zip").await.unwrap() && !library.cancel_export(photo.id, "zip").await.unwrap());
    assert_eq!(bed.blobs(&library).await.len(), 3);
}

async fn exports_of_the_previous_version_are_deleted(bed: Bed) {
    let library = bed.node().await;
    let before = done(&library, 1, owner("ann")).await;
    order(&library, &before, JobKind::Export, "zip", &owner("ann")).await.unwrap();
    write_next(&library, b"file").await;
    order(&library, &before, JobKind::Export, "glb", &owner("ann")).await.unwrap();
    let late = library.take(&[JobKind::Export], LEASE).await.unwrap().unwrap();
    let queued = library.remake(&before, Class::Interactive, &owner("ann")).await.unwrap();
    assert!(matches!(order(&library, &queued, JobKind::Export, "html", &owner("ann")).await, Err(LibraryError::NotReady)));
    let after = make_next(&library).await;
    assert!(matches!(library.renew(&late, None).await, Err(LibraryError::LeaseLost)));
    assert!(matches!(library.job(JobKind::Export, before.id, Some("zip")).await, Err(LibraryError::NotFound(_))));
    assert_eq!(bed.blobs(&library).await.len(), 3, "its file is deleted");
    assert!(matches!(order(&library, &before, JobKind::Export, "zip", &owner("ann")).await, Err(LibraryError::Changed)));
    assert!(order(&library, &after, JobKind::Export, "zip", &owner("ann")).await.unwrap().new);
}

async fn a_failed_export_can_be_ordered_again(bed: Bed) {
    let library = bed.node_with(Limits { attempts: 1, ..Limits::default() }).await;
    let photo = done(&library, 1, owner("ann")).await;
    order(&library, &photo, JobKind::Export, "zip", &owner("ann")).await.unwrap();
    let lease = library.take(&[JobKind::Export], LEASE).await.unwrap().unwrap();
    library.retry(&lease, &Retry::Died("signal 9".into())).await.unwrap();
    let failed = library.job(JobKind::Export, photo.id, Some("zip")).await.unwrap();
    assert_eq!((failed.state, failed.problem.unwrap().kind.as_str()), (JobState::Failed, "gave-up"));
    assert_eq!(library.get(photo.id).await.unwrap().state, PhotoState::Done, "the photo is not at fault");
    assert!(order(&library, &photo, JobKind::Export, "zip", &owner("ann")).await.unwrap().new);
    assert_eq!(write_next(&library, b"file").await.attempts, 0);
}

async fn exports_have_their_own_queue_and_disk_limits(bed: Bed) {
    let library = bed.node_with(Limits { exports: 4, exports_bytes: 10, ..Limits::default() }).await;
    let photo = done(&library, 1, owner("ann")).await;
    for (key, is_taken) in [("a", true), ("b", true), ("c", false)] {
        assert_eq!(order(&library, &photo, JobKind::Export, key, &owner("ann")).await.is_ok(), is_taken, "half of the places: {key}");
    }
    let lease = library.take(&[JobKind::Export], LEASE).await.unwrap().unwrap();
    assert!(matches!(library.finish_export(&lease, Content::of_bytes(vec![0; 11])).await, Err(LibraryError::Invalid(_))));
    library.finish_export(&lease, Content::of_bytes(vec![0; 4])).await.unwrap();
    bed.jump(10);
    write_next(&library, &[1; 4]).await;
    // within a minute of its writing a fetch would not count
    bed.jump(60_000);
    let a = library.job(JobKind::Export, photo.id, Some("a")).await.unwrap();
    library.note_export_fetch(&a).await.unwrap();
    order(&library, &photo, JobKind::Export, "c", &owner("ann")).await.unwrap();
    bed.jump(10);
    write_next(&library, &[2; 4]).await;
    let mut there = String::new();
    for key in ["a", "b", "c"] {
        if library.job(JobKind::Export, photo.id, Some(key)).await.is_ok() {
            there.push_str(key);
        }
    }
    assert_eq!(there, "ac", "the least recently fetched one makes room");
    assert_eq!(bed.blobs(&library).await.len(), 3 + 2);
}
