//! Touch-up: what a person paints over the depth.

use serde::{Deserialize, Serialize};

/// What a stroke asks of its region.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Ask {
    /// Nearer by so much disparity, −1 to 1; relief within the region stays.
    By(f64),
    /// As near as this place of the photo, x and y of 0 to 1.
    Like([f64; 2]),
    /// This disparity, 0 (infinitely far) to 1 (the nearest thing).
    To(f64),
}

/// A stroke of a brush over the photo.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stroke {
    /// Its middle line, x and y in shares of the photo's width and height, 0 to 1.
    pub points: Vec<[f64; 2]>,
    /// Radius of the brush as a share of the photo's longer side, 0.002 to 0.25.
    pub radius: f64,
    /// What it asks of the region.
    #[serde(flatten)]
    pub ask: Ask,
}

/// All strokes of a photo, in their order: at most 100 with 8192 points together.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Strokes {
    /// The strokes.
    pub strokes: Vec<Stroke>,
}
