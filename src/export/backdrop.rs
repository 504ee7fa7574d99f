//! A coarse sheet behind all layers that shows the photo's background. Users look at models from outside the view box, where they see the
//! sheet instead of holes.

use super::mesh::{Mesh, Space, disparity};
use super::visible_surface::{inpainted, visible_disparity};
use tmpi_core::{Photo, Scene};
use tmpi_pipeline::photo::{reduced_size, resize};

/// Squares along the photo's longer side.
const SQUARES: u32 = 48;
/// Radius of the minimum filter in squares. The sheet stays flat behind objects up to twice as wide.
const RADIUS: usize = 4;
/// Gap between the sheet and the farthest layer, in δ.
const GAP: f64 = 0.02;
/// Pixels this far in front of the sheet, in δ, are not background.
const FOREGROUND: f32 = 0.12;
/// Maximum side of the sheet's texture, in pixels.
const SIDE: u32 = 1024;

/// The sheet behind the layers of `scene`, and its texture.
pub(super) fn backdrop(scene: &Scene, space: &Space) -> (Mesh, Photo) {
    let (width, height) = (scene.grid.width, scene.grid.height);
    let side = width.max(height).div_ceil(SQUARES).max(1);
    let (columns, rows) = (width.div_ceil(side) as usize, height.div_ceil(side) as usize);
    let far = &farthest(scene, side, columns, rows);
    // δ at a corner: the minimum of the adjacent squares
    let at = |x: usize, y: usize| {
        let squares = |i: usize, n: usize| i.saturating_sub(1)..(i + 1).min(n);
        let all = squares(y, rows).flat_map(|v| squares(x, columns).map(move |u| far[v * columns + u]));
        all.fold(f64::INFINITY, f64::min)
    };
    let mut mesh = Mesh::default();
    let mut corners = Vec::new();
    for y in 0..=rows {
        for x in 0..=columns {
            let pixel = [(x as u32 * side).min(width), (y as u32 * side).min(height)].map(f64::from);
            let delta = at(x, y);
            corners.push(delta as f32);
            mesh.positions.push(space.position(pixel, (delta - GAP) * space.gain + space.offset));
            mesh.coordinates.push([(pixel[0] / f64::from(width)) as f32, (pixel[1] / f64::from(height)) as f32]);
            if x < columns && y < rows {
                let a = (y * (columns + 1) + x) as u32;
                let [b, c, d] = [a + columns as u32 + 1, a + columns as u32 + 2, a + 1];
                mesh.triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
    }
    (mesh, background(scene, &corners, columns + 1, side))
}

/// Minimum δ of all layers in each square and its surroundings, at least 0.
fn farthest(scene: &Scene, side: u32, columns: usize, rows: usize) -> Vec<f64> {
    let mut least = vec![f64::INFINITY; columns * rows];
    for l in scene.layers.iter().filter(|l| l.rect.area() > 0) {
        let (delta, r) = (disparity(scene, l), l.rect);
        let ends = |from: u32, length: u32| [f64::from(from), f64::from(from + length)];
        let corners = ends(r.x, r.w).into_iter().flat_map(|x| ends(r.y, r.h).map(|y| delta.of([x, y])));
        let own = corners.fold(f64::INFINITY, f64::min).max(0.0);
        for v in r.y / side..=(r.y + r.h - 1) / side {
            for u in r.x / side..=(r.x + r.w - 1) / side {
                let at = &mut least[v as usize * columns + u as usize];
                *at = at.min(own);
            }
        }
    }
    // the minimum filter is separable: rows first, then columns
    let around = |i: usize, n: usize| i.saturating_sub(RADIUS)..(i + RADIUS + 1).min(n);
    let pick = |from: &[f64], index: &dyn Fn(usize, usize) -> std::ops::Range<usize>, place: &dyn Fn(usize, usize, usize) -> usize| {
        let one = |i: usize| {
            let (x, y) = (i % columns, i / columns);
            index(x, y).map(|j| from[place(x, y, j)]).fold(f64::INFINITY, f64::min)
        };
        (0..from.len()).map(one).collect::<Vec<f64>>()
    };
    let across = pick(&least, &|x, _| around(x, columns), &|_, y, j| y * columns + j);
    let all = pick(&across, &|_, y| around(y, rows), &|x, _, j| j * columns + x);
    all.into_iter().map(|d| if d.is_finite() { d } else { 0.0 }).collect()
}

/// The reduced photo with everything in front of the sheet inpainted. `corners` are the sheet's δ, `stride` per row, `side` pixels apart.
fn background(scene: &Scene, corners: &[f32], stride: usize, side: u32) -> Photo {
    let (width, height) = (scene.grid.width, scene.grid.height);
    let map = visible_disparity(scene);
    let (w, h) = reduced_size((width, height), Some(SIDE));
    let small = resize(&scene.photo, w, h);
    let sheet = |x: u32, y: u32| {
        let (u, v) = (x as f32 / side as f32, y as f32 / side as f32);
        let (i, j) = (u as usize, v as usize);
        let row = |j: usize| corners[j * stride + i] * (1.0 - u.fract()) + corners[j * stride + i + 1] * u.fract();
        row(j) * (1.0 - v.fract()) + row(j + 1) * v.fract()
    };
    let before = |i: u32| {
        let (x, y) = ((i % w) * width / w, (i / w) * height / h);
        (map.delta[(y * width + x) as usize] - sheet(x, y)).max(0.0)
    };
    let delta: Vec<f32> = (0..w * h).map(before).collect();
    inpainted(&small, &delta, FOREGROUND, |i| delta[i] > FOREGROUND)
}

#[cfg(test)]
mod tests {
    use super::super::testing;
    use super::*;

    #[test]
    fn the_sheet_is_behind_all_layers_without_near_objects() {
        let scene = &testing::sample().1;
        let space = Space::relief(&scene.intrinsics, scene.grid.width, scene.grid.height);
        let (sheet, texture) = backdrop(scene, &space);
        let k = &space.intrinsics;
        // from the photo's camera, the triangles cover the photo and face the camera
        let place = |i: u32| {
            let [x, y, z] = sheet.positions[i as usize].map(f64::from);
            ([k.cx - k.fx * x / z, k.cy + k.fy * y / z], -1.0 / z)
        };
        let mut area = 0.0;
        for t in &sheet.triangles {
            let [a, b, c] = t.map(place);
            let own = ((b.0[1] - a.0[1]) * (c.0[0] - a.0[0]) - (b.0[0] - a.0[0]) * (c.0[1] - a.0[1])) / 2.0;
            assert!(own > 0.0);
            area += own;
            let middle = [0, 1].map(|i| (a.0[i] + b.0[i] + c.0[i]) / 3.0);
            let delta = (a.1 + b.1 + c.1) / 3.0;
            for l in &scene.layers {
                let r = l.rect;
                let inside = |at: f64, from: u32, length: u32| (f64::from(from)..f64::from(from + length)).contains(&at);
                if inside(middle[0], r.x, r.w) && inside(middle[1], r.y, r.h) {
                    assert!(delta < space.of(&disparity(scene, l)).of(middle).max(space.offset), "{middle:?}");
                }
            }
        }
        assert!((area - f64::from(scene.grid.width * scene.grid.height)).abs() < 1e-2 * area, "{area}");
        let at = |x: u32, y: u32| texture.rgb[(y * texture.width + x) as usize];
        assert!(at(70, 60)[0] < 180, "the box is gone: {:?}", at(70, 60));
        assert_eq!(at(20, 5), scene.photo.rgb[5 * 150 + 20]);
    }
}
