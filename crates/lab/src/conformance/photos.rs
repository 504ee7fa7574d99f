//! Photos: files of every kind and shape through the whole way; what is decoded, and the view from the reference camera, against the formula
//! that the file was written from.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use image::{ImageFormat, Rgb, RgbImage};
use tmpi_testing::jpeg::{Jpeg, components, smooth};
use tmpi_testing::pictures::{encoded, noise, wave, waves};
use tmpi_testing::png::{Png, chunk};

use super::scenes::own_camera;
use super::{Checked, Host};
use crate::oracle_depth;
use tmpi_core::{DisparityMap, Photo, Pose, Scene, container};
use tmpi_pipeline::photo::{Decoded, Limits, PhotoError, decode};
use tmpi_pipeline::{self, Models, Options, Silent};
use tmpi_render::Renderer;

const FAMILY: &str = "photos";

/// Depth by brightness: edges wherever the photo has them, for photos of any shape, without a network.
pub(super) fn by_brightness() -> Models {
    let estimate = |photo: &Photo| {
        let delta = photo.rgb.iter().map(|p| p.iter().map(|&v| f32::from(v)).sum::<f32>() / 765.0).collect();
        Ok(DisparityMap { width: photo.width, height: photo.height, delta })
    };
    oracle_depth::models(("brightness", estimate))
}

/// Colour of a pixel, 0 to 255.
type Truth = Box<dyn Fn(u32, u32) -> [f64; 3]>;

/// A sample of a channel at a place, 0 to 1.
type Sample = fn(usize, u32, u32) -> f64;

/// Columns of two colours in turn.
fn columns(x: u32) -> [u8; 3] {
    if x.is_multiple_of(2) { [200, 30, 90] } else { [20, 90, 230] }
}

/// A WebP animation of one frame of 16×8.
fn animated() -> Vec<u8> {
    let still = encoded(RgbImage::from_fn(16, 8, |x, _| Rgb(columns(x))), ImageFormat::WebP);
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

/// A file, and what its pixels are by the formula that it was written from.
struct File {
    name: String,
    bytes: Vec<u8>,
    truth: Truth,
    /// Levels that a decoded pixel may be off.
    decoded: f64,
    /// Levels, root mean square, that the view may be off: what is lost in the container's photo.
    view: f64,
}

/// Levels, root mean square, that the container's photo may be off: 1.96 at most were found.
const LOSS: f64 = 2.5;
/// The same of noise: 6.3 at most were found.
const NOISE_LOSS: f64 = 8.0;

fn readable() -> Vec<File> {
    let file =
        |name: &str, bytes: Vec<u8>, decoded: f64, view: f64, truth: Truth| File { name: name.to_owned(), bytes, truth, decoded, view };
    let sides = [(1, 1), (1, 2000), (2000, 1), (1, 16_384), (16_384, 1), (63, 63), (65, 65), (64, 64), (7, 200)];
    let waves = sides.map(|(w, h)| file(&format!("{w}×{h}"), waves(w, h), 0.0, LOSS, Box::new(|x, y| wave(x, y).map(f64::from))));
    let blocks: Sample = |c, x, y| noise(x / 7, y / 5 + 100 * c as u32).into();
    let one: Sample = |c, _, _| [0.8, 0.04, 0.35][c];
    let png =
        |depth, colour, sample: Sample| Png { width: 70, height: 50, depth, colour, interlaced: false, chunks: Vec::new() }.write(sample);
    let jpeg = |sampling: &[(u8, u8)]| Jpeg::new(70, 50, components(sampling)).write(smooth);
    let at = |v: u32| f64::from(v) + 0.5;
    let grey: fn(Sample) -> Truth = |sample| Box::new(move |x, y| [255.0 * sample(0, x, y); 3]);
    let rgb: fn(Sample) -> Truth = |sample| Box::new(move |x, y| [0, 1, 2].map(|c| 255.0 * sample(c, x, y)));
    // samples are rounded once; with alpha, colours and alpha are, and 1.11 was found; of JPEG, 1.7
    let (rounded, blended, coded) = (0.51, 1.2, 2.5);
    let over = move |x, y| [0, 1, 2].map(|c| 255.0 * (1.0 - blocks(3, x, y) * (1.0 - blocks(c, x, y))));
    let inks = move |x, y| [0, 1, 2].map(|c| smooth(c, at(x), at(y)) * smooth(3, at(x), at(y)) / 255.0);
    let rest = [
        file("greyscale JPEG", jpeg(&[(1, 1)]), coded, LOSS, Box::new(move |x, y| [smooth(0, at(x), at(y)); 3])),
        file("greyscale PNG", png(8, 0, blocks), rounded, NOISE_LOSS, grey(blocks)),
        file("palette", png(8, 3, blocks), rounded, NOISE_LOSS, grey(blocks)),
        file("16 bits", png(16, 2, blocks), rounded, NOISE_LOSS, rgb(blocks)),
        file("CMYK JPEG", jpeg(&[(1, 1); 4]), coded, LOSS, Box::new(inks)),
        file("alpha", png(8, 6, blocks), blended, NOISE_LOSS, Box::new(over)),
        file("wholly transparent", png(8, 6, |_, _, _| 0.0), 0.0, LOSS, Box::new(|_, _| [255.0; 3])),
        file("animated", animated(), 0.0, NOISE_LOSS, Box::new(|x, _| columns(x).map(f64::from))),
        file("all black", png(8, 2, |_, _, _| 0.0), 0.0, LOSS, Box::new(|_, _| [0.0; 3])),
        file("one colour", png(8, 2, one), rounded, LOSS, rgb(one)),
    ];
    waves.into_iter().chain(rest).collect()
}

/// Differences between the colours of a picture of this width and a formula, in levels.
fn off<const N: usize>(pixels: &[[u8; N]], width: u32, truth: impl Fn(u32, u32) -> [f64; 3]) -> Vec<f64> {
    let one = |(i, p): (u32, &[u8; N])| {
        let want = truth(i % width, i / width);
        [0, 1, 2].map(|c| (f64::from(p[c]) - want[c]).abs())
    };
    (0..).zip(pixels).flat_map(one).collect()
}

pub(super) fn run(checked: &mut Checked, hosts: &[Host]) {
    let models = by_brightness();
    for File { name, bytes, truth, view, .. } in readable() {
        let scene = made(&models, &bytes, &Options::default());
        for host in hosts {
            checked.case(FAMILY, &format!("{name}, identity view"), host.name(), "levels, rms", view, || {
                let Some(drawn) = scene.as_ref().and_then(|s| host.render(s, &own_camera(s, Pose::default())).ok()) else {
                    return f64::INFINITY;
                };
                let off = off(&drawn.rgba, drawn.width, &truth);
                let open = drawn.rgba.iter().any(|p| p[3] < u8::MAX);
                if open { f64::INFINITY } else { (off.iter().map(|v| v * v).sum::<f64>() / off.len() as f64).sqrt() }
            });
        }
    }
    decoder(checked, |file| decode(file, &Limits::default(), None));
}

/// `kernel` decodes a photo.
pub(super) fn decoder(checked: &mut Checked, kernel: impl Fn(&[u8]) -> Result<Decoded, PhotoError>) {
    for File { name, bytes, truth, decoded, .. } in readable() {
        checked.case(FAMILY, &format!("{name}, decoded"), "decoder", "levels", decoded, || {
            let Ok(Decoded { photo, .. }) = kernel(&bytes) else { return f64::INFINITY };
            off(&photo.rgb, photo.width, &truth).into_iter().fold(0.0, f64::max)
        });
    }
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

type IsExpected<'a> = &'a dyn Fn(&PhotoError) -> bool;

/// Files that are no photo or too much of one.
fn refusals(checked: &mut Checked, kernel: impl Fn(&[u8]) -> Result<Decoded, PhotoError>) {
    let whole = waves(33, 17);
    let photo = Jpeg::new(33, 17, components(&[(1, 1); 3])).write(smooth);
    let too_large = |e: &PhotoError| matches!(e, PhotoError::SideTooLong { .. } | PhotoError::TooManyPixels { .. });
    let any = |_: &PhotoError| true;
    let files: [(&str, Vec<u8>, IsExpected); 8] = [
        ("1×20 000", promise(1, 20_000), &too_large),
        ("20 000×1", promise(20_000, 1), &too_large),
        ("decompression bomb, 16 000×16 000", promise(16_000, 16_000), &too_large),
        ("promised 2000×2000, has nothing", promise(2000, 2000), &any),
        ("truncated PNG", whole[..whole.len() / 2].to_vec(), &any),
        ("truncated JPEG", photo[..photo.len() / 2].to_vec(), &any),
        ("empty", Vec::new(), &any),
        ("text", b"a photo of a cat".to_vec(), &any),
    ];
    for (name, file, is_expected) in files {
        checked.case(FAMILY, &format!("{name} is refused"), "decoder", "accepted", 0.0, || {
            f64::from(u8::from(!kernel(&file).is_err_and(|e| is_expected(&e))))
        });
    }
}
