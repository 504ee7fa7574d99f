//! Pictures for tests, lossless, and noise that is the same on every machine.

use std::io::Cursor;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::{DynamicImage, ExtendedColorType, ImageEncoder, ImageFormat};

/// The file of a picture.
pub fn encoded(image: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
    let mut out = Cursor::new(Vec::new());
    image.into().write_to(&mut out, format).unwrap();
    out.into_inner()
}

/// A JPEG file of a picture at a quality of 1 to 100.
pub fn jpeg(image: impl Into<DynamicImage>, quality: u8) -> Vec<u8> {
    let mut out = Vec::new();
    image.into().write_with_encoder(JpegEncoder::new_with_quality(&mut out, quality)).unwrap();
    out
}

/// A PNG file of these samples.
pub fn png(width: u32, height: u32, samples: &[u8], colour: ExtendedColorType) -> Vec<u8> {
    let mut file = Vec::new();
    PngEncoder::new(&mut file).write_image(samples, width, height, colour).unwrap();
    file
}

/// A PNG file of [`wave`].
pub fn waves(width: u32, height: u32) -> Vec<u8> {
    let rgb: Vec<u8> = (0..width * height).flat_map(|i| wave(i % width, i / width)).collect();
    png(width, height, &rgb, ExtendedColorType::Rgb8)
}

/// Colour of a pixel in smooth waves with some edges.
pub fn wave(x: u32, y: u32) -> [u8; 3] {
    let along = |v: u32, by: f64| (127.5 + 100.0 * (f64::from(v) / by).sin()) as u8;
    [along(x, 9.0), along(y, 7.0), if (x / 30 + y / 20).is_multiple_of(2) { 200 } else { 90 }]
}

/// A number of 0 to 1 for a pixel, unlike those of its neighbours.
pub fn noise(x: u32, y: u32) -> f32 {
    let i = (y * 4099 + x).wrapping_mul(2_654_435_761);
    ((i ^ (i >> 15)).wrapping_mul(0x2C1B_3C6D) >> 8) as f32 / (1 << 24) as f32
}

/// Frames of an IVF file, which holds a film in VP9.
pub fn ivf_frames(file: &[u8]) -> Vec<&[u8]> {
    let (mut frames, mut file) = (Vec::new(), &file[32..]);
    while let Some((head, rest)) = file.split_first_chunk::<12>() {
        let (frame, rest) = rest.split_at(u32::from_le_bytes([head[0], head[1], head[2], head[3]]) as usize);
        frames.push(frame);
        file = rest;
    }
    frames
}
