//! Cookies, and cache headers for private answers.

use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::Response;

use crate::server::conditional::insert;
use crate::server::hosts::origin;
use tmpi_library::PhotoId;

/// Cookie with an owner's secret. Over TLS it has a `__Host-` name, which no other host of the same domain can set (RFC 6265bis,
/// section 4.1.3.2).
const OWNER_COOKIE: &str = "tmpi_owner";
const OWNER_COOKIE_TLS: &str = "__Host-tmpi_owner";
/// Cookie with a photo's own token, scoped to that photo's path. Over TLS it has a `__Secure-` name, which only a host with TLS can set.
const MANAGE_COOKIE: &str = "tmpi_manage";
const MANAGE_COOKIE_TLS: &str = "__Secure-tmpi_manage";
/// Cookie with the link that opened a photo.
pub const LINK_COOKIE: &str = "tmpi_link";
/// Lifetime of the owner and photo-token cookies in seconds: the longest that browsers allow.
pub const KEPT: u64 = 400 * 86_400;

/// The value of a cookie.
pub fn cookie<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    let all = headers.get_all(header::COOKIE).iter().filter_map(|v| v.to_str().ok()).flat_map(|v| v.split(';'));
    all.filter_map(|pair| pair.trim().split_once('=')).find(|(n, _)| *n == name).map(|(_, value)| value)
}

fn is_tls(headers: &HeaderMap) -> bool {
    origin(headers).is_some_and(|o| o.starts_with("https:"))
}

/// The owner's secret from the request's cookie.
pub fn owner_cookie(headers: &HeaderMap) -> Option<&str> {
    cookie(headers, if is_tls(headers) { OWNER_COOKIE_TLS } else { OWNER_COOKIE })
}

/// The photo's token from the request's cookie.
pub fn manage_cookie(headers: &HeaderMap) -> Option<&str> {
    cookie(headers, if is_tls(headers) { MANAGE_COOKIE_TLS } else { MANAGE_COOKIE })
}

/// Sets a cookie that scripts cannot read and pages of other sites do not send.
pub fn set_cookie(response: &mut Response, asked: &HeaderMap, pair: &str, path: &str, age: u64) {
    let secure = if is_tls(asked) { "; Secure" } else { "" };
    let text = format!("{pair}; Path={path}; Max-Age={age}; HttpOnly; SameSite=Lax{secure}");
    if let Ok(mut value) = HeaderValue::from_str(&text) {
        value.set_sensitive(true);
        response.headers_mut().append(header::SET_COOKIE, value);
        insert(response, header::CACHE_CONTROL, "private, no-store");
    }
}

/// Sets the cookie with an owner's secret.
pub fn set_owner(response: &mut Response, asked: &HeaderMap, secret: &str) {
    let name = if is_tls(asked) { OWNER_COOKIE_TLS } else { OWNER_COOKIE };
    set_cookie(response, asked, &format!("{name}={secret}"), "/", KEPT);
}

/// Sets the cookie with a photo's token, scoped to that photo's path.
pub fn set_manage(response: &mut Response, asked: &HeaderMap, photo: PhotoId, token: &str) {
    let name = if is_tls(asked) { MANAGE_COOKIE_TLS } else { MANAGE_COOKIE };
    set_cookie(response, asked, &format!("{name}={token}"), &format!("/v1/photos/{photo}"), KEPT);
}

/// Marks an answer as private: only the caller's browser may store it, and it revalidates each time.
pub fn keep_private(response: &mut Response) {
    let kept = response.headers().get(header::CACHE_CONTROL).and_then(|v| v.to_str().ok()).unwrap_or_default();
    if kept != "no-store" {
        insert(response, header::CACHE_CONTROL, "private, no-cache");
    }
    response.headers_mut().append(header::VARY, HeaderValue::from_static("authorization, cookie"));
}
