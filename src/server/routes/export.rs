//! Exports of a photo that other programs can open.

use std::sync::Arc;
use std::time::Instant;

use axum::extract::{Extension, State};
use axum::http::{HeaderMap, StatusCode, Uri, header};
use axum::response::Response;
use tokio_util::sync::CancellationToken;

use super::derived_answer::Derived;
use super::query::Found;
use crate::export::{self, ExportError, ExportFormat, ExportOptions};
use crate::server::app_state::{App, AppState, DiskFullPolicy, Export, StoredFile};
use crate::server::blocking_pool::WorkClass;
use crate::server::conditional::insert;
use crate::server::content_disposition::content_disposition;
use crate::server::exports::{ExportQuery, Recipe, TITLE};
use crate::server::problem::Problem;
use crate::server::time_limit::TimeLimit;

/// Download the photo as a page, a model, layers or an archive.
///
/// `html` is one page that contains viewer and photo and opens from disk without a network; `glb` is a glTF 2.0 model of textured, unlit
/// polygons; `ora` is an `OpenRaster` file for Krita and GIMP, with 3 to 8 layers of the photo's size and the depth map; `zip` holds the
/// photo, every layer as a PNG, the disparity, and the planes as JSON.
#[utoipa::path(
    get, path = "/v1/photos/{id}/export", tag = "photos",
    params(
        ExportQuery,
        ("Range" = Option<String>, Header, description = "One range of bytes"),
        ("If-None-Match" = Option<String>, Header, description = "Entity tags that the client has"),
    ),
    responses(
        (status = 200, description = "The file", content(
            (String = "text/html"), (String = "model/gltf-binary"), (String = "image/openraster"), (String = "application/zip")),
            headers(("ETag" = String, description = "Strong entity tag"), ("Content-Disposition" = String, description = "Name of the file"))),
        (status = 206, description = "The range", content(
            (String = "text/html"), (String = "model/gltf-binary"), (String = "image/openraster"), (String = "application/zip"))),
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
    Found(photo): Found,
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
    let recipe = Recipe::File { format, model };
    let write = async {
        let gone = CancellationToken::new();
        let _guard = gone.clone().drop_guard();
        let pixels = u64::from(done.width) * u64::from(done.height);
        let own = if format == ExportFormat::Ora { export::ORA_BYTES * pixels } else { 0 };
        let slot = app.pool.enter(WorkClass::Export, done.scene_bytes() + own).await?;
        let cheap = recipe.is_cheap(&done);
        // a page contains the container as it is
        let scene = if cheap && format != ExportFormat::Html { Some(app.scene(&photo, &slot).await?.0) } else { None };
        let (container, name, shared) = (app.container_of(&photo).await?, derived.made.clone(), Arc::clone(&app));
        let written = slot.run(move || {
            let start = Instant::now();
            let bytes = match scene {
                Some(scene) => export::export(format, &container, &scene, &ExportOptions { title: TITLE, model }, &|| gone.is_cancelled())
                    .map_err(problem),
                None if cheap => export::html(&container, TITLE).map_err(problem),
                None => shared.write_export(&recipe, (&container, &done), &gone),
            };
            let stored = StoredFile::derived(Some(&name), bytes?, &shared.temp_folder(), DiskFullPolicy::Refuse)?;
            Ok::<_, Problem>((Export(stored), start.elapsed()))
        });
        let (export, elapsed) = written.await??;
        timing.push(("export", elapsed));
        Ok::<_, Problem>(export)
    };
    let Export(stored) = app.exports.get((version, derived.made.clone()), Box::pin(write)).await?;
    let mut response = derived.answer(&headers, stored, format.media_type(), &timing);
    insert(&mut response, header::CONTENT_DISPOSITION, &content_disposition(&photo, format.extension()));
    Ok(response)
}

fn problem(error: ExportError) -> Problem {
    match error {
        ExportError::Cancelled => Problem::new(StatusCode::SERVICE_UNAVAILABLE, "cancelled", error.to_string()).retry_after(1),
        e => Problem::internal("exporting a photo", &e),
    }
}
