//! Benchmarks of a page of the list, the statistics, and accepting an upload: on SQLite with 100 000 photos, and on PostgreSQL, where it is
//! installed, with 1 000 000. This PostgreSQL does not sync its files, so that writing costs less than on a server.
#![allow(clippy::unwrap_used, reason = "bench")]

use std::path::Path;
use std::time::{Duration, Instant};

use criterion::{Criterion, criterion_group, criterion_main};
use sqlx::{AnyConnection, AssertSqlSafe, Connection as _, Executor as _};
use tmpi_library::{Class, Config, Content, Library, Owner, PhotoId, Requester, Upload};

/// Inserts finished photos of 100 owners as the library does, without their blobs. `PHOTOS` stands for their number.
const FILL: &str = r#"
    WITH RECURSIVE n (n) AS (SELECT 0 UNION ALL SELECT n + 1 FROM n WHERE n < 99)
    INSERT INTO owners SELECT printf('%064x', n), 0 FROM n;
    WITH RECURSIVE n (n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM n WHERE n < PHOTOS)
    INSERT INTO photos SELECT printf('%08x', (n * 2654435761) % 4294967296) || printf('%024x', n), printf('%064x', n % 100),
        n * 1000, n * 1000, n * 1000, 0, '{"quality":"80"}', '{"title":"Photo"}', 1, 1, 'done', 1, n * 1000,
        '{"width":640,"height":480}', NULL,
        '{"upload":{"name":"' || hex(randomblob(40)) || '","bytes":1,"digest":"' || hex(randomblob(32)) || '"},' ||
        '"container":{"name":"' || hex(randomblob(40)) || '","bytes":1,"digest":"' || hex(randomblob(32)) || '"}}',
        100000, n * 1000 FROM n;"#;

/// What [`FILL`] uses of SQLite's functions, for PostgreSQL.
const FUNCTIONS: &str = "
    CREATE FUNCTION printf(TEXT, BIGINT) RETURNS TEXT LANGUAGE sql AS $$ SELECT lpad(to_hex($2), translate($1, '%x', '')::INT, '0') $$;
    CREATE FUNCTION randomblob(INT) RETURNS BYTEA LANGUAGE sql AS $$ SELECT substr(sha512(random()::TEXT::BYTEA), 1, $1) $$;
    CREATE FUNCTION hex(BYTEA) RETURNS TEXT LANGUAGE sql AS $$ SELECT encode($1, 'hex') $$;";

/// A library of `photos`, in PostgreSQL if there is a URL.
async fn filled(data: &Path, url: Option<&str>, photos: u32) -> Library {
    let config = || Config { database: url.map(str::to_owned), ..Config::of_folder(data) };
    let library = Library::open(config()).await.unwrap();
    library.close().await;
    let sqlite = format!("sqlite://{}", data.join("library.db").display());
    let mut connection = AnyConnection::connect(url.unwrap_or(&sqlite)).await.unwrap();
    if url.is_some() {
        connection.execute(sqlx::raw_sql(FUNCTIONS)).await.unwrap();
    }
    let fill = FILL.replace("PHOTOS", &photos.to_string());
    connection.execute(sqlx::raw_sql(AssertSqlSafe(fill))).await.unwrap();
    // on a server, PostgreSQL vacuums by itself after so many rows, and only then counts within indices
    let analyze = if url.is_some() { "VACUUM ANALYZE" } else { "ANALYZE" };
    connection.execute(sqlx::raw_sql(analyze)).await.unwrap();
    connection.close().await.unwrap();
    Library::open(config()).await.unwrap()
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

fn measure(criterion: &mut Criterion, url: Option<&str>, photos: u32) {
    let database = if url.is_some() { "PostgreSQL" } else { "SQLite" };
    let dir = tempfile::tempdir().unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let library = runtime.block_on(filled(dir.path(), url, photos));
    let page = |owner: Option<&Owner>, after| runtime.block_on(library.list(owner, after, 50)).unwrap();
    let middle = (0..20).fold(None, |after, _| page(None, after).next);
    let mut group = criterion.benchmark_group(format!("{photos} photos in {database}"));
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
    println!("accepting and deleting a photo in {database}: {:.2} ms", begin.elapsed().as_secs_f64() * 1000.0 / uploads as f64);
}

fn lists(criterion: &mut Criterion) {
    measure(criterion, None, 100_000);
    // says that it is skipped if PostgreSQL is not installed
    #[cfg(unix)]
    if let Some(url) = tmpi_testing::database() {
        measure(criterion, Some(&url), 1_000_000);
    }
}

criterion_group!(benches, lists);
criterion_main!(benches);
