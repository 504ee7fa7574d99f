//! Benchmarks on SQLite with 100 000 photos: a page of the list, the statistics, and accepting an upload.
#![allow(clippy::unwrap_used, reason = "bench")]

use std::path::Path;
use std::time::{Duration, Instant};

use criterion::{Criterion, criterion_group, criterion_main};
use sqlx::{AnyConnection, Connection as _, Executor as _};
use tmpi_library::{Class, Config, Content, Library, Owner, PhotoId, Requester, Upload};

/// Photos of the library, of 100 owners.
const PHOTOS: u32 = 100_000;

/// Inserts finished photos as the library does, without their blobs.
const FILL: &str = "
    WITH RECURSIVE n (n) AS (SELECT 0 UNION ALL SELECT n + 1 FROM n WHERE n < 99)
    INSERT INTO owners SELECT printf('%064x', n), 0 FROM n;
    WITH RECURSIVE n (n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM n WHERE n < 100000)
    INSERT INTO photos SELECT printf('%08x%024x', (n * 2654435761) % 4294967296, n), printf('%064x', n % 100), n * 1000, n * 1000, n * 1000, 0,
        '{\"quality\":\"80\"}', '{\"title\":\"Photo\"}', 1, 1, 'done', 1, n * 1000, '{\"width\":640,\"height\":480}', NULL,
        '{' || '\"upload\":{\"name\":\"' || hex(randomblob(40)) || '\",\"bytes\":1,\"digest\":\"' || hex(randomblob(32)) || '\"}' ||
        ',\"container\":{\"name\":\"' || hex(randomblob(40)) || '\",\"bytes\":1,\"digest\":\"' || hex(randomblob(32)) || '\"}' || '}', 100000, n * 1000 FROM n;
    ANALYZE;";

async fn filled(data: &Path) -> Library {
    let library = Library::open(Config::of_folder(data)).await.unwrap();
    library.close().await;
    let mut connection = AnyConnection::connect(&format!("sqlite://{}", data.join("library.db").display())).await.unwrap();
    connection.execute(sqlx::raw_sql(FILL)).await.unwrap();
    connection.close().await.unwrap();
    Library::open(Config::of_folder(data)).await.unwrap()
}

fn upload(n: u64) -> Upload {
    let photo = Content::of_bytes(n.to_string().into_bytes());
    Upload {
        id: PhotoId::of_content(photo.digest(), None, "", ""),
        requester: Requester::default(),
        class: Class::Interactive,
        options: std::collections::BTreeMap::default(),
        settings: serde_json::json!({}),
        photo,
        depth: None,
    }
}

fn lists(criterion: &mut Criterion) {
    let dir = tempfile::tempdir().unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let library = runtime.block_on(filled(dir.path()));
    let page = |owner: Option<&Owner>, after| runtime.block_on(library.list(owner, after, 50)).unwrap();
    let middle = (0..20).fold(None, |after, _| page(None, after).next);
    let mut group = criterion.benchmark_group(format!("{PHOTOS} photos"));
    group.measurement_time(Duration::from_secs(3)).sample_size(30);
    group.bench_function("first page of 50", |b| b.iter(|| page(None, None)));
    group.bench_function("21st page of 50", |b| b.iter(|| page(None, middle)));
    let owner = runtime.block_on(library.list(None, None, 1)).unwrap().photos.remove(0).owner;
    group.bench_function("an owner's page of 50", |b| b.iter(|| page(owner.as_ref(), None)));
    group.bench_function("statistics", |b| b.iter(|| runtime.block_on(library.statistics()).unwrap()));
    group.finish();
    // not a criterion loop, because each photo can be accepted only once
    let begin = Instant::now();
    let uploads = 200;
    for n in 0..uploads {
        let id = runtime.block_on(library.accept(upload(n))).unwrap().photo.id;
        runtime.block_on(library.delete(id, None)).unwrap();
    }
    println!("accepting and deleting a photo: {:.2} ms", begin.elapsed().as_secs_f64() * 1000.0 / uploads as f64);
}

criterion_group!(benches, lists);
criterion_main!(benches);
