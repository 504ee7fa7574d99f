//! Photos: files of every kind and shape through the whole way, and the view from the reference camera against the photo.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use image::{ImageFormat, Rgb, RgbImage};
use tmpi_testing::jpeg::{Jpeg, components, smooth};
use tmpi_testing::pictures::{encoded, noise, waves};
use tmpi_testing::png::{Png, chunk};

use super::scenes::own_camera;
use super::{Checked, Hosts};
use crate::oracle_depth;
use tmpi_core::container;
use tmpi_core::{DisparityMap, Photo, Pose, Scene};
use tmpi_pipeline::Silent;
use tmpi_pipeline::depth::{DepthError, Estimator};
use tmpi_pipeline::photo::{Decoded, Limits, PhotoError, decode};
use tmpi_pipeline::{self, Models, Options};
use tmpi_render::Renderer;

const FAMILY: &str = "photos";

/// Depth by brightness: edges wherever the photo has them, for photos of any shape, without a network.
pub(super) struct Brightness;

impl Estimator for Brightness {
    fn name(&self) -> &'static str {
        "brightness"
    }

    fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        let delta = photo.rgb.iter().map(|p| p.iter().map(|&v| f32::from(v)).sum::<f32>() / 765.0).collect();
        Ok(DisparityMap { width: photo.width, height: photo.height, delta })
    }
}

/// A sample of a channel at a place, 0 to 1.
type Sample = fn(usize, u32, u32) -> f64;

/// A WebP animation of one frame of 16×8.
fn animated() -> Vec<u8> {
    let still = encoded(RgbImage::from_fn(16, 8, |x, _| Rgb(if x % 2 == 0 { [200, 30, 90] } else { [20, 90, 230] })), ImageFormat::WebP);
    let mut out = b"RIFF\0\0\0\0WEBPVP8X\x0a\0\0\0\x02\0\0\0\x0f\0\0\x07\0\0ANIM\x06\0\0\0\0\0\0\0\0\0ANMF".to_vec();
    out.extend((16 + still.len() as u32 - 12).to_le_bytes());
    out.extend([0, 0, 0, 0, 0, 0, 0x0f, 0, 0, 0x07, 0, 0, 100, 0, 0, 0]);
    out.extend(&still[12..]);
    let length = (out.len() - 8) as u32;
    out[4..8].copy_from_slice(&length.to_le_bytes());
    out
}

/// A PNG header that promises a picture, with next to nothing behind it.
fn promise(w: u32, h: u32) -> Vec<u8> {
    let header = [&w.to_be_bytes()[..], &h.to_be_bytes(), &[8, 2, 0, 0, 0]].concat();
    let chunks = [chunk(b"IHDR", &header), chunk(b"IDAT", &[0x78, 0x9c, 0x63, 0, 0]), chunk(b"IEND", &[])];
    [&b"\x89PNG\r\n\x1a\n"[..], &chunks.concat()].concat()
}

/// A JPEG that says it was taken with a focal length of so many millimetres, as a double.
fn with_focal(millimetres: f64) -> Vec<u8> {
    let mut exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x69\x87\x04\0\x01\0\0\0\x1a\0\0\0\0\0\0\0".to_vec();
    exif.extend(b"\x01\0\x05\xa4\x0c\0\x01\0\0\0\x2c\0\0\0\0\0\0\0");
    exif.extend(millimetres.to_le_bytes());
    Jpeg { segments: vec![(0xE1, exif)], ..Jpeg::new(40, 24, components(&[(1, 1); 3])) }.write(smooth)
}

fn readable() -> Vec<(String, Vec<u8>)> {
    let sides = [(1, 1), (1, 2000), (2000, 1), (1, 16_384), (16_384, 1), (63, 63), (65, 65), (64, 64), (7, 200)];
    let mut all: Vec<(String, Vec<u8>)> = sides.into_iter().map(|(w, h)| (format!("{w}×{h}"), waves(w, h))).collect();
    let blocks: Sample = |c, x, y| noise(x / 7, y / 5 + 100 * c as u32).into();
    let png =
        |depth, colour, sample: Sample| Png { width: 70, height: 50, depth, colour, interlaced: false, chunks: Vec::new() }.write(sample);
    let jpeg = |sampling: &[(u8, u8)]| Jpeg::new(70, 50, components(sampling)).write(smooth);
    let rest: [(&str, Vec<u8>); 10] = [
        ("greyscale JPEG", jpeg(&[(1, 1)])),
        ("greyscale PNG", png(8, 0, blocks)),
        ("palette", png(8, 3, blocks)),
        ("16 bits", png(16, 2, blocks)),
        ("CMYK JPEG", jpeg(&[(1, 1); 4])),
        ("alpha", png(8, 6, blocks)),
        ("wholly transparent", png(8, 6, |_, _, _| 0.0)),
        ("animated", animated()),
        ("all black", png(8, 2, |_, _, _| 0.0)),
        ("one colour", png(8, 2, |c, _, _| [0.8, 0.04, 0.35][c])),
    ];
    all.extend(rest.map(|(name, bytes)| (name.to_owned(), bytes)));
    all
}

pub(super) fn run(checked: &mut Checked, hosts: &Hosts) {
    let models = oracle_depth::models(Brightness);
    for (name, file) in readable() {
        let scene = made(&models, &file, &Options::default());
        for host in &hosts.all {
            let bound = if host.name() == "gpu" { 1.0 } else { 0.0 };
            checked.case(FAMILY, &name, host.name(), "levels", bound, || identity(scene.as_ref(), host.as_ref()));
        }
    }
    decoder(checked, |file| decode(file, &Limits::default(), None));
}

/// `kernel` decodes a photo.
pub(super) fn decoder(checked: &mut Checked, kernel: impl Fn(&[u8]) -> Result<Decoded, PhotoError>) {
    refusals(checked, &kernel);
    for focal in [0.0, f64::NAN, 1e9, -50.0, f64::INFINITY] {
        checked.case(FAMILY, &format!("EXIF focal length of {focal} mm"), "decoder", "px from default", 0.0, || {
            kernel(&with_focal(focal)).map_or(f64::INFINITY, |d| (d.intrinsics.fx - 0.58 * 40.0).abs())
        });
    }
    checked.case(FAMILY, "EXIF focal length of 27 mm", "decoder", "px", 1e-9, || {
        kernel(&with_focal(27.0)).map_or(f64::INFINITY, |d| (d.intrinsics.fx - 30.0).abs())
    });
}

/// The scene that a reader finds in the container of a photo; none where the photo was not made.
pub(super) fn made(models: &Models, file: &[u8], options: &Options) -> Option<Arc<Scene>> {
    let make = || tmpi_pipeline::make(models, &Limits::default(), file, None, options, &Silent);
    let made = catch_unwind(AssertUnwindSafe(make)).ok()?.ok()?;
    container::decode(&made.container).ok().map(Arc::new)
}

/// Largest difference between the view from the reference camera and the photo that the container carries, in levels.
pub(super) fn identity(scene: Option<&Arc<Scene>>, host: &dyn Renderer) -> f64 {
    let Some(scene) = scene else { return f64::INFINITY };
    let Ok(view) = host.render(scene, &own_camera(scene, Pose::default())) else { return f64::INFINITY };
    let off = |(p, q): (&[u8; 4], &[u8; 3])| (0..4).map(|c| p[c].abs_diff(if c < 3 { q[c] } else { 255 })).max().unwrap_or(0);
    view.rgba.iter().zip(&scene.photo.rgb).map(off).max().unwrap_or(u8::MAX).into()
}

/// Whether an error is the one that was wanted.
type Wanted<'a> = &'a dyn Fn(&PhotoError) -> bool;

/// Files that are no photo or too much of one.
fn refusals(checked: &mut Checked, kernel: impl Fn(&[u8]) -> Result<Decoded, PhotoError>) {
    let whole = waves(33, 17);
    let photo = Jpeg::new(33, 17, components(&[(1, 1); 3])).write(smooth);
    let too_large = |e: &PhotoError| matches!(e, PhotoError::SideTooLong { .. } | PhotoError::TooManyPixels { .. });
    let any = |_: &PhotoError| true;
    let files: [(&str, Vec<u8>, Wanted); 8] = [
        ("1×20 000", promise(1, 20_000), &too_large),
        ("20 000×1", promise(20_000, 1), &too_large),
        ("decompression bomb, 16 000×16 000", promise(16_000, 16_000), &too_large),
        ("promised 2000×2000, has nothing", promise(2000, 2000), &any),
        ("truncated PNG", whole[..whole.len() / 2].to_vec(), &any),
        ("truncated JPEG", photo[..photo.len() / 2].to_vec(), &any),
        ("empty", Vec::new(), &any),
        ("text", b"a photo of a cat".to_vec(), &any),
    ];
    for (name, file, wanted) in files {
        checked.case(FAMILY, &format!("{name} is refused"), "decoder", "accepted", 0.0, || {
            f64::from(u8::from(!kernel(&file).is_err_and(|e| wanted(&e))))
        });
    }
}
