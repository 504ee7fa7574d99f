//! What a caller can choose.

use serde::{Deserialize, Serialize};
use tmpi_core::ViewBox;

use crate::StageError;
use crate::depth::DepthKind;
use crate::photo::Limits;
use crate::planes::{MAX_AUTO_PLANES, MAX_PLANES, Method, Placement};
use crate::stereo::Stereo;
use crate::strokes::{self, Stroke};

/// How planes are placed in a tile.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum PlaneMethod {
    /// Evenly in disparity between the tile's extremes.
    Linear,
    /// Confidence-weighted k-means (the paper's).
    Lloyd,
    /// Exact one-dimensional k-means by dynamic programming.
    Optimal,
    /// Confidence-weighted k-planes with slanted planes.
    #[default]
    Slanted,
}

/// How many planes a tile gets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PlaneCount {
    /// The fewest that meet the error target.
    #[default]
    Auto,
    /// Always this many (fewer where a tile has fewer distinct disparities).
    Fixed(u32),
}

/// Tile size.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TileSize {
    /// Square tiles of that many pixels.
    Pixels(u32),
    /// One tile: a regular MPI.
    Full,
}

/// A step that runs where it helps, or not at all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Switch {
    /// Where it helps by measure.
    #[default]
    Auto,
    /// Always.
    On,
    /// Never.
    Off,
}

/// How the disparity map is cleaned before planes are placed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Denoise {
    /// Planes fitted around each pixel where noise is measured; a map without noise or outliers stays as it is.
    #[default]
    Auto,
    /// The network Θ on maps with noise, outliers or blurred edges; its file must be there.
    Theta,
    /// 5-pixel median and guided filter.
    Classic,
    /// Not at all.
    Off,
}

/// Everything a caller can choose; the defaults are those of the command line and of the server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Options {
    /// How the user's own depth map is meant.
    pub depth_kind: DepthKind,
    /// Depth that a photo brings along within its file, where the user gives none: used where it can be read; on: nothing else will do.
    pub photo_depth: Switch,
    /// Where the picture of a second eye is.
    pub stereo: Stereo,
    /// Horizontal field of view in degrees; none: EXIF, else 0.58 × width.
    pub fov_x: Option<f64>,
    /// Planes a tile.
    pub planes: PlaneCount,
    /// Their placement.
    pub plane_method: PlaneMethod,
    /// Tile size.
    pub tile: TileSize,
    /// Snapping of depth ramps to colour edges.
    pub snap: Switch,
    /// Refinement by Ψ; its file must be there where it is on.
    pub refine: Switch,
    /// Cleaning of the disparity map.
    pub denoise: Denoise,
    /// Longest side in pixels; larger photos are reduced.
    pub max_size: Option<u32>,
    /// Picture quality, 1 to 100.
    pub quality: u8,
    /// Parallax error that planes may leave, in pixels over the view box: 99 % of a tile's pixels stay below it, where [`MAX_AUTO_PLANES`]
    /// are enough. [`Options::MAX_ERROR`] unless told otherwise.
    pub max_error: f64,
    /// Camera positions to make the scene for.
    pub view_box: ViewBox,
    /// Wall time that making may take, in milliseconds: size and parallax error are chosen for it.
    pub budget_ms: Option<f64>,
    /// Whether to measure what leaving out unseen texels changes; it takes about as long as making the scene.
    pub verify_prune: bool,
    /// What a person puts right of the disparity map.
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
    /// The usual view box: twice as far to the sides as viewers go by themselves, so that whoever wants more can turn it up; forward a
    /// little does much. `check --photos` tells what is uncovered at its corners, and half-way there.
    pub const VIEW_BOX: ViewBox = ViewBox { x: 0.12, y: 0.12, z: 0.06 };

    /// The usual parallax error, in pixels at the corners of the view box.
    /// `tmpi-lab bench --quick --only planes` compares views, bytes and planes a tile: 34.48 dB, 26.5 KB and 2.67 at 0.5; 34.48 dB, 26.3 KB and 2.33 at
    /// 1.0; 34.37 dB, 26.1 KB and 2.02 at 1.75; 32.44 dB, 26.0 KB and 1.66 at 3.5.
    pub const MAX_ERROR: f64 = 1.0;

    /// How planes are to be placed for an error of `max_error` pixels, where one of 1 in δ is at most `most` pixels ([`super::Movement::most`]).
    #[must_use]
    pub fn placement(&self, max_error: f64, most: f64) -> Placement {
        let method = match self.plane_method {
            PlaneMethod::Linear => Method::Linear,
            PlaneMethod::Lloyd => Method::Lloyd,
            PlaneMethod::Optimal => Method::Optimal,
            PlaneMethod::Slanted => Method::Slanted,
        };
        match self.planes {
            PlaneCount::Fixed(n) => Placement::fixed(method, n),
            PlaneCount::Auto => Placement::fewest(method, MAX_AUTO_PLANES, max_error / most.max(1.0)),
        }
    }

    /// Checks every number against its range.
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
            check((0.0..=10.0).contains(&e), "view-box", "three numbers of 0 to 10", &e)?;
        }
        strokes::check(&self.strokes)?;
        Ok(())
    }
}
