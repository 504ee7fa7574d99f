//! Refuses requests from pages of other sites.

use axum::http::uri::Authority;
use axum::http::{HeaderMap, StatusCode, Uri, header};

use super::problem::Problem;

/// Refuses a request from a page of another site: browsers let a page open web sockets to any server, but send the page's origin.
pub fn check_origin(headers: &HeaderMap) -> Result<(), Problem> {
    let foreign = || Problem::new(StatusCode::FORBIDDEN, "cross-site", "pages of other sites may not do this");
    if let Some(site) = headers.get("sec-fetch-site") {
        return if site == "same-origin" || site == "none" { Ok(()) } else { Err(foreign()) };
    }
    // not a browser, or one that sends no origin
    let Some(origin) = headers.get(header::ORIGIN) else { return Ok(()) };
    let origin = origin.to_str().ok().and_then(|o| o.parse::<Uri>().ok()).and_then(|o| o.authority().cloned());
    let host = headers.get(header::HOST).and_then(|h| h.to_str().ok()).and_then(|h| h.parse::<Authority>().ok());
    if origin.is_some() && origin == host {
        return Ok(());
    }
    Err(foreign())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_from_pages_of_other_sites_are_refused() {
        let headers = |pairs: &[(&'static str, &'static str)]| {
            let pairs = [&[("host", "localhost:8080")], pairs].concat();
            let header = |(name, value)| (header::HeaderName::from_static(name), header::HeaderValue::from_static(value));
            check_origin(&pairs.into_iter().map(header).collect()).is_ok()
        };
        assert!(headers(&[]) && headers(&[("origin", "http://localhost:8080")]));
        for origin in ["http://localhost:8081", "https://example.org", "null"] {
            assert!(!headers(&[("origin", origin)]), "{origin}");
        }
        for (site, good) in [("same-origin", true), ("none", true), ("same-site", false), ("cross-site", false), ("", false)] {
            assert_eq!(headers(&[("sec-fetch-site", site)]), good, "{site}");
        }
        assert!(!headers(&[("sec-fetch-site", "cross-site"), ("origin", "http://localhost:8080")]));
    }
}
