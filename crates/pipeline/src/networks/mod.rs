//! ONNX Runtime: the library is loaded at run time, and each session belongs to a named worker thread with a bounded queue.

pub mod cli_flags;
mod library;
pub mod models;
mod onnx_graph;
mod session;

#[cfg(test)]
mod tests;

pub use library::{available, disable_telemetry};
pub use onnx_graph::{OnnxGraph, onnx_graph};
pub use session::{Config, ExternalData, Provider, Session, TensorInfo};

/// A dense `f32` tensor, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Dimensions, outermost first.
    pub shape: Vec<usize>,
    /// As many values as the product of `shape`.
    pub data: Vec<f32>,
}

/// Why a network could not be loaded or run.
#[derive(Clone, Debug, thiserror::Error)]
pub enum OnnxError {
    /// No usable ONNX Runtime library; the text lists what was tried and what to do.
    #[error("ONNX Runtime was not found: {0}")]
    Library(String),
    /// The model file is unusable.
    #[error("model {name}: {reason}")]
    Model {
        /// Name of the model.
        name: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The network failed while running.
    #[error("running {name}: {reason}")]
    Run {
        /// Name of the model.
        name: String,
        /// What went wrong.
        reason: String,
    },
}

/// A network that can be run. Takes inputs and returns outputs in the graph's order.
pub trait Network: Send + Sync {
    /// Runs the network. Blocks the calling thread until its turn has come and the result is ready.
    ///
    /// # Errors
    /// [`OnnxError::Run`] if the network fails or an input does not fit.
    fn run(&self, inputs: Vec<Tensor>) -> Result<Vec<Tensor>, OnnxError>;
}

/// A function of the first input, for tests.
#[cfg(test)]
impl<F: Fn(&Tensor) -> Vec<Tensor> + Send + Sync> Network for F {
    fn run(&self, inputs: Vec<Tensor>) -> Result<Vec<Tensor>, OnnxError> {
        Ok(self(&inputs[0]))
    }
}
