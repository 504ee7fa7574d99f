use super::lossy_disk::LossyDisk;
use super::*;

on_both! {
    gc_deletes_blobs_without_references_after_a_day,
    fsck_finds_missing_truncated_and_changed_blobs,
    blobs_of_a_folder_that_is_away_are_not_damaged,
    a_store_of_another_library_is_refused,
    of_nodes_with_different_stores_that_start_at_once_one_is_refused,
    garbage_collection_runs_once_a_day_on_one_node,
}

async fn gc_deletes_blobs_without_references_after_a_day(bed: Bed) {
    let library = bed.node().await;
    let photo = done(&library, 1, owner("ann")).await;
    order(&library, &photo, JobKind::Film, "a", &owner("ann")).await.unwrap();
    write_next(&library, b"film").await;
    let orphan = |n: u8| Contents::from([(Part::Upload, Content::of_bytes(vec![n; 9]))]);
    let old = library.blobs().store(photo.id, orphan(1)).await.unwrap().remove(&Part::Upload).unwrap();
    library.blobs().store(PhotoId::from_bytes([0; 16]), orphan(2)).await.unwrap();
    let long_ago = std::time::SystemTime::now() - Duration::from_hours(25);
    let file = std::fs::File::options().write(true).open(library.blobs().path(&old).unwrap()).unwrap();
    file.set_modified(long_ago).unwrap();
    assert_eq!(library.gc().await.unwrap(), Collected { blobs: 1, bytes: 9 });
    assert_eq!(bed.blobs(&library).await.len(), 3 + 1 + 1);
    assert_eq!(library.gc_older_than(Duration::ZERO).await.unwrap(), Collected { blobs: 1, bytes: 9 });
    assert!(library.verify(&library.get(photo.id).await.unwrap()).await.unwrap().is_empty());
    assert_eq!(library.fsck().await.unwrap(), []);
}

async fn fsck_finds_missing_truncated_and_changed_blobs(bed: Bed) {
    let library = bed.node().await;
    let mut photos = Vec::new();
    for n in 0..4 {
        photos.push(done(&library, n, owner(&n.to_string())).await);
    }
    let path = |n: usize, part| library.blobs().path(photos[n].blob(part).unwrap()).unwrap();
    std::fs::remove_file(path(0, Part::Container)).unwrap();
    std::fs::write(path(1, Part::Report), b"").unwrap();
    std::fs::write(path(2, Part::Container), b"made of photo x").unwrap();
    std::fs::remove_file(path(3, Part::Upload)).unwrap();
    let mut found = library.fsck().await.unwrap();
    found.sort_by_key(|damage| photos.iter().position(|photo| photo.id == damage.photo));
    let told: Vec<String> = found.iter().map(ToString::to_string).collect();
    assert_eq!(
        told,
        [
            "container is damaged: it is missing",
            "report is damaged: it has 0 bytes, and 2 were written",
            "container is damaged: it is not what was written",
            "upload is damaged: it is missing"
        ]
    );
    let mut states = Vec::new();
    for photo in &photos {
        states.push(library.get(photo.id).await.unwrap().state);
    }
    assert_eq!(states, [PhotoState::Damaged, PhotoState::Damaged, PhotoState::Damaged, PhotoState::Done], "it can be served");
}

async fn blobs_of_a_folder_that_is_away_are_not_damaged(bed: Bed) {
    let library = bed.node().await;
    let made = done(&library, 1, owner("ann")).await;
    let (blobs, away) = (bed.path().join("blobs"), bed.path().join("away"));
    std::fs::rename(&blobs, &away).unwrap();
    // a mount point without its disk
    std::fs::create_dir(&blobs).unwrap();
    let told = library.fsck().await;
    assert!(matches!(told, Err(LibraryError::Unavailable { service: Service::Blobs, .. })), "{told:?}");
    assert_eq!(library.get(made.id).await.unwrap().state, PhotoState::Done);
    std::fs::remove_dir(&blobs).unwrap();
    std::fs::rename(&away, &blobs).unwrap();
    assert_eq!(library.fsck().await.unwrap(), []);
}

#[tokio::test]
async fn an_uploaded_file_is_moved_not_copied() {
    let bed = Bed::sqlite();
    let library = bed.node().await;
    let path = library.incoming().join("upload");
    std::fs::write(&path, bytes(1)).unwrap();
    let content = Content::of_file(path.clone(), 7, Digest::of(&bytes(1)));
    let accepted = library.accept(Upload { photo: content, ..photo(1) }).await.unwrap().photo;
    assert!(!path.exists() && library.verify(&accepted).await.unwrap().is_empty());
}

#[tokio::test(flavor = "multi_thread")]
async fn photos_live_and_die_in_an_object_store() {
    let Some(engine) = tokio::task::spawn_blocking(tmpi_testing::Engine::s3).await.unwrap() else { return };
    let bed = Bed::sqlite();
    let library = bed.node_of(BlobStore::s3_at(engine.addr), Limits::default()).await;
    library.check().await.unwrap();
    let photo = done(&library, 1, owner("ann")).await;
    assert!(library.verify(&photo).await.unwrap().is_empty());
    let container = photo.blob(Part::Container).unwrap();
    assert_eq!(library.blobs().read_range(container, 8..13).await.unwrap(), "photo");
    assert!(library.blobs().read_range(container, 99..200).await.unwrap().is_empty() && library.blobs().path(container).is_none());
    library.blobs().store(photo.id, Contents::from([(Part::Report, Content::of_bytes(b"x".as_slice()))])).await.unwrap();
    assert_eq!(library.gc().await.unwrap(), Collected::default(), "not yet a day old");
    assert_eq!(library.gc_older_than(Duration::ZERO).await.unwrap(), Collected { blobs: 1, bytes: 1 });
    library.blobs().delete(&container.name).await.unwrap();
    assert_eq!(library.fsck().await.unwrap()[0].to_string(), "container is damaged: it is missing");
    library.delete(photo.id, None).await.unwrap();
    assert!(bed.blobs(&library).await.is_empty());
    drop(engine);
    let away = library.accept(super::photo(2)).await;
    assert!(matches!(away, Err(LibraryError::Unavailable { service: Service::Blobs, .. })), "{away:?}");
    let unread = library.blobs().read_range(container, 8..13).await;
    assert!(matches!(unread, Err(LibraryError::Unavailable { service: Service::Blobs, .. })), "{unread:?}");
}

async fn a_store_of_another_library_is_refused(bed: Bed) {
    let library = bed.node().await;
    let refusal = async |bed: &Bed, blobs: &std::path::Path| {
        let blobs = BlobStore::folder(blobs, Reserve::default()).unwrap();
        bed.try_node_of(blobs, Limits::default()).await.unwrap_err().to_string()
    };
    let (other, own) = (Bed::sqlite(), bed.path().join("blobs"));
    assert!(refusal(&other, &own).await.contains("another library"), "its gc would delete this one's blobs");
    other.node().await;
    let empty = other.path().join("empty");
    assert!(refusal(&bed, &empty).await.contains("the same --blobs"), "some of the photos would be in either");
    done(&library, 1, owner("ann")).await;
    assert!(refusal(&bed, &empty).await.contains("the same --blobs"), "its photos would be missing");
    bed.node().await;
}

async fn of_nodes_with_different_stores_that_start_at_once_one_is_refused(bed: Bed) {
    let bed = Arc::new(bed);
    let open = |name: &'static str| {
        let bed = Arc::clone(&bed);
        tokio::spawn(async move {
            let blobs = BlobStore::folder(&bed.path().join(name), Reserve::default()).unwrap();
            Box::pin(bed.try_node_of(blobs, Limits::default())).await.err().map(|error| error.to_string())
        })
    };
    let [one, other] = [open("one"), open("other")];
    let refused: Vec<String> = [one.await.unwrap(), other.await.unwrap()].into_iter().flatten().collect();
    assert!(matches!(refused.as_slice(), [told] if told.contains("the same --blobs")), "{refused:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn of_two_libraries_that_claim_a_new_store_at_once_at_most_one_gets_it() {
    for round in 0..100 {
        let store = BlobStore::folder_of(Arc::new(LossyDisk::default()), Path::new("/blobs")).unwrap();
        let claim = |id: &'static str| {
            let store = store.clone();
            tokio::spawn(async move { store.claim(id).await.unwrap() })
        };
        let [one, other] = [claim("one"), claim("other")];
        let got = [one.await.unwrap(), other.await.unwrap()];
        assert_ne!(got, [true, true], "in round {round}");
        // if the store refused both, the next claim gets it
        let is_free = got == [false, false];
        assert_eq!((store.claim("one").await.unwrap(), store.claim("other").await.unwrap()), (got[0] || is_free, got[1]));
    }
}

async fn garbage_collection_runs_once_a_day_on_one_node(bed: Bed) {
    let (one, other) = (bed.node().await, bed.node().await);
    assert_eq!(one.gc_if_due().await.unwrap(), Some(Collected::default()));
    assert_eq!((one.gc_if_due().await.unwrap(), other.gc_if_due().await.unwrap()), (None, None));
    bed.jump(1000 * 3600 * 25);
    assert_eq!(other.gc_if_due().await.unwrap(), Some(Collected::default()));
}
