//! Rendered views of a photo.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::extract::{Extension, State};
use axum::http::{HeaderMap, Uri, header};
use axum::response::Response;
use tokio_util::sync::CancellationToken;

use crate::server::app_state::{App, AppState, DiskFullPolicy, StoredFile};
use crate::server::blocking_pool::WorkClass;
use crate::server::conditional::insert;
use crate::server::exports::{Recipe, export_for_client};
use crate::server::finished_photo::FinishedPhoto;
use crate::server::limits::Limits;
use crate::server::link_preview::PICTURE;
use crate::server::photo_options;
use crate::server::problem::Problem;
use crate::server::time_limit::TimeLimit;
use crate::server::viewer_settings::Settings;
use tmpi_core::{Camera, Scene};
use tmpi_library::Photo;
use tmpi_render::{DEFAULT_QUALITY, PictureFormat, RenderError, Renderer, View, draw_multiview, encode};

use super::derived_answer::Derived;
use super::path_photo::PathPhoto;
use super::query::decode;
use super::rendered_view_query::ViewQuery;

/// The format that the client prefers; PNG without a preference. `None` if it accepts none.
fn negotiate(headers: &HeaderMap) -> Option<PictureFormat> {
    let ranges: Vec<(String, f32)> = headers
        .get_all(header::ACCEPT)
        .iter()
        .filter_map(|v| v.to_str().ok())
        .flat_map(|v| v.split(','))
        .filter_map(|range| {
            let mut parts = range.split(';').map(str::trim);
            let name = parts.next().filter(|n| !n.is_empty())?.to_ascii_lowercase();
            let q = parts.find_map(|p| p.strip_prefix("q=").or_else(|| p.strip_prefix("Q=")));
            Some((name, q.and_then(|q| q.parse().ok()).unwrap_or(1.0)))
        })
        .collect();
    if ranges.is_empty() {
        return Some(PictureFormat::default());
    }
    // the most specific matching range counts
    let quality = |format: PictureFormat| {
        let named = |name: &str| ranges.iter().find(|(n, _)| n == name).map(|(_, q)| *q);
        named(format.media_type()).or_else(|| named("image/*")).or_else(|| named("*/*")).unwrap_or(0.0)
    };
    let best = PictureFormat::ALL.map(|f| (f, quality(f))).into_iter().filter(|(_, q)| *q > 0.0);
    // the first one wins a tie
    best.reduce(|a, b| if b.1 > a.1 { b } else { a }).map(|(f, _)| f)
}

/// The format in the query, else the one that the client prefers.
fn picked(asked: Option<PictureFormat>, headers: &HeaderMap) -> Result<PictureFormat, Problem> {
    asked.or_else(|| negotiate(headers)).ok_or_else(|| {
        let status = axum::http::StatusCode::NOT_ACCEPTABLE;
        Problem::new(status, "not-acceptable", "views are image/png, image/jpeg or image/webp").field("Accept")
    })
}

/// A rendered view of a photo for any camera.
///
/// The server rounds the pose (lengths to 0.00001, angles to 0.001 degrees), so that views that look the same share a cache entry. If it
/// rendered the view for this request, `Server-Timing` has the times of decoding, rendering and encoding.
#[utoipa::path(
    get, path = "/v1/photos/{id}/view", tag = "photos",
    params(
        ViewQuery,
        ("preset" = Option<String>, Query, description = "Name of a preset of the server (`--preset`), whose options are added to those here"),
    ),
    responses(
        (status = 200, description = "The view; PNG and WebP are transparent where nothing is known", content(
            (String = "image/png"), (String = "image/jpeg"), (String = "image/webp"), (String = "image/mpo"), (String = "video/mp4"))),
        (status = 304, description = "The client has it"),
        (status = 400, description = "A parameter is wrong; `field` names it"),
        (status = 403, description = "The server takes only presets; `field` names another option"),
        (status = 406, description = "The client accepts none of the formats"),
        (status = 409, description = "Not finished yet"),
        (status = 501, description = "There is no ffmpeg for an animation"),
        (status = 503, description = "Too much waits; `Retry-After` says when to come back"),
    )
)]
pub async fn view(
    State(app): State<App>,
    Extension(clock): Extension<TimeLimit>,
    PathPhoto(photo): PathPhoto,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let pairs = decode(&uri)?;
    let free = app.takes_options(&headers) || is_preview(&photo, &pairs, &app.limits);
    let query = ViewQuery::of_pairs(app.presets.expand(pairs, free)?, &app.limits)?;
    let (version, done) = AppState::finished(&photo)?;
    let size = query.size((done.width, done.height), &app.limits)?;
    let still = query.film.map(|_| PictureFormat::default());
    let format = picked(query.format.or(still), &headers)?;
    let name = |results: &str| format!("{results} {size:?} {format:?} {:?}", query.canonical());
    let derived = Derived::new(&app, &done, query.version.as_deref(), name);
    if let Some(mut response) = derived.known(&headers) {
        insert(&mut response, header::VARY, "Accept");
        return Ok(response);
    }
    let mut timing = Vec::new();
    let key = (version, derived.made.clone());
    // concurrent requests for the same view wait for this one
    let stored = if query.film.is_some() {
        clock.allow(app.limits.exports.timeout);
        let recipe = Recipe::Film(Box::new(query.clone()), size);
        let written = async {
            let (export, [waited, rendering]) = export_for_client(&app, (&photo, &done), recipe, derived.made.clone()).await?;
            timing = vec![("wait", waited), ("render", rendering)];
            Ok::<_, Problem>(export)
        };
        app.exports.get(key, Box::pin(written)).await?.0
    } else {
        let drawn = async {
            let (bytes, took) = draw(&app, (&photo, &done), &query, size, format).await?;
            timing = took;
            let (name, disk) = (derived.made.clone(), app.temp_folder());
            let keep = tokio::task::spawn_blocking(move || StoredFile::derived(Some(&name), bytes, &disk, DiskFullPolicy::Memory));
            keep.await.map_err(|e| Problem::internal("keeping a view", &e))?
        };
        app.views.get(key, Box::pin(drawn)).await?
    };
    count(&app, &timing);
    let content_type = query.film.map_or(format.media_type(), |film| film.format.media_type());
    let mut response = derived.answer(&headers, stored, content_type, &timing);
    insert(&mut response, header::VARY, "Accept");
    Ok(response)
}

/// Whether it is a picture of which the server itself gives the address: the photo's poster, or its picture in cards.
fn is_preview(photo: &Photo, pairs: &[(String, String)], limits: &Limits) -> bool {
    let Ok(query) = ViewQuery::of_pairs(pairs.to_vec(), limits) else { return false };
    let pose = Settings::of(photo).poster_pose(&photo_options::view_box_of(&photo.options)).unwrap_or_default();
    let pose = format!("/view?{}", pose.trim_end_matches('&')).parse().ok().and_then(|uri| ViewQuery::read(&uri, limits).ok());
    let is_small = query.w.is_some() && [query.w, query.h].into_iter().flatten().all(|side| side <= PICTURE);
    query.format == Some(PictureFormat::Jpeg) && is_small && pose == Some(query.canonical())
}

/// Records the times of the phases.
fn count(app: &App, timing: &[(&'static str, Duration)]) {
    // a cached scene would make decoding look cheap
    for (phase, took) in timing.iter().filter(|(_, took)| !took.is_zero()) {
        app.telemetry.view(phase, *took);
    }
}

/// Renders and encodes a view; also returns the time of each phase.
async fn draw(
    app: &App,
    (photo, done): (&Photo, &FinishedPhoto),
    query: &ViewQuery,
    size: (u32, u32),
    format: PictureFormat,
) -> Result<(Vec<u8>, Vec<(&'static str, Duration)>), Problem> {
    // cancelled when the client goes away; rendering then stops after the current view
    let gone = CancellationToken::new();
    let renderer = Unless { gone: gone.clone(), renderer: Arc::clone(&app.renderer) };
    let _guard = gone.drop_guard();
    let asked = Instant::now();
    // decode inside the slot, so that waiting requests hold no scene
    let slot = app.pool.enter(WorkClass::Interactive, done.scene_bytes()).await?;
    let waited = asked.elapsed();
    let (scene, decoding) = app.scene(photo, &slot).await?;
    let (camera, rig) = (query.camera(&scene, size), query.rig(&scene));
    let drawn = slot.run(move || {
        let start = Instant::now();
        let view = match &rig {
            Some(rig) => draw_multiview(&renderer, &scene, &camera, rig),
            None => renderer.render(&scene, &camera),
        };
        let view = view.map_err(|e| Problem::from(&e))?;
        let rendered = Instant::now();
        let bytes = encode(&view, format, DEFAULT_QUALITY).map_err(|e| Problem::from(&e))?;
        Ok::<_, Problem>((bytes, rendered - start, rendered.elapsed()))
    });
    let (bytes, rendering, encoding) = drawn.await??;
    // a cached scene took no decoding
    let timing = vec![("decode", decoding.unwrap_or_default()), ("wait", waited), ("render", rendering), ("encode", encoding)];
    Ok((bytes, timing))
}

/// Renders unless the client has gone.
struct Unless {
    gone: CancellationToken,
    renderer: Arc<dyn Renderer>,
}

impl Renderer for Unless {
    fn name(&self) -> &'static str {
        self.renderer.name()
    }

    fn render(&self, scene: &Arc<Scene>, camera: &Camera) -> Result<View, RenderError> {
        if self.gone.is_cancelled() { Err(RenderError::Cancelled) } else { self.renderer.render(scene, camera) }
    }
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    #[test]
    fn formats_by_accept() {
        let with = |accept: &str| negotiate(&[(header::ACCEPT, HeaderValue::from_str(accept).unwrap())].into_iter().collect());
        assert_eq!(negotiate(&HeaderMap::new()), Some(PictureFormat::Png));
        assert_eq!(with("*/*"), Some(PictureFormat::Png));
        assert_eq!(with("image/jpeg"), Some(PictureFormat::Jpeg));
        assert_eq!(with("image/webp;q=0.9, image/*;q=0.5"), Some(PictureFormat::WebP));
        assert_eq!(with("image/png;q=0, */*"), Some(PictureFormat::Jpeg));
        assert_eq!(with("text/html"), None);
    }
}
