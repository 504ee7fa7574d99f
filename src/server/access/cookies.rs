//! Cookies, and cache headers for private answers.

use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::Response;

use crate::server::conditional::insert;
use crate::server::hosts::origin;

/// Names of a cookie without TLS and over TLS.
pub type Cookie = [&'static str; 2];

/// Cookie with an owner's secret or session. Over TLS it has a `__Host-` name, which no other host of the same domain can set (RFC
/// 6265bis, section 4.1.3.2).
pub const OWNER: Cookie = ["tmpi_owner", "__Host-tmpi_owner"];
/// The same for a server below a path, which `__Host-` does not allow.
pub const OWNER_BELOW: Cookie = ["tmpi_owner", "__Secure-tmpi_owner"];
/// Cookie with a photo's own token, scoped to that photo's path. Over TLS it has a `__Secure-` name, which only a host with TLS can set.
pub const MANAGE: Cookie = ["tmpi_manage", "__Secure-tmpi_manage"];
/// Cookie with the link that opened a photo.
pub const LINK: Cookie = ["tmpi_link", "tmpi_link"];
/// Lifetime of the owner and photo-token cookies in seconds: the longest that browsers allow.
pub const KEPT: u64 = 400 * 86_400;

fn is_tls(headers: &HeaderMap) -> bool {
    origin(headers).is_some_and(|o| o.starts_with("https:"))
}

pub fn cookie(headers: &HeaderMap, [plain, tls]: Cookie) -> Option<&str> {
    let name = if is_tls(headers) { tls } else { plain };
    let all = headers.get_all(header::COOKIE).iter().filter_map(|v| v.to_str().ok()).flat_map(|v| v.split(';'));
    all.filter_map(|pair| pair.trim().split_once('=')).find(|(n, _)| *n == name).map(|(_, value)| value)
}

/// Sets a cookie that scripts cannot read and pages of other sites do not send.
pub fn set_cookie(response: &mut Response, asked: &HeaderMap, [plain, tls]: Cookie, value: &str, path: &str, age: u64) {
    let (name, secure) = if is_tls(asked) { (tls, "; Secure") } else { (plain, "") };
    let text = format!("{name}={value}; Path={path}; Max-Age={age}; HttpOnly; SameSite=Lax{secure}");
    if let Ok(mut value) = HeaderValue::from_str(&text) {
        value.set_sensitive(true);
        response.headers_mut().append(header::SET_COOKIE, value);
        insert(response, header::CACHE_CONTROL, "private, no-store");
    }
}

/// Marks an answer as private: only the caller's browser may store it, and it revalidates each time.
pub fn keep_private(response: &mut Response) {
    let kept = response.headers().get(header::CACHE_CONTROL).and_then(|v| v.to_str().ok()).unwrap_or_default();
    if kept != "no-store" {
        insert(response, header::CACHE_CONTROL, "private, no-cache");
    }
    response.headers_mut().append(header::VARY, HeaderValue::from_static("authorization, cookie"));
}
