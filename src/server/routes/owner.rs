//! Links by which others may read a photo for a while, or change it until its owner takes that back, and a browser's own secret.

use axum::Json;
use axum::extract::{Path, State};
use axum::http::header::CACHE_CONTROL;
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::query::{NoBody, NoQuery, Pairs};
use crate::server::access;
use crate::server::app::App;
use crate::server::conditional::insert;
use crate::server::problem::Problem;

/// Seconds that a link is good for where nothing is said.
const USUAL: u64 = 86_400;
/// Where tickets are made.
const TICKET: &str = "/v1/owner/ticket";

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
    /// Page by which somebody else may see and change this photo, and no other, with the photo's token behind its `#`: a secret. It has no end, but
    /// can be taken back; missing where the server asks nobody who they are.
    #[serde(skip_serializing_if = "Option::is_none")]
    manage: Option<String>,
    /// Where whoever asks can let another browser be the same owner; missing where they have no secret of their own to pass on.
    #[serde(skip_serializing_if = "Option::is_none")]
    ticket: Option<&'static str>,
}

/// Let others read a photo for a while, or change it.
///
/// Whoever has the link can read the photo and what is made of it until it ends, and change nothing. It goes for any address of this one photo:
/// its parameters `expires` and `signature` name no version and no view, and are no part of what is kept of an answer. Whoever has `manage` can
/// do with this photo what its owner can, but for taking links back.
#[utoipa::path(
    post, path = "/v1/photos/{id}/links", tag = "photos",
    params(
        ("id" = String, Path, description = "Id of the photo"),
        ("seconds" = Option<u64>, Query, minimum = 1, maximum = 31_622_400, description = "How long it is good, 1 to 31622400; a day if it is not given. Where the server asks nobody who they are, links do not end, and this is refused"),
    ),
    responses(
        (status = 200, description = "The link", body = PhotoLink),
        (status = 400, description = "A parameter is wrong, or there is a body"),
        (status = 404, description = "There is no such photo"),
    )
)]
pub async fn links(State(app): State<App>, Path(id): Path<String>, uri: Uri, _: NoBody) -> Result<Json<PhotoLink>, Problem> {
    let photo = app.photo(&id).await?;
    let pairs = Pairs::read(&uri, &["seconds"])?;
    let most = app.limits.link.as_secs();
    let wrong = |text: &str| Problem::parameter("seconds", format!("must be from 1 to {most}, not {text:?}"));
    let read = |text: &str| text.parse().ok().filter(|n| (1..=most).contains(n)).ok_or_else(|| wrong(text));
    let given = pairs.get("seconds").map(read).transpose()?;
    if given.is_some() && app.guard.is_none() {
        let detail = "this server lets everybody see every photo (--access open): links do not end here, so leave it out";
        return Err(Problem::parameter("seconds", detail));
    }
    let seconds = given.unwrap_or(USUAL.min(most));
    let now = app.library.now().await?.max(0) as u64 / 1000;
    let expires = app.guard.as_ref().map(|_| now + seconds);
    let query = app.guard.as_ref().zip(expires).map(|(guard, expires)| guard.query(&photo, expires));
    let address = |path: String| query.as_ref().map_or(path.clone(), |query| format!("{path}?{query}"));
    let manage = app.guard.as_ref().map(|guard| guard.manage_link(&photo));
    Ok(Json(PhotoLink {
        page: address(format!("/view/{}", photo.id)),
        atlas: address(format!("/v1/photos/{}/atlas", photo.id)),
        query,
        expires,
        manage,
        ticket: app.guard.as_ref().and_then(|_| access::owner_by_secret()).map(|_| TICKET),
    }))
}

/// Have a browser keep a photo's token.
///
/// Sent as a bearer, it comes back as a cookie for this photo's addresses alone, which no script reads. Pages call this for links with `#manage=`.
#[utoipa::path(
    post, path = "/v1/photos/{id}/manage", tag = "photos",
    params(("id" = String, Path, description = "Id of the photo")),
    responses(
        (status = 204, description = "Kept, where a token came and the server asks who comes"),
        (status = 400, description = "There are neither parameters nor a body here"),
        (status = 401, description = "The token is none"),
        (status = 404, description = "There is no such photo, or the token is not its own, or was taken back"),
    )
)]
pub async fn keep_token(
    State(app): State<App>,
    Path(id): Path<String>,
    _: NoQuery,
    headers: HeaderMap,
    _: NoBody,
) -> Result<Response, Problem> {
    let photo = app.photo(&id).await?.id;
    let mut response = StatusCode::NO_CONTENT.into_response();
    if let Some(token) = access::token() {
        access::set_manage(&mut response, &headers, photo, &token);
    }
    Ok(response)
}

/// Take back all links to a photo.
///
/// Its token, also where browsers keep it, and links that would still be good are so no longer; new ones can be made. Only for its owner.
#[utoipa::path(
    delete, path = "/v1/photos/{id}/manage", tag = "photos",
    params(("id" = String, Path, description = "Id of the photo")),
    responses(
        (status = 204, description = "They are taken back"),
        (status = 400, description = "There are no parameters here"),
        (status = 404, description = "There is no such photo"),
        (status = 412, description = "It was changed meanwhile"),
    )
)]
pub async fn take_back(State(app): State<App>, Path(id): Path<String>, _: NoQuery) -> Result<StatusCode, Problem> {
    let photo = app.photo(&id).await?;
    app.library.revoke_links(photo.id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// What makes another browser the same owner.
#[derive(Serialize, utoipa::ToSchema)]
pub struct Ticket {
    /// A secret: it goes behind `#owner=` of any photo's page. It does not tell the owner's own.
    ticket: String,
    /// When it ends, in seconds since 1970.
    expires: u64,
}

/// Let another browser be the same owner.
///
/// Whoever opens a photo's page with the ticket behind `#owner=` within a quarter of an hour, and says so there, owns what this owner does. What their
/// browser keeps cannot be taken back.
#[utoipa::path(
    post, path = "/v1/owner/ticket", tag = "system",
    responses(
        (status = 200, description = "The ticket", body = Ticket),
        (status = 400, description = "There are neither parameters nor a body here"),
        (status = 403, description = "Only for whoever has an owner's secret"),
    )
)]
pub async fn ticket(State(app): State<App>, _: NoQuery, _: NoBody) -> Result<Response, Problem> {
    let Some((guard, owner)) = app.guard.as_ref().zip(access::owner_by_secret()) else {
        let detail = "only whoever has an owner's secret can let another browser be that owner";
        return Err(Problem::new(StatusCode::FORBIDDEN, "no-owner", detail));
    };
    let expires = app.library.now().await?.max(0) as u64 / 1000 + access::TICKET.as_secs();
    let mut response = Json(Ticket { ticket: guard.ticket(&owner).await?, expires }).into_response();
    insert(&mut response, CACHE_CONTROL, "private, no-store");
    Ok(response)
}

/// Have a browser keep an owner's secret.
///
/// Sent as a bearer, it comes back as a cookie that no script reads; a ticket is exchanged for one that says the same. Pages call this for links with
/// `#owner=`, once somebody has said so: what the browser uploads from then on belongs to whoever has the secret.
#[utoipa::path(
    post, path = "/v1/owner", tag = "system",
    params(("replace" = Option<bool>, Query, description = "Whether the secret of another owner goes, which the browser keeps; else `false`")),
    responses(
        (status = 204, description = "Kept, where the server asks who comes"),
        (status = 400, description = "A parameter is wrong, or there is a body"),
        (status = 401, description = "The secret is none, or the ticket's time is over"),
        (status = 409, description = "The browser is another owner: without that secret its photos are lost to it"),
    )
)]
pub async fn keep(State(app): State<App>, uri: Uri, headers: HeaderMap, _: NoBody) -> Result<Response, Problem> {
    let replace = match Pairs::read(&uri, &["replace"])?.get("replace") {
        None | Some("false") => false,
        Some("true") => true,
        Some(other) => return Err(Problem::parameter("replace", format!("must be true or false, not {other:?}"))),
    };
    let mut response = StatusCode::NO_CONTENT.into_response();
    if let Some(guard) = &app.guard
        && let Some(owner) = access::to_be()
    {
        if !replace && guard.is_another(&headers, &owner).await? {
            let detail = "the browser keeps the secret of another owner, which would be lost; replace=true does it all the same";
            return Err(Problem::new(StatusCode::CONFLICT, "another-owner", detail).field("replace"));
        }
        access::set_owner(&mut response, &headers, &guard.to_keep(&owner).await?);
    }
    Ok(response)
}
