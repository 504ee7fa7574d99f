//! Requests: bounded in time and size, tried again where that is safe.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use reqwest::header::{AUTHORIZATION, HeaderMap, HeaderName, HeaderValue, RETRY_AFTER};
use reqwest::{Method, Response, StatusCode, Url};

use crate::retry::{Again, pause};
use crate::{Error, Problem};

/// Bytes of a JSON answer, at most.
const JSON: usize = 16 << 20;
/// Bytes of a problem document, at most.
const PROBLEM: usize = 64 << 10;
/// What a fragment with an owner's secret begins with.
const OWNER: &str = "owner=";

/// How a client asks; see the methods for what holds where nothing is said.
#[derive(Clone, Debug)]
pub struct Builder {
    base: String,
    bearer: Option<String>,
    silence: Duration,
    connect: Duration,
    longest_pause: Duration,
    tries: u32,
    most_bytes: usize,
    proxy: bool,
}

impl Builder {
    /// A key of `tmpi key add`, or an owner's secret (`tmpi_o_…`).
    #[must_use]
    pub fn key(mut self, key: impl Into<String>) -> Self {
        self.bearer = Some(key.into());
        self
    }

    /// The owner's link, as an upload's `links.manage` or the page under *Share* gives it: `…/view/ID#owner=tmpi_o_…`.
    ///
    /// # Errors
    /// [`Error::Input`] where the link has no secret.
    pub fn owner_link(self, link: &str) -> Result<Self, Error> {
        let secret = link.split_once('#').and_then(|(_, fragment)| fragment.strip_prefix(OWNER));
        let secret = secret.ok_or_else(|| Error::Input("an owner's link ends with #owner= and a secret".into()))?;
        Ok(self.key(secret))
    }

    /// How long nothing may come before a request is given up; 60 s.
    #[must_use]
    pub fn silence(mut self, silence: Duration) -> Self {
        self.silence = silence;
        self
    }

    /// How long a connection may take to be made; 10 s.
    #[must_use]
    pub fn connect(mut self, connect: Duration) -> Self {
        self.connect = connect;
        self
    }

    /// Longest pause before another try; 30 s.
    #[must_use]
    pub fn longest_pause(mut self, pause: Duration) -> Self {
        self.longest_pause = pause;
        self
    }

    /// How often a request is sent, at most, 1 or more; 4.
    #[must_use]
    pub fn tries(mut self, tries: u32) -> Self {
        self.tries = tries.max(1);
        self
    }

    /// Bytes of a container, picture or export that are taken; 512 MiB.
    #[must_use]
    pub fn most_bytes(mut self, bytes: usize) -> Self {
        self.most_bytes = bytes;
        self
    }

    /// Goes by no proxy, whatever the environment says.
    #[must_use]
    pub fn no_proxy(mut self) -> Self {
        self.proxy = false;
        self
    }

    /// The client.
    ///
    /// # Errors
    /// [`Error::Input`] where the address or the key can be none.
    pub fn build(self) -> Result<Client, Error> {
        let wrong = || Error::Input(format!("not the address of a server: {:?}", self.base));
        let base = Url::parse(&self.base).map_err(|_| wrong())?;
        let schemes: &[&str] = if cfg!(feature = "tls") { &["http", "https"] } else { &["http"] };
        if !schemes.contains(&base.scheme()) || base.path() != "/" || base.query().is_some() || !base.username().is_empty() {
            return Err(wrong());
        }
        let bearer = self.bearer.map(|key| HeaderValue::try_from(format!("Bearer {key}"))).transpose();
        let mut bearer = bearer.map_err(|_| Error::Input("a key is letters, digits, - and _".into()))?;
        if let Some(value) = &mut bearer {
            value.set_sensitive(true);
        }
        #[cfg(feature = "tls")]
        // where the program has chosen another one, that one stays
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::Client::builder().redirect(reqwest::redirect::Policy::none()).connect_timeout(self.connect);
        let http = if self.proxy { http } else { http.no_proxy() };
        let (silence, longest_pause, tries, most_bytes) = (self.silence, self.longest_pause, self.tries, self.most_bytes);
        Ok(Client { inner: Arc::new(Inner { http: http.build()?, base, bearer, silence, longest_pause, tries, most_bytes }) })
    }
}

#[derive(Debug)]
struct Inner {
    http: reqwest::Client,
    base: Url,
    bearer: Option<HeaderValue>,
    silence: Duration,
    longest_pause: Duration,
    tries: u32,
    most_bytes: usize,
}

/// A server, as one caller sees it. Clones share connections.
#[derive(Clone, Debug)]
pub struct Client {
    inner: Arc<Inner>,
}

/// A request that can be sent several times.
pub(crate) struct Call {
    pub method: Method,
    pub url: Url,
    pub headers: HeaderMap,
    pub body: Bytes,
    /// Silence that is borne.
    pub patience: Duration,
    pub again: Again,
    /// Bytes of the answer, at most.
    pub most: usize,
}

impl Call {
    pub(crate) fn header(mut self, name: HeaderName, value: &str) -> Result<Self, Error> {
        let value = HeaderValue::from_str(value).map_err(|_| Error::Input(format!("no value of {name}: {value:?}")))?;
        self.headers.insert(name, value);
        Ok(self)
    }

    pub(crate) fn parameter(mut self, name: &str, value: impl std::fmt::Display) -> Self {
        self.url.query_pairs_mut().append_pair(name, &value.to_string());
        self
    }
}

/// An answer that is a success, or 304.
pub(crate) struct Answer {
    pub status: StatusCode,
    pub headers: HeaderMap,
    pub body: Vec<u8>,
}

impl Answer {
    pub(crate) fn header(&self, name: &HeaderName) -> Option<String> {
        self.headers.get(name).and_then(|v| v.to_str().ok()).map(str::to_owned)
    }

    pub(crate) fn json<T: serde::de::DeserializeOwned>(&self) -> Result<T, Error> {
        serde_json::from_slice(&self.body).map_err(|e| Error::Answer(e.to_string()))
    }
}

impl Client {
    /// A client of the server at `base`, like `https://photos.example.org`, that is nobody.
    ///
    /// # Errors
    /// [`Error::Input`] where that is no address; `https` takes the feature `tls`.
    pub fn new(base: &str) -> Result<Self, Error> {
        Self::builder(base).build()
    }

    /// How to ask the server at `base`.
    #[must_use]
    pub fn builder(base: &str) -> Builder {
        Builder {
            base: base.to_owned(),
            bearer: None,
            silence: Duration::from_mins(1),
            connect: Duration::from_secs(10),
            longest_pause: Duration::from_secs(30),
            tries: 4,
            most_bytes: 512 << 20,
            proxy: true,
        }
    }

    /// Address of `path` on the server.
    ///
    /// # Errors
    /// [`Error::Answer`] where the path leads to another server: links of answers come to here.
    pub fn address(&self, path: &str) -> Result<String, Error> {
        self.url(path).map(String::from)
    }

    fn url(&self, path: &str) -> Result<Url, Error> {
        let url = self.inner.base.join(path).map_err(|e| Error::Answer(format!("{path:?}: {e}")))?;
        if url.origin() == self.inner.base.origin() { Ok(url) } else { Err(Error::Answer(format!("{path:?} is of another server"))) }
    }

    /// A request below a photo's address.
    pub(crate) fn photo(&self, method: Method, id: &str, part: &str) -> Result<Call, Error> {
        if id.len() != 32 || !id.bytes().all(|b| b.is_ascii_hexdigit()) {
            return Err(Error::Input(format!("no id of a photo: {id:?}")));
        }
        self.call(method, &format!("/v1/photos/{id}{part}"))
    }

    pub(crate) fn call(&self, method: Method, path: &str) -> Result<Call, Error> {
        let url = self.url(path)?;
        let again = if method == Method::GET { Again::Safe } else { Again::Undone };
        let (headers, patience) = (HeaderMap::new(), self.inner.silence);
        Ok(Call { method, url, headers, body: Bytes::new(), patience, again, most: JSON })
    }

    pub(crate) fn most_bytes(&self) -> usize {
        self.inner.most_bytes
    }

    pub(crate) fn is_owner(&self) -> bool {
        self.inner.bearer.is_some()
    }

    pub(crate) fn longest_pause(&self) -> Duration {
        self.inner.longest_pause
    }

    /// The whole answer.
    pub(crate) async fn fetch(&self, call: &Call) -> Result<Answer, Error> {
        self.repeated(call, async || {
            let response = self.send(call).await?;
            let (status, headers) = (response.status(), response.headers().clone());
            Ok(Answer { status, headers, body: read(response, call.most, call.patience).await? })
        })
        .await
    }

    /// The answer's head; its body is still to come.
    pub(crate) async fn open(&self, call: &Call) -> Result<Response, Error> {
        self.repeated(call, async || self.send(call).await).await
    }

    async fn repeated<T>(&self, call: &Call, once: impl AsyncFn() -> Result<T, Error>) -> Result<T, Error> {
        let mut tries = 0;
        loop {
            let error = match once().await {
                Ok(done) => return Ok(done),
                Err(error) => error,
            };
            tries += 1;
            let asked = error.problem().and_then(|p| p.retry_after).map(Duration::from_secs).unwrap_or_default();
            if tries >= self.inner.tries || asked > self.inner.longest_pause || !call.again.after(&error) {
                return Err(error);
            }
            tokio::time::sleep(asked.max(pause(tries - 1, self.inner.longest_pause))).await;
        }
    }

    async fn send(&self, call: &Call) -> Result<Response, Error> {
        let mut request = self.inner.http.request(call.method.clone(), call.url.clone()).headers(call.headers.clone());
        if let Some(bearer) = &self.inner.bearer {
            request = request.header(AUTHORIZATION, bearer.clone());
        }
        if !call.body.is_empty() || call.method == Method::POST {
            request = request.body(call.body.clone());
        }
        let response = within(call.patience, request.send()).await??;
        let status = response.status();
        if status.is_success() || status == StatusCode::NOT_MODIFIED {
            return Ok(response);
        }
        let header = response.headers().get(RETRY_AFTER).and_then(|v| v.to_str().ok()).and_then(|v| v.parse().ok());
        let body = read(response, PROBLEM, call.patience).await?;
        let problem: Result<Problem, _> = serde_json::from_slice(&body);
        let mut problem = problem.unwrap_or_else(|_| foreign(status, &body));
        problem.status = status.as_u16();
        problem.retry_after = problem.retry_after.or(header);
        Err(Error::Refused(Box::new(problem)))
    }
}

/// A refusal of somebody between here and the server.
fn foreign(status: StatusCode, body: &[u8]) -> Problem {
    let title = status.canonical_reason().unwrap_or("refused").to_owned();
    let detail = String::from_utf8_lossy(&body[..body.len().min(256)]).into_owned();
    Problem { kind: "about:blank".into(), title, status: status.as_u16(), detail, field: None, request_id: None, retry_after: None }
}

pub(crate) async fn within<T>(patience: Duration, future: impl Future<Output = T>) -> Result<T, Error> {
    tokio::time::timeout(patience, future).await.map_err(|_| Error::Silence(patience))
}

/// A body of at most `most` bytes.
async fn read(mut response: Response, most: usize, patience: Duration) -> Result<Vec<u8>, Error> {
    if response.content_length().is_some_and(|length| length > most as u64) {
        return Err(Error::TooLarge(most));
    }
    let mut body = Vec::new();
    while let Some(chunk) = within(patience, response.chunk()).await?? {
        if body.len() + chunk.len() > most {
            return Err(Error::TooLarge(most));
        }
        body.extend_from_slice(&chunk);
    }
    Ok(body)
}
