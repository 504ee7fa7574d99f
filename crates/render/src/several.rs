//! Pictures made of several views: stereo pairs and quilts for light-field displays.

use std::sync::Arc;

use super::{RenderError, Renderer, View};
use tmpi_core::{Camera, Class, Scene};

/// How the views of a picture lie in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Arrangement {
    /// Left eye's view left of the right eye's.
    SideBySide,
    /// One picture for red and cyan glasses.
    Anaglyph,
    /// `columns × rows` views from left to right, row after row from the lower left, as light-field displays take them.
    Quilt {
        /// Views in a row, at least 1.
        columns: u32,
        /// Rows, at least 1.
        rows: u32,
    },
}

/// Cameras in a row that look the same way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rig {
    /// What becomes of their views.
    pub arrangement: Arrangement,
    /// From the first camera to the last, in units of the nearest distance.
    pub baseline: f64,
    /// Disparity that lies at the same place in all views: what is nearer stands before the screen.
    pub focus: f64,
}

/// Distance of the eyes where none is given: a thirtieth of the distance to the nearest thing, as stereographers have it.
pub const EYES: f64 = 1.0 / 30.0;

/// Most views of a quilt.
pub const MAX_QUILT: u32 = 100;

impl Arrangement {
    /// Views in a row of the picture, and rows.
    #[must_use]
    pub const fn grid(self) -> (u32, u32) {
        match self {
            Self::SideBySide => (2, 1),
            Self::Anaglyph => (1, 1),
            Self::Quilt { columns, rows } => (columns, rows),
        }
    }

    /// `CxR`, both at least 1 and at most [`MAX_QUILT`] views.
    ///
    /// # Errors
    /// What is wrong, as text.
    pub fn quilt(text: &str) -> Result<Self, String> {
        let parsed = text.split_once(['x', 'X']).and_then(|(c, r)| Some((c.parse::<u32>().ok()?, r.parse::<u32>().ok()?)));
        match parsed {
            Some((columns, rows)) if columns > 0 && rows > 0 && columns.saturating_mul(rows) <= MAX_QUILT => {
                Ok(Self::Quilt { columns, rows })
            }
            _ => Err(format!("must be COLUMNSxROWS of at most {MAX_QUILT} views, not {text:?}")),
        }
    }
}

impl Rig {
    /// Cameras of the views in their order, around `camera`.
    fn cameras(&self, camera: &Camera) -> impl Iterator<Item = Camera> + use<> {
        let (columns, rows) = self.arrangement.grid();
        let count = (columns * rows).max(if self.arrangement == Arrangement::Anaglyph { 2 } else { 1 });
        let (rig, camera) = (*self, *camera);
        (0..count).map(move |i| {
            let share = if count > 1 { f64::from(i) / f64::from(count - 1) - 0.5 } else { 0.0 };
            let shift = share * rig.baseline;
            let mut own = Camera { pose: camera.pose.shifted([shift, 0.0, 0.0]), ..camera };
            own.intrinsics.cx += own.intrinsics.fx * shift * rig.focus;
            own
        })
    }
}

/// Disparity that views turn about where none is chosen, and that lies in the screen of stereo pairs: the median over the photo's
/// area, in steps of 1/256, as the page's viewer has it. 0.35 where nothing of the photo is seen.
#[must_use]
pub fn pivot(scene: &Scene) -> f64 {
    const BINS: usize = 256;
    const UNKNOWN: f64 = 0.35;
    let mut area = [0usize; BINS];
    for l in &scene.layers {
        let (centre, half) = (scene.grid.centre(l.tile), scene.grid.half());
        let middle = |from: u32, length: u32| f64::from(from) + f64::from(length) / 2.0;
        let (u, v) = ((middle(l.rect.x, l.rect.w) - centre.0) / half, (middle(l.rect.y, l.rect.h) - centre.1) / half);
        let texels = l.first_texel..l.first_texel + l.rect.area();
        let visible = scene.texels.class[texels].iter().filter(|&&c| c == Class::Photo as u8).count();
        // `as` saturates below 0
        area[((l.plane.disparity(u, v) * BINS as f64) as usize).min(BINS - 1)] += visible;
    }
    let total: usize = area.iter().sum();
    let mut sum = 0;
    let median = area.iter().position(|&n| {
        sum += n;
        total > 0 && 2 * sum >= total
    });
    median.map_or(UNKNOWN, |bin| (bin as f64 + 0.5) / BINS as f64)
}

/// Draws `scene` by all cameras of `rig` around `camera`, whose size is that of one view.
///
/// # Errors
/// [`RenderError`].
pub fn draw_several(renderer: &dyn Renderer, scene: &Arc<Scene>, camera: &Camera, rig: &Rig) -> Result<View, RenderError> {
    let (columns, rows) = rig.arrangement.grid();
    let (w, h) = (camera.width as usize, camera.height as usize);
    if rig.arrangement == Arrangement::Anaglyph {
        let mut both = rig.cameras(camera).map(|c| renderer.render(scene, &c));
        let missing = RenderError::Camera("an anaglyph has two views");
        let (Some(left), Some(right)) = (both.next(), both.next()) else { return Err(missing) };
        return Ok(anaglyph(&left?, &right?));
    }
    let width = w * columns as usize;
    let mut out = View { width: camera.width * columns, height: camera.height * rows, rgba: vec![[0; 4]; width * h * rows as usize] };
    for (i, camera) in rig.cameras(camera).enumerate() {
        let view = renderer.render(scene, &camera)?;
        let (column, row) = (i % columns as usize, rows as usize - 1 - i / columns as usize);
        for (y, from) in view.rgba.chunks_exact(w).enumerate() {
            let at = (row * h + y) * width + column * w;
            out.rgba[at..at + w].copy_from_slice(from);
        }
    }
    Ok(out)
}

/// Red-cyan mix by the least-squares projection of Dubois (2001), which keeps the colours of skin and leaves, with little ghosting.
fn anaglyph(left: &View, right: &View) -> View {
    const LEFT: [[f32; 3]; 3] = [[0.456, 0.500, 0.176], [-0.040, -0.038, -0.016], [-0.015, -0.021, -0.005]];
    const RIGHT: [[f32; 3]; 3] = [[-0.043, -0.088, -0.002], [0.378, 0.734, -0.018], [-0.072, -0.113, 1.226]];
    let mixed = |l: &[u8; 4], r: &[u8; 4]| {
        let alpha = l[3].min(r[3]);
        let [red, green, blue] = std::array::from_fn(|i| {
            let sum: f32 = (0..3).map(|c| LEFT[i][c] * f32::from(l[c]) + RIGHT[i][c] * f32::from(r[c])).sum();
            // `as` saturates; premultiplied colour is at most alpha
            ((sum + 0.5) as u8).min(alpha)
        });
        [red, green, blue, alpha]
    };
    View { width: left.width, height: left.height, rgba: left.rgba.iter().zip(&right.rgba).map(|(l, r)| mixed(l, r)).collect() }
}

#[cfg(test)]
mod tests {
    use super::super::{Cpu, testing};
    use super::*;
    use tmpi_core::Pose;

    fn camera(scene: &Scene) -> Camera {
        Camera { pose: Pose::default(), intrinsics: scene.intrinsics, width: scene.grid.width, height: scene.grid.height }
    }

    #[test]
    fn a_quilt_begins_at_the_lower_left_with_the_leftmost_camera() {
        let scene = Arc::new(testing::flat(40, 30, 0.5));
        let (cpu, camera) = (Cpu::default(), camera(&scene));
        let rig = Rig { arrangement: Arrangement::quilt("3x2").unwrap(), baseline: 0.1, focus: 0.0 };
        let quilt = draw_several(&cpu, &scene, &camera, &rig).unwrap();
        assert_eq!((quilt.width, quilt.height), (120, 60));
        for (i, (column, row)) in [(0, 1), (1, 1), (2, 1), (0, 0), (1, 0), (2, 0)].into_iter().enumerate() {
            let own = Camera { pose: Pose::at(i as f64 / 50.0 - 0.05, 0.0, 0.0), ..camera };
            let want = cpu.render(&scene, &own).unwrap();
            for y in 0..30 {
                let at = (row * 30 + y) * 120 + column * 40;
                assert_eq!(&quilt.rgba[at..at + 40], &want.rgba[y * 40..][..40], "view {i}, row {y}");
            }
        }
    }

    #[test]
    fn what_lies_in_focus_is_the_same_in_both_eyes() {
        let scene = Arc::new(testing::flat(60, 40, 0.5));
        let pair = |focus: f64| {
            let rig = Rig { arrangement: Arrangement::SideBySide, baseline: 0.1, focus };
            let view = draw_several(&Cpu::default(), &scene, &camera(&scene), &rig).unwrap();
            let differ = |y: usize, x: usize| {
                let (l, r) = (view.rgba[y * 120 + x], view.rgba[y * 120 + 60 + x]);
                (0..3).any(|c| l[c].abs_diff(r[c]) > 2)
            };
            (0..40).flat_map(|y| (10..50).map(move |x| (y, x))).filter(|&(y, x)| differ(y, x)).count()
        };
        assert_eq!(pair(0.5), 0);
        assert!(pair(0.0) > 800, "{}", pair(0.0));
    }

    #[test]
    fn the_pivot_is_the_disparity_that_half_of_the_photo_is_behind() {
        for at in [0.1, 0.5, 0.9] {
            assert!((pivot(&testing::flat(60, 40, at)) - at).abs() <= 1.0 / 256.0, "{at}");
        }
        let mut nothing = testing::flat(60, 40, 0.5);
        nothing.layers.clear();
        assert!((pivot(&nothing) - 0.35).abs() < 1e-12);
    }

    #[test]
    fn an_anaglyph_of_two_equal_grey_views_is_grey() {
        let grey = View { width: 2, height: 1, rgba: vec![[128, 128, 128, 255], [0; 4]] };
        let mixed = anaglyph(&grey, &grey);
        assert!(mixed.rgba[0].iter().take(3).all(|v| v.abs_diff(128) <= 6), "{:?}", mixed.rgba[0]);
        assert_eq!(mixed.rgba[1], [0; 4]);
        let red = View { width: 1, height: 1, rgba: vec![[255, 255, 255, 255]] };
        let black = View { width: 1, height: 1, rgba: vec![[0, 0, 0, 255]] };
        let left = anaglyph(&red, &black).rgba[0];
        assert!(left[0] > 250 && left[1] < 5 && left[2] < 5, "the left eye sees red: {left:?}");
    }

    #[test]
    fn quilts_at_the_limit_and_one_over() {
        assert_eq!(Arrangement::quilt("8x6"), Ok(Arrangement::Quilt { columns: 8, rows: 6 }));
        assert!(Arrangement::quilt("10x10").is_ok());
        for bad in ["", "8", "0x3", "3x0", "101x1", "11x10", "-1x2", "4294967295x2", "a×b"] {
            assert!(Arrangement::quilt(bad).is_err(), "{bad}");
        }
    }
}
