//! Exports the photo and its depth map side by side in one picture (RGB-D), for light-field displays.

use image::ExtendedColorType;

use super::ExportError;
use super::ora::png;
use super::visible_surface::visible_disparity;
use tmpi_core::Scene;

/// Writes a PNG of twice the photo's width: the photo, and at its right the disparity of what it shows as grey of 8 bits; white is nearest.
///
/// # Errors
/// [`ExportError::Picture`].
pub fn rgbd(scene: &Scene) -> Result<Vec<u8>, ExportError> {
    let (photo, map) = (&scene.photo, visible_disparity(scene));
    let width = photo.width as usize;
    let rows = photo.rgb.chunks_exact(width).zip(map.delta.chunks_exact(width));
    let grey = |d: &f32| [(d * 255.0).round() as u8; 3];
    let rgb: Vec<[u8; 3]> = rows.flat_map(|(colours, depth)| colours.iter().copied().chain(depth.iter().map(grey))).collect();
    png(rgb.as_flattened(), 2 * photo.width, photo.height, ExtendedColorType::Rgb8)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::super::testing;
    use super::*;
    use tmpi_core::Photo;
    use tmpi_pipeline::depth::DepthError;
    use tmpi_pipeline::photo::Limits;
    use tmpi_pipeline::{Denoise, Models, Options, Silent, Stereo, Switch, make};

    #[test]
    fn the_picture_is_read_back_as_photo_and_depth() {
        let scene = &testing::sample().1;
        let file = rgbd(scene).unwrap();
        let models = Models { depth: Arc::new(("none", |_: &Photo| Err(DepthError::NotEmbedded))), theta: None, psi: None };
        let options = Options { stereo: Stereo::Rgbd, denoise: Denoise::Off, snap: Switch::Off, ..Options::default() };
        let made = make(&models, &Limits::default(), &file, None, &options, &Silent).unwrap();
        assert_eq!((made.report.width, made.report.input.depth.unwrap().source.as_str()), (scene.photo.width, "rgbd"));
        let want = visible_disparity(scene).delta;
        let worst = made.disparity.delta.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst <= 0.5 / 255.0 + 1e-6, "{worst}");
        assert!(want.iter().any(|d| *d > 0.8) && want.iter().any(|d| *d < 0.05));
    }
}
