//! Entry points of the request parsers, for the fuzz targets.

use axum::body::Body;
use axum::extract::{FromRequest, Multipart, Request};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Uri, header};

use super::access::{link_of_url, query_of, take_link};
use super::conditional::{RequestedRange, requested_range};
use super::exports::Recipe;
use super::hosts::origin;
use super::multipart_header_limit::LimitedHeaders;
use super::proxies::{Network, Proxies, X_FORWARDED_FOR};
use super::request_body::json_parameters;
use super::routes::{ViewQuery, decode};
use super::viewer_settings::Settings;
use super::{Limits, photo_options};
use tmpi_core::{Grid, Intrinsics, Photo, Scene, Texels, ViewBox};

/// Reads a query for a view of a photo of 60 × 40 pixels.
pub fn view(query: &str) {
    let Ok(uri) = format!("/v1/photos/x/view?{query}").parse() else { return };
    let limits = Limits::default();
    let query = match ViewQuery::read(&uri, &limits) {
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
        view_box: ViewBox::cube(0.03),
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

/// Reads an order of a file or film of a photo of 60 × 40 pixels: its query, and its body in JSON if it has one.
pub fn export_order(query: &str, body: &[u8]) {
    let Ok(uri) = format!("/v1/photos/x/exports?{query}").parse() else { return };
    let limits = Limits::default();
    let read = || {
        let mut pairs = decode(&uri)?;
        if !body.is_empty() {
            pairs.extend(json_parameters(body)?);
        }
        Recipe::read(pairs, (60, 40), &limits)
    };
    match read() {
        Ok(recipe) => {
            let text = recipe.text();
            assert!(Recipe::kind(&text).is_some(), "{text} has no format");
            // the job reads what the order wrote
            assert!(Recipe::parse(&text, &limits).is_ok_and(|again| again.text() == text), "{text} is read as another order");
            if let Recipe::Film(_, (width, height)) = recipe {
                assert!(width > 0 && height > 0);
            }
        }
        Err(problem) => assert!(problem.status == 400 && !problem.detail.is_empty()),
    }
}

/// Reads a header `Range` for `length` bytes.
pub fn range(value: &str, length: usize) {
    let Ok(value) = HeaderValue::from_str(value) else { return };
    if let RequestedRange::Part(r) = requested_range(&HeaderMap::from_iter([(header::RANGE, value)]), "\"tag\"", length) {
        assert!(r.start < r.end && r.end <= length);
    }
}

/// Reads the options of a form whose boundary is `x`.
pub fn multipart(body: &[u8]) {
    // in pieces, as a connection delivers them
    let pieces: Vec<_> = body.chunks(7).map(|piece| Ok::<_, std::io::Error>(bytes::Bytes::copy_from_slice(piece))).collect();
    let bounded = LimitedHeaders::new(futures_util::stream::iter(pieces), "x");
    let mut request = Request::new(Body::from_stream(bounded));
    request.headers_mut().insert(header::CONTENT_TYPE, HeaderValue::from_static("multipart/form-data; boundary=x"));
    let Ok(runtime) = tokio::runtime::Builder::new_current_thread().build() else { return };
    runtime.block_on(async {
        let Ok(mut form) = Multipart::from_request(request, &()).await else { return };
        let mut read = tmpi_pipeline::Options::default();
        while let Ok(Some(field)) = form.next_field().await {
            let name = field.name().unwrap_or_default().to_owned();
            let Ok(value) = field.text().await else { return };
            if let Err(problem) = photo_options::set(&mut read, &name, &value) {
                assert!(problem.status == 400 && problem.field.is_some());
            }
        }
        let text = photo_options::to_text(&read);
        assert!(
            photo_options::from_text(&text).is_ok_and(|again| photo_options::to_text(&again) == text),
            "options are read otherwise than written"
        );
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

/// Reads a request's client, scheme and host from the headers of proxies: `X-Forwarded-For` twice, `X-Forwarded-Proto`, `Host`.
pub fn forwarded(values: [&str; 4]) {
    let names = [X_FORWARDED_FOR, X_FORWARDED_FOR, HeaderName::from_static("x-forwarded-proto"), header::HOST];
    let headers: HeaderMap =
        names.into_iter().zip(values).filter_map(|(name, value)| Some((name, HeaderValue::from_str(value).ok()?))).collect();
    let (near, far) = ([10, 0, 0, 1].into(), [192, 0, 2, 1].into());
    let Ok(private) = "private".parse::<Network>() else { unreachable!("tests read it") };
    let proxies = Proxies::new(&[private]);
    assert_eq!(proxies.client(far, &headers), far, "a stranger is believed");
    let client = proxies.client(near, &headers);
    assert_eq!(client, client.to_canonical());
    if let Some(origin) = origin(&headers) {
        let uri = origin.parse::<Uri>();
        assert!(uri.is_ok_and(|u| u.authority().is_some()), "{origin} is no origin");
    }
}

/// Takes the link out of a URL, and checks that the rest has none and that the link survives writing and reading. Also reads the link in
/// the URL that its parameter `url` names.
pub fn link(url: &str) {
    let Ok(uri) = url.parse() else { return };
    if let Some((rest, link)) = take_link(&uri) {
        assert!(take_link(&rest).is_none(), "{rest} still has a link");
        if let Some(link) = link {
            let query = query_of(&link);
            let again = format!("/x?{query}").parse().ok().and_then(|uri| take_link(&uri)).and_then(|(_, link)| link);
            assert_eq!(again.map(|l| query_of(&l)), Some(query));
        }
    }
    let _ = link_of_url(&uri);
}
