use proptest::prelude::*;

use super::*;

fn samples(width: usize, deltas: &[f32], weights: Option<&[f32]>) -> Samples {
    let mut s = Samples::default();
    s.clear(width);
    let h = deltas.len() / width;
    for (i, &d) in deltas.iter().enumerate() {
        let (x, y) = (i % width, i / width);
        s.push(2.0 * (x as f32 + 0.5) / width as f32 - 1.0, 2.0 * (y as f32 + 0.5) / h as f32 - 1.0, d, weights.map_or(1.0, |w| w[i]));
    }
    s.settle_weights_for_test();
    s
}

const METHODS: [Method; 4] = [Method::Linear, Method::Lloyd, Method::Optimal, Method::Slanted];

fn place_n(s: &Samples, method: Method, n: u32) -> Tile {
    place_tile(s, &Placement::fixed(method, n))
}

fn cost(s: &Samples, p: &[Plane]) -> f64 {
    s.assign(p, &mut Vec::new(), &mut Vec::new())
}

#[test]
fn a_flat_tile_gets_one_plane() {
    let s = samples(64, &[0.25; 4096], None);
    for m in METHODS {
        let t = place_n(&s, m, 4);
        assert_eq!(t.planes, vec![Plane::fronto_parallel(0.25)], "{m:?}");
    }
}

#[test]
fn a_ramp_needs_one_slanted_plane() {
    let ramp: Vec<f32> = (0..4096).map(|i| 0.5 + 0.2 * (2.0 * ((i % 64) as f32 + 0.5) / 64.0 - 1.0)).collect();
    let s = samples(64, &ramp, None);
    let target = 0.002;
    assert_eq!(place_tile(&s, &Placement::fewest(Method::Slanted, 6, target)).planes.len(), 1);
    assert!(place_tile(&s, &Placement::fewest(Method::Optimal, 6, target)).planes.len() > 4);
}

#[test]
fn two_walls_and_an_object_need_three_slanted_planes() {
    let scene: Vec<f32> = (0..4096)
        .map(|i| {
            let (x, y) = ((i % 64) as f32, (i / 64) as f32);
            if (x - 40.0).hypot(y - 30.0) < 12.0 {
                0.9
            } else if x < 24.0 {
                0.5 - 0.006 * x
            } else {
                0.25 + 0.004 * x
            }
        })
        .collect();
    let s = samples(64, &scene, None);
    let t = place_tile(&s, &Placement::fewest(Method::Slanted, 6, 0.004));
    assert_eq!(t.planes.len(), 3);
    assert!(s.error_p99(&t.planes) < 0.004);
}

#[test]
fn low_confidence_suppresses_an_outlier() {
    let mut d = vec![0.2f32; 4096];
    let mut w = vec![1.0f32; 4096];
    d[77] = 1.0;
    w[77] = 1e-4;
    for m in [Method::Lloyd, Method::Optimal, Method::Slanted] {
        let p = place_n(&samples(64, &d, Some(&w)), m, 1).planes[0];
        assert!((p.disparity(0.0, 0.0) - 0.2).abs() < 1e-4, "{m:?}: {p:?}");
    }
}

/// Name, width, disparities, weights.
type Case = (&'static str, usize, Vec<f32>, Option<Vec<f32>>);

#[test]
fn extreme_tiles_get_finite_planes_that_fit() {
    let n = 4096;
    let mut cases: Vec<Case> = vec![
        ("1e-7 apart", 64, (0..n).map(|i| if i % 2 == 0 { 0.5 } else { 0.5 + 1e-7 }).collect(), None),
        ("1e-8 and 1", 64, (0..n).map(|i| if i % 2 == 0 { 1e-8 } else { 1.0 }).collect(), None),
        ("one outlier", 64, (0..n).map(|i| if i == 99 { 1.0 } else { 0.1 }).collect(), None),
        ("no confidence", 64, (0..n).map(|i| (i % 7) as f32 / 7.0).collect(), Some(vec![0.0; n])),
        ("NaN, Inf, negative", 64, (0..n).map(|i| [0.3, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -0.5][i % 5]).collect(), None),
        ("all NaN", 64, vec![f32::NAN; n], None),
        ("NaN weights", 64, (0..n).map(|i| (i % 3) as f32 / 3.0).collect(), Some(vec![f32::NAN; n])),
        (
            "weights 1 : 1e4",
            64,
            (0..n).map(|i| (i % 9) as f32 / 9.0).collect(),
            Some((0..n).map(|i| if i % 2 == 0 { 1.0 } else { 1e4 }).collect()),
        ),
        ("huge", 64, (0..n).map(|i| if i == 3 { f32::MAX } else { 0.5 }).collect(), None),
    ];
    cases.push(("1x1", 1, vec![0.7], None));
    cases.push(("1xN", 1, (0..64).map(|i| i as f32 / 64.0).collect(), None));
    cases.push(("Nx1", 64, (0..64).map(|i| i as f32 / 64.0).collect(), None));
    for (name, width, d, w) in cases {
        let s = samples(width, &d, w.as_deref());
        let of = |value: &dyn Fn(usize) -> f64| (0..s.len()).map(|i| f64::from(s.weights()[i]) * value(i)).sum::<f64>();
        let flat = cost(&s, &[Plane::fronto_parallel(of(&|i| s.deltas()[i].into()) / of(&|_| 1.0))]);
        for m in METHODS {
            for n in [1, 2, 4, 64] {
                let t = place_n(&s, m, n);
                assert!(!t.planes.is_empty() && t.planes.len() <= n as usize, "{name} {m:?}");
                assert!(t.planes.iter().all(Plane::is_finite), "{name} {m:?}: {:?}", t.planes);
                assert!(t.labels.iter().all(|&l| (l as usize) < t.planes.len()), "{name} {m:?}");
                // linear planes ignore the distribution of values; all others are no worse than one plane at the mean
                let got = cost(&s, &t.planes);
                assert!(m == Method::Linear || got <= flat * 1.01 + 1e-6, "{name} {m:?} {n}: {got}, not {flat}");
            }
        }
    }
}

/// Compares the result with the best split between bins, and with the best split of all by the documented bound.
fn compare_with_all_splits(d: &mut [f32], n: usize) -> Result<(), TestCaseError> {
    let s = samples(d.len(), d, None);
    let got = cost(&s, &exact_k_means::Table::new(&s, n).centres(n).into_iter().map(Plane::fronto_parallel).collect::<Vec<_>>());
    d.sort_by(f32::total_cmp);
    let d: Vec<f64> = d.iter().copied().map(f64::from).collect();
    let scale = 256.0 / (d[d.len() - 1] - d[0]);
    let bin = |x: f64| (((x - d[0]) * scale) as usize).min(255);
    let sse = |p: &[f64]| {
        let m = p.iter().sum::<f64>() / p.len() as f64;
        p.iter().map(|x| (x - m).powi(2)).sum::<f64>()
    };
    let best = |ends: &[usize]| {
        let mut best = sse(&d);
        for (k, &i) in ends.iter().enumerate() {
            best = best.min(sse(&d[..i]) + sse(&d[i..]));
            for &j in &ends[if n == 3 { k + 1 } else { ends.len() }..] {
                best = best.min(sse(&d[..i]) + sse(&d[i..j]) + sse(&d[j..]));
            }
        }
        best
    };
    let all: Vec<usize> = (1..d.len()).collect();
    let between: Vec<usize> = all.iter().copied().filter(|&i| bin(d[i - 1]) < bin(d[i])).collect();
    let binned = best(&between);
    prop_assert!(got <= binned + 1e-6, "{got} > {binned}");
    let (exact, within) = (best(&all), d.chunk_by(|a, b| bin(*a) == bin(*b)).map(sse).sum::<f64>());
    let bound = (exact.sqrt() + within.sqrt()).powi(2) + within;
    prop_assert!(got <= bound + 1e-6, "{got} > {bound} of {exact}");
    Ok(())
}

#[test]
fn the_optimal_split_does_not_divide_a_bin() {
    compare_with_all_splits(&mut [0.778_965_83, 0.0, 0.776_459_34], 3).expect("the bins' optimum");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// Compares dynamic programming with all splits between bins, in `f64`.
    #[test]
    fn optimal_is_optimal(mut d in prop::collection::vec(0f32..1.0, 3..12), n in 2usize..4) {
        compare_with_all_splits(&mut d, n)?;
    }

    #[test]
    fn optimal_costs_no_more_than_the_others(d in prop::collection::vec(0f32..1.0, 256)) {
        let s = samples(16, &d, None);
        let c = |m| cost(&s, &place_n(&s, m, 4).planes);
        prop_assert!(c(Method::Optimal) <= c(Method::Lloyd) * 1.01 + 1e-6);
        prop_assert!(c(Method::Optimal) <= c(Method::Linear) * 1.01 + 1e-6);
    }
}

#[test]
fn ghosts_are_pixels_on_a_plane_between_two_surfaces() {
    // one tile: near to the left of column 32, far from there on
    let (w, h) = (64u32, 48u32);
    let map = DisparityMap { width: w, height: h, delta: (0..w * h).map(|i| if i % w < 32 { 0.8 } else { 0.2 }).collect() };
    let grid = Grid::new(w, h, 64);
    assert_eq!(grid.tiles(), 1);
    let planes = vec![Plane::fronto_parallel(0.8), Plane::fronto_parallel(0.2), Plane::fronto_parallel(0.5)];
    let label = |x: u32, from: u32| if (from..from + 3).contains(&x) { 2 } else { u8::from(x >= 32) };
    let share = |from: u32| {
        let labels = (0..w * h).map(|i| label(i % w, from)).collect();
        ghost_share(&map, &grid, &[Tile { planes: planes.clone(), labels, background: None }], 0.05)
    };
    // three of 64 columns lie on the plane between, at any position
    assert!((share(31) - 3.0 / 64.0).abs() < 1e-12 && (share(5) - 3.0 / 64.0).abs() < 1e-12);
    assert!(share(64).abs() < 1e-12);
    // two pixels into the near side, the far plane is still beside its surface; farther in, it is a ghost
    let labels = |to: u32| (0..w * h).map(|i| u8::from(i % w >= to)).collect::<Vec<u8>>();
    let moved = |to| ghost_share(&map, &grid, &[Tile { planes: planes.clone(), labels: labels(to), background: None }], 0.05);
    assert!(moved(30).abs() < 1e-12 && (moved(28) - 2.0 / 64.0).abs() < 1e-12);
}
