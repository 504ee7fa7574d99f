//! Reads a user's own depth map.

use super::grey::{ALIKE, Grey, grey, not_a_map};
use super::{DepthError, DepthKind, Read, openexr, pfm};

use crate::photo::{self, Head, Limits};
use tmpi_core::{DisparityMap, Photo};

/// Share of metric values that may be nearer than δ = 1: a sensor's outliers must not push everything else to infinity.
const OUTLIERS: f64 = 1e-3;

/// Columns at the left of half a picture into which JPEG carries colours of the other half.
const SEAM: usize = 17;
/// Largest difference in aspect, as a share, at which a map fits its photo.
const STRETCHED: f64 = 0.03;

/// Returns a map's width and height, and refuses by its headers alone what [`from_map`] would refuse: another format, or a map over the
/// limits. Whether the channels of a colour picture are nearly equal only shows when it is read.
///
/// # Errors
/// [`DepthError::Map`] says what is wrong with the file.
pub fn check(bytes: &[u8], limits: &Limits) -> Result<(u32, u32), DepthError> {
    if pfm::is_pfm(bytes) {
        return pfm::check(bytes, limits);
    }
    if openexr::is_openexr(bytes) {
        return openexr::check(bytes, limits);
    }
    photo::check(bytes, limits).map(|(_, size)| size).map_err(|e| not_a_map(&e))
}

/// Reads a map's size from its first bytes while the rest is still arriving.
///
/// # Errors
/// The [`DepthError::Map`] that [`check`] returns for the whole file.
pub fn head(bytes: &[u8], limits: &Limits) -> Result<Head, DepthError> {
    if pfm::is_pfm(bytes) {
        return pfm::head(bytes, limits);
    }
    if openexr::is_openexr(bytes) {
        return openexr::head(bytes, limits);
    }
    photo::head(bytes, limits).map_err(|e| not_a_map(&e))
}

/// Reads a user's depth map at the photo's size `width × height`. Also returns the map's own size.
///
/// The map is a portable float map, an OpenEXR file, or a picture within `limits` (PNG of 8 or 16 bits, JPEG, WebP) that is grey or has
/// nearly equal colour channels. A map of another size is resampled without mixing across edges. Metric depth is scaled so that its
/// nearest 0.1 % is at δ = 1; unknown metric values (0) take the farther known neighbour in the row.
///
/// # Errors
/// [`DepthError::Map`] says what is wrong with the file.
pub fn from_map(bytes: &[u8], kind: DepthKind, limits: &Limits, width: u32, height: u32) -> Result<(DisparityMap, (u32, u32)), DepthError> {
    from_map_beside(bytes, kind, limits, (width, height), 1).map(|read| (read.map, read.size))
}

/// Like [`from_map`], for a photo with this upright size that its EXIF `orientation` (1 to 8) turned. A map with the aspect of the stored
/// photo, and not of the upright one, is turned with it.
///
/// # Errors
/// [`DepthError::Map`] says what is wrong with the file.
pub fn from_map_beside(
    bytes: &[u8],
    kind: DepthKind,
    limits: &Limits,
    (width, height): (u32, u32),
    orientation: u8,
) -> Result<Read, DepthError> {
    let Grey { width: w, height: h, values } = if pfm::is_pfm(bytes) {
        pfm::read(bytes, limits)?
    } else if openexr::is_openexr(bytes) {
        openexr::read(bytes, limits)?
    } else {
        grey(bytes, limits)?
    };
    let lies = orientation >= 5 && fits((w, h), (height, width)) && !fits((w, h), (width, height));
    let (values, size) = photo::upright_srgb::turned(values, (w, h), if lies { orientation } else { 1 });
    from_values(values, size, kind, (width, height))
}

/// Disparity from the half of a picture that holds the depth map of the other half (RGB-D), at its size.
///
/// # Errors
/// [`DepthError::Embedded`] if it is in colour, or holds no known depth.
pub fn from_half(half: &Photo, kind: DepthKind) -> Result<Read, DepthError> {
    let size = (half.width, half.height);
    let differs = |&[r, g, b]: &[u8; 3]| u16::from(r.abs_diff(g).max(b.abs_diff(g))) > ALIKE;
    if half.rgb.chunks_exact(size.0 as usize).any(|row| row.iter().skip(SEAM).any(differs)) {
        return Err(DepthError::Embedded("the right half is in colour: a depth map must be grey".into()));
    }
    // brightness: colours of the other half do not change it
    let values = half.rgb.iter().map(|p| p.iter().zip([77.0, 150.0, 29.0]).map(|(&v, share)| f32::from(v) * share).sum::<f32>());
    from_values(values.map(|v| v / (256.0 * 255.0)).collect(), size, kind, size).map_err(|e| DepthError::Embedded(e.to_string()))
}

/// Reads the values of an upright map of `size` at the size of the photo.
fn from_values(values: Vec<f32>, size: (u32, u32), kind: DepthKind, photo: (u32, u32)) -> Result<Read, DepthError> {
    let width = size.0 as usize;
    Ok(match kind {
        DepthKind::Disparity | DepthKind::Inverted => {
            let (delta, unknown) = from_disparity(values, width, kind == DepthKind::Inverted)?;
            let filled = (unknown > 0).then(|| unknown as f64 / delta.len() as f64);
            Read { filled, ..Read::new(delta, size, photo) }
        }
        DepthKind::Metric => {
            let all = values.len().max(1) as f64;
            let Metric { delta, unknown, clipped } = from_metric(values, width)?;
            let [filled, clipped] = [unknown, clipped].map(|n| Some(n as f64 / all));
            Read { filled, clipped, ..Read::new(delta, size, photo) }
        }
    })
}

/// Disparity from a metric map.
struct Metric {
    delta: Vec<f32>,
    /// Number of unknown values.
    unknown: usize,
    /// Number of values nearer than the nearest distance.
    clipped: usize,
}

/// Whether a map of one size has the aspect of a photo of another, within 3 %.
pub fn fits(map: (u32, u32), photo: (u32, u32)) -> bool {
    let shape = (f64::from(map.0) * f64::from(photo.1)) / (f64::from(map.1) * f64::from(photo.0));
    (shape - 1.0).abs() <= STRETCHED
}

/// Disparity 0 to 1, and the number of unknown values. Only floats exceed this range: larger ones are in pixels and are scaled by the
/// largest; those that are not finite are unknown and take the farther known neighbour.
fn from_disparity(mut values: Vec<f32>, w: usize, is_inverted: bool) -> Result<(Vec<f32>, usize), DepthError> {
    let most = values.iter().copied().filter(|v| v.is_finite()).reduce(f32::max);
    let most = most.ok_or_else(|| DepthError::Map("it has no known depth: no value is finite".into()))?.max(1.0);
    let mut unknown = 0;
    for v in &mut values {
        if v.is_finite() {
            *v = (*v / most).max(0.0);
            *v = if is_inverted { 1.0 - *v } else { *v };
        } else {
            *v = f32::NAN;
            unknown += 1;
        }
    }
    if unknown > 0 {
        fill_unknown(&mut values, w);
    }
    Ok((values, unknown))
}

/// `δ = z_near / z`, at most 1, where `z_near` is the nearest depth apart from [`OUTLIERS`]; infinity is 0. An unknown value (0) takes the
/// farther of its known neighbours in the row, and a row of unknown values the nearest known row.
fn from_metric(mut z: Vec<f32>, w: usize) -> Result<Metric, DepthError> {
    let mut sorted: Vec<f32> = z.iter().copied().filter(|v| *v > 0.0 && v.is_finite()).collect();
    if sorted.is_empty() {
        return Err(DepthError::Map("it has no known depth: no value is a distance above 0".into()));
    }
    let rank = (sorted.len() as f64 * OUTLIERS) as usize;
    let near = *sorted.select_nth_unstable_by(rank, f32::total_cmp).1;
    let known = z.iter().filter(|v| **v > 0.0).count();
    let (unknown, clipped) = (z.len() - known, sorted.iter().filter(|v| **v < near).count());
    for v in &mut z {
        *v = if *v > 0.0 { (near / *v).min(1.0) } else { f32::NAN };
    }
    fill_unknown(&mut z, w);
    Ok(Metric { delta: z, unknown, clipped })
}

/// Fills each unknown value (NaN) with the farther of its known neighbours in the row, and a row of unknown values with the nearest known
/// row.
fn fill_unknown(z: &mut [f32], w: usize) {
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
            // the farther one: a sensor's holes lie behind the edge that hides them
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
}

#[cfg(test)]
mod tests {
    use super::*;

    fn from_map(bytes: &[u8], kind: DepthKind, width: u32, height: u32) -> Result<DisparityMap, DepthError> {
        super::from_map(bytes, kind, &Limits::default(), width, height).map(|(map, _)| map)
    }

    use image::{DynamicImage, ImageBuffer, ImageFormat, Luma, Rgb};
    use tmpi_testing::jpeg::with_profile;
    use tmpi_testing::pictures::{encoded, jpeg};

    fn png(image: impl Into<DynamicImage>) -> Vec<u8> {
        encoded(image, ImageFormat::Png)
    }

    fn wide(w: u32, h: u32, f: impl Fn(u32, u32) -> u16) -> Vec<u8> {
        png(ImageBuffer::from_fn(w, h, |x, y| Luma([f(x, y)])))
    }

    #[test]
    fn disparity_is_used_unchanged() {
        let got = from_map(&wide(4, 2, |x, y| (x * 1000 + y * 7) as u16), DepthKind::Disparity, 4, 2).unwrap();
        assert!((got.delta[7] - 3007.0 / 65_535.0).abs() < 1e-7);
        let eight = from_map(&png(ImageBuffer::from_fn(2, 1, |x, _| Luma([(x * 51) as u8]))), DepthKind::Disparity, 2, 1).unwrap();
        assert!((eight.delta[1] - 0.2).abs() < 1e-7);
    }

    #[test]
    fn an_inverted_map_has_white_far() {
        let map = wide(3, 1, |x, _| [0, 13_107, 65_535][x as usize]);
        let got = from_map(&map, DepthKind::Inverted, 3, 1).unwrap();
        assert!(got.delta.iter().zip([1.0, 0.8, 0.0]).all(|(got, want)| (got - want).abs() < 1e-6), "{:?}", got.delta);
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
    fn a_small_thing_before_infinity_is_near() {
        // fewer finite distances than outliers may be left out
        let z = (0..10_000).map(|i| if i < 5 { 2.0 } else { f32::INFINITY }).collect();
        let got = from_metric(z, 100).unwrap();
        assert!(got.delta.iter().enumerate().all(|(i, d)| (d - if i < 5 { 1.0 } else { 0.0 }).abs() < 1e-6));
        assert_eq!((got.unknown, got.clipped), (0, 0));
        assert!(from_metric(vec![f32::INFINITY; 4], 2).is_err());
    }

    #[test]
    fn resizing_never_mixes_two_surfaces() {
        let step = wide(40, 30, |x, _| if x < 20 { 6_000 } else { 60_000 });
        for (w, h) in [(80, 60), (400, 299), (13, 7), (1, 1), (40, 1), (16_384, 1)] {
            let got = from_map(&step, DepthKind::Disparity, w, h).unwrap();
            let pure = |v: f32| (v - 6_000.0 / 65_535.0).abs() < 1e-6 || (v - 60_000.0 / 65_535.0).abs() < 1e-6;
            assert!(got.delta.iter().all(|&v| pure(v)), "{w}×{h}");
        }
    }

    #[test]
    fn the_given_limits_are_checked_before_decoding() {
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
    fn grey_pictures_of_every_kind_give_the_same_values() {
        let value = |x: u32, y: u32| (x * 6 + y * 3) as u8;
        let rgb = ImageBuffer::from_fn(40, 30, |x, y| Rgb([value(x, y); 3]));
        let rgb16 = ImageBuffer::from_fn(40, 30, |x, y| Rgb([u16::from(value(x, y)) * 257; 3]));
        let luma = DynamicImage::from(rgb.clone()).to_luma8();
        let files = [(png(rgb.clone()), 0.0), (png(rgb16), 0.0), (jpeg(rgb.clone(), 100), 2.01 / 255.0), (jpeg(luma, 100), 2.01 / 255.0)];
        for (i, (file, tolerance)) in files.iter().enumerate() {
            let got = from_map(file, DepthKind::Disparity, 40, 30).unwrap();
            for (at, got) in got.delta.iter().enumerate() {
                let want = f32::from(value(at as u32 % 40, at as u32 / 40)) / 255.0;
                assert!((got - want).abs() <= tolerance + 1e-6, "file {i}: {got} for {want}");
            }
        }
        // decoded from a lossy file and saved again
        let off = ImageBuffer::from_fn(40, 30, |x, y| Rgb([value(x, y), value(x, y).saturating_add((x % 3) as u8), value(x, y)]));
        let off16 =
            ImageBuffer::from_fn(40, 30, |x, y| off.get_pixel(x, y).0.map(|v| u16::from(v) * 256 + 99).into()) as ImageBuffer<Rgb<u16>, _>;
        for file in [png(off.clone()), png(off16)] {
            let got = from_map(&file, DepthKind::Disparity, 40, 30).unwrap();
            assert!(got.delta.iter().zip(off.pixels()).all(|(got, p)| (got - f32::from(p[1]) / 255.0).abs() < 3e-3));
        }
        let tinted = jpeg(ImageBuffer::from_fn(40, 30, |x, y| Rgb([value(x, y), 128, 40])), 100);
        assert!(from_map(&tinted, DepthKind::Disparity, 40, 30).unwrap_err().to_string().contains("colour"));
    }

    #[test]
    fn half_a_picture_is_a_map_unless_it_is_in_colour() {
        let grey = |x: u32| (x * 2) as u8;
        let half = |seam: [u8; 3], within: [u8; 3]| {
            Photo::from_fn(100, 3, |x, y| match (x, y) {
                (0, 1) => seam,
                (60, 1) => within,
                _ => [grey(x); 3],
            })
        };
        // colours that cross the seam count by their brightness: (77 · 110 + 150 · 75 + 29 · 196) / 256 = 99.2
        let read = from_half(&half([110, 75, 196], [120, 120, 127]), DepthKind::Disparity).unwrap();
        assert_eq!((read.size, read.own, read.filled), ((100, 3), None, None));
        let at = |x: usize, y: usize| f64::from(read.map.delta[y * 100 + x]) * 255.0;
        assert!((at(0, 1) - 99.2).abs() < 0.1 && (at(99, 0) - 198.0).abs() < 1e-4 && (at(60, 1) - 120.8).abs() < 0.1);
        let inverted = from_half(&half([0; 3], [120; 3]), DepthKind::Inverted).unwrap().map.delta[99];
        assert!((inverted * 255.0 - 57.0).abs() < 1e-3, "{inverted}");
        let error = from_half(&half([0; 3], [120, 120, 129]), DepthKind::Disparity).unwrap_err();
        assert!(matches!(&error, DepthError::Embedded(why) if why.contains("colour")), "{error}");
    }

    #[test]
    fn neither_profile_nor_alpha_changes_values() {
        let value = |x: u32| (x * 6) as u8;
        let grey = ImageBuffer::from_fn(40, 4, |x, _| Luma([value(x)]));
        let rgb = ImageBuffer::from_fn(40, 4, |x, _| Rgb([value(x); 3]));
        let clear = ImageBuffer::from_fn(40, 4, |x, _| image::Rgba([value(x), value(x), value(x), 255 - value(x)]));
        let profiled = |image: DynamicImage, profile: moxcms::ColorProfile| with_profile(&jpeg(image, 100), &profile.encode().unwrap());
        let files = [
            profiled(grey.into(), moxcms::ColorProfile::new_gray_with_gamma(1.0)),
            profiled(rgb.into(), moxcms::ColorProfile::new_bt2020()),
            png(clear.clone()),
            encoded(clear, ImageFormat::WebP),
        ];
        for (i, file) in files.iter().enumerate() {
            let got = from_map(file, DepthKind::Disparity, 40, 4).unwrap();
            for (at, got) in got.delta.iter().enumerate() {
                let want = f32::from(value(at as u32 % 40)) / 255.0;
                assert!((got - want).abs() < 3.1 / 255.0, "file {i}: {got} for {want}");
            }
        }
    }

    #[test]
    fn a_map_in_the_photos_stored_orientation_turns_with_it() {
        // stored 40 × 30, upright 30 × 40; columns become rows
        let lying = wide(40, 30, |x, _| if x < 20 { 6_000 } else { 60_000 });
        let beside = |file: &[u8], size, orientation| {
            from_map_beside(file, DepthKind::Disparity, &Limits::default(), size, orientation).map(|read| (read.map, read.size)).unwrap()
        };
        for (orientation, first, last) in [(6, 6_000.0, 60_000.0), (8, 60_000.0, 6_000.0), (5, 6_000.0, 60_000.0), (7, 60_000.0, 6_000.0)] {
            let (map, size) = beside(&lying, (30, 40), orientation);
            assert_eq!((size, map.width, map.height), ((30, 40), 30, 40));
            assert!((map.delta[7] * 65_535.0 - first).abs() < 1.0 && (map.delta[1199] * 65_535.0 - last).abs() < 1.0, "{orientation}");
            // a map of another size turns too
            assert_eq!(beside(&wide(20, 15, |x, _| x as u16), (30, 40), orientation).1, (15, 20));
        }
        // not turned: an upright map, a map of another aspect, and maps beside photos that are only mirrored or are square
        for (size, orientation) in [((40, 30), 6), ((30, 40), 1), ((40, 30), 3), ((30, 30), 6), ((20, 40), 6)] {
            assert_eq!(beside(&lying, size, orientation).1, (40, 30), "{size:?} {orientation}");
        }
        let square = wide(30, 30, |x, _| x as u16 * 2000);
        assert!(beside(&square, (30, 30), 6).0.delta[1] > 0.0, "a square map shows no orientation and is not turned");
    }

    #[test]
    fn other_files_are_refused_with_their_reason() {
        let colour = png(ImageBuffer::from_fn(2, 2, |_, _| Rgb([1u8, 2, 30])));
        assert!(from_map(&colour, DepthKind::Disparity, 2, 2).unwrap_err().to_string().contains("colour"));
        assert!(from_map(b"P5 2 2 255", DepthKind::Disparity, 2, 2).unwrap_err().to_string().contains("not a JPEG, PNG or WebP"));
        let good = wide(9, 9, |x, _| x as u16);
        assert!(from_map(&good[..good.len() - 40], DepthKind::Disparity, 9, 9).is_err());
        let mut bomb = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR".to_vec();
        bomb.extend_from_slice(&[0, 0, 0x80, 0, 0, 0, 0x80, 0, 16, 0, 0, 0, 0]);
        assert!(from_map(&bomb, DepthKind::Disparity, 9, 9).is_err());
    }
}
