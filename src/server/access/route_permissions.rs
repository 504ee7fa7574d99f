//! The table of rights that each route needs with private access. A route that is not in it answers 404.

use axum::http::Method;

use crate::server::problem::Problem;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Permission {
    /// Nothing: pages, their files, health.
    Nothing,
    /// A photo that the caller may see.
    Read,
    /// The caller's own photo, or one whose token it has.
    Change,
    /// The caller's own photo.
    Own,
    /// The right to upload, and to be told of one's photos.
    Upload,
    /// The right to list the caller's photos.
    List,
    Metrics,
    Admin,
    /// A room, which checks its own tokens.
    Room,
}

use Permission::{Admin, Change, List, Metrics, Nothing, Own, Read, Room, Upload};

const TABLE: &[(&str, &str, Permission)] = &[
    ("GET", "/", Nothing),
    ("GET", "/demo", Nothing),
    // the page reports a missing photo itself, but its preview card needs read access
    ("GET", "/view/{id}", Read),
    ("GET", "/embed/{id}", Read),
    ("GET", "/live/{room}", Nothing),
    ("GET", "/live/{room}/publish", Nothing),
    ("GET", "/static/{*name}", Nothing),
    ("GET", "/tmpi-viewer.js", Nothing),
    ("GET", "/healthz", Nothing),
    ("GET", "/readyz", Nothing),
    ("GET", "/openapi.json", Nothing),
    ("GET", "/metrics", Metrics),
    ("GET", "/v1/network", Admin),
    ("POST", "/v1/network", Admin),
    ("GET", "/v1/presets", Nothing),
    ("POST", "/v1/owner", Nothing),
    // the handler refuses callers that are no owner
    ("POST", "/v1/owner/ticket", Nothing),
    ("GET", "/v1/photos", List),
    ("POST", "/v1/photos", Upload),
    ("GET", "/v1/photos/{id}", Read),
    ("PATCH", "/v1/photos/{id}", Change),
    ("DELETE", "/v1/photos/{id}", Change),
    ("POST", "/v1/photos/{id}/remake", Change),
    ("POST", "/v1/photos/{id}/links", Change),
    ("POST", "/v1/photos/{id}/manage", Change),
    // a token does not entitle its holder to revoke it for others
    ("DELETE", "/v1/photos/{id}/manage", Own),
    ("GET", "/v1/photos/{id}/strokes", Read),
    ("PATCH", "/v1/photos/{id}/strokes", Change),
    ("GET", "/v1/photos/{id}/events", Read),
    ("GET", "/v1/photos/{id}/depth", Read),
    ("GET", "/v1/photos/{id}/settings", Read),
    ("GET", "/v1/photos/{id}/atlas", Read),
    ("GET", "/v1/photos/{id}/report", Read),
    ("GET", "/v1/photos/{id}/thumbnail", Read),
    ("GET", "/v1/photos/{id}/view", Read),
    ("GET", "/v1/photos/{id}/export", Read),
    ("POST", "/v1/photos/{id}/exports", Read),
    ("GET", "/v1/photos/{id}/exports/{key}", Read),
    ("GET", "/v1/photos/{id}/exports/{key}/file", Read),
    // all readers of the photo share the file
    ("DELETE", "/v1/photos/{id}/exports/{key}", Change),
    ("GET", "/oembed", Read),
    // the handlers refuse callers that are no owner, and hide the webhooks of others
    ("GET", "/v1/webhooks", Upload),
    ("POST", "/v1/webhooks", Upload),
    ("GET", "/v1/webhooks/{id}", Upload),
    ("PATCH", "/v1/webhooks/{id}", Upload),
    ("DELETE", "/v1/webhooks/{id}", Upload),
    ("POST", "/v1/webhooks/{id}/test", Upload),
    ("GET", "/v1/webhooks/{id}/deliveries", Upload),
    ("POST", "/v1/live/{room}/token", Room),
];

/// What a route needs, by method and path template; `None` for an unknown route.
pub fn permission(method: &str, path: &str) -> Option<Permission> {
    let method = if method == "HEAD" { "GET" } else { method };
    if method == "GET" && (path.starts_with("/v1/live/{room}/") || path == "/v1/live/{room}") {
        return Some(Room);
    }
    TABLE.iter().find(|(m, p, _)| (*m, *p) == (method, path)).map(|(_, _, permission)| *permission)
}

/// 405 for a known route without this method, 404 for an unknown route.
pub fn refusal(method: &Method, path: &str) -> Problem {
    let all = ["GET", "HEAD", "POST", "PATCH", "DELETE"];
    let allow: Vec<&str> = all.into_iter().filter(|method| permission(method, path).is_some()).collect();
    if allow.is_empty() {
        Problem::not_found("there is nothing at this address")
    } else {
        Problem::no_method(method, Some(&allow.join(",")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::routes;

    #[test]
    fn every_route_has_a_permission_and_every_permission_a_route() {
        let all = routes::routes();
        for route in &all {
            for method in &route.methods {
                assert!(permission(method.as_str(), &route.path).is_some(), "{method} {}: add it to TABLE", route.path);
            }
        }
        for (method, path, _) in TABLE {
            assert!(all.iter().any(|r| r.path == *path && r.methods.iter().any(|m| m == method)), "{method} {path} is no route");
        }
        assert_eq!(permission("PUT", "/v1/photos/{id}"), None);
        let refused = refusal(&Method::PUT, "/v1/photos/{id}");
        assert_eq!((refused.status, refused.header.unwrap().1.to_str().unwrap()), (405, "GET,HEAD,PATCH,DELETE"));
        assert_eq!(refusal(&Method::POST, "/v1/live/{room}/subscribe").status, 405);
        assert_eq!(refusal(&Method::GET, "/v1/nothing").status, 404);
        assert_eq!(permission("HEAD", "/v1/photos/{id}"), Some(Read));
    }
}
