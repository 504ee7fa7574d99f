//! Blobs and ledger in an object store: S3 and what speaks like it, with conditional writes.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use futures_util::{StreamExt, TryStreamExt};
use object_store::aws::AmazonS3Builder;
use object_store::path::Path;
use object_store::{BackoffConfig, ClientOptions, Error, ObjectStore, ObjectStoreExt, PutMode, PutOptions, RetryConfig, UpdateVersion};
use tokio::runtime::Handle;

use super::ports::{Blobs, Ledger, Tag, unreachable};

/// Longest that a request is tried again; callers know what to do without the store.
const RETRY: Duration = Duration::from_secs(3);
/// Longest that a request about a record may take: a store that is silent must not hold up what is here.
const RECORD: Duration = Duration::from_secs(5);
/// Longest that a blob may take.
const BLOB: Duration = Duration::from_mins(1);
/// Longest that a connection may take to come about.
const CONNECT: Duration = Duration::from_secs(3);

/// An object store under a prefix.
#[derive(Debug)]
pub struct Objects {
    records: Arc<dyn ObjectStore>,
    blobs: Arc<dyn ObjectStore>,
    prefix: String,
    runtime: Handle,
}

impl Objects {
    /// The bucket and the prefix of a URL, `s3://bucket/prefix`; endpoint, region and credentials by the usual `AWS_…` variables.
    /// Called within a runtime, on which requests run.
    ///
    /// # Errors
    /// The URL or a variable is not understood.
    pub fn open(bucket: &str, prefix: &str) -> io::Result<Self> {
        let plain = std::env::var("AWS_ENDPOINT_URL").or_else(|_| std::env::var("AWS_ENDPOINT")).is_ok_and(|e| e.starts_with("http:"));
        Self::of(&AmazonS3Builder::from_env().with_bucket_name(bucket), prefix, plain)
    }

    /// The same with whatever settings, without TLS where `plain`.
    pub(super) fn of(builder: &AmazonS3Builder, prefix: &str, plain: bool) -> io::Result<Self> {
        // what else is built in may ask for another kind of TLS; a second call changes nothing
        let _ = rustls::crypto::ring::default_provider().install_default();
        let backoff = BackoffConfig { init_backoff: Duration::from_millis(100), max_backoff: Duration::from_secs(1), base: 2.0 };
        let retry = RetryConfig { backoff, max_retries: 5, retry_timeout: RETRY };
        let store = |most| -> io::Result<Arc<dyn ObjectStore>> {
            let client = ClientOptions::new().with_timeout(most).with_connect_timeout(CONNECT).with_allow_http(plain);
            let store = builder.clone().with_client_options(client).with_retry(retry.clone()).build();
            Ok(Arc::new(store.map_err(|e| io::Error::new(io::ErrorKind::InvalidInput, e))?))
        };
        let (records, blobs) = (store(RECORD)?, store(BLOB)?);
        let prefix = prefix.trim_matches('/');
        let prefix = if prefix.is_empty() { String::new() } else { format!("{prefix}/") };
        Ok(Self { records, blobs, prefix, runtime: Handle::current() })
    }

    fn path(&self, name: &str) -> io::Result<Path> {
        Path::parse(format!("{}{name}", self.prefix)).map_err(|e| io::Error::new(io::ErrorKind::InvalidInput, e))
    }

    /// Writes under a condition, and gives the tag; none where it does not hold.
    fn write_if(&self, name: &str, bytes: &[u8], mode: PutMode) -> io::Result<Option<Tag>> {
        let path = self.path(name)?;
        let options = PutOptions { mode, ..PutOptions::default() };
        match self.runtime.block_on(self.records.put_opts(&path, bytes.to_vec().into(), options)) {
            Ok(done) => done.e_tag.map(|tag| Some(Tag(tag))).ok_or_else(no_tags),
            Err(e) => absent(e, is_refused),
        }
    }

    fn delete(&self, name: &str) -> io::Result<()> {
        let path = self.path(name)?;
        match self.runtime.block_on(self.records.delete(&path)) {
            Ok(()) => Ok(()),
            Err(e) => absent(e, |e| matches!(e, Error::NotFound { .. })).map(|_: Option<()>| ()),
        }
    }
}

/// True where an error says that a condition does not hold.
fn is_refused(error: &Error) -> bool {
    matches!(error, Error::AlreadyExists { .. } | Error::Precondition { .. })
}

/// None where an error is `expected` of an object; that there is no bucket says nothing of what was in it.
fn absent<T>(error: Error, expected: impl Fn(&Error) -> bool) -> io::Result<Option<T>> {
    if expected(&error) && !no_bucket(&error) { Ok(None) } else { Err(problem(error)) }
}

/// True where the bucket itself is missing.
fn no_bucket(error: &Error) -> bool {
    format!("{error:?}").contains("NoSuchBucket")
}

fn no_tags() -> io::Error {
    io::Error::new(io::ErrorKind::Unsupported, "the store gives no entity tags")
}

/// Errors as the ports tell them: what is not about one object is the store's.
fn problem(error: Error) -> io::Error {
    match error {
        Error::NotFound { .. } if !no_bucket(&error) => io::Error::new(io::ErrorKind::NotFound, error),
        Error::InvalidPath { .. } => io::Error::new(io::ErrorKind::InvalidInput, error),
        _ => unreachable(error),
    }
}

impl Blobs for Objects {
    fn put(&self, name: &str, bytes: Vec<u8>) -> io::Result<()> {
        let path = self.path(name)?;
        self.runtime.block_on(self.blobs.put(&path, bytes.into())).map(drop).map_err(problem)
    }

    fn read(&self, name: &str) -> io::Result<Vec<u8>> {
        let path = self.path(name)?;
        let bytes = self.runtime.block_on(async { self.blobs.get(&path).await?.bytes().await });
        bytes.map(Into::into).map_err(problem)
    }

    fn discard(&self, name: &str) -> io::Result<()> {
        self.delete(name)
    }
}

impl Ledger for Objects {
    fn create(&self, name: &str, bytes: &[u8]) -> io::Result<bool> {
        self.write_if(name, bytes, PutMode::Create).map(|tag| tag.is_some())
    }

    fn get(&self, name: &str) -> io::Result<Option<(Vec<u8>, Tag)>> {
        let path = self.path(name)?;
        let got = self.runtime.block_on(async {
            let got = self.records.get(&path).await?;
            let tag = got.meta.e_tag.clone();
            Ok::<_, Error>((got.bytes().await?, tag))
        });
        match got {
            Ok((bytes, Some(tag))) => Ok(Some((bytes.into(), Tag(tag)))),
            Ok((_, None)) => Err(no_tags()),
            Err(e) => absent(e, |e| matches!(e, Error::NotFound { .. })),
        }
    }

    fn swap(&self, name: &str, seen: &Tag, bytes: &[u8]) -> io::Result<Option<Tag>> {
        let seen = UpdateVersion { e_tag: Some(seen.0.clone()), version: None };
        self.write_if(name, bytes, PutMode::Update(seen))
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        self.delete(name)
    }

    fn page(&self, folder: &str, after: Option<&str>, limit: usize) -> io::Result<Vec<String>> {
        let path = self.path(folder.trim_end_matches('/'))?;
        let names = match after {
            Some(after) => self.records.list_with_offset(Some(&path), &self.path(after)?),
            None => self.records.list(Some(&path)),
        };
        let cut = self.prefix.len();
        let name = |meta: object_store::ObjectMeta| meta.location.to_string().get(cut..).unwrap_or_default().to_owned();
        let names = names.map_ok(name).take(limit).try_collect();
        self.runtime.block_on(names).map_err(problem)
    }
}
