//! The server's depth network.

use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::query::{EmptyBody, NoQuery};
use crate::server::app_state::{App, AppState};
use crate::server::depth_network_download::{DownloadState, NetworkOffer};
use crate::server::problem::Problem;
use tmpi_pipeline::networks::models::registry::better_than;

/// The network that estimates depth, and a better one that is available.
#[derive(Serialize, utoipa::ToSchema)]
pub struct Network {
    /// Name of the current network, as in reports.
    #[schema(example = "tmpi")]
    name: String,
    /// Kinds of networks that it is better than, best first: a report's network is worse if its name begins with one of them.
    #[schema(example = json!(["midas-v2.1-small", "tmpi"]))]
    better_than: &'static [&'static str],
    /// A better network to download; missing if there is none, or it is installed.
    #[serde(skip_serializing_if = "Option::is_none")]
    better: Option<NetworkOffer>,
    /// Bytes downloaded; only during the download.
    #[serde(skip_serializing_if = "Option::is_none")]
    fetched_bytes: Option<u64>,
    /// Why the download failed; another try resumes it.
    #[serde(skip_serializing_if = "Option::is_none")]
    problem: Option<String>,
}

fn network_now(app: &AppState) -> Network {
    let (maker, state) = (&app.maker, app.download.state());
    let (fetched_bytes, problem) = match state {
        DownloadState::Idle => (None, None),
        DownloadState::UnderWay(bytes) => (Some(bytes), None),
        DownloadState::Failed(problem) => (None, Some(problem)),
    };
    let name = maker.network().to_owned();
    Network { better_than: better_than(&name), name, better: maker.better(), fetched_bytes, problem }
}

/// Refuses remote callers, if the access guard has not checked already.
fn own(app: &AppState, headers: &HeaderMap) -> Result<(), Problem> {
    // with private access the guard has checked for the local user or an admin key
    if app.guard.is_some() || app.hosts.is_own(headers) {
        return Ok(());
    }
    let detail = "only this machine's own user can manage networks, at a loopback address";
    Err(Problem::new(StatusCode::FORBIDDEN, "not-yours", detail))
}

/// The depth network of the server.
///
/// Only for this machine's own user, as with the list of photos.
#[utoipa::path(
    get, path = "/v1/network", tag = "system",
    responses(
        (status = 200, description = "The network, and a better one if available", body = Network),
        (status = 403, description = "The caller is not this machine's own user"),
    )
)]
pub async fn network(State(app): State<App>, _: NoQuery, headers: HeaderMap) -> Result<Json<Network>, Problem> {
    own(&app, &headers)?;
    Ok(Json(network_now(&app)))
}

/// Download the better depth network.
///
/// Only for this machine's own user. The server downloads it once, in the background, from a fixed address, and checks its digest. Photos
/// made from then on get their depth from it.
#[utoipa::path(
    post, path = "/v1/network", tag = "system",
    responses(
        (status = 200, description = "There is nothing to download", body = Network),
        (status = 202, description = "The download is running", body = Network),
        (status = 403, description = "The caller is not this machine's own user"),
    )
)]
pub async fn fetch(State(app): State<App>, _: NoQuery, headers: HeaderMap, _: EmptyBody) -> Result<Response, Problem> {
    own(&app, &headers)?;
    app.download.start(&app.maker).map_err(|e| Problem::internal("fetching a network", &e))?;
    let now = network_now(&app);
    let status = if now.fetched_bytes.is_some() { StatusCode::ACCEPTED } else { StatusCode::OK };
    Ok((status, Json(now)).into_response())
}
