use super::*;

fn samples(width: usize, deltas: &[f32], weights: Option<&[f32]>) -> Samples {
    let mut s = Samples::default();
    s.clear(width);
    let h = deltas.len() / width;
    for (i, &d) in deltas.iter().enumerate() {
        let (x, y) = (i % width, i / width);
        s.push(2.0 * (x as f32 + 0.5) / width as f32 - 1.0, 2.0 * (y as f32 + 0.5) / h as f32 - 1.0, d, weights.map_or(1.0, |w| w[i]));
    }
    s
}

const METHODS: [Method; 4] = [Method::Linear, Method::Lloyd, Method::Optimal, Method::Slanted];

fn place_n(s: &Samples, method: Method, n: u32) -> Tile {
    place_tile(s, &Placement::fixed(method, n))
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
