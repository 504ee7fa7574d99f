//! Doors to what reads requests, for [`crate::fuzzing`].

use axum::body::Body;
use axum::extract::{FromRequest, Multipart, Request};
use axum::http::{HeaderMap, HeaderValue, Uri, header};

use super::Limits;
use super::conditional::{Wanted, wanted};
use super::file_name::file_name;
use super::form::Bounded;
use super::options;
use super::routes::ViewQuery;
use super::settings::Settings;
use tmpi_core::{Grid, Intrinsics, Photo, Scene, Texels, ViewBox};

/// Reads a query for a view of a photo of 60 × 40 pixels.
pub fn view(uri: &Uri) {
    let limits = Limits::default();
    let query = match ViewQuery::read(uri, &limits) {
        Ok(query) => query,
        Err(problem) => {
            assert!(problem.status == 400 && !problem.detail.is_empty());
            return;
        }
    };
    let (width, height) = (60, 40);
    let Ok(size) = query.size((width, height), &limits) else { return };
    assert!(size.0 > 0 && size.1 > 0 && u64::from(size.0) * u64::from(size.1) <= limits.view_pixels, "{size:?}");
    let scene = Scene {
        grid: Grid::new(width, height, 64),
        intrinsics: Intrinsics::centred(width, height, 30.0),
        view_box: ViewBox::default(),
        photo: Photo { width, height, rgb: vec![[0; 3]; 2400] },
        layers: Vec::new(),
        texels: Texels::default(),
    };
    let camera = query.camera(&scene, size);
    let p = camera.pose;
    assert!([p.tx, p.ty, p.tz, p.yaw, p.pitch, p.roll].iter().all(|v| v.is_finite()));
    assert!(camera.intrinsics.is_valid());
    let _ = (query.rig(&scene), query.canonical());
}

/// Reads a range of `length` bytes.
pub fn range(headers: &HeaderMap, length: usize) {
    if let Wanted::Part(r) = wanted(headers, "\"tag\"", length) {
        assert!(r.start < r.end && r.end <= length);
    }
}

/// Reads the options of a form whose boundary is `x`.
pub fn multipart(body: &[u8]) {
    // in pieces, as they come
    let pieces: Vec<_> = body.chunks(7).map(|piece| Ok::<_, std::io::Error>(bytes::Bytes::copy_from_slice(piece))).collect();
    let bounded = Bounded::new(futures_util::stream::iter(pieces), "x");
    let mut request = Request::new(Body::from_stream(bounded));
    request.headers_mut().insert(header::CONTENT_TYPE, HeaderValue::from_static("multipart/form-data; boundary=x"));
    let Ok(runtime) = tokio::runtime::Builder::new_current_thread().build() else { return };
    runtime.block_on(async {
        let Ok(mut form) = Multipart::from_request(request, &()).await else { return };
        let mut read = tmpi_pipeline::Options::default();
        while let Ok(Some(field)) = form.next_field().await {
            let name = field.name().unwrap_or_default().to_owned();
            let _ = file_name(field.headers());
            let Ok(value) = field.text().await else { return };
            if let Err(problem) = options::set(&mut read, &name, &value) {
                assert!(problem.status == 400 && problem.field.is_some());
            }
        }
        let text = options::to_text(&read);
        assert!(options::from_text(&text).is_ok_and(|again| options::to_text(&again) == text), "options are read otherwise than written");
    });
}

/// Reads a merge patch.
pub fn patch(patch: &[u8]) {
    match Settings::default().patched(patch) {
        Ok(settings) => {
            let written = serde_json::to_vec(&settings).unwrap_or_default();
            assert!(serde_json::from_slice::<Settings>(&written).is_ok_and(|read| read == settings));
            assert_eq!(settings.patched(b"{}").as_ref(), Ok(&settings));
        }
        Err(problem) => assert!(problem.status == 400 && !problem.detail.is_empty()),
    }
}
