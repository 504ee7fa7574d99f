//! Tokens of rooms: grants that the server's key signs. Checking one needs no database.

use axum::http::{HeaderMap, header};
use tmpi_library::{Grant, Link, Millis, Secret, Subject};

/// A token to publish in a room, or to watch it, until `expires`, in seconds since 1970.
pub fn room_token(key: &[u8], grant: Grant, room: &str, expires: u64) -> String {
    Secret::of_key(key).sign(grant, Subject::Room(room), expires).to_string()
}

/// Expiry of a token in seconds since 1970; `None` if the token is not valid now for this room and grant. A publisher may watch, too.
pub fn token_expiry(key: &[u8], grant: Grant, room: &str, token: &str, now: u64) -> Option<u64> {
    let (secret, link) = (Secret::of_key(key), token.parse::<Link>().ok()?);
    let allows = |grant| secret.allows(grant, Subject::Room(room), &link, now as Millis * 1000);
    (allows(grant) || grant == Grant::Watch && allows(Grant::Publish)).then_some(link.expires)
}

/// Prefix of a token among the WebSocket protocols: the one header of a WebSocket that a page can set.
const AMONG_PROTOCOLS: &str = "token.";
/// The protocol of a room's web sockets.
pub const PROTOCOL: &str = "tmpi.live.v1";

/// The token in a request's headers: a bearer token (RFC 6750), or one among the WebSocket protocols.
pub fn token_in_headers(headers: &HeaderMap) -> Option<&str> {
    let text = |name| headers.get(name).and_then(|v: &axum::http::HeaderValue| v.to_str().ok());
    let bearer = text(header::AUTHORIZATION).and_then(|v| v.strip_prefix("Bearer "));
    let among = || text(header::SEC_WEBSOCKET_PROTOCOL)?.split(',').find_map(|name| name.trim().strip_prefix(AMONG_PROTOCOLS));
    bearer.or_else(among)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn is_good(key: &[u8], grant: Grant, room: &str, token: &str, now: u64) -> bool {
        token_expiry(key, grant, room, token, now).is_some()
    }

    #[test]
    fn a_token_is_valid_for_its_room_role_and_time_only() {
        let key = b"a key";
        let watch = room_token(key, Grant::Watch, "attic", 1000);
        let publish = room_token(key, Grant::Publish, "attic", 1000);
        assert!(is_good(key, Grant::Watch, "attic", &watch, 999) && is_good(key, Grant::Publish, "attic", &publish, 999));
        assert_eq!(token_expiry(key, Grant::Watch, "attic", &publish, 999), Some(1000), "a publisher may watch");
        assert!(!is_good(key, Grant::Publish, "attic", &watch, 999), "a viewer may not publish");
        assert!(!is_good(key, Grant::Watch, "attic", &watch, 1000), "too late");
        assert!(!is_good(key, Grant::Watch, "cellar", &watch, 999) && !is_good(b"another", Grant::Watch, "attic", &watch, 999));
        let later = watch.replace("1000-", "2000-");
        for wrong in ["", "-", "1000", "1000-", "x-y", &watch[..watch.len() - 1], &later] {
            assert!(!is_good(key, Grant::Watch, "attic", wrong, 999), "{wrong}");
        }
    }

    #[test]
    fn tokens_come_as_bearers_or_as_websocket_protocols() {
        let of =
            |name, value| token_in_headers(&[(name, axum::http::HeaderValue::from_static(value))].into_iter().collect()).map(str::to_owned);
        assert_eq!(of(header::AUTHORIZATION, "Bearer 1000-ab").as_deref(), Some("1000-ab"));
        assert_eq!(of(header::AUTHORIZATION, "Basic 1000-ab"), None);
        assert_eq!(of(header::SEC_WEBSOCKET_PROTOCOL, "tmpi.live.v1, token.1000-ab").as_deref(), Some("1000-ab"));
        assert_eq!(of(header::SEC_WEBSOCKET_PROTOCOL, "tmpi.live.v1"), None);
    }
}
