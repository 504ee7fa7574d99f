//! The path of the server on its host, if a proxy serves other applications beside it.
//!
//! Requests may have the path or not, because some proxies remove it, and nodes and health checks reach the server without a proxy. All
//! addresses in answers have it. Handlers, permissions and signatures only know addresses without it.

use std::fmt;
use std::str::FromStr;

use axum::http::Uri;
use axum::http::uri::PathAndQuery;

/// First names of the server's own addresses. Below one of them, it could not tell an address with the path from one without.
const OWN: [&str; 10] = ["demo", "embed", "healthz", "live", "metrics", "oembed", "readyz", "static", "v1", "view"];

/// Path before every address, such as `/3d`; empty by default.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BasePath(String);

impl FromStr for BasePath {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let is_fine = |name: &str| {
            let is_plain = name.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_.~".contains(&b));
            is_plain && !matches!(name, "" | "." | "..")
        };
        if text.split('/').nth(1).is_some_and(|first| OWN.contains(&first)) {
            return Err("the server has addresses of its own that begin so; expected a path such as /3d");
        }
        let fits = text.strip_prefix('/').is_some_and(|names| names.split('/').all(is_fine));
        fits.then(|| Self(text.to_owned())).ok_or("expected a path such as /3d: letters, digits and -_.~ after each /, none at the end")
    }
}

impl fmt::Display for BasePath {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl BasePath {
    /// Whether the server has the whole host.
    pub const fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The address of `path`, which begins with `/`, for clients.
    pub fn at(&self, path: &str) -> String {
        format!("{}{path}", self.0)
    }

    /// The path that all addresses are at or below: itself, or `/`.
    pub fn root(&self) -> &str {
        if self.is_empty() { "/" } else { &self.0 }
    }

    /// Removes the path from a client's address; leaves others as they are.
    pub fn strip(&self, uri: &mut Uri) {
        let whole = uri.path_and_query().map_or("", PathAndQuery::as_str);
        let rest = whole.strip_prefix(&self.0).filter(|rest| !self.is_empty() && (rest.is_empty() || rest.starts_with(['/', '?'])));
        let Some(rest) = rest else { return };
        let slash = if rest.starts_with('/') { "" } else { "/" };
        let mut parts = uri.clone().into_parts();
        parts.path_and_query = format!("{slash}{rest}").parse().ok();
        if let Ok(stripped) = Uri::from_parts(parts) {
            *uri = stripped;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_plain_paths_are_accepted() {
        for fine in ["/3d", "/a/b-c_d.e~f", "/..."] {
            assert_eq!(fine.parse::<BasePath>().unwrap().to_string(), fine);
        }
        for wrong in [
            "", "/", "3d", "/3d/", "//3d", "/a//b", "/..", "/a/../b", "/.", "/a b", "/a%20b", "/a?b", "/a#b", "/a;b", "/a\"b", "/é", "/v1",
            "/live/3d",
        ] {
            assert!(wrong.parse::<BasePath>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn the_path_is_removed_once_and_only_as_a_whole() {
        let stripped = |base: &str, uri: &str| {
            let mut uri = uri.parse().unwrap();
            base.parse::<BasePath>().unwrap_or_default().strip(&mut uri);
            uri.to_string()
        };
        for (from, to) in [
            ("/3d", "/"),
            ("/3d/", "/"),
            ("/3d?a=%41", "/?a=%41"),
            ("/3d/view/1?a=b&c", "/view/1?a=b&c"),
            ("/3d/3d/x", "/3d/x"),
            ("http://h:1/3d/x", "http://h:1/x"),
            ("/3dx", "/3dx"),
            ("/view/3d", "/view/3d"),
            ("/%33d/x", "/%33d/x"),
            ("*", "*"),
        ] {
            assert_eq!(stripped("/3d", from), to, "{from}");
        }
        assert_eq!((stripped("", "/x?y"), BasePath::default().root(), BasePath::default().at("/x")), ("/x?y".into(), "/", "/x".into()));
    }
}
