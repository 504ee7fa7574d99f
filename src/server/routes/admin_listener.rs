//! The admin listener ([`Config::admin`](crate::server::Config::admin)). It has no authentication: bind it to an address that only
//! operators can reach.

use std::net::SocketAddr;
use std::sync::Arc;

use axum::Router;
use axum::extract::{DefaultBodyLimit, Path, State};
use axum::http::StatusCode;
use axum::middleware::from_fn_with_state;
use tower_http::csrf::CsrfLayer;
use utoipa::OpenApi;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::query::NoQuery;
use super::{foreign, no_method, openapi_shared, system};
use crate::server::app_state::App;
use crate::server::hosts::Hosts;
use crate::server::middleware;
use crate::server::problem::Problem;
use tmpi_library::PhotoId;

#[derive(OpenApi)]
#[openapi(
    info(title = "tmpi for operators", description = "The API at the address of `tmpi serve --admin`. Every error is a problem document (RFC 9457)."),
    servers((url = "/", description = "This address")),
    // no authentication
    security(()),
    tags((name = "system", description = "Health, counters, draining and taking down")),
    components(schemas(Problem))
)]
struct Document;

/// Shut the server down as SIGTERM does.
///
/// `/readyz` answers 503 from now on. After the lame-duck time the server accepts no more connections; running requests and jobs then have
/// the drain time to finish.
#[utoipa::path(
    post, path = "/drain", tag = "system",
    responses(
        (status = 202, description = "The server is shutting down"),
        (status = 403, description = "The request comes from a page of another site"),
    )
)]
async fn drain(State(app): State<App>, _: NoQuery) -> StatusCode {
    tracing::info!("asked to shut down");
    app.asked_to_leave.cancel();
    StatusCode::ACCEPTED
}

/// Delete a photo of any owner, with its results and their cache entries.
#[utoipa::path(
    post, path = "/purge/{id}", tag = "system", params(("id" = String, Path, description = "Id of the photo")),
    responses(
        (status = 204, description = "Deleted"),
        (status = 403, description = "The request comes from a page of another site"),
        (status = 404, description = "There is no such photo"),
        (status = 503, description = "The library cannot be reached"),
    )
)]
async fn purge(State(app): State<App>, Path(id): Path<String>, _: NoQuery) -> Result<StatusCode, Problem> {
    let nothing = || Problem::not_found(format!("there is no photo {id:?}"));
    let photo: PhotoId = id.parse().map_err(|_| nothing())?;
    let known = app.library.delete(photo, None).await?;
    app.evict_photo(photo).await;
    if !known {
        return Err(nothing());
    }
    tracing::info!(%photo, "purged");
    Ok(StatusCode::NO_CONTENT)
}

/// Routes with their `OpenAPI` descriptions.
fn api() -> OpenApiRouter<App> {
    OpenApiRouter::with_openapi(Document::openapi())
        .routes(routes!(system::healthz))
        .routes(routes!(system::readyz))
        .routes(routes!(system::metrics))
        .routes(routes!(drain))
        .routes(routes!(purge))
}

/// Router of the admin listener, bound to `addr`. `names` are the accepted `Host` names besides loopback and its address.
pub fn router(app: App, addr: SocketAddr, names: &[String]) -> Router {
    let (router, document) = api().split_for_parts();
    let mut document = serde_json::json!(document);
    openapi_shared::add_shared(&mut document);
    let state = (App::clone(&app), Arc::new(Hosts::new(addr, names)));
    router
        .route("/openapi.json", axum::routing::get(async move || axum::Json(document)))
        .fallback(async || Problem::not_found("this address is for operators: /healthz, /readyz, /metrics, /drain, /purge/{id}"))
        .method_not_allowed_fallback(no_method)
        .layer(DefaultBodyLimit::disable())
        .layer(CsrfLayer::new().with_rejection_response(foreign))
        .layer(from_fn_with_state(state, middleware::around_admin))
        .with_state(app)
}
