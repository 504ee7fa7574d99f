//! Doors to what reads requests, for [`crate::fuzzing`].

use axum::http::{HeaderMap, Uri};

use super::Limits;
use super::conditional::{Wanted, wanted};
use super::routes::ViewQuery;
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
