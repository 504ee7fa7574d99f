//! Writes photos of every format and feature, and what the program decodes them to, so that tests/browser/decode/photo-formats.test.mjs can
//! compare them with a browser.
//!
//! `decoded FOLDER` writes each photo, a file `NAME.rgb` beside it with its upright pixels (three bytes each, row by row), and
//! `index.json` with, for each photo, its `name` and either its `width`, its `height` and whether it is `damaged`, or why it is
//! `refused`.

use std::error::Error;
use std::path::PathBuf;

use image::{DynamicImage, ImageFormat, RgbImage, RgbaImage};
use moxcms::{ColorProfile, ToneReprCurve};
use serde_json::{Value, json};
use tmpi_pipeline::photo::{Limits, decode};
use tmpi_testing::jpeg::{Component, Jpeg, Scans, adobe, components, jfif, smooth, smooth_rgb, without_tables};
use tmpi_testing::pictures::encoded;
use tmpi_testing::png::{Png, chunk, iccp};

type Files = Vec<(String, Vec<u8>)>;

const W: u32 = 67;
const H: u32 = 45;

fn main() -> Result<(), Box<dyn Error>> {
    let folder = PathBuf::from(std::env::args().nth(1).ok_or("usage: decoded FOLDER")?);
    let mut index: Vec<Value> = Vec::new();
    for (name, file) in [jpegs(), jpeg_colours()?, pngs(), png_colours()?, webps()?].concat() {
        std::fs::write(folder.join(&name), &file)?;
        index.push(match decode(&file, &Limits::default(), None) {
            Ok(got) => {
                std::fs::write(folder.join(format!("{name}.rgb")), got.photo.rgb.as_flattened())?;
                json!({ "name": name, "width": got.photo.width, "height": got.photo.height, "damaged": got.damaged })
            }
            Err(error) => json!({ "name": name, "refused": error.to_string() }),
        });
    }
    Ok(std::fs::write(folder.join("index.json"), serde_json::to_vec(&index)?)?)
}

/// Samplings, orders of scans, ends of files.
fn jpegs() -> Files {
    let mut files = Files::new();
    let all = [("interleaved", Scans::Interleaved), ("separate", Scans::Separate), ("progressive", Scans::Progressive)];
    let samplings: [&[(u8, u8)]; 25] = [
        &[(1, 1)],
        &[(2, 2)],
        &[(3, 1)],
        &[(1, 1); 3],
        &[(2, 1), (1, 1), (1, 1)],
        &[(1, 2), (1, 1), (1, 1)],
        &[(2, 2), (1, 1), (1, 1)],
        &[(4, 1), (1, 1), (1, 1)],
        &[(1, 4), (1, 1), (1, 1)],
        &[(4, 2), (1, 1), (1, 1)],
        &[(2, 2), (2, 1), (2, 1)],
        &[(2, 2), (1, 2), (1, 2)],
        &[(2, 2), (1, 1), (2, 1)],
        &[(2, 1); 3],
        &[(2, 2); 3],
        &[(3, 1), (1, 1), (1, 1)],
        &[(1, 3), (1, 1), (1, 1)],
        &[(3, 2), (1, 1), (3, 1)],
        &[(4, 1), (2, 1), (1, 1)],
        &[(1, 1), (2, 2), (2, 2)],
        &[(1, 1), (1, 2), (1, 2)],
        &[(1, 2), (2, 1), (2, 1)],
        &[(1, 1); 4],
        &[(2, 2), (1, 1), (1, 1), (2, 2)],
        &[(1, 1), (1, 1), (1, 1), (2, 2)],
    ];
    for sampling in samplings {
        for (order, scans) in all {
            for (restart, (width, height)) in [(0, (W as u16, H as u16)), (3, (W as u16, H as u16)), (1, (16, 33))] {
                let segments = vec![if sampling.len() == 4 { adobe(0) } else { jfif() }];
                let file = Jpeg { restart, scans, segments, ..Jpeg::new(width, height, components(sampling)) }.write(smooth);
                let factors = sampling.iter().map(|(h, v)| format!("{h}{v}")).collect::<Vec<_>>().join("-");
                files.push((format!("sampling-{factors}-{order}-{restart}-{width}.jpg"), file));
            }
        }
    }
    for (order, scans) in all {
        let segments = vec![jfif()];
        let whole = Jpeg { scans, segments, ..Jpeg::new(W as u16, H as u16, components(&[(2, 2), (1, 1), (1, 1)])) }.write(smooth);
        let film = [b"\0\0\0\x18ftypmp42\0\0\0\0isommp42\0\0\x01\0mdat".as_slice(), &whole].concat();
        for (of, end) in [("end", &[0xFF, 0xD9][..]), ("half-end", &[0xFF]), ("no-end", &[])] {
            for (what, behind) in
                [("nothing", &b""[..]), ("newline", b"\n"), ("samsung", b"\0\0\x01\x0aImage_UTC_DataSEFHk\0\0\0SEFT"), ("film", &film)]
            {
                files.push((format!("{of}-{what}-{order}.jpg"), [&whole[..whole.len() - 2], end, behind].concat()));
            }
        }
    }
    files.push(("motion.jpg".to_owned(), without_tables(&encoded(picture(), ImageFormat::Jpeg), &[])));
    files
}

/// Markers, component names, profiles, orientations.
fn jpeg_colours() -> Result<Files, Box<dyn Error>> {
    let mut files = Files::new();
    let write = |names: &[u8], segments: Vec<(u8, Vec<u8>)>| {
        let components = names.iter().map(|&id| Component { id, h: 1, v: 1 }).collect();
        Jpeg { segments, ..Jpeg::new(W as u16, H as u16, components) }.write(smooth)
    };
    let markers = [
        ("nothing", vec![]),
        ("jfif", vec![jfif()]),
        ("adobe0", vec![adobe(0)]),
        ("adobe1", vec![adobe(1)]),
        ("adobe2", vec![adobe(2)]),
        ("jfif-adobe0", vec![jfif(), adobe(0)]),
        ("adobe0-jfif", vec![adobe(0), jfif()]),
        ("jfif-adobe1", vec![jfif(), adobe(1)]),
    ];
    for (marker, segments) in markers {
        for (names, ids) in [("123", &b"\x01\x02\x03"[..]), ("012", b"\x00\x01\x02"), ("rgb", b"RGB"), ("four", b"\x01\x02\x03\x04")] {
            files.push((format!("marker-{marker}-{names}.jpg"), write(ids, segments.clone())));
        }
    }
    for (profile, icc) in profiles()? {
        let segment = (0xE2, [b"ICC_PROFILE\0\x01\x01", &icc[..]].concat());
        files.push((format!("profile-{profile}-colour.jpg"), write(b"\x01\x02\x03", vec![jfif(), segment.clone()])));
        files.push((format!("profile-{profile}-grey.jpg"), write(b"\x01", vec![jfif(), segment])));
    }
    for orientation in 1..=8 {
        let exif = (0xE1, [b"Exif\0\0", &tiff(orientation)[..]].concat());
        files.push((format!("orientation-{orientation}.jpg"), write(b"\x01\x02\x03", vec![exif])));
    }
    Ok(files)
}

fn tiff(orientation: u8) -> Vec<u8> {
    [&b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0"[..], &[orientation, 0, 0, 0, 0, 0, 0]].concat()
}

/// Profiles by a short name.
type Profiles = Vec<(&'static str, Vec<u8>)>;

fn profiles() -> Result<Profiles, Box<dyn Error>> {
    let mut linear = ColorProfile::new_srgb();
    linear.cicp = None;
    for curve in [&mut linear.red_trc, &mut linear.green_trc, &mut linear.blue_trc] {
        *curve = Some(ToneReprCurve::Lut(vec![]));
    }
    Ok(vec![
        ("srgb", ColorProfile::new_srgb().encode()?),
        ("p3", ColorProfile::new_display_p3().encode()?),
        ("adobe", ColorProfile::new_adobe_rgb().encode()?),
        ("prophoto", ColorProfile::new_pro_photo_rgb().encode()?),
        ("linear", linear.encode()?),
        ("grey-linear", ColorProfile::new_gray_with_gamma(1.0).encode()?),
        ("grey-22", ColorProfile::new_gray_with_gamma(2.2).encode()?),
    ])
}

/// A sample of a PNG, 0 to 1: the smooth picture, and alpha from transparent to opaque.
fn sample(colour: u8) -> impl Fn(usize, u32, u32) -> f64 {
    move |channel, x, y| {
        let alpha = matches!((colour, channel), (4, 1) | (6, 3));
        let value = smooth_rgb(f64::from(x) + 0.5, f64::from(y) + 0.5)[channel % 3] / 255.0;
        if alpha { f64::from(x + y) / f64::from(W + H) * 1.2 } else { value }
    }
}

fn png(colour: u8, depth: u8, interlaced: bool, chunks: Vec<Vec<u8>>) -> Vec<u8> {
    Png { width: W, height: H, depth, colour, interlaced, chunks }.write(sample(colour))
}

/// Kinds of PNG: colour type and depth.
const KINDS: [(u8, u8); 15] =
    [(0, 1), (0, 2), (0, 4), (0, 8), (0, 16), (2, 8), (2, 16), (3, 1), (3, 2), (3, 4), (3, 8), (4, 8), (4, 16), (6, 8), (6, 16)];

fn pngs() -> Files {
    let mut files = Files::new();
    for (colour, depth) in KINDS {
        for interlaced in [false, true] {
            files.push((format!("kind-{colour}-{depth}-{interlaced}.png"), png(colour, depth, interlaced, vec![])));
        }
    }
    for interlaced in [false, true] {
        let whole = png(2, 8, interlaced, vec![]);
        let [no_end, half_end] = [12, 5].map(|bytes| whole[..whole.len() - bytes].to_vec());
        let mut checksum = whole.clone();
        // of the picture data, before the end chunk
        checksum[whole.len() - 13] ^= 1;
        let files_of = [("no-end", no_end), ("half-end", half_end), ("checksum", checksum), ("behind", [&whole[..], b"behind"].concat())];
        files.extend(files_of.map(|(name, file)| (format!("{name}-{interlaced}.png"), file)));
    }
    for (colour, depth) in [(0, 1), (0, 2), (0, 4), (0, 8), (0, 16)] {
        for place in [0, 1, (1u32 << depth) - 1] {
            let clear = chunk(b"tRNS", &(place as u16).to_be_bytes());
            files.push((format!("clear-{place}-{colour}-{depth}.png"), png(colour, depth, false, vec![clear])));
        }
    }
    for orientation in 1..=8 {
        files.push((format!("orientation-{orientation}.png"), png(2, 8, false, vec![chunk(b"eXIf", &tiff(orientation))])));
        // after the picture, where browsers do not look
        let mut late = png(2, 8, false, vec![]);
        late.truncate(late.len() - 12);
        late.extend([chunk(b"eXIf", &tiff(orientation)), chunk(b"IEND", &[])].concat());
        files.push((format!("orientation-{orientation}-late.png"), late));
    }
    files
}

fn png_colours() -> Result<Files, Box<dyn Error>> {
    let mut files = Files::new();
    let some = [(0, 8), (0, 16), (2, 8), (2, 16), (3, 8), (4, 8), (4, 16), (6, 8), (6, 16)];
    for (colour, depth) in some {
        let mut add =
            |name: &str, chunks: Vec<Vec<u8>>| files.push((format!("{name}-{colour}-{depth}.png"), png(colour, depth, false, chunks)));
        for (profile, icc) in profiles()? {
            add(&format!("profile-{profile}"), vec![iccp(&icc)]);
        }
        for (name, primaries, transfer) in [
            ("srgb", 1, 13),
            ("p3", 12, 13),
            ("linear", 1, 8),
            ("video", 1, 1),
            ("gamma22", 1, 4),
            ("2020", 9, 14),
            ("pq", 9, 16),
            ("hlg", 9, 18),
        ] {
            add(&format!("cicp-{name}"), vec![chunk(b"cICP", &[primaries, transfer, 0, 1])]);
        }
        add("cicp-profile", vec![chunk(b"cICP", &[12, 13, 0, 1]), iccp(&ColorProfile::new_adobe_rgb().encode()?)]);
        add("srgb", vec![chunk(b"sRGB", &[0])]);
    }
    let gamma = |value: u32| chunk(b"gAMA", &value.to_be_bytes());
    let p3 = [31_270, 32_900, 68_000, 32_000, 26_500, 69_000, 15_000, 6_000u32];
    let primaries = chunk(b"cHRM", p3.map(u32::to_be_bytes).as_flattened());
    for (name, chunks) in
        [("gamma-22", vec![gamma(45_455)]), ("gamma-1", vec![gamma(100_000)]), ("gamma-primaries", vec![gamma(45_455), primaries])]
    {
        files.push((format!("{name}.png"), png(2, 8, false, chunks)));
    }
    Ok(files)
}

fn picture() -> DynamicImage {
    let pixel = |x, y| image::Rgb(smooth_rgb(f64::from(x) + 0.5, f64::from(y) + 0.5).map(|v| v.round() as u8));
    RgbImage::from_fn(W, H, pixel).into()
}

fn clear_picture() -> DynamicImage {
    let opaque = picture().to_rgb8();
    let alpha = |x: u32, y: u32| ((x + y) * 255 / (W + H) * 6 / 5).min(255) as u8;
    RgbaImage::from_fn(W, H, |x, y| {
        let p = opaque.get_pixel(x, y);
        image::Rgba([p[0], p[1], p[2], alpha(x, y)])
    })
    .into()
}

/// A chunk of a WebP.
fn riff(name: [u8; 4], body: &[u8]) -> Vec<u8> {
    [&name[..], &(body.len() as u32).to_le_bytes(), body, &vec![0; body.len() % 2]].concat()
}

fn webp_of(chunks: &[u8]) -> Vec<u8> {
    [b"RIFF", &(chunks.len() as u32 + 4).to_le_bytes()[..], b"WEBP", chunks].concat()
}

/// The chunks of a picture, without the file around them and without a `VP8X` header.
fn bitstreams(picture: &DynamicImage, lossy: bool) -> Vec<u8> {
    let file = if lossy {
        let (rgba, alpha) = (picture.to_rgba8(), picture.color().has_alpha());
        let rgb = picture.to_rgb8();
        let (w, h) = rgba.dimensions();
        if alpha { webp::Encoder::from_rgba(&rgba, w, h) } else { webp::Encoder::from_rgb(&rgb, w, h) }.encode(90.0).to_vec()
    } else {
        encoded(picture.clone(), ImageFormat::WebP)
    };
    let chunks = &file[12..];
    if chunks.starts_with(b"VP8X") { chunks[18..].to_vec() } else { chunks.to_vec() }
}

fn three(value: u32) -> [u8; 3] {
    let [a, b, c, _] = value.to_le_bytes();
    [a, b, c]
}

fn webps() -> Result<Files, Box<dyn Error>> {
    let mut files = Files::new();
    let head = |flags: u8| riff(*b"VP8X", &[&[flags, 0, 0, 0][..], &three(W - 1), &three(H - 1)].concat());
    for (kind, picture, alpha) in [("opaque", picture(), 0), ("clear", clear_picture(), 0x10)] {
        for (codec, lossy) in [("lossy", true), ("lossless", false)] {
            let body = bitstreams(&picture, lossy);
            let mut add = |name: String, chunks: &[&[u8]]| files.push((format!("{name}-{kind}-{codec}.webp"), webp_of(&chunks.concat())));
            add("plain".into(), &[&head(alpha), &body]);
            for (profile, icc) in profiles()? {
                add(format!("profile-{profile}"), &[&head(alpha | 0x20), &riff(*b"ICCP", &icc), &body]);
            }
            if kind == "opaque" {
                for orientation in 1..=8 {
                    add(format!("orientation-{orientation}"), &[&head(0x08), &body, &riff(*b"EXIF", &tiff(orientation))]);
                }
            }
            for flag in [0, 0x10] {
                for (left, top) in [(0, 0), (6, 4), (W % 2 + 1, 0)] {
                    let place = [three(left / 2), three(top / 2)].concat();
                    let (width, height) = (W - left / 2 * 2, H - top / 2 * 2);
                    let part = picture.crop_imm(0, 0, width - 10, height - 10);
                    let sizes = [three(width - 11), three(height - 11), three(100)].concat();
                    let frame = [&place[..], &sizes, &[0], &bitstreams(&part, lossy)].concat();
                    let animation = riff(*b"ANIM", &[0, 0, 0, 255, 0, 0]);
                    add(format!("animation-{flag}-{left}-{top}"), &[&head(0x02 | flag), &animation, &riff(*b"ANMF", &frame)]);
                }
            }
        }
    }
    Ok(files)
}
