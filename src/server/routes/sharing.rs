//! Links to a photo: those to read expire, those to edit are valid until they are revoked.

use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::path_photo::PathPhoto;
use super::query::{EmptyBody, NoQuery, Pairs};
use crate::server::access;
use crate::server::app_state::App;
use crate::server::problem::Problem;

/// Default lifetime of a link in seconds.
const USUAL: u64 = 86_400;
/// Route that issues tickets.
const TICKET: &str = "/v1/owner/ticket";

/// Links to share a photo.
#[derive(Serialize, utoipa::ToSchema)]
pub struct PhotoLink {
    /// Page with the viewer.
    page: String,
    /// The container.
    atlas: String,
    /// Query to add to any address of this photo; missing with open access.
    #[serde(skip_serializing_if = "Option::is_none")]
    query: Option<String>,
    /// When the link expires, in seconds since 1970; missing with open access.
    #[serde(skip_serializing_if = "Option::is_none")]
    expires: Option<u64>,
    /// Page with the photo's token after its `#`: a secret. Anyone who has it can see and change this photo only. It does not expire, but
    /// the owner can revoke it. Missing with open access.
    #[serde(skip_serializing_if = "Option::is_none")]
    manage: Option<String>,
    /// Route that issues tickets for other browsers; missing if the caller has no owner's secret.
    #[serde(skip_serializing_if = "Option::is_none")]
    ticket: Option<String>,
}

/// Share a photo.
///
/// A caller with the link can read the photo and its results until the link expires, but not change them. Its parameters `expires` and
/// `signature` are valid for any address of this photo and are not part of cache keys. A caller with `manage` can do what the photo's owner
/// can, except revoke links. An application with a key that has the scope `sign` makes such links without this call.
#[utoipa::path(
    post, path = "/v1/photos/{id}/links", tag = "photos",
    params(("seconds" = Option<u64>, Query, minimum = 1, maximum = 31_622_400, description = "Lifetime, 1 to 31622400; a day if it is not given. With open access links do not expire, and the parameter is an error")),
    responses(
        (status = 200, description = "The link", body = PhotoLink),
        (status = 400, description = "A parameter is wrong, or there is a body"),
    )
)]
pub async fn links(State(app): State<App>, PathPhoto(photo): PathPhoto, uri: Uri, _: EmptyBody) -> Result<Json<PhotoLink>, Problem> {
    let pairs = Pairs::read(&uri, &["seconds"])?;
    let most = app.limits.link.as_secs();
    let given = pairs.number("seconds", &(1..=most))?;
    if given.is_some() && app.guard.is_none() {
        let detail = "links do not expire on this server, which shows every photo to everyone (--access open); leave the parameter out";
        return Err(Problem::parameter("seconds", detail));
    }
    let seconds = given.unwrap_or(USUAL.min(most));
    let now = app.library.now().await?.max(0) as u64 / 1000;
    let expires = app.guard.as_ref().map(|_| now + seconds);
    let query = app.guard.as_ref().zip(expires).map(|(guard, expires)| guard.query(&photo, expires));
    let address = |path: String| app.base.at(&path) + &query.as_ref().map(|query| format!("?{query}")).unwrap_or_default();
    let manage = app.guard.as_ref().map(|guard| guard.manage_link(&photo));
    Ok(Json(PhotoLink {
        page: address(format!("/view/{}", photo.id)),
        atlas: address(format!("/v1/photos/{}/atlas", photo.id)),
        query,
        expires,
        manage,
        ticket: app.guard.as_ref().and_then(|_| access::owner_by_secret()).map(|_| app.base.at(TICKET)),
    }))
}

/// Store a photo's token in a cookie.
///
/// Send the token as a bearer; the answer sets it as a cookie for this photo's addresses only, which scripts cannot read. Pages call this
/// for links with `#manage=`.
#[utoipa::path(
    post, path = "/v1/photos/{id}/manage", tag = "photos",
    responses(
        (status = 204, description = "The cookie is set, if the caller sent a token and access is private"),
        (status = 401, description = "The token is malformed"),
        (status = 404, description = "There is no such photo, or the token is not its own, or is revoked"),
    )
)]
pub async fn keep_token(
    State(app): State<App>,
    _: NoQuery,
    PathPhoto(photo): PathPhoto,
    headers: HeaderMap,
    _: EmptyBody,
) -> Result<Response, Problem> {
    let mut response = StatusCode::NO_CONTENT.into_response();
    if let Some(guard) = &app.guard {
        guard.set_manage(&mut response, &headers, photo.id);
    }
    Ok(response)
}

/// Revoke all links to a photo.
///
/// The photo's token, also in cookies, and its unexpired links become invalid; you can make new ones. Links that an application signed stay
/// valid as long as its key. Only for its owner.
#[utoipa::path(
    delete, path = "/v1/photos/{id}/manage", tag = "photos",
    responses(
        (status = 204, description = "All links are revoked"),
        (status = 412, description = "The photo changed meanwhile"),
    )
)]
pub async fn revoke_links(State(app): State<App>, _: NoQuery, PathPhoto(photo): PathPhoto) -> Result<StatusCode, Problem> {
    app.library.revoke_links(photo.id).await?;
    Ok(StatusCode::NO_CONTENT)
}
