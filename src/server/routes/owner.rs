//! Links by which others may read a photo for a while, and a browser's own secret.

use axum::Json;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::query::{NoQuery, Pairs};
use crate::server::access;
use crate::server::app::App;
use crate::server::problem::Problem;

/// Seconds that a link is good for where nothing is said.
const USUAL: u64 = 86_400;

/// A way to a photo for somebody else.
#[derive(Serialize, utoipa::ToSchema)]
pub struct PhotoLink {
    /// Page with the viewer.
    page: String,
    /// The container.
    atlas: String,
    /// What to put into the query of any address below the photo's; missing where the server asks nobody who they are.
    #[serde(skip_serializing_if = "Option::is_none")]
    query: Option<String>,
    /// When it ends, in seconds since 1970.
    #[serde(skip_serializing_if = "Option::is_none")]
    expires: Option<u64>,
    /// Page by which another browser owns what this one owns: a secret. Only for whoever came with it.
    #[serde(skip_serializing_if = "Option::is_none")]
    manage: Option<String>,
}

/// Let others read a photo for a while.
///
/// Whoever has the link can read the photo and what is made of it until it ends, and change nothing. It goes for any address of this one photo:
/// its parameters `expires` and `signature` name no version and no view, and are no part of what is kept of an answer.
#[utoipa::path(
    post, path = "/v1/photos/{id}/links", tag = "photos",
    params(
        ("id" = String, Path, description = "Id of the photo"),
        ("seconds" = Option<u64>, Query, minimum = 1, maximum = 31_622_400, description = "How long it is good, 1 to 31622400; a day if it is not given"),
    ),
    responses(
        (status = 200, description = "The link", body = PhotoLink),
        (status = 400, description = "A parameter is wrong"),
        (status = 404, description = "There is no such photo"),
    )
)]
pub async fn links(State(app): State<App>, Path(id): Path<String>, uri: Uri) -> Result<Json<PhotoLink>, Problem> {
    let photo = app.photo(&id)?.id;
    let pairs = Pairs::read(&uri, &["seconds"])?;
    let most = app.limits.link.as_secs();
    let wrong = |text: &str| Problem::parameter("seconds", format!("must be from 1 to {most}, not {text:?}"));
    let read = |text: &str| text.parse().ok().filter(|n| (1..=most).contains(n)).ok_or_else(|| wrong(text));
    let seconds = pairs.get("seconds").map_or(Ok(USUAL.min(most)), read)?;
    let expires = app.guard.as_ref().map(|_| access::now() + seconds);
    let query = app.guard.as_ref().zip(expires).map(|(guard, expires)| guard.query(photo, expires));
    let address = |path: String| query.as_ref().map_or(path.clone(), |query| format!("{path}?{query}"));
    let manage = access::secret().map(|secret| format!("/view/{photo}#owner={secret}"));
    Ok(Json(PhotoLink {
        page: address(format!("/view/{photo}")),
        atlas: address(format!("/v1/photos/{photo}/atlas")),
        query,
        expires,
        manage,
    }))
}

/// Have a browser keep an owner's secret.
///
/// Sent as a bearer, it comes back as a cookie that no script reads. Pages call this for links with `#owner=`.
#[utoipa::path(
    post, path = "/v1/owner", tag = "system",
    responses(
        (status = 204, description = "Kept, where the server asks who comes"),
        (status = 400, description = "There are no parameters here"),
        (status = 401, description = "The secret is none"),
    )
)]
pub async fn keep(_: NoQuery, headers: HeaderMap) -> Response {
    let mut response = StatusCode::NO_CONTENT.into_response();
    if let Some(secret) = access::secret() {
        access::set_owner(&mut response, &headers, &secret);
    }
    response
}
