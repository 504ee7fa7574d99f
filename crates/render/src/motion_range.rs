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
/// Disparity that views turn about, and range of disparities, if a scene shows nothing.
const PIVOT: f64 = 0.35;
const SPREAD: f64 = 0.8;
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
        if total <= 0.0 {
            return Self { travel: travel(scene, SPREAD, 0.0), pivot: PIVOT, nearest: [0.5, 0.5] };
        }
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
        Self {
            travel: travel(scene, at(near) - at(far), scene.layers.len() as f64 / f64::from(grid.tiles())),
            pivot: at(quantile(0.5)),
            nearest: [sums[1] / sums[0] / f64::from(grid.width), sums[2] / sums[0] / f64::from(grid.height)],
        }
    }
}

/// Travel for a scene with this range of disparities and this many layers per tile.
fn travel(scene: &Scene, spread: f64, layers: f64) -> ViewBox {
    let ViewBox { x, y, z } = scene.view_box;
    let calm = (1.0 - CALMER * (layers - BROKEN).max(0.0)).max(CALMEST);
    let wanted = SHARE * f64::from(scene.grid.width) / (2.0 * scene.intrinsics.fx * spread.max(1e-3)) * calm;
    let extent = wanted.clamp(LEAST, MotionRange::TRAVEL);
    ViewBox { x: x.min(extent), y: y.min(extent), z: z.min(2.0 * extent) }
}

#[cfg(test)]
mod tests {
    use super::super::testing;
    use super::*;
    use proptest::prelude::*;
    use tmpi_core::{Layer, Plane, Rect};

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

    /// Reference: the rules on a list of all visible texels, each at its layer's disparity, from far to near. A test of
    /// `static/view/motion-range.js` compares it with the same.
    fn by_definition(scene: &Scene) -> MotionRange {
        let mut texels: Vec<(f64, f64, f64)> = Vec::new();
        for layer in &scene.layers {
            let (x, y) = (f64::from(layer.rect.x) + f64::from(layer.rect.w) / 2.0, f64::from(layer.rect.y) + f64::from(layer.rect.h) / 2.0);
            let (cx, cy) = scene.grid.centre(layer.tile);
            let delta = layer.plane.a + layer.plane.b * ((x - cx) / scene.grid.half()) + layer.plane.c * ((y - cy) / scene.grid.half());
            let bin = if delta.is_nan() { 0.0 } else { (delta * 256.0).floor().clamp(0.0, 255.0) };
            let class = &scene.texels.class[layer.first_texel..][..layer.rect.area()];
            texels.extend(class.iter().filter(|c| **c == Class::Photo as u8).map(|_| ((bin + 0.5) / 256.0, x, y)));
        }
        texels.sort_by(|a, b| a.0.total_cmp(&b.0));
        let n = texels.len() as f64;
        let at = |share: f64| texels[((share * n).ceil() as usize).saturating_sub(1)].0;
        let (spread, layers) = if texels.is_empty() { (0.8, 0.0) } else { (at(0.97) - at(0.03), scene.layers.len() as f64) };
        let half = 0.06 * f64::from(scene.grid.width) / (2.0 * scene.intrinsics.fx * spread.max(0.001));
        let half = (half * (1.0 - 0.15 * (layers - 4.0).max(0.0)).max(0.6)).clamp(0.02, 0.06);
        let nearest: Vec<_> = texels.iter().filter(|t| t.0 >= at(0.97)).collect();
        let mean = |of: fn(&(f64, f64, f64)) -> f64, side: u32| {
            nearest.iter().map(|t| of(t)).sum::<f64>() / nearest.len() as f64 / f64::from(side)
        };
        let ViewBox { x, y, z } = scene.view_box;
        MotionRange {
            travel: ViewBox { x: x.min(half), y: y.min(half), z: z.min(2.0 * half) },
            pivot: if texels.is_empty() { 0.35 } else { at(0.5) },
            nearest: if texels.is_empty() { [0.5; 2] } else { [mean(|t| t.1, scene.grid.width), mean(|t| t.2, scene.grid.height)] },
        }
    }

    fn any_layer() -> impl Strategy<Value = Layer> {
        let a = prop_oneof![8 => -0.3f64..1.3, 1 => prop::sample::select(vec![f64::NAN, f64::INFINITY, f64::NEG_INFINITY])];
        let plane = (a, -0.3f64..0.3, -0.3f64..0.3).prop_map(|(a, b, c)| Plane { a, b, c });
        let rect = (0u32..50, 0u32..30, 1u32..=50, 1u32..=30).prop_map(|(x, y, w, h)| Rect { x, y, w, h });
        (plane, rect).prop_map(|(plane, rect)| Layer { tile: 0, plane, rect, first_texel: 0, first_hidden: 0 })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]

        #[test]
        fn motion_ranges_agree_with_their_definition(
            layers in prop::collection::vec(any_layer(), 0..9), fx in 10.0f64..500.0, view in 0.0f64..0.2, hidden in 1usize..9, equal in any::<bool>(),
        ) {
            let mut made = scene(view);
            made.intrinsics.fx = fx;
            made.texels.class.iter_mut().step_by(hidden).for_each(|c| *c = Class::Hidden as u8);
            // equal counts end at a quantile exactly
            made.layers = layers.into_iter().map(|l| if equal { Layer { rect: Rect { w: 10, h: 10, ..l.rect }, ..l } } else { l }).collect();
            let (got, want) = (MotionRange::of(&made), by_definition(&made));
            let of = |m: &MotionRange| [m.travel.x, m.travel.y, m.travel.z, m.pivot, m.nearest[0], m.nearest[1]];
            prop_assert!(of(&got).iter().zip(of(&want)).all(|(g, w)| (g - w).abs() < 1e-9), "{got:?}, not {want:?}");
        }
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
