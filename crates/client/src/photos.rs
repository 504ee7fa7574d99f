//! State, list, settings, strokes, links and deletion of photos, and waiting for them.

use std::time::Duration;

use bytes::Bytes;
use reqwest::Method;
use reqwest::header::{CONTENT_TYPE, ETAG, IF_MATCH};
use serde::Serialize;
use serde_json::{Map, Value};
use tokio::time::Instant;

use crate::client::Call;
use crate::retry::{Again, pause};
use crate::{Client, Error, Event, Link, PhotoList, PhotoState, State, Stroke, Strokes, Visibility};

/// With the tag of its version, to change just that one.
#[derive(Clone, Debug, PartialEq)]
pub struct Tagged<T> {
    /// What it is.
    pub value: T,
    /// Its entity tag.
    pub etag: Option<String>,
}

/// What to change of a photo's settings; what is not named stays.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[serde(transparent)]
pub struct Change(Map<String, Value>);

impl Change {
    /// Nothing yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Another title, 1 to 200 characters.
    #[must_use]
    pub fn title(self, title: &str) -> Self {
        self.set("title", title)
    }

    /// Who may see it.
    #[must_use]
    pub fn visibility(self, visibility: Visibility) -> Self {
        self.set("visibility", visibility.name())
    }

    /// A setting by its name in [`crate::Settings`], as JSON.
    #[must_use]
    pub fn set(mut self, name: &str, value: impl Into<Value>) -> Self {
        self.0.insert(name.to_owned(), value.into());
        self
    }

    /// Leaves a setting to viewers.
    #[must_use]
    pub fn remove(self, name: &str) -> Self {
        self.set(name, Value::Null)
    }
}

impl Client {
    /// How a photo fares.
    ///
    /// # Errors
    /// [`Error::Refused`]: there is no such photo, or it is somebody else's (404).
    pub async fn state(&self, id: &str) -> Result<Tagged<PhotoState>, Error> {
        let answer = self.fetch(&self.photo(Method::GET, id, "")?).await?;
        Ok(Tagged { value: answer.json()?, etag: answer.header(&ETAG) })
    }

    /// A page of photos, newest first: `limit` (1 to 200; 50), after the photo `after`.
    ///
    /// # Errors
    /// [`Error::Refused`]: the list is closed (403), a parameter is wrong (400).
    pub async fn list(&self, limit: Option<u32>, after: Option<&str>) -> Result<PhotoList, Error> {
        let mut call = self.call(Method::GET, "/v1/photos")?;
        if let Some(limit) = limit {
            call = call.parameter("limit", limit);
        }
        if let Some(after) = after {
            call = call.parameter("after", after);
        }
        self.fetch(&call).await?.json()
    }

    /// The page after `page`; none after the last.
    ///
    /// # Errors
    /// As [`Client::list`].
    pub async fn next_page(&self, page: &PhotoList) -> Result<Option<PhotoList>, Error> {
        let Some(next) = &page.next else { return Ok(None) };
        self.fetch(&self.call(Method::GET, next)?).await?.json().map(Some)
    }

    /// What was done, what was left out, and at what error and cost. Its fields grow with the pipeline: see `Report` in the server's
    /// `/openapi.json`.
    ///
    /// # Errors
    /// [`Error::Refused`]: no such photo (404), not finished (409).
    pub async fn report(&self, id: &str) -> Result<Value, Error> {
        self.fetch(&self.photo(Method::GET, id, "/report")?).await?.json()
    }

    /// Changes settings; with `seen`, the tag of a state, only if they are still those.
    ///
    /// # Errors
    /// [`Error::Refused`]: a setting is wrong (400), no such photo (404), changed meanwhile (412).
    pub async fn change(&self, id: &str, change: &Change, seen: Option<&str>) -> Result<Tagged<PhotoState>, Error> {
        self.patch(self.photo(Method::PATCH, id, "")?, change, seen).await
    }

    /// The strokes that a photo's depth is touched up with.
    ///
    /// # Errors
    /// [`Error::Refused`]: no such photo (404).
    pub async fn strokes(&self, id: &str) -> Result<Tagged<Strokes>, Error> {
        let answer = self.fetch(&self.photo(Method::GET, id, "/strokes")?).await?;
        Ok(Tagged { value: answer.json()?, etag: answer.header(&ETAG) })
    }

    /// Replaces all strokes; the photo is made again with them. The tag that is given back is that of the strokes; with `seen`, only if they
    /// are still those.
    ///
    /// # Errors
    /// [`Error::Refused`]: a stroke is wrong (400), no such photo (404), it is being made (409), changed meanwhile (412).
    pub async fn touch_up(&self, id: &str, strokes: &[Stroke], seen: Option<&str>) -> Result<Tagged<PhotoState>, Error> {
        self.patch(self.photo(Method::PATCH, id, "/strokes")?, &Strokes { strokes: strokes.to_vec() }, seen).await
    }

    /// A link by which others read the photo for `seconds` (1 to 31622400; a day).
    ///
    /// # Errors
    /// [`Error::Refused`]: no such photo (404).
    pub async fn link(&self, id: &str, seconds: Option<u64>) -> Result<Link, Error> {
        let mut call = self.photo(Method::POST, id, "/links")?;
        // nothing is kept of a link
        call.again = Again::Safe;
        if let Some(seconds) = seconds {
            call = call.parameter("seconds", seconds);
        }
        self.fetch(&call).await?.json()
    }

    /// Deletes a photo and everything that was made of it.
    ///
    /// # Errors
    /// [`Error::Refused`]: no such photo (404).
    pub async fn delete(&self, id: &str) -> Result<(), Error> {
        self.fetch(&self.photo(Method::DELETE, id, "")?).await.map(drop)
    }

    /// Waits until a photo is made, for at most `limit`, and tells `told` what happens meanwhile. It follows the photo's events; where these break
    /// off it asks for its state, ever more seldom.
    ///
    /// # Errors
    /// [`Error::NotMade`] with the problem, [`Error::Deleted`], [`Error::Late`], or [`Error::Refused`] where there is no such photo.
    pub async fn wait(&self, id: &str, limit: Duration, mut told: impl FnMut(&Event)) -> Result<PhotoState, Error> {
        let end = Instant::now() + limit;
        tokio::time::timeout_at(end, self.follow(id, &mut told)).await.unwrap_or(Err(Error::Late(limit)))
    }

    async fn follow(&self, id: &str, told: &mut impl FnMut(&Event)) -> Result<PhotoState, Error> {
        let mut rounds = 0;
        loop {
            match self.events(id).await {
                Ok(mut events) => {
                    while let Ok(Some(event)) = events.next().await {
                        rounds = 0;
                        told(&event);
                        match event {
                            Event::Done(state) => return Ok(*state),
                            Event::Failed(problem) | Event::Damaged(problem) => return Err(Error::NotMade(problem)),
                            Event::Deleted => return Err(Error::Deleted),
                            Event::Queued { .. } | Event::Stage(_) => {}
                        }
                    }
                }
                // a photo that is not there does not come; whatever else goes wrong with events, its state may be had
                Err(error) if error.status().is_some_and(|status| status < 429) => return Err(error),
                Err(_) => {}
            }
            let state = self.state(id).await?.value;
            match (state.state, state.problem) {
                (State::Done, _) => return Ok(state),
                (State::Failed | State::Damaged, Some(problem)) => return Err(Error::NotMade(Box::new(problem))),
                _ => tokio::time::sleep(pause(rounds, self.longest_pause().min(Duration::from_secs(10)))).await,
            }
            rounds += 1;
        }
    }

    async fn patch<T: Serialize>(&self, call: Call, patch: &T, seen: Option<&str>) -> Result<Tagged<PhotoState>, Error> {
        let mut call = call.header(CONTENT_TYPE, "application/merge-patch+json")?;
        call.body = Bytes::from(serde_json::to_vec(patch).map_err(|e| Error::Input(e.to_string()))?);
        if let Some(seen) = seen {
            call = call.header(IF_MATCH, seen)?;
        }
        let answer = self.fetch(&call).await?;
        Ok(Tagged { value: answer.json()?, etag: answer.header(&ETAG) })
    }
}
