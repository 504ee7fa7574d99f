//! ONNX Runtime: the library is looked up at run time, sessions belong to named worker threads with bounded queues.

pub mod cli_flags;
mod library;
pub mod models;
mod onnx_graph;
mod session;

#[cfg(test)]
mod tests;

pub use library::{available, keep_to_yourself};
pub use onnx_graph::{OnnxGraph, onnx_graph};
pub use session::{Beside, Config, Optimisation, Port, Provider, Session};

/// A dense `f32` tensor, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Extents, outermost first.
    pub shape: Vec<usize>,
    /// `shape` product many values.
    pub data: Vec<f32>,
}

/// Why a network could not be loaded or run.
#[derive(Clone, Debug, thiserror::Error)]
pub enum OnnxError {
    /// No usable ONNX Runtime library; the text lists where it was looked for and what to do.
    #[error("ONNX Runtime was not found: {0}")]
    Library(String),
    /// The model file is not usable.
    #[error("model {name}: {reason}")]
    Model {
        /// Name of the model.
        name: String,
        /// What ONNX Runtime says.
        reason: String,
    },
    /// The network failed while running.
    #[error("running {name}: {reason}")]
    Run {
        /// Name of the model.
        name: String,
        /// What ONNX Runtime says.
        reason: String,
    },
}

/// A network that can be run: named inputs in the graph's order in, outputs in the graph's order out.
pub trait Network: Send + Sync {
    /// Runs the network; blocks the calling thread until its turn has come and the result is there.
    ///
    /// # Errors
    /// [`OnnxError::Run`].
    fn run(&self, inputs: Vec<Tensor>) -> Result<Vec<Tensor>, OnnxError>;
}
