//! Webhooks of an owner. An administrator's webhooks receive the events of all photos and rooms.

use axum::Json;
use axum::extract::{Path, Request, State};
use axum::http::header::{CACHE_CONTROL, LOCATION};
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde_json::{Map, Value};

use super::photos::merge_patch;
use super::query::{EmptyBody, NoQuery, Pairs};
use super::webhook_state::{DeliveryList, DeliveryRecord, WebhookList, WebhookOrder, WebhookPatch, WebhookState, WebhookTest};
use crate::server::access::Guard;
use crate::server::app_state::{App, AppState};
use crate::server::conditional::insert;
use crate::server::problem::Problem;
use crate::server::webhooks::{SigningSecret, event_types};
use crate::server::{outbound, request_body};
use tmpi_library::{EventType, LibraryError, NewWebhook, Owner, Webhook, WebhookChange};

/// Most bytes of a webhook's fields.
const MOST: usize = 16 << 10;
/// Deliveries on a page, if the client does not say, and at most.
const USUAL_PAGE: usize = 50;
const MAX_PAGE: usize = 200;

/// Whose webhooks a caller manages; `None` for those of all owners and for all photos.
struct Whose(Option<Owner>);

impl Whose {
    /// The caller's.
    ///
    /// # Errors
    /// 403 if the caller is no owner, or with open access not this machine's own user.
    fn of(app: &AppState, headers: &HeaderMap) -> Result<Self, Problem> {
        let refused = |kind, detail| Err(Problem::new(StatusCode::FORBIDDEN, kind, detail));
        match (&app.guard, Guard::owner()) {
            (None, _) if app.hosts.is_own(headers) => Ok(Self(None)),
            (None, _) => refused("not-yours", "only this machine's own user can manage webhooks, at a loopback address"),
            (Some(_), _) if Guard::is_admin() => Ok(Self(None)),
            (Some(_), Some(owner)) => Ok(Self(Some(owner))),
            (Some(_), None) => refused("no-owner", "only a caller with a key or an owner's secret has webhooks"),
        }
    }

    /// A webhook that the caller manages.
    ///
    /// # Errors
    /// 404.
    async fn find(&self, app: &AppState, id: &str) -> Result<Webhook, Problem> {
        let none = || Problem::not_found(format!("there is no webhook {id:?}"));
        let webhook = app.library.webhook(id).await.map_err(|error| match error {
            LibraryError::NotFound(_) => none(),
            error => error.into(),
        })?;
        if self.0.is_none() || webhook.owner == self.0 { Ok(webhook) } else { Err(none()) }
    }
}

/// The fields of a body, each one of `names`.
async fn fields(request: Request, names: &[&str]) -> Result<Map<String, Value>, Problem> {
    let (_, body) = merge_patch(request, MOST, "webhooks").await?;
    let fields = request_body::json_object(&body)?;
    match fields.keys().find(|name| !names.contains(&name.as_str())) {
        Some(name) => Err(Problem::parameter(name, format!("there is no such field; there are {}", names.join(", ")))),
        None => Ok(fields),
    }
}

/// Where events go, if a field says so.
fn url(app: &AppState, fields: &Map<String, Value>) -> Result<Option<String>, Problem> {
    let Some(value) = fields.get("url") else { return Ok(None) };
    let text = value.as_str().ok_or_else(|| Problem::parameter("url", "must be text"))?;
    outbound::url(text, app.webhook_addresses).map_err(|error| Problem::parameter("url", error))?;
    Ok(Some(text.to_owned()))
}

/// The events, if a field names them.
fn asked(fields: &Map<String, Value>) -> Result<Option<Vec<EventType>>, Problem> {
    let Some(value) = fields.get("events") else { return Ok(None) };
    let names: Option<Vec<&str>> = value.as_array().and_then(|all| all.iter().map(Value::as_str).collect());
    let names = names.ok_or_else(|| Problem::parameter("events", "must be a list of event names"))?;
    event_types(&names).map(Some).map_err(|error| Problem::parameter("events", error))
}

/// Add a webhook.
///
/// The server tells its address of events by requests that follow the Standard Webhooks specification. It is told of its owner's photos; an
/// administrator's, of all photos and rooms. Save the secret: no other answer has it.
#[utoipa::path(
    post, path = "/v1/webhooks", tag = "webhooks", operation_id = "webhook_add",
    request_body(content((WebhookOrder = "application/json"))),
    responses(
        (status = 201, description = "The webhook with its secret", body = WebhookState,
            headers(("Location" = String, description = "Address of the webhook"))),
        (status = 400, description = "A field is wrong; `field` names it"),
        (status = 403, description = "The caller is no owner, or has 16 webhooks"),
        (status = 413, description = "The body is too large"),
        (status = 415, description = "Not JSON"),
    )
)]
pub async fn add(State(app): State<App>, _: NoQuery, headers: HeaderMap, request: Request) -> Result<Response, Problem> {
    let whose = Whose::of(&app, &headers)?;
    let fields = fields(request, &["url", "events", "secret"]).await?;
    let url = url(&app, &fields)?.ok_or_else(|| Problem::parameter("url", "is missing"))?;
    let events = asked(&fields)?.unwrap_or_else(|| EventType::ALL.to_vec());
    let secret = match fields.get("secret") {
        None => SigningSecret::new_text()?,
        Some(value) => {
            let text = value.as_str().unwrap_or_default();
            SigningSecret::parse(text).map_err(|error| Problem::parameter("secret", error))?;
            text.to_owned()
        }
    };
    let webhook = app.library.add_webhook(whose.0.as_ref(), &NewWebhook { url, secret, events }).await?;
    let secret = Some(webhook.secret.clone());
    let mut state = WebhookState::from(webhook);
    state.secret = secret;
    let location = app.base.at(&format!("/v1/webhooks/{}", state.id));
    let mut response = (StatusCode::CREATED, Json(state)).into_response();
    insert(&mut response, LOCATION, &location);
    insert(&mut response, CACHE_CONTROL, "private, no-store");
    Ok(response)
}

/// An answer that depends on the caller.
fn own(body: impl Serialize) -> Response {
    let mut response = Json(body).into_response();
    insert(&mut response, CACHE_CONTROL, "private, no-store");
    response
}

/// List webhooks.
///
/// One's own; an administrator sees all.
#[utoipa::path(
    get, path = "/v1/webhooks", tag = "webhooks", operation_id = "webhook_list",
    responses(
        (status = 200, description = "The webhooks, without their secrets", body = WebhookList),
    )
)]
pub async fn list(State(app): State<App>, _: NoQuery, headers: HeaderMap) -> Result<Response, Problem> {
    let whose = Whose::of(&app, &headers)?;
    let webhooks = app.library.webhooks(whose.0.as_ref()).await?;
    Ok(own(WebhookList { webhooks: webhooks.into_iter().map(WebhookState::from).collect() }))
}

/// A webhook.
#[utoipa::path(
    get, path = "/v1/webhooks/{id}", tag = "webhooks", operation_id = "webhook_state",
    responses(
        (status = 200, description = "The webhook, without its secret", body = WebhookState),
    )
)]
pub async fn state(State(app): State<App>, Path(id): Path<String>, _: NoQuery, headers: HeaderMap) -> Result<Response, Problem> {
    let webhook = Whose::of(&app, &headers)?.find(&app, &id).await?;
    Ok(own(WebhookState::from(webhook)))
}

/// 409 if the configuration says how a webhook is.
fn changeable(webhook: &Webhook) -> Result<(), Problem> {
    if !webhook.configured {
        return Ok(());
    }
    Err(Problem::new(StatusCode::CONFLICT, "configured", "the webhook is from the server's configuration: change it there"))
}

/// Change a webhook, or enable it again.
#[utoipa::path(
    patch, path = "/v1/webhooks/{id}", tag = "webhooks", operation_id = "webhook_change",
    request_body(content((WebhookPatch = "application/merge-patch+json"), (WebhookPatch = "application/json"))),
    responses(
        (status = 200, description = "The webhook, without its secret", body = WebhookState),
        (status = 400, description = "A field is wrong; `field` names it"),
        (status = 409, description = "It is from the server's configuration"),
        (status = 413, description = "The body is too large"),
        (status = 415, description = "Not JSON"),
    )
)]
pub async fn change(
    State(app): State<App>,
    Path(id): Path<String>,
    _: NoQuery,
    headers: HeaderMap,
    request: Request,
) -> Result<Response, Problem> {
    let webhook = Whose::of(&app, &headers)?.find(&app, &id).await?;
    let fields = fields(request, &["url", "events", "enabled"]).await?;
    let enabled = match fields.get("enabled") {
        None => None,
        Some(value) => Some(value.as_bool().ok_or_else(|| Problem::parameter("enabled", "must be true or false"))?),
    };
    let change = WebhookChange { url: url(&app, &fields)?, events: asked(&fields)?, enabled };
    if change.url.is_some() || change.events.is_some() {
        changeable(&webhook)?;
    }
    Ok(own(WebhookState::from(app.library.change_webhook(&id, &change).await?)))
}

/// Delete a webhook, with its deliveries.
#[utoipa::path(
    delete, path = "/v1/webhooks/{id}", tag = "webhooks", operation_id = "webhook_delete",
    responses(
        (status = 204, description = "Deleted"),
        (status = 409, description = "It is from the server's configuration"),
    )
)]
pub async fn delete(State(app): State<App>, Path(id): Path<String>, _: NoQuery, headers: HeaderMap) -> Result<StatusCode, Problem> {
    changeable(&Whose::of(&app, &headers)?.find(&app, &id).await?)?;
    app.library.remove_webhook(&id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Send a `ping` event to a webhook.
#[utoipa::path(
    post, path = "/v1/webhooks/{id}/test", tag = "webhooks", operation_id = "webhook_test",
    responses(
        (status = 202, description = "It is on its way; the list of deliveries tells what becomes of it", body = WebhookTest),
        (status = 409, description = "It is disabled"),
    )
)]
pub async fn test(
    State(app): State<App>,
    Path(id): Path<String>,
    _: NoQuery,
    headers: HeaderMap,
    _: EmptyBody,
) -> Result<Response, Problem> {
    Whose::of(&app, &headers)?.find(&app, &id).await?;
    let delivery = app.library.ping(&id).await.map_err(|error| match error {
        LibraryError::Invalid(detail) => Problem::new(StatusCode::CONFLICT, "disabled", detail),
        error => error.into(),
    })?;
    Ok((StatusCode::ACCEPTED, own(WebhookTest { delivery })).into_response())
}

/// Deliveries of a webhook, newest first.
///
/// The server keeps those of 7 days, and at most 1000 besides those that are pending.
#[utoipa::path(
    get, path = "/v1/webhooks/{id}/deliveries", tag = "webhooks", operation_id = "webhook_deliveries",
    params(
        ("limit" = Option<usize>, Query, minimum = 1, maximum = 200, description = "Deliveries on this page, at most 200; 50 if it is not given"),
        ("after" = Option<String>, Query, description = "Id of the last delivery of the page before"),
    ),
    responses(
        (status = 200, description = "A page of the list", body = DeliveryList),
        (status = 400, description = "A parameter is wrong"),
    )
)]
pub async fn deliveries(State(app): State<App>, Path(id): Path<String>, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    Whose::of(&app, &headers)?.find(&app, &id).await?;
    let pairs = Pairs::read(&uri, &["limit", "after"])?;
    let limit = pairs.number("limit", &(1..=MAX_PAGE))?.unwrap_or(USUAL_PAGE);
    let page = app.library.deliveries(&id, pairs.get("after"), limit).await?;
    Ok(own(DeliveryList {
        next: page.next.map(|next| app.base.at(&format!("/v1/webhooks/{id}/deliveries?limit={limit}&after={next}"))),
        deliveries: page.deliveries.into_iter().map(|delivery| DeliveryRecord::of(&app, delivery)).collect(),
    }))
}
