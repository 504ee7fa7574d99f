//! Textured triangle models that scenes may be furnished with.

mod mesh;
mod read;

use std::sync::Arc;

use thiserror::Error;

use super::math::{Rng, V3, v3};

pub(super) use mesh::Mesh;

/// Triangles of a model, at most.
pub const MAX_TRIANGLES: usize = 2_000_000;
/// Pixels of all its textures, at most.
pub const MAX_TEXELS: u64 = 64 << 20;
/// Metres from the middle to a corner, along each axis, at most.
pub const FARTHEST: f64 = 10_000.0;
/// A thing is replaced by models of up to so many times its size, or its size over that.
const LIKE: f64 = 1.6;
/// Share of things that are replaced where a model is of their size.
const OFTEN: f64 = 0.5;
/// Metres of a model's sides from which on one may stand within it.
const WIDE: f64 = 8.0;
/// Parts that a model has at least for one to stand within it: a house of one piece is empty.
const FURNISHED: usize = 20;

/// Why a file is no model that scenes can have.
#[derive(Debug, Error)]
pub enum ModelError {
    /// It is no glTF, breaks its rules, or needs an extension that is not known.
    #[error("no glTF that can be read: {0}")]
    Format(#[from] gltf::Error),
    /// Something in it lies outside of the file, or outside of what it has.
    #[error("{0} is not in the file itself, or not whole")]
    Missing(&'static str),
    /// More of something than is allowed.
    #[error("more than {most} {what}")]
    TooMuch {
        /// What there is too much of.
        what: &'static str,
        /// How much is allowed.
        most: u64,
    },
    /// A texture cannot be decoded.
    #[error("a texture cannot be decoded: {0}")]
    Texture(#[from] image::ImageError),
    /// It shows nothing.
    #[error("no triangles")]
    Nothing,
    /// A corner is no number, or farther than [`FARTHEST`].
    #[error("a corner is no number, or farther than {FARTHEST} m")]
    Far,
}

/// Which axis of a file points up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Up {
    /// As glTF has it.
    #[default]
    Y,
    /// As many exporters leave it.
    Z,
}

/// A model in metres, standing on the ground about the middle of its footprint.
#[derive(Clone, Debug)]
pub struct Model {
    /// One for each of its meshes, in a frame of their own: x right, y down, z ahead, the ground at 0.
    pub(super) parts: Arc<[Arc<Mesh>]>,
    low: V3,
    high: V3,
}

impl Model {
    /// Reads a binary glTF file (`.glb`) that holds all that it needs.
    ///
    /// # Errors
    /// As [`ModelError`] has them.
    pub fn read(bytes: &[u8], up: Up) -> Result<Self, ModelError> {
        let mut parts = read::parts(bytes, up)?;
        let low = parts.iter().map(Mesh::low).reduce(V3::min).ok_or(ModelError::Nothing)?;
        let high = parts.iter().map(Mesh::high).reduce(V3::max).ok_or(ModelError::Nothing)?;
        let foot = v3(0.5 * (low.x + high.x), high.y, 0.5 * (low.z + high.z));
        for part in &mut parts {
            part.shift(-foot);
        }
        Ok(Self { parts: parts.into_iter().map(Arc::new).collect(), low: low - foot, high: high - foot })
    }

    /// Metres that it measures to the right, up and ahead.
    #[must_use]
    pub fn size(&self) -> [f64; 3] {
        (self.high - self.low).array()
    }

    fn largest(&self) -> f64 {
        self.size().into_iter().fold(0.0, f64::max)
    }

    fn is_furnished(&self) -> bool {
        let [x, _, z] = self.size();
        x.min(z) > WIDE && self.parts.len() >= FURNISHED
    }
}

/// Models that things of scenes may be replaced by; none by default.
///
/// With them a scene is a function of its seed and of these models, in this order.
#[derive(Clone, Debug, Default)]
pub struct Models(Arc<[Model]>);

impl Models {
    /// These models.
    #[must_use]
    pub fn new(models: Vec<Model>) -> Self {
        Self(models.into())
    }

    /// One about as large as a thing of `size` metres, sometimes; nothing is drawn where there are no models.
    pub(super) fn like(&self, rng: &Rng, size: f64) -> Option<Model> {
        let alike = |m: &&Model| (size / LIKE..size * LIKE).contains(&m.largest());
        let count = self.0.iter().filter(alike).count();
        (count > 0 && rng.chance(OFTEN)).then(|| self.0.iter().filter(alike).nth(rng.int(0, count as u32 - 1) as usize).cloned())?
    }

    /// One to stand within, sometimes.
    pub(super) fn furnished(&self, rng: &Rng, share: f64) -> Option<Model> {
        let count = self.0.iter().filter(|m| m.is_furnished()).count();
        let nth = |n: u32| self.0.iter().filter(|m| m.is_furnished()).nth(n as usize).cloned();
        (count > 0 && rng.chance(share)).then(|| nth(rng.int(0, count as u32 - 1)))?
    }
}

#[cfg(test)]
mod tests;
