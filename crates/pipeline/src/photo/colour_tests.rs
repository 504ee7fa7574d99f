//! Colours: ICC profiles, `cICP` code points, alpha.

use image::{DynamicImage, ImageBuffer, ImageFormat, Luma, LumaA, Rgb, Rgba};
use moxcms::{ColorProfile, ToneReprCurve};
use tmpi_testing::jpeg::with_profile;
use tmpi_testing::pictures::jpeg;
use tmpi_testing::png::{chunk, iccp};

use super::tests::{file, ok, picture};
use super::*;

/// sRGB encoding of linear light 0 to 1, in levels of 255.
fn encoded(light: f64) -> f64 {
    let light = light.clamp(0.0, 1.0);
    255.0 * if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
}

fn linear_grey() -> Vec<u8> {
    ColorProfile::new_gray_with_gamma(1.0).encode().unwrap()
}

/// A profile with sRGB's primaries and linear samples.
fn linear_rgb() -> Vec<u8> {
    let mut profile = ColorProfile::new_srgb();
    for curve in [&mut profile.red_trc, &mut profile.green_trc, &mut profile.blue_trc] {
        *curve = Some(ToneReprCurve::Lut(vec![]));
    }
    profile.cicp = None;
    profile.encode().unwrap()
}

fn p3() -> Vec<u8> {
    ColorProfile::new_display_p3().encode().unwrap()
}

/// A PNG of these pixels with `chunks` after its header.
fn png(image: impl Into<DynamicImage>, chunks: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = file(image, ImageFormat::Png);
    bytes.splice(33..33, chunks.concat());
    bytes
}

fn cicp(primaries: u8, transfer: u8) -> Vec<u8> {
    chunk(b"cICP", &[primaries, transfer, 0, 1])
}

fn jpeg_with(image: impl Into<DynamicImage>, profile: &[u8]) -> Vec<u8> {
    with_profile(&jpeg(image, 100), profile)
}

fn near(got: &Photo, levels: f64, want: impl Fn(u32, u32) -> [f64; 3], of: &str) {
    for y in 0..got.height {
        for x in 0..got.width {
            let (got, want) = (got.at(x, y), want(x, y));
            assert!((0..3).all(|c| (f64::from(got[c]) - want[c]).abs() <= levels), "{of} at {x},{y}: {got:?}, {want:?} wanted");
        }
    }
}

fn ramp(x: u32) -> u8 {
    (x * 4) as u8
}

#[test]
fn grey_and_rgb_profiles_convert_grey_pictures() {
    let grey = ImageBuffer::from_fn(64, 2, |x, _| Luma([ramp(x)]));
    let clear = ImageBuffer::from_fn(64, 2, |x, _| LumaA([ramp(x), 255]));
    let wide = ImageBuffer::from_fn(64, 2, |x, _| Luma([u16::from(ramp(x)) * 257]));
    let want = |x: u32, _| [encoded(f64::from(ramp(x)) / 255.0); 3];
    for profile in [linear_grey(), linear_rgb()] {
        near(&ok(&png(grey.clone(), &[iccp(&profile)])).photo, 1.0, want, "grey");
        near(&ok(&png(clear.clone(), &[iccp(&profile)])).photo, 1.0, want, "grey and alpha");
        near(&ok(&png(wide.clone(), &[iccp(&profile)])).photo, 1.0, want, "16 bits");
        // the curve is steep in the first columns and amplifies the encoder's own error
        let jpeg = ok(&jpeg_with(grey.clone(), &profile));
        assert!(jpeg.stripped.is_none());
        let off = |x: u32| (f64::from(jpeg.photo.at(x, 1)[0]) - want(x, 1)[0]).abs();
        assert!((8..64).all(|x| off(x) < 4.0), "{:?}", (8..64).map(off).collect::<Vec<_>>());
        let half = decode(&jpeg_with(grey.clone(), &profile), &Limits::default(), Some(32)).unwrap().photo;
        assert!((f64::from(half.at(16, 0)[0]) - encoded(130.0 / 255.0)).abs() < 4.0);
    }
}

#[test]
fn a_grey_profile_leaves_coloured_pictures_unchanged() {
    let coloured = picture(40, 24);
    assert_eq!(ok(&png(coloured.clone(), &[iccp(&linear_grey())])).photo, ok(&png(coloured.clone(), &[])).photo);
    let plain = ok(&jpeg_with(coloured.clone(), b"no profile"));
    let got = ok(&jpeg_with(coloured, &linear_grey()));
    assert!(got.photo == plain.photo && got.stripped.is_some());
}

#[test]
fn cicp_code_points_of_a_png_select_its_colour_space() {
    let coloured = picture(40, 24);
    let plain = ok(&png(coloured.clone(), &[])).photo;
    let by_profile = ok(&png(coloured.clone(), &[iccp(&p3())])).photo;
    assert_ne!(plain, by_profile);
    // Display P3 alone, and beside a profile of another colour space, which it overrides
    for chunks in [vec![cicp(12, 13)], vec![cicp(12, 13), iccp(&linear_rgb())], vec![iccp(&linear_rgb()), cicp(12, 13)]] {
        near(&ok(&png(coloured.clone(), &chunks)).photo, 1.0, |x, y| by_profile.at(x, y).map(f64::from), "P3");
    }
    let light = |x: u32, y: u32| plain.at(x, y).map(|v| encoded(f64::from(v) / 255.0));
    near(&ok(&png(coloured.clone(), &[cicp(1, 8)])).photo, 1.0, light, "linear");
    let video = |x: u32, y: u32| plain.at(x, y).map(|v| encoded((f64::from(v) / 255.0).powf(2.4)));
    near(&ok(&png(coloured.clone(), &[cicp(1, 1)])).photo, 1.5, video, "video");
    assert_eq!(ok(&png(coloured.clone(), &[cicp(1, 13)])).photo, plain);
    // luma and chroma, limited range, reserved and unspecified code points; below, a chunk that is too short
    for unknown in [[12, 13, 1, 1], [12, 13, 0, 0], [0, 13, 0, 1], [12, 0, 0, 1], [2, 2, 0, 1]] {
        assert_eq!(ok(&png(coloured.clone(), &[chunk(b"cICP", &unknown)])).photo, plain, "{unknown:?}");
        let both = [chunk(b"cICP", &unknown), iccp(&p3())];
        assert_eq!(ok(&png(coloured.clone(), &both)).photo, by_profile, "{unknown:?} before a profile");
    }
    assert_eq!(ok(&png(coloured.clone(), &[chunk(b"cICP", &[12, 13])])).photo, plain);
}

#[test]
fn sixteen_bit_pictures_keep_shadow_detail_through_a_conversion() {
    let dark = ImageBuffer::from_fn(64, 2, |x, _| Rgb([x as u16 * 16; 3]));
    let want = |x: u32, _| [encoded(f64::from(x * 16) / 65_535.0); 3];
    near(&ok(&png(dark, &[cicp(1, 8)])).photo, 1.0, want, "dark light");
}

#[test]
fn transparent_pixels_are_blended_after_the_conversion() {
    let opaque = picture(40, 24);
    let alpha = |x: u32, y: u32| (x * 6 + y) as u8;
    let converted = ok(&png(opaque.clone(), &[iccp(&p3())])).photo;
    let clear = ImageBuffer::from_fn(40, 24, |x, y| {
        let p = opaque.get_pixel(x, y);
        Rgba([p[0], p[1], p[2], alpha(x, y)])
    });
    let want = |x: u32, y: u32| {
        let a = f64::from(alpha(x, y)) / 255.0;
        converted.at(x, y).map(|v| f64::from(v) * a + 255.0 * (1.0 - a))
    };
    near(&ok(&png(clear.clone(), &[iccp(&p3())])).photo, 1.0, want, "RGBA");
    let wide = DynamicImage::from(clear).to_rgba16();
    near(&ok(&png(wide, &[cicp(12, 13)])).photo, 2.0, want, "RGBA of 16 bits");
    let grey = ImageBuffer::from_fn(40, 24, |x, y| LumaA([ramp(x), alpha(x, y)]));
    let want = |x: u32, y: u32| {
        let a = f64::from(alpha(x, y)) / 255.0;
        [encoded(f64::from(ramp(x)) / 255.0) * a + 255.0 * (1.0 - a); 3]
    };
    near(&ok(&png(grey, &[iccp(&linear_grey())])).photo, 1.0, want, "grey and alpha");
}

/// A WebP with a `VP8X` header of these flags and this size, followed by `chunks`.
fn webp(flags: u8, (width, height): (u32, u32), chunks: &[(&[u8; 4], Vec<u8>)]) -> Vec<u8> {
    let side = |s: u32| (s - 1).to_le_bytes()[..3].to_vec();
    let head = [vec![flags, 0, 0, 0], side(width), side(height)].concat();
    let all = [(b"VP8X", head)].into_iter().chain(chunks.iter().cloned());
    let body: Vec<u8> =
        all.flat_map(|(name, body)| [&name[..], &(body.len() as u32).to_le_bytes(), &body, &vec![0; body.len() % 2]].concat()).collect();
    [b"RIFF", &(body.len() as u32 + 4).to_le_bytes()[..], b"WEBP", &body].concat()
}

/// A picture's WebP chunk without the file around it.
fn bitstream(image: impl Into<DynamicImage>) -> Vec<u8> {
    file(image, ImageFormat::WebP)[20..].to_vec()
}

#[test]
fn a_canvas_is_white_outside_a_smaller_frame() {
    let frame = picture(16, 10);
    let at = |x: u32, y: u32| [&(x / 2).to_le_bytes()[..3], &(y / 2).to_le_bytes()[..3]].concat();
    let frame_of = |x, y| {
        let picture = bitstream(frame.clone());
        let chunk = [b"VP8L", &(picture.len() as u32).to_le_bytes()[..], &picture, &vec![0; picture.len() % 2]].concat();
        [at(x, y), vec![15, 0, 0, 9, 0, 0, 100, 0, 0, 0], chunk].concat()
    };
    for (flags, (left, top)) in [(0x02, (4, 6)), (0x12, (4, 6)), (0x02, (0, 0)), (0x02, (14, 10))] {
        // a black background colour, which readers ignore
        let animation = (b"ANIM", vec![0, 0, 0, 255, 0, 0]);
        let got = ok(&webp(flags, (30, 20), &[animation, (b"ANMF", frame_of(left, top))]));
        let want = |x: u32, y: u32| {
            let inside = (left..left + 16).contains(&x) && (top..top + 10).contains(&y);
            if inside { frame.get_pixel(x - left, y - top).0 } else { [255; 3] }.map(f64::from)
        };
        near(&got.photo, 0.0, want, "animation");
        assert!(got.stripped.is_none());
    }
}

#[test]
fn a_webp_is_converted_by_its_profile_before_it_is_blended() {
    let clear = ImageBuffer::from_fn(16, 10, |x, _| Rgba([200u8, 40, 30, (x * 16) as u8]));
    let opaque = ImageBuffer::from_fn(16, 10, |_, _| Rgb([200u8, 40, 30]));
    let converted = ok(&png(opaque, &[iccp(&p3())])).photo.at(0, 0);
    let file = webp(0x30, (16, 10), &[(b"ICCP", p3()), (b"VP8L", bitstream(clear))]);
    let want = |x: u32, _| converted.map(|v| f64::from(v) * f64::from(x * 16) / 255.0 + 255.0 - f64::from(x * 16));
    near(&ok(&file).photo, 1.0, want, "WebP");
}

/// Known points of the two curves: PQ code 520 of 1023 is 100 nits (ITU-R BT.2408), HLG code 767.25 (three quarters) is reference white.
#[test]
fn high_dynamic_range_maps_reference_white_to_half() {
    let grey = |value: f64| ImageBuffer::from_pixel(4, 4, Rgb([(value * 65_535.0).round() as u16; 3]));
    let shown = |value, numbers: (u8, u8)| f64::from(ok(&png(grey(value), &[cicp(numbers.0, numbers.1)])).photo.at(1, 1)[0]);
    for primaries in [1, 9, 12] {
        assert!((shown(0.508_078, (primaries, 16)) - encoded(100.0 / 203.0 / 2.0)).abs() < 1.5, "100 nits");
        assert!((shown(0.580_689, (primaries, 16)) - encoded(0.5)).abs() < 1.5, "reference white");
        assert!((shown(0.75, (primaries, 18)) - encoded(0.5)).abs() < 1.5, "reference white of HLG");
        for transfer in [16, 18] {
            assert!(shown(0.0, (primaries, transfer)) < 0.5 && shown(1.0, (primaries, transfer)) > 254.5);
            let steps: Vec<f64> = (0..=32).map(|i| shown(f64::from(i) / 32.0, (primaries, transfer))).collect();
            assert!(steps.is_sorted() && steps.iter().filter(|v| **v < 255.0).count() > 20, "{steps:?}");
        }
    }
    // 8-bit samples give the same
    let byte = ImageBuffer::from_pixel(4, 4, Rgb([148u8; 3]));
    let got = ok(&png(byte, &[cicp(9, 16)])).photo.at(0, 0)[0];
    assert!((f64::from(got) - shown(148.0 / 255.0, (9, 16))).abs() < 1.0);
}
