//! A photo in forms that need no program of ours.

use std::sync::Arc;
use std::time::Instant;

use axum::extract::{Extension, Path, State};
use axum::http::{HeaderMap, StatusCode, Uri, header};
use axum::response::Response;
use tokio_util::sync::CancellationToken;

use super::derived::Derived;
use super::query::Pairs;
use crate::export::{self, ExportError, ExportFormat, ExportOptions, ModelOptions, ModelShape, ModelTextures};
use crate::server::app::{App, Export, Full, Shared, Stored, scene_bytes};
use crate::server::attachment::attachment;
use crate::server::clock::Clock;
use crate::server::conditional::insert;
use crate::server::exports::{Recipe, TITLE};
use crate::server::pool::Class;
use crate::server::problem::Problem;

/// Format of an export.
#[derive(Clone, Debug, Default, PartialEq, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
pub struct ExportQuery {
    /// `html`, `glb`, `ora` or `zip`; `html` if it is not given.
    #[param(value_type = Option<String>)]
    pub format: ExportFormat,
    /// Space of a `glb`: `relief`, which fits into the frame that viewers put around a model, or `metric`, with far things far away;
    /// `relief` if it is not given.
    #[param(value_type = Option<String>)]
    pub shape: ModelShape,
    /// Textures of a `glb`: `plain`, JPEG and PNG, which every program reads, or `webp`, which are smaller and need `EXT_texture_webp`; `plain` if it
    /// is not given.
    #[param(value_type = Option<String>)]
    pub textures: ModelTextures,
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
        Self::of(Pairs::read(uri, &["format", "shape", "textures", "v"])?)
    }

    /// The same of parameters that are known.
    ///
    /// # Errors
    /// 400 that names the first parameter that is wrong.
    pub fn of(mut pairs: Pairs) -> Result<Self, Problem> {
        let format = pairs.get("format").map_or(Ok(ExportFormat::default()), |value| {
            let known = ExportFormat::from_extension(value);
            known.ok_or_else(|| Problem::parameter("format", format!("must be html, glb, ora or zip, not {value:?}")))
        })?;
        for name in ["shape", "textures"] {
            if format != ExportFormat::Glb && pairs.get(name).is_some() {
                return Err(Problem::parameter(name, "goes with format=glb"));
            }
        }
        let shape = pairs.get("shape").map(|value| match value {
            "relief" => Ok(ModelShape::Relief),
            "metric" => Ok(ModelShape::Metric),
            _ => Err(Problem::parameter("shape", format!("must be relief or metric, not {value:?}"))),
        });
        let textures = pairs.get("textures").map(|value| match value {
            "plain" => Ok(ModelTextures::Plain),
            "webp" => Ok(ModelTextures::WebP),
            _ => Err(Problem::parameter("textures", format!("must be plain or webp, not {value:?}"))),
        });
        let (shape, textures) = (shape.transpose()?.unwrap_or_default(), textures.transpose()?.unwrap_or_default());
        Ok(Self { format, shape, textures, version: pairs.take("v") })
    }

    /// What a model is.
    #[must_use]
    pub const fn model(&self) -> ModelOptions {
        ModelOptions { shape: self.shape, textures: self.textures }
    }
}

/// The photo as a page, a model, layers or an archive, to download.
///
/// `html` is one page that carries viewer and photo in itself and opens from disk without a network; `glb` is a glTF 2.0 model of
/// textured, unlit polygons; `ora` is an `OpenRaster` file of 3 to 8 layers of the photo's size, as Krita and GIMP read it, with the depth
/// map; `zip` holds the photo, every layer as a PNG, the disparity, and the planes as JSON.
#[utoipa::path(
    get, path = "/v1/photos/{id}/export", tag = "photos",
    params(
        ("id" = String, Path, description = "Id of the photo"), ExportQuery,
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
        (status = 404, description = "There is no such photo"),
        (status = 409, description = "Not finished yet"),
        (status = 416, description = "There are no such bytes"),
        (status = 503, description = "Too much waits"),
    )
)]
pub async fn export(
    State(app): State<App>,
    Extension(clock): Extension<Clock>,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let photo = app.photo(&id).await?;
    let query = ExportQuery::read(&uri)?;
    let (format, model, asked) = (query.format, query.model(), query.version);
    let (version, done) = Shared::done(&photo)?;
    let derived = Derived::new(&app, &done, asked.as_deref(), |results| format!("export {results} {format:?} {model:?}"));
    if let Some(response) = derived.known(&headers) {
        return Ok(response);
    }
    clock.allow(app.limits.export);
    let mut timing = Vec::new();
    let recipe = Recipe::File { format, model };
    let write = async {
        let gone = CancellationToken::new();
        let _guard = gone.clone().drop_guard();
        let pixels = u64::from(done.width) * u64::from(done.height);
        let own = if format == ExportFormat::Ora { export::ORA_BYTES * pixels } else { 0 };
        let slot = app.pool.enter(Class::Export, scene_bytes(&done) + own).await?;
        let cheap = recipe.is_cheap(&done);
        // a page carries the container as it is
        let scene = if cheap && format != ExportFormat::Html { Some(app.scene(&photo, &slot).await?.0) } else { None };
        let (container, name, shared) = (app.container_of(&photo).await?, derived.made.clone(), Arc::clone(&app));
        let written = slot.run(move || {
            let start = Instant::now();
            let bytes = match scene {
                Some(scene) => export::export(format, &container, &scene, &ExportOptions { title: TITLE, model }, &|| gone.is_cancelled())
                    .map_err(problem),
                None if cheap => export::html(&container, TITLE).map_err(problem),
                None => shared.written(&recipe, (&container, &done), &gone),
            };
            let stored = Stored::derived(Some(&name), bytes?, &shared.disk(), Full::Refuse)?;
            Ok::<_, Problem>((Export(stored), start.elapsed()))
        });
        let (export, elapsed) = written.await??;
        timing.push(("export", elapsed));
        Ok::<_, Problem>(export)
    };
    let Export(stored) = app.exports.get((version, derived.made.clone()), Box::pin(write)).await?;
    let mut response = derived.answer(&headers, stored, format.media_type(), &timing);
    insert(&mut response, header::CONTENT_DISPOSITION, &attachment(&photo, format.extension()));
    Ok(response)
}

fn problem(error: ExportError) -> Problem {
    match error {
        ExportError::Cancelled => Problem::new(StatusCode::SERVICE_UNAVAILABLE, "cancelled", error.to_string()).retry_after(1),
        e => Problem::internal("exporting a photo", &e),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_parameters_are_named() {
        let read = |query: &str| ExportQuery::read(&format!("/export?{query}").parse().unwrap());
        assert_eq!(read("").unwrap().format, ExportFormat::Html);
        assert_eq!(read("format=GLB").unwrap().format, ExportFormat::Glb);
        assert_eq!(read("format=glb&shape=metric").unwrap().shape, ModelShape::Metric);
        for (query, field) in [
            ("format=gltf", "format"),
            ("format=", "format"),
            ("format=zip&format=zip", "format"),
            ("w=3", "w"),
            ("shape=metric", "shape"),
            ("format=glb&shape=flat", "shape"),
            ("textures=webp", "textures"),
            ("format=glb&textures=jpeg", "textures"),
        ] {
            let p = read(query).unwrap_err();
            assert_eq!((p.status, p.field.as_deref()), (400, Some(field)), "{query}");
        }
    }
}
