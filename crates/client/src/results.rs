//! Results of a photo: container, scene, views, exports.

use std::time::Duration;

use bytes::Bytes;
use reqwest::Method;
use reqwest::StatusCode;
use reqwest::header::{ETAG, IF_NONE_MATCH};
use tmpi_core::Scene;
use tmpi_core::container;

use crate::answer::Call;
use crate::photos::{part, query};
use crate::{Client, Error, Problem};

/// Polling interval for a file that is being written.
const LOOK: Duration = Duration::from_millis(500);

/// The answer to a conditional request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fresh {
    /// New bytes, and the tag for the next request.
    New(Bytes, Option<String>),
    /// The bytes are unchanged.
    Same,
}

/// A view that the server draws.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    pairs: Vec<(String, String)>,
}

impl View {
    /// From the photo's own place, in pixels.
    #[must_use]
    pub fn new(width: u32, height: u32) -> Self {
        Self { pairs: Vec::new() }.with("w", &width).with("h", &height)
    }

    /// From another place: metres to the right, down and forward in a scene whose nearest thing is a metre away; within the photo's view
    /// box.
    #[must_use]
    pub fn at(self, x: f64, y: f64, z: f64) -> Self {
        self.with("tx", &x).with("ty", &y).with("tz", &z)
    }

    /// `jpeg`, `png` or `webp`.
    #[must_use]
    pub fn format(self, name: &str) -> Self {
        self.with("format", &name)
    }

    /// Another parameter of the view by its name; the server's `OpenAPI` document has all of them.
    #[must_use]
    pub fn with(mut self, name: &str, value: &impl ToString) -> Self {
        self.pairs.push((name.to_owned(), value.to_string()));
        self
    }
}

/// A file to download, which the server writes as a job.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Export {
    pairs: Vec<(String, String)>,
}

impl Export {
    /// In this format: `html`, `glb`, `ora` or `zip`, or `webp` or `mp4` with [`Export::along`].
    #[must_use]
    pub fn new(format: &str) -> Self {
        Self { pairs: vec![("format".to_owned(), format.to_owned())] }
    }

    /// A film of so many frames, 30 a second, along a way of the camera: `orbit`, `swing`, `dolly`, `dolly-zoom` or `zoom`.
    #[must_use]
    pub fn along(self, path: &str, frames: u32) -> Self {
        self.with("path", &path).with("frames", &frames)
    }

    /// Another parameter by its name; the server's `OpenAPI` document has all of them.
    #[must_use]
    pub fn with(mut self, name: &str, value: &impl ToString) -> Self {
        self.pairs.push((name.to_owned(), value.to_string()));
        self
    }
}

impl From<&str> for Export {
    fn from(format: &str) -> Self {
        Self::new(format)
    }
}

/// State of an export.
#[derive(serde::Deserialize)]
struct ExportState {
    state: String,
    problem: Option<Problem>,
    links: ExportLinks,
}

#[derive(serde::Deserialize)]
struct ExportLinks {
    #[serde(rename = "self")]
    this: String,
    file: String,
}

impl Client {
    /// The container of a photo.
    ///
    /// # Errors
    /// [`Error`]; status 409 while the photo is not made yet.
    pub async fn container(&self, id: &str) -> Result<Bytes, Error> {
        self.result(id, "/atlas").await
    }

    /// The container, unless it is still that of `tag`.
    ///
    /// # Errors
    /// As [`Client::container`].
    pub async fn container_unless(&self, id: &str, tag: &str) -> Result<Fresh, Error> {
        let answer = self.ask(Call::new(Method::GET, part(id, "/atlas")).header(IF_NONE_MATCH, tag)?).await?;
        let now = answer.headers.get(ETAG).and_then(|v| v.to_str().ok()).map(str::to_owned);
        Ok(if answer.status == StatusCode::NOT_MODIFIED { Fresh::Same } else { Fresh::New(answer.body, now) })
    }

    /// A smaller container of the same planes, at `1 / 2^level` of the size.
    ///
    /// # Errors
    /// As [`Client::container`].
    pub async fn level(&self, id: &str, level: u8) -> Result<Bytes, Error> {
        self.result(id, &format!("/atlas?level={level}")).await
    }

    /// The decoded scene of a photo. Decoding keeps a core busy for some 50 ms a megapixel.
    ///
    /// # Errors
    /// As [`Client::container`], and [`Error::Container`].
    pub async fn scene(&self, id: &str) -> Result<Scene, Error> {
        Ok(container::decode(&self.container(id).await?)?)
    }

    /// A view as a picture file.
    ///
    /// # Errors
    /// [`Error`]; [`Error::Problem`] names the parameter.
    pub async fn view(&self, id: &str, view: &View) -> Result<Bytes, Error> {
        self.result(id, &query("/view", &view.pairs)?).await
    }

    /// The report: what was done, with errors and costs.
    ///
    /// # Errors
    /// As [`Client::container`].
    pub async fn report(&self, id: &str) -> Result<serde_json::Value, Error> {
        self.ask(Call::new(Method::GET, part(id, "/report"))).await?.json()
    }

    /// Disparity as used, a grey PNG of 16 bits.
    ///
    /// # Errors
    /// As [`Client::container`].
    pub async fn depth(&self, id: &str) -> Result<Bytes, Error> {
        self.result(id, "/depth").await
    }

    /// A small JPEG.
    ///
    /// # Errors
    /// As [`Client::container`].
    pub async fn thumbnail(&self, id: &str) -> Result<Bytes, Error> {
        self.result(id, "/thumbnail").await
    }

    /// Orders an export, waits for it and downloads it; a format alone will do. If this future is dropped, the server still writes the
    /// file, and the same call finds it.
    ///
    /// # Errors
    /// As [`Client::container`], and [`Error::Problem`] with why it could not be written.
    pub async fn export(&self, id: &str, what: impl Into<Export>) -> Result<Bytes, Error> {
        let what = what.into();
        // idempotent: the same order is the same file
        let order = Call::new(Method::POST, part(id, &query("/exports", &what.pairs)?));
        let mut state: ExportState = self.ask(order).await?.json()?;
        loop {
            match (state.state.as_str(), state.problem) {
                ("done", _) => return Ok(self.ask(Call::new(Method::GET, state.links.file)).await?.body),
                ("failed", Some(problem)) => return Err(Error::Problem(Box::new(problem))),
                ("queued" | "working", _) => {}
                (other, _) => return Err(Error::Answer(format!("a file that is {other:?}"))),
            }
            tokio::time::sleep(LOOK).await;
            state = self.ask(Call::new(Method::GET, state.links.this)).await?.json()?;
        }
    }

    async fn result(&self, id: &str, rest: &str) -> Result<Bytes, Error> {
        Ok(self.ask(Call::new(Method::GET, part(id, rest))).await?.body)
    }
}
