//! Errors of the stages.

/// Why a scene could not be made.
#[derive(Debug, thiserror::Error)]
pub enum StageError {
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
    /// A stroke is not as strokes are; the text names its field.
    #[error(transparent)]
    Stroke(#[from] crate::strokes::StrokeError),
    /// An option asks for more than readers of a container take of a photo of this size; the text names the bound.
    #[error("{field}: {detail}")]
    Bound {
        /// Name of the option.
        field: &'static str,
        /// What is asked for, and the most that can be.
        detail: String,
    },
    /// An option wants a network whose file is not there; the text names both.
    #[error("{field} {value} wants the network {file}, which is not in the folder of networks (TMPI_MODELS)")]
    Network {
        /// Name of the option.
        field: &'static str,
        /// What was given.
        value: &'static str,
        /// Name of the file.
        file: &'static str,
    },
    /// A network failed.
    #[error(transparent)]
    Onnx(#[from] crate::networks::OnnxError),
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
