//! Webhooks and their deliveries as JSON.

use serde::Serialize;
use serde_json::Value;

use crate::server::app_state::AppState;
use crate::server::timestamps::rfc3339;
use crate::server::webhooks::data;
use tmpi_library::{Delivery, DeliveryState, EventType, Webhook};

/// A webhook to add.
#[derive(utoipa::ToSchema)]
#[allow(dead_code, reason = "describes the body in the OpenAPI document; fields are read by hand so that errors name them")]
pub struct WebhookOrder {
    /// Where events go: `https://…` or `http://…`, at a public address.
    url: String,
    /// The events to tell; all if it is missing or empty.
    events: Option<Vec<String>>,
    /// The secret that signs requests, `whsec_` and the base64 of 24 to 64 bytes; else the server makes one.
    secret: Option<String>,
}

/// A change of a webhook; what is missing stays.
#[derive(utoipa::ToSchema)]
#[allow(dead_code, reason = "describes the body in the OpenAPI document; fields are read by hand so that errors name them")]
pub struct WebhookPatch {
    /// Where events go.
    url: Option<String>,
    /// The events to tell; all if it is empty.
    events: Option<Vec<String>>,
    /// Whether it gets events. Disabling it fails its pending deliveries.
    enabled: Option<bool>,
}

/// A webhook.
#[derive(Serialize, utoipa::ToSchema)]
pub struct WebhookState {
    /// Its id.
    pub id: String,
    /// Where events go.
    url: String,
    /// The events that it is told.
    events: Vec<&'static str>,
    /// Whether it gets events.
    enabled: bool,
    /// Why it does not.
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
    /// Since when every attempt has failed (RFC 3339, UTC).
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(format = DateTime)]
    failing_since: Option<String>,
    /// When it was added (RFC 3339, UTC).
    #[schema(format = DateTime)]
    created: String,
    /// Whether it is told of all photos and rooms, not only of one owner's photos.
    all: bool,
    /// Whether it is from the server's configuration, and can only be enabled and disabled here.
    configured: bool,
    /// The secret that signs requests: only in the answer that adds the webhook.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub secret: Option<String>,
}

impl From<Webhook> for WebhookState {
    fn from(webhook: Webhook) -> Self {
        Self {
            id: webhook.id,
            url: webhook.url,
            events: webhook.events.into_iter().map(EventType::name).collect(),
            enabled: webhook.disabled.is_none(),
            reason: webhook.disabled.map(|disabled| disabled.reason),
            failing_since: webhook.failing_since.map(rfc3339),
            created: rfc3339(webhook.created_at),
            all: webhook.owner.is_none(),
            configured: webhook.configured,
            secret: None,
        }
    }
}

/// The caller's webhooks.
#[derive(Serialize, utoipa::ToSchema)]
pub struct WebhookList {
    /// The webhooks, oldest first.
    pub webhooks: Vec<WebhookState>,
}

/// A delivery of an event to a webhook.
#[derive(Serialize, utoipa::ToSchema)]
pub struct DeliveryRecord {
    /// Its id, as in the header `webhook-id`.
    id: String,
    /// Type of the event.
    #[serde(rename = "type")]
    event: &'static str,
    /// What the event is about.
    #[schema(value_type = Object)]
    data: Value,
    /// `pending`, `delivered` or `failed`.
    state: &'static str,
    /// Attempts so far.
    attempts: i64,
    /// HTTP status of the last answer.
    #[serde(skip_serializing_if = "Option::is_none")]
    status: Option<u16>,
    /// Why the last attempt failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
    /// Milliseconds that the last attempt took.
    #[serde(skip_serializing_if = "Option::is_none")]
    took_ms: Option<i64>,
    /// When the event happened (RFC 3339, UTC).
    #[schema(format = DateTime)]
    created: String,
    /// When the next attempt is due (RFC 3339, UTC).
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(format = DateTime)]
    next: Option<String>,
    /// When it was delivered or given up (RFC 3339, UTC).
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(format = DateTime)]
    ended: Option<String>,
}

impl DeliveryRecord {
    /// As a caller sees it.
    pub fn of(app: &AppState, delivery: Delivery) -> Self {
        Self {
            event: delivery.event.name(),
            data: data(&delivery, &app.base, app.origin.get().map(String::as_str)),
            state: delivery.state.name(),
            attempts: delivery.attempts,
            status: delivery.status,
            error: delivery.error,
            took_ms: delivery.took_ms,
            created: rfc3339(delivery.created_at),
            next: (delivery.state == DeliveryState::Pending).then(|| rfc3339(delivery.run_after)),
            ended: delivery.ended_at.map(rfc3339),
            id: delivery.id,
        }
    }
}

/// A page of a webhook's deliveries.
#[derive(Serialize, utoipa::ToSchema)]
pub struct DeliveryList {
    /// The deliveries, newest first.
    pub deliveries: Vec<DeliveryRecord>,
    /// Address of the next page; missing on the last one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub next: Option<String>,
}

/// A test that was sent.
#[derive(Serialize, utoipa::ToSchema)]
pub struct WebhookTest {
    /// Id of the delivery.
    pub delivery: String,
}
