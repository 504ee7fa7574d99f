//! Extractor of the photo whose id is in the path.

use std::collections::BTreeMap;

use axum::extract::{FromRequestParts, Path};
use axum::http::request::Parts;

use crate::server::app_state::App;
use crate::server::problem::Problem;
use tmpi_library::Photo;

/// The photo whose id is in the path; 404 if there is none.
pub struct PathPhoto(pub Photo);

impl FromRequestParts<App> for PathPhoto {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, app: &App) -> Result<Self, Problem> {
        let path = Path::<BTreeMap<String, String>>::from_request_parts(parts, app).await;
        let Path(parameters) = path.map_err(|e| Problem::new(e.status(), "request", e.body_text()))?;
        app.photo(parameters.get("id").map_or("", String::as_str)).await.map(Self)
    }
}
