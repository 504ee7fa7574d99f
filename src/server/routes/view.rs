//! Rendered views of a photo.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, HeaderName, Uri, header};
use axum::response::Response;
use sha2::{Digest, Sha256};

use crate::render::{DEFAULT_QUALITY, PictureFormat, encode};
use crate::server::app::{App, Shared};
use crate::server::conditional::{Entity, insert, is_known, respond};
use crate::server::id::hex;
use crate::server::limits::Limits;
use crate::server::problem::Problem;
use crate::tmpi::{Camera, Intrinsics, Pose, Scene};

/// The same camera gives the same picture, but a newer program may draw it better.
const CACHED: &str = "public, max-age=86400";
/// Fields of view that are drawn, in degrees.
const FOV: std::ops::RangeInclusive<f64> = 0.1..=179.0;

/// Camera and format of a view.
#[derive(Clone, Copy, Debug, Default, PartialEq, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
pub struct ViewQuery {
    /// Camera to the right, in units of the nearest distance.
    pub tx: Option<f64>,
    /// Camera down.
    pub ty: Option<f64>,
    /// Camera forward.
    pub tz: Option<f64>,
    /// Degrees to the right.
    pub yaw: Option<f64>,
    /// Degrees up.
    pub pitch: Option<f64>,
    /// Degrees clockwise.
    pub roll: Option<f64>,
    /// Width in pixels; the photo's if neither `w` nor `h` is given, else by its aspect.
    #[param(minimum = 1, maximum = 16384)]
    pub w: Option<u32>,
    /// Height in pixels.
    #[param(minimum = 1, maximum = 16384)]
    pub h: Option<u32>,
    /// Horizontal field of view in degrees; that of the photo if it is not given.
    #[param(minimum = 0.1, maximum = 179.0)]
    pub fov: Option<f64>,
    /// `png`, `jpeg` or `webp`; by `Accept` if it is not given.
    #[param(value_type = Option<String>)]
    pub format: Option<PictureFormat>,
}

impl ViewQuery {
    /// Reads the query.
    ///
    /// # Errors
    /// 400 that names the first parameter that is unknown, given twice, not finite or out of range.
    pub fn read(uri: &Uri, limits: &Limits) -> Result<Self, Problem> {
        let Query(pairs) = Query::<Vec<(String, String)>>::try_from_uri(uri).map_err(|e| Problem::bad_request(e.body_text()))?;
        let mut given = BTreeMap::new();
        for (name, value) in pairs {
            if given.insert(name.clone(), value).is_some() {
                return Err(Problem::parameter(name, "is given twice"));
            }
        }
        let mut number = |name: &str| -> Result<Option<f64>, Problem> {
            let Some(text) = given.remove(name) else { return Ok(None) };
            let value = text.parse().ok().filter(|v: &f64| v.is_finite());
            value.map(Some).ok_or_else(|| Problem::parameter(name, format!("must be a finite number, not {text:?}")))
        };
        let [tx, ty, tz] = [number("tx")?, number("ty")?, number("tz")?];
        let [yaw, pitch, roll] = [number("yaw")?, number("pitch")?, number("roll")?];
        let fov = number("fov")?;
        if fov.is_some_and(|v| !FOV.contains(&v)) {
            return Err(Problem::parameter("fov", format!("must be from {} to {} degrees", FOV.start(), FOV.end())));
        }
        let mut side = |name: &str| -> Result<Option<u32>, Problem> {
            let Some(text) = given.remove(name) else { return Ok(None) };
            let value = text.parse().ok().filter(|v| (1..=limits.view_side).contains(v));
            value.map(Some).ok_or_else(|| Problem::parameter(name, format!("must be from 1 to {} pixels, not {text:?}", limits.view_side)))
        };
        let (w, h) = (side("w")?, side("h")?);
        let format = given.remove("format").map(|text| {
            let known = PictureFormat::from_extension(&text);
            known.ok_or_else(|| Problem::parameter("format", format!("must be png, jpeg or webp, not {text:?}")))
        });
        let format = format.transpose()?;
        match given.into_keys().next() {
            Some(name) => {
                Err(Problem::parameter(name, "there is no such parameter; there are tx, ty, tz, yaw, pitch, roll, w, h, fov, format"))
            }
            None => Ok(Self { tx, ty, tz, yaw, pitch, roll, w, h, fov, format }),
        }
    }

    /// Size of the view of a photo of `photo` pixels.
    ///
    /// # Errors
    /// 400 where it is over the limit of pixels; without a size in the query, a view of a larger photo is reduced instead.
    pub fn size(&self, photo: (u32, u32), limits: &Limits) -> Result<(u32, u32), Problem> {
        let (pw, ph) = (f64::from(photo.0), f64::from(photo.1));
        let side = |v: f64| (v.round() as u32).clamp(1, limits.view_side);
        let (w, h) = match (self.w, self.h) {
            (Some(w), Some(h)) => (w, h),
            (Some(w), None) => (w, side(f64::from(w) * ph / pw)),
            (None, Some(h)) => (side(f64::from(h) * pw / ph), h),
            (None, None) => {
                let scale = (limits.view_pixels as f64 / (pw * ph)).sqrt().min(1.0);
                // rounded down, so that the product stays within the limit
                return Ok(if scale < 1.0 {
                    (((pw * scale) as u32).max(1), ((ph * scale) as u32).max(1))
                } else {
                    (photo.0.min(limits.view_side), photo.1.min(limits.view_side))
                });
            }
        };
        if u64::from(w) * u64::from(h) > limits.view_pixels {
            let field = if self.w.is_some() { "w" } else { "h" };
            return Err(Problem::parameter(field, format!("{w}×{h} is over the limit of {} pixels", limits.view_pixels)));
        }
        Ok((w, h))
    }

    /// The camera.
    #[must_use]
    pub fn camera(&self, scene: &Scene, (width, height): (u32, u32)) -> Camera {
        let of = |v: Option<f64>| v.unwrap_or(0.0);
        let pose =
            Pose { tx: of(self.tx), ty: of(self.ty), tz: of(self.tz), yaw: of(self.yaw), pitch: of(self.pitch), roll: of(self.roll) };
        let intrinsics = match self.fov {
            Some(fov) => Intrinsics::from_fov_x(width, height, fov),
            None => scene.intrinsics.resized((scene.grid.width, scene.grid.height), (width, height)),
        };
        Camera { pose, intrinsics, width, height }
    }
}

/// The format that a client likes best; PNG where it has no preference. None where it takes none of them.
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
    // the most specific range that matches counts
    let quality = |format: PictureFormat| {
        let named = |name: &str| ranges.iter().find(|(n, _)| n == name).map(|(_, q)| *q);
        named(format.media_type()).or_else(|| named("image/*")).or_else(|| named("*/*")).unwrap_or(0.0)
    };
    let best = PictureFormat::ALL.map(|f| (f, quality(f))).into_iter().filter(|(_, q)| *q > 0.0);
    // the first of equals
    best.reduce(|a, b| if b.1 > a.1 { b } else { a }).map(|(f, _)| f)
}

/// A rendered view of a photo for any camera.
///
/// `Server-Timing` tells what decoding, rendering and encoding took.
#[utoipa::path(
    get, path = "/v1/photos/{id}/view", tag = "photos",
    params(("id" = String, Path, description = "Id of the photo"), ViewQuery),
    responses(
        (status = 200, description = "The view; PNG and WebP are transparent where nothing is known", content(
            (String = "image/png"), (String = "image/jpeg"), (String = "image/webp"))),
        (status = 304, description = "The client has it"),
        (status = 400, description = "A parameter is wrong; `field` names it", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such photo", body = Problem, content_type = "application/problem+json"),
        (status = 406, description = "The client takes none of the formats", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "Not finished yet", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "Too many views wait", body = Problem, content_type = "application/problem+json"),
    )
)]
pub async fn view(State(app): State<App>, Path(id): Path<String>, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    let entry = app.photo(&id)?;
    let query = ViewQuery::read(&uri, &app.limits)?;
    let (version, done) = Shared::done(&entry)?;
    let size = query.size((done.width, done.height), &app.limits)?;
    let format = query.format.or_else(|| negotiate(&headers)).ok_or_else(|| {
        let status = axum::http::StatusCode::NOT_ACCEPTABLE;
        Problem::new(status, "not-acceptable", "views are image/png, image/jpeg or image/webp").field("Accept")
    })?;
    let what = format!("{} {} {size:?} {format:?} {query:?}", env!("CARGO_PKG_VERSION"), done.atlas_hash);
    let etag = format!("\"{}\"", hex(&Sha256::digest(what)[..16]));
    let mut timing = Vec::new();
    let bytes = if is_known(&headers, &etag) {
        bytes::Bytes::new()
    } else {
        let (scene, decoding) = app.scene(version).await?;
        let camera = query.camera(&scene, size);
        let renderer = std::sync::Arc::clone(&app.renderer);
        let asked = Instant::now();
        let drawn = app.pool.run(move || {
            let start = Instant::now();
            let waited = start - asked;
            let view = renderer.render(&scene, &camera).map_err(|e| Problem::from(&e))?;
            let rendered = Instant::now();
            let bytes = encode(&view, format, DEFAULT_QUALITY).map_err(|e| Problem::from(&e))?;
            Ok::<_, Problem>((bytes, waited, rendered - start, rendered.elapsed()))
        });
        let (bytes, waiting, rendering, encoding) = drawn.await??;
        // a scene at hand took no decoding
        timing.push(("decode", decoding.unwrap_or_default()));
        timing.extend([("wait", waiting), ("render", rendering), ("encode", encoding)]);
        bytes.into()
    };
    // a scene that was at hand would make decoding look cheap
    for (phase, took) in timing.iter().filter(|(_, took)| !took.is_zero()) {
        app.telemetry.view(phase, *took);
    }
    let entity = Entity { bytes, etag: &etag, content_type: format.media_type(), cache_control: CACHED };
    let mut response = respond(&headers, entity);
    insert(&mut response, header::VARY, "Accept");
    if !timing.is_empty() {
        insert(&mut response, HeaderName::from_static("server-timing"), &server_timing(&timing));
    }
    Ok(response)
}

fn server_timing(phases: &[(&str, Duration)]) -> String {
    let all: Vec<String> = phases.iter().map(|(name, d)| format!("{name};dur={:.2}", d.as_secs_f64() * 1e3)).collect();
    all.join(", ")
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    fn read(query: &str) -> Result<ViewQuery, Problem> {
        ViewQuery::read(&format!("/view?{query}").parse().unwrap(), &Limits::default())
    }

    #[test]
    fn wrong_parameters_are_named() {
        for (query, field) in [
            ("tx=NaN", "tx"),
            ("ty=inf", "ty"),
            ("tz=-Infinity", "tz"),
            ("yaw=left", "yaw"),
            ("pitch=", "pitch"),
            ("roll=1e999", "roll"),
            ("w=0", "w"),
            ("w=16385", "w"),
            ("h=-1", "h"),
            ("h=1.5", "h"),
            ("fov=0.09", "fov"),
            ("fov=179.1", "fov"),
            ("fov=NaN", "fov"),
            ("format=gif", "format"),
            ("yew=3", "yew"),
            ("tx=1&tx=2", "tx"),
        ] {
            let p = read(query).unwrap_err();
            assert_eq!((p.status, p.field.as_deref()), (400, Some(field)), "{query}: {}", p.detail);
        }
    }

    #[test]
    fn sizes_at_the_limit_and_one_over() {
        let limits = Limits { view_pixels: 1000, view_side: 100, ..Limits::default() };
        let size = |w, h| ViewQuery { w, h, ..ViewQuery::default() }.size((60, 30), &limits);
        assert_eq!(size(Some(100), Some(10)).unwrap(), (100, 10));
        assert_eq!(size(Some(91), Some(11)).unwrap_err().field.as_deref(), Some("w"));
        assert_eq!(size(Some(40), None).unwrap(), (40, 20));
        assert_eq!(size(None, Some(10)).unwrap(), (20, 10));
        let (w, h) = size(None, None).unwrap();
        assert!(w * h <= 1000 && w * h > 800, "{w}×{h}");
        assert!(ViewQuery::read(&"/view?w=101".parse().unwrap(), &limits).is_err());
        assert!(ViewQuery::read(&"/view?w=100".parse().unwrap(), &limits).is_ok());
    }

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
