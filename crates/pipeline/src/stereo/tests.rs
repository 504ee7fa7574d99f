//! Matching against its definition, and pairs made to break it.

use proptest::prelude::*;

use super::census::{Grey, census};
use super::rectify::{Model, rectify};
use super::sgm::{self, Range, Views};
use super::*;
use crate::depth::DepthError;
use crate::photo::resize;
use tmpi_testing::jpeg::{segment, with_segments};

fn noise(x: u32, y: u32, seed: u32) -> u8 {
    let i = (y.wrapping_mul(4099).wrapping_add(x).wrapping_add(seed.wrapping_mul(77_777))).wrapping_mul(2_654_435_761);
    ((i ^ (i >> 15)).wrapping_mul(0x2C1B_3C6D) >> 24) as u8
}

/// Spots a few pixels wide, as photos have them.
pub(super) fn spots(width: u32, height: u32, seed: u32) -> Photo {
    let (w, h) = (width.div_ceil(3), height.div_ceil(3));
    let small = Photo { width: w, height: h, rgb: (0..w * h).map(|i| [noise(i % w, i / w, seed); 3]).collect() };
    resize(&small, width, height)
}

/// `photo` seen from beside: its upper half moves `far` and its lower half `near` pixels to the left.
pub(super) fn beside(photo: &Photo, far: i32, near: i32) -> Photo {
    let (w, h) = (photo.width as i32, photo.height as i32);
    let from = |i: i32| (i / w, (i % w + if i / w < h / 2 { far } else { near }).clamp(0, w - 1));
    Photo { rgb: (0..w * h).map(|i| photo.rgb[(from(i).0 * w + from(i).1) as usize]).collect(), ..*photo }
}

fn grey_of(photo: &Photo) -> Grey {
    grey(photo, (photo.width, photo.height))
}

/// Costs of all disparities of all pixels, summed over eight paths by definition.
fn by_definition(first: &Grey, second: &Grey, range: Range) -> Vec<Vec<i64>> {
    let (w, h, n) = (first.width as i64, first.height as i64, range.count as i64);
    let [own, other] = [census(first), census(second)];
    let cost = |x: i64, y: i64, i: i64| {
        let to = x - i64::from(range.first) - i;
        if (0..w).contains(&to) { i64::from((own[(y * w + x) as usize] ^ other[(y * w + to) as usize]).count_ones()) } else { 30 }
    };
    let mut sums = vec![vec![0; n as usize]; (w * h) as usize];
    for (dx, dy) in [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)] {
        let mut path = vec![Vec::new(); (w * h) as usize];
        for j in 0..h {
            for k in 0..w {
                let (x, y) = (if dx < 0 { w - 1 - k } else { k }, if dy < 0 { h - 1 - j } else { j });
                let (px, py) = (x - dx, y - dy);
                let at = (y * w + x) as usize;
                path[at] = if (0..w).contains(&px) && (0..h).contains(&py) {
                    let before: &Vec<i64> = &path[(py * w + px) as usize];
                    let least = *before.iter().min().unwrap();
                    let step = i64::from(first.values[at].abs_diff(first.values[(py * w + px) as usize]));
                    let large = (100 * 12 / (12 + step)).max(9);
                    let one = |i: i64| {
                        let near = [i - 1, i + 1].into_iter().filter_map(|k| before.get(usize::try_from(k).ok()?)).min();
                        let near = near.map_or(i64::MAX, |v| v + 7);
                        cost(x, y, i) + before[i as usize].min(near).min(least + large) - least
                    };
                    (0..n).map(one).collect()
                } else {
                    (0..n).map(|i| cost(x, y, i)).collect()
                };
                sums[at].iter_mut().zip(&path[at]).for_each(|(s, p)| *s += p);
            }
        }
    }
    sums
}

/// Reference in `f64`: disparities of a row by the sums of its pixels. NaN where another position matches as well, where the other picture's
/// pixel has a smaller sum from elsewhere in the row, or where the best position lies outside.
fn chosen(sums: &[Vec<i64>], range: Range) -> Vec<f64> {
    let (w, n) = (sums.len() as i64, range.count as i64);
    let of = |x: i64| {
        let own = &sums[x as usize];
        let (least, i) = own.iter().zip(0..n).min().unwrap();
        let place = x - i64::from(range.first) - i;
        let from = (0..w).map(|x| (x, x - i64::from(range.first) - place)).filter(|(_, j)| (0..n).contains(j));
        let (_, back) = from.map(|(x, j)| (sums[x as usize][j as usize], j)).min().unwrap();
        let rival = own.iter().zip(0..n).filter(|(_, j)| (j - i).abs() > 1).map(|(s, _)| *s).min().unwrap();
        if !(0..w).contains(&place) || (back - i).abs() > 1 || *least as f64 >= 0.97 * rival as f64 {
            return f64::NAN;
        }
        // two lines of the steeper side's slope, one falling and one rising, meet at the minimum
        let part = if i == 0 || i == n - 1 {
            0.0
        } else {
            let [falls, rises] = [i - 1, i + 1].map(|j| (own[j as usize] - least) as f64);
            if falls.max(rises) > 0.0 { (falls - rises) / (2.0 * falls.max(rises)) } else { 0.0 }
        };
        f64::from(range.first) + i as f64 + part
    };
    (0..w).map(of).collect()
}

/// Compares matching with its definition, and returns the number of measured pixels. Pictures have a single band.
fn measured_by_definition(first: &Grey, second: &Grey, range: Range) -> usize {
    let [own, other] = [census(first), census(second)];
    let got = sgm::disparity(&Views { width: first.width, height: first.height, grey: &first.values, own: &own, other: &other }, range);
    let want = by_definition(first, second, range).chunks(first.width).flat_map(|row| chosen(row, range)).collect::<Vec<_>>();
    for (i, (got, want)) in got.iter().zip(&want).enumerate() {
        assert!(got.is_nan() && want.is_nan() || (f64::from(*got) - want).abs() < 1e-4, "pixel {i} of {range:?}: {got}, not {want}");
    }
    want.iter().filter(|d| d.is_finite()).count()
}

#[test]
fn disparities_agree_with_their_definition() {
    for (w, h, first, steps) in [(40, 21, 0, 1), (40, 21, 0, 3), (33, 9, -20, 1), (33, 9, -60, 2), (1, 12, 0, 1), (12, 1, -3, 1)] {
        let (a, b) = (grey_of(&spots(w, h, 1)), grey_of(&beside(&spots(w, h, 1), 3, 5)));
        let measured = measured_by_definition(&a, &b, Range { first, count: steps * sgm::STEP });
        assert!(w < 30 || first < 0 || measured > 300, "{measured}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// From even pictures to noise of 256 levels, on ranges that lead outside the other picture.
    #[test]
    fn disparities_of_noise_agree_with_their_definition(
        w in 1u32..36, h in 1u32..12, levels in 1u16..=256, shift in -9i32..9, first in -45i32..9, steps in 1usize..3, wrong in 0u8..200,
        seed in 0u32..1000,
    ) {
        let value = |x: u32, y: u32, seed: u32| (u16::from(noise(x, y, seed)) % levels * (255 / (levels - 1).max(1))) as u8;
        let a = Photo::from_fn(w, h, |x, y| [value(x, y, seed); 3]);
        let mut b = beside(&a, shift, -shift);
        for (i, p) in (0..).zip(&mut b.rgb).filter(|(i, _)| noise(*i, 0, seed) < wrong) {
            *p = [value(i, 1, seed + 1); 3];
        }
        measured_by_definition(&grey_of(&a), &grey_of(&b), Range { first, count: steps * sgm::STEP });
    }
}

#[test]
fn bands_give_the_same_bits_on_any_number_of_threads_and_leave_no_seams() {
    // three bands
    let (a, b) = (grey_of(&spots(80, 250, 9)), grey_of(&beside(&spots(80, 250, 9), 6, 6)));
    let [own, other] = [census(&a), census(&b)];
    let views = Views { width: 80, height: 250, grey: &a.values, own: &own, other: &other };
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| sgm::disparity(&views, Range { first: 0, count: sgm::STEP }))
    };
    let one = on(1);
    let bits = |all: &[f32]| all.iter().map(|d| d.to_bits()).collect::<Vec<_>>();
    assert!([2, 5].into_iter().all(|threads| bits(&on(threads)) == bits(&one)));
    let inside = (0..250).flat_map(|y| (20..60).map(move |x| y * 80 + x));
    assert!(inside.clone().all(|i| (one[i] - 6.0).abs() < 0.5), "{:?}", inside.map(|i| one[i]).find(|d| (d - 6.0).abs() >= 0.5));
}

#[test]
fn two_surfaces_are_measured_in_either_direction() {
    let photo = spots(300, 260, 2);
    for (far, near) in [(4, 17), (-20, -3), (-6, 9)] {
        let measured = measure(&photo, &beside(&photo, far, near)).unwrap();
        let off = |rows: std::ops::Range<usize>, d: i32| {
            let places = rows.flat_map(|y| (40..260).map(move |x| y * 300 + x));
            let all: Vec<f32> = places.map(|i| measured.disparity[i]).collect();
            // the second picture shows what comes from the right: x − x' is the shift
            all.iter().filter(|v| (**v - d as f32).abs() > 0.75 || v.is_nan()).count() as f64 / all.len() as f64
        };
        assert!(off(10..115, far) < 0.02 && off(145..250, near) < 0.02, "{far} {near}: {} {}", off(10..115, far), off(145..250, near));
        let estimate = DisparityMap { width: 300, height: 260, delta: (0..78_000).map(|i| f32::from(u8::from(i >= 39_000))).collect() };
        let FusedDisparity { map, figures, .. } = measured.fuse(&photo, &estimate);
        assert!((figures.nearest_px - f64::from(near)).abs() < 2.0 && !figures.crossed, "{figures:?}");
        assert!(map.delta.iter().all(|d| (0.0..=1.0).contains(d)) && map.delta[200 * 300 + 150] > map.delta[50 * 300 + 150] + 0.3);
    }
}

#[test]
fn swapped_eyes_are_detected_by_the_estimate() {
    let photo = spots(300, 260, 3);
    let measured = measure(&photo, &beside(&photo, -4, -17)).unwrap();
    let estimate = DisparityMap { width: 300, height: 260, delta: (0..78_000).map(|i| f32::from(u8::from(i >= 39_000))).collect() };
    let FusedDisparity { map, figures, .. } = measured.fuse(&photo, &estimate);
    assert!(figures.crossed && map.delta[200 * 300 + 150] > map.delta[50 * 300 + 150] + 0.3, "{figures:?}");
}

#[test]
fn a_turned_picture_is_rectified() {
    let photo = grey_of(&spots(400, 300, 4));
    for model in [Model { offset: 0.015, ..Model::default() }, Model { roll: 0.02, scale: 0.01, offset: -0.01, ..Model::default() }] {
        let turned = model.rectified(&photo);
        let found = rectify(&photo, &turned).unwrap();
        assert!(found.before_px > 1.0 && found.after_px < 0.35, "{found:?}");
        let (u, v) = (0.3, -0.2);
        assert!((found.model.down(u, v) + model.down(u, v)).abs() < 0.002, "{model:?}: {found:?}");
    }
    let unturned = rectify(&photo, &photo).unwrap();
    assert!(unturned.model == Model::default() && unturned.after_px < 0.1, "{unturned:?}");
}

#[test]
fn pairs_without_depth_are_refused() {
    let photo = spots(200, 160, 5);
    let even = |v: u8| Photo { rgb: vec![[v; 3]; photo.rgb.len()], ..photo };
    assert_eq!(measure(&photo, &photo).unwrap_err(), StereoError::NoParallax);
    for other in [even(0), even(255), spots(200, 160, 6)] {
        let error = measure(&photo, &other).unwrap_err();
        assert!(matches!(error, StereoError::Few { .. }), "{error}");
    }
    assert!(measure(&even(9), &even(9)).is_err());
    assert!(matches!(measure(&photo, &spots(160, 200, 5)).unwrap_err(), StereoError::Shape { .. }));
    for (w, h) in [(1, 1), (1, 40), (40, 1), (5, 5)] {
        assert!(measure(&spots(w, h, 7), &spots(w, h, 8)).is_err(), "{w}×{h}");
    }
}

#[test]
fn unmeasured_pixels_are_filled_however_few_are_known() {
    for known in [0, 1, 700] {
        let mut measured: Vec<f32> = (0..1000).map(|i| if i < known { i as f32 / 10.0 } else { f32::NAN }).collect();
        let share = fuse::fill(&mut measured, &vec![0.5; 1000], 40);
        assert!(measured.iter().all(|d| d.is_finite()) && share <= 1.0 - known as f64 / 1000.0 + 1e-9, "{known}");
    }
    // a gap beside a nearer surface lies on the farther one
    let mut row = vec![2.0, 2.0, f32::NAN, f32::NAN, f32::NAN, f32::NAN, 6.0, 6.0];
    assert!(fuse::fill(&mut row, &[0.0; 8], 8) < 1e-9 && row[2..6].iter().all(|d| (d - 2.0).abs() < 1e-6), "{row:?}");
}

#[test]
fn file_names_tell_where_the_eyes_are() {
    for (name, want) in [
        ("a.left-right.jpg", Stereo::LeftRight),
        ("A_SBS.JPG", Stereo::LeftRight),
        ("a.top-bottom.png", Stereo::TopBottom),
        ("a-ou.webp", Stereo::TopBottom),
        ("a_rgbd.png", Stereo::Rgbd),
        ("could.jpg", Stereo::Auto),
        ("left.jpg", Stereo::Auto),
        ("360.jpg", Stereo::Auto),
    ] {
        assert_eq!(Stereo::of_name(name).unwrap(), want, "{name}");
    }
    assert!(Stereo::of_name("walrus-360.top-bottom.jpg").is_err());
}

#[test]
fn panoramas_are_refused_unless_stereo_is_none() {
    let with = |properties: &str| {
        let xmp = format!(
            "<x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:RDF xmlns:rdf='http://www.w3.org/1999/02/22-rdf-syntax-ns#'><rdf:Description \
             xmlns:GPano='http://ns.google.com/photos/1.0/panorama/' {properties}/></rdf:RDF></x:xmpmeta>"
        );
        let body = [b"http://ns.adobe.com/xap/1.0/\0".as_slice(), xmp.as_bytes()].concat();
        with_segments(b"\xff\xd8\xff\xd9", &[segment(0xE1, &body)])
    };
    let sphere = "GPano:ProjectionType='equirectangular'";
    let cropped = |own: u32| format!("{sphere} GPano:CroppedAreaImageWidthPixels='{own}' GPano:FullPanoWidthPixels='3600'");
    for (properties, refused) in [
        (sphere.to_owned(), true),
        (cropped(3600), true),
        (cropped(1800), true),
        (cropped(1200), false),
        (format!("{sphere} GPano:CroppedAreaImageWidthPixels='x' GPano:FullPanoWidthPixels='0'"), true),
        ("GPano:ProjectionType='cylindrical'".to_owned(), false),
        (String::new(), false),
    ] {
        let photo = with(&properties);
        for stereo in [Stereo::Auto, Stereo::TopBottom] {
            assert_eq!(matches!(stereo.check(&photo, false), Err(DepthError::Sphere)), refused, "{properties}");
        }
        assert!(Stereo::None.check(&photo, false).is_ok(), "{properties}");
    }
}

#[test]
fn halves_have_equal_sizes() {
    let photo = Photo { width: 5, height: 3, rgb: (0..15).map(|i| [i; 3]).collect() };
    let (left, right) = Halves::LeftRight.split(&photo).unwrap();
    assert_eq!((left.at(1, 2), right.at(0, 0), right.width), ([11; 3], [3; 3], 2));
    let (top, bottom) = Halves::TopBottom.split(&photo).unwrap();
    assert_eq!((top.at(0, 0), bottom.at(0, 0), bottom.height), ([0; 3], [10; 3], 1));
    let one = Photo { width: 1, height: 1, rgb: vec![[0; 3]] };
    assert!(Halves::LeftRight.split(&one).is_none() && Halves::TopBottom.split(&one).is_none());
}
