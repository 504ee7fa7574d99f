//! The task of a node that sends deliveries.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::http::{StatusCode, header};
use http_body_util::{BodyExt as _, Limited};
use reqwest::{Body, Response};
use tmpi_library::{Attempt, DeliveryState, DueDelivery, Event, LibraryError, Subscription, Verdict};
use tokio::task::JoinSet;

use super::payload::body;
use super::signature::SigningSecret;
use crate::server::app_state::App;
use crate::server::outbound::{self, AddressPolicy, Outbound, cause};

/// Attempts at a time of this node.
const AT_ONCE: usize = 8;
/// Time limit of an attempt.
const PATIENCE: Duration = Duration::from_secs(15);
/// Interval of looking for due attempts, if some are pending: those of other nodes become due without an event.
const LOOK: Duration = Duration::from_secs(1);
/// Most bytes to read of an answer, and how long, so that the connection can be used again.
const MAX_ANSWER: usize = 16 << 10;
const REST: Duration = Duration::from_secs(1);

pub struct Clients {
    /// Of callers.
    named: Outbound,
    /// Of the configuration.
    configured: Outbound,
}

impl Clients {
    /// Clients of which those for webhooks of callers are limited to `reach`.
    pub const fn new(reach: AddressPolicy) -> Self {
        Self { named: Outbound::new(reach), configured: Outbound::new(AddressPolicy::Any) }
    }

    async fn send(&self, due: &DueDelivery, seconds: u64, app: &App) -> Attempt {
        let begun = Instant::now();
        let sent = tokio::time::timeout(PATIENCE, self.post(due, seconds, app)).await;
        let sent = sent.unwrap_or_else(|_| Err(format!("no answer in {} s", PATIENCE.as_secs())));
        let took = begun.elapsed();
        match sent {
            Ok(answer) => {
                let attempt = judged(&answer, took);
                // the rest of one that is short
                let _ = tokio::time::timeout(REST, Limited::new(Body::from(answer), MAX_ANSWER).collect()).await;
                attempt
            }
            Err(error) => Attempt { verdict: Verdict::Refused(None), status: None, error: Some(error), took },
        }
    }

    async fn post(&self, due: &DueDelivery, seconds: u64, app: &App) -> Result<Response, String> {
        let (delivery, webhook) = (&due.delivery, &due.webhook);
        let outbound = if webhook.configured { &self.configured } else { &self.named };
        let url = outbound::url(&webhook.url, outbound.reach()).map_err(|error| format!("the address {error}"))?;
        let secret = SigningSecret::parse(&webhook.secret).map_err(|error| format!("the secret {error}"))?;
        let body = body(delivery, &app.base, app.origin.get().map(String::as_str));
        let request = outbound
            .client()
            .map_err(cause)?
            .post(url)
            .header(header::CONTENT_TYPE, "application/json")
            .header("webhook-id", &delivery.id)
            .header("webhook-timestamp", seconds)
            .header("webhook-signature", secret.sign(&delivery.id, seconds, &body));
        request.body(body).send().await.map_err(cause)
    }
}

/// What an answer means.
fn judged(answer: &Response, took: Duration) -> Attempt {
    let status = answer.status();
    let verdict = match status {
        _ if status.is_success() => Verdict::Delivered,
        StatusCode::GONE => Verdict::Gone,
        StatusCode::TOO_MANY_REQUESTS | StatusCode::SERVICE_UNAVAILABLE => Verdict::Refused(retry_after(answer)),
        _ => Verdict::Refused(None),
    };
    let error = (verdict != Verdict::Delivered).then(|| format!("the receiver answers {status}"));
    Attempt { verdict, status: Some(status.as_u16()), error, took }
}

/// Seconds of `Retry-After`; a date counts as none.
fn retry_after(answer: &Response) -> Option<Duration> {
    let seconds = answer.headers().get(header::RETRY_AFTER)?.to_str().ok()?.trim().parse().ok()?;
    Some(Duration::from_secs(seconds))
}

/// Sends deliveries until the server stops: those that are due at the start, those that events announce, and those to try again.
pub async fn deliver(app: App, clients: Arc<Clients>) {
    let mut events = app.library.subscribe();
    let mut sending = JoinSet::new();
    loop {
        let wait = begin(&app, &clients, &mut sending).await.unwrap_or_else(|error| {
            tracing::warn!(%error, "cannot look for deliveries to webhooks");
            Some(LOOK)
        });
        let due = async {
            match wait {
                Some(wait) => tokio::time::sleep(wait).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = app.stop.cancelled() => break,
            Some(_) = sending.join_next(), if !sending.is_empty() => {}
            is_open = news(&mut events) => if !is_open { break },
            () = due => {}
        }
    }
    // the rest of the time to stop
    while sending.join_next().await.is_some() {}
}

/// Waits for a new delivery; false once the library is closed.
async fn news(events: &mut Subscription) -> bool {
    loop {
        match events.next().await {
            Some(Event::Delivery | Event::Gap) => return true,
            Some(_) => {}
            None => return false,
        }
    }
}

/// Begins due attempts; returns how long to wait for the next one, `None` if none is pending.
async fn begin(app: &App, clients: &Arc<Clients>, sending: &mut JoinSet<()>) -> Result<Option<Duration>, LibraryError> {
    let Some(wait) = app.library.next_delivery_in().await? else { return Ok(None) };
    let free = AT_ONCE - sending.len();
    if !wait.is_zero() || free == 0 {
        return Ok(Some(wait.min(LOOK)));
    }
    for due in app.library.take_deliveries(free).await? {
        sending.spawn(attempt(App::clone(app), Arc::clone(clients), due));
    }
    Ok(Some(LOOK))
}

/// Makes and records an attempt. One that cannot be recorded is made again.
async fn attempt(app: App, clients: Arc<Clients>, due: DueDelivery) {
    let (delivery, webhook) = (due.delivery.id.as_str(), due.webhook.id.as_str());
    let attempted = async {
        let seconds = app.library.now().await?.max(0) as u64 / 1000;
        let attempt = clients.send(&due, seconds, &app).await;
        let state = app.library.record_attempt(&due, &attempt).await?;
        let outcome = if state == DeliveryState::Pending { "retried" } else { state.name() };
        app.telemetry.delivery(outcome);
        let (ms, status) = (attempt.took.as_millis() as u64, attempt.status);
        tracing::info!(delivery, webhook, event = due.delivery.event.name(), outcome, status, ms, error = attempt.error, "delivery");
        Ok::<_, LibraryError>(())
    };
    match attempted.await {
        Ok(()) | Err(LibraryError::LeaseLost) => {}
        Err(error) => tracing::warn!(%error, delivery, webhook, "cannot record an attempt to deliver"),
    }
}
