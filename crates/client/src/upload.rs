//! Uploads: the photo's bytes with options in the query, or a form where a depth map comes along.

use std::fmt::Write as _;
use std::hash::{BuildHasher, Hasher, RandomState};
use std::path::Path;
use std::time::Duration;

use bytes::Bytes;
use reqwest::Method;
use reqwest::header::{CONTENT_TYPE, HeaderName};

use crate::client::Call;
use crate::retry::Again;
use crate::{Client, Error, PhotoState, Visibility};

/// Characters of a title, at most.
const TITLE: usize = 200;
/// Bytes a second that the server wants of an upload, at least.
const SLOWEST: usize = 8 << 10;

/// A photo to upload.
#[derive(Clone, Debug)]
pub struct Upload {
    photo: Bytes,
    depth: Option<Bytes>,
    fields: Vec<(String, String)>,
    wait: Duration,
}

impl Upload {
    /// A JPEG, PNG or WebP.
    #[must_use]
    pub fn bytes(photo: impl Into<Bytes>) -> Self {
        Self { photo: photo.into(), depth: None, fields: Vec::new(), wait: Duration::ZERO }
    }

    /// The same of a file, by whose name it is called unless it gets a [`Upload::title`].
    ///
    /// # Errors
    /// [`Error::File`] where it cannot be read.
    pub async fn file(path: impl AsRef<Path>) -> Result<Self, Error> {
        let path = path.as_ref();
        let read = tokio::fs::read(path).await;
        let photo = read.map_err(|source| Error::File { path: path.display().to_string(), source })?;
        let name: String = path.file_stem().unwrap_or_default().to_string_lossy().chars().filter(|c| !c.is_control()).take(TITLE).collect();
        let upload = Self::bytes(photo);
        Ok(if name.trim().is_empty() { upload } else { upload.title(name) })
    }

    /// What to call the photo, 1 to 200 characters.
    #[must_use]
    pub fn title(self, title: impl Into<String>) -> Self {
        self.option("title", title)
    }

    /// Who may see it.
    #[must_use]
    pub fn visibility(self, visibility: Visibility) -> Self {
        self.option("visibility", visibility.name())
    }

    /// A depth map in place of the estimated depth: a grey picture, larger is nearer unless `depth_kind` is `metric`.
    #[must_use]
    pub fn depth(mut self, map: impl Into<Bytes>) -> Self {
        self.depth = Some(map.into());
        self
    }

    /// An option of `tmpi make` by its name: `planes`, `tile`, `max_size`, `quality`, `view_box`, `budget_ms` and so on. The last of one name counts.
    #[must_use]
    pub fn option(mut self, name: impl Into<String>, value: impl Into<String>) -> Self {
        let name = name.into();
        self.fields.retain(|(n, _)| *n != name);
        self.fields.push((name, value.into()));
        self
    }

    /// How long the server may wait for the photo to be made before it answers (`Prefer: wait`), in whole seconds; not at all if not given. It
    /// answers earlier where its own limit on requests is shorter.
    #[must_use]
    pub fn prefer_wait(mut self, wait: Duration) -> Self {
        self.wait = wait;
        self
    }

    fn call(&self, client: &Client) -> Result<Call, Error> {
        let mut call = client.call(Method::POST, "/v1/photos")?;
        if let Some(depth) = &self.depth {
            let (kind, body) = form(&self.photo, depth, &self.fields);
            call.body = body;
            call = call.header(CONTENT_TYPE, &kind)?;
        } else {
            call = self.fields.iter().fold(call, |call, (name, value)| call.parameter(name, value));
            call.body = self.photo.clone();
            call = call.header(CONTENT_TYPE, "application/octet-stream")?;
        }
        let seconds = self.wait.as_secs();
        if seconds > 0 {
            call = call.header(HeaderName::from_static("prefer"), &format!("wait={seconds}"))?;
        }
        call.patience += self.wait + Duration::from_secs((call.body.len() / SLOWEST) as u64);
        // whoever has no secret gets a new one each time, and another photo with it
        call.again = if client.is_owner() { Again::Safe } else { Again::Undone };
        Ok(call)
    }
}

/// A form (RFC 7578): its media type and its bytes.
fn form(photo: &[u8], depth: &[u8], fields: &[(String, String)]) -> (String, Bytes) {
    let random = || RandomState::new().build_hasher().finish();
    let boundary = format!("tmpi-{:016x}{:016x}", random(), random());
    let mut body = Vec::new();
    let mut part = |name: &str, file: bool, bytes: &[u8]| {
        let mut head = format!("--{boundary}\r\ncontent-disposition: form-data; name=\"{}\"", name.replace(['"', '\r', '\n'], "_"));
        if file {
            _ = write!(head, "; filename=\"{name}\"");
        }
        body.extend_from_slice(head.as_bytes());
        body.extend_from_slice(b"\r\n\r\n");
        body.extend_from_slice(bytes);
        body.extend_from_slice(b"\r\n");
    };
    for (name, value) in fields {
        part(name, false, value.as_bytes());
    }
    part("photo", true, photo);
    part("depth", true, depth);
    body.extend_from_slice(format!("--{boundary}--\r\n").as_bytes());
    (format!("multipart/form-data; boundary={boundary}"), body.into())
}

impl Client {
    /// Uploads a photo. Once this is answered it is on the server's disk; [`Client::wait`] waits until it is made. The same upload of one owner
    /// again is the same photo.
    ///
    /// # Errors
    /// [`Error::Refused`]: an option is wrong (400), too large (413), no picture (415), damaged (422), too many wait (429).
    pub async fn upload(&self, upload: &Upload) -> Result<PhotoState, Error> {
        self.fetch(&upload.call(self)?).await?.json()
    }
}
