//! Photos that the server fetches from other servers, for callers that name an address instead of sending a file.
//!
//! The operator lists the hosts. Each address on the way, redirects included, must be of a listed host and public; see
//! [`outbound`](super::outbound).

use std::str::FromStr;
use std::time::Duration;

use axum::body::Body;
use axum::http::{HeaderMap, Response, StatusCode, header};
use reqwest::Url;

use super::outbound::{self, AddressError, AddressPolicy, Outbound, cause, is_not_public};

/// Redirects that are followed.
const REDIRECTS: usize = 3;
/// Time for an answer to begin.
const ANSWER: Duration = Duration::from_secs(30);

/// A host from which photos may be fetched: `HOST`, `*.DOMAIN` for all hosts below a domain, or `*` for all, by HTTPS; with `http://` before it
/// by HTTP. Behind it a port, if it is not the usual one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SourceHost {
    scheme: String,
    /// As URLs have it: in lower case and punycode.
    host: String,
    port: u16,
}

impl FromStr for SourceHost {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let wrong = "a host is expected, as a.example, *.b.example, c.example:8443 or http://d.example";
        let has_scheme = text.starts_with("https://") || text.starts_with("http://");
        let url = if has_scheme { text.parse::<Url>() } else { format!("https://{text}").parse() };
        let url: Url = url.map_err(|_| wrong)?;
        let has_user = !url.username().is_empty() || url.password().is_some();
        // the path of a URL without one is `/`
        let has_more = url.path() != "/" || url.query().is_some() || url.fragment().is_some() || text.ends_with(['/', '\\', ':']);
        let (host, port) = url.host_str().zip(url.port_or_known_default()).ok_or(wrong)?;
        let name = host.strip_prefix("*.").unwrap_or(host);
        let is_pattern = host == "*" || !name.is_empty() && !name.contains('*');
        if has_user || has_more || !is_pattern {
            return Err(wrong);
        }
        Ok(Self { scheme: url.scheme().to_owned(), host: host.to_owned(), port })
    }
}

impl SourceHost {
    fn allows(&self, url: &Url) -> bool {
        let Some(host) = url.host_str() else { return false };
        let is_host = match self.host.strip_prefix('*') {
            Some(domain) => domain.is_empty() || host.strip_suffix(domain).is_some_and(|below| !below.is_empty()),
            None => host == self.host,
        };
        is_host && url.scheme() == self.scheme && url.port_or_known_default() == Some(self.port)
    }
}

/// Why a photo is not fetched.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum SourceError {
    /// The address itself is wrong.
    #[error("{0}")]
    Address(AddressError),
    /// The address, or one that it redirects to, is of a host that is not listed.
    #[error("this server does not fetch photos from {0}; tmpi serve --source-hosts lists the hosts")]
    Host(String),
    /// The name of a listed host has no public address.
    #[error("{0} has no public address")]
    NotPublic(String),
    /// The source refuses the request, or does not have the photo.
    #[error("the source answers {0}")]
    Refused(StatusCode),
    /// The source, or the way to it, is at fault.
    #[error("{0}")]
    Failed(String),
    /// The source does not answer.
    #[error("the source does not answer in time")]
    Slow,
}

/// What a source said of a photo, by which it can be asked whether that has changed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Validators {
    pub etag: Option<String>,
    pub last_modified: Option<String>,
}

impl Validators {
    fn of(headers: &HeaderMap) -> Self {
        let text = |name| headers.get(name).and_then(|value| value.to_str().ok()).map(str::to_owned);
        Self { etag: text(header::ETAG), last_modified: text(header::LAST_MODIFIED) }
    }
}

/// Fetches photos.
pub struct Sources {
    hosts: Vec<SourceHost>,
    outbound: Outbound,
}

impl Sources {
    /// From these hosts, at addresses within `reach`.
    pub const fn new(hosts: Vec<SourceHost>, reach: AddressPolicy) -> Self {
        Self { hosts, outbound: Outbound::new(reach) }
    }

    /// Whether any host is listed.
    pub const fn is_on(&self) -> bool {
        !self.hosts.is_empty()
    }

    /// Reads an address and checks it against the list.
    ///
    /// # Errors
    /// [`SourceError`] of the caller.
    pub fn address(&self, text: &str) -> Result<Url, SourceError> {
        let mut url = outbound::url(text, AddressPolicy::Any).map_err(SourceError::Address)?;
        url.set_fragment(None);
        self.check(&url)?;
        Ok(url)
    }

    fn check(&self, url: &Url) -> Result<(), SourceError> {
        let host = || url.host_str().unwrap_or(url.scheme()).to_owned();
        if !self.hosts.iter().any(|listed| listed.allows(url)) {
            return Err(SourceError::Host(host()));
        }
        outbound::check(url, self.outbound.reach()).map_err(|error| match error {
            AddressError::NotPublic => SourceError::NotPublic(host()),
            error => SourceError::Address(error),
        })
    }

    /// Asks for a photo; `None` if it is still that of the validators `known`. Follows three redirects.
    ///
    /// # Errors
    /// [`SourceError`].
    pub async fn fetch(&self, url: Url, known: Option<&Validators>) -> Result<Option<(Body, Validators)>, SourceError> {
        let mut url = url;
        for _ in 0..=REDIRECTS {
            self.check(&url)?;
            let answer = self.ask(&url, known).await?;
            let status = answer.status();
            match status {
                StatusCode::OK => {
                    let (parts, body) = Response::from(answer).into_parts();
                    return Ok(Some((Body::new(body), Validators::of(&parts.headers))));
                }
                StatusCode::NOT_MODIFIED if known.is_some() => return Ok(None),
                _ if status.is_redirection() => url = target(&url, answer.headers())?,
                _ if status.is_client_error() => return Err(SourceError::Refused(status)),
                _ => return Err(SourceError::Failed(format!("the source answers {status}"))),
            }
        }
        Err(SourceError::Failed(format!("the source redirects more than {REDIRECTS} times")))
    }

    async fn ask(&self, url: &Url, known: Option<&Validators>) -> Result<reqwest::Response, SourceError> {
        let client = self.outbound.client().map_err(|error| SourceError::Failed(cause(error)))?;
        let mut request = client.get(url.clone()).header(header::ACCEPT, "image/*");
        let Validators { etag, last_modified } = known.cloned().unwrap_or_default();
        for (name, value) in [(header::IF_NONE_MATCH, etag), (header::IF_MODIFIED_SINCE, last_modified)] {
            if let Some(value) = value {
                request = request.header(name, value);
            }
        }
        let host = || url.host_str().unwrap_or_default().to_owned();
        match tokio::time::timeout(ANSWER, request.send()).await {
            Err(_) => Err(SourceError::Slow),
            Ok(Err(error)) if error.is_timeout() => Err(SourceError::Slow),
            Ok(Err(error)) if is_not_public(&error) => Err(SourceError::NotPublic(host())),
            Ok(Err(error)) => Err(SourceError::Failed(format!("the source cannot be reached: {}", cause(error)))),
            Ok(Ok(answer)) => Ok(answer),
        }
    }
}

/// Where a redirect leads.
fn target(from: &Url, headers: &HeaderMap) -> Result<Url, SourceError> {
    let to = headers.get(header::LOCATION).and_then(|value| value.to_str().ok()).and_then(|text| from.join(text).ok());
    to.ok_or_else(|| SourceError::Failed("the source redirects to nowhere".into()))
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::net::TcpListener;

    use super::*;

    fn host(text: &str) -> Option<SourceHost> {
        text.parse().ok()
    }

    #[test]
    fn a_host_is_listed_with_its_scheme_and_port() {
        for (listed, allowed, others) in [
            (
                "a.example",
                &["https://a.example/x", "https://A.example:443/"][..],
                &["http://a.example/", "https://a.example:8443/", "https://x.a.example/"][..],
            ),
            ("http://a.example", &["http://a.example/"], &["https://a.example/", "http://a.example:8080/"]),
            ("a.example:8443", &["https://a.example:8443/"], &["https://a.example/"]),
            (
                "*.b.example",
                &["https://x.b.example/", "https://x.y.b.example/"],
                &["https://b.example/", "https://.b.example/", "https://xb.example/", "https://x.b.example.evil/"],
            ),
            ("*", &["https://a.example/", "https://1.1.1.1/"], &["http://a.example/", "https://a.example:8443/"]),
            ("http://[::1]:8080", &["http://[::1]:8080/"], &["http://[::1]/"]),
            ("bücher.example", &["https://xn--bcher-kva.example/", "https://bücher.example/"], &[]),
        ] {
            let listed = host(listed).unwrap_or_else(|| panic!("{listed}"));
            let allows = |text: &&&str| text.parse().is_ok_and(|url| listed.allows(&url));
            assert_eq!(allowed.iter().filter(allows).count(), allowed.len(), "{listed:?}");
            assert_eq!(others.iter().find(allows), None, "{listed:?}");
        }
        for wrong in ["", "ftp://a", "a/b", "a?b", "me@a", "a:b", "a b", "*a", "x.*.a", "**", "*.", "*.1.1.1.1", "http://", "a:70000"] {
            assert_eq!(host(wrong), None, "{wrong}");
        }
    }

    /// Sources of which `public.example` is this machine, as if it were public.
    async fn of_this_machine(hosts: &[&str], location: &'static str) -> (Sources, Url) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let addr = listener.local_addr().unwrap();
        tokio::spawn(async move {
            loop {
                let (mut stream, _) = listener.accept().await.unwrap();
                let _ = stream.read(&mut [0; 4096]).await;
                let answer = format!("HTTP/1.1 302 Found\r\nconnection: close\r\ncontent-length: 0\r\nlocation: {location}\r\n\r\n");
                let _ = stream.write_all(answer.as_bytes()).await;
            }
        });
        let hosts = hosts.iter().map(|host| host.replace("PORT", &addr.port().to_string()).parse().unwrap()).collect();
        let client = outbound::builder(AddressPolicy::Public).resolve("public.example", addr).build().unwrap();
        (
            Sources { hosts, outbound: Outbound::of(AddressPolicy::Public, client) },
            format!("http://public.example:{}/", addr.port()).parse().unwrap(),
        )
    }

    #[tokio::test]
    async fn a_redirect_leads_to_listed_hosts_and_public_addresses_alone() {
        let listed = ["http://public.example:PORT", "http://127.0.0.1", "http://169.254.169.254", "http://[::1]", "http://localhost"];
        for (location, wrong) in [
            ("http://127.0.0.1/", SourceError::NotPublic("127.0.0.1".into())),
            ("http://169.254.169.254/latest/meta-data", SourceError::NotPublic("169.254.169.254".into())),
            ("http://[::1]/", SourceError::NotPublic("[::1]".into())),
            ("http://2130706433/", SourceError::NotPublic("127.0.0.1".into())),
            ("http://localhost/", SourceError::NotPublic("localhost".into())),
            ("http://10.0.0.1/", SourceError::Host("10.0.0.1".into())),
            ("https://localhost/", SourceError::Host("localhost".into())),
            ("file:///etc/passwd", SourceError::Host("file".into())),
            ("/", SourceError::Failed("the source redirects more than 3 times".into())),
        ] {
            let (sources, url) = of_this_machine(&listed, location).await;
            assert_eq!(sources.fetch(url, None).await.err(), Some(wrong), "{location}");
        }
    }
}
