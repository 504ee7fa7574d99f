//! Trusted proxies, which name the client of a request: by a header, or by the PROXY protocol at the start of each connection.
//!
//! The server ignores such claims of other peers, and of several hops it uses only those that trusted proxies saw.

use std::io;
use std::net::IpAddr;
use std::str::FromStr;
use std::time::Duration;

use axum::http::{HeaderMap, HeaderName, HeaderValue, header};
use ipnet::IpNet;
use proxy_header::{Error, ParseConfig};
use tokio::io::AsyncReadExt as _;
use tokio::net::TcpStream;

/// The client and the proxies behind it, the nearest last.
pub const X_FORWARDED_FOR: HeaderName = HeaderName::from_static("x-forwarded-for");
/// Most bytes of a PROXY protocol header.
const MOST: usize = 4096;
/// Pause before an incomplete header is read again.
const AGAIN: Duration = Duration::from_millis(5);
/// Loopback, private networks (RFC 1918, RFC 4193) and link-local ones.
const PRIVATE: [&str; 8] =
    ["127.0.0.0/8", "10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "169.254.0.0/16", "::1/128", "fc00::/7", "fe80::/10"];

/// Where trusted proxies are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Network {
    /// On this machine and in all private networks.
    Private,
    /// In one network, or at one address.
    One(IpNet),
}

impl FromStr for Network {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "private" {
            return Ok(Self::Private);
        }
        let one = text.parse().ok().or_else(|| text.parse::<IpAddr>().ok().map(IpNet::from));
        one.map(Self::One)
            .ok_or_else(|| "an address, a network as 10.0.0.0/8, or `private` for all private networks and this machine".into())
    }
}

/// How trusted proxies name the client.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum ClientAddress {
    /// By `X-Forwarded-For`, the most common way.
    #[default]
    XForwardedFor,
    /// By `Forwarded` (RFC 7239).
    Forwarded,
    /// By the PROXY protocol, version 1 or 2, at the start of each connection.
    ProxyProtocol,
}

/// The trusted proxies. Without any, the client of a request is the peer of its connection.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Proxies {
    networks: Vec<IpNet>,
    told: ClientAddress,
}

impl Proxies {
    /// Trusts proxies in `networks`, which name clients as `told`.
    #[must_use]
    pub fn new(networks: &[Network], told: ClientAddress) -> Self {
        let of = |network: &Network| match network {
            Network::Private => PRIVATE.iter().filter_map(|text| text.parse().ok()).collect(),
            Network::One(one) => vec![one.trunc()],
        };
        Self { networks: networks.iter().flat_map(of).collect(), told }
    }

    /// Whether a peer is a trusted proxy.
    #[must_use]
    pub fn trusts(&self, peer: IpAddr) -> bool {
        // most servers trust none
        !self.networks.is_empty() && self.networks.iter().any(|network| network.contains(&peer.to_canonical()))
    }

    /// Whether connections from there begin with the PROXY protocol.
    #[must_use]
    pub fn uses_proxy_protocol(&self, peer: IpAddr) -> bool {
        self.told == ClientAddress::ProxyProtocol && self.trusts(peer)
    }

    /// The client of a request from `peer`: the last address on its way that is not a trusted proxy, or the first of all.
    #[must_use]
    pub fn client(&self, peer: IpAddr, headers: &HeaderMap) -> IpAddr {
        if !self.trusts(peer) {
            return peer;
        }
        match self.told {
            ClientAddress::XForwardedFor => self.last(peer, hops(headers, &X_FORWARDED_FOR)),
            ClientAddress::Forwarded => self.last(peer, hops(headers, &header::FORWARDED).map(forwarded)),
            ClientAddress::ProxyProtocol => peer,
        }
    }

    /// Goes back from `peer` as far as trusted proxies saw; stops at anything that is not an address.
    fn last<'a>(&self, peer: IpAddr, hops: impl Iterator<Item = &'a str>) -> IpAddr {
        let mut client = peer;
        for hop in hops {
            let Some(address) = address(hop) else { break };
            client = address;
            if !self.trusts(client) {
                break;
            }
        }
        client
    }
}

/// Items of a list over all headers of a name, last first.
fn hops<'a>(headers: &'a HeaderMap, name: &HeaderName) -> impl Iterator<Item = &'a str> {
    headers.get_all(name).into_iter().rev().flat_map(|value| value.to_str().unwrap_or_default().rsplit(','))
}

/// The `for` parameter of a hop of `Forwarded`.
fn forwarded(hop: &str) -> &str {
    let mut pairs = hop.split(';').filter_map(|pair| pair.split_once('='));
    pairs.find(|(name, _)| name.trim().eq_ignore_ascii_case("for")).map_or("", |(_, value)| value)
}

/// An address as proxies write it: with or without port, quotes and brackets.
fn address(text: &str) -> Option<IpAddr> {
    let text = text.trim().trim_matches('"');
    let alone = text.strip_prefix('[').and_then(|rest| rest.split_once(']')).map_or(text, |(inside, _)| inside);
    let with_port = || text.parse::<std::net::SocketAddr>().ok().map(|all| all.ip());
    alone.parse::<IpAddr>().ok().or_else(with_port).map(|address| address.to_canonical())
}

/// Sets a header with the client from the PROXY protocol, as an HTTP proxy does; such a client is never this machine's own user.
pub fn set_forwarded(headers: &mut HeaderMap, client: IpAddr) {
    if let Ok(value) = HeaderValue::try_from(client.to_string()) {
        headers.insert(X_FORWARDED_FOR, value);
    }
}

/// Reads the PROXY protocol header of a connection: the client, or `None` for a health check by the proxy itself.
///
/// # Errors
/// An I/O error; [`io::ErrorKind::InvalidData`] if the connection begins otherwise.
pub async fn read_proxy_protocol(stream: &mut TcpStream) -> io::Result<Option<IpAddr>> {
    let mut bytes = [0; MOST];
    loop {
        // peek, so that the bytes after the header stay in the socket
        let seen = stream.peek(&mut bytes).await?;
        if seen == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        match ProxyHeader::read(&bytes[..seen]) {
            Ok(ProxyHeader { client, length }) => {
                stream.read_exact(&mut bytes[..length]).await?;
                return Ok(client);
            }
            Err(Error::BufferTooShort) if seen < MOST => tokio::time::sleep(AGAIN).await,
            Err(error) => return Err(io::Error::new(io::ErrorKind::InvalidData, error)),
        }
    }
}

/// A PROXY protocol header.
#[derive(Debug, PartialEq, Eq)]
pub struct ProxyHeader {
    /// The client; `None` for a connection of the proxy itself.
    pub client: Option<IpAddr>,
    /// Length of the header in bytes.
    pub length: usize,
}

impl ProxyHeader {
    /// # Errors
    /// [`Error::BufferTooShort`] if more bytes are needed.
    pub fn read(bytes: &[u8]) -> Result<Self, Error> {
        let (header, length) = proxy_header::ProxyHeader::parse(bytes, ParseConfig { include_tlvs: false, ..ParseConfig::default() })?;
        Ok(Self { client: header.proxied_address().map(|address| address.source.ip().to_canonical()), length })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use tokio::io::AsyncWriteExt as _;

    use super::*;

    fn trusted(networks: &[&str], told: ClientAddress) -> Proxies {
        Proxies::new(&networks.iter().map(|text| text.parse().unwrap()).collect::<Vec<_>>(), told)
    }

    fn client(proxies: &Proxies, peer: &str, headers: &[(&'static str, &str)]) -> String {
        let headers = headers.iter().map(|(k, v)| (HeaderName::from_static(k), HeaderValue::from_str(v).unwrap())).collect();
        proxies.client(peer.parse().unwrap(), &headers).to_string()
    }

    #[test]
    fn headers_of_untrusted_peers_are_ignored() {
        let (none, one) = (Proxies::default(), trusted(&["10.0.0.1"], ClientAddress::XForwardedFor));
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
        let all = trusted(&["private"], ClientAddress::XForwardedFor);
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
    fn forwarded_follows_rfc_7239() {
        let all = trusted(&["127.0.0.0/8", "203.0.113.43"], ClientAddress::Forwarded);
        let of = |way: &str| client(&all, "127.0.0.1", &[("forwarded", way), ("x-forwarded-for", "198.51.100.1")]);
        assert_eq!(of("for=192.0.2.43, For=\"203.0.113.43\";proto=https;by=127.0.0.1"), "192.0.2.43");
        assert_eq!(of("proto=http; for=\"[2001:db8:cafe::17]:4711\""), "2001:db8:cafe::17");
        assert_eq!(of("for=192.0.2.43;proto=https"), "192.0.2.43");
        for nothing in ["for=_gazonk", "proto=https", "for", "for=\"\"", "unfor=192.0.2.43"] {
            assert_eq!(of(nothing), "127.0.0.1", "{nothing}");
        }
    }

    #[test]
    fn networks_are_read_in_cidr_notation() {
        assert_eq!("private".parse(), Ok(Network::Private));
        assert!(trusted(&["10.1.2.3/8"], ClientAddress::default()).trusts("10.200.0.1".parse().unwrap()));
        assert!(trusted(&["fd00::/8"], ClientAddress::default()).trusts("fd12::1".parse().unwrap()));
        for wrong in ["", "10.0.0.0/33", "example.org", "Private", "10.0.0"] {
            assert!(wrong.parse::<Network>().unwrap_err().contains("10.0.0.0/8"), "{wrong}");
        }
    }

    /// Reads the header of a connection whose client writes `pieces`; also returns the bytes left to read.
    async fn begun(pieces: &[&[u8]]) -> (io::Result<Option<IpAddr>>, Vec<u8>) {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let mut client = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let (mut stream, _) = listener.accept().await.unwrap();
        let pieces: Vec<Vec<u8>> = pieces.iter().map(|piece| piece.to_vec()).collect();
        let writes = async move {
            for piece in pieces {
                client.write_all(&piece).await.unwrap();
                tokio::time::sleep(AGAIN * 2).await;
            }
        };
        let (client, ()) = tokio::join!(read_proxy_protocol(&mut stream), writes);
        let mut left = Vec::new();
        if client.is_ok() {
            stream.read_to_end(&mut left).await.unwrap();
        }
        (client, left)
    }

    #[tokio::test]
    async fn both_versions_of_the_proxy_protocol_are_read_and_nothing_after_them() {
        let two = |about: &[u8]| [b"\r\n\r\n\0\r\nQUIT\n".as_slice(), about].concat();
        let four = two(b"\x21\x11\x00\x0f\xc0\x00\x02\x07\x7f\x00\x00\x01\x12\x34\x00\x50\x04\x00\x00");
        let client = Some("192.0.2.7".parse().unwrap());
        for (pieces, expected) in [
            (vec![b"PROXY TCP4 192.0.2.7 127.0.0.1 4711 80\r\nGET".as_slice()], client),
            (vec![b"PROXY TCP4 192.0.2.7 127", b".0.0.1 4711 80\r\nGET"], client),
            (vec![&four, b"GET"], client),
            (vec![&four[..9], &four[9..20], &four[20..], b"GET"], client),
            (vec![b"PROXY TCP6 2001:db8::1 ::1 4711 80\r\nGET"], Some("2001:db8::1".parse().unwrap())),
            (vec![b"PROXY UNKNOWN\r\nGET"], None),
            (vec![&two(b"\x20\x00\x00\x00"), b"GET"], None),
        ] {
            let (told, left) = begun(&pieces).await;
            assert_eq!((told.unwrap(), left.as_slice()), (expected, b"GET".as_slice()), "{pieces:?}");
        }
    }

    #[tokio::test]
    async fn connections_without_a_proxy_header_are_refused() {
        let endless = [b"PROXY TCP4 ".as_slice(), &[b'1'; 5000]].concat();
        let large = [b"\r\n\r\n\0\r\nQUIT\n\x21\x11\xff\xff".as_slice(), &[0; MOST]].concat();
        for pieces in [
            vec![b"GET / HTTP/1.1\r\nHost: a\r\n\r\n".as_slice()],
            vec![b"\x16\x03\x01 and more of a handshake"],
            vec![b"PROXY TCP4 one two 1 2\r\n"],
            vec![&endless],
            vec![&large],
        ] {
            assert_eq!(begun(&pieces).await.0.unwrap_err().kind(), io::ErrorKind::InvalidData, "{pieces:?}");
        }
    }

    proptest! {
        /// Anything before the proxy's own entry has no effect.
        #[test]
        fn only_the_last_hop_before_the_proxy_counts(before in "[ -~]{0,60}", quoted in any::<bool>()) {
            let of = |told, name, value: &str| client(&trusted(&["10.0.0.1"], told), "10.0.0.1", &[(name, value)]);
            let wrote = if quoted { "for=\"192.0.2.1:80\"" } else { "for=192.0.2.1;proto=https" };
            prop_assert_eq!(of(ClientAddress::XForwardedFor, "x-forwarded-for", &format!("{before}, 192.0.2.1")), "192.0.2.1");
            prop_assert_eq!(of(ClientAddress::Forwarded, "forwarded", &format!("{before}, {wrote}")), "192.0.2.1");
        }
    }
}
