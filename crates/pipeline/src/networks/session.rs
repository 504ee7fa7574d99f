//! Runs a network in a worker thread of its own.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread;

use half::f16;
use ort::ep::{self, ExecutionProviderDispatch};
use ort::session::SessionInputValue;
use ort::session::builder::GraphOptimizationLevel;
use ort::value::{TensorElementType, TensorRef, ValueType};

use super::{Network, OnnxError, Tensor, library};

/// Runs that may wait; further callers block.
const QUEUE: usize = 16;

/// What computes a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
#[value(rename_all = "lower")]
pub enum Provider {
    /// The processor.
    Cpu,
    /// NVIDIA.
    Cuda,
    /// Apple.
    CoreMl,
    /// Any `DirectX` 12 card.
    DirectMl,
}

impl Provider {
    fn dispatch(self) -> ExecutionProviderDispatch {
        match self {
            Self::Cpu => ep::CPU::default().build(),
            Self::Cuda => ep::CUDA::default().build(),
            Self::CoreMl => ep::CoreML::default().build(),
            Self::DirectMl => ep::DirectML::default().build(),
        }
    }
}

/// How a network is loaded and run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Config {
    /// Threads per operation; 0: one per core.
    pub threads: usize,
    /// Providers, best first. If the list holds [`Provider::Cpu`], missing providers are skipped; else they are errors.
    pub providers: Vec<Provider>,
}

impl Default for Config {
    fn default() -> Self {
        Self { threads: 0, providers: vec![Provider::Cpu] }
    }
}

/// An input or output of a network. An input that is a single 64-bit integer is given as a float and truncated.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TensorInfo {
    /// Its name in the graph.
    pub name: String,
    /// Its dimensions; −1 if any size will do.
    pub shape: Vec<i64>,
}

/// Number type of a port.
#[derive(Clone, Copy, PartialEq)]
enum Number {
    Single,
    /// 16-bit floats, in networks of half precision without 32-bit inputs and outputs.
    Half,
    /// A single 64-bit integer, for inputs only.
    Whole,
}

/// A port with the number type that the session expects.
#[derive(Clone)]
struct TypedTensor {
    port: TensorInfo,
    number: Number,
}

/// A file of weights: its name in the ONNX file, and its bytes.
pub type ExternalData = (String, Arc<[u8]>);

struct Job {
    inputs: Vec<Tensor>,
    reply: SyncSender<Result<Vec<Tensor>, OnnxError>>,
}

/// A loaded network. A worker thread named after it owns the ONNX Runtime session, because that session's `run` is not thread-safe.
pub struct Session {
    name: String,
    inputs: Vec<TensorInfo>,
    outputs: Vec<TensorInfo>,
    queue: SyncSender<Job>,
}

impl Session {
    /// Loads a network from the bytes of an ONNX file and of the files of weights that it names. `name` appears in errors and names the
    /// thread.
    ///
    /// # Errors
    /// [`OnnxError::Library`] without ONNX Runtime, [`OnnxError::Model`] if a file cannot be used.
    pub fn load(name: &str, model: &[u8], external_data: &[ExternalData], config: &Config) -> Result<Self, OnnxError> {
        let reason = |reason: String| OnnxError::Model { name: name.to_owned(), reason };
        let session = build(model, external_data, config).map_err(|e| match e {
            Fault::Library(e) => e,
            Fault::Model(e) => reason(e),
        })?;
        let (inputs, outputs) = (ports(session.inputs(), true).map_err(reason)?, ports(session.outputs(), false).map_err(reason)?);
        let (queue, jobs) = sync_channel(QUEUE);
        let worker = Worker { name: name.to_owned(), session, inputs: inputs.clone() };
        let plain = |ports: Vec<TypedTensor>| ports.into_iter().map(|w| w.port).collect();
        thread::Builder::new()
            .name(format!("onnx-{name}"))
            .spawn(move || worker.serve(&jobs))
            .map_err(|e| reason(format!("its thread does not start: {e}")))?;
        Ok(Self { name: name.to_owned(), inputs: plain(inputs), outputs: plain(outputs), queue })
    }

    /// Inputs in the graph's order.
    pub fn inputs(&self) -> &[TensorInfo] {
        &self.inputs
    }

    /// Outputs in the graph's order.
    pub fn outputs(&self) -> &[TensorInfo] {
        &self.outputs
    }
}

impl Network for Session {
    fn run(&self, inputs: Vec<Tensor>) -> Result<Vec<Tensor>, OnnxError> {
        let gone = || OnnxError::Run { name: self.name.clone(), reason: "its worker thread has ended".into() };
        let (reply, result) = sync_channel(1);
        self.queue.send(Job { inputs, reply }).map_err(|_| gone())?;
        result.recv().map_err(|_| gone())?
    }
}

enum Fault {
    Library(OnnxError),
    Model(String),
}

impl<R> From<ort::Error<R>> for Fault {
    fn from(e: ort::Error<R>) -> Self {
        Self::Model(e.message().to_owned())
    }
}

fn build(model: &[u8], external_data: &[ExternalData], config: &Config) -> Result<ort::session::Session, Fault> {
    let environment = library::environment().map_err(Fault::Library)?;
    let fall_back = config.providers.contains(&Provider::Cpu);
    let providers: Vec<_> = config
        .providers
        .iter()
        .filter(|&&p| p != Provider::Cpu)
        .map(|p| if fall_back { p.dispatch() } else { p.dispatch().error_on_failure() })
        .collect();
    let mut builder = ort::session::Session::builder(environment)?;
    for (name, bytes) in external_data {
        builder = builder.with_external_initializer_file_in_memory(name, Arc::clone(bytes))?;
    }
    Ok(builder
        .with_optimization_level(GraphOptimizationLevel::All)?
        .with_intra_threads(config.threads)?
        // idle threads that spin take cores from the steps between two networks
        .with_intra_op_spinning(false)?
        .with_execution_providers(providers)?
        .commit_from_memory(model)?)
}

fn ports(outlets: &[ort::value::Outlet], inputs: bool) -> Result<Vec<TypedTensor>, String> {
    let typed = |o: &ort::value::Outlet| {
        let ValueType::Tensor { ty, shape, .. } = o.dtype() else { return None };
        let number = match ty {
            TensorElementType::Float32 => Number::Single,
            TensorElementType::Float16 => Number::Half,
            TensorElementType::Int64 if inputs && shape.iter().all(|&n| n.abs() == 1) => Number::Whole,
            _ => return None,
        };
        Some(TypedTensor { port: TensorInfo { name: o.name().to_owned(), shape: shape.to_vec() }, number })
    };
    let all =
        outlets.iter().map(|o| typed(o).ok_or_else(|| format!("{} is {:?}, not a tensor of 32-bit or 16-bit floats", o.name(), o.dtype())));
    all.collect()
}

struct Worker {
    name: String,
    session: ort::session::Session,
    inputs: Vec<TypedTensor>,
}

impl Worker {
    fn serve(mut self, jobs: &Receiver<Job>) {
        for job in jobs {
            // the caller may no longer wait
            let _ = job.reply.send(self.run(&job.inputs).map_err(|reason| OnnxError::Run { name: self.name.clone(), reason }));
        }
    }

    fn run(&mut self, inputs: &[Tensor]) -> Result<Vec<Tensor>, String> {
        if inputs.len() != self.inputs.len() {
            return Err(format!("{} inputs given, {} expected", inputs.len(), self.inputs.len()));
        }
        let mut values = Vec::with_capacity(inputs.len());
        for (tensor, TypedTensor { port, number }) in inputs.iter().zip(&self.inputs) {
            check(tensor, port)?;
            let shape = tensor.shape.as_slice();
            values.push(match number {
                Number::Half => {
                    let data: Vec<f16> = tensor.data.iter().map(|v| f16::from_f32(*v)).collect();
                    SessionInputValue::from(ort::value::Tensor::from_array((shape, data)).map_err(|e| e.to_string())?)
                }
                Number::Whole => {
                    let data: Vec<i64> = tensor.data.iter().map(|v| *v as i64).collect();
                    SessionInputValue::from(ort::value::Tensor::from_array((shape, data)).map_err(|e| e.to_string())?)
                }
                Number::Single => {
                    let value = TensorRef::from_array_view((shape, tensor.data.as_slice())).map_err(|e| e.to_string())?;
                    SessionInputValue::from(value)
                }
            });
        }
        let outputs = self.session.run(values.as_slice()).map_err(|e| e.message().to_owned())?;
        outputs
            .values()
            .map(|value| {
                let (shape, data) = if *value.data_type() == TensorElementType::Float16 {
                    let (shape, data) = value.try_extract_tensor::<f16>().map_err(|e| e.to_string())?;
                    (shape, data.iter().map(|v| v.to_f32()).collect())
                } else {
                    let (shape, data) = value.try_extract_tensor::<f32>().map_err(|e| e.to_string())?;
                    (shape, data.to_vec())
                };
                let shape = shape.iter().map(|&n| usize::try_from(n).map_err(|_| format!("an output has a dimension of {n}")));
                Ok(Tensor { shape: shape.collect::<Result<_, String>>()?, data })
            })
            .collect()
    }
}

fn check(tensor: &Tensor, port: &TensorInfo) -> Result<(), String> {
    let fits = tensor.shape.len() == port.shape.len()
        && tensor.shape.iter().zip(&port.shape).all(|(&n, &want)| n > 0 && (want < 0 || usize::try_from(want) == Ok(n)));
    if !fits {
        return Err(format!("input {} is {:?}, expected {:?} (-1: any)", port.name, tensor.shape, port.shape));
    }
    let count = tensor.shape.iter().try_fold(1usize, |n, &s| n.checked_mul(s));
    if count != Some(tensor.data.len()) {
        return Err(format!("input {} of {:?} has {} values", port.name, tensor.shape, tensor.data.len()));
    }
    Ok(())
}
