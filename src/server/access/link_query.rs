//! Parameters of a signed, expiring read link, as they come in URLs.

use axum::http::Uri;
use axum::http::uri::PathAndQuery;
use tmpi_library::Link;

/// A link as a URL query.
pub fn query_of(link: &Link) -> String {
    format!("expires={}&signature={}", link.expires, link.signature())
}

/// The link in the URL that the parameter `url` names, as in oEmbed requests.
pub fn link_of_url(uri: &Uri) -> Option<Link> {
    let (_, url) = form_urlencoded::parse(uri.query()?.as_bytes()).find(|(name, _)| name == "url")?;
    take_link(&url.parse().ok()?)?.1
}

/// Splits a URL into the URL without link parameters and the link (`None` if malformed). `None` without link parameters.
pub fn take_link(uri: &Uri) -> Option<(Uri, Option<Link>)> {
    let query = uri.query()?;
    let of = |pair: &'_ str, name: &str| pair.split_once('=').map_or(pair, |(n, _)| n) == name;
    let (ours, rest): (Vec<&str>, Vec<&str>) = query.split('&').partition(|pair| of(pair, "expires") || of(pair, "signature"));
    if ours.is_empty() {
        return None;
    }
    let value = |name: &str| {
        let mut all = ours.iter().filter(|pair| of(pair, name));
        // a repeated parameter does not count
        all.next().filter(|_| all.next().is_none()).and_then(|pair| pair.split_once('=')).map(|(_, value)| value)
    };
    let read = |(expires, signature): (&str, &str)| Link::of_signature(expires.parse().ok()?, signature);
    let link = value("expires").zip(value("signature")).and_then(read);
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
                .map(|(uri, link)| (uri.to_string(), link.map(|l| (l.expires, l.signature()))))
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
        for wrong in ["expires=12", "signature=ab", "expires=1&expires=12&signature=ab", "expires=x&signature=ab", "expires&signature"] {
            assert_eq!(take(&format!("/x?{wrong}")), Some(("/x".into(), None)), "{wrong}");
        }
    }
}
