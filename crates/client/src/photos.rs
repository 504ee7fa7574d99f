//! Uploads, lists, changes and deletes photos.

use std::time::Duration;

use bytes::{BufMut as _, Bytes, BytesMut};
use reqwest::header::{CONTENT_TYPE, HeaderName};
use reqwest::{Method, Url};
use serde::{Deserialize, Serialize};

use crate::request::Call;
use crate::{Client, Error, Link, PhotoState, State, hex};

const PREFER: HeaderName = HeaderName::from_static("prefer");

/// A photo to upload, with its options.
#[derive(Clone, Debug, Default)]
pub struct Upload {
    photo: Bytes,
    depth: Option<Bytes>,
    options: Vec<(String, String)>,
    wait: Option<Duration>,
}

impl Upload {
    /// Uploads a photo: JPEG, PNG or WebP.
    pub fn of(photo: impl Into<Bytes>) -> Self {
        Self { photo: photo.into(), ..Self::default() }
    }

    /// Adds a depth map, a grey picture, which replaces the estimated depth.
    pub fn depth(mut self, map: impl Into<Bytes>) -> Self {
        self.depth = Some(map.into());
        self
    }

    /// Sets an upload option by name, for example `title`, `visibility` or `planes`. The server's `OpenAPI` document lists all of them.
    pub fn option(mut self, name: &str, value: &str) -> Self {
        self.options.push((name.to_owned(), value.to_owned()));
        self
    }

    /// Waits up to this long for the server to process the photo.
    pub fn wait(mut self, most: Duration) -> Self {
        self.wait = Some(most);
        self
    }
}

/// One page of the photo list.
#[derive(Deserialize)]
struct Page {
    photos: Vec<PhotoState>,
    next: Option<String>,
}

impl Client {
    /// Uploads a photo. When this returns, the photo is on the server's disk and will be processed even if the server restarts.
    ///
    /// If an owner uploads the same photo twice, the server keeps one, so the client retries after network failures. It does not retry
    /// without a key, because a server with authentication then creates a new owner for each attempt.
    ///
    /// # Errors
    /// [`Error`]; [`Error::Problem`] names the field or the limit.
    pub async fn upload(&self, upload: Upload) -> Result<PhotoState, Error> {
        let Upload { photo, depth, options, wait } = upload;
        let (path, kind, body) = match depth {
            None => (query("/v1/photos", &options)?, "application/octet-stream".to_owned(), photo),
            Some(depth) => {
                let texts = options.iter().map(|(name, value)| (name.as_str(), value.as_bytes()));
                let parts: Vec<(&str, &[u8])> = [("photo", &photo[..]), ("depth", &depth[..])].into_iter().chain(texts).collect();
                let (kind, body) = form(&parts)?;
                ("/v1/photos".to_owned(), kind, body)
            }
        };
        let mut call = Call::new(Method::POST, path).header(CONTENT_TYPE, &kind)?.body(body);
        call.idempotent = !self.headers.is_empty();
        if let Some(wait) = wait {
            call = call.header(PREFER, &format!("wait={}", wait.as_secs()))?;
        }
        self.request(call).await?.json()
    }

    /// State, sizes and settings of a photo.
    ///
    /// # Errors
    /// [`Error`]; status 404 if the photo does not exist or has another owner.
    pub async fn photo(&self, id: &str) -> Result<PhotoState, Error> {
        self.request(Call::new(Method::GET, photo_path(id, ""))).await?.json()
    }

    /// All photos that the caller may list, newest first.
    ///
    /// # Errors
    /// [`Error`]; status 403 if the server does not list photos.
    pub async fn photos(&self) -> Result<Vec<PhotoState>, Error> {
        let (mut all, mut next) = (Vec::new(), Some("/v1/photos?limit=200".to_owned()));
        while let Some(path) = next {
            let page: Page = self.request(Call::new(Method::GET, path)).await?.json()?;
            all.extend(page.photos);
            next = page.next;
        }
        Ok(all)
    }

    /// Changes a photo by a merge patch (RFC 7396) of what is at `path` below it: `""` are its [`Settings`](crate::Settings), `/strokes` the
    /// strokes that correct its depth. Fields that `change` leaves out keep their value. After a change of its strokes the server processes
    /// the photo again under the same id; wait for it with [`Client::finished`].
    ///
    /// # Errors
    /// [`Error`]; [`Error::Problem`] names the field.
    pub async fn change(&self, id: &str, path: &str, change: &impl Serialize) -> Result<PhotoState, Error> {
        let body = serde_json::to_vec(change).map_err(|e| Error::Answer(e.to_string()))?;
        let mut call = Call::new(Method::PATCH, photo_path(id, path)).header(CONTENT_TYPE, "application/merge-patch+json")?.body(body);
        // strokes start processing, during which the server refuses others
        call.idempotent = path.is_empty();
        self.request(call).await?.json()
    }

    /// Deletes a photo and everything made from it.
    ///
    /// # Errors
    /// [`Error`]; status 404 if the photo does not exist or has another owner.
    pub async fn delete(&self, id: &str) -> Result<(), Error> {
        self.request(Call::new(Method::DELETE, photo_path(id, ""))).await.map(drop)
    }

    /// Revokes all links to a photo, both view links and the manage link. Only its owner may do this.
    ///
    /// # Errors
    /// [`Error`]; status 404 if the photo does not exist or has another owner.
    pub async fn take_links_back(&self, id: &str) -> Result<(), Error> {
        self.request(Call::new(Method::DELETE, photo_path(id, "/manage"))).await.map(drop)
    }

    /// Creates a link that lets others view a photo for `seconds`, 1 to 31 622 400 (`None`: the server's default), and one that lets them
    /// change it.
    ///
    /// # Errors
    /// [`Error`]; status 400 if `seconds` is set and the server has no authentication: its links do not expire.
    pub async fn link(&self, id: &str, seconds: Option<u64>) -> Result<Link, Error> {
        let query = seconds.map(|seconds| format!("?seconds={seconds}")).unwrap_or_default();
        self.request(Call::new(Method::POST, photo_path(id, &format!("/links{query}")))).await?.json()
    }
}

impl PhotoState {
    /// Returns the state, unless the photo failed or is damaged.
    ///
    /// # Errors
    /// [`Error::Photo`] if the photo failed or is damaged.
    pub fn sound(self) -> Result<Self, Error> {
        match (self.state, &self.problem) {
            (State::Failed | State::Damaged, Some(problem)) => {
                Err(Error::Photo { id: self.id.clone(), problem: Box::new(problem.clone()) })
            }
            _ => Ok(self),
        }
    }
}

/// Path of a photo's resource. Percent-encodes `id`, so that an invalid one stays within its path segment.
pub(crate) fn photo_path(id: &str, rest: &str) -> String {
    let plain = |b: &u8| b.is_ascii_alphanumeric() || matches!(b, b'-' | b'_');
    let id: String = id.bytes().map(|b| if plain(&b) { char::from(b).to_string() } else { format!("%{b:02X}") }).collect();
    format!("/v1/photos/{id}{rest}")
}

/// Appends a query to a path.
pub(crate) fn query<K: AsRef<str>, V: AsRef<str>>(path: &str, pairs: &[(K, V)]) -> Result<String, Error> {
    if pairs.is_empty() {
        return Ok(path.to_owned());
    }
    let url = Url::parse_with_params("http://localhost", pairs).map_err(|e| Error::Answer(e.to_string()))?;
    Ok(format!("{path}?{}", url.query().unwrap_or_default()))
}

/// Encodes a multipart form (RFC 7578); returns its media type and body.
fn form(parts: &[(&str, &[u8])]) -> Result<(String, Bytes), Error> {
    let mut random = [0; 16];
    getrandom::fill(&mut random).map_err(|_| Error::Key)?;
    // 128 random bits do not occur in any part
    let boundary = hex(&random);
    let mut body = BytesMut::with_capacity(parts.iter().map(|(name, bytes)| name.len() + bytes.len() + 128).sum::<usize>() + 64);
    for (name, bytes) in parts {
        body.put_slice(format!("--{boundary}\r\ncontent-disposition: form-data; name=\"{name}\"\r\n\r\n").as_bytes());
        body.put_slice(bytes);
        body.put_slice(b"\r\n");
    }
    body.put_slice(format!("--{boundary}--\r\n").as_bytes());
    Ok((format!("multipart/form-data; boundary={boundary}"), body.freeze()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_and_queries_are_percent_encoded() {
        assert_eq!(photo_path("0a", "/atlas"), "/v1/photos/0a/atlas");
        assert_eq!(photo_path("../x?y#z", ""), "/v1/photos/%2E%2E%2Fx%3Fy%23z");
        assert_eq!(query("/v1/photos", &[("title", "a&b=c d")]).unwrap(), "/v1/photos?title=a%26b%3Dc+d");
    }
}
