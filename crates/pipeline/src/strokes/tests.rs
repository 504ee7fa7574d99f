//! Strokes against a plain reference, on simple photos, and on photos made to break them.
#![allow(clippy::float_cmp, reason = "untouched values keep every bit")]

use proptest::prelude::*;

use super::*;

fn one_colour(width: u32, height: u32, value: u8) -> Photo {
    Photo { width, height, rgb: vec![[value; 3]; width as usize * height as usize] }
}

fn even(photo: &Photo, value: f32) -> DisparityMap {
    DisparityMap { width: photo.width, height: photo.height, delta: vec![value; photo.rgb.len()] }
}

fn dab(at: [f64; 2], radius: f64, effect: Effect) -> Stroke {
    Stroke { points: vec![at], radius, effect }
}

/// The pixels that a stroke changes on an even map.
fn covered(photo: &Photo, stroke: &Stroke) -> Vec<bool> {
    let mut map = even(photo, 0.25);
    apply(photo, &mut map, None, &[Stroke { effect: Effect::To(1.0), ..stroke.clone() }]);
    map.delta.iter().map(|v| *v == 1.0).collect()
}

/// Grey noise of 100 to 100 + `spread` levels, the same each time.
fn noise(i: usize, spread: usize) -> u8 {
    (100 + (i.wrapping_mul(2_654_435_761) >> 7) % (spread + 1)) as u8
}

#[test]
fn without_edges_a_stroke_covers_its_brush() {
    let photo = one_colour(240, 180, 90);
    let radius = 0.1 * 240.0;
    let count = covered(&photo, &dab([0.5, 0.5], 0.1, Effect::To(1.0))).iter().filter(|c| **c).count() as f64;
    let disc = std::f64::consts::PI * radius * radius;
    assert!((count / disc - 1.0).abs() < 0.1, "{count} pixels for a disc of {disc}");
    let line = Stroke { points: vec![[0.25, 0.5], [0.75, 0.5]], radius: 0.05, effect: Effect::To(1.0) };
    let mask = covered(&photo, &line);
    // across the brush, in the middle of the line
    let high = (0..180).filter(|y| mask[y * 240 + 120]).count() as f64;
    assert!((high - 24.0).abs() <= 2.0, "{high} pixels across a brush of 24");
}

#[test]
fn an_outline_stops_at_an_edge_of_the_photo() {
    // a box on a ground, both with noise
    let (w, h) = (200_usize, 150_usize);
    let inside = |x: usize, y: usize| (60..130).contains(&x) && (40..100).contains(&y);
    let rgb = (0..w * h).map(|i| [noise(i, 10).saturating_add(if inside(i % w, i / w) { 60 } else { 0 }); 3]).collect();
    let photo = Photo { width: w as u32, height: h as u32, rgb };
    // drawn along the middle of the box, a little askew
    let stroke = Stroke { points: vec![[0.37, 0.44], [0.58, 0.5]], radius: 0.13, effect: Effect::To(1.0) };
    let mask = covered(&photo, &stroke);
    let (both, either) = (0..w * h).fold((0, 0), |(b, e), i| {
        let truth = inside(i % w, i / w);
        (b + usize::from(mask[i] && truth), e + usize::from(mask[i] || truth))
    });
    let overlap = f64::from(both as u32) / f64::from(either as u32);
    assert!(overlap > 0.95, "{overlap} of the box");
}

#[test]
fn an_outline_stops_at_a_step_of_the_disparity_alone() {
    let photo = one_colour(160, 120, 90);
    let mut map = even(&photo, 0.2);
    for i in 0..map.delta.len() {
        if i % 160 >= 80 {
            map.delta[i] = 0.7;
        }
    }
    let before = map.clone();
    apply(&photo, &mut map, None, &[dab([0.42, 0.5], 0.1, Effect::By(0.1))]);
    let beyond = (0..map.delta.len()).filter(|i| i % 160 >= 82 && map.delta[*i] != before.delta[*i]).count();
    let within = (0..map.delta.len()).filter(|i| i % 160 < 80 && map.delta[*i] != before.delta[*i]).count();
    assert!(beyond == 0 && within > 500, "{within} before the step, {beyond} behind it");
}

#[test]
fn strokes_are_applied_in_order() {
    let photo = one_colour(100, 100, 50);
    let mut map = even(&photo, 0.5);
    // relief that must stay
    map.delta[50 * 100 + 50] = 0.53;
    let mut confidence = vec![0.25; 10_000];
    let strokes = [
        dab([0.5, 0.5], 0.08, Effect::By(0.2)),
        dab([0.5, 0.5], 0.03, Effect::By(0.9)),
        dab([0.2, 0.2], 0.05, Effect::To(0.0)),
        // like the result of the first two
        dab([0.8, 0.8], 0.05, Effect::Like([0.5, 0.44])),
    ];
    apply(&photo, &mut map, Some(&mut confidence), &strokes[..1]);
    assert!((map.delta[50 * 100 + 50] - 0.73).abs() < 1e-6 && (map.delta[44 * 100 + 50] - 0.7).abs() < 1e-6);
    let mut all = even(&photo, 0.5);
    apply(&photo, &mut all, Some(&mut confidence), &strokes);
    let at = |x: usize, y: usize| all.delta[y * 100 + x];
    assert_eq!((at(50, 50), at(20, 20)), (1.0, 0.0), "values stay within 0 to 1");
    assert!((at(80, 80) - 0.7).abs() < 1e-6);
    assert_eq!((at(5, 95), confidence[95 * 100 + 5], confidence[20 * 100 + 20]), (0.5, 0.25, 1.0));
}

#[test]
fn a_larger_photo_of_the_scene_has_the_same_region() {
    let scene = |n: u32| {
        let inside = |v: u32| (n / 4..n / 2).contains(&v);
        Photo::from_fn(n, n, |x, y| if inside(x) && inside(y) { [180; 3] } else { [90; 3] })
    };
    let stroke = dab([0.36, 0.39], 0.12, Effect::To(1.0));
    let share = |n: u32| covered(&scene(n), &stroke).iter().filter(|c| **c).count() as f64 / f64::from(n * n);
    let (small, large) = (share(320), share(1280));
    assert!((large / small - 1.0).abs() < 0.02, "{small} and {large}");
}

/// The same cell by relaxing all pixels in turn, in `f64`, until nothing changes; and the margin by which each label is decided.
fn reference(step: &[f32], away: &[f32], radius: f64, (width, height): (usize, usize)) -> Vec<(bool, f64)> {
    let grown = |seed: &dyn Fn(f64) -> bool| {
        let mut cost: Vec<f64> = away.iter().map(|d| if seed(f64::from(*d)) { 0.0 } else { f64::INFINITY }).collect();
        loop {
            let mut changed = false;
            for i in 0..cost.len() {
                for n in 0..cost.len() {
                    let (dx, dy) = ((i % width).abs_diff(n % width), (i / width).abs_diff(n / width));
                    if dx.max(dy) == 1 {
                        let reached = cost[n] + (((dx + dy) as f64).sqrt() * f64::from(step[i] + step[n])) / 2.0;
                        if reached < cost[i] {
                            (cost[i], changed) = (reached, true);
                        }
                    }
                }
            }
            if !changed {
                return cost;
            }
        }
    };
    assert_eq!(away.len(), width * height);
    let (inner, outer) = (grown(&|d| d <= 0.71), grown(&|d| d >= 2.0 * radius));
    inner.into_iter().zip(outer).map(|(i, o)| (i < o, (i - o).abs())).collect()
}

fn any_photo() -> impl Strategy<Value = Photo> {
    (1_u32..24, 1_u32..24).prop_flat_map(|(width, height)| {
        let pixels = proptest::collection::vec(any::<[u8; 3]>(), (width * height) as usize);
        pixels.prop_map(move |rgb| Photo { width, height, rgb })
    })
}

fn any_stroke() -> impl Strategy<Value = Stroke> {
    let place = || [0.0_f64..=1.0, 0.0_f64..=1.0];
    let effect = prop_oneof![(-1.0_f64..=1.0).prop_map(Effect::By), (0.0_f64..=1.0).prop_map(Effect::To), place().prop_map(Effect::Like)];
    (proptest::collection::vec(place(), 1..6), RADII, effect).prop_map(|(points, radius, effect)| Stroke { points, radius, effect })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn regions_agree_with_the_reference(photo in any_photo(), stroke in any_stroke()) {
        let outlines = Outlines::new(&photo, &even(&photo, 0.5));
        let (mask, step, near) = outlines.traced(&stroke);
        for (i, (inside, sure)) in reference(&step, &near.away, near.radius, near.size).into_iter().enumerate() {
            // where both sides are equally near, rounding decides
            prop_assert!((mask[i] == 1) == inside || sure < 1e-3, "pixel {}: {} by {}", i, mask[i], sure);
        }
    }

    #[test]
    fn strokes_stay_within_the_range_and_their_reach(photo in any_photo(), stroke in any_stroke(), value in 0.0_f32..=1.0) {
        prop_assert_eq!(stroke.check(), Ok(()));
        let mut map = even(&photo, value);
        apply(&photo, &mut map, None, std::slice::from_ref(&stroke));
        prop_assert_eq!(map.delta.len(), photo.rgb.len());
        prop_assert!(map.delta.iter().all(|v| (0.0..=1.0).contains(v)));
        let longer = f64::from(photo.width.max(photo.height));
        let reach = 2.0 * (stroke.radius * longer).max(1.0) + 1.0;
        let line = &stroke.points;
        for (i, v) in map.delta.iter().enumerate() {
            let (x, y) = (f64::from(i as u32 % photo.width) + 0.5, f64::from(i as u32 / photo.width) + 0.5);
            let box_of = |axis: usize, n: u32| {
                let all = line.iter().map(|p| p[axis] * f64::from(n));
                (all.clone().fold(f64::MAX, f64::min) - reach, all.fold(f64::MIN, f64::max) + reach)
            };
            let ((left, right), (top, bottom)) = (box_of(0, photo.width), box_of(1, photo.height));
            let near = (left..=right).contains(&x) && (top..=bottom).contains(&y);
            prop_assert!(near || *v == value, "pixel {} is far off the stroke", i);
        }
    }

    #[test]
    fn strokes_round_trip_through_json(strokes in proptest::collection::vec(any_stroke(), 0..5)) {
        prop_assert_eq!(read(&write(&strokes)), Ok(strokes.clone()));
        prop_assert_eq!(patch(&write(&strokes)), Ok(Some(strokes)));
    }
}

#[test]
fn single_pixels_can_be_touched() {
    let photo = one_colour(300, 1, 7);
    let mask = covered(&photo, &dab([0.5, 0.5], *RADII.start(), Effect::To(1.0)));
    let count = mask.iter().filter(|c| **c).count();
    assert!((1..=3).contains(&count) && mask[150], "{count} pixels");
    let point = one_colour(1, 1, 7);
    assert_eq!(covered(&point, &dab([1.0, 1.0], *RADII.end(), Effect::To(1.0))), [true]);
}

#[test]
fn errors_name_the_invalid_field() {
    for (text, field) in [
        (r#"{"strokes": 3}"#, Some("strokes")),
        (r#"{"colour": 3}"#, Some("colour")),
        (r#"{"version": 2}"#, Some("version")),
        (r#"{"strokes": [1]}"#, Some("strokes[0]")),
        (r#"{"strokes": [{"radius": 0.1, "by": 0.1}]}"#, Some("strokes[0].points")),
        (r#"{"strokes": [{"points": [], "radius": 0.1, "by": 0.1}]}"#, Some("strokes[0].points")),
        (r#"{"strokes": [{"points": [[0.1]], "radius": 0.1, "by": 0.1}]}"#, Some("strokes[0].points[0]")),
        (r#"{"strokes": [{"points": [[0, 0], [0.1, 1.01]], "radius": 0.1, "by": 0.1}]}"#, Some("strokes[0].points[1]")),
        (r#"{"strokes": [{"points": [[0.1, "NaN"]], "radius": 0.1, "by": 0.1}]}"#, Some("strokes[0].points[0]")),
        (r#"{"strokes": [{"points": [[0.1, 0.1]], "by": 0.1}]}"#, Some("strokes[0].radius")),
        (r#"{"strokes": [{"points": [[0.1, 0.1]], "radius": 0.0019, "by": 0.1}]}"#, Some("strokes[0].radius")),
        (r#"{"strokes": [{"points": [[0.1, 0.1]], "radius": 0.26, "by": 0.1}]}"#, Some("strokes[0].radius")),
        (r#"{"strokes": [{"points": [[0.1, 0.1]], "radius": 0.1}]}"#, Some("strokes[0].by")),
        (r#"{"strokes": [{"points": [[0.1, 0.1]], "radius": 0.1, "by": 1.1}]}"#, Some("strokes[0].by")),
        (r#"{"strokes": [{"points": [[0.1, 0.1]], "radius": 0.1, "to": -0.1}]}"#, Some("strokes[0].to")),
        (r#"{"strokes": [{"points": [[0.1, 0.1]], "radius": 0.1, "like": [2, 0]}]}"#, Some("strokes[0].like")),
        (r#"{"strokes": [{"points": [[0.1, 0.1]], "radius": 0.1, "by": 0.1, "to": 0}]}"#, Some("strokes[0].to")),
        (r#"{"strokes": [{"points": [[0.1, 0.1]], "radius": 0.1, "by": 0.1, "colour": 0}]}"#, Some("strokes[0].colour")),
        // neither a JSON number nor an f64
        (r#"{"strokes": [{"points": [[NaN, 0.1]], "radius": 0.1, "by": 0.1}]}"#, None),
        (r#"{"strokes": [{"points": [[1e999, 0.1]], "radius": 0.1, "by": 0.1}]}"#, None),
        ("[]", None),
        ("{", None),
    ] {
        let error = read(text.as_bytes()).unwrap_err();
        assert_eq!(error.field.as_deref(), field, "{text}: {error}");
        assert!(!error.detail.is_empty());
    }
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let fine = dab([0.5, 0.5], 0.1, Effect::By(0.0));
        for (stroke, field) in [
            (Stroke { points: vec![[0.5, 0.5], [0.5, bad]], ..fine.clone() }, "points[1]"),
            (Stroke { radius: bad, ..fine.clone() }, "radius"),
            (Stroke { effect: Effect::By(bad), ..fine.clone() }, "by"),
            (Stroke { effect: Effect::To(bad), ..fine.clone() }, "to"),
            (Stroke { effect: Effect::Like([bad, 0.0]), ..fine.clone() }, "like"),
        ] {
            assert_eq!(stroke.check().unwrap_err().field.as_deref(), Some(field), "{bad}");
        }
    }
}

#[test]
fn counts_are_bounded() {
    let one = dab([0.5, 0.5], 0.1, Effect::By(0.1));
    assert_eq!(check(&vec![one.clone(); STROKES]), Ok(()));
    assert_eq!(check(&vec![one.clone(); STROKES + 1]).unwrap_err().field.as_deref(), Some("strokes"));
    let long = |n: usize| Stroke { points: vec![[0.123_456_789_012_345_68, 0.5]; n], ..one.clone() };
    assert_eq!(check(&[long(POINTS)]), Ok(()));
    assert_eq!(check(&[long(POINTS), one.clone()]).unwrap_err().field.as_deref(), Some("strokes"));
    let file = write(&[long(POINTS)]);
    assert!(file.len() <= BYTES && read(&file).is_ok(), "{} bytes", file.len());
    let spaces = |n: usize| format!("{{{}}}", " ".repeat(n - 2));
    assert_eq!(patch(spaces(BYTES).as_bytes()), Ok(None));
    assert!(patch(spaces(BYTES + 1).as_bytes()).is_err());
}
