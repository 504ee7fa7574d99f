//! A user's own depth map.

use image::{ColorType, ImageDecoder};
use rayon::prelude::*;

use super::{DepthError, DepthKind};
use tmpi_core::container::PhotoFormat;

use crate::photo::{self, Head, Limits, PhotoError, png};
use tmpi_core::DisparityMap;

/// Range of neighbouring disparities above which they lie on two surfaces and are not mixed.
const EDGE: f32 = 0.03;
/// Share of metric values that may be nearer than δ = 1: a sensor's outliers must not push everything else to infinity.
const OUTLIERS: f64 = 1e-3;

/// Levels of 255 by which the channels of a grey picture that was kept as a coloured JPEG may differ.
const ALIKE: u8 = 2;

/// Width and height of a map. Refuses by its headers alone what [`from_map`] would refuse: another format, or a map over the limits. Whether the channels of a picture
/// in colour are alike is seen only when it is read.
///
/// # Errors
/// [`DepthError::Map`] says what is wrong with the file.
pub fn check(bytes: &[u8], limits: &Limits) -> Result<(u32, u32), DepthError> {
    photo::check(bytes, limits).map(|(_, size)| size).map_err(|e| not_a_map(&e))
}

/// What the first bytes of a map tell, while the rest of it is still on its way.
///
/// # Errors
/// [`DepthError::Map`], as [`check`] of the whole would.
pub fn head(bytes: &[u8], limits: &Limits) -> Result<Head, DepthError> {
    photo::head(bytes, limits).map_err(|e| not_a_map(&e))
}

fn not_a_map(error: &PhotoError) -> DepthError {
    DepthError::Map(error.to_string())
}

/// A grey picture.
pub(super) struct Grey {
    pub width: u32,
    pub height: u32,
    /// 0 to 1, row by row.
    pub values: Vec<f32>,
}

/// Reads a picture that is grey, or whose colour channels are alike: PNG of 8 or 16 bits, JPEG, WebP.
///
/// # Errors
/// [`DepthError::Map`] says what is wrong with the file.
pub(super) fn grey(bytes: &[u8], limits: &Limits) -> Result<Grey, DepthError> {
    check(bytes, limits)?;
    if PhotoFormat::sniff(bytes) != Some(PhotoFormat::Png) {
        let photo::Decoded { photo, .. } = photo::decode(bytes, limits, None).map_err(|e| not_a_map(&e))?;
        if photo.rgb.iter().any(|[r, g, b]| r.abs_diff(*g).max(g.abs_diff(*b)) > ALIKE) {
            return Err(in_colour());
        }
        let values = photo.rgb.iter().map(|p| f32::from(p[1]) / 255.0).collect();
        return Ok(Grey { width: photo.width, height: photo.height, values });
    }
    let bad = |e: &dyn std::fmt::Display| DepthError::Map(e.to_string());
    let map = png::scan(bytes, limits).map_err(|e| not_a_map(&e))?;
    let (width, height) = (map.width, map.height);
    let decoder = map.decoder().map_err(|e| bad(&e))?;
    let colour = decoder.color_type();
    let mut samples = vec![0; decoder.total_bytes() as usize];
    decoder.read_image(&mut samples).map_err(|e| bad(&e))?;
    let wide = |b: &[u8]| u16::from_ne_bytes([b[0], b[1]]);
    // Alpha says nothing about depth
    let alike = |n: usize, of: &(dyn Fn(&[u8]) -> [u16; 3] + Sync), most: f32| {
        let values = samples.par_chunks_exact(n).map(of).map(|[r, g, b]| (r == g && g == b).then(|| f32::from(r) / most));
        values.collect::<Option<Vec<f32>>>().ok_or_else(in_colour)
    };
    let byte = |b: &[u8]| u16::from(b[0]);
    let values = match colour {
        ColorType::L8 => alike(1, &|p| [byte(p); 3], 255.0),
        ColorType::La8 => alike(2, &|p| [byte(p); 3], 255.0),
        ColorType::Rgb8 => alike(3, &|p| [0, 1, 2].map(|i| byte(&p[i..])), 255.0),
        ColorType::Rgba8 => alike(4, &|p| [0, 1, 2].map(|i| byte(&p[i..])), 255.0),
        ColorType::L16 => alike(2, &|p| [wide(p); 3], 65_535.0),
        ColorType::La16 => alike(4, &|p| [wide(p); 3], 65_535.0),
        ColorType::Rgb16 => alike(6, &|p| [0, 2, 4].map(|i| wide(&p[i..])), 65_535.0),
        ColorType::Rgba16 => alike(8, &|p| [0, 2, 4].map(|i| wide(&p[i..])), 65_535.0),
        other => Err(DepthError::Map(format!("pixels of kind {other:?} are not read"))),
    }?;
    Ok(Grey { width, height, values })
}

fn in_colour() -> DepthError {
    DepthError::Map("it is in colour: a depth map is grey, or has three channels that are alike".into())
}

/// Reads a user's depth map (a grey picture within `limits`: PNG of 8 or 16 bits, JPEG, WebP; or one in colour whose channels are alike) at
/// the photo's size `width × height`, and tells the map's own; one of another size is resampled without mixing across edges. Metric depth
/// is scaled so that its nearest 0.1 % is at δ = 1; unknown metric values (0) take the farther known neighbour in the row.
///
/// # Errors
/// [`DepthError::Map`] says what is wrong with the file.
pub fn from_map(bytes: &[u8], kind: DepthKind, limits: &Limits, width: u32, height: u32) -> Result<(DisparityMap, (u32, u32)), DepthError> {
    let Grey { width: w, height: h, values } = grey(bytes, limits)?;
    let delta = match kind {
        DepthKind::Disparity => values,
        DepthKind::Metric => from_metric(values, w as usize)?,
    };
    if (w, h) == (width, height) {
        return Ok((DisparityMap { width, height, delta }, (w, h)));
    }
    Ok((resize(&delta, (w as usize, h as usize), (width, height)), (w, h)))
}

/// `δ = z_near / z`, at most 1, where `z_near` is the nearest depth but for [`OUTLIERS`]; an unknown value (0) takes the farther of its known neighbours in the row, a row of unknowns the row above or below.
fn from_metric(mut z: Vec<f32>, w: usize) -> Result<Vec<f32>, DepthError> {
    let mut sorted: Vec<f32> = z.iter().copied().filter(|&v| v > 0.0).collect();
    if sorted.is_empty() {
        return Err(DepthError::Map("it has no known depth: every value is 0".into()));
    }
    let rank = (sorted.len() as f64 * OUTLIERS) as usize;
    let near = *sorted.select_nth_unstable_by(rank, f32::total_cmp).1;
    for v in &mut z {
        *v = if *v > 0.0 { (near / *v).min(1.0) } else { f32::NAN };
    }
    let mut known = Vec::new();
    for (y, row) in z.chunks_exact_mut(w).enumerate() {
        let mut left = None;
        let mut x = 0;
        while x < w {
            if !row[x].is_nan() {
                left = Some(row[x]);
                x += 1;
                continue;
            }
            let end = row[x..].iter().position(|v| !v.is_nan()).map_or(w, |n| x + n);
            let right = row.get(end).copied();
            // The farther one: holes of a sensor lie behind the edge that hides them
            let Some(fill) = left.into_iter().chain(right).reduce(f32::min) else { break };
            row[x..end].fill(fill);
            x = end;
        }
        if row.iter().all(|v| !v.is_nan()) {
            known.push(y);
        }
    }
    for y in 0..z.len() / w {
        let at = known.partition_point(|&k| k < y);
        let candidates = [at.checked_sub(1).map(|i| known[i]), known.get(at).copied()];
        if candidates[1] == Some(y) {
            continue;
        }
        if let Some(nearest) = candidates.into_iter().flatten().min_by_key(|k| k.abs_diff(y)) {
            z.copy_within(nearest * w..(nearest + 1) * w, y * w);
        }
    }
    Ok(z)
}

/// Another size: linear within a surface, the nearest sample where the four around a place belong to two surfaces;
/// reducing, the mean of the covered samples within a surface, else their median.
pub(super) fn resize(source: &[f32], (w, h): (usize, usize), (width, height): (u32, u32)) -> DisparityMap {
    let (ratio_x, ratio_y) = (w as f64 / f64::from(width), h as f64 / f64::from(height));
    let mut delta = vec![0f32; width as usize * height as usize];
    delta.par_chunks_exact_mut(width as usize).enumerate().for_each(|(y, row)| {
        let (y0, y1) = covered(y, ratio_y, h);
        let mut window = Vec::new();
        for (x, out) in row.iter_mut().enumerate() {
            let (x0, x1) = covered(x, ratio_x, w);
            window.clear();
            for line in source.chunks_exact(w).take(y1 + 1).skip(y0) {
                window.extend_from_slice(&line[x0..=x1]);
            }
            let (lo, hi) = window.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |m, &v| (m.0.min(v), m.1.max(v)));
            *out = if hi - lo > EDGE {
                if x1 - x0 <= 1 && y1 - y0 <= 1 {
                    let near = |i: usize, ratio: f64, n: usize| (((i as f64 + 0.5) * ratio) as usize).min(n - 1);
                    source[near(y, ratio_y, h) * w + near(x, ratio_x, w)]
                } else {
                    let middle = window.len() / 2;
                    *window.select_nth_unstable_by(middle, f32::total_cmp).1
                }
            } else if x1 - x0 <= 1 && y1 - y0 <= 1 {
                let share = |i: usize, ratio: f64, first: usize| (((i as f64 + 0.5) * ratio - 0.5 - first as f64) as f32).clamp(0.0, 1.0);
                let (fx, fy) = (share(x, ratio_x, x0), share(y, ratio_y, y0));
                let at = |xx: usize, yy: usize| source[yy * w + xx];
                let line = |yy: usize| at(x0, yy) + (at(x1, yy) - at(x0, yy)) * fx;
                line(y0) + (line(y1) - line(y0)) * fy
            } else {
                window.iter().sum::<f32>() / window.len() as f32
            };
        }
    });
    DisparityMap { width, height, delta }
}

/// A map at another size, without mixing across edges.
#[must_use]
pub fn resized(map: &DisparityMap, width: u32, height: u32) -> DisparityMap {
    resize(&map.delta, (map.width as usize, map.height as usize), (width, height))
}

/// First and last source sample that a place of the result stands on.
fn covered(i: usize, ratio: f64, n: usize) -> (usize, usize) {
    let half = ratio.max(1.0) / 2.0;
    let centre = (i as f64 + 0.5) * ratio - 0.5;
    // Reducing covers `ratio` samples; enlarging lies between two
    let (first, last) =
        if ratio > 1.0 { ((centre - half).ceil(), (centre + half - 1e-9).floor()) } else { (centre.floor(), centre.floor() + 1.0) };
    let first = (first.max(0.0) as usize).min(n - 1);
    (first, (last.max(0.0) as usize).clamp(first, n - 1))
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;

    fn from_map(bytes: &[u8], kind: DepthKind, width: u32, height: u32) -> Result<DisparityMap, DepthError> {
        super::from_map(bytes, kind, &Limits::default(), width, height).map(|(map, _)| map)
    }

    use image::{DynamicImage, ImageBuffer, ImageFormat, Luma, Rgb};

    fn png(image: impl Into<DynamicImage>) -> Vec<u8> {
        let mut out = Cursor::new(Vec::new());
        image.into().write_to(&mut out, ImageFormat::Png).unwrap();
        out.into_inner()
    }

    fn wide(w: u32, h: u32, f: impl Fn(u32, u32) -> u16) -> Vec<u8> {
        png(ImageBuffer::from_fn(w, h, |x, y| Luma([f(x, y)])))
    }

    #[test]
    fn disparity_is_taken_as_it_is() {
        let got = from_map(&wide(4, 2, |x, y| (x * 1000 + y * 7) as u16), DepthKind::Disparity, 4, 2).unwrap();
        assert!((got.delta[7] - 3007.0 / 65_535.0).abs() < 1e-7);
        let eight = from_map(&png(ImageBuffer::from_fn(2, 1, |x, _| Luma([(x * 51) as u8]))), DepthKind::Disparity, 2, 1).unwrap();
        assert!((eight.delta[1] - 0.2).abs() < 1e-7);
    }

    #[test]
    fn metric_fills_unknown_values_from_the_farther_side() {
        // 0 is unknown; the nearest is 1000
        let rows: [[u16; 5]; 4] = [[0, 1000, 0, 0, 4000], [0, 0, 0, 0, 0], [2000, 0, 1000, 0, 0], [0; 5]];
        let got = from_map(&wide(5, 4, |x, y| rows[y as usize][x as usize]), DepthKind::Metric, 5, 4).unwrap();
        let want = [[1.0, 1.0, 0.25, 0.25, 0.25], [1.0, 1.0, 0.25, 0.25, 0.25], [0.5, 0.5, 1.0, 1.0, 1.0], [0.5, 0.5, 1.0, 1.0, 1.0]];
        for (got, want) in got.delta.iter().zip(want.as_flattened()) {
            assert!((got - want).abs() < 1e-6, "{got:?}");
        }
        assert!(from_map(&wide(3, 3, |_, _| 0), DepthKind::Metric, 3, 3).unwrap_err().to_string().contains("no known depth"));
    }

    #[test]
    fn another_size_never_mixes_two_surfaces() {
        let step = wide(40, 30, |x, _| if x < 20 { 6_000 } else { 60_000 });
        for (w, h) in [(80, 60), (400, 299), (13, 7), (1, 1), (40, 1), (16_384, 1)] {
            let got = from_map(&step, DepthKind::Disparity, w, h).unwrap();
            let pure = |v: f32| (v - 6_000.0 / 65_535.0).abs() < 1e-6 || (v - 60_000.0 / 65_535.0).abs() < 1e-6;
            assert!(got.delta.iter().all(|&v| pure(v)), "{w}×{h}");
        }
        let ramp = wide(64, 64, |x, y| (x * 300 + y * 200) as u16);
        let got = from_map(&ramp, DepthKind::Disparity, 128, 128).unwrap();
        let want = (31.75 * 300.0 + 10.25 * 200.0) / 65_535.0;
        assert!((f64::from(got.delta[21 * 128 + 64]) - want).abs() < 1e-5, "a slope stays smooth");
        let got = from_map(&ramp, DepthKind::Disparity, 16, 16).unwrap();
        let want = (17.5 * 300.0 + 29.5 * 200.0) / 65_535.0;
        assert!((f64::from(got.delta[7 * 16 + 4]) - want).abs() < 1e-5, "{} {want}", got.delta[7 * 16 + 4]);
    }

    #[test]
    fn the_limits_given_hold_before_anything_is_decoded() {
        let map = wide(20, 10, |x, _| x as u16);
        let limits = Limits { pixels: 200, side: 20, bytes: map.len(), decoder_memory: 400, ..Limits::default() };
        assert!(check(&map, &limits).is_ok());
        assert_eq!(super::from_map(&map, DepthKind::Disparity, &limits, 20, 10).unwrap().1, (20, 10));
        for over in [
            Limits { pixels: 199, ..limits },
            Limits { side: 19, ..limits },
            Limits { bytes: map.len() - 1, ..limits },
            Limits { decoder_memory: 399, ..limits },
        ] {
            assert!(check(&map, &over).is_err(), "{over:?}");
            assert!(super::from_map(&map, DepthKind::Disparity, &over, 20, 10).is_err(), "{over:?}");
        }
        assert!(check(b"P5 2 2 255", &Limits::default()).is_err());
    }

    #[test]
    fn grey_pictures_of_every_kind_are_read_alike() {
        let value = |x: u32, y: u32| (x * 6 + y * 3) as u8;
        let rgb = ImageBuffer::from_fn(40, 30, |x, y| Rgb([value(x, y); 3]));
        let rgb16 = ImageBuffer::from_fn(40, 30, |x, y| Rgb([u16::from(value(x, y)) * 257; 3]));
        let jpeg = |image: DynamicImage| {
            let mut out = Cursor::new(Vec::new());
            image.write_with_encoder(image::codecs::jpeg::JpegEncoder::new_with_quality(&mut out, 100)).unwrap();
            out.into_inner()
        };
        let luma = DynamicImage::from(rgb.clone()).to_luma8();
        let files =
            [(png(rgb.clone()), 0.0), (png(rgb16), 0.0), (jpeg(rgb.clone().into()), 2.01 / 255.0), (jpeg(luma.into()), 2.01 / 255.0)];
        for (i, (file, tolerance)) in files.iter().enumerate() {
            let got = from_map(file, DepthKind::Disparity, 40, 30).unwrap();
            for (at, got) in got.delta.iter().enumerate() {
                let want = f32::from(value(at as u32 % 40, at as u32 / 40)) / 255.0;
                assert!((got - want).abs() <= tolerance + 1e-6, "file {i}: {got} for {want}");
            }
        }
        let tinted = jpeg(ImageBuffer::from_fn(40, 30, |x, y| Rgb([value(x, y), 128, 40])).into());
        assert!(from_map(&tinted, DepthKind::Disparity, 40, 30).unwrap_err().to_string().contains("colour"));
    }

    #[test]
    fn other_files_are_errors_that_say_so() {
        let colour = png(ImageBuffer::from_fn(2, 2, |_, _| Rgb([1u8, 2, 3])));
        assert!(from_map(&colour, DepthKind::Disparity, 2, 2).unwrap_err().to_string().contains("colour"));
        assert!(from_map(b"P5 2 2 255", DepthKind::Disparity, 2, 2).unwrap_err().to_string().contains("not a JPEG, PNG or WebP"));
        let good = wide(9, 9, |x, _| x as u16);
        assert!(from_map(&good[..good.len() - 40], DepthKind::Disparity, 9, 9).is_err());
        let mut bomb = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR".to_vec();
        bomb.extend_from_slice(&[0, 0, 0x80, 0, 0, 0, 0x80, 0, 16, 0, 0, 0, 0]);
        assert!(from_map(&bomb, DepthKind::Disparity, 9, 9).is_err());
    }
}
