//! Photos: files of every kind and shape through the whole way, and the view from the reference camera against the photo.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use image::codecs::{jpeg::JpegEncoder, png::PngEncoder, webp::WebPEncoder};
use image::{ExtendedColorType, ImageEncoder};

use super::{Checked, Hosts};
use tmpi_core::container;
use tmpi_core::{Camera, DisparityMap, Photo, Pose, Scene};
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

/// Colours of every kind of edge: smooth, sharp, fine.
fn pixels(w: u32, h: u32) -> Vec<[u8; 3]> {
    (0..w * h)
        .map(|i| {
            let (x, y) = (i % w, i / w);
            let board = (x / 7 + y / 5).is_multiple_of(2);
            [(x * 255 / w) as u8, (y * 255 / h) as u8, if board { 230 } else { 20 }]
        })
        .collect()
}

pub(super) fn png(w: u32, h: u32, samples: &[u8], colour: ExtendedColorType) -> Vec<u8> {
    let mut out = Vec::new();
    // what cannot be written is an empty file, which fails its case
    let _ = PngEncoder::new(&mut out).write_image(samples, w, h, colour);
    out
}

pub(super) fn rgb_png(w: u32, h: u32) -> Vec<u8> {
    png(w, h, pixels(w, h).as_flattened(), ExtendedColorType::Rgb8)
}

fn jpeg(w: u32, h: u32, samples: &[u8], colour: ExtendedColorType) -> Vec<u8> {
    let mut out = Vec::new();
    let _ = JpegEncoder::new_with_quality(&mut out, 95).write_image(samples, w, h, colour);
    out
}

/// The frame header of a JPEG (baseline), and the start of its scan.
fn parts(jpeg: &[u8]) -> Option<(usize, usize)> {
    let find = |marker: u8| jpeg.windows(2).position(|w| w == [0xFF, marker]);
    Some((find(0xC0)?, find(0xDA)?))
}

/// Four grey scans as the four components of one frame: a CMYK JPEG.
fn cmyk() -> Vec<u8> {
    let grey = jpeg(16, 8, &(0..128_u8).map(|i| i * 2).collect::<Vec<_>>(), ExtendedColorType::L8);
    let Some((frame, scan)) = parts(&grey) else { return Vec::new() };
    let mut out = grey[..frame].to_vec();
    out.extend([0xFF, 0xC0, 0, 20]);
    out.extend(&grey[frame + 4..frame + 9]);
    out.push(4);
    (1..=4).for_each(|id| out.extend([id, 0x11, 0]));
    out.extend(&grey[frame + 13..scan]);
    for id in 1..=4 {
        out.extend(&grey[scan..scan + 5]);
        out.push(id);
        out.extend(&grey[scan + 6..grey.len() - 2]);
    }
    out.extend([0xFF, 0xD9]);
    out
}

/// Adds a chunk of a PNG or WebP file with its length and, for PNG, checksum.
fn png_chunk(out: &mut Vec<u8>, name: [u8; 4], body: &[u8]) {
    out.extend((body.len() as u32).to_be_bytes());
    let start = out.len();
    out.extend(name);
    out.extend(body);
    let crc = out[start..]
        .iter()
        .fold(u32::MAX, |crc, &b| (0..8).fold(crc ^ u32::from(b), |c, _| if c & 1 == 1 { (c >> 1) ^ 0xEDB8_8320 } else { c >> 1 }));
    out.extend((!crc).to_be_bytes());
}

/// A palette PNG, from the same compressed samples as a grey one: the samples become indices.
fn palette() -> Vec<u8> {
    let grey = png(16, 8, &(0..128_u8).collect::<Vec<_>>(), ExtendedColorType::L8);
    let mut out = grey[..8].to_vec();
    let mut header = grey[16..29].to_vec();
    header[9] = 3;
    png_chunk(&mut out, *b"IHDR", &header);
    png_chunk(&mut out, *b"PLTE", &(0..=255_u8).flat_map(|i| [i, 255 - i, 90]).collect::<Vec<_>>());
    out.extend(&grey[33..]);
    out
}

/// A WebP animation of one frame of 16×8.
fn animated() -> Vec<u8> {
    let mut still = Vec::new();
    let _ = WebPEncoder::new_lossless(&mut still).write_image(pixels(16, 8).as_flattened(), 16, 8, ExtendedColorType::Rgb8);
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
    let mut out = b"\x89PNG\r\n\x1a\n".to_vec();
    let header = [w.to_be_bytes(), h.to_be_bytes()].concat();
    png_chunk(&mut out, *b"IHDR", &[&header[..], &[8, 2, 0, 0, 0]].concat());
    png_chunk(&mut out, *b"IDAT", &[0x78, 0x9c, 0x63, 0, 0]);
    png_chunk(&mut out, *b"IEND", &[]);
    out
}

/// A JPEG that says it was taken with a focal length of so many millimetres, as a double.
fn with_focal(millimetres: f64) -> Vec<u8> {
    let plain = jpeg(40, 24, pixels(40, 24).as_flattened(), ExtendedColorType::Rgb8);
    let mut tiff = b"II*\0\x08\0\0\0\x01\0\x69\x87\x04\0\x01\0\0\0\x1a\0\0\0\0\0\0\0".to_vec();
    tiff.extend(b"\x01\0\x05\xa4\x0c\0\x01\0\0\0\x2c\0\0\0\0\0\0\0");
    tiff.extend(millimetres.to_le_bytes());
    let mut out = plain[..2].to_vec();
    out.extend([0xFF, 0xE1]);
    out.extend((tiff.len() as u16 + 8).to_be_bytes());
    out.extend(b"Exif\0\0");
    out.extend(&tiff);
    out.extend(&plain[2..]);
    out
}

fn readable() -> Vec<(String, Vec<u8>)> {
    let mut all: Vec<(String, Vec<u8>)> = [(1, 1), (1, 2000), (2000, 1), (1, 16_384), (16_384, 1), (63, 63), (65, 65), (64, 64), (7, 200)]
        .into_iter()
        .map(|(w, h)| (format!("{w}×{h}"), rgb_png(w, h)))
        .collect();
    let (w, h) = (70, 50);
    let n = (w * h) as usize;
    let wide: Vec<u16> = (0..n * 3).map(|i| (i * 37 % 65_536) as u16).collect();
    let grey: Vec<u8> = (0..n).map(|i| (i * 7 % 256) as u8).collect();
    let clear: Vec<u8> = pixels(w, h).iter().enumerate().flat_map(|(i, p)| [p[0], p[1], p[2], (i % 256) as u8]).collect();
    let rest: [(&str, Vec<u8>); 10] = [
        ("greyscale JPEG", jpeg(w, h, &grey, ExtendedColorType::L8)),
        ("greyscale PNG", png(w, h, &grey, ExtendedColorType::L8)),
        ("palette", palette()),
        ("16 bits", png(w, h, bytemuck::cast_slice(&wide), ExtendedColorType::Rgb16)),
        ("CMYK JPEG", cmyk()),
        ("alpha", png(w, h, &clear, ExtendedColorType::Rgba8)),
        ("wholly transparent", png(w, h, &vec![0; n * 4], ExtendedColorType::Rgba8)),
        ("animated", animated()),
        ("all black", png(w, h, &vec![0; n * 3], ExtendedColorType::Rgb8)),
        ("one colour", png(w, h, &[[200, 10, 90]].repeat(n).concat(), ExtendedColorType::Rgb8)),
    ];
    all.extend(rest.map(|(name, bytes)| (name.to_owned(), bytes)));
    all
}

pub(super) fn run(checked: &mut Checked, hosts: &Hosts) {
    let models = Models { depth: Arc::new(Brightness), theta: None, psi: None };
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
fn decoder(checked: &mut Checked, kernel: impl Fn(&[u8]) -> Result<Decoded, PhotoError>) {
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
    let camera = Camera { pose: Pose::default(), intrinsics: scene.intrinsics, width: scene.photo.width, height: scene.photo.height };
    let Ok(view) = host.render(scene, &camera) else { return f64::INFINITY };
    let off = |(p, q): (&[u8; 4], &[u8; 3])| (0..4).map(|c| p[c].abs_diff(if c < 3 { q[c] } else { 255 })).max().unwrap_or(0);
    view.rgba.iter().zip(&scene.photo.rgb).map(off).max().unwrap_or(u8::MAX).into()
}

/// Whether an error is the one that was wanted.
type Wanted<'a> = &'a dyn Fn(&PhotoError) -> bool;

/// Files that are no photo or too much of one.
fn refusals(checked: &mut Checked, kernel: impl Fn(&[u8]) -> Result<Decoded, PhotoError>) {
    let whole = rgb_png(33, 17);
    let photo = jpeg(33, 17, pixels(33, 17).as_flattened(), ExtendedColorType::Rgb8);
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

#[cfg(test)]
mod tests {
    use super::super::{Faulty, caught, failed};
    use super::*;
    use tmpi_core::Intrinsics;

    #[test]
    fn a_fault_of_the_decoder_or_of_a_renderer_is_caught() {
        let right = |file: &[u8]| decode(file, &Limits::default(), None);
        assert_eq!(failed(|c| decoder(c, right)), 0);
        let takes_all = |file: &[u8]| right(file).or_else(|_| right(&rgb_png(3, 3)));
        assert!(failed(|c| refusals(c, takes_all)) > 0);
        let believes = |file: &[u8]| {
            let decoded = right(file)?;
            Ok(Decoded { intrinsics: Intrinsics { fx: decoded.intrinsics.fx * 1.01, ..decoded.intrinsics }, ..decoded })
        };
        assert!(failed(|c| decoder(c, believes)) > 0);
        let upside_down = Faulty::hosts(|cpu, scene, camera| {
            let mut view = cpu.render(scene, camera)?;
            view.rgba.reverse();
            Ok(view)
        });
        assert_eq!(caught(|c| run(c, &upside_down)), ["gpu"]);
    }
}
