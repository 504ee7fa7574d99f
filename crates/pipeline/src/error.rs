//! Errors of the stages.

/// Why a stage failed.
#[derive(Debug, thiserror::Error)]
pub enum StageError {
    /// An option is out of its range.
    #[error("{field} must be {range}, not {value}")]
    Option {
        /// Name of the option.
        field: &'static str,
        /// Allowed range.
        range: &'static str,
        /// Given value.
        value: String,
    },
    /// A stroke is invalid; the text names its field.
    #[error(transparent)]
    Stroke(#[from] crate::strokes::StrokeError),
    /// An option needs more than a container's readers accept for a photo of this size; the text names the bound.
    #[error("{field}: {detail}")]
    Bound {
        /// Name of the option.
        field: &'static str,
        /// What the option needs, and the largest allowed.
        detail: String,
    },
    /// An option needs a network whose file is missing; the text names both.
    #[error("{field} {value} needs the network {file}, which is missing from the folder of networks (TMPI_MODELS)")]
    Network {
        /// Name of the option.
        field: &'static str,
        /// Given value.
        value: &'static str,
        /// Name of the file.
        file: &'static str,
    },
    /// A network failed.
    #[error(transparent)]
    Onnx(#[from] crate::networks::OnnxError),
    /// A network returned an output of another shape than its card states.
    #[error("{network} returned {got}, expected {want}")]
    Shape {
        /// The network.
        network: &'static str,
        /// Returned shape.
        got: String,
        /// Expected shape.
        want: String,
    },
}
