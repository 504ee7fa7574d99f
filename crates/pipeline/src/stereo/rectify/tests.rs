//! Matches and the fit of rectification against plain references.

use proptest::prelude::*;

use super::*;

/// Reference in `f64`: the position whose window differs in the fewest bits, of all that lie inside and in reach.
fn by_definition(words: (&[u64], &[u64]), (w, h): (i64, i64), (x, y): (i64, i64), search: &Search) -> Option<(f64, f64)> {
    let half = search.half as i64;
    let inside = |x: i64, y: i64| x >= half && y >= half && x + half < w && y + half < h;
    let cost = |tx: i64, ty: i64| -> f64 {
        let window = (-half..=half).flat_map(|j| (-half..=half).map(move |i| (i, j)));
        let at = |x: i64, y: i64| (y * w + x) as usize;
        window.map(|(i, j)| f64::from((words.0[at(x + i, y + j)] ^ words.1[at(tx + i, ty + j)]).count_ones())).sum()
    };
    let reached = |tx: i64, ty: i64| {
        (tx - x - search.about.0).abs() <= search.reach.0 && (ty - y - search.about.1).abs() <= search.reach.1 && inside(tx, ty)
    };
    if !inside(x, y) {
        return None;
    }
    let all = (0..h).flat_map(|ty| (0..w).map(move |tx| (tx, ty))).filter(|(tx, ty)| reached(*tx, *ty));
    let all: Vec<(i64, i64, f64)> = all.map(|(tx, ty)| (tx, ty, cost(tx, ty))).collect();
    let (tx, ty, least) = *all.iter().min_by(|a, b| a.2.total_cmp(&b.2))?;
    let rivals = all.iter().filter(|p| (p.0 - tx).abs() > 2 || (p.1 - ty).abs() > 2).map(|p| p.2);
    if search.unique < 1.0 && least > 0.8 * rivals.fold(-1.0, |least, c| if least < 0.0 { c } else { c.min(least) }) {
        return None;
    }
    let beside = |ty: i64| all.iter().find(|p| (p.0, p.1) == (tx, ty)).map(|p| p.2);
    let (above, below) = (beside(ty - 1)?, beside(ty + 1)?);
    // minimum of the parabola through the three
    let curve = above - 2.0 * least + below;
    let part = if curve > 0.0 { (above - below) / 2.0 / curve } else { 0.0 };
    Some(((tx - x) as f64, (ty - y) as f64 + part))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]

    /// The second picture is the first moved, with some words of chance.
    #[test]
    fn matches_agree_with_their_definition(
        w in 1usize..18, h in 1usize..14, corner in (0usize..18, 0usize..14), moved in (-4i64..4, -3i64..3), about in (-3i64..3, -3i64..3),
        reach in (0i64..9, 0i64..6), half in 0usize..3, kind in 0..3, seeds in prop::collection::vec(any::<u64>(), 18 * 14),
    ) {
        let corner = (corner.0 % w, corner.1 % h);
        // as many bits as a slope and noise are high, so that positions nearby match nearly as well
        let slope = |x: i64, y: i64, noise: u64| (1u64 << ((3 * x + 2 * y).rem_euclid(40) as u64 + noise % 24)) - 1;
        let (column, row) = (|i: usize| (i % w) as i64, |i: usize| (i / w) as i64);
        let word = |i: usize| match kind {
            0 => seeds[i],
            // few different words, so that costs are often equal
            1 => seeds[i] % 5,
            _ => slope(column(i), row(i), seeds[i]),
        };
        let first: Vec<u64> = (0..w * h).map(word).collect();
        let from = |i: usize| {
            let (x, y) = (column(i) - moved.0, row(i) - moved.1);
            match seeds[i] % 7 {
                _ if kind == 2 => slope(x, y, seeds[i] >> 8),
                0 => seeds[i] >> 3,
                _ => first[(y.rem_euclid(h as i64) * w as i64 + x.rem_euclid(w as i64)) as usize],
            }
        };
        let second: Vec<u64> = (0..w * h).map(from).collect();
        let search = Search { about, reach, half, unique: if kind == 1 { 1.0 } else { UNIQUE } };
        let got = nearest((&first, &second), (w, h), corner, &search);
        let want = by_definition((&first, &second), (w as i64, h as i64), (corner.0 as i64, corner.1 as i64), &search);
        let same = match (got, want) {
            (Some(got), Some(want)) => (got.0 - want.0).abs() < 1e-9 && (got.1 - want.1).abs() < 1e-9,
            (got, want) => got == want,
        };
        prop_assert!(same, "{got:?}, not {want:?}");
    }

    /// No model near the fitted one has a smaller sum of squares.
    #[test]
    fn the_fit_has_the_least_squares(points in prop::collection::vec((0.0f64..640.0, 0.0f64..480.0, -9.0f64..9.0), 6..40)) {
        let size = (640, 480);
        let matches: Vec<Match> = points.iter().map(|(x, y, off)| Match { from: (*x, *y), to: (*x, y + off) }).collect();
        let Some(model) = fit(&matches, size) else { return Err(TestCaseError::reject("singular")) };
        let squares = |m: &Model| -> f64 {
            let ridge = 1e-4 * matches.len() as f64 * (m.yaw * m.yaw + m.pitch * m.pitch);
            ridge + matches.iter().map(|p| (p.off(m, size) / 640.0).powi(2)).sum::<f64>()
        };
        let Model { offset, roll, scale, yaw, pitch } = model;
        for (k, by) in (0..5).flat_map(|k| [(k, 1e-3), (k, -1e-3)]) {
            let mut all = [offset, roll, scale, yaw, pitch];
            all[k] += by;
            prop_assert!(squares(&Model::of(all)) >= squares(&model), "term {k} of {model:?}");
        }
    }

    /// Brightness between pixels is that of the plane that the pixels lie on, and beyond the border that of the border; never another level.
    #[test]
    fn brightness_between_pixels_is_linear(x in -3.0f64..12.0, y in -3.0f64..9.0, values in prop::collection::vec(any::<u8>(), 9 * 7)) {
        let ramp = Grey { width: 9, height: 7, values: (0..63).map(|i| (i % 9 * 20 + i / 9 * 10) as u8).collect() };
        let want = x.clamp(0.0, 8.0) * 20.0 + y.clamp(0.0, 6.0) * 10.0;
        prop_assert!((f64::from(at(&ramp, (x, y))) - want).abs() <= 0.5 + 1e-9);
        let noise = Grey { width: 9, height: 7, values };
        let (column, row) = (x.clamp(0.0, 8.0) as usize, y.clamp(0.0, 6.0) as usize);
        let near = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| noise.values[(row + j).min(6) * 9 + (column + i).min(8)]);
        let got = at(&noise, (x, y));
        prop_assert!(near.iter().min() <= Some(&got) && Some(&got) <= near.iter().max());
        prop_assert_eq!(at(&Grey { width: 1, height: 1, values: vec![7] }, (x, f64::INFINITY)), 7);
    }
}
