//! All routes, and the `OpenAPI` document that is generated from their handlers.

mod events;
mod export;
mod photos;
mod query;
mod results;
mod state;
mod system;
mod view;
mod view_query;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::http::{HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::{from_fn_with_state, map_response};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use bytes::Bytes;
use tower_http::cors::{AllowOrigin, CorsLayer};
use tower_http::csrf::{CsrfLayer, ProtectionError};
use utoipa::OpenApi;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::app::App;
use super::middleware;
pub(super) use view_query::ViewQuery;

use super::pages;
use super::problem::Problem;

#[derive(OpenApi)]
#[openapi(
    info(
        title = "tmpi",
        description = "Turns an uploaded photo into a tiled multiplane image and serves it. Every error is a problem document (RFC 9457)."
    ),
    tags(
        (name = "photos", description = "Photos and what is made of them"),
        (name = "system", description = "Health, metrics and this document")
    ),
    components(schemas(Problem))
)]
struct Document;

fn api() -> OpenApiRouter<App> {
    // what elements and frames on other sites need
    let open = OpenApiRouter::new()
        .routes(routes!(photos::settings))
        .routes(routes!(results::atlas))
        .routes(routes!(results::report))
        .routes(routes!(results::thumbnail))
        .routes(routes!(view::view))
        .routes(routes!(export::export))
        .layer(map_response(open_to_all))
        .layer(cors());
    OpenApiRouter::with_openapi(Document::openapi())
        .merge(open)
        .routes(routes!(photos::upload, photos::list))
        .routes(routes!(photos::state, photos::change, photos::delete))
        .routes(routes!(events::events))
        .routes(routes!(results::depth))
        .routes(routes!(system::healthz))
        .routes(routes!(system::readyz))
        .routes(routes!(system::metrics))
        .routes(routes!(system::openapi))
}

/// Says that any site may take the answer in as a picture.
async fn open_to_all(mut response: Response) -> Response {
    response.headers_mut().insert(pages::RESOURCE_POLICY, HeaderValue::from_static("cross-origin"));
    response
}

/// Leave for pages of any site to read an answer.
fn cors() -> CorsLayer {
    let exposed = [
        "etag",
        "content-range",
        "accept-ranges",
        "content-length",
        "server-timing",
        "x-request-id",
        "retry-after",
        "content-disposition",
    ];
    CorsLayer::new()
        .allow_origin(AllowOrigin::any())
        .allow_methods([Method::GET, Method::HEAD])
        .allow_headers([header::RANGE, header::IF_NONE_MATCH, header::IF_RANGE, header::ACCEPT])
        .expose_headers(exposed.map(HeaderName::from_static))
        .max_age(std::time::Duration::from_hours(24))
}

/// The `OpenAPI` document as JSON.
///
/// # Errors
/// It cannot be written as JSON.
pub fn openapi() -> serde_json::Result<Bytes> {
    api().into_openapi().to_pretty_json().map(Bytes::from)
}

/// The whole service.
pub fn router(app: App) -> Router {
    let (router, _) = api().split_for_parts();
    let scripts = Router::new().route("/static/{*name}", get(pages::file)).route("/tmpi-viewer.js", get(pages::script)).layer(cors());
    let foreign = |_: ProtectionError| Problem::new(StatusCode::FORBIDDEN, "cross-site", "a page of another site may not change anything here").into_response();
    router
        .merge(scripts)
        .route("/", get(pages::index))
        .route("/demo", get(pages::demo))
        .route("/view/{id}", get(pages::view))
        .route("/embed/{id}", get(pages::embed))
        .fallback(async || Problem::not_found("there is nothing at this address"))
        .method_not_allowed_fallback(async |method: Method| {
            Problem::new(StatusCode::METHOD_NOT_ALLOWED, "method", format!("{method} is not possible at this address"))
        })
        .layer(DefaultBodyLimit::disable())
        .layer(CsrfLayer::new().with_rejection_response(foreign))
        .layer(from_fn_with_state(app.clone(), middleware::around))
        .with_state(app)
}
