//! Writes an export file by its recipe, in the server or a child process.

use std::sync::Arc;
use std::time::Instant;

use super::recipe::Recipe;
use crate::export::{self, ExportError, ExportOptions};
use crate::server::maker::Fault;
use crate::server::problem::Problem;
use crate::server::routes::ViewQuery;
use axum::http::StatusCode;
use tmpi_core::{Scene, container};
use tmpi_pipeline::Sink;
use tmpi_render::{Animation, DEFAULT_QUALITY, MotionRange, Renderer, draw_multiview};

/// Title of a page: the server knows no name of the photo.
const TITLE: &str = "3D photo";

/// Gets the renderer for films, or why there is none.
pub type Drawing<'a> = &'a (dyn Fn() -> Result<Arc<dyn Renderer>, String> + Sync);

/// An export file to write.
pub struct ExportTask<'a> {
    pub recipe: &'a Recipe,
    pub container: &'a [u8],
    /// The renderer for films in this process.
    pub drawing: Drawing<'a>,
    pub is_low_priority: bool,
}

impl ExportTask<'_> {
    /// Writes it in this process.
    ///
    /// # Errors
    /// [`Fault::Cancelled`] once `sink` says so, [`Fault::Photo`] for anything else.
    pub fn run(&self, sink: &dyn Sink) -> Result<Vec<u8>, Fault> {
        let scene = || container::decode(self.container).map_err(failed);
        match self.recipe {
            Recipe::File { format: export::ExportFormat::Html, .. } => export::html(self.container, TITLE).map_err(|e| fault(&e)),
            Recipe::File { format, model } => {
                let options = ExportOptions { title: TITLE, model: *model };
                export::export(*format, self.container, &scene()?, &options, &|| is_over(sink)).map_err(|e| fault(&e))
            }
            Recipe::Film(query, size) => {
                let (scene, renderer) = (Arc::new(scene()?), (self.drawing)().map_err(Fault::Server)?);
                film(query, *size, &scene, &*renderer, sink)
            }
        }
    }
}

fn is_over(sink: &dyn Sink) -> bool {
    sink.cancelled() || sink.deadline().is_some_and(|deadline| Instant::now() >= deadline)
}

/// The answer if writing takes too long.
pub fn timeout_problem() -> Problem {
    let detail = "writing the file exceeds the time limit (exports.timeout): request fewer frames, a smaller size or another format";
    Problem::new(StatusCode::SERVICE_UNAVAILABLE, "late", detail)
}

fn fault(error: &ExportError) -> Fault {
    match error {
        ExportError::Cancelled => Fault::Cancelled,
        ExportError::TooLarge(_) => Fault::Photo(Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "export-too-large", error.to_string())),
        e => Fault::Photo(Problem::internal("exporting a photo", e)),
    }
}

/// The fault of work that `error` ends.
#[allow(clippy::needless_pass_by_value, reason = "for map_err")]
fn failed<E>(error: E) -> Fault
where
    for<'a> Problem: From<&'a E>,
{
    Fault::Photo(Problem::from(&error))
}

fn film(query: &ViewQuery, size: (u32, u32), scene: &Arc<Scene>, renderer: &dyn Renderer, sink: &dyn Sink) -> Result<Vec<u8>, Fault> {
    let Some(film) = query.film else { return Err(Fault::Photo(Problem::parameter("path", "is required for a film"))) };
    let (camera, rig, range) = (query.camera(scene, size), query.rig(scene), MotionRange::of(scene));
    let mut animation = None;
    for frame in 0..film.frames {
        if is_over(sink) {
            return Err(Fault::Cancelled);
        }
        let camera = film.path.camera(&camera, frame, film.frames, &range);
        let view = match &rig {
            Some(rig) => draw_multiview(renderer, scene, &camera, rig),
            None => renderer.render(scene, &camera),
        };
        let view = view.map_err(failed)?;
        let started = match &mut animation {
            Some(started) => started,
            None => animation.insert(Animation::start(film.format, (view.width, view.height), DEFAULT_QUALITY).map_err(failed)?),
        };
        started.push(&view).map_err(failed)?;
    }
    animation.map_or(Ok(Vec::new()), |animation| animation.finish().map_err(failed))
}
