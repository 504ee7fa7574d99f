//! All routes, and the `OpenAPI` document that is generated from their handlers.

mod admin_listener;
mod depth_network;
mod derived_answer;
mod events;
mod export;
mod export_jobs;
mod oembed;
mod openapi_shared;
mod openapi_values;
mod owner_tickets;
mod path_photo;
mod photo_state;
mod photos;
mod presets;
mod query;
mod remake;
mod rendered_view;
mod rendered_view_query;
mod results;
mod sharing;
mod strokes;
mod system;
mod webhook_state;
mod webhooks;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::http::{HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::{from_fn_with_state, map_response};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, get};
use bytes::Bytes;
use tower_http::cors::{AllowOrigin, CorsLayer};
use tower_http::csrf::{CsrfLayer, ProtectionError};
use utoipa::OpenApi;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::app_state::App;
use super::base_path::BasePath;
use super::limits::Limits;
use super::middleware;
pub(super) use admin_listener::router as admin_router;
pub(super) use photo_state::Progress as Stage;
pub(crate) use query::{EmptyBody, Pairs, decode};
pub(super) use rendered_view_query::ViewQuery;

use super::pages::{self, Frames};
use super::problem::Problem;
use crate::live;

#[derive(OpenApi)]
#[openapi(
    info(
        title = "tmpi",
        description = "Turns an uploaded photo into a tiled multiplane image and serves it. Every error is a problem document (RFC 9457). \
                       On every route: a request has one Host (else 400) that is the server's own (else 421); parameters are known and given \
                       once (else 400); pages of other sites cannot change anything (403); too many requests answer 429 with `Retry-After`."
    ),
    servers((url = "/", description = "This server")),
    tags(
        (name = "photos", description = "Photos and what is made of them"),
        (name = "live", description = "Rooms, in which photos move"),
        (name = "webhooks", description = "Requests that tell other servers of events"),
        (name = "system", description = "Health, metrics and this document")
    ),
    components(schemas(Problem))
)]
struct Document;

/// Routes that pages of any site can read.
fn open_api() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(photos::settings))
        .routes(routes!(results::atlas))
        .routes(routes!(results::report))
        .routes(routes!(results::thumbnail))
        .routes(routes!(rendered_view::view))
        .routes(routes!(export::export))
        .routes(routes!(oembed::oembed))
}

/// Routes for this server's own pages and for programs, without metrics.
fn pages_api() -> OpenApiRouter<App> {
    OpenApiRouter::with_openapi(Document::openapi())
        .routes(routes!(photos::upload, photos::list))
        .routes(routes!(photos::state, photos::change, photos::delete))
        .routes(routes!(strokes::strokes, strokes::touch_up))
        .routes(routes!(remake::remake))
        .routes(routes!(sharing::links))
        .routes(routes!(sharing::keep_token, sharing::revoke_links))
        .routes(routes!(owner_tickets::ticket))
        .routes(routes!(owner_tickets::adopt_owner))
        .routes(routes!(depth_network::network, depth_network::fetch))
        .routes(routes!(presets::presets))
        .routes(routes!(events::events))
        .routes(routes!(results::depth))
        .routes(routes!(export_jobs::order))
        .routes(routes!(export_jobs::state, export_jobs::cancel))
        .routes(routes!(export_jobs::file))
        .routes(routes!(webhooks::add, webhooks::list))
        .routes(routes!(webhooks::state, webhooks::change, webhooks::delete))
        .routes(routes!(webhooks::test))
        .routes(routes!(webhooks::deliveries))
        .routes(routes!(system::healthz))
        .routes(routes!(system::readyz))
        .routes(routes!(system::openapi))
}

/// Routes for this server's own pages and for programs.
fn own_api() -> OpenApiRouter<App> {
    pages_api().routes(routes!(system::metrics))
}

/// The answer to a method that a route does not have: 204 to OPTIONS, else 405. The router adds `Allow` to both.
async fn no_method(method: Method) -> Response {
    if method == Method::OPTIONS { StatusCode::NO_CONTENT.into_response() } else { Problem::no_method(&method, None).into_response() }
}

/// Adds `Allow` to the answers of the CORS layer to OPTIONS.
async fn say_methods(mut response: Response) -> Response {
    let headers = response.headers_mut();
    if let Some(methods) = headers.get(header::ACCESS_CONTROL_ALLOW_METHODS).cloned() {
        headers.entry(header::ALLOW).or_insert(methods);
    }
    response
}

/// Lets pages of any site embed the answer.
async fn open_to_all(mut response: Response) -> Response {
    response.headers_mut().insert(pages::RESOURCE_POLICY, HeaderValue::from_static("cross-origin"));
    response
}

/// CORS for routes that pages of any site can read.
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
        "ratelimit",
        "ratelimit-policy",
    ];
    CorsLayer::new()
        .allow_origin(AllowOrigin::any())
        .allow_methods([Method::GET, Method::HEAD])
        .allow_headers([header::RANGE, header::IF_NONE_MATCH, header::IF_RANGE, header::ACCEPT])
        .expose_headers(exposed.map(HeaderName::from_static))
        .max_age(std::time::Duration::from_hours(24))
}

/// CORS for rooms, where pages of other sites need a token.
fn rooms_cors() -> CorsLayer {
    let exposed = ["etag", "content-length", "location", "server-timing", "x-request-id", "x-tmpi-frame", "x-tmpi-epoch", "retry-after"];
    cors()
        .allow_headers([header::AUTHORIZATION, header::IF_NONE_MATCH, header::ACCEPT])
        .expose_headers(exposed.map(HeaderName::from_static))
}

/// The `OpenAPI` document as JSON.
///
/// # Errors
/// If it cannot be written as JSON.
pub fn openapi() -> serde_json::Result<Bytes> {
    openapi_of(&Limits::default(), false, &BasePath::default())
}

/// The `OpenAPI` document of a server with these limits at this path; with an admin listener, only that one's document describes metrics.
///
/// # Errors
/// As [`openapi`].
pub fn openapi_of(limits: &Limits, has_admin: bool, base: &BasePath) -> serde_json::Result<Bytes> {
    let own = if has_admin { pages_api() } else { own_api() };
    let mut document = own.merge(open_api()).into_openapi();
    document.merge(live::routes::watching_api().into_openapi());
    document.merge(live::routes::publishing_api().into_openapi());
    let mut document = serde_json::to_value(document)?;
    document["servers"][0]["url"] = base.root().into();
    openapi_values::add_values(&mut document);
    openapi_shared::add_shared(&mut document);
    openapi_values::add_link_limit(&mut document, limits.link.as_secs());
    serde_json::to_vec_pretty(&document).map(Bytes::from)
}

/// Which sites' pages can access a route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Pages of any site can read it.
    Open,
    /// Pages of this server, programs, and pages of any site with a token.
    Token,
    /// Pages of any site can show it in a frame, but not read it.
    Framed,
    /// Pages of this server, and programs.
    Own,
}

/// A route of the service.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Route {
    /// Path template: `/v1/photos/{id}`.
    pub path: String,
    /// Methods without HEAD, which GET implies.
    pub methods: Vec<Method>,
    /// Which sites' pages can access it.
    pub access: Access,
}

/// Scripts and pictures that any site can embed.
fn files() -> [(&'static str, MethodRouter<App>); 2] {
    let script = pages::fixed("element/tmpi-viewer.js", Frames::Anybody);
    [("/static/{*name}", get(pages::file)), ("/tmpi-viewer.js", script)]
}

/// Pages.
fn own_pages() -> [(&'static str, MethodRouter<App>, Access); 6] {
    [
        ("/", pages::fixed("app/upload-page.html", Frames::Own), Access::Own),
        ("/demo", pages::fixed("app/demo-page.html", Frames::Own), Access::Own),
        ("/view/{id}", get(pages::view), Access::Own),
        // the page itself shows whether the room is live
        ("/live/{room}", pages::fixed("app/watch-page.html", Frames::Own), Access::Own),
        ("/live/{room}/publish", pages::fixed("app/publish-page.html", Frames::Own), Access::Own),
        ("/embed/{id}", get(pages::embed), Access::Framed),
    ]
}

/// All routes of [`router`].
pub fn routes() -> Vec<Route> {
    let described = |api: utoipa::openapi::OpenApi, access| {
        let paths = api.paths.paths;
        paths.into_iter().map(move |(path, item)| {
            let all = [(item.get, Method::GET), (item.post, Method::POST), (item.patch, Method::PATCH), (item.delete, Method::DELETE)];
            let others = [(item.put, Method::PUT), (item.head, Method::HEAD), (item.options, Method::OPTIONS), (item.trace, Method::TRACE)];
            let methods = all.into_iter().chain(others).filter_map(|(operation, method)| operation.map(|_| method)).collect();
            Route { path, methods, access }
        })
    };
    let page = |path: &str, access| Route { path: path.to_owned(), methods: vec![Method::GET], access };
    described(own_api().into_openapi(), Access::Own)
        .chain(described(open_api().into_openapi(), Access::Open))
        .chain(described(live::routes::watching_api().into_openapi(), Access::Token))
        .chain(described(live::routes::publishing_api().into_openapi(), Access::Own))
        .chain(own_pages().map(|(path, _, access)| page(path, access)))
        .chain(files().map(|(path, _)| page(path, Access::Open)))
        .collect()
}

/// Only health, metrics and the `OpenAPI` document, for nodes that only make photos.
pub fn system_router(app: App) -> Router {
    let system =
        OpenApiRouter::<App>::new().routes(routes!(system::healthz)).routes(routes!(system::readyz)).routes(routes!(system::openapi));
    let system = if app.has_admin { system } else { system.routes(routes!(system::metrics)) };
    let (router, _) = system.split_for_parts();
    router
        .fallback(async || Problem::not_found("this node only makes photos and reports its health"))
        .method_not_allowed_fallback(no_method)
        .layer(DefaultBodyLimit::disable())
        .layer(from_fn_with_state(app.clone(), middleware::around))
        .with_state(app)
}

/// 403 to a page of another site that tries to change something.
fn foreign(_: ProtectionError) -> Response {
    Problem::new(StatusCode::FORBIDDEN, "cross-site", "pages of other sites cannot change anything here").into_response()
}

/// Rooms.
fn rooms_router(here: live::RoomsContext) -> Router {
    let (watching, _) = live::routes::watching_api().split_for_parts();
    let (publishing, _) = live::routes::publishing_api().split_for_parts();
    let watching = watching.method_not_allowed_fallback(no_method).layer((map_response(say_methods), rooms_cors()));
    watching.merge(publishing).with_state(here)
}

/// The whole service, with `rooms` if enabled, and without metrics if there is an admin listener.
pub fn router(app: App, rooms: Option<live::RoomsContext>) -> Router {
    let (router, _) = if app.has_admin { pages_api() } else { own_api() }.split_for_parts();
    let (open, _) = open_api().split_for_parts();
    // set the fallback before the layers, so that they see every method (preflights are OPTIONS);
    // a tuple of layers counts as one: each layer costs every request a box and a clone of the inner service
    let open = open.method_not_allowed_fallback(no_method).layer((map_response(say_methods), cors(), map_response(open_to_all)));
    let files = files().into_iter().fold(Router::new(), |router, (path, handler)| router.route(path, handler));
    let files = files.method_not_allowed_fallback(no_method).layer((map_response(say_methods), cors()));
    let router = router.merge(open).merge(files).merge(rooms.map(rooms_router).unwrap_or_default().with_state(()));
    own_pages()
        .into_iter()
        .fold(router, |router, (path, handler, _)| router.route(path, handler))
        .fallback(pages::not_found)
        .method_not_allowed_fallback(no_method)
        .layer((
            from_fn_with_state(app.clone(), middleware::around),
            CsrfLayer::new().with_rejection_response(foreign),
            DefaultBodyLimit::disable(),
        ))
        .with_state(app)
}
