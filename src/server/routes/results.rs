//! What was made of a photo: container, depth, report, thumbnail.

use axum::extract::State;
use axum::http::{HeaderMap, Uri};
use axum::response::Response;

use super::path_photo::PathPhoto;
use super::query::{OnlyVersion, Pairs};
use crate::server::app_state::{App, AppState, DiskFullPolicy, StoredFile};
use crate::server::conditional::{ContentCoding, Entity, cache_control_for, respond};
use crate::server::problem::Problem;
use tmpi_core::Rect;
use tmpi_core::container::{LEVELS, MEDIA_TYPE, SECTIONS};
use tmpi_library::{Part, Photo};
use tmpi_pipeline::strokes;

/// The container of a photo.
///
/// Its index says where each section lies, so that you can fetch sections one by one with `Range`, or choose those of a smaller container
/// with `sections`. The entity tag is strong and differs for every level and choice of sections.
/// A smaller level has the same planes over a photo of half, a quarter or an eighth of the size. With `region` it is the container of
/// the fewest whole tiles that cover a rectangle of the photo, at the same poses; the photo is encoded again, as in levels.
#[utoipa::path(
    get, path = "/v1/photos/{id}/atlas", tag = "photos",
    params(
        ("level" = Option<u8>, Query, description = "0 (default): the photo's own size, 1: half of it, 2: a quarter, 3: an eighth"),
        ("fit" = Option<u16>, Query, description = "Instead of a level: the smallest whose longer side, or that of `region`, has at least \
            this many pixels"),
        ("region" = Option<String>, Query, description = "`x,y,w,h` in pixels of the photo at its own size: only the tiles over it. The \
            answer's principal point is the whole photo's less the corner of the answer",
            example = "512,512,512,512"),
        ("sections" = Option<String>, Query, description = "Sections of the container, separated by commas: `index` (always included), \
            `photo`, `planes`, `labels`, `alpha` and `hidden`; all if it is not given. Sections that the photo does not have are left out",
            example = "photo"),
        ("v" = Option<String>, Query, description = "Version as in the photo's `links`: browsers cache the answer for a year; without it, \
            or if the photo has another version now, they revalidate"),
        ("Range" = Option<String>, Header, description = "One range of bytes"),
        ("If-Range" = Option<String>, Header, description = "Entity tag that the range belongs to"),
        ("If-None-Match" = Option<String>, Header, description = "Entity tags that the client has"),
    ),
    responses(
        (status = 200, description = "The container", body = String, content_type = "application/vnd.tmpi",
            headers(("ETag" = String, description = "Strong entity tag"))),
        (status = 206, description = "The range", body = String, content_type = "application/vnd.tmpi",
            headers(("Content-Range" = String, description = "Which bytes of how many"))),
        (status = 304, description = "The client has it"),
        (status = 400, description = "There is no such level, region or section"),
        (status = 409, description = "Not finished yet"),
        (status = 416, description = "There are no such bytes"),
    )
)]
pub async fn atlas(State(app): State<App>, PathPhoto(photo): PathPhoto, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    // check the query first: 400 goes before 409
    let pairs = Pairs::read(&uri, &["level", "fit", "region", "sections", "v"])?;
    wanted_level(&pairs, 0)?;
    let (sections, region) = (wanted_sections(&pairs)?, pairs.typed::<Rect>("region")?);
    let (_, done) = AppState::finished(&photo)?;
    let side = region.map_or(done.width.max(done.height), |r| r.w.max(r.h));
    let level = wanted_level(&pairs, side)?;
    let cache_control = cache_control_for(pairs.get("v"), || app.version(&done));
    let file = app.container(&photo, (level, region), sections.as_deref()).await?;
    Ok(answer(file, &headers, MEDIA_TYPE, cache_control, ContentCoding::Plain))
}

/// Names of the sections in a query; `None` for all.
fn wanted_sections(pairs: &Pairs) -> Result<Option<Vec<&'static str>>, Problem> {
    let Some(list) = pairs.get("sections") else { return Ok(None) };
    let known = |name: &str| {
        let unknown = || Problem::parameter("sections", format!("there is no section {name:?}; there are {}", SECTIONS.join(", ")));
        SECTIONS.into_iter().find(|s| *s == name).ok_or_else(unknown)
    };
    list.split(',').map(known).collect::<Result<_, _>>().map(Some)
}

/// The level that a query selects; the longer side of the photo or region has `side` pixels.
fn wanted_level(pairs: &Pairs, side: u32) -> Result<u8, Problem> {
    if let Some(level) = pairs.number("level", &(0..=LEVELS))? {
        return Ok(level);
    }
    let Some(fit) = pairs.number("fit", &(1..=u16::MAX))? else { return Ok(0) };
    Ok((1..=LEVELS).take_while(|l| side >> l >= u32::from(fit)).last().unwrap_or(0))
}

/// The disparity that the photo was made with.
///
/// If strokes touched it up, `before=strokes` returns the map without them, for previews.
#[utoipa::path(
    get, path = "/v1/photos/{id}/depth", tag = "photos",
    params(
        ("before" = Option<String>, Query, pattern = "^strokes$", description = "`strokes`: the map before them, at most 640 pixels a side, and \
            before its edges were snapped to the photo's"),
        ("v" = Option<String>, Query, description = "Version as in the photo's `links`"),
    ),
    responses(
        (status = 200, description = "Grey PNG of 16 bits, δ = v / 65535, larger is nearer", body = String, content_type = "image/png"),
        (status = 304, description = "The client has it"),
        (status = 404, description = "There is no such photo, or it has no strokes"),
        (status = 409, description = "Not finished yet"),
    )
)]
pub async fn depth(State(app): State<App>, PathPhoto(photo): PathPhoto, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    let mut pairs = Pairs::read(&uri, &["before", "v"])?;
    let before = pairs.parse("before", "strokes", |text| (text == "strokes").then_some(()))?;
    if before.is_none() {
        return stored(&app, &photo, &OnlyVersion(pairs.take("v")), &headers, Part::Disparity, "image/png").await;
    }
    let (_, done) = AppState::finished(&photo)?;
    let cache_control = cache_control_for(pairs.get("v"), || app.version(&done));
    let file = app.file(&photo, Part::Disparity).await?;
    let head = file.source.head(strokes::HEAD).await.map_err(|e| Problem::store(&e))?;
    let none = || Problem::not_found("there is no map before the strokes: the photo has none");
    let (map, disk) = (strokes::before(&head).ok_or_else(none)?.to_vec(), app.temp_folder());
    let keep = tokio::task::spawn_blocking(move || StoredFile::derived(None, map, &disk, DiskFullPolicy::Memory));
    let file = keep.await.map_err(|e| Problem::internal("keeping a depth map", &e))??;
    Ok(answer(file, &headers, "image/png", cache_control, ContentCoding::Plain))
}

/// Report on how the photo was made: steps taken, steps skipped, errors and costs.
#[utoipa::path(
    get, path = "/v1/photos/{id}/report", tag = "photos",
    params(("v" = Option<String>, Query, description = "Version as in the photo's `links`")),
    responses(
        (status = 200, description = "The report", body = tmpi_pipeline::Report),
        (status = 304, description = "The client has it"),
        (status = 409, description = "Not finished yet"),
    )
)]
pub async fn report(State(app): State<App>, v: OnlyVersion, PathPhoto(photo): PathPhoto, headers: HeaderMap) -> Result<Response, Problem> {
    stored(&app, &photo, &v, &headers, Part::Report, "application/json").await
}

/// A small picture of the photo.
#[utoipa::path(
    get, path = "/v1/photos/{id}/thumbnail", tag = "photos",
    params(("v" = Option<String>, Query, description = "Version as in the photo's `links`")),
    responses(
        (status = 200, description = "JPEG of at most 320 pixels a side", body = String, content_type = "image/jpeg"),
        (status = 304, description = "The client has it"),
        (status = 409, description = "Not finished yet"),
    )
)]
pub async fn thumbnail(
    State(app): State<App>,
    v: OnlyVersion,
    PathPhoto(photo): PathPhoto,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    stored(&app, &photo, &v, &headers, Part::Thumbnail, "image/jpeg").await
}

async fn stored(app: &App, photo: &Photo, v: &OnlyVersion, headers: &HeaderMap, part: Part, kind: &str) -> Result<Response, Problem> {
    let (_, done) = AppState::finished(photo)?;
    let cache_control = cache_control_for(v.0.as_deref(), || app.version(&done));
    let file = app.file(photo, part).await?;
    let coding = if part == Part::Report { ContentCoding::Gzip } else { ContentCoding::Plain };
    Ok(answer(file, headers, kind, cache_control, coding))
}

fn answer(file: StoredFile, headers: &HeaderMap, content_type: &str, cache_control: &str, coding: ContentCoding) -> Response {
    respond(headers, Entity { source: file.source, etag: &file.etag, content_type, cache_control, coding })
}
