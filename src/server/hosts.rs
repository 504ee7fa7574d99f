//! The accepted `Host` names, and the test for the local user.
//!
//! A page of another site can point its own name at this server (DNS rebinding) and then shares its origin. It cannot choose the `Host`
//! that the browser sends: its own name, which is not in the list.

use std::net::{IpAddr, SocketAddr};

use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderValue, Request, StatusCode, header};

use super::problem::Problem;

/// Headers that proxies add.
const PROXIED: [&str; 6] = ["forwarded", "x-forwarded-for", "x-forwarded-host", "x-forwarded-proto", "x-real-ip", "via"];

/// The accepted names.
#[derive(Clone, Debug)]
pub struct Hosts {
    bound: IpAddr,
    names: Vec<String>,
}

impl Hosts {
    /// Loopback names, the address that the server is bound to (any address if it is bound to all), and `names` without ports.
    pub fn new(bound: SocketAddr, names: &[String]) -> Self {
        Self { bound: bound.ip(), names: names.iter().map(|n| plain(n)).collect() }
    }

    /// The first of the given names.
    pub fn first(&self) -> Option<&str> {
        self.names.first().map(String::as_str)
    }

    /// Checks the host of a request.
    ///
    /// # Errors
    /// 400 without a `Host` or with more than one, 421 if it is not accepted.
    pub fn check<B>(&self, request: &Request<B>) -> Result<(), Problem> {
        let named = authority(request)?;
        // the target wins over the header (RFC 9112, section 3.2.2), but both must be accepted
        for host in request.uri().authority().into_iter().chain([&named]) {
            if !self.allows(host.host()) {
                let detail = format!("the server does not answer as \"{:.64}\"; tmpi serve --host names others", host.host());
                return Err(Problem::new(StatusCode::MISDIRECTED_REQUEST, "host", detail).field("Host"));
            }
        }
        Ok(())
    }

    /// Whether the server answers under this name.
    pub fn allows(&self, host: &str) -> bool {
        let host = plain(host);
        if is_loopback_name(&host) || self.names.contains(&host) {
            return true;
        }
        // an address cannot be rebound: a person gave it to the browser
        address(&host).is_some_and(|ip| ip.is_loopback() || ip == self.bound || self.bound.is_unspecified())
    }

    /// Whether the request seems to come from this machine's own user: the server is bound to loopback, the `Host` is a loopback name, and
    /// no proxy forwarded it.
    pub fn is_own(&self, headers: &HeaderMap) -> bool {
        let host = headers.get(header::HOST).and_then(|v| v.to_str().ok()).and_then(|v| v.parse::<Authority>().ok());
        let local = |host: Authority| {
            let host = plain(host.host());
            is_loopback_name(&host) || address(&host).is_some_and(|ip| ip.is_loopback())
        };
        self.bound.is_loopback() && host.is_some_and(local) && !PROXIED.iter().any(|name| headers.contains_key(*name))
    }
}

tokio::task_local! {
    /// Whether the request came over TLS.
    pub static SECURE: bool;
}

/// `scheme://host` of this server as the client sees it: from `Host`, which [`Hosts::check`] has checked, from the connection, and from the
/// scheme that a proxy names (`X-Forwarded-Proto`). `None` without a valid `Host`.
pub fn origin(headers: &HeaderMap) -> Option<String> {
    let host = host_of(headers.get(header::HOST)?)?;
    let named = headers.get("x-forwarded-proto").and_then(|v| v.to_str().ok());
    // the first is of the proxy next to the browser
    let proto = named.and_then(|protos| protos.split(',').next()).map(str::trim);
    let secure = proto.map_or_else(|| SECURE.try_with(|secure| *secure).unwrap_or(false), |p| p.eq_ignore_ascii_case("https"));
    let scheme = if secure { "https" } else { "http" };
    let port = host.port_u16().map(|port| format!(":{port}")).unwrap_or_default();
    Some(format!("{scheme}://{}{port}", host.host()))
}

/// The one `Host` of a request.
fn authority<B>(request: &Request<B>) -> Result<Authority, Problem> {
    let wrong = |detail: &str| Problem::bad_request(detail).field("Host");
    let mut all = request.headers().get_all(header::HOST).iter();
    let (Some(host), None) = (all.next(), all.next()) else { return Err(wrong("a request has one Host header (RFC 9112, section 3.2)")) };
    host_of(host).ok_or_else(|| wrong("the Host header is not a host"))
}

/// A host and perhaps a port, without a user.
fn host_of(value: &HeaderValue) -> Option<Authority> {
    let authority: Authority = value.to_str().ok()?.parse().ok()?;
    let host = authority.host();
    // the parser also takes brackets within a name
    let name = host.strip_prefix('[').and_then(|host| host.strip_suffix(']')).unwrap_or(host);
    let is_host = !authority.as_str().contains('@') && !name.is_empty() && !name.contains(['[', ']']);
    is_host.then_some(authority)
}

/// Lower case, without the trailing dot.
fn plain(name: &str) -> String {
    name.trim_end_matches('.').to_ascii_lowercase()
}

fn is_loopback_name(host: &str) -> bool {
    host == "localhost" || host.ends_with(".localhost")
}

fn address(host: &str) -> Option<IpAddr> {
    host.trim_start_matches('[').trim_end_matches(']').parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::body::Body;

    fn headers(pairs: &[(&'static str, &'static str)]) -> HeaderMap {
        pairs.iter().map(|(k, v)| (header::HeaderName::from_static(k), HeaderValue::from_static(v))).collect()
    }

    fn status(hosts: &Hosts, target: &str, all: &[&str]) -> u16 {
        let mut request = Request::builder().uri(target);
        for host in all {
            request = request.header(header::HOST, *host);
        }
        hosts.check(&request.body(Body::empty()).unwrap()).map_or_else(|p| p.status, |()| 200)
    }

    #[test]
    fn host_names_are_accepted_as_configured() {
        let loopback = Hosts::new(([127, 0, 0, 1], 8080).into(), &["Photos.Example.".into()]);
        for fine in
            ["localhost", "LOCALHOST:8080", "a.localhost", "127.0.0.1:1", "127.9.9.9", "[::1]:8080", "photos.example", "photos.example:443"]
        {
            assert_eq!(status(&loopback, "/", &[fine]), 200, "{fine}");
        }
        for foreign in ["evil.example", "192.168.1.5", "localhost.evil.example", "photos.example.evil", "127.0.0.1.evil.example"] {
            assert_eq!(status(&loopback, "/", &[foreign]), 421, "{foreign}");
        }
        for wrong in [&[][..], &["localhost", "localhost"], &["a b"], &["user@localhost"], &[""], &[":80"], &["8m[l1::981]l:."], &["[]"]] {
            assert_eq!(status(&loopback, "/", wrong), 400, "{wrong:?}");
        }
        assert_eq!(status(&loopback, "http://evil.example/", &["localhost"]), 421);
        assert_eq!(status(&loopback, "http://localhost/", &["evil.example"]), 421);
        let one = Hosts::new(([192, 168, 1, 5], 80).into(), &[]);
        assert_eq!((status(&one, "/", &["192.168.1.5"]), status(&one, "/", &["192.168.1.6"])), (200, 421));
        let all = Hosts::new(([0, 0, 0, 0], 80).into(), &[]);
        assert_eq!((status(&all, "/", &["192.168.1.6:80"]), status(&all, "/", &["evil.example"])), (200, 421));
    }

    #[test]
    fn addresses_have_the_host_and_scheme_of_the_request() {
        let of = |pairs: &[(&'static str, &'static str)]| origin(&headers(pairs));
        assert_eq!(of(&[("host", "localhost:8080")]).as_deref(), Some("http://localhost:8080"));
        assert_eq!(of(&[("host", "[::1]:80")]).as_deref(), Some("http://[::1]:80"));
        let behind = |name, value| of(&[("host", "photos.example"), (name, value)]).unwrap();
        for (name, value, scheme) in [
            ("x-forwarded-proto", "https", "https"),
            ("x-forwarded-proto", "HTTPS, http", "https"),
            ("x-forwarded-proto", "javascript", "http"),
            ("x-forwarded-host", "evil.example", "http"),
        ] {
            assert_eq!(behind(name, value), format!("{scheme}://photos.example"), "{name}: {value}");
        }
        for none in [&[][..], &[("host", "a b")], &[("host", ":80")]] {
            assert_eq!(of(none), None, "{none:?}");
        }
    }

    #[test]
    fn only_loopback_callers_are_the_local_user() {
        let loopback = Hosts::new(([127, 0, 0, 1], 8080).into(), &["photos.example".into()]);
        assert!(loopback.is_own(&headers(&[("host", "localhost:8080")])) && loopback.is_own(&headers(&[("host", "[::1]")])));
        assert!(!loopback.is_own(&headers(&[("host", "photos.example")])));
        for proxy in PROXIED {
            assert!(!loopback.is_own(&headers(&[("host", "localhost"), (proxy, "203.0.113.1")])), "{proxy}");
        }
        let all = Hosts::new(([0, 0, 0, 0], 8080).into(), &[]);
        assert!(!all.is_own(&headers(&[("host", "localhost")])));
    }
}
