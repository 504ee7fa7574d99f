//! The owner's secret in a browser's cookie, and tickets that make another browser the same owner.

use axum::Json;
use axum::extract::State;
use axum::http::header::CACHE_CONTROL;
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::query::{EmptyBody, NoQuery, Pairs};
use crate::server::access;
use crate::server::app_state::App;
use crate::server::conditional::insert;
use crate::server::problem::Problem;

/// A ticket that makes another browser the same owner.
#[derive(Serialize, utoipa::ToSchema)]
pub struct Ticket {
    /// A secret to append to a photo's page after `#owner=`. It does not reveal the owner's own secret.
    ticket: String,
    /// When it expires, in seconds since 1970.
    expires: u64,
}

/// Make another browser the same owner.
///
/// A browser that opens a photo's page with the ticket after `#owner=` within 15 minutes, and whose user confirms, becomes this owner. You
/// cannot revoke its cookie.
#[utoipa::path(
    post, path = "/v1/owner/ticket", tag = "system",
    responses(
        (status = 200, description = "The ticket", body = Ticket),
        (status = 403, description = "The caller has no owner's secret"),
    )
)]
pub async fn ticket(State(app): State<App>, _: NoQuery, _: EmptyBody) -> Result<Response, Problem> {
    let Some((guard, owner)) = app.guard.as_ref().zip(access::owner_by_secret()) else {
        let detail = "only a caller with an owner's secret can make another browser that owner";
        return Err(Problem::new(StatusCode::FORBIDDEN, "no-owner", detail));
    };
    let (ticket, expires) = guard.ticket(&owner).await?;
    let mut response = Json(Ticket { ticket, expires }).into_response();
    insert(&mut response, CACHE_CONTROL, "private, no-store");
    Ok(response)
}

/// Store an owner's secret in a cookie.
///
/// Send the secret or a ticket as a bearer; the answer sets a cookie that scripts cannot read: the secret, or a session in exchange for the
/// ticket. Pages call this for links with `#owner=` once the user confirms: this owner then owns what the browser uploads.
#[utoipa::path(
    post, path = "/v1/owner", tag = "system",
    params(("replace" = Option<bool>, Query, description = "Whether to replace the cookie of another owner; else `false`")),
    responses(
        (status = 204, description = "The cookie is set, if access is private"),
        (status = 400, description = "A parameter is wrong, or there is a body"),
        (status = 401, description = "The secret is malformed, or the ticket has expired"),
        (status = 409, description = "The browser has another owner's cookie; without it, it loses access to that owner's photos"),
    )
)]
pub async fn adopt_owner(State(app): State<App>, uri: Uri, headers: HeaderMap, _: EmptyBody) -> Result<Response, Problem> {
    let replace = Pairs::read(&uri, &["replace"])?.parse("replace", "true or false", |text| text.parse().ok())?.unwrap_or(false);
    let mut response = StatusCode::NO_CONTENT.into_response();
    if let Some(guard) = &app.guard
        && let Some((owner, kept)) = guard.named_owner().await?
    {
        if !replace && guard.is_another(&headers, &owner).await? {
            let detail = "the browser has another owner's secret, which would be lost; replace=true overwrites it";
            return Err(Problem::new(StatusCode::CONFLICT, "another-owner", detail).field("replace"));
        }
        guard.set_owner(&mut response, &headers, &kept);
    }
    Ok(response)
}
