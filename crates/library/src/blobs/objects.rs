//! Blobs in an object store: S3 and compatible stores.

use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::TryStreamExt as _;
use object_store::aws::AmazonS3Builder;
use object_store::path::Path;
use object_store::{BackoffConfig, ClientOptions, Error, ObjectStore, ObjectStoreExt as _, RetryConfig};

use super::{Listed, Source, Write};
use crate::error::{LibraryError, Result, Service};

/// How long to retry a request: callers handle an unavailable store.
const RETRY: Duration = Duration::from_secs(3);
/// Timeout of a request and of a connection.
const REQUEST: Duration = Duration::from_mins(1);
const CONNECT: Duration = Duration::from_secs(3);

/// A bucket under a prefix.
#[derive(Clone, Debug)]
pub(super) struct Objects {
    store: Arc<dyn ObjectStore>,
    prefix: String,
}

/// Builds a store; `plain` allows HTTP without TLS.
fn s3(builder: AmazonS3Builder, plain: bool) -> object_store::Result<Arc<dyn ObjectStore>> {
    // other dependencies may build rustls with another provider; a second call changes nothing
    let _ = rustls::crypto::ring::default_provider().install_default();
    let client = ClientOptions::new().with_timeout(REQUEST).with_connect_timeout(CONNECT).with_allow_http(plain);
    let backoff = BackoffConfig { init_backoff: Duration::from_millis(100), max_backoff: Duration::from_secs(1), base: 2.0 };
    let retry = RetryConfig { backoff, max_retries: 5, retry_timeout: RETRY };
    Ok(Arc::new(builder.with_client_options(client).with_retry(retry).build()?))
}

impl Objects {
    pub fn open(url: &str) -> Result<Self> {
        let invalid = |reason: String| LibraryError::Invalid(format!("the blob store {url}: {reason}"));
        let place = url.strip_prefix("s3://").ok_or_else(|| invalid("must be s3://BUCKET/PREFIX".into()))?;
        let (bucket, prefix) = place.split_once('/').unwrap_or((place, ""));
        let endpoint = ["AWS_ENDPOINT_URL", "AWS_ENDPOINT"].into_iter().find_map(|name| std::env::var(name).ok());
        let plain = endpoint.is_some_and(|endpoint| endpoint.starts_with("http:"));
        let store = s3(AmazonS3Builder::from_env().with_bucket_name(bucket), plain).map_err(|e| invalid(e.to_string()))?;
        Ok(Self { store, prefix: prefix.trim_matches('/').to_owned() })
    }

    /// A test's S3 server with a bucket `photos`.
    #[cfg(test)]
    pub fn s3_at(addr: std::net::SocketAddr) -> Self {
        let builder = AmazonS3Builder::new().with_bucket_name("photos").with_endpoint(format!("http://{addr}"));
        let builder = builder.with_region("us-east-1").with_access_key_id("test").with_secret_access_key("test");
        Self { store: s3(builder, true).unwrap(), prefix: "library".into() }
    }

    /// A store in memory.
    #[cfg(test)]
    pub fn in_memory() -> Self {
        Self { store: Arc::new(object_store::memory::InMemory::new()), prefix: "a/b".into() }
    }

    fn path(&self, name: &str) -> Path {
        Path::from(format!("{}/{name}", self.prefix))
    }

    pub async fn put_all(&self, writes: Vec<Write>) -> Result<()> {
        for Write { name, source } in writes {
            let bytes = match &source {
                Source::Bytes(bytes) => bytes.clone(),
                Source::File(path) => tokio::fs::read(path).await.map_err(|e| LibraryError::blobs(&e))?.into(),
            };
            self.store.put(&self.path(&name), bytes.into()).await.map_err(problem)?;
            if let Source::File(path) = source {
                // it is stored: a leftover file only takes space
                let _ = tokio::fs::remove_file(path).await;
            }
        }
        Ok(())
    }

    pub async fn get(&self, name: &str, range: Option<Range<u64>>) -> Result<Bytes> {
        let path = self.path(name);
        match range {
            Some(range) if range.is_empty() => Ok(Bytes::new()),
            Some(range) => self.store.get_range(&path, range).await.map_err(problem),
            None => self.store.get(&path).await.map_err(problem)?.bytes().await.map_err(problem),
        }
    }

    pub async fn delete(&self, name: &str) -> Result<()> {
        match self.store.delete(&self.path(name)).await.map_err(problem) {
            Err(LibraryError::NotFound(_)) => Ok(()),
            done => done,
        }
    }

    pub async fn list(&self, prefix: &str) -> Result<Vec<Listed>> {
        let (folder, cut) = (self.path(prefix), self.path("").as_ref().len() + 1);
        let of = |meta: object_store::ObjectMeta| Listed {
            name: meta.location.as_ref().get(cut..).unwrap_or_default().to_owned(),
            bytes: meta.size,
            written_at: meta.last_modified.timestamp_millis(),
        };
        self.store.list(Some(&folder)).map_ok(of).try_collect().await.map_err(problem)
    }
}

/// Maps errors. A missing object is [`LibraryError::NotFound`], but a missing bucket is not.
#[allow(clippy::needless_pass_by_value, reason = "it is what map_err gives")]
fn problem(error: Error) -> LibraryError {
    let told = format!("{error:?}");
    match error {
        Error::NotFound { .. } if !told.contains("NoSuchBucket") => LibraryError::NotFound("blob"),
        _ => LibraryError::Unavailable { service: Service::Blobs, reason: error.to_string() },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn objects_are_put_read_listed_and_deleted() {
        let objects = Objects::in_memory();
        let put = |name: &str| objects.put_all(vec![Write { name: name.to_owned(), source: Source::Bytes(Bytes::from_static(b"bytes")) }]);
        put("ab/one").await.unwrap();
        put("ac/two").await.unwrap();
        assert_eq!(objects.get("ab/one", None).await.unwrap(), "bytes");
        assert_eq!(objects.get("ab/one", Some(1..3)).await.unwrap(), "yt");
        assert_eq!(objects.get("ab/one", Some(5..5)).await.unwrap(), "");
        let names = |listed: Vec<Listed>| listed.into_iter().map(|l| (l.name, l.bytes)).collect::<Vec<_>>();
        assert_eq!(names(objects.list("ab").await.unwrap()), [("ab/one".to_owned(), 5)]);
        objects.delete("ab/one").await.unwrap();
        objects.delete("ab/one").await.unwrap();
        assert!(matches!(objects.get("ab/one", None).await, Err(LibraryError::NotFound(_))));
    }

    #[test]
    fn other_urls_are_refused_with_what_they_must_be() {
        for url in ["", "s3:/x", "gs://x/y", "file:///x"] {
            let told = Objects::open(url).unwrap_err().to_string();
            assert!(told.contains("s3://BUCKET/PREFIX"), "{told}");
        }
    }
}
