//! A link that opens a photo, as it comes in URLs and cookies: signed by the server, or by an application with its key.
//!
//! The server's parameters are `expires` and `signature`, an application's `key`, `expires` and `signature`. An application signs either
//! exactly what it puts before `&signature=`, or the photo's address `/v1/photos/ID?key=…&expires=…`, which opens all addresses of the photo.
//! No order or encoding is canonical: the signed text is what arrives, byte for byte.

use axum::http::Uri;
use axum::http::uri::PathAndQuery;
use tmpi_library::{Grant, Key, Link, Millis, Photo, Secret, Subject};

/// Names of a link's parameters.
const NAMES: [&str; 3] = ["key", "expires", "signature"];
/// Hex digits of a key's id.
const ID_DIGITS: usize = 8;
/// Beginning of addresses that can be signed alone. A page needs all of its photo.
const ALONE: &str = "/v1/photos/";

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UrlLink {
    /// Expiry and signature.
    pub link: Link,
    /// Id of the application's key; `None` if the server signed.
    pub key: Option<String>,
    /// The path and query before the signature, which the key may have signed.
    target: Option<String>,
}

impl From<Link> for UrlLink {
    fn from(link: Link) -> Self {
        Self { link, key: None, target: None }
    }
}

impl UrlLink {
    /// Reads what [`query_of`] writes, in any order.
    pub fn of_query(query: &str) -> Option<Self> {
        Self::of_pairs(&query.split('&').collect::<Vec<_>>())
    }

    /// `None` if a parameter is malformed, missing or repeated.
    fn of_pairs(pairs: &[&str]) -> Option<Self> {
        let value = |name: &str| pairs.iter().find_map(|pair| pair.split_once('=').filter(|(n, _)| *n == name)).map(|(_, value)| value);
        let key = value("key");
        let is_id = |id: &str| id.len() == ID_DIGITS && id.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b));
        if pairs.len() != 2 + usize::from(key.is_some()) || !key.is_none_or(is_id) {
            return None;
        }
        let link = Link::of_signature(value("expires")?.parse().ok()?, value("signature")?)?;
        Some(Self { key: key.map(str::to_owned), ..link.into() })
    }

    /// Whether it lets its holder see a photo at `now`; `signers` are the keys with its key's id.
    pub fn opens(&self, photo: &Photo, secret: &Secret, signers: &[Key], now: Millis) -> bool {
        let Some(id) = &self.key else { return secret.allows(Grant::View, Subject::Photo(photo), &self.link, now) };
        let whole = format!("{ALONE}{}?key={id}&expires={}", photo.id, self.link.expires);
        let texts: Vec<&String> = std::iter::once(&whole).chain(&self.target).collect();
        // a key opens only its owner's photos, even an administrator's
        let own = signers.iter().filter(|key| photo.owner.as_ref() == Some(&key.owner));
        own.filter_map(Key::link_secret).any(|secret| texts.iter().any(|text| secret.has_signed(text, &self.link, now)))
    }
}

pub fn query_of(UrlLink { link, key, .. }: &UrlLink) -> String {
    let key = key.as_ref().map(|key| format!("key={key}&")).unwrap_or_default();
    format!("{key}expires={}&signature={}", link.expires, link.signature())
}

/// The link in the URL that the parameter `url` names, as in oEmbed requests.
pub fn link_of_url(uri: &Uri) -> Option<UrlLink> {
    let (_, url) = form_urlencoded::parse(uri.query()?.as_bytes()).find(|(name, _)| name == "url")?;
    take_link(&url.parse().ok()?)?.1
}

/// Splits a URL into the URL without link parameters and the link (`None` if malformed). `None` without link parameters.
pub fn take_link(uri: &Uri) -> Option<(Uri, Option<UrlLink>)> {
    let query = uri.query()?;
    let is_ours = |pair: &&str| NAMES.contains(&pair.split_once('=').map_or(*pair, |(name, _)| name));
    let (ours, rest): (Vec<&str>, Vec<&str>) = query.split('&').partition(is_ours);
    if ours.is_empty() {
        return None;
    }
    let before = uri.path_and_query().and_then(|all| all.as_str().rsplit_once("&signature=")).filter(|(_, last)| !last.contains('&'));
    let target = before.map(|(before, _)| before.to_owned()).filter(|text| text.starts_with(ALONE));
    let link = UrlLink::of_pairs(&ours).map(|link| UrlLink { target, ..link });
    let path = if rest.is_empty() { uri.path().to_owned() } else { format!("{}?{}", uri.path(), rest.join("&")) };
    let mut parts = uri.clone().into_parts();
    parts.path_and_query = PathAndQuery::try_from(path).ok();
    Uri::from_parts(parts).ok().map(|uri| (uri, link))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIGNATURE: &str = "abababababababababababababababababababababababababababababababab";

    #[test]
    fn links_are_taken_out_of_addresses_in_any_order() {
        let take = |uri: &str| {
            take_link(&uri.replace("=ab", &format!("={SIGNATURE}")).parse().unwrap())
                .map(|(uri, link)| (uri.to_string(), link.map(|l| (l.link.expires, l.link.signature()))))
        };
        let link = Some((12, SIGNATURE.to_owned()));
        assert_eq!(take("/x?w=8"), None);
        assert_eq!(take("/x?expires=12&signature=ab"), Some(("/x".into(), link.clone())));
        assert_eq!(take("/x?signature=ab&w=8&expires=12"), Some(("/x?w=8".into(), link.clone())));
        assert_eq!(take("http://a/x?w=8&expires=12&signature=ab&v=1"), Some(("http://a/x?w=8&v=1".into(), link)));
        let inner = |uri: &str| link_of_url(&uri.replace("Dab", &format!("D{SIGNATURE}")).parse().unwrap()).map(|l| query_of(&l));
        let named = "/oembed?format=json&url=http%3A%2F%2Fa%2Fview%2F0%3Fsignature%3Dab%26expires%3D12";
        assert_eq!(inner(named), Some(format!("expires=12&signature={SIGNATURE}")));
        assert_eq!(
            (inner("/oembed?url=http%3A%2F%2Fa%2Fview%2F0"), inner("/oembed?expires=12&signature=ab"), inner("/oembed")),
            (None, None, None)
        );
        let twice = ["expires=1&expires=12&signature=ab", "key=0123abcd&key=0123abcd&expires=12&signature=ab"];
        let keys = ["key", "key=", "key=0123abc", "key=0123ABCD", "key=0123abcde", "key=0123abc%64"]
            .map(|key| format!("{key}&expires=12&signature=ab"));
        let wrong = ["expires=12", "signature=ab", "expires=x&signature=ab", "expires&signature", "key=0123abcd"];
        for wrong in wrong.into_iter().chain(twice).chain(keys.iter().map(String::as_str)) {
            assert_eq!(take(&format!("/x?{wrong}")), Some(("/x".into(), None)), "{wrong}");
        }
    }

    #[test]
    fn a_key_signs_what_is_before_the_signature() {
        let link = |uri: &str| take_link(&format!("{uri}={SIGNATURE}").parse().unwrap()).unwrap().1.unwrap();
        let target = |uri: &str| link(uri).target;
        let text = "/v1/photos/0/view?w=8&title=%41&key=0123abcd&expires=12";
        assert_eq!(target(&format!("{text}&signature")).as_deref(), Some(text), "as it arrives");
        assert_eq!(target(&format!("https://a{text}&signature")).as_deref(), Some(text), "without the host");
        assert_eq!(target("/view/0?key=0123abcd&expires=12&signature"), None, "a page needs more than its own address");
        let early = link("/v1/photos/0/view?key=0123abcd&expires=12&w=8&signature");
        assert_eq!(UrlLink::of_query(&query_of(&early)), Some(UrlLink { target: None, ..early }));
        let (uri, link) =
            take_link(&format!("/v1/photos/0/view?key=0123abcd&signature={SIGNATURE}&expires=12&w=8").parse().unwrap()).unwrap();
        assert_eq!((uri.to_string().as_str(), link.unwrap().target), ("/v1/photos/0/view?w=8", None), "nothing can follow a signature");
    }
}
