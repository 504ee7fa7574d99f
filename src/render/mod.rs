//! Drawing a scene for a camera (paper, algorithm 1) on three hosts that are held against each other.

mod encode;

pub use encode::{DEFAULT_QUALITY, EncodeError, PictureFormat, encode};

use std::sync::Arc;

use crate::tmpi::{Camera, Scene};

/// Which host draws.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// `gpu` where there is a hardware adapter, else `cpu`.
    #[default]
    Auto,
    /// wgpu with the WGSL that the browser uses.
    Gpu,
    /// Row bands in parallel, front to back.
    Cpu,
    /// `f64`, all samples of a pixel sorted.
    Reference,
}

/// Why nothing was drawn.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The camera is not usable; the text names the field.
    #[error("camera: {0}")]
    Camera(&'static str),
    /// There is no graphics adapter, or it was lost and could not be rebuilt.
    #[error("graphics adapter: {0}")]
    Adapter(String),
    /// The scene does not fit into the adapter's limits.
    #[error("the scene does not fit the graphics adapter: {0}")]
    TooLarge(String),
}

/// A drawn view.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct View {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Premultiplied RGBA, row-major; alpha is below 255 where the scene leaves the frame uncovered.
    pub rgba: Vec<[u8; 4]>,
}

/// A host that draws scenes.
pub trait Renderer: Send + Sync {
    /// `gpu`, `cpu` or `reference`.
    fn name(&self) -> &'static str;

    /// Draws `scene` for `camera`.
    ///
    /// # Errors
    /// [`RenderError`].
    fn render(&self, scene: &Arc<Scene>, camera: &Camera) -> Result<View, RenderError>;
}
