//! Textured triangle models for scenes.

mod mesh;
mod read;

use std::sync::Arc;

use thiserror::Error;

use super::math::{Rng, V3, v3};

pub(super) use mesh::Mesh;

/// Maximum number of triangles in a model.
pub const MAX_TRIANGLES: usize = 2_000_000;
/// Maximum number of pixels in all textures of a model.
pub const MAX_TEXELS: u64 = 64 << 20;
/// Maximum coordinate of a vertex along each axis, in metres.
pub const FARTHEST: f64 = 10_000.0;
/// Models of up to this times an object's size, or its size divided by this, may replace the object.
const SIZE_RATIO: f64 = 1.6;
/// Fraction of objects that are replaced if a model of similar size exists.
const REPLACED: f64 = 0.5;
/// Minimum sides of a model for a camera inside it, in metres.
const MIN_SIDE: f64 = 8.0;
/// Minimum number of parts of a model for a camera inside it: a house of one piece is empty.
const MIN_PARTS: usize = 20;

/// Why a file cannot be used as a model.
#[derive(Debug, Error)]
pub enum ModelError {
    /// The file is not valid glTF, or needs an unsupported extension.
    #[error("invalid glTF: {0}")]
    Format(#[from] gltf::Error),
    /// Data is outside the file, or out of range.
    #[error("{0} is missing from the file or incomplete")]
    Missing(&'static str),
    /// The file exceeds a limit.
    #[error("more than {most} {what}")]
    TooMuch {
        /// The limited quantity.
        what: &'static str,
        /// The limit.
        most: u64,
    },
    /// A texture cannot be decoded.
    #[error("a texture cannot be decoded: {0}")]
    Texture(#[from] image::ImageError),
    /// The model has no triangles.
    #[error("no triangles")]
    Nothing,
    /// A vertex is not finite, or beyond [`FARTHEST`].
    #[error("a vertex is not finite, or farther than {FARTHEST} m")]
    Far,
}

/// The axis of a file that points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Up {
    /// As in the glTF specification
    Y,
    /// As many exporters write it
    Z,
}

/// A model in metres. The origin is on the ground, at the centre of its footprint.
#[derive(Clone, Debug)]
pub struct Model {
    /// Meshes of the model; x right, y down, z ahead.
    pub(super) parts: Arc<[Arc<Mesh>]>,
    low: V3,
    high: V3,
}

impl Model {
    /// Reads a self-contained binary glTF file (`.glb`).
    ///
    /// # Errors
    /// [`ModelError`].
    pub fn read(bytes: &[u8], up: Up) -> Result<Self, ModelError> {
        let mut parts = read::parts(bytes, up)?;
        let low = parts.iter().map(|m| m.bounds.low).reduce(V3::min).ok_or(ModelError::Nothing)?;
        let high = parts.iter().map(|m| m.bounds.high).reduce(V3::max).ok_or(ModelError::Nothing)?;
        let foot = v3(0.5 * (low.x + high.x), high.y, 0.5 * (low.z + high.z));
        for part in &mut parts {
            part.shift(-foot);
        }
        Ok(Self { parts: parts.into_iter().map(Arc::new).collect(), low: low - foot, high: high - foot })
    }

    /// Width, height and depth in metres.
    pub fn size(&self) -> [f64; 3] {
        (self.high - self.low).array()
    }

    fn largest(&self) -> f64 {
        self.size().into_iter().fold(0.0, f64::max)
    }

    fn is_furnished(&self) -> bool {
        let [x, _, z] = self.size();
        x.min(z) > MIN_SIDE && self.parts.len() >= MIN_PARTS
    }
}

/// Models that may replace objects of scenes; none by default.
///
/// With models, a scene depends on its seed and on these models in this order.
#[derive(Clone, Debug, Default)]
pub struct Models(Arc<[Model]>);

impl Models {
    /// Creates the collection.
    pub fn new(models: Vec<Model>) -> Self {
        Self(models.into())
    }

    /// Sometimes returns a model of similar size to an object of `size` metres. Without such models, does not advance the generator.
    pub(super) fn similar(&self, rng: &Rng, size: f64) -> Option<Model> {
        self.some(rng, REPLACED, |m| (size / SIZE_RATIO..size * SIZE_RATIO).contains(&m.largest()))
    }

    /// Sometimes returns a model for a camera inside it.
    pub(super) fn furnished(&self, rng: &Rng, share: f64) -> Option<Model> {
        self.some(rng, share, Model::is_furnished)
    }

    fn some(&self, rng: &Rng, share: f64, is_wanted: impl Fn(&Model) -> bool) -> Option<Model> {
        let wanted: Vec<&Model> = self.0.iter().filter(|&m| is_wanted(m)).collect();
        (!wanted.is_empty() && rng.chance(share)).then(|| wanted[rng.int(0, wanted.len() as u32 - 1) as usize].clone())
    }
}

#[cfg(test)]
mod tests;
