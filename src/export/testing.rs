//! A small processed photo for this module's unit tests.

use std::sync::{Arc, OnceLock};

use tmpi_core::container::{decode, encode_jpeg};
use tmpi_core::{DisparityMap, Photo, Scene};
use tmpi_pipeline::depth::{DepthError, to_png};
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::{Models, Options, Silent, make};

/// Container and scene of a box in front of a ground that reaches from the camera to the horizon, with the sky at infinity.
pub(super) fn sample() -> &'static (Vec<u8>, Scene) {
    static SAMPLE: OnceLock<(Vec<u8>, Scene)> = OnceLock::new();
    SAMPLE.get_or_init(|| {
        let (width, height) = (150u32, 110u32);
        let inside = |x: u32, y: u32| (50..90).contains(&x) && (40..85).contains(&y);
        let photo =
            Photo::from_fn(
                width,
                height,
                |x, y| {
                    if inside(x, y) { [220, 140, (x * 3) as u8] } else { [(y * 2) as u8, 90 + (x / 2) as u8, 160] }
                },
            );
        let ground = |y: u32| (f64::from(y) - 30.0).max(0.0) / 120.0;
        let depth = to_png(&DisparityMap::from_fn(width, height, |x, y| if inside(x, y) { 0.9 } else { ground(y) as f32 })).unwrap();
        let photo = encode_jpeg(width, height, photo.rgb.as_flattened(), 92).unwrap();
        // the photo comes with a depth map
        let models = Models { depth: Arc::new(("none", |_: &Photo| Err(DepthError::NotEmbedded))), theta: None, psi: None };
        let made = make(&models, &Limits::default(), &photo, Some(&depth), &Options::default(), &Silent).unwrap();
        let scene = decode(&made.container).unwrap();
        (made.container, scene)
    })
}
