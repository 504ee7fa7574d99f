//! Requests of this server to addresses that callers name. They reach public addresses alone, unless the operator permits others: a
//! caller must not use the server to reach its own network.
//!
//! A name is resolved here, and its addresses are filtered, so that a name cannot have one address when it is checked and another one when
//! it is connected to. No proxy of the environment is used, which would resolve names itself.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::OnceLock;

use ipnet::{Ipv4Net, Ipv6Net};
use reqwest::dns::{Addrs, Name, Resolve, Resolving};
use reqwest::{Client, ClientBuilder, Url};

/// Longest address in bytes.
const MAX_URL: usize = 2048;

/// Addresses that a request may reach.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AddressPolicy {
    /// Public ones.
    Public,
    /// All, those of this machine and its networks included.
    Any,
}

/// Why a request is not sent to an address.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum AddressError {
    /// It is no URL, or longer than 2 048 bytes.
    #[error("must be an address as https://example.org/path")]
    Malformed,
    /// It is for another protocol.
    #[error("must begin with https:// or http://")]
    Scheme,
    /// It has a user or a password.
    #[error("must not contain a user or a password")]
    Credentials,
    /// It names this machine, a private network, or what is reserved.
    #[error("must be a public address, not one of this machine or of a private network")]
    NotPublic,
}

const fn four(a: u8, b: u8, c: u8, d: u8, bits: u8) -> Ipv4Net {
    Ipv4Net::new_assert(Ipv4Addr::new(a, b, c, d), bits)
}

const fn six(a: u16, b: u16, bits: u8) -> Ipv6Net {
    Ipv6Net::new_assert(Ipv6Addr::new(a, b, 0, 0, 0, 0, 0, 0), bits)
}

/// Networks of IPv4 that are not public (IANA's registry of special-purpose addresses).
const SPECIAL_4: [Ipv4Net; 15] = [
    four(0, 0, 0, 0, 8),
    four(10, 0, 0, 0, 8),
    four(100, 64, 0, 0, 10),
    four(127, 0, 0, 0, 8),
    four(169, 254, 0, 0, 16),
    four(172, 16, 0, 0, 12),
    four(192, 0, 0, 0, 24),
    four(192, 0, 2, 0, 24),
    four(192, 88, 99, 0, 24),
    four(192, 168, 0, 0, 16),
    four(198, 18, 0, 0, 15),
    four(198, 51, 100, 0, 24),
    four(203, 0, 113, 0, 24),
    four(224, 0, 0, 0, 4),
    four(240, 0, 0, 0, 4),
];
/// Unicast addresses of IPv6, and networks among them that are not public: protocols such as Teredo, and documentation.
const UNICAST: Ipv6Net = six(0x2000, 0, 3);
const SPECIAL_6: [Ipv6Net; 3] = [six(0x2001, 0, 23), six(0x2001, 0xdb8, 32), six(0x3fff, 0, 20)];
/// Networks of IPv6 whose addresses hold one of IPv4: at the end, and after 16 bits.
const TRANSLATED: Ipv6Net = six(0x64, 0xff9b, 96);
const SIX_TO_FOUR: Ipv6Net = six(0x2002, 0, 16);

/// Whether an address belongs to the public Internet. An address of IPv6 that holds one of IPv4 is public if that one is.
pub fn is_public(address: IpAddr) -> bool {
    match address.to_canonical() {
        IpAddr::V4(v4) => !SPECIAL_4.iter().any(|net| net.contains(&v4)),
        IpAddr::V6(v6) => {
            let bits = u128::from(v6);
            let held = |shift: u32| is_public(Ipv4Addr::from((bits >> shift) as u32).into());
            if TRANSLATED.contains(&v6) {
                held(0)
            } else if SIX_TO_FOUR.contains(&v6) {
                held(80)
            } else {
                UNICAST.contains(&v6) && !SPECIAL_6.iter().any(|net| net.contains(&v6))
            }
        }
    }
}

/// Reads an address that a caller names. One that is a number must be within `reach`; the numbers of a name are checked when it is
/// resolved.
///
/// # Errors
/// [`AddressError`].
pub fn url(text: &str, reach: AddressPolicy) -> Result<Url, AddressError> {
    let url: Url = text.parse().ok().filter(|_| text.len() <= MAX_URL).ok_or(AddressError::Malformed)?;
    check(&url, reach)?;
    Ok(url)
}

/// Checks an address, as [`url`] does.
///
/// # Errors
/// [`AddressError`].
pub fn check(url: &Url, reach: AddressPolicy) -> Result<(), AddressError> {
    if !matches!(url.scheme(), "http" | "https") {
        return Err(AddressError::Scheme);
    }
    if !url.username().is_empty() || url.password().is_some() {
        return Err(AddressError::Credentials);
    }
    let host = url.host_str().ok_or(AddressError::Malformed)?;
    let number = host.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>();
    match number {
        Ok(address) if reach == AddressPolicy::Public && !is_public(address) => Err(AddressError::NotPublic),
        _ => Ok(()),
    }
}

/// Resolves names to their public addresses.
struct PublicAddresses;

impl Resolve for PublicAddresses {
    fn resolve(&self, name: Name) -> Resolving {
        Box::pin(async move {
            let all = tokio::net::lookup_host((name.as_str(), 0)).await?;
            Ok(Box::new(public_of(all)?.into_iter()) as Addrs)
        })
    }
}

/// The public ones among the addresses of a name.
fn public_of(all: impl Iterator<Item = SocketAddr>) -> Result<Vec<SocketAddr>, NotPublic> {
    let public: Vec<SocketAddr> = all.filter(|address| is_public(address.ip())).collect();
    if public.is_empty() { Err(NotPublic) } else { Ok(public) }
}

/// A name has no public address.
#[derive(Debug, thiserror::Error)]
#[error("the name has no public address")]
struct NotPublic;

/// Whether a request failed because its name has no public address.
pub fn is_not_public(error: &reqwest::Error) -> bool {
    anyhow::Chain::new(error).any(<dyn std::error::Error>::is::<NotPublic>)
}

/// Sends requests to addresses within a reach. Its client is made when it is first used: a machine without certificates can run a server
/// that sends none.
#[derive(Clone, Debug)]
pub struct Outbound {
    reach: AddressPolicy,
    client: OnceLock<Client>,
}

impl Outbound {
    pub const fn new(reach: AddressPolicy) -> Self {
        Self { reach, client: OnceLock::new() }
    }

    #[cfg(test)]
    pub fn of(reach: AddressPolicy, client: Client) -> Self {
        Self { reach, client: OnceLock::from(client) }
    }

    pub const fn reach(&self) -> AddressPolicy {
        self.reach
    }

    /// A client that follows no redirects. Check each URL by [`check`], too: the client does not resolve numbers.
    ///
    /// # Errors
    /// The system's certificates cannot be read.
    pub fn client(&self) -> reqwest::Result<&Client> {
        if let Some(client) = self.client.get() {
            return Ok(client);
        }
        let client = builder(self.reach).build()?;
        Ok(self.client.get_or_init(|| client))
    }
}

pub fn builder(reach: AddressPolicy) -> ClientBuilder {
    // keeps a provider that is installed already
    let _ = rustls::crypto::ring::default_provider().install_default();
    let builder = Client::builder().no_proxy().redirect(reqwest::redirect::Policy::none()).referer(false);
    let builder = builder.user_agent(concat!("tmpi/", env!("CARGO_PKG_VERSION")));
    match reach {
        AddressPolicy::Public => builder.dns_resolver(PublicAddresses),
        AddressPolicy::Any => builder,
    }
}

/// The innermost cause of a request's error, without its URL, which may hold a secret.
pub fn cause(error: reqwest::Error) -> String {
    anyhow::Error::from(error.without_url()).root_cause().to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_addresses_of_the_public_internet_are_public() {
        let all = |text: &'static str| text.split(' ').map(|address| (address, is_public(address.parse().unwrap())));
        for public in [
            "1.1.1.1 192.0.1.1 2606:4700::1111 2a00::1",
            // next to networks that are not
            "9.255.255.255 100.63.255.255 100.128.0.1 172.15.0.1 172.32.0.1 223.255.255.255",
            // of IPv4, within IPv6
            "::ffff:1.1.1.1 64:ff9b::1.1.1.1 2002:101:101::1",
        ] {
            assert_eq!(all(public).find(|(_, public)| !public), None);
        }
        for special in [
            // this host and its networks
            "0.0.0.0 0.1.2.3 127.0.0.1 127.255.255.255 :: ::1",
            "10.0.0.1 100.64.0.1 100.127.255.255 169.254.169.254 172.16.0.1 172.31.255.255 192.168.1.1",
            "fc00::1 fd00:ec2::254 fe80::1 fec0::1",
            // protocols, documentation, benchmarks
            "192.0.0.8 192.0.2.1 192.88.99.1 198.18.0.1 198.19.255.255 198.51.100.1 203.0.113.1",
            "64:ff9b:1::1.1.1.1 100::1 2001::1 2001:10::1 2001:db8::1 3fff::1 5f00::1",
            // multicast and reserved
            "224.0.0.1 239.255.255.255 240.0.0.1 255.255.255.255 ff02::1",
            // of IPv4, within IPv6
            "::127.0.0.1 ::ffff:127.0.0.1 ::ffff:10.0.0.1 64:ff9b::127.0.0.1 64:ff9b::a00:1 2002:7f00:1:: 2002:c0a8:101::1",
        ] {
            assert_eq!(all(special).find(|(_, public)| *public), None);
        }
    }

    #[test]
    fn addresses_are_checked_in_every_notation() {
        use AddressError::{Credentials, Malformed, NotPublic, Scheme};
        for (text, wrong) in [
            ("https://example.org/hook?a=b", None),
            ("http://example.org:8080", None),
            ("https://[2606:4700::1111]/", None),
            ("http://127.0.0.1/", Some(NotPublic)),
            ("http://127.1/", Some(NotPublic)),
            ("http://2130706433/", Some(NotPublic)),
            ("http://0x7f.0.0.1/", Some(NotPublic)),
            ("http://0177.0.0.1/", Some(NotPublic)),
            ("http://[::1]:80/", Some(NotPublic)),
            ("http://[::ffff:169.254.169.254]/", Some(NotPublic)),
            ("http://0/", Some(NotPublic)),
            ("ftp://example.org/", Some(Scheme)),
            ("file:///etc/passwd", Some(Scheme)),
            ("https://me@example.org/", Some(Credentials)),
            ("https://me:secret@example.org/", Some(Credentials)),
            ("example.org", Some(Malformed)),
            ("https://", Some(Malformed)),
            ("", Some(Malformed)),
        ] {
            assert_eq!(url(text, AddressPolicy::Public).err(), wrong, "{text}");
        }
        assert!(url("http://127.0.0.1/", AddressPolicy::Any).is_ok());
        assert_eq!(url(&format!("https://a/{}", "x".repeat(MAX_URL)), AddressPolicy::Any), Err(Malformed));
    }

    #[test]
    fn only_public_addresses_of_a_name_are_used() {
        let of = |all: &[&str]| public_of(all.iter().map(|a| SocketAddr::new(a.parse().unwrap(), 0))).map(|a| a.len()).ok();
        assert_eq!((of(&["127.0.0.1", "1.1.1.1", "::1"]), of(&["127.0.0.1"]), of(&[])), (Some(1), None, None));
    }

    #[tokio::test]
    async fn a_name_of_this_machine_is_not_connected_to() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://localhost:{}/", listener.local_addr().unwrap().port());
        let refused = Outbound::new(AddressPolicy::Public).client().unwrap().get(&url).send().await.unwrap_err();
        assert!(is_not_public(&refused));
        assert_eq!(cause(refused), "the name has no public address");
        let (came, asked) = tokio::join!(listener.accept(), async {
            let wait = std::time::Duration::from_millis(200);
            Outbound::new(AddressPolicy::Any).client().unwrap().get(&url).timeout(wait).send().await
        });
        assert!(came.is_ok() && asked.is_err());
    }
}
