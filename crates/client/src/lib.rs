//! Client of tmpi's REST API: upload a photo, download the tiled multiplane image and views of it.
//!
//! ```no_run
//! use tmpi_client::{Client, Upload};
//!
//! # async fn example() -> Result<(), tmpi_client::Error> {
//! let client = Client::new("https://photos.example.org")?.with_key("tmpi_k_…")?;
//! let photo = client.upload(Upload::of(std::fs::read("beach.jpg").expect("a photo")).option("title", "Beach")).await?;
//! let photo = client.finished(&photo.id, |stage| println!("{} of {}: {}", stage.step, stage.steps, stage.stage)).await?;
//! let scene = client.scene(&photo.id).await?;
//! let view = client.view(&photo.id, &[("w", "1280"), ("tx", "0.02")]).await?;
//! println!("{} × {}, {} layers, a view of {} bytes", scene.photo.width, scene.photo.height, scene.layers.len(), view.len());
//! # Ok(())
//! # }
//! ```
//!
//! Every failed call returns an [`Error`]; if the server refused the call, it is [`Error::Problem`]. The client retries idempotent calls
//! after network failures. If the server is overloaded or limits the rate, the client retries after the time in `Retry-After`
//! ([`Client::patience`]). Without an async executor, block on a tokio runtime:
//!
//! ```no_run
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
//! let client = tmpi_client::Client::new("http://127.0.0.1:8080")?;
//! let photos = runtime.block_on(client.photos())?;
//! # let _ = photos;
//! # Ok(())
//! # }
//! ```

mod error;
mod events;
mod photos;
mod request;
mod results;
mod types;

use std::sync::Arc;
use std::time::Duration;

use reqwest::Url;
use reqwest::header::{AUTHORIZATION, HeaderMap, HeaderValue};

pub use error::{Error, Problem};
pub use photos::Upload;
pub use types::{Link, Links, Offset, PhotoState, Progress, Settings, State, Visibility};

/// Prefix of an owner's secret.
const OWNER: &str = "tmpi_o_";
/// Longest time without a byte from the server.
const SILENCE: Duration = Duration::from_mins(1);
/// Time to connect.
const CONNECT: Duration = Duration::from_secs(10);
/// Default total time that a call waits between retries.
const PATIENCE: Duration = Duration::from_mins(1);
/// Largest accepted answer in bytes: slightly more than the largest container.
const MAX_ANSWER_BYTES: usize = 1 << 30;

/// A client of a server. Clones share their connections.
#[derive(Clone)]
pub struct Client {
    base: Arc<Url>,
    http: reqwest::Client,
    headers: HeaderMap,
    secret: Option<String>,
    patience: Duration,
}

impl std::fmt::Debug for Client {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // the other fields contain secrets
        f.debug_struct("Client").field("base", &self.base.as_str()).finish_non_exhaustive()
    }
}

impl Client {
    /// Creates a client of the server at `base`, for example `https://photos.example.org` or `http://127.0.0.1:8080`. Include the path
    /// if a proxy serves tmpi below one.
    ///
    /// # Errors
    /// [`Error::Address`] if `base` is not an HTTP or HTTPS URL.
    pub fn new(base: &str) -> Result<Self, Error> {
        let wrong = |why: String| Error::Address { address: base.to_owned(), why };
        let mut url = Url::parse(base).map_err(|e| wrong(e.to_string()))?;
        if !matches!(url.scheme(), "http" | "https") {
            return Err(wrong("expected http or https".into()));
        }
        if !url.path().ends_with('/') {
            let path = format!("{}/", url.path());
            url.set_path(&path);
        }
        // fails if the program has already installed a provider, which is fine
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::Client::builder()
            .connect_timeout(CONNECT)
            .read_timeout(SILENCE)
            .user_agent(concat!("tmpi-client/", env!("CARGO_PKG_VERSION")))
            .redirect(reqwest::redirect::Policy::none())
            .build()
            .map_err(Error::Network)?;
        Ok(Self { base: Arc::new(url), http, headers: HeaderMap::new(), secret: None, patience: PATIENCE })
    }

    /// Authenticates with an API key (`tmpi key add`), an owner's secret (`tmpi_o_…`), or the token behind `#manage=` of a manage link
    /// (`tmpi_m_…`), which allows changes to one photo only: [`Link::manage`], or [`Links::manage`] of an upload.
    ///
    /// # Errors
    /// [`Error::Key`] if it is not a valid header value.
    pub fn with_key(mut self, key: &str) -> Result<Self, Error> {
        let mut value = HeaderValue::from_str(&format!("Bearer {key}")).map_err(|_| Error::Key)?;
        value.set_sensitive(true);
        self.headers.insert(AUTHORIZATION, value);
        self.secret = key.starts_with(OWNER).then(|| key.to_owned());
        Ok(self)
    }

    /// Authenticates as a new owner. Anyone who has [`Client::secret`] owns the uploads.
    ///
    /// # Errors
    /// [`Error::Key`] if the system has no random bytes.
    pub fn with_fresh_owner(self) -> Result<Self, Error> {
        let mut bytes = [0; 32];
        getrandom::fill(&mut bytes).map_err(|_| Error::Key)?;
        self.with_key(&format!("{OWNER}{}", hex(&bytes)))
    }

    /// The owner's secret, if the client has one. Keep it like a password.
    pub fn secret(&self) -> Option<&str> {
        self.secret.as_deref()
    }

    /// Sets the longest total wait for retries; the default is a minute, zero disables retries.
    pub fn patience(mut self, most: Duration) -> Self {
        self.patience = most;
        self
    }

    /// Resolves a `path` from one of the server's answers, which begins with `/`, to a URL.
    ///
    /// # Errors
    /// [`Error::Address`] if the URL is invalid or belongs to another server.
    pub fn address(&self, path: &str) -> Result<Url, Error> {
        let wrong = |why: String| Error::Address { address: path.to_owned(), why };
        let url = self.base.join(path.trim_start_matches('/')).map_err(|e| wrong(e.to_string()))?;
        // never send the key to another server
        if url.origin() == self.base.origin() { Ok(url) } else { Err(wrong("it belongs to another server".into())) }
    }

    /// HTML that embeds a photo in a page of another site: one whose visibility is [`Visibility::Link`], or any other through a link, until
    /// the link expires.
    ///
    /// # Errors
    /// [`Error::Address`].
    pub fn embedding(&self, photo: &PhotoState, link: Option<&Link>) -> Result<String, Error> {
        let mut address = self.address(&photo.links.embed)?;
        if let Some(link) = link {
            address.set_query(link.query.as_deref());
        }
        let (width, height) = (photo.width.unwrap_or(4), photo.height.unwrap_or(3));
        let (style, address) = (format!("width:100%;aspect-ratio:{width}/{height};border:0"), address.as_str().replace('&', "&amp;"));
        Ok(format!("<iframe src=\"{address}\" style=\"{style}\" loading=\"lazy\" allow=\"accelerometer; gyroscope; fullscreen\"></iframe>"))
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().flat_map(|b| [b >> 4, b & 15]).filter_map(|digit| char::from_digit(digit.into(), 16)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_of_other_servers_are_refused() {
        let client = Client::new("https://photos.example/sub").unwrap();
        assert_eq!(client.address("/v1/photos").unwrap().as_str(), "https://photos.example/sub/v1/photos");
        for other in ["https://evil.example/v1/photos", "http://photos.example/"] {
            assert!(client.address(other).is_err(), "{other}");
        }
        for wrong in ["photos.example", "ftp://photos.example", "https://"] {
            assert!(matches!(Client::new(wrong), Err(Error::Address { .. })), "{wrong}");
        }
    }

    #[test]
    fn debug_output_shows_no_keys() {
        let client = || Client::new("http://localhost").unwrap();
        assert!(client().with_key("a\nb").is_err());
        let (one, other) = (client().with_fresh_owner().unwrap(), client().with_fresh_owner().unwrap());
        assert_ne!(one.secret(), other.secret());
        assert_eq!(one.secret().map(str::len), Some(OWNER.len() + 64));
        assert_eq!(client().with_key("tmpi_k_1").unwrap().secret(), None);
        assert!(!format!("{one:?} {:?}", one.headers).contains(one.secret().unwrap()));
    }
}
