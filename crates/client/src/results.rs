//! Downloads a photo's results: container, scene, views, exports.

use std::time::Duration;

use bytes::Bytes;
use reqwest::Method;
use serde::Deserialize;
use tmpi_core::Scene;
use tmpi_core::container;

use crate::photos::{photo_path, query};
use crate::request::Call;
use crate::{Client, Error, Problem};

/// Interval between state requests while the server writes an export.
const POLL_INTERVAL: Duration = Duration::from_millis(500);

/// The server's state of an export.
#[derive(Deserialize)]
struct ExportState {
    state: String,
    problem: Option<Problem>,
    links: ExportLinks,
}

#[derive(Deserialize)]
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
        self.part(id, "/atlas").await
    }

    /// The decoded scene of a photo. Decoding takes about 50 ms of CPU time per megapixel.
    ///
    /// # Errors
    /// As [`Client::container`], and [`Error::Container`].
    pub async fn scene(&self, id: &str) -> Result<Scene, Error> {
        Ok(container::decode(&self.container(id).await?)?)
    }

    /// Renders a view with these parameters, for example `w`, `h`, `tx` and `format`, and returns it as a picture file. The server's
    /// `OpenAPI` document lists all parameters.
    ///
    /// # Errors
    /// [`Error`]; [`Error::Problem`] names the parameter.
    pub async fn view(&self, id: &str, parameters: &[(&str, &str)]) -> Result<Bytes, Error> {
        self.part(id, &query("/view", parameters)?).await
    }

    /// Anything else that the server has below a photo's path: `/depth`, `/thumbnail`, `/report`, `/strokes`, `/atlas?level=1`.
    ///
    /// # Errors
    /// As [`Client::container`].
    pub async fn part(&self, id: &str, path: &str) -> Result<Bytes, Error> {
        Ok(self.request(Call::new(Method::GET, photo_path(id, path))).await?.body)
    }

    /// Requests an export with these parameters, for example `format`, waits for it and downloads it. If you drop this future, the server
    /// still writes the file, and the same call finds it later.
    ///
    /// # Errors
    /// As [`Client::container`], and [`Error::Problem`] if the server could not write the file.
    pub async fn export(&self, id: &str, parameters: &[(&str, &str)]) -> Result<Bytes, Error> {
        // idempotent: the same request yields the same file
        let order = Call::new(Method::POST, photo_path(id, &query("/exports", parameters)?));
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
}
