use image::{ImageBuffer, ImageFormat, Luma, LumaA, Rgb, Rgba};
use tmpi_testing::jpeg::{Jpeg, components, segment, with_profile, with_segments};
use tmpi_testing::pictures;
pub(super) use tmpi_testing::pictures::encoded as file;

use super::*;

/// A picture without any symmetry, so that every orientation looks different.
pub(super) fn picture(w: u32, h: u32) -> image::RgbImage {
    ImageBuffer::from_fn(w, h, |x, y| Rgb([(x * 255 / w) as u8, (y * 255 / h) as u8, if x * 3 < w && y * 2 < h { 220 } else { 40 }]))
}

pub(super) fn jpeg(w: u32, h: u32) -> Vec<u8> {
    pictures::jpeg(picture(w, h), 95)
}

/// A TIFF structure with an orientation, and with a focal length (tag 0xA405, in the EXIF directory) of the given type and bytes.
fn tiff(orientation: u16, focal: Option<(u16, [u8; 4], &[u8])>) -> Vec<u8> {
    let mut t = b"II*\0\x08\0\0\0".to_vec();
    let entry = |t: &mut Vec<u8>, tag: u16, kind: u16, value: [u8; 4]| {
        t.extend_from_slice(&tag.to_le_bytes());
        t.extend_from_slice(&kind.to_le_bytes());
        t.extend_from_slice(&1u32.to_le_bytes());
        t.extend_from_slice(&value);
    };
    t.extend_from_slice(&2u16.to_le_bytes());
    entry(&mut t, 0x0112, 3, [orientation.to_le_bytes()[0], orientation.to_le_bytes()[1], 0, 0]);
    entry(&mut t, 0x8769, 4, 38u32.to_le_bytes());
    t.extend_from_slice(&0u32.to_le_bytes());
    assert_eq!(t.len(), 38);
    t.extend_from_slice(&u16::from(focal.is_some()).to_le_bytes());
    if let Some((kind, value, more)) = focal {
        entry(&mut t, 0xA405, kind, value);
        t.extend_from_slice(&0u32.to_le_bytes());
        t.extend_from_slice(more);
    } else {
        t.extend_from_slice(&0u32.to_le_bytes());
    }
    t
}

fn with_exif(jpeg: &[u8], tiff: &[u8]) -> Vec<u8> {
    with_segments(jpeg, &[segment(0xE1, &[b"Exif\0\0".as_slice(), tiff].concat())])
}

pub(super) fn ok(bytes: &[u8]) -> Decoded {
    decode(bytes, &Limits::default(), None).unwrap()
}

fn contains(bytes: &[u8], what: &[u8]) -> bool {
    bytes.windows(what.len()).any(|w| w == what)
}

#[test]
fn all_eight_orientations_become_upright() {
    let base = ok(&jpeg(40, 24));
    for orientation in 1..=8u8 {
        // stored so that a viewer that obeys the tag shows the base picture: turned the inverse way
        let inverse = match orientation {
            6 => 8,
            8 => 6,
            o => o,
        };
        let stored = upright_srgb::upright(base.photo.clone(), inverse);
        let image = image::RgbImage::from_raw(stored.width, stored.height, stored.rgb.into_flattened()).unwrap();
        let mut bytes = file(image, ImageFormat::Png);
        let tiff = tiff(orientation.into(), None);
        bytes.splice(33..33, tmpi_testing::png::chunk(b"eXIf", &tiff));
        let got = ok(&bytes);
        assert_eq!(got.photo, base.photo, "orientation {orientation}");
        assert_eq!(got.original, (40, 24));
    }
}

#[test]
fn a_rotated_jpeg_is_not_carried_and_a_plain_one_is_without_its_metadata() {
    let plain = jpeg(40, 24);
    let secret = b"GPS 59.3N 18.1E";
    let bytes = with_segments(&plain, &[segment(0xED, secret), segment(0xFE, secret)]);
    let mut bytes = with_exif(&bytes, &[tiff(1, None), secret.to_vec()].concat());
    bytes.extend_from_slice(secret);
    let got = ok(&bytes);
    let stripped = got.stripped.unwrap();
    assert!(!contains(&stripped, b"GPS") && !contains(&stripped, b"Exif"));
    let again = ok(&stripped);
    assert_eq!(again.photo, got.photo);
    assert_eq!(ok(&plain).photo, got.photo);
    assert_eq!(again.stripped.as_deref(), Some(stripped.as_slice()), "stripping twice changes nothing");
    let turned = ok(&with_exif(&plain, &tiff(6, None)));
    assert!(turned.stripped.is_none());
    assert_eq!((turned.photo.width, turned.photo.height), (24, 40));
}

#[test]
fn webp_is_carried_without_its_metadata_unless_it_is_transparent() {
    let plain = file(picture(30, 20), ImageFormat::WebP);
    let mut extended = b"RIFF\0\0\0\0WEBPVP8X\x0a\0\0\0\x2c\0\0\0\x1d\0\0\x13\0\0".to_vec();
    extended.extend_from_slice(b"ICCP\x04\0\0\0junk");
    extended.extend_from_slice(&plain[12..]);
    let tiff = tiff(1, None);
    extended.extend_from_slice(b"EXIF");
    extended.extend_from_slice(&(tiff.len() as u32).to_le_bytes());
    extended.extend_from_slice(&tiff);
    extended.extend_from_slice(b"XMP \x03\0\0\0GPS\0");
    let length = (extended.len() - 8) as u32;
    extended[4..8].copy_from_slice(&length.to_le_bytes());
    let (a, b) = (ok(&plain), ok(&extended));
    assert_eq!(a.photo, b.photo);
    let stripped = b.stripped.unwrap();
    for name in [b"EXIF", b"XMP ", b"ICCP"] {
        assert!(!contains(&stripped, name));
    }
    assert_eq!(stripped[20], 0, "no feature flag is left");
    assert_eq!(ok(&stripped).photo, a.photo);

    let clear = ImageBuffer::from_fn(8, 8, |x, _| Rgba([200u8, 100, 50, if x < 4 { 255 } else { 0 }]));
    let got = ok(&file(clear, ImageFormat::WebP));
    assert!(got.stripped.is_none());
    assert_eq!((got.photo.at(0, 0), got.photo.at(7, 7)), ([200, 100, 50], [255, 255, 255]));
}

#[test]
fn the_focal_length_comes_from_exif_if_it_is_plausible() {
    let base = jpeg(40, 24);
    let short = |v: u16| Some((3, [v.to_le_bytes()[0], v.to_le_bytes()[1], 0, 0], [].as_slice()));
    let got = ok(&with_exif(&base, &tiff(1, short(27))));
    assert!((got.intrinsics.fx - 27.0 / 36.0 * 40.0).abs() < 1e-9);
    let turned = ok(&with_exif(&base, &tiff(6, short(27))));
    assert!((turned.intrinsics.fx - 30.0).abs() < 1e-9, "the longer side counts, whichever way the camera was held");
    assert!((turned.intrinsics.cx - 12.0).abs() < 1e-9);
    let reduced = decode(&with_exif(&base, &tiff(1, short(27))), &Limits::default(), Some(20)).unwrap();
    assert!((reduced.intrinsics.fx - 15.0).abs() < 1e-9);
    // both ends of the range, and values outside; `tmpi-lab check` has NaN, 1e9 and others
    for (value, sane) in [(7, false), (8, true), (600, true), (601, false), (0, false), (65_535, false)] {
        assert_eq!(ok(&with_exif(&base, &tiff(1, short(value)))).intrinsics != ok(&base).intrinsics, sane, "{value} mm");
    }
    let over_zero = [27u32.to_le_bytes(), 0u32.to_le_bytes()].concat();
    assert_eq!(ok(&with_exif(&base, &tiff(1, Some((5, 56u32.to_le_bytes(), &over_zero))))).intrinsics, ok(&base).intrinsics);
}

#[test]
fn every_kind_of_png_decodes() {
    let grey = file(ImageBuffer::from_fn(5, 3, |x, _| Luma([(x * 50) as u8])), ImageFormat::Png);
    assert_eq!(ok(&grey).photo.at(4, 0), [200; 3]);
    let grey_alpha = file(ImageBuffer::from_fn(5, 3, |_, _| LumaA([200u8, 128])), ImageFormat::Png);
    assert_eq!(ok(&grey_alpha).photo.at(0, 0), [227; 3]);
    let wide = file(ImageBuffer::from_fn(5, 3, |_, _| Rgb([0xFFFFu16, 0x8080, 0x0101])), ImageFormat::Png);
    assert_eq!(ok(&wide).photo.at(0, 0), [255, 128, 1]);
    let wide_alpha = file(ImageBuffer::from_fn(5, 3, |_, _| Rgba([0xFFFFu16, 0x8080, 0, 0])), ImageFormat::Png);
    assert_eq!(ok(&wide_alpha).photo.at(0, 0), [255; 3], "transparent over white");
    let wide_grey = file(ImageBuffer::from_fn(5, 3, |_, _| Luma([0x1234u16])), ImageFormat::Png);
    assert_eq!(ok(&wide_grey).photo.at(0, 0), [0x12; 3]);
    for got in [grey, grey_alpha, wide, wide_alpha, wide_grey].map(|f| ok(&f)) {
        assert_eq!((got.photo.rgb.len(), got.format), (15, PhotoFormat::Png));
        assert!(got.stripped.is_none());
    }
}

#[test]
fn cmyk_decodes_and_is_not_carried() {
    let got = ok(&Jpeg::new(16, 8, components(&[(1, 1); 4])).write(|_, x, _| if x < 8.0 { 255.0 } else { 0.0 }));
    assert_eq!(got.photo.rgb.len(), 128);
    assert!(got.stripped.is_none());
    // without an Adobe marker, full ink is black and no ink is white, or the reverse: the halves differ by the whole range
    let (a, b) = (got.photo.at(0, 0), got.photo.at(15, 0));
    assert!(a[0].abs_diff(b[0]) > 250, "{a:?} {b:?}");
}

#[test]
fn a_file_cut_at_any_length_is_refused_or_damaged() {
    for format in [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::WebP] {
        let whole = file(picture(33, 17), format);
        ok(&whole);
        for end in 0..whole.len() {
            let cut = decode(&whole[..end], &Limits::default(), None);
            // the end chunk of a PNG holds nothing of the picture
            let harmless = format == ImageFormat::Png && end >= whole.len() - 12;
            assert!(!harmless || cut.as_ref().is_ok_and(|d| !d.damaged), "cut to {end}: still complete");
            // neither does the padding byte at the end of a WebP
            let harmless = harmless || (format == ImageFormat::WebP && end == whole.len() - 1);
            // a JPEG cut near its end is damaged; its last bytes may hold nothing but the end marker
            let harmless = harmless || (format == ImageFormat::Jpeg && end >= whole.len() - 2 - jpeg_metadata::READ_AHEAD);
            let harmless = harmless || cut.as_ref().is_ok_and(|d| format == ImageFormat::Jpeg && d.damaged && end > whole.len() / 2);
            assert!(cut.is_err() || harmless, "{format:?} cut to {end} of {} bytes", whole.len());
        }
    }
}

#[test]
fn a_png_with_a_wrong_checksum_is_damaged_and_a_webp_with_a_wrong_length_is_not() {
    let whole = file(picture(33, 17), ImageFormat::Png);
    let data = whole.windows(4).position(|w| w == b"IDAT").unwrap();
    let length = u32::from_be_bytes(*whole[data - 4..].first_chunk().unwrap()) as usize;
    let mut wrong = whole.clone();
    wrong[data + 4 + length] ^= 1;
    let got = ok(&wrong);
    assert!(got.damaged && got.photo == ok(&whole).photo && !ok(&whole).damaged);
    // metadata that follows the picture and is cut short
    let webp = file(picture(33, 17), ImageFormat::WebP);
    for (more, behind) in [(100, &b""[..]), (0, &b"XMP \xFF\xFF\0\0cut"[..]), (100, &b"EXIF"[..])] {
        let mut file = [&webp[..], behind].concat();
        let riff = (webp.len() - 8 + behind.len() + more) as u32;
        file[4..8].copy_from_slice(&riff.to_le_bytes());
        let got = ok(&file);
        assert!(got.photo == ok(&webp).photo && !got.damaged, "{more} {behind:?}");
    }
}

#[test]
fn the_default_limits_are_checked_by_headers_alone() {
    // headers without any pixel: decoding first would fail for lack of data, not for size
    let mut png = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR".to_vec();
    png.extend_from_slice(&16_385u32.to_be_bytes());
    png.extend_from_slice(&1u32.to_be_bytes());
    png.extend_from_slice(&[8, 2, 0, 0, 0]);
    assert!(matches!(decode(&png, &Limits::default(), None), Err(PhotoError::SideTooLong { .. })));
    png[16..24].copy_from_slice(&[10_000u32.to_be_bytes(), 5_001u32.to_be_bytes()].concat());
    assert!(matches!(decode(&png, &Limits::default(), None), Err(PhotoError::TooManyPixels { .. })));
    let mut webp = file(picture(8, 8), ImageFormat::WebP);
    let bits = u32::from_le_bytes([webp[21], webp[22], webp[23], webp[24]]) & !0x0FFF_FFFF | 0x270F | (5_000 << 14);
    webp[21..25].copy_from_slice(&bits.to_le_bytes());
    assert!(matches!(decode(&webp, &Limits::default(), None), Err(PhotoError::TooManyPixels { width: 10_000, height: 5_001, .. })));
    let mut jpeg = jpeg(8, 8);
    let frame = jpeg.windows(2).position(|w| w == [0xFF, 0xC0]).unwrap();
    jpeg[frame + 5..frame + 9].copy_from_slice(&[0x40, 0x01, 0, 8]);
    assert!(matches!(decode(&jpeg, &Limits::default(), None), Err(PhotoError::SideTooLong { width: 8, height: 16_385, .. })));
}

#[test]
fn reduction_keeps_the_picture_whichever_way_it_is_decoded() {
    let jpeg = jpeg(800, 600);
    let full = ok(&jpeg).photo;
    for max in [790, 400, 390, 200, 101, 64, 1] {
        let got = decode(&jpeg, &Limits::default(), Some(max)).unwrap();
        assert_eq!(got.photo.width, max);
        assert_eq!(got.original, (800, 600));
        assert!(got.stripped.is_none());
        let want = resize(&full, got.photo.width, got.photo.height);
        let off = |a: &[u8; 3], b: &[u8; 3]| (0..3).map(|c| f64::from(a[c].abs_diff(b[c]))).sum::<f64>() / 3.0;
        let mean = got.photo.rgb.iter().zip(&want.rgb).map(|(a, b)| off(a, b)).sum::<f64>() / want.rgb.len() as f64;
        assert!(mean < 3.0, "{max} px: {mean} levels");
    }
    assert_eq!(decode(&jpeg, &Limits::default(), Some(800)).unwrap().photo, full);
    assert_eq!(reduced_size((20_000, 1), Some(100)), (100, 1));
}

#[test]
fn resampling_agrees_with_sums_in_f64_and_keeps_constants() {
    let source: Vec<f32> = (0..37 * 23).map(|i| ((i * 7919) % 101) as f32 / 101.0).collect();
    for (to, filter) in [
        ((11, 9), Filter::Lanczos3),
        ((80, 51), Filter::Triangle),
        ((13, 70), Filter::Cubic),
        ((1, 1), Filter::Lanczos3),
        ((37, 1), Filter::Triangle),
    ] {
        let got = resample(&source, (37, 23), to, filter, |v| [v], |[v]| v);
        for y in 0..to.1 {
            for x in 0..to.0 {
                let want = by_definition(&source, (37, 23), to, filter, (x, y));
                let v = f64::from(got[(y * to.0 + x) as usize]);
                assert!((v - want).abs() < 1e-5, "{to:?} {filter:?} at {x},{y}: {v} for {want}");
            }
        }
        let flat = resample(&[0.7f32; 37 * 23], (37, 23), to, filter, |v| [v], |[v]| v);
        assert!(flat.iter().all(|v| (v - 0.7).abs() < 1e-5));
    }
}

fn by_definition(source: &[f32], from: (u32, u32), to: (u32, u32), filter: Filter, at: (u32, u32)) -> f64 {
    let kernel = |x: f64| match filter {
        Filter::Triangle => (1.0 - x.abs()).max(0.0),
        Filter::Cubic => match x.abs() {
            x if x < 1.0 => 1.5 * x.powi(3) - 2.5 * x * x + 1.0,
            x if x < 2.0 => -0.5 * x.powi(3) + 2.5 * x * x - 4.0 * x + 2.0,
            _ => 0.0,
        },
        Filter::Lanczos3 if x == 0.0 => 1.0,
        Filter::Lanczos3 if x.abs() >= 3.0 => 0.0,
        Filter::Lanczos3 => {
            let sinc = |v: f64| (std::f64::consts::PI * v).sin() / (std::f64::consts::PI * v);
            sinc(x) * sinc(x / 3.0)
        }
    };
    let weight = |i: u32, from: u32, to: u32, s: u32| {
        let ratio = f64::from(from) / f64::from(to);
        kernel((f64::from(s) + 0.5 - (f64::from(i) + 0.5) * ratio) / ratio.max(1.0))
    };
    let (mut sum, mut all) = (0.0, 0.0);
    for y in 0..from.1 {
        for x in 0..from.0 {
            let w = weight(at.0, from.0, to.0, x) * weight(at.1, from.1, to.1, y);
            sum += w * f64::from(source[(y * from.0 + x) as usize]);
            all += w;
        }
    }
    sum / all
}

#[test]
fn a_wide_gamut_profile_is_converted_and_an_srgb_profile_is_not() {
    let icc = |p: moxcms::ColorProfile| with_profile(&jpeg(40, 24), &p.encode().unwrap());
    let plain = ok(&jpeg(40, 24));
    let same = ok(&icc(moxcms::ColorProfile::new_srgb()));
    assert!(same.photo == plain.photo && same.stripped.is_some());
    let wide = ok(&icc(moxcms::ColorProfile::new_display_p3()));
    assert!(wide.photo != plain.photo && wide.stripped.is_none());
    let junk = ok(&with_profile(&jpeg(40, 24), b"not a profile"));
    assert_eq!(junk.photo, plain.photo);
}
