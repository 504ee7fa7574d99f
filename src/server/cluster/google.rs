//! What of Google Cloud Storage's XML interface a store asks, in memory, for tests: objects with generations, conditions on these, lists.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use axum::Router;
use axum::body::Bytes;
use axum::extract::State;
use axum::http::{HeaderMap, Method, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use tokio::runtime::Runtime;

/// The bucket that there is.
const BUCKET: &str = "photos";

/// Objects by name with their generations, and the last one that was given.
#[derive(Default)]
struct Objects(BTreeMap<String, (u64, Bytes)>, u64);

/// Starts one, which ends with the runtime.
pub fn start(runtime: &Runtime) -> SocketAddr {
    let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).unwrap();
    let addr = listener.local_addr().unwrap();
    let app = Router::new().fallback(answer).with_state(Arc::new(Mutex::new(Objects::default())));
    runtime.spawn(async move { axum::serve(listener, app).await });
    addr
}

/// A text as it was before it was made part of an address.
fn plain(text: &str) -> String {
    form_urlencoded::parse(text.as_bytes()).next().map_or_else(String::new, |(name, _)| name.into_owned())
}

async fn answer(State(all): State<Arc<Mutex<Objects>>>, method: Method, uri: Uri, headers: HeaderMap, body: Bytes) -> Response {
    let (bucket, name) = uri.path()[1..].split_once('/').unwrap_or((&uri.path()[1..], ""));
    if plain(bucket) != BUCKET {
        return (StatusCode::NOT_FOUND, "<Error><Code>NoSuchBucket</Code></Error>").into_response();
    }
    let (mut all, name) = (all.lock().unwrap(), plain(name));
    if name.is_empty() {
        return list(&all, uri.query().unwrap_or_default());
    }
    let is = all.0.get(&name).map_or(0, |(generation, _)| *generation);
    if headers.get("x-goog-if-generation-match").is_some_and(|wanted| wanted.as_bytes() != is.to_string().as_bytes()) {
        return (StatusCode::PRECONDITION_FAILED, "<Error><Code>PreconditionFailed</Code></Error>").into_response();
    }
    match method {
        Method::PUT => {
            all.1 += 1;
            let generation = all.1;
            all.0.insert(name, (generation, body));
            told(generation, Bytes::new())
        }
        Method::GET if is > 0 => part_of(is, all.0[&name].1.clone(), headers.get("range").and_then(|range| range.to_str().ok())),
        Method::HEAD if is > 0 => {
            let size = [("content-length", all.0[&name].1.len().to_string())];
            (size, told(is, Bytes::new())).into_response()
        }
        Method::DELETE if is > 0 => {
            all.0.remove(&name);
            StatusCode::NO_CONTENT.into_response()
        }
        _ => (StatusCode::NOT_FOUND, "<Error><Code>NoSuchKey</Code></Error>").into_response(),
    }
}

fn told(generation: u64, body: Bytes) -> Response {
    // of equal bytes the tag is the same: nothing may go by it
    let headers = [
        ("x-goog-generation", generation.to_string()),
        ("etag", "\"0\"".into()),
        ("last-modified", "Tue, 24 Nov 2026 00:00:00 GMT".into()),
    ];
    (headers, body).into_response()
}

/// The bytes of a range `bytes=A-B`, or all.
fn part_of(generation: u64, body: Bytes, range: Option<&str>) -> Response {
    let Some((from, to)) = range.and_then(|range| range.strip_prefix("bytes=")?.split_once('-')) else { return told(generation, body) };
    let (from, to): (usize, usize) = (from.parse().unwrap(), to.parse().unwrap());
    if from >= body.len() {
        return (StatusCode::RANGE_NOT_SATISFIABLE, "<Error><Code>InvalidRange</Code></Error>").into_response();
    }
    let end = (to + 1).min(body.len());
    let of = [("content-range", format!("bytes {from}-{}/{}", end - 1, body.len()))];
    (StatusCode::PARTIAL_CONTENT, of, told(generation, body.slice(from..end))).into_response()
}

fn list(all: &Objects, query: &str) -> Response {
    let asked: BTreeMap<_, _> = form_urlencoded::parse(query.as_bytes()).into_owned().collect();
    let of = |name: &str| asked.get(name).map(String::as_str).unwrap_or_default();
    let names = all.0.iter().filter(|(name, _)| name.starts_with(of("prefix")) && name.as_str() > of("start-after"));
    let one = |(name, (_, bytes)): (&String, &(u64, Bytes))| {
        let size = bytes.len();
        format!(
            "<Contents><Key>{name}</Key><LastModified>2026-11-24T00:00:00.000Z</LastModified><ETag>0</ETag><Size>{size}</Size></Contents>"
        )
    };
    format!("<ListBucketResult>{}</ListBucketResult>", names.map(one).collect::<String>()).into_response()
}
