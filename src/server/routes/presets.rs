//! The names of the server's presets.

use axum::Json;
use axum::extract::State;
use axum::http::HeaderMap;
use serde::Serialize;

use super::query::NoQuery;
use crate::server::app_state::App;

/// A preset of the server.
#[derive(Serialize, utoipa::ToSchema)]
pub struct NamedPreset {
    /// Its name, the value of the parameter or field `preset`.
    #[schema(example = "card")]
    name: String,
    /// What its options are of: a `view`, a `film`, or a `photo` to make.
    #[schema(example = "view")]
    kind: &'static str,
}

/// The presets of the server.
#[derive(Serialize, utoipa::ToSchema)]
pub struct PresetList {
    /// All presets. A preset of photos may have the name of another one.
    presets: Vec<NamedPreset>,
    /// Whether the server takes no other options of views, films and photos from this caller (`--presets-only`).
    only: bool,
}

/// The presets of the server (`--preset`).
///
/// Anyone may see their names, since the pages offer them.
#[utoipa::path(
    get, path = "/v1/presets", tag = "system",
    responses(
        (status = 200, description = "All presets", body = PresetList),
    )
)]
pub async fn presets(State(app): State<App>, _: NoQuery, headers: HeaderMap) -> Json<PresetList> {
    let presets = app.presets.names().map(|(name, kind)| NamedPreset { name: name.to_owned(), kind }).collect();
    Json(PresetList { presets, only: !app.takes_options(&headers) })
}
