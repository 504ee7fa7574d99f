//! Pictures that combine several views: stereo pairs, and quilts for light-field displays.

use std::sync::Arc;

use super::{RenderError, Renderer, View};
use tmpi_core::{Camera, Intrinsics, Scene};

/// How a stereo picture holds the views of the two eyes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, clap::ValueEnum)]
pub enum StereoLayout {
    /// The left eye's view left of the right eye's
    #[value(name = "sbs")]
    SideBySide,
    /// Side by side, each view at half its width, for televisions
    #[value(name = "half-sbs")]
    HalfSideBySide,
    /// The right eye's view left of the left eye's, for crossed eyes
    #[value(name = "crossed")]
    Crossed,
    /// The left eye's view above the right eye's
    #[value(name = "top-bottom")]
    TopBottom,
    /// One above the other, each view at half its height
    #[value(name = "half-top-bottom")]
    HalfTopBottom,
    /// One picture for red and cyan glasses
    #[value(name = "anaglyph")]
    Anaglyph,
    /// For red and cyan glasses, without colours: the least ghosting on saturated colours
    #[value(name = "anaglyph-grey")]
    AnaglyphGrey,
    /// For green and magenta glasses
    #[value(name = "anaglyph-green-magenta")]
    AnaglyphGreenMagenta,
    /// For amber and blue glasses
    #[value(name = "anaglyph-amber-blue")]
    AnaglyphAmberBlue,
}

/// How views are arranged in a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Arrangement {
    /// Views of two eyes.
    Stereo(StereoLayout),
    /// `columns × rows` views from left to right, row by row from the lower left, as light-field displays expect them.
    Quilt {
        /// Views per row, at least 1.
        columns: u32,
        /// Number of rows, at least 1.
        rows: u32,
    },
}

/// A row of cameras that look in the same direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rig {
    /// How to combine their views.
    pub arrangement: Arrangement,
    /// Distance from the first to the last camera, in units of the nearest distance.
    pub baseline: f64,
    /// Disparity that appears at the same position in all views; nearer points appear in front of the screen.
    pub focus: f64,
}

/// Default distance of the eyes: a thirtieth of the distance to the nearest surface, a rule of stereographers.
pub const EYE_DISTANCE: f64 = 1.0 / 30.0;

/// Maximum number of views of a quilt.
pub const MAX_QUILT: u32 = 100;

impl StereoLayout {
    /// Returns the layout of a name in the command line or a query.
    pub fn from_name(name: &str) -> Option<Self> {
        <Self as clap::ValueEnum>::from_str(name, false).ok()
    }

    /// The layout's name in the command line and in queries.
    pub fn name(self) -> String {
        clap::ValueEnum::to_possible_value(&self).map(|value| value.get_name().to_owned()).unwrap_or_default()
    }

    /// How an anaglyph mixes the eyes' colours; `None` for pictures of two views.
    const fn mix(self) -> Option<&'static Mix> {
        match self {
            Self::Anaglyph => Some(&RED_CYAN),
            Self::AnaglyphGrey => Some(&GREY),
            Self::AnaglyphGreenMagenta => Some(&GREEN_MAGENTA),
            Self::AnaglyphAmberBlue => Some(&AMBER_BLUE),
            _ => None,
        }
    }

    /// Divisors of a view's width and height.
    const fn squeeze(self) -> (u32, u32) {
        match self {
            Self::HalfSideBySide => (2, 1),
            Self::HalfTopBottom => (1, 2),
            _ => (1, 1),
        }
    }
}

impl Arrangement {
    /// Number of columns and rows of views in the picture.
    const fn cells(self) -> (u32, u32) {
        match self {
            Self::Stereo(StereoLayout::SideBySide | StereoLayout::HalfSideBySide | StereoLayout::Crossed) => (2, 1),
            Self::Stereo(StereoLayout::TopBottom | StereoLayout::HalfTopBottom) => (1, 2),
            Self::Stereo(_) => (1, 1),
            Self::Quilt { columns, rows } => (columns, rows),
        }
    }

    /// Width and height of the picture, as multiples of a view's; a squeezed view may make it one pixel smaller.
    pub const fn grid(self) -> (u32, u32) {
        let (columns, rows) = self.cells();
        let (wide, high) = self.squeeze();
        (columns / wide, rows / high)
    }

    /// Size of the picture, for views of `width × height` pixels before they are squeezed.
    pub fn size(self, (width, height): (u32, u32)) -> (u32, u32) {
        let ((columns, rows), (wide, high)) = (self.cells(), self.squeeze());
        ((width / wide).max(1).saturating_mul(columns), (height / high).max(1).saturating_mul(rows))
    }

    /// Number of views.
    pub const fn views(self) -> u32 {
        match self {
            Self::Stereo(_) => 2,
            Self::Quilt { columns, rows } => columns * rows,
        }
    }

    const fn squeeze(self) -> (u32, u32) {
        if let Self::Stereo(layout) = self { layout.squeeze() } else { (1, 1) }
    }

    /// Parses `CxR`, both at least 1 and at most [`MAX_QUILT`] views in total.
    ///
    /// # Errors
    /// A text that says what is wrong.
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
    /// The views' cameras around `camera`, in view order.
    fn cameras(&self, camera: &Camera) -> impl Iterator<Item = Camera> + use<> {
        let (count, (wide, high)) = (self.arrangement.views(), self.arrangement.squeeze());
        let (rig, camera) = (*self, squeezed(camera, wide, high));
        (0..count).map(move |i| {
            let share = if count > 1 { f64::from(i) / f64::from(count - 1) - 0.5 } else { 0.0 };
            let shift = share * rig.baseline;
            let mut own = Camera { pose: camera.pose.shifted([shift, 0.0, 0.0]), ..camera };
            own.intrinsics.cx += own.intrinsics.fx * shift * rig.focus;
            own
        })
    }
}

/// The camera with its picture squeezed to `1 / wide` of the width and `1 / high` of the height, at least one pixel.
fn squeezed(camera: &Camera, wide: u32, high: u32) -> Camera {
    let (width, height) = ((camera.width / wide).max(1), (camera.height / high).max(1));
    let (sx, sy) = (f64::from(width) / f64::from(camera.width), f64::from(height) / f64::from(camera.height));
    let k = camera.intrinsics;
    let intrinsics = Intrinsics { fx: k.fx * sx, fy: k.fy * sy, cx: k.cx * sx, cy: k.cy * sy };
    Camera { intrinsics, width, height, ..*camera }
}

/// Draws `scene` for all cameras of `rig` around `camera`, whose size is that of one view before it is squeezed.
///
/// # Errors
/// [`RenderError`].
pub fn draw_multiview(renderer: &dyn Renderer, scene: &Arc<Scene>, camera: &Camera, rig: &Rig) -> Result<View, RenderError> {
    let mut cameras: Vec<Camera> = rig.cameras(camera).collect();
    if let (Arrangement::Stereo(layout), [left, right]) = (rig.arrangement, cameras.as_slice()) {
        if let Some(mix) = layout.mix() {
            return Ok(anaglyph(&renderer.render(scene, left)?, &renderer.render(scene, right)?, mix));
        }
        // the rows of a quilt start at the bottom, but the left eye's view is on top
        if matches!(layout, StereoLayout::Crossed | StereoLayout::TopBottom | StereoLayout::HalfTopBottom) {
            cameras.reverse();
        }
    }
    let (columns, rows) = rig.arrangement.cells();
    let (view_width, view_height) = cameras.first().map_or((camera.width, camera.height), |c| (c.width, c.height));
    let (w, h, width) = (view_width as usize, view_height as usize, (view_width * columns) as usize);
    let mut out = View { width: view_width * columns, height: view_height * rows, rgba: vec![[0; 4]; width * h * rows as usize] };
    for (i, camera) in cameras.iter().enumerate() {
        let view = renderer.render(scene, camera)?;
        let (column, row) = (i % columns as usize, rows as usize - 1 - i / columns as usize);
        for (y, from) in view.rgba.chunks_exact(w).enumerate() {
            let at = (row * h + y) * width + column * w;
            out.rgba[at..at + w].copy_from_slice(from);
        }
    }
    Ok(out)
}

/// For each eye, the matrix from the view's colour to the red, green and blue of an anaglyph.
struct Mix {
    left: [[f32; 3]; 3],
    right: [[f32; 3]; 3],
}

/// Least-squares projections onto what the eyes see through the glasses. They keep the colours of skin and leaves, with little ghosting.
/// Source: Dubois, *A projection method to generate anaglyph stereo images*, ICASSP 2001; matrices from his table of 2009.
const RED_CYAN: Mix = Mix {
    left: [[0.456, 0.500, 0.176], [-0.040, -0.038, -0.016], [-0.015, -0.021, -0.005]],
    right: [[-0.043, -0.088, -0.002], [0.378, 0.734, -0.018], [-0.072, -0.113, 1.226]],
};
const GREEN_MAGENTA: Mix = Mix {
    left: [[-0.062, -0.158, -0.039], [0.284, 0.668, 0.143], [-0.015, -0.027, 0.021]],
    right: [[0.529, 0.705, 0.024], [-0.016, -0.015, -0.065], [0.009, 0.075, 0.937]],
};
const AMBER_BLUE: Mix = Mix {
    left: [[1.062, -0.205, 0.299], [-0.026, 0.908, 0.068], [-0.038, -0.173, 0.022]],
    right: [[-0.016, -0.123, -0.017], [0.006, 0.062, -0.017], [0.094, 0.185, 0.911]],
};
/// Luma weights of BT.601.
const LUMA: [f32; 3] = [0.299, 0.587, 0.114];
const GREY: Mix = Mix { left: [LUMA, [0.0; 3], [0.0; 3]], right: [[0.0; 3], LUMA, LUMA] };

fn anaglyph(left: &View, right: &View, mix: &Mix) -> View {
    let mixed = |l: &[u8; 4], r: &[u8; 4]| {
        let alpha = l[3].min(r[3]);
        let [red, green, blue] = std::array::from_fn(|i| {
            let sum: f32 = (0..3).map(|c| mix.left[i][c] * f32::from(l[c]) + mix.right[i][c] * f32::from(r[c])).sum();
            // `as` saturates; a premultiplied colour is at most alpha
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
        let quilt = draw_multiview(&cpu, &scene, &camera, &rig).unwrap();
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
            let rig = Rig { arrangement: Arrangement::Stereo(StereoLayout::SideBySide), baseline: 0.1, focus };
            let view = draw_multiview(&Cpu::default(), &scene, &camera(&scene), &rig).unwrap();
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
    fn each_stereo_layout_puts_each_eye_in_its_place() {
        let scene = Arc::new(testing::flat(40, 30, 0.5));
        let (cpu, camera) = (Cpu::default(), camera(&scene));
        let draw = |layout| {
            let rig = Rig { arrangement: Arrangement::Stereo(layout), baseline: 0.1, focus: 0.0 };
            draw_multiview(&cpu, &scene, &camera, &rig).unwrap()
        };
        let eye = |tx: f64, wide: u32, high: u32| {
            cpu.render(&scene, &squeezed(&Camera { pose: Pose::at(tx, 0.0, 0.0), ..camera }, wide, high)).unwrap()
        };
        let part = |view: &View, x: usize, y: usize, w: usize, h: usize| -> Vec<[u8; 4]> {
            (y..y + h).flat_map(|y| view.rgba[y * view.width as usize + x..][..w].to_vec()).collect()
        };
        for (layout, size, [left, right], (wide, high)) in [
            (StereoLayout::SideBySide, (80, 30), [(0, 0), (40, 0)], (1, 1)),
            (StereoLayout::Crossed, (80, 30), [(40, 0), (0, 0)], (1, 1)),
            (StereoLayout::HalfSideBySide, (40, 30), [(0, 0), (20, 0)], (2, 1)),
            (StereoLayout::TopBottom, (40, 60), [(0, 0), (0, 30)], (1, 1)),
            (StereoLayout::HalfTopBottom, (40, 30), [(0, 0), (0, 15)], (1, 2)),
        ] {
            let picture = draw(layout);
            assert_eq!((picture.width, picture.height), size, "{layout:?}");
            let (arrangement, odd) = (Arrangement::Stereo(layout), Camera { width: 41, height: 31, ..camera });
            let (columns, rows) = arrangement.grid();
            assert_eq!(((40 * columns, 30 * rows), arrangement.size((40, 30))), (size, size), "{layout:?}");
            let drawn = draw_multiview(&cpu, &scene, &odd, &Rig { arrangement, baseline: 0.1, focus: 0.0 }).unwrap();
            assert_eq!((drawn.width, drawn.height), arrangement.size((41, 31)), "{layout:?}");
            for (tx, (x, y)) in [(-0.05, left), (0.05, right)] {
                let want = eye(tx, wide, high);
                let (w, h) = (want.width as usize, want.height as usize);
                assert_eq!(part(&picture, x, y, w, h), want.rgba, "{layout:?}, eye at {tx}");
            }
        }
    }

    #[test]
    fn names_of_layouts_are_read_back() {
        for layout in <StereoLayout as clap::ValueEnum>::value_variants() {
            assert_eq!(StereoLayout::from_name(&layout.name()), Some(*layout));
        }
        assert_eq!((StereoLayout::from_name("SBS"), StereoLayout::from_name("")), (None, None));
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
