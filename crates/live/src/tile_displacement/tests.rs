#![allow(clippy::unwrap_used, reason = "test")]

use proptest::prelude::*;
use tmpi_core::{Camera, Grid, Intrinsics, Pose, ViewBox, homography};

use super::*;

/// The largest distance between the positions of the frame's pixel `(x, y)` on two planes, over all corners of the view box, computed with
/// the renderers' homographies.
fn apart(g: &Geometry, index: u32, (x, y): (u32, u32), a: &Plane, b: &Plane) -> f64 {
    let (k, v) = (g.intrinsics, g.view_box);
    let mut most = 0f64;
    for corner in 0..8 {
        let side = |bit: u32, half: f64| if corner >> bit & 1 == 1 { half } else { -half };
        let pose = Pose::at(side(0, v.x), side(1, v.y), side(2, v.z));
        let camera = Camera { pose, intrinsics: k, width: g.grid.width, height: g.grid.height };
        let place = |plane: &Plane| {
            let h = homography(plane.normal(g.grid.centre(index), g.grid.half(), &k), &k, &camera);
            let p = [f64::from(x) + 0.5, f64::from(y) + 0.5, 1.0];
            let [px, py, w] = h.map(|row| row[0] * p[0] + row[1] * p[1] + row[2] * p[2]);
            (px / w, py / w)
        };
        let ((ax, ay), (bx, by)) = (place(a), place(b));
        most = most.max((ax - bx).hypot(ay - by));
    }
    most
}

/// Largest distance over the visible pixels and all pixels of each layer.
fn reference(g: &Geometry, index: u32, old: &Tile, new: &Tile) -> f64 {
    let r = g.grid.rect(index);
    let mut most = 0f64;
    for i in 0..r.area() {
        let at = (r.x + i as u32 % r.w, r.y + i as u32 / r.w);
        most = most.max(apart(g, index, at, &old.planes[usize::from(old.labels[i])], &new.planes[usize::from(new.labels[i])]));
        for (a, b) in old.planes.iter().zip(&new.planes).chain(old.background.iter().zip(&new.background)) {
            most = most.max(apart(g, index, at, a, b));
        }
    }
    most
}

fn scene(view_box: ViewBox) -> Geometry {
    let grid = Grid::new(90, 70, 32);
    let tiles = vec![Tile::default(); grid.tiles() as usize];
    Geometry { grid, intrinsics: Intrinsics::from_fov_x(90, 70, 60.0), view_box, tiles, matte_band: 0 }
}

/// A tile with planes from far to near, a background if `behind`, and labels in stripes that begin at `edge`.
fn tile(g: &Geometry, index: u32, slants: &[[f64; 3]], behind: bool, edge: u32) -> Tile {
    let r = g.grid.rect(index);
    let plane = |[a, b, c]: &[f64; 3]| Plane { a: *a, b: *b, c: *c }.quantised();
    let labels = (0..r.area() as u32).map(|i| ((i % r.w + edge) / 7 % slants.len() as u32) as u8).collect();
    Tile { planes: slants.iter().map(plane).collect(), labels, background: behind.then(|| plane(&[0.02, 0.01, 0.0])) }
}

fn slants() -> impl Strategy<Value = Vec<[f64; 3]>> {
    prop::collection::vec([0.0..1.0f64, -0.2..0.2f64, -0.2..0.2f64], 1..4)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn the_bound_is_never_below_the_homographies(
        index in 0u32..12, planes in slants(), by in prop::collection::vec([-0.1..0.1f64, -0.02..0.02f64, -0.02..0.02f64], 3),
        behind in any::<bool>(), edges in [0u32..7, 0u32..7], half in [0.0..0.2f64, 0.0..0.2f64, 0.0..0.3f64],
    ) {
        let g = scene(ViewBox { x: half[0], y: half[1], z: half[2] });
        let index = index % g.grid.tiles();
        let old = tile(&g, index, &planes, behind, edges[0]);
        let other: Vec<_> = planes.iter().zip(&by).map(|(p, by)| std::array::from_fn(|i| p[i] + by[i])).collect();
        let new = tile(&g, index, &other, behind, edges[1]);
        let (bound, found) = (tile_displacement(&g, index, &old, &new), reference(&g, index, &old, &new));
        prop_assert!(found <= bound * (1.0 + 1e-9), "{found} px seen, {bound} px said");
        prop_assert_eq!(bound.to_bits(), tile_displacement(&g, index, &new, &old).to_bits());
    }

    #[test]
    fn the_bound_is_exact_if_only_labels_differ(index in 0u32..12, planes in slants(), edges in [0u32..7, 0u32..7], half in [0.0..0.2f64, 0.0..0.2f64, 0.0..0.3f64]) {
        let g = scene(ViewBox { x: half[0], y: half[1], z: half[2] });
        let index = index % g.grid.tiles();
        let [old, new] = edges.map(|edge| tile(&g, index, &planes, true, edge));
        let (bound, found) = (tile_displacement(&g, index, &old, &new), reference(&g, index, &old, &new));
        prop_assert!((bound - found).abs() <= 1e-9 * (1.0 + found), "{found} px seen, {bound} px said");
    }
}

#[test]
fn the_bound_is_exact_for_fronto_parallel_planes() {
    let g = scene(ViewBox::cube(0.03));
    for index in 0..g.grid.tiles() {
        let [old, new] = [0.4, 0.43].map(|a| tile(&g, index, &[[a, 0.0, 0.0]], false, 0));
        let (bound, found) = (tile_displacement(&g, index, &old, &new), reference(&g, index, &old, &new));
        assert!(found > 0.0 && (bound - found).abs() < 1e-9, "{found} px seen, {bound} px said");
    }
}

#[test]
fn different_numbers_of_layers_are_infinitely_far_apart() {
    let g = scene(ViewBox::cube(0.03));
    let two = tile(&g, 1, &[[0.2, 0.0, 0.0], [0.7, 0.0, 0.0]], true, 0);
    assert_eq!(tile_displacement(&g, 1, &two, &two).to_bits(), 0f64.to_bits());
    for other in [tile(&g, 1, &[[0.2, 0.0, 0.0]], true, 0), Tile { background: None, ..two.clone() }, Tile::default()] {
        assert!(tile_displacement(&g, 1, &two, &other).is_infinite() && tile_displacement(&g, 1, &other, &two).is_infinite());
    }
}

#[test]
fn a_camera_behind_a_plane_has_no_bound() {
    let g = scene(ViewBox { x: 0.0, y: 0.0, z: 1.2 });
    let [far, near] = [0.5, 0.9].map(|a| tile(&g, 0, &[[a, 0.0, 0.0]], false, 0));
    assert!(tile_displacement(&g, 0, &far, &near).is_infinite());
    assert!(tile_displacement(&g, 0, &near, &near) < f64::MIN_POSITIVE);
}
