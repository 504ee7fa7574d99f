//! Errors of measurements.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use tmpi_core::container::ContainerError;
use tmpi_core::live::LiveError;
use tmpi_live::GeometryError;
use tmpi_live::video::VideoError;
use tmpi_pipeline::MakeError;
use tmpi_pipeline::depth::DepthError;
use tmpi_pipeline::networks::OnnxError;
use tmpi_render::RenderError;

/// Why a measurement failed.
#[derive(Debug, thiserror::Error)]
pub enum LabError {
    #[error("cannot make {subject}")]
    Make { subject: String, source: MakeError },
    /// A file or a folder cannot be used.
    #[error("{path}: {reason}")]
    File { path: PathBuf, reason: String },
    #[error("cannot encode a frame: {0}")]
    Encode(String),
    #[error(transparent)]
    Video(#[from] VideoError),
    #[error(transparent)]
    Geometry(#[from] GeometryError),
    /// A reader cannot decode a message.
    #[error(transparent)]
    Live(#[from] LiveError),
    #[error(transparent)]
    Render(#[from] RenderError),
    #[error(transparent)]
    Container(#[from] ContainerError),
    #[error(transparent)]
    Depth(#[from] DepthError),
    #[error(transparent)]
    Onnx(#[from] OnnxError),
}

impl LabError {
    pub(crate) fn file(path: &Path, reason: impl Display) -> Self {
        Self::File { path: path.into(), reason: reason.to_string() }
    }
}
