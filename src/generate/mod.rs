//! From photo and disparity to a tiled multiplane image (paper, section 3.2).

pub mod classic;
pub mod confidence;
pub mod layers;
pub mod planar;
pub mod planes;
pub mod refine;
mod report;
pub mod snap;

pub use report::{Budget, Bytes, ErrorFigures, Input, LeftOut, Report, Stage};

/// Why a scene could not be made.
#[derive(Debug, thiserror::Error)]
pub enum GenerateError {
    /// An option is out of its range; the text names it and the range.
    #[error("{field} must be {range}, not {value}")]
    Option {
        /// Name of the option.
        field: &'static str,
        /// What is allowed.
        range: &'static str,
        /// What was given.
        value: String,
    },
    /// A network failed.
    #[error(transparent)]
    Onnx(#[from] crate::onnx::OnnxError),
    /// A network gave something other than what its card says.
    #[error("{network} gave {got}, not {want}")]
    Shape {
        /// The network.
        network: &'static str,
        /// Shape given.
        got: String,
        /// Shape expected.
        want: String,
    },
}
