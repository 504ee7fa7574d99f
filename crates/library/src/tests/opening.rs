use super::*;

on_both! {
    nodes_that_open_simultaneously_create_one_schema,
    a_newer_schema_is_refused,
    a_transaction_that_the_database_ended_does_not_prevent_the_next,
}

async fn nodes_that_open_simultaneously_create_one_schema(bed: Bed) {
    let bed = Arc::new(bed);
    let opened: Vec<_> = (0..6)
        .map(|_| {
            let bed = Arc::clone(&bed);
            tokio::spawn(async move { bed.node().await })
        })
        .collect();
    let mut secrets = Vec::new();
    for node in opened {
        let node = node.await.unwrap();
        secrets.push(node.secret().sign(Grant::Relay, Subject::Room("attic"), 1).to_string());
        node.close().await;
    }
    secrets.dedup();
    assert_eq!(secrets.len(), 1, "and one secret");
    let library = bed.node().await;
    done(&library, 1, owner("ann")).await;
    library.close().await;
    assert_eq!(bed.node().await.list(None, None, 9).await.unwrap().photos.len(), 1, "opened again nothing is lost");
}

async fn a_newer_schema_is_refused(bed: Bed) {
    let library = bed.node().await;
    let mut tx = library.database().write().await.unwrap();
    sqlx::query("INSERT INTO migrations (version) VALUES (1000)").execute(tx.connection()).await.unwrap();
    tx.commit().await.unwrap();
    library.close().await;
    let again = match &bed.url {
        Some(url) => Database::postgres(url).await,
        None => Database::sqlite(&bed.path().join("library.db")).await,
    };
    assert!(matches!(again, Err(LibraryError::Invalid(told)) if told.contains("schema 1000")));
}

async fn a_transaction_that_the_database_ended_does_not_prevent_the_next(bed: Bed) {
    let library = bed.node().await;
    let mut tx = library.database().write().await.unwrap();
    // as SQLite does when a disk is full
    sqlx::raw_sql("ROLLBACK").execute(tx.connection()).await.unwrap();
    drop(tx);
    done(&library, 1, owner("ann")).await;
    assert_eq!(library.list(None, None, 9).await.unwrap().photos.len(), 1);
}

#[tokio::test]
async fn a_folder_opens_with_its_own_database_and_blobs() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("a folder?#%");
    let library = Library::open(Config::of_folder(&data)).await.unwrap();
    library.check().await.unwrap();
    library.accept(photo(1)).await.unwrap();
    assert!(data.join("library.db").exists() && data.join("blobs").is_dir());
    #[cfg(unix)]
    {
        let mode = std::fs::metadata(data.join("blobs")).unwrap();
        assert_eq!(std::os::unix::fs::PermissionsExt::mode(&mode.permissions()) & 0o777, 0o700);
    }
    library.close().await;
    assert!(matches!(library.get(PhotoId::from_bytes([0; 16])).await, Err(LibraryError::Unavailable { service: Service::Database, .. })));
}

#[tokio::test]
async fn errors_of_opening_say_why() {
    let dir = tempfile::tempdir().unwrap();
    let config = || Config::of_folder(dir.path());
    let file = dir.path().join("file");
    std::fs::write(&file, b"x").unwrap();
    let told = |opened: Result<Library>| opened.err().unwrap().to_string();
    let no_folder = told(Library::open(Config { data: file, ..config() }).await);
    assert!(no_folder.contains("cannot be made"), "{no_folder}");
    let no_store = told(Library::open(Config { blobs: Some("ftp://x".into()), ..config() }).await);
    assert!(no_store.contains("s3://BUCKET/PREFIX"), "{no_store}");
    let url = "postgres://nobody@localhost/none?host=/nowhere";
    let no_database = Library::open(Config { database: Some(url.into()), ..config() }).await;
    assert!(matches!(no_database, Err(LibraryError::Unavailable { service: Service::Database, .. })), "{no_database:?}");
}
