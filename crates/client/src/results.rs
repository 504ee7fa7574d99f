//! Downloads a photo's results: container, scene, views, exports.

use std::time::Duration;

use bytes::Bytes;
use reqwest::Method;
use reqwest::StatusCode;
use reqwest::header::{ETAG, IF_NONE_MATCH};
use tmpi_core::Scene;
use tmpi_core::container;

use crate::photos::{photo_path, query};
use crate::request::Call;
use crate::{Client, Error, Problem};

/// Interval between state requests while the server writes an export.
const POLL_INTERVAL: Duration = Duration::from_millis(500);

/// The answer to a conditional request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fresh {
    /// New bytes, and the tag for the next request.
    New(Bytes, Option<String>),
    /// The bytes are unchanged.
    Same,
}

/// A view that the server renders.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    pairs: Vec<(String, String)>,
}

impl View {
    /// A view of this size in pixels, from the photo's reference camera.
    pub fn new(width: u32, height: u32) -> Self {
        Self { pairs: Vec::new() }.with("w", &width).with("h", &height)
    }

    /// Moves the camera right, down and forward, within the photo's view box. Units are metres in a scene whose nearest surface is 1 m
    /// away.
    pub fn at(self, x: f64, y: f64, z: f64) -> Self {
        self.with("tx", &x).with("ty", &y).with("tz", &z)
    }

    /// Sets the picture format: `jpeg`, `png` or `webp`.
    pub fn format(self, name: &str) -> Self {
        self.with("format", &name)
    }

    /// Sets a view parameter by name. The server's `OpenAPI` document lists all of them.
    pub fn with(mut self, name: &str, value: &impl ToString) -> Self {
        self.pairs.push((name.to_owned(), value.to_string()));
        self
    }
}

/// An export that the server writes as a job.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Export {
    pairs: Vec<(String, String)>,
}

impl Export {
    /// An export in this format: `html`, `glb`, `ora` or `zip`; with [`Export::along`] also `webp` or `mp4`.
    pub fn new(format: &str) -> Self {
        Self { pairs: vec![("format".to_owned(), format.to_owned())] }
    }

    /// Exports a film of this many frames, at 30 per second, along a camera path: `orbit`, `swing`, `dolly`, `dolly-zoom` or `zoom`.
    pub fn along(self, path: &str, frames: u32) -> Self {
        self.with("path", &path).with("frames", &frames)
    }

    /// Sets an export parameter by name. The server's `OpenAPI` document lists all of them.
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

/// The server's state of an export.
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
    /// [`Error`]; status 409 while the server is still processing the photo.
    pub async fn container(&self, id: &str) -> Result<Bytes, Error> {
        self.result(id, "/atlas").await
    }

    /// The container, unless it still has the entity tag `tag`.
    ///
    /// # Errors
    /// As [`Client::container`].
    pub async fn container_unless(&self, id: &str, tag: &str) -> Result<Fresh, Error> {
        let answer = self.request(Call::new(Method::GET, photo_path(id, "/atlas")).header(IF_NONE_MATCH, tag)?).await?;
        let now = answer.headers.get(ETAG).and_then(|v| v.to_str().ok()).map(str::to_owned);
        Ok(if answer.status == StatusCode::NOT_MODIFIED { Fresh::Same } else { Fresh::New(answer.body, now) })
    }

    /// A smaller container with the same planes, at `1 / 2^level` of the size.
    ///
    /// # Errors
    /// As [`Client::container`].
    pub async fn level(&self, id: &str, level: u8) -> Result<Bytes, Error> {
        self.result(id, &format!("/atlas?level={level}")).await
    }

    /// The decoded scene of a photo. Decoding takes about 50 ms of CPU time per megapixel.
    ///
    /// # Errors
    /// As [`Client::container`], and [`Error::Container`].
    pub async fn scene(&self, id: &str) -> Result<Scene, Error> {
        Ok(container::decode(&self.container(id).await?)?)
    }

    /// Renders a view and returns it as a picture file.
    ///
    /// # Errors
    /// [`Error`]; [`Error::Problem`] names the parameter.
    pub async fn view(&self, id: &str, view: &View) -> Result<Bytes, Error> {
        self.result(id, &query("/view", &view.pairs)?).await
    }

    /// The processing report, with errors and costs.
    ///
    /// # Errors
    /// As [`Client::container`].
    pub async fn report(&self, id: &str) -> Result<serde_json::Value, Error> {
        self.request(Call::new(Method::GET, photo_path(id, "/report"))).await?.json()
    }

    /// The disparity that the planes are fitted to, as a 16-bit grey PNG.
    ///
    /// # Errors
    /// As [`Client::container`].
    pub async fn depth(&self, id: &str) -> Result<Bytes, Error> {
        self.result(id, "/depth").await
    }

    /// A thumbnail, as JPEG.
    ///
    /// # Errors
    /// As [`Client::container`].
    pub async fn thumbnail(&self, id: &str) -> Result<Bytes, Error> {
        self.result(id, "/thumbnail").await
    }

    /// Requests an export, waits for it and downloads it. You can pass just a format. If you drop this future, the server still writes the
    /// file, and the same call finds it later.
    ///
    /// # Errors
    /// As [`Client::container`], and [`Error::Problem`] if the server could not write the file.
    pub async fn export(&self, id: &str, what: impl Into<Export>) -> Result<Bytes, Error> {
        let what = what.into();
        // idempotent: the same request yields the same file
        let order = Call::new(Method::POST, photo_path(id, &query("/exports", &what.pairs)?));
        let mut state: ExportState = self.request(order).await?.json()?;
        loop {
            match (state.state.as_str(), state.problem) {
                ("done", _) => return Ok(self.request(Call::new(Method::GET, state.links.file)).await?.body),
                ("failed", Some(problem)) => return Err(Error::Problem(Box::new(problem))),
                ("queued" | "working", _) => {}
                (other, _) => return Err(Error::Answer(format!("unknown export state {other:?}"))),
            }
            tokio::time::sleep(POLL_INTERVAL).await;
            state = self.request(Call::new(Method::GET, state.links.this)).await?.json()?;
        }
    }

    async fn result(&self, id: &str, rest: &str) -> Result<Bytes, Error> {
        Ok(self.request(Call::new(Method::GET, photo_path(id, rest))).await?.body)
    }
}
