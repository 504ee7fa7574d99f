//! Options of making a photo.

use serde::{Deserialize, Serialize};
use tmpi_core::ViewBox;

use crate::StageError;
use crate::depth::DepthKind;
use crate::photo::Limits;
use crate::planes::{MAX_AUTO_PLANES, MAX_PLANES, Method as PlaneMethod, Placement};
use crate::stereo::Stereo;
use crate::strokes::{self, Stroke};

/// Number of planes per tile.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PlaneCount {
    /// The fewest that meet the error target.
    #[default]
    Auto,
    /// This number, or fewer if a tile has fewer distinct disparities.
    Fixed(u32),
}

/// Tile size.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TileSize {
    /// Square tiles with sides of this many pixels.
    Pixels(u32),
    /// One tile: a regular MPI.
    Full,
}

/// Whether a step runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Switch {
    /// Where measurements show that it helps.
    #[default]
    Auto,
    /// Always.
    On,
    /// Never.
    Off,
}

/// How the disparity map is denoised before planes are placed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Denoise {
    /// Planes fitted around each pixel where the map is noisy; a map without noise or outliers stays unchanged.
    #[default]
    Auto,
    /// The network Θ on maps with noise, outliers or blurred edges; needs the file of Θ.
    Theta,
    /// 5×5 median, then a guided filter.
    Classic,
    /// No denoising.
    Off,
}

/// Options of making a photo; the defaults are those of the command line and the server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Options {
    /// Meaning of the values in your own depth map.
    pub depth_kind: DepthKind,
    /// Whether to use depth embedded in the photo's file if you give none. Auto: if it can be read; on: fail without it.
    pub photo_depth: Switch,
    /// Where the second picture is.
    pub stereo: Stereo,
    /// Horizontal field of view in degrees, between 0 and 180; `None`: from EXIF, else from a focal length of 0.58 × width.
    pub fov_x: Option<f64>,
    /// Number of planes per tile, 1 to 64 if fixed.
    pub planes: PlaneCount,
    /// How planes are placed.
    pub plane_method: PlaneMethod,
    /// Tile size, 8 to 1024 pixels or one tile.
    pub tile: TileSize,
    /// Whether to snap depth ramps to colour edges. Auto also widens what a depth network draws too small; on does not.
    pub snap: Switch,
    /// Whether to refine layers with Ψ; on: needs the file of Ψ.
    pub refine: Switch,
    /// How to denoise the disparity map.
    pub denoise: Denoise,
    /// Longest side in pixels, 1 to 16384; larger photos are scaled down.
    pub max_size: Option<u32>,
    /// Picture quality, 1 to 100.
    pub quality: u8,
    /// Largest parallax error of planes, in pixels over the view box, 0 to 1000: 99 % of a tile's pixels stay below it if
    /// [`MAX_AUTO_PLANES`] planes are enough. The default is [`Options::MAX_ERROR`].
    pub max_error: f64,
    /// Camera positions to make the photo for; half extents of 0 to 10, in units of the nearest distance.
    pub view_box: ViewBox,
    /// Time budget for making, in milliseconds of wall time, 1 to 10 000 000; it chooses the photo's size and the parallax error.
    pub budget_ms: Option<f64>,
    /// Whether to measure how pruning unseen texels changes views; takes about half as long as making.
    pub verify_prune: bool,
    /// Strokes that correct the disparity map.
    pub strokes: Vec<Stroke>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            depth_kind: DepthKind::default(),
            photo_depth: Switch::default(),
            stereo: Stereo::default(),
            fov_x: None,
            planes: PlaneCount::default(),
            plane_method: PlaneMethod::default(),
            tile: TileSize::Pixels(64),
            snap: Switch::default(),
            refine: Switch::default(),
            denoise: Denoise::default(),
            max_size: None,
            quality: 90,
            max_error: Self::MAX_ERROR,
            view_box: Self::VIEW_BOX,
            budget_ms: None,
            verify_prune: false,
            strokes: Vec::new(),
        }
    }
}

impl Options {
    /// The default view box: twice as far sideways as viewers move on their own, so that users can turn it up, and less far forward,
    /// where a short distance has a large effect. `check --photos` reports what is uncovered at its corners and halfway there.
    pub const VIEW_BOX: ViewBox = ViewBox { x: 0.12, y: 0.12, z: 0.06 };

    /// The default parallax error, in pixels at the corners of the view box.
    ///
    /// `tmpi-lab bench --quick --only planes` compares the PSNR of views, bytes and planes per tile: 34.48 dB, 26.5 KB and 2.67 at 0.5;
    /// 34.48 dB, 26.3 KB and 2.33 at 1.0; 34.37 dB, 26.1 KB and 2.02 at 1.75; 32.44 dB, 26.0 KB and 1.66 at 3.5.
    pub const MAX_ERROR: f64 = 1.0;

    /// Placement for a parallax error of `max_error` pixels; `most` is the largest shift in pixels per unit of δ
    /// ([`super::Parallax::most`]).
    pub fn placement(&self, max_error: f64, most: f64) -> Placement {
        match self.planes {
            PlaneCount::Fixed(n) => Placement::fixed(self.plane_method, n),
            PlaneCount::Auto => Placement::fewest(self.plane_method, MAX_AUTO_PLANES, max_error / most.max(1.0)),
        }
    }

    /// Checks that every number is in its range.
    ///
    /// # Errors
    /// [`StageError::Option`] names the option and its range.
    pub fn validate(&self) -> Result<(), StageError> {
        let check = |ok: bool, field, range, value: &dyn std::fmt::Display| {
            if ok { Ok(()) } else { Err(StageError::Option { field, range, value: value.to_string() }) }
        };
        if let Some(f) = self.fov_x {
            check(f > 0.0 && f < 180.0, "fov-x", "between 0 and 180 degrees", &f)?;
        }
        if let PlaneCount::Fixed(n) = self.planes {
            check((1..=MAX_PLANES).contains(&n), "planes", "auto or 1 to 64", &n)?;
        }
        if let TileSize::Pixels(h) = self.tile {
            check((8..=1024).contains(&h), "tile", "full or 8 to 1024 pixels", &h)?;
        }
        if let Some(m) = self.max_size {
            check((1..=Limits::SIDE).contains(&m), "max-size", "1 to 16384 pixels", &m)?;
        }
        check((1..=100).contains(&self.quality), "quality", "1 to 100", &self.quality)?;
        check(self.max_error >= 0.0 && self.max_error <= 1e3, "max-error", "0 to 1000 pixels", &self.max_error)?;
        if let Some(b) = self.budget_ms {
            check((1.0..=1e7).contains(&b), "budget-ms", "1 to 10000000 milliseconds", &b)?;
        }
        for e in [self.view_box.x, self.view_box.y, self.view_box.z] {
            check((0.0..=10.0).contains(&e), "view-box", "three numbers from 0 to 10", &e)?;
        }
        strokes::check(&self.strokes)?;
        Ok(())
    }
}
