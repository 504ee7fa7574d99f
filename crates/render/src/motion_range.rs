//! Default range and centre of a photo's motion. Each photo moves by about the same share of its width, and less if its depth is flat or
//! fragmented. `static/view/motion-range.js` has the same rules.

use tmpi_core::{Class, Scene, ViewBox};

/// How far near surfaces move against far ones from one end of the travel to the other, as a share of the photo's width.
const SHARE: f64 = 0.06;
/// Minimum half extent of the travel, in units of the nearest distance, if the view box is that large.
const LEAST: f64 = 0.02;
/// Quantiles of the photo's area at which its far and its near end lie.
const ENDS: [f64; 2] = [0.03, 0.97];
/// Depth counts as fragmented above this number of layers per tile. Each further layer reduces the motion by [`CALMER`], down to
/// [`CALMEST`].
const BROKEN: f64 = 4.0;
const CALMER: f64 = 0.15;
const CALMEST: f64 = 0.6;
/// Disparity that views turn about if a scene shows nothing.
const PIVOT: f64 = 0.35;
/// Number of disparity bins.
const BINS: usize = 256;

/// Motion that suits a scene's disparities.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionRange {
    /// Half extents of the camera's automatic motion, within the view box.
    pub travel: ViewBox,
    /// Disparity that views turn about, which is also the screen plane of stereo pairs: the median over the picture's area, in steps of 1/256,
    /// as in the page's viewer. 0.35 if the scene shows nothing of the photo.
    pub pivot: f64,
    /// Mean position of the nearest surfaces, as shares of the photo's width and height.
    pub nearest: [f64; 2],
}

impl MotionRange {
    /// Maximum half extent of the travel, in units of the nearest distance.
    pub const TRAVEL: f64 = 0.06;

    /// Derives the motion range of a scene.
    pub fn of(scene: &Scene) -> Self {
        let (half, grid) = (scene.grid.half(), &scene.grid);
        // disparity bin, visible texels and centre of each layer
        let layers: Vec<(usize, f64, [f64; 2])> = scene
            .layers
            .iter()
            .map(|l| {
                let middle = [f64::from(l.rect.x) + f64::from(l.rect.w) / 2.0, f64::from(l.rect.y) + f64::from(l.rect.h) / 2.0];
                let (cx, cy) = grid.centre(l.tile);
                let delta = l.plane.disparity((middle[0] - cx) / half, (middle[1] - cy) / half);
                let classes = scene.texels.class.get(l.first_texel..l.first_texel + l.rect.area()).unwrap_or_default();
                let visible = classes.iter().filter(|&&c| c == Class::Photo as u8).count();
                // `as` saturates, and turns NaN into 0
                (((delta * BINS as f64).floor().max(0.0) as usize).min(BINS - 1), visible as f64, middle)
            })
            .collect();
        let mut area = [0.0; BINS];
        for (bin, visible, _) in &layers {
            area[*bin] += visible;
        }
        let total: f64 = area.iter().sum();
        let quantile = |share: f64| {
            let mut sum = 0.0;
            let bin = area.iter().position(|a| {
                sum += a;
                sum >= share * total
            });
            bin.unwrap_or(BINS - 1)
        };
        let [far, near] = ENDS.map(quantile);
        let at = |bin: usize| (bin as f64 + 0.5) / BINS as f64;
        let mut sums = [0.0; 3];
        for (_, visible, [x, y]) in layers.iter().filter(|l| l.0 >= near) {
            sums = [sums[0] + visible, sums[1] + visible * x, sums[2] + visible * y];
        }
        let place = |sum: f64, side: u32| if sums[0] > 0.0 { sum / sums[0] / f64::from(side) } else { 0.5 };
        Self {
            travel: travel(scene, if total > 0.0 { at(near) - at(far) } else { 0.0 }),
            pivot: if total > 0.0 { at(quantile(0.5)) } else { PIVOT },
            nearest: [place(sums[1], grid.width), place(sums[2], grid.height)],
        }
    }
}

/// Travel for a scene whose disparities have a range of `spread`.
fn travel(scene: &Scene, spread: f64) -> ViewBox {
    let ViewBox { x, y, z } = scene.view_box;
    let a_tile = scene.layers.len() as f64 / f64::from(scene.grid.tiles()).max(1.0);
    let calm = (1.0 - CALMER * (a_tile - BROKEN).max(0.0)).max(CALMEST);
    let wanted = SHARE * f64::from(scene.grid.width) / (2.0 * scene.intrinsics.fx * spread.max(1e-3)) * calm;
    let extent = wanted.clamp(LEAST, MotionRange::TRAVEL);
    ViewBox { x: x.min(extent), y: y.min(extent), z: z.min(2.0 * extent) }
}

#[cfg(test)]
mod tests {
    use super::super::testing;
    use super::*;
    use tmpi_core::Plane;

    fn scene(view: f64) -> Scene {
        let mut scene = testing::flat(100, 60, 0.5);
        scene.view_box = ViewBox { x: view, y: view, z: view };
        scene
    }

    #[test]
    fn a_flat_photo_goes_as_far_as_viewers_go_and_a_small_box_is_its_own() {
        let seen = MotionRange::of(&scene(0.12));
        assert_eq!(seen.travel, ViewBox { x: MotionRange::TRAVEL, y: MotionRange::TRAVEL, z: 0.12 });
        assert!(seen.nearest.iter().all(|v| (v - 0.5).abs() < 1e-9), "{seen:?}");
        assert_eq!(MotionRange::of(&scene(0.03)).travel, ViewBox { x: 0.03, y: 0.03, z: 0.03 });
    }

    #[test]
    fn views_turn_about_the_disparity_that_half_of_the_photo_is_behind() {
        for at in [0.1, 0.5, 0.9] {
            assert!((MotionRange::of(&testing::flat(60, 40, at)).pivot - at).abs() <= 1.0 / 256.0, "{at}");
        }
        let mut nothing = testing::flat(60, 40, 0.5);
        nothing.layers.clear();
        assert!((MotionRange::of(&nothing).pivot - PIVOT).abs() < 1e-12);
    }

    #[test]
    fn depth_that_moves_more_is_moved_less_far() {
        let mut deep = scene(0.12);
        let mut near = deep.layers[0];
        near.plane = Plane { a: 0.9, b: 0.0, c: 0.0 };
        deep.layers[0].plane = Plane { a: 0.05, b: 0.0, c: 0.0 };
        near.first_texel = 0;
        deep.layers.push(near);
        // a long lens moves it more
        deep.intrinsics.fx = 150.0;
        let long = MotionRange::of(&deep).travel.x;
        assert!((LEAST..MotionRange::TRAVEL).contains(&long), "{long}");
        let way = 2.0 * long * deep.intrinsics.fx * 0.85 / 100.0;
        assert!((way - SHARE).abs() < 0.006, "{way}");
        deep.layers.extend([near; 5]);
        assert!(MotionRange::of(&deep).travel.x < long, "broken up");
    }
}
