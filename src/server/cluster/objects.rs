//! Blobs and ledger in an object store with conditional writes: S3 and what speaks like it, Google Cloud Storage, Azure.

use std::io;
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use futures_util::{StreamExt, TryStreamExt};
use object_store::aws::AmazonS3Builder;
use object_store::azure::MicrosoftAzureBuilder;
use object_store::gcp::GoogleCloudStorageBuilder;
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
    /// A record is known by the number of its version, not by its entity tag.
    by_version: bool,
    runtime: Handle,
}

/// What makes a store of how it is asked.
type Built = object_store::Result<Arc<dyn ObjectStore>>;

impl Objects {
    /// The bucket and the prefix of a URL, `s3://bucket/prefix`, `gs://…` or `az://container/prefix`; endpoint, region and credentials by the
    /// usual variables, `AWS_…`, `GOOGLE_…` or `AZURE_…`. Called within a runtime, on which requests run. None where the scheme is another.
    ///
    /// # Errors
    /// The URL or a variable is not understood.
    pub fn open(scheme: &str, bucket: &str, prefix: &str) -> Option<io::Result<Self>> {
        let plain = |names: &[&str]| names.iter().find_map(|name| std::env::var(name).ok()).is_some_and(|e| e.starts_with("http:"));
        Some(match scheme {
            "s3" => Self::s3(&AmazonS3Builder::from_env().with_bucket_name(bucket), prefix, plain(&["AWS_ENDPOINT_URL", "AWS_ENDPOINT"])),
            "gs" => {
                let builder = GoogleCloudStorageBuilder::from_env().with_bucket_name(bucket);
                Self::google(&builder, prefix, plain(&["GOOGLE_BASE_URL"]))
            }
            "az" => {
                let builder = MicrosoftAzureBuilder::from_env().with_container_name(bucket);
                Self::azure(&builder, prefix, plain(&["AZURE_STORAGE_ENDPOINT", "AZURE_ENDPOINT"]))
            }
            _ => return None,
        })
    }

    /// S3 with whatever settings, without TLS where `plain`.
    pub(super) fn s3(builder: &AmazonS3Builder, prefix: &str, plain: bool) -> io::Result<Self> {
        Self::of(prefix, plain, false, |client, retry| Ok(Arc::new(builder.clone().with_client_options(client).with_retry(retry).build()?)))
    }

    /// The same of Google's, which goes by the number of a version, not by its entity tag.
    pub(super) fn google(builder: &GoogleCloudStorageBuilder, prefix: &str, plain: bool) -> io::Result<Self> {
        Self::of(prefix, plain, true, |client, retry| Ok(Arc::new(builder.clone().with_client_options(client).with_retry(retry).build()?)))
    }

    /// The same of Azure's.
    pub(super) fn azure(builder: &MicrosoftAzureBuilder, prefix: &str, plain: bool) -> io::Result<Self> {
        Self::of(prefix, plain, false, |client, retry| Ok(Arc::new(builder.clone().with_client_options(client).with_retry(retry).build()?)))
    }

    fn of(prefix: &str, plain: bool, by_version: bool, build: impl Fn(ClientOptions, RetryConfig) -> Built) -> io::Result<Self> {
        // what else is built in may ask for another kind of TLS; a second call changes nothing
        let _ = rustls::crypto::ring::default_provider().install_default();
        let backoff = BackoffConfig { init_backoff: Duration::from_millis(100), max_backoff: Duration::from_secs(1), base: 2.0 };
        let retry = RetryConfig { backoff, max_retries: 5, retry_timeout: RETRY };
        let store = |most| {
            let client = ClientOptions::new().with_timeout(most).with_connect_timeout(CONNECT).with_allow_http(plain);
            build(client, retry.clone()).map_err(|e| io::Error::new(io::ErrorKind::InvalidInput, e))
        };
        let (records, blobs) = (store(RECORD)?, store(BLOB)?);
        let prefix = prefix.trim_matches('/');
        let prefix = if prefix.is_empty() { String::new() } else { format!("{prefix}/") };
        Ok(Self { records, blobs, prefix, by_version, runtime: Handle::current() })
    }

    /// By what a record is known not to have changed.
    fn tag(&self, e_tag: Option<String>, version: Option<String>) -> Option<Tag> {
        if self.by_version { version.map(Tag) } else { e_tag.map(Tag) }
    }

    fn path(&self, name: &str) -> io::Result<Path> {
        Path::parse(format!("{}{name}", self.prefix)).map_err(|e| io::Error::new(io::ErrorKind::InvalidInput, e))
    }

    /// Writes under a condition, and gives the tag; none where it does not hold.
    fn write_if(&self, name: &str, bytes: &[u8], mode: PutMode) -> io::Result<Option<Tag>> {
        let path = self.path(name)?;
        let options = PutOptions { mode, ..PutOptions::default() };
        match self.runtime.block_on(self.records.put_opts(&path, bytes.to_vec().into(), options)) {
            Ok(done) => self.tag(done.e_tag, done.version).map(Some).ok_or_else(no_tags),
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
    let told = format!("{error:?}");
    // in Google's words and in Azure's, too
    ["NoSuchBucket", "The specified bucket does not exist", "ContainerNotFound", "ContainerBeingDeleted"]
        .iter()
        .any(|word| told.contains(word))
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

    fn read_range(&self, name: &str, range: Range<u64>) -> io::Result<Vec<u8>> {
        let path = self.path(name)?;
        let read = async {
            let mut refused = None;
            if !range.is_empty() {
                match self.blobs.get_range(&path, range.clone()).await {
                    Ok(bytes) => return Ok(bytes.into()),
                    // perhaps it begins behind the end, which stores refuse each in its own words
                    Err(e @ Error::Generic { .. }) => refused = Some(e),
                    Err(e) => return Err(e),
                }
            }
            let size = self.blobs.head(&path).await?.size;
            refused.filter(|_| range.start < size).map_or_else(|| Ok(Vec::new()), Err)
        };
        self.runtime.block_on(read).map_err(problem)
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
            let tag = self.tag(got.meta.e_tag.clone(), got.meta.version.clone());
            Ok::<_, Error>((got.bytes().await?, tag))
        });
        match got {
            Ok((bytes, Some(tag))) => Ok(Some((bytes.into(), tag))),
            Ok((_, None)) => Err(no_tags()),
            Err(e) => absent(e, |e| matches!(e, Error::NotFound { .. })),
        }
    }

    fn swap(&self, name: &str, seen: &Tag, bytes: &[u8]) -> io::Result<Option<Tag>> {
        // each kind of store looks at its own
        let seen = UpdateVersion { e_tag: Some(seen.0.clone()), version: Some(seen.0.clone()) };
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
