//! A photo in forms that need no program of ours.

use std::sync::Arc;
use std::time::Instant;

use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, HeaderName, Uri, header};
use axum::response::Response;
use sha2::{Digest, Sha256};

use crate::export::{self, ExportFormat};
use crate::server::app::{App, Shared};
use crate::server::conditional::{Entity, insert, is_known, respond};
use crate::server::id::hex;
use crate::server::problem::Problem;
use crate::server::store::Part;

/// The same photo gives the same file, but a newer program may write it better.
const CACHED: &str = "public, max-age=86400";
/// Title of a page: the server knows no name of a photo.
const TITLE: &str = "3D photo";

/// Format of an export.
#[derive(Clone, Copy, Debug, Default, PartialEq, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
pub struct ExportQuery {
    /// `html`, `glb` or `zip`; `html` if it is not given.
    #[param(value_type = Option<String>)]
    pub format: ExportFormat,
}

impl ExportQuery {
    /// Reads the query.
    ///
    /// # Errors
    /// 400 that names the first parameter that is unknown, given twice or wrong.
    pub fn read(uri: &Uri) -> Result<Self, Problem> {
        let Query(pairs) = Query::<Vec<(String, String)>>::try_from_uri(uri).map_err(|e| Problem::bad_request(e.body_text()))?;
        let mut format = None;
        for (name, value) in pairs {
            if name != "format" {
                return Err(Problem::parameter(name, "there is no such parameter; there is format"));
            }
            if format.is_some() {
                return Err(Problem::parameter(name, "is given twice"));
            }
            let known = ExportFormat::from_extension(&value);
            format = Some(known.ok_or_else(|| Problem::parameter("format", format!("must be html, glb or zip, not {value:?}")))?);
        }
        Ok(Self { format: format.unwrap_or_default() })
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
pub async fn export(State(app): State<App>, Path(id): Path<String>, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    let entry = app.photo(&id)?;
    let ExportQuery { format } = ExportQuery::read(&uri)?;
    let (version, done) = Shared::done(&entry)?;
    let what = format!("export {} {} {format:?}", env!("CARGO_PKG_VERSION"), done.atlas_hash);
    let etag = format!("\"{}\"", hex(&Sha256::digest(what)[..16]));
    let mut took = None;
    let bytes = if is_known(&headers, &etag) {
        bytes::Bytes::new()
    } else {
        let container = app.file(version, Part::Atlas).await?.bytes;
        // a page carries the container as it is
        let scene = if format == ExportFormat::Html { None } else { Some(app.scene(version).await?.0) };
        let written = app.pool.run(move || {
            let start = Instant::now();
            let bytes = match scene {
                None => export::html(&container, TITLE),
                Some(scene) => export::export(format, &container, &Arc::clone(&scene), TITLE),
            };
            bytes.map(|bytes| (bytes, start.elapsed())).map_err(|e| Problem::internal("exporting a photo", &e))
        });
        let (bytes, elapsed) = written.await??;
        took = Some(elapsed);
        bytes.into()
    };
    let mut response = respond(&headers, Entity { bytes, etag: &etag, content_type: format.media_type(), cache_control: CACHED });
    let name = format!("attachment; filename=\"{}.{}\"", entry.id, format.extension());
    insert(&mut response, header::CONTENT_DISPOSITION, &name);
    if let Some(took) = took {
        let timing = format!("export;dur={:.2}", took.as_secs_f64() * 1e3);
        insert(&mut response, HeaderName::from_static("server-timing"), &timing);
    }
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
