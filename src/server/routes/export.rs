//! A photo in forms that need no program of ours.

use std::sync::Arc;
use std::time::Instant;

use axum::extract::{Extension, Path, State};
use axum::http::{HeaderMap, StatusCode, Uri, header};
use axum::response::Response;
use tokio_util::sync::CancellationToken;

use super::derived::Derived;
use super::query::Pairs;
use crate::export::{self, ExportError, ExportFormat};
use crate::server::app::{App, Export, Full, Shared, Stored, scene_bytes};
use crate::server::clock::Clock;
use crate::server::conditional::insert;
use crate::server::pool::Class;
use crate::server::problem::Problem;

/// Title of a page: the server knows no name of a photo.
const TITLE: &str = "3D photo";

/// Format of an export.
#[derive(Clone, Debug, Default, PartialEq, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
pub struct ExportQuery {
    /// `html`, `glb` or `zip`; `html` if it is not given.
    #[param(value_type = Option<String>)]
    pub format: ExportFormat,
    /// Version as in the photo's `links`: the file is kept for a year then.
    #[param(rename = "v")]
    pub version: Option<String>,
}

impl ExportQuery {
    /// Reads the query.
    ///
    /// # Errors
    /// 400 that names the first parameter that is unknown, given twice or wrong.
    pub fn read(uri: &Uri) -> Result<Self, Problem> {
        let mut pairs = Pairs::read(uri, &["format", "v"])?;
        let format = pairs.get("format").map_or(Ok(ExportFormat::default()), |value| {
            let known = ExportFormat::from_extension(value);
            known.ok_or_else(|| Problem::parameter("format", format!("must be html, glb or zip, not {value:?}")))
        })?;
        Ok(Self { format, version: pairs.take("v") })
    }
}

/// The photo as a page, a model or an archive, to download.
///
/// `html` is one page that carries viewer and photo in itself and opens from disk without a network; `glb` is a glTF 2.0 model of
/// textured, unlit polygons; `zip` holds the photo, every layer as a PNG, the disparity, and the planes as JSON.
#[utoipa::path(
    get, path = "/v1/photos/{id}/export", tag = "photos",
    params(
        ("id" = String, Path, description = "Id of the photo"), ExportQuery,
        ("Range" = Option<String>, Header, description = "One range of bytes"),
        ("If-None-Match" = Option<String>, Header, description = "Entity tags that the client has"),
    ),
    responses(
        (status = 200, description = "The file", content(
            (String = "text/html"), (String = "model/gltf-binary"), (String = "application/zip")),
            headers(("ETag" = String, description = "Strong entity tag"), ("Content-Disposition" = String, description = "Name of the file"))),
        (status = 206, description = "The range", content(
            (String = "text/html"), (String = "model/gltf-binary"), (String = "application/zip"))),
        (status = 304, description = "The client has it"),
        (status = 400, description = "A parameter is wrong; `field` names it", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such photo", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "Not finished yet", body = Problem, content_type = "application/problem+json"),
        (status = 416, description = "There are no such bytes", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "Too much waits", body = Problem, content_type = "application/problem+json"),
    )
)]
pub async fn export(
    State(app): State<App>,
    Extension(clock): Extension<Clock>,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let entry = app.photo(&id)?;
    let ExportQuery { format, version: asked } = ExportQuery::read(&uri)?;
    let (version, done) = Shared::done(&entry)?;
    let derived = Derived::new(&app, &done, asked.as_deref(), |results| format!("export {results} {format:?}"));
    if let Some(response) = derived.known(&headers) {
        return Ok(response);
    }
    clock.allow(app.limits.export);
    let mut timing = Vec::new();
    let write = async {
        let gone = CancellationToken::new();
        let _guard = gone.clone().drop_guard();
        let slot = app.pool.enter(Class::Export, scene_bytes(&done)).await?;
        // a page carries the container as it is
        let scene = if format == ExportFormat::Html { None } else { Some(app.scene(version, &slot).await?.0) };
        let (read, name, shared) = (app.reading(version), derived.made.clone(), Arc::clone(&app));
        let written = slot.run(move || {
            let (start, container) = (Instant::now(), read()?);
            let bytes = match scene {
                None => export::html(&container, TITLE),
                Some(scene) => export::export(format, &container, &scene, TITLE, &|| gone.is_cancelled()),
            };
            let bytes = bytes.map_err(|e| match e {
                ExportError::Cancelled => Problem::new(StatusCode::SERVICE_UNAVAILABLE, "cancelled", e.to_string()).retry_after(1),
                e => Problem::internal("exporting a photo", &e),
            })?;
            let stored = Stored::derived(Some(&name), bytes, &shared.jobs.store, Full::Refuse)?;
            Ok::<_, Problem>((Export(stored), start.elapsed()))
        });
        let (export, elapsed) = written.await??;
        timing.push(("export", elapsed));
        Ok::<_, Problem>(export)
    };
    let Export(stored) = app.exports.get((version, derived.made.clone()), write).await?;
    let mut response = derived.answer(&headers, stored, format.media_type(), &timing);
    let name = format!("attachment; filename=\"{}.{}\"", entry.id, format.extension());
    insert(&mut response, header::CONTENT_DISPOSITION, &name);
    Ok(response)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_parameters_are_named() {
        let read = |query: &str| ExportQuery::read(&format!("/export?{query}").parse().unwrap());
        assert_eq!(read("").unwrap().format, ExportFormat::Html);
        assert_eq!(read("format=GLB").unwrap().format, ExportFormat::Glb);
        for (query, field) in [("format=gltf", "format"), ("format=", "format"), ("format=zip&format=zip", "format"), ("w=3", "w")] {
            let p = read(query).unwrap_err();
            assert_eq!((p.status, p.field.as_deref()), (400, Some(field)), "{query}");
        }
    }
}
