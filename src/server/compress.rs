//! Gzip for pages, scripts and JSON. Containers and images are compressed already.
//!
//! Not a layer around the service: a compressed answer is another representation with its own entity tag (RFC 9110, section 8.8.3.3),
//! ranges apply to the plain one, and embedded files are compressed once.

use std::io::Write as _;

use axum::http::{HeaderMap, header};
use bytes::Bytes;
use flate2::Compression;
use flate2::write::GzEncoder;

/// Smaller answers fit in one packet anyway.
const LEAST: usize = 1200;
/// Suffix of a compressed answer's entity tag.
const SUFFIX: &str = "-gzip";

/// Whether the client accepts gzip (RFC 9110, section 12.5.3).
pub fn accepts_gzip(headers: &HeaderMap) -> bool {
    let (mut named, mut any) = (None, false);
    let codings = headers.get_all(header::ACCEPT_ENCODING).iter().filter_map(|v| v.to_str().ok()).flat_map(|v| v.split(','));
    for coding in codings {
        let mut parts = coding.split(';').map(str::trim);
        let name = parts.next().unwrap_or_default();
        let weight = parts.find_map(|p| p.strip_prefix("q=")).map_or(1.0, |q| q.parse::<f32>().unwrap_or(0.0));
        match name {
            _ if name.eq_ignore_ascii_case("gzip") || name.eq_ignore_ascii_case("x-gzip") => named = Some(weight > 0.0),
            "*" => any = weight > 0.0,
            _ => {}
        }
    }
    named.unwrap_or(any)
}

/// `bytes` in gzip; `None` if that is not worth it.
pub fn gzip(bytes: &[u8], level: Compression) -> Option<Bytes> {
    if bytes.len() < LEAST {
        return None;
    }
    let mut coder = GzEncoder::new(Vec::with_capacity(bytes.len() / 2), level);
    coder.write_all(bytes).ok()?;
    let coded = coder.finish().ok()?;
    (coded.len() + 64 < bytes.len()).then(|| coded.into())
}

/// The entity tag of the compressed answer, from that of the plain one.
pub fn gzip_etag(etag: &str) -> String {
    format!("{}{SUFFIX}\"", etag.strip_suffix('"').unwrap_or(etag))
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    #[test]
    fn accept_encoding_decides_gzip() {
        let with = |value: &'static str| accepts_gzip(&[(header::ACCEPT_ENCODING, HeaderValue::from_static(value))].into_iter().collect());
        for yes in ["gzip", "br, GZIP;q=0.5", "*", "deflate, *;q=0.1", "gzip;q=1, *;q=0"] {
            assert!(with(yes), "{yes}");
        }
        for no in ["", "br", "identity", "gzip;q=0", "*, gzip;q=0", "*;q=0", "gzip;q=none", "gzipped"] {
            assert!(!with(no), "{no}");
        }
        assert!(!accepts_gzip(&HeaderMap::new()), "who does not say gets it plain");
    }

    #[test]
    fn bytes_are_compressed_only_if_that_makes_them_smaller() {
        assert!(gzip(&[7; LEAST], Compression::default()).is_some());
        assert!(gzip(&[7; LEAST - 1], Compression::default()).is_none());
        let noise: Vec<u8> = (0..5000).map(|i| (256.0 * tmpi_testing::pictures::noise(i, 0)) as u8).collect();
        assert!(gzip(&noise, Compression::best()).is_none());
    }
}
