//! Trusted proxies, which name the client of a request in `X-Forwarded-For`, and the user whom they have logged in.
//!
//! The server ignores such claims of other peers, and of several hops it uses only those that trusted proxies saw.

use std::net::IpAddr;
use std::str::FromStr;

use axum::http::{HeaderMap, HeaderName};
use ipnet::IpNet;
use tmpi_library::Owner;

use super::problem::Problem;

/// The client and the proxies behind it, the nearest last.
pub const X_FORWARDED_FOR: HeaderName = HeaderName::from_static("x-forwarded-for");
/// Loopback, private networks (RFC 1918, RFC 4193) and link-local ones.
const PRIVATE: [&str; 8] =
    ["127.0.0.0/8", "10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "169.254.0.0/16", "::1/128", "fc00::/7", "fe80::/10"];

/// Where trusted proxies are: in one network, at one address, or on this machine and in all private networks (`private`).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Network(Vec<IpNet>);

impl FromStr for Network {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "private" {
            return Ok(Self(PRIVATE.iter().filter_map(|text| text.parse().ok()).collect()));
        }
        let one = text.parse::<IpNet>().ok().or_else(|| text.parse::<IpAddr>().ok().map(IpNet::from));
        one.map(|one| Self(vec![one.trunc()]))
            .ok_or_else(|| "an address, a network as 10.0.0.0/8, or `private` for all private networks and this machine".into())
    }
}

/// The trusted proxies. Without any, the client of a request is the peer of its connection.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Proxies {
    networks: Vec<IpNet>,
    login: Option<HeaderName>,
}

impl Proxies {
    /// Trusts proxies in `networks`.
    pub fn new(networks: &[Network]) -> Self {
        Self { networks: networks.iter().flat_map(|network| network.0.iter().copied()).collect(), login: None }
    }

    /// They name the logged-in user in this header.
    pub fn with_login(self, header: Option<HeaderName>) -> Self {
        Self { login: header, ..self }
    }

    /// Whether a peer is a trusted proxy.
    pub fn trusts(&self, peer: IpAddr) -> bool {
        self.networks.iter().any(|network| network.contains(&peer.to_canonical()))
    }

    /// The user whom `peer` has logged in; `None` if it is not a trusted proxy, whatever it sends.
    ///
    /// # Errors
    /// 400 if the header is not text, or comes twice: the client may have sent one of the two.
    pub fn login(&self, peer: IpAddr, headers: &HeaderMap) -> Result<Option<Owner>, Problem> {
        let Some(name) = self.login.as_ref().filter(|_| self.trusts(peer)) else { return Ok(None) };
        let values: Vec<_> = headers.get_all(name).iter().map(|value| std::str::from_utf8(value.as_bytes())).collect();
        match values.as_slice() {
            [] | [Ok("")] => Ok(None),
            [Ok(user)] => Ok(Some(Owner::of_login(user))),
            _ => Err(Problem::bad_request("the login header must be given once, as text").field(name.as_str())),
        }
    }

    /// The client of a request from `peer`: the last address on its way that is not a trusted proxy, or the first of all.
    pub fn client(&self, peer: IpAddr, headers: &HeaderMap) -> IpAddr {
        if !self.trusts(peer) {
            return peer;
        }
        // goes back as far as trusted proxies saw; stops at anything that is not an address
        let mut client = peer;
        for hop in headers.get_all(X_FORWARDED_FOR).into_iter().rev().flat_map(|value| value.to_str().unwrap_or_default().rsplit(',')) {
            let Some(address) = address(hop) else { break };
            client = address;
            if !self.trusts(client) {
                break;
            }
        }
        client
    }
}

/// An address as proxies write it: with or without port and brackets.
fn address(text: &str) -> Option<IpAddr> {
    let text = text.trim();
    let alone = text.strip_prefix('[').and_then(|rest| rest.split_once(']')).map_or(text, |(inside, _)| inside);
    let with_port = || text.parse::<std::net::SocketAddr>().ok().map(|all| all.ip());
    alone.parse::<IpAddr>().ok().or_else(with_port).map(|address| address.to_canonical())
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;
    use proptest::prelude::*;

    use super::*;

    fn trusted(networks: &[&str]) -> Proxies {
        Proxies::new(&networks.iter().map(|text| text.parse().unwrap()).collect::<Vec<_>>())
    }

    fn client(proxies: &Proxies, peer: &str, headers: &[(&'static str, &str)]) -> String {
        let headers = headers.iter().map(|(k, v)| (HeaderName::from_static(k), HeaderValue::from_str(v).unwrap())).collect();
        proxies.client(peer.parse().unwrap(), &headers).to_string()
    }

    #[test]
    fn headers_of_untrusted_peers_are_ignored() {
        let (none, one) = (Proxies::default(), trusted(&["10.0.0.1"]));
        let said = [("x-forwarded-for", "192.0.2.1"), ("forwarded", "for=192.0.2.2")];
        assert_eq!(client(&none, "10.0.0.1", &said), "10.0.0.1");
        assert_eq!(client(&one, "10.0.0.2", &said), "10.0.0.2");
        assert_eq!(client(&one, "10.0.0.1", &said), "192.0.2.1");
        assert_eq!(client(&one, "::ffff:10.0.0.1", &said), "192.0.2.1", "the same written otherwise");
        assert_eq!(client(&one, "10.0.0.1", &said[1..]), "10.0.0.1", "not by a header that the proxy does not write");
        // what the client sent, before the proxy appended
        assert_eq!(client(&one, "10.0.0.1", &[("x-forwarded-for", "127.0.0.1, 198.51.100.9, 192.0.2.1")]), "192.0.2.1");
        assert_eq!(client(&one, "10.0.0.1", &[("x-forwarded-for", "198.51.100.9"), ("x-forwarded-for", "192.0.2.1")]), "192.0.2.1");
    }

    #[test]
    fn a_chain_of_trusted_proxies_leads_to_the_client() {
        let all = trusted(&["private"]);
        let of = |way: &str| client(&all, "127.0.0.1", &[("x-forwarded-for", way)]);
        assert_eq!(of("198.51.100.9, 192.0.2.1, 10.1.2.3,172.31.0.9"), "192.0.2.1");
        assert_eq!(of("2001:db8::7, fd00::1"), "2001:db8::7");
        assert_eq!(of("10.9.9.9"), "10.9.9.9", "one within the private network itself");
        assert_eq!(of("192.0.2.1:4711"), "192.0.2.1");
        assert_eq!(of("[2001:db8::7]:4711"), "2001:db8::7");
        for nothing in ["unknown", "", "192.0.2.1, unknown", ",,", "192.0.2.1, _hidden, 10.0.0.1"] {
            assert!(all.trusts(of(nothing).parse().unwrap()), "{nothing}: no trusted proxy saw more");
        }
    }

    #[test]
    fn networks_are_read_in_cidr_notation() {
        assert!(trusted(&["10.1.2.3/8"]).trusts("10.200.0.1".parse().unwrap()));
        assert!(trusted(&["fd00::/8"]).trusts("fd12::1".parse().unwrap()));
        for wrong in ["", "10.0.0.0/33", "example.org", "Private", "10.0.0"] {
            assert!(wrong.parse::<Network>().unwrap_err().contains("10.0.0.0/8"), "{wrong}");
        }
    }

    proptest! {
        /// Anything before the proxy's own entry has no effect.
        #[test]
        fn only_the_last_hop_before_the_proxy_counts(before in "[ -~]{0,60}") {
            let way = format!("{before}, 192.0.2.1");
            prop_assert_eq!(client(&trusted(&["10.0.0.1"]), "10.0.0.1", &[("x-forwarded-for", &way)]), "192.0.2.1");
        }
    }
}
