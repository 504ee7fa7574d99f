//! Second pictures made to break their readers.

use std::sync::Arc;

use image::{ImageFormat, RgbImage};
use proptest::prelude::*;
use tmpi_testing::jpeg::{EYE, multi_picture};
use tmpi_testing::pictures::encoded;

use super::tests::{beside, spots};
use super::*;
use crate::depth::DepthError;
use crate::photo::{Limits, PhotoError};
use crate::{Made, MakeError, Models, Options, Report, Silent, Switch, make};

const W: u32 = 120;
const H: u32 = 90;
/// Disparity of the upper and of the lower half, in pixels.
const SHIFTS: (i32, i32) = (2, 8);

fn file(photo: &Photo, format: ImageFormat) -> Vec<u8> {
    encoded(RgbImage::from_vec(photo.width, photo.height, photo.rgb.as_flattened().to_vec()).unwrap(), format)
}

fn jpeg(photo: &Photo) -> Vec<u8> {
    file(photo, ImageFormat::Jpeg)
}

fn first() -> Photo {
    spots(W, H, 11)
}

fn second() -> Photo {
    beside(&first(), SHIFTS.0, SHIFTS.1)
}

fn made_with(value: f32, limits: &Limits, photo: &[u8], given: Option<&[u8]>, options: &Options) -> Result<Made, MakeError> {
    let constant = move |photo: &Photo| Ok(DisparityMap::from_fn(photo.width, photo.height, |_, _| value));
    let models = Models { depth: Arc::new(("constant", constant)), theta: None, psi: None };
    let made = make(&models, limits, photo, given, options, &Silent)?;
    assert!(made.disparity.delta.iter().all(|d| (0.0..=1.0).contains(d)));
    Ok(made)
}

fn made(photo: &[u8], given: Option<&[u8]>, options: &Options) -> Result<Report, MakeError> {
    made_with(0.5, &Limits::default(), photo, given, options).map(|made| made.report)
}

fn is_measured(report: &Report) -> bool {
    let measured = report.error.stereo.is_some_and(|s| s.measured > 0.7 && (s.nearest_px - f64::from(SHIFTS.1)).abs() < 1.5);
    measured && report.depth_model == "stereo" && report.input.depth_problem.is_none()
}

/// The network's estimate was used, for the reason `why` or for none.
#[track_caller]
fn is_estimated(report: &Report, why: Option<&str>) {
    let problem = report.input.depth_problem.as_deref();
    assert!(report.depth_model == "constant" && report.error.stereo.is_none(), "{}", report.depth_model);
    assert!(why.map_or(problem.is_none(), |why| problem.is_some_and(|p| p.contains(why))), "{why:?}: {problem:?}");
}

fn beside_it() -> Options {
    Options { stereo: Stereo::Beside, ..Options::default() }
}

fn only_depth() -> Options {
    Options { photo_depth: Switch::On, ..Options::default() }
}

/// Attributes of a large thumbnail.
const THUMBNAIL: u32 = 0x0001_0001;
/// Attributes of the first picture of a pair, which declares that it stands for both.
const FIRST_EYE: u32 = 0x2002_0002;

#[test]
fn the_first_eye_after_a_photo_is_used_however_many_pictures_follow() {
    let (a, b) = (jpeg(&first()), jpeg(&second()));
    let (small, even) = (jpeg(&spots(16, 12, 1)), jpeg(&Photo { rgb: vec![[90; 3]; (W * H) as usize], ..first() }));
    let options = Options::default();
    for behind in [&[][..], &[(THUMBNAIL, &small[..])], &[(0, &b), (THUMBNAIL, &b)]] {
        let file = multi_picture(&a, behind);
        is_estimated(&made(&file, None, &options).unwrap(), None);
        assert!(matches!(made(&file, None, &only_depth()), Err(MakeError::Depth(DepthError::NotEmbedded))));
    }
    let many = [vec![(THUMBNAIL, &small[..]); 14], vec![(EYE, &b)]].concat();
    for behind in [&[(EYE, &b[..])][..], &[(THUMBNAIL, &small), (EYE, &b)], &[(FIRST_EYE, &b), (EYE, &even), (EYE, &a)], &many] {
        assert!(is_measured(&made(&multi_picture(&a, behind), None, &options).unwrap()), "{} pictures", behind.len() + 1);
    }
    is_estimated(&made(&multi_picture(&a, &[(EYE, &b)]), None, &Options { stereo: Stereo::None, ..Options::default() }).unwrap(), None);
    // after more pictures than are looked at
    let more = [vec![(THUMBNAIL, &small[..]); 300], vec![(EYE, &b)]].concat();
    is_estimated(&made(&multi_picture(&a, &more), None, &options).unwrap(), None);
}

#[test]
fn a_truncated_or_missing_second_picture_leaves_depth_to_the_network() {
    let (a, b) = (jpeg(&first()), jpeg(&second()));
    let whole = multi_picture(&a, &[(EYE, &b)]);
    let behind = whole.len() - b.len();
    for cut in [1, b.len() / 2, b.len() - 1, b.len()] {
        let file = &whole[..whole.len() - cut];
        is_estimated(&made(file, None, &Options::default()).unwrap(), Some("the file ends within"));
        assert!(matches!(made(file, None, &only_depth()), Err(MakeError::Depth(DepthError::Second(_)))));
    }
    // its entry points to something else, to nothing, or to the first picture
    for (length, at) in [(b.len(), behind - 9), (0, behind - 10), (u32::MAX as usize, u32::MAX as usize), (8, 0)] {
        let mut file = whole.clone();
        let entry = file.windows(4).position(|w| w == EYE.to_be_bytes()).unwrap();
        file[entry + 4..entry + 8].copy_from_slice(&(length as u32).to_be_bytes());
        file[entry + 8..entry + 12].copy_from_slice(&(at as u32).to_be_bytes());
        is_estimated(&made(&file, None, &Options::default()).unwrap(), Some("second eye"));
    }
    // cut within its own data: most of a picture must be intact
    for (keep, taken) in [(2, false), (30, false), (b.len() / 4, false), (b.len() * 19 / 20, true)] {
        let given = made(&a, Some(&b[..keep]), &beside_it());
        let within = made(&multi_picture(&a, &[(EYE, &b[..keep])]), None, &Options::default()).unwrap();
        if taken {
            assert!(is_measured(&given.unwrap()) && is_measured(&within), "{keep} bytes");
        } else {
            assert!(matches!(given, Err(MakeError::Depth(DepthError::Second(_)))), "{keep} bytes");
            is_estimated(&within, Some("second eye"));
        }
    }
    for bytes in [&b""[..], b"GIF89a", &a[..20]] {
        assert!(matches!(made(&a, Some(bytes), &beside_it()), Err(MakeError::Depth(DepthError::Second(_)))));
    }
}

/// A PNG whose header claims another size.
fn claims(width: u32, height: u32) -> Vec<u8> {
    let mut png = file(&Photo { width: 1, height: 1, rgb: vec![[7; 3]] }, ImageFormat::Png);
    png[16..20].copy_from_slice(&width.to_be_bytes());
    png[20..24].copy_from_slice(&height.to_be_bytes());
    let sum = crc32fast::hash(&png[12..29]);
    png[29..33].copy_from_slice(&sum.to_be_bytes());
    png
}

#[test]
fn limits_are_checked_for_both_pictures_before_decoding() {
    let (limits, options) = (Limits { pixels: u64::from(W * H), ..Limits::default() }, beside_it());
    let (png, other) = (file(&first(), ImageFormat::Png), file(&second(), ImageFormat::Png));
    let with = |photo: &[u8], given: &[u8]| made_with(0.5, &limits, photo, Some(given), &options).map(|made| made.report);
    assert!(is_measured(&with(&png, &other).unwrap()));
    // corrupt pixels show that nothing is decoded before the limits are checked
    let mut corrupt = png.clone();
    let data = corrupt.windows(4).position(|name| name == b"IDAT").unwrap() + 4;
    corrupt[data] ^= 0xFF;
    assert!(matches!(with(&corrupt, &other), Err(MakeError::Photo(PhotoError::Broken(_)))));
    for huge in [claims(W, H + 1), claims(16_384, 16_384), claims(1, 60_000)] {
        let refused = with(&corrupt, &huge).unwrap_err();
        assert!(matches!(&refused, MakeError::Depth(DepthError::Second(text)) if text.contains("limit")), "{refused}");
        assert!(matches!(with(&huge, &corrupt), Err(MakeError::Photo(PhotoError::TooManyPixels { .. } | PhotoError::SideTooLong { .. }))));
        // within the photo's file it is ignored
        let behind = multi_picture(&jpeg(&first()), &[(EYE, &huge)]);
        let report = made_with(0.5, &limits, &behind, None, &Options::default()).unwrap().report;
        is_estimated(&report, Some("second eye"));
    }
    let memory = Limits { memory: 300 << 20, ..Limits::default() };
    let sizes = crate::Sizes::of(&png, Some(&claims(6000, 4000)), &options, &memory).unwrap();
    assert!(matches!(options.fitted(&sizes, &memory), Err(MakeError::Depth(DepthError::Second(_)))));
}

#[test]
fn a_picture_after_a_photo_takes_no_more_memory_than_the_photo() {
    let a = jpeg(&first());
    let larger = multi_picture(&a, &[(EYE, &claims(2000, 1001))]);
    is_estimated(&made(&larger, None, &Options::default()).unwrap(), Some("larger than that of the first"));
    let sizes = |file: &[u8], options: &Options| crate::Sizes::of(file, None, options, &Limits::default()).unwrap();
    let auto = Options::default();
    assert_eq!(sizes(&larger, &auto).extra, None);
    // a second picture counts only if it is measured
    let both = multi_picture(&a, &[(EYE, &jpeg(&second()))]);
    assert_eq!(sizes(&both, &auto).extra, Some(crate::run::ExtraPicture::SecondPicture((W, H))));
    for off in [Options { stereo: Stereo::None, ..auto.clone() }, Options { photo_depth: Switch::Off, ..auto.clone() }] {
        assert_eq!(sizes(&both, &off).extra, None);
        assert_eq!(made(&both, None, &off).unwrap().depth_model, "constant");
    }
    let report = made(&both, None, &auto).unwrap();
    let bound = |sizes| auto.memory_with(&sizes, None, report.planes_per_tile.ceil() as u32);
    assert_eq!(report.memory_bound_bytes, bound(sizes(&both, &auto)));
    assert!(report.memory_bound_bytes > bound(crate::Sizes::of_photo((W, H))));
}

#[test]
fn identical_or_tiny_pictures_leave_depth_to_the_network() {
    let a = file(&first(), ImageFormat::Png);
    is_estimated(&made(&a, Some(&a), &beside_it()).unwrap(), Some("no parallax"));
    let both = multi_picture(&jpeg(&first()), &[(EYE, &jpeg(&first()))]);
    is_estimated(&made(&both, None, &Options::default()).unwrap(), Some("no parallax"));
    for (w, h) in [(1, 1), (1, 2), (2, 1), (1, 300), (300, 1), (63, 400), (400, 63)] {
        let (a, b) = (spots(w, h, 1), spots(w, h, 2));
        let given = made(&file(&a, ImageFormat::Png), Some(&file(&b, ImageFormat::Png)), &beside_it()).unwrap();
        is_estimated(&given, Some("too small"));
        let within = made(&multi_picture(&jpeg(&a), &[(EYE, &jpeg(&b))]), None, &Options::default()).unwrap();
        is_estimated(&within, Some("too small"));
        for stereo in [Stereo::LeftRight, Stereo::TopBottom] {
            let report = made(&file(&a, ImageFormat::Png), None, &Options { stereo, ..Options::default() }).unwrap();
            assert!(report.depth_model == "constant" && (report.width, report.height) <= (w, h), "{w}×{h}");
        }
    }
}

#[test]
fn a_non_finite_estimate_keeps_measured_pixels() {
    let (photo, size) = (first(), (W * H) as usize);
    let measured = || measure(&photo, &second()).unwrap();
    let joined = |estimate: &dyn Fn(usize) -> f32| {
        let estimate = DisparityMap { width: W, height: H, delta: (0..size).map(estimate).collect() };
        measured().fuse(&photo, &estimate)
    };
    let known: Vec<bool> = measured().disparity.iter().map(|d| d.is_finite()).collect();
    let ramp = |i: usize| (i / W as usize) as f32 / H as f32;
    let plain = joined(&ramp);
    let some = |bad: f32| move |i: usize| if i.is_multiple_of(7) { bad } else { ramp(i) };
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN] {
        for got in [joined(&|_| bad), joined(&some(bad))] {
            assert!(got.map.delta.iter().all(|d| (0.0..=1.0).contains(d)), "{bad}");
            let figures = got.figures;
            assert!(!figures.crossed && figures.nearest_px.is_finite() && figures.infinity_px.is_finite(), "{bad}: {figures:?}");
            let off = (0..size).filter(|i| known[*i] && (got.map.delta[*i] - plain.map.delta[*i]).abs() > 0.1).count();
            assert!(off < size / 50, "{bad}: {off} measured pixels have moved");
        }
    }
    let report = made_with(f32::NAN, &Limits::default(), &jpeg(&first()), Some(&jpeg(&second())), &beside_it()).unwrap().report;
    assert!(is_measured(&report));
}

#[test]
fn small_pictures_are_measured_only_if_they_belong_together() {
    for (w, h) in [(64, 64), (100, 64), (64, 200)] {
        for seed in (0..8).map(|s| 2 * s) {
            let a = spots(w, h, seed);
            assert!(measure(&a, &spots(w, h, seed + 1)).is_err(), "{w}×{h}, {seed}: by chance");
            assert!(measure(&a, &beside(&a, 1, 5)).is_ok(), "{w}×{h}, {seed}");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn damage_to_a_file_of_two_eyes_is_an_error_or_ignored(at in 0usize..20_000, value: u8, cut in 0usize..30_000) {
        let (a, b) = (spots(72, 64, 3), beside(&spots(72, 64, 3), 1, 5));
        let mut file = multi_picture(&jpeg(&a), &[(EYE, &jpeg(&b))]);
        let at = at % file.len();
        file[at] = value;
        file.truncate(cut.max(2));
        if let Ok(report) = made(&file, None, &Options::default()) {
            prop_assert!(["stereo", "constant", "embedded"].contains(&report.depth_model.as_str()));
        }
    }
}
