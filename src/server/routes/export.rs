//! Exports of a photo that other programs can open.

use axum::extract::{Extension, State};
use axum::http::{HeaderMap, Uri, header};
use axum::response::Response;

use super::derived_answer::Derived;
use super::path_photo::PathPhoto;
use crate::server::app_state::{App, AppState, Export};
use crate::server::conditional::insert;
use crate::server::content_disposition::content_disposition;
use crate::server::exports::{ExportQuery, Recipe, export_for_client};
use crate::server::problem::Problem;
use crate::server::time_limit::TimeLimit;

/// Download the photo as a page, a model, layers, photo and depth in one picture, or an archive.
///
/// `html` is one page that contains viewer and photo and opens from disk without a network; `glb` is a glTF 2.0 model of textured, unlit
/// polygons; `ora` is an `OpenRaster` file for Krita and GIMP, with 3 to 8 layers of the photo's size and the depth map; `rgbd` is a PNG
/// of the photo with its depth map at the right, in which white is near, for light-field displays; `zip` holds the photo, every layer as a PNG, the disparity, and the planes as JSON.
#[utoipa::path(
    get, path = "/v1/photos/{id}/export", tag = "photos",
    params(
        ExportQuery,
        ("Range" = Option<String>, Header, description = "One range of bytes"),
        ("If-None-Match" = Option<String>, Header, description = "Entity tags that the client has"),
    ),
    responses(
        (status = 200, description = "The file", content(
            (String = "text/html"), (String = "model/gltf-binary"), (String = "image/openraster"), (String = "image/png"), (String = "application/zip")),
            headers(("ETag" = String, description = "Strong entity tag"), ("Content-Disposition" = String, description = "Name of the file"))),
        (status = 206, description = "The range", content(
            (String = "text/html"), (String = "model/gltf-binary"), (String = "image/openraster"), (String = "image/png"), (String = "application/zip"))),
        (status = 304, description = "The client has it"),
        (status = 400, description = "A parameter is wrong; `field` names it"),
        (status = 409, description = "Not finished yet"),
        (status = 416, description = "There are no such bytes"),
        (status = 503, description = "Too much waits"),
    )
)]
pub async fn export(
    State(app): State<App>,
    Extension(clock): Extension<TimeLimit>,
    PathPhoto(photo): PathPhoto,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let query = ExportQuery::read(&uri)?;
    let (format, model, asked) = (query.format, query.model(), query.version);
    let (version, done) = AppState::finished(&photo)?;
    let derived = Derived::new(&app, &done, asked.as_deref(), |results| format!("export {results} {format:?} {model:?}"));
    if let Some(response) = derived.known(&headers) {
        return Ok(response);
    }
    clock.allow(app.limits.exports.timeout);
    let mut timing = Vec::new();
    let write = async {
        let recipe = Recipe::File { format, model };
        let (export, [_, took]) = export_for_client(&app, (&photo, &done), recipe, derived.made.clone()).await?;
        timing.push(("export", took));
        Ok::<_, Problem>(export)
    };
    let Export(stored) = app.exports.get((version, derived.made.clone()), Box::pin(write)).await?;
    let mut response = derived.answer(&headers, stored, format.media_type(), &timing);
    insert(&mut response, header::CONTENT_DISPOSITION, &content_disposition(&photo, format.ending()));
    Ok(response)
}
