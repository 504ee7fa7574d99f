//! Blobs: large, immutable contents in a local folder or an object store. The store needs only put, range get, delete and list.
//!
//! A blob's name has its photo, its part, the start of its digest, and a number that is unique to each write. So a name that no row refers
//! to after a day will never be referred to again, and `gc` may delete it without any lock.

mod folder;
mod objects;

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Duration;

use bytes::Bytes;

pub(crate) use folder::create_private;
#[cfg(test)]
pub(crate) use folder::{Disk, Files};
pub use folder::{DiskSpace, Reserve};

use crate::Millis;
use crate::digest::{Digest, hex};
use crate::error::{LibraryError, Result, Service};
use crate::ids::{PhotoId, random};
use crate::photo::{Blob, Blobs, Part, blob_names};
use folder::Folder;
use objects::Objects;

/// Hex digits of the digest in a name.
const DIGITS: usize = 16;
/// Folder of the probe's blobs.
const PROBE: &str = "probe";
/// Start of the name of a claim of the store, before the id of its library.
const CLAIM: &str = "probe/claim-";
/// Age in milliseconds at which a claim counts as left behind by a crash. Its announcement stays until `gc` deletes it after a day, like all
/// blobs of [`PROBE`]: a claim does not delete those of others, which may still be looking at the store.
const CLAIM_ENDS: Millis = 15 * 60 * 1000;
/// Name of the blob with the id of the store's library.
const LIBRARY: &str = "library-id";
/// How long replaced blobs stay for readers that began before.
const READERS: Duration = Duration::from_mins(15);

/// A content to be stored.
#[derive(Debug)]
pub struct Content {
    source: Source,
    bytes: u64,
    digest: Digest,
}

#[derive(Debug)]
pub(crate) enum Source {
    Bytes(Bytes),
    /// A file in [`Library::incoming`](crate::Library::incoming), which is moved.
    File(PathBuf),
}

impl Content {
    /// A content from bytes.
    pub fn of_bytes(bytes: impl Into<Bytes>) -> Self {
        let bytes = bytes.into();
        Self { bytes: bytes.len() as u64, digest: Digest::of(&bytes), source: Source::Bytes(bytes) }
    }

    /// A content from a file in [`Library::incoming`](crate::Library::incoming), with the size and digest computed while it was written.
    /// Storing the content removes the file.
    pub const fn of_file(path: PathBuf, bytes: u64, digest: Digest) -> Self {
        Self { source: Source::File(path), bytes, digest }
    }

    /// Its size in bytes.
    pub const fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Its digest.
    pub const fn digest(&self) -> &Digest {
        &self.digest
    }
}

/// Contents of a photo to be stored.
pub type Contents = BTreeMap<Part, Content>;

/// A blob that is being written.
pub(crate) struct Write {
    pub name: String,
    pub source: Source,
}

/// A blob as the store lists it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Listed {
    pub name: String,
    pub bytes: u64,
    /// By the store's clock.
    pub written_at: Millis,
}

/// The blob store.
#[derive(Clone, Debug)]
pub struct BlobStore(Backend);

#[derive(Clone, Debug)]
enum Backend {
    Folder(Folder),
    Objects(Objects),
}

/// Calls the same of either kind of store.
macro_rules! on_either {
    ($blobs:ident, $store:ident => $call:expr) => {
        match &$blobs.0 {
            Backend::Folder($store) => $call,
            Backend::Objects($store) => $call,
        }
    };
}

impl BlobStore {
    /// A local folder, created if missing.
    pub(crate) fn folder(path: &Path, reserve: Reserve) -> Result<Self> {
        Folder::open(path, reserve).map(|folder| Self(Backend::Folder(folder)))
    }

    /// The same with other file operations.
    #[cfg(test)]
    pub(crate) fn folder_of(files: std::sync::Arc<dyn Files>, path: &Path) -> Result<Self> {
        Folder::open_in(files, path, Reserve::default()).map(|folder| Self(Backend::Folder(folder)))
    }

    /// An S3 server with a bucket `photos`.
    #[cfg(test)]
    pub(crate) fn s3_at(addr: std::net::SocketAddr) -> Self {
        Self(Backend::Objects(Objects::s3_at(addr)))
    }

    /// A bucket and a prefix, `s3://BUCKET/PREFIX`. Endpoint, region and credentials come from the usual environment variables.
    pub(crate) fn objects(url: &str) -> Result<Self> {
        Objects::open(url).map(|objects| Self(Backend::Objects(objects)))
    }

    /// Writes, reads and deletes a blob.
    pub async fn probe(&self) -> Result<()> {
        let name = format!("{PROBE}/{}", hex(&random::<8>()?));
        let written = Bytes::from_static(b"tmpi");
        self.put(name.clone(), written.clone()).await?;
        let read = self.get(&name, Some(0..written.len() as u64)).await;
        self.delete(&name).await?;
        if read? == written { Ok(()) } else { Err(LibraryError::Invalid("the blob store returned other bytes than were written".into())) }
    }

    /// Checks that the disk has space for this many bytes beyond its reserve.
    pub fn check_space(&self, bytes: u64) -> Result<()> {
        let Backend::Folder(folder) = &self.0 else { return Ok(()) };
        folder.check_space(bytes)
    }

    /// Free space of the disk; `None` for an object store.
    pub fn disk_space(&self) -> Option<DiskSpace> {
        let Backend::Folder(folder) = &self.0 else { return None };
        folder.disk_space()
    }

    /// Stores contents of a photo for a change that refers to them. If the change fails, deletes them; after an error that may have come
    /// after its commit, they stay for `gc`.
    pub(crate) async fn store_for<T, F>(&self, photo: PhotoId, contents: Contents, change: impl FnOnce(Blobs) -> F) -> Result<T>
    where
        F: Future<Output = Result<T>>,
    {
        let blobs = if contents.is_empty() { Blobs::new() } else { self.store(photo, contents).await? };
        let written = blob_names(&blobs);
        let changed = change(blobs).await;
        if !matches!(changed, Ok(_) | Err(LibraryError::Unavailable { .. } | LibraryError::Internal(_))) {
            self.discard(written).await;
        }
        changed
    }

    /// Stores contents of a photo. All are durable when this returns; after an error it may leave orphans.
    pub(crate) async fn store(&self, photo: PhotoId, contents: Contents) -> Result<Blobs> {
        self.check_space(contents.values().map(Content::bytes).sum())?;
        let (mut blobs, mut writes) = (Blobs::new(), Vec::new());
        for (part, content) in contents {
            let name = name(photo, part, &content.digest)?;
            writes.push(Write { name: name.clone(), source: content.source });
            blobs.insert(part, Blob { name, bytes: content.bytes, digest: content.digest });
        }
        if let Err(error) = self.put_all(writes).await {
            // some may have been written; an object store may not answer now, so the caller does not wait for it
            let (store, names) = (self.clone(), blobs.into_values().map(|blob| blob.name).collect::<Vec<_>>());
            match &self.0 {
                Backend::Folder(_) => store.discard(names).await,
                Backend::Objects(_) => drop(tokio::spawn(async move { store.discard(names).await })),
            }
            return Err(error);
        }
        Ok(blobs)
    }

    /// Id of the store's library, as written by [`BlobStore::claim`].
    pub(crate) async fn library(&self) -> Result<Option<Bytes>> {
        match self.get(LIBRARY, None).await {
            Err(LibraryError::NotFound(_)) => Ok(None),
            read => read.map(Some),
        }
    }

    /// Makes the store that of library `id`; false if another library has it, or claims it at the same time.
    ///
    /// The store has no conditional writes. So a claim is announced before it looks for others, and its announcement stays until its end: of
    /// two claims, the one that looks last sees the other's announcement, or its result.
    pub(crate) async fn claim(&self, id: &str) -> Result<bool> {
        let own = format!("{CLAIM}{id}-{}", hex(&random::<8>()?));
        self.put(own.clone(), Bytes::from_static(b"claim")).await?;
        let claimed = self.claim_as_announced(id, &own).await;
        self.delete(&own).await?;
        claimed
    }

    async fn claim_as_announced(&self, id: &str, own: &str) -> Result<bool> {
        let listed = self.list(PROBE).await?;
        let now = listed.iter().find(|claim| claim.name == own).map_or(0, |claim| claim.written_at);
        let is_of_another = |claim: &Listed| claim.name.strip_prefix(CLAIM).is_some_and(|rest| !rest.starts_with(id));
        if listed.iter().any(|claim| is_of_another(claim) && now - claim.written_at < CLAIM_ENDS) {
            return Ok(false);
        }
        if let Some(of) = self.library().await? {
            return Ok(of == id);
        }
        self.put(LIBRARY.into(), Bytes::from(id.to_owned())).await?;
        Ok(true)
    }

    async fn put(&self, name: String, bytes: Bytes) -> Result<()> {
        self.put_all(vec![Write { name, source: Source::Bytes(bytes) }]).await
    }

    async fn put_all(&self, writes: Vec<Write>) -> Result<()> {
        on_either!(self, store => store.put_all(writes).await)
    }

    async fn get(&self, name: &str, range: Option<Range<u64>>) -> Result<Bytes> {
        on_either!(self, store => store.get(name, range).await)
    }

    /// The error of a blob that is not found: it is damaged, unless the whole store is away, such as a folder that is not mounted.
    pub async fn missing(&self, part: Part) -> LibraryError {
        match self.library().await {
            Ok(Some(_)) => LibraryError::Damaged { part, detail: "it is missing".into() },
            Ok(None) => LibraryError::Unavailable { service: Service::Blobs, reason: format!("it has no {LIBRARY}") },
            Err(error) => error,
        }
    }

    /// A range of a blob's bytes.
    pub async fn read_range(&self, blob: &Blob, range: Range<u64>) -> Result<Bytes> {
        self.get(&blob.name, Some(range.start.min(blob.bytes)..range.end.min(blob.bytes))).await
    }

    /// A whole blob, checked against its size and digest.
    ///
    /// # Errors
    /// [`LibraryError::Damaged`], also if it is [missing](Self::missing).
    pub async fn read(&self, part: Part, blob: &Blob) -> Result<Bytes> {
        let damaged = |detail: String| LibraryError::Damaged { part, detail };
        let bytes = match self.get(&blob.name, None).await {
            Err(LibraryError::NotFound(_)) => return Err(self.missing(part).await),
            read => read?,
        };
        if bytes.len() as u64 != blob.bytes {
            return Err(damaged(format!("it has {} bytes, and {} were written", bytes.len(), blob.bytes)));
        }
        // hashing a large blob would block the runtime for a second
        let hash = move || (Digest::of(&bytes), bytes);
        let (digest, bytes) = tokio::task::spawn_blocking(hash).await.map_err(|e| LibraryError::Internal(e.to_string()))?;
        if digest == blob.digest { Ok(bytes) } else { Err(damaged("it is not what was written".into())) }
    }

    /// The file of a blob, if the store is a local folder.
    pub fn path(&self, blob: &Blob) -> Option<PathBuf> {
        let Backend::Folder(folder) = &self.0 else { return None };
        Some(folder.path(&blob.name))
    }

    pub(crate) async fn delete(&self, name: &str) -> Result<()> {
        on_either!(self, store => store.delete(name).await)
    }

    /// Deletes blobs without references. If that fails, `gc` deletes them later.
    pub(crate) async fn discard(&self, names: impl IntoIterator<Item = String>) {
        for name in names {
            if let Err(error) = self.delete(&name).await {
                tracing::warn!(name, %error, "cannot delete a blob; gc will");
            }
        }
    }

    /// [`Self::discard`], in an object store after [`READERS`]: readers fetch objects piece by piece, while they keep files open.
    pub(crate) async fn discard_later(&self, names: Vec<String>) {
        match &self.0 {
            Backend::Folder(_) => self.discard(names).await,
            Backend::Objects(_) => {
                let store = self.clone();
                tokio::spawn(async move {
                    tokio::time::sleep(READERS).await;
                    store.discard(names).await;
                });
            }
        }
    }

    /// Blobs in the folder `prefix`: those of photos whose ids begin with it.
    pub(crate) async fn list(&self, prefix: &str) -> Result<Vec<Listed>> {
        on_either!(self, store => store.list(prefix).await)
    }

    pub(crate) async fn now(&self) -> Result<Millis> {
        let name = format!("{PROBE}/{}", hex(&random::<8>()?));
        self.put(name.clone(), Bytes::from_static(b"now")).await?;
        let listed = self.list(PROBE).await;
        self.delete(&name).await?;
        let written = listed?.into_iter().find(|listed| listed.name == name).map(|listed| listed.written_at);
        written.ok_or_else(|| LibraryError::Invalid("the blob store does not list a blob that was written".into()))
    }
}

/// All folders: the first two digits of photos' ids.
pub(crate) fn prefixes() -> impl Iterator<Item = String> {
    (0..=u8::MAX).map(|byte| hex(&[byte]))
}

fn name(photo: PhotoId, part: Part, digest: &Digest) -> Result<String> {
    let id = photo.to_string();
    let digest = digest.as_str().get(..DIGITS).unwrap_or_default();
    Ok(format!("{}/{id}-{part}-{digest}-{}", id.get(..2).unwrap_or_default(), hex(&random::<8>()?)))
}
