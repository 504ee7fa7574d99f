//! Uploading, listing, changing and deleting photos.

use std::time::Duration;

use bytes::Bytes;
use reqwest::header::{CONTENT_TYPE, HeaderName};
use reqwest::{Method, Url};
use serde::Deserialize;

use crate::answer::Call;
use crate::form::form;
use crate::{Client, Error, Link, PhotoState, Settings, State, Visibility};

const PREFER: HeaderName = HeaderName::from_static("prefer");

/// A photo to upload, and what is to be made of it.
#[derive(Clone, Debug, Default)]
pub struct Upload {
    photo: Bytes,
    depth: Option<Bytes>,
    options: Vec<(String, String)>,
    wait: Option<Duration>,
}

impl Upload {
    /// A photo as JPEG, PNG or WebP.
    #[must_use]
    pub fn of(photo: impl Into<Bytes>) -> Self {
        Self { photo: photo.into(), ..Self::default() }
    }

    /// With a depth map, a grey picture, in place of the estimated depth.
    #[must_use]
    pub fn depth(mut self, map: impl Into<Bytes>) -> Self {
        self.depth = Some(map.into());
        self
    }

    /// What to call the photo, 1 to 200 characters.
    #[must_use]
    pub fn title(self, title: &str) -> Self {
        self.option("title", title)
    }

    /// Who may see it, on a server with authentication.
    #[must_use]
    pub fn visibility(self, who: Visibility) -> Self {
        self.option("visibility", if who == Visibility::Link { "link" } else { "private" })
    }

    /// An option of the upload by its name, as `max_size` or `planes`; the server's `OpenAPI` document has all of them.
    #[must_use]
    pub fn option(mut self, name: &str, value: &str) -> Self {
        self.options.push((name.to_owned(), value.to_owned()));
        self
    }

    /// Waits up to this time for the photo to be made.
    #[must_use]
    pub fn wait(mut self, most: Duration) -> Self {
        self.wait = Some(most);
        self
    }
}

/// A page of the list.
#[derive(Deserialize)]
struct Page {
    photos: Vec<PhotoState>,
    next: Option<String>,
}

impl Client {
    /// Uploads a photo. When this returns it is on the server's disk, and is made even if the server is restarted.
    ///
    /// The same upload by the same owner is the same photo, so the client retries after network failures – but not without a key, because a
    /// server with authentication then creates another owner each time.
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
        call.again = !self.headers.is_empty();
        if let Some(wait) = wait {
            call = call.header(PREFER, &format!("wait={}", wait.as_secs()))?;
        }
        self.ask(call).await?.json()
    }

    /// State, sizes and settings of a photo.
    ///
    /// # Errors
    /// [`Error`]; status 404 where there is no such photo, or it is another's.
    pub async fn photo(&self, id: &str) -> Result<PhotoState, Error> {
        self.ask(Call::new(Method::GET, part(id, ""))).await?.json()
    }

    /// All photos that the caller may list, newest first.
    ///
    /// # Errors
    /// [`Error`]; status 403 where the list is closed.
    pub async fn photos(&self) -> Result<Vec<PhotoState>, Error> {
        let (mut all, mut next) = (Vec::new(), Some("/v1/photos?limit=200".to_owned()));
        while let Some(path) = next {
            let page: Page = self.ask(Call::new(Method::GET, path)).await?.json()?;
            all.extend(page.photos);
            next = page.next;
        }
        Ok(all)
    }

    /// Changes the owner's settings for viewers: the fields in `change`; the rest stays.
    ///
    /// # Errors
    /// [`Error`]; [`Error::Problem`] names the setting.
    pub async fn change(&self, id: &str, change: &Settings) -> Result<PhotoState, Error> {
        let body = serde_json::to_vec(change).map_err(|e| Error::Answer(e.to_string()))?;
        self.ask(Call::new(Method::PATCH, part(id, "")).header(CONTENT_TYPE, "application/merge-patch+json")?.body(body)).await?.json()
    }

    /// Deletes a photo and everything made from it.
    ///
    /// # Errors
    /// [`Error`]; status 404 where there was none, or it is another's.
    pub async fn delete(&self, id: &str) -> Result<(), Error> {
        self.ask(Call::new(Method::DELETE, part(id, ""))).await.map(drop)
    }

    /// Revokes all links to a photo: those for viewing, and the one for changing it. Only its owner may.
    ///
    /// # Errors
    /// [`Error`]; status 404 where there is none, or it is another's.
    pub async fn take_links_back(&self, id: &str) -> Result<(), Error> {
        self.ask(Call::new(Method::DELETE, part(id, "/manage"))).await.map(drop)
    }

    /// A link by which others can read a photo for `seconds`, 1 to 31 622 400, or as long as is usual; and one by which they can change it.
    ///
    /// # Errors
    /// [`Error`]; status 400 for `seconds` where the server has no authentication: its links have no end.
    pub async fn link(&self, id: &str, seconds: Option<u64>) -> Result<Link, Error> {
        let query = seconds.map(|seconds| format!("?seconds={seconds}")).unwrap_or_default();
        self.ask(Call::new(Method::POST, part(id, &format!("/links{query}")))).await?.json()
    }
}

impl PhotoState {
    /// The state, or why there is none to go on with.
    ///
    /// # Errors
    /// [`Error::Photo`] where it could not be made or is damaged.
    pub fn sound(self) -> Result<Self, Error> {
        match (self.state, &self.problem) {
            (State::Failed | State::Damaged, Some(problem)) => {
                Err(Error::Photo { id: self.id.clone(), problem: Box::new(problem.clone()) })
            }
            _ => Ok(self),
        }
    }
}

/// An address of a photo. What is no id stays within its segment.
pub(crate) fn part(id: &str, rest: &str) -> String {
    let plain = |b: &u8| b.is_ascii_alphanumeric() || matches!(b, b'-' | b'_');
    let id: String = id.bytes().map(|b| if plain(&b) { char::from(b).to_string() } else { format!("%{b:02X}") }).collect();
    format!("/v1/photos/{id}{rest}")
}

/// A path with a query.
pub(crate) fn query(path: &str, pairs: &[(String, String)]) -> Result<String, Error> {
    if pairs.is_empty() {
        return Ok(path.to_owned());
    }
    let url = Url::parse_with_params("http://localhost", pairs).map_err(|e| Error::Answer(e.to_string()))?;
    Ok(format!("{path}?{}", url.query().unwrap_or_default()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_sent_stays_in_its_place() {
        assert_eq!(part("0a", "/atlas"), "/v1/photos/0a/atlas");
        assert_eq!(part("../x?y#z", ""), "/v1/photos/%2E%2E%2Fx%3Fy%23z");
        let pairs = [("title".to_owned(), "a&b=c d".to_owned())];
        assert_eq!(query("/v1/photos", &pairs).unwrap(), "/v1/photos?title=a%26b%3Dc+d");
    }
}
