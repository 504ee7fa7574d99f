//! Disparity of the visible surface, and the photo with foreground pixels inpainted.

use tmpi_core::{Class, DisparityMap, Geometry, Grid, Inpainter, Intrinsics, Photo, Plane, Pyramid, Scene, Tile, ViewBox};

/// Quantisation steps of δ for inpainting; a tile cannot have more planes.
const STEPS: f32 = 63.0;

/// δ of the visible surface: at each pixel, that of the nearest opaque texel of the photo.
pub(super) fn visible_disparity(scene: &Scene) -> DisparityMap {
    let g = &scene.grid;
    let mut delta = vec![0f32; scene.photo.rgb.len()];
    for l in &scene.layers {
        let (centre, half) = (g.centre(l.tile), g.half());
        for i in 0..l.rect.area() {
            let (x, y) = (l.rect.x + i as u32 % l.rect.w, l.rect.y + i as u32 / l.rect.w);
            let at = l.first_texel + i;
            // what is hidden lies behind, but for the background of mixed pixels
            if scene.texels.alpha[at] == u8::MAX {
                let d = l.plane.disparity((f64::from(x) + 0.5 - centre.0) / half, (f64::from(y) + 0.5 - centre.1) / half);
                let best = &mut delta[y as usize * g.width as usize + x as usize];
                *best = best.max(d as f32);
            }
        }
    }
    DisparityMap { width: g.width, height: g.height, delta }
}

/// Replaces the `hidden` pixels of a photo by colours of nearby pixels whose δ is at most `limit`, or by the photo's mean colour if there
/// are none. `delta` is the δ of each pixel, at least 0.
pub(super) fn inpainted(photo: &Photo, delta: &[f32], limit: f32, hidden: impl Fn(usize) -> bool) -> Photo {
    let grid = Grid::full(photo.width, photo.height);
    let most = delta.iter().fold(limit, |m, &d| m.max(d)).max(f32::MIN_POSITIVE);
    let labels = delta.iter().map(|d| (d / most * STEPS).round() as u8).collect();
    let planes = (0..=STEPS as u8).map(|i| Plane::fronto_parallel(f64::from(f32::from(i) / STEPS * most))).collect();
    // colours do not depend on the camera
    let (intrinsics, view_box) = (Intrinsics::from_fov_x(photo.width, photo.height, 60.0), ViewBox::cube(0.0));
    let geometry = Geometry { grid, intrinsics, view_box, tiles: vec![Tile { planes, labels, background: None }], matte_band: 0 };
    let class: Vec<u8> = (0..delta.len()).map(|i| if hidden(i) { Class::Hidden } else { Class::Photo } as u8).collect();
    let plane = Plane::fronto_parallel(f64::from(limit));
    let colours = Inpainter::new(photo, &geometry).fill(0, &plane, grid.rect(0), &class, &mut Pyramid::default());
    let mut out = photo.clone();
    let places = class.iter().enumerate().filter(|(_, c)| **c == Class::Hidden as u8);
    for ((i, _), colour) in places.zip(colours) {
        out.rgb[i] = colour;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::testing;
    use super::*;

    #[test]
    fn hidden_pixels_take_the_colours_behind_them() {
        let scene = &testing::sample().1;
        let map = visible_disparity(scene);
        let at = |x: usize, y: usize| y * map.width as usize + x;
        assert!((map.delta[at(70, 60)] - 0.9).abs() < 0.01 && map.delta[at(20, 5)] < 0.02, "box, sky");
        let near = |i: usize| map.delta[i] > 0.6;
        let behind = inpainted(&scene.photo, &map.delta, 0.6, near);
        for (i, (a, b)) in behind.rgb.iter().zip(&scene.photo.rgb).enumerate() {
            assert!(near(i) || a == b, "other pixels stay unchanged");
        }
        // the box has 220 in red; ground and sky have 90 to 165 in green and 160 in blue
        let [r, g, b] = behind.rgb[at(70, 60)];
        assert!(r < 180 && (80..180).contains(&g) && b > 140, "{r} {g} {b}");
    }

    #[test]
    fn without_a_source_pixels_get_the_mean_colour() {
        let photo = Photo { width: 8, height: 8, rgb: vec![[90, 80, 70]; 64] };
        assert_eq!(inpainted(&photo, &[0.5; 64], 0.1, |_| true).rgb, photo.rgb);
    }
}
