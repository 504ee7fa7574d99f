//! Photos made in a process of their own, which can be stopped at any moment and takes nothing down with it.
//!
//! What decodes foreign pictures or runs networks cannot be asked to stop, and what takes too much memory ends its process. So the
//! server runs its own program once more, with the same arguments and [`VARIABLE`] set, and keeps it for the next photo. Frames go
//! both ways through pipes: a kind of one byte, a length of eight (little-endian), and so many bytes.

use std::collections::BTreeMap;
use std::io::{self, Read, Write};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::maker::{Fault, Maker, PipelineMaker, Product};
use super::options;
use super::problem::Problem;
use tmpi_pipeline::{MakeError, Options, Progress, Report, STAGES, Sink, networks};

/// Set in the environment of a process that makes photos for a server.
pub const VARIABLE: &str = "TMPI_MAKES_PHOTOS";
/// How often cancellation and the deadline are looked at.
const TICK: Duration = Duration::from_millis(10);
/// Peak memory above which a process is not kept: allocators do not give all of it back.
const KEPT_BYTES: u64 = 768 << 20;
/// Longest frame.
const FRAME: u64 = 1 << 30;
/// Linux ends the process with the highest score first where memory is short: never the server for a photo's sake.
const SCORE: &str = "500";

/// Kinds of frames.
mod kind {
    pub const OPTIONS: u8 = 1;
    pub const PHOTO: u8 = 2;
    pub const DEPTH: u8 = 3;
    pub const MAKE: u8 = 4;
    pub const PROGRESS: u8 = 5;
    pub const CONTAINER: u8 = 6;
    pub const DISPARITY: u8 = 7;
    pub const THUMBNAIL: u8 = 8;
    pub const REPORT: u8 = 9;
    pub const FAULT: u8 = 10;
}

fn write(to: &mut impl Write, kind: u8, bytes: &[u8]) -> io::Result<()> {
    to.write_all(&[kind])?;
    to.write_all(&(bytes.len() as u64).to_le_bytes())?;
    to.write_all(bytes)
}

fn read(from: &mut impl Read) -> io::Result<(u8, Vec<u8>)> {
    let mut head = [0; 9];
    from.read_exact(&mut head)?;
    let [kind, length @ ..] = head;
    let length = u64::from_le_bytes(length);
    if length > FRAME {
        return Err(io::Error::new(io::ErrorKind::InvalidData, "a frame that is too long"));
    }
    let mut bytes = Vec::new();
    from.take(length).read_to_end(&mut bytes)?;
    if bytes.len() as u64 == length { Ok((kind, bytes)) } else { Err(io::ErrorKind::UnexpectedEof.into()) }
}

/// A stage as it is told.
#[derive(Serialize, Deserialize)]
struct Told {
    stage: String,
    step: u32,
    steps: u32,
    elapsed_ms: f64,
}

/// Makes photos in processes of their own.
pub struct ProcessMaker {
    checks: PipelineMaker,
    /// Processes that wait for a photo.
    idle: Mutex<Vec<Worker>>,
    command: fn() -> io::Result<Command>,
}

/// What a process answers, frame by frame, until it ends.
type Frames = Receiver<io::Result<(u8, Vec<u8>)>>;

struct Worker {
    child: Child,
    input: ChildStdin,
    output: Frames,
}

impl Drop for Worker {
    fn drop(&mut self) {
        // it may have ended already
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// This program with its own arguments, as a process that makes photos.
fn this_program() -> io::Result<Command> {
    // the file may have been replaced meanwhile
    let program = if cfg!(target_os = "linux") { "/proc/self/exe".into() } else { std::env::current_exe()? };
    let mut command = Command::new(program);
    command.args(std::env::args_os().skip(1)).env(VARIABLE, "1");
    Ok(command)
}

impl ProcessMaker {
    /// A maker that checks photos itself, and starts a process at once so that the first photo need not wait for it.
    #[must_use]
    pub fn new(checks: PipelineMaker) -> Self {
        let maker = Self { checks, idle: Mutex::default(), command: this_program };
        match maker.start() {
            Ok(worker) => maker.keep(worker),
            // it is tried again, and told, with the first photo
            Err(error) => tracing::warn!(%error, "starting a process that makes photos"),
        }
        maker
    }

    fn start(&self) -> io::Result<Worker> {
        let mut command = (self.command)()?;
        // a Ctrl-C in a terminal is for the server
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let (Some(input), Some(mut output)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(io::Error::other("a process without pipes"));
        };
        let (tell, told) = channel();
        std::thread::Builder::new().name("tmpi-child".into()).spawn(move || {
            loop {
                let frame = read(&mut output);
                let last = frame.is_err();
                if tell.send(frame).is_err() || last {
                    return;
                }
            }
        })?;
        Ok(Worker { child, input, output: told })
    }

    fn keep(&self, worker: Worker) {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner).push(worker);
    }

    fn take(&self) -> Result<Worker, Fault> {
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        while let Some(mut worker) = idle.pop() {
            if matches!(worker.child.try_wait(), Ok(None)) {
                return Ok(worker);
            }
        }
        drop(idle);
        self.start().map_err(|e| Fault::Server(format!("no process to make photos in can be started: {e}")))
    }
}

impl Maker for ProcessMaker {
    fn identity(&self) -> &str {
        self.checks.identity()
    }

    fn check(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> Result<(), MakeError> {
        self.checks.check(photo, depth, options)
    }

    fn memory(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> u64 {
        self.checks.memory(photo, depth, options)
    }

    fn lacks(&self) -> Option<&'static str> {
        let missing = "ONNX Runtime is missing: photos without a depth map wait for it; the server's log says where it was looked for";
        networks::available().is_err().then_some(missing)
    }

    fn make(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, Fault> {
        // what earlier photos left in a process must not be what is missing for this one
        let large = self.memory(photo, depth, options) > self.checks.most_memory() / 2;
        if large {
            self.idle.lock().unwrap_or_else(PoisonError::into_inner).clear();
        }
        let mut worker = self.take()?;
        let options = serde_json::to_vec(&options::to_text(options)).map_err(|e| Fault::Server(e.to_string()))?;
        let (outcome, keep) = std::thread::scope(|scope| {
            let Worker { child, input, output } = &mut worker;
            // a process that does not read would hold up whoever writes to it, past deadline and cancellation
            let sending = std::thread::Builder::new().name("tmpi-sends".into()).spawn_scoped(scope, || send(input, &options, photo, depth));
            if let Err(error) = sending {
                return (Err(Fault::Server(format!("no thread can be started: {error}"))), false);
            }
            let outcome = listen(child, output, sink);
            let keep = match &outcome {
                Ok(product) => product.report.peak_rss_bytes < KEPT_BYTES,
                Err(Answer::Told(Fault::Photo(_))) => true,
                // after a fault of its own a fresh one begins anew: a library that was missing may be there
                Err(_) => false,
            };
            if !keep {
                // what is still being sent to it ends with it
                let _ = child.kill();
            }
            (outcome.map_err(Answer::fault), keep)
        });
        if keep {
            self.keep(worker);
        }
        outcome
    }
}

/// Sends a photo to be made.
fn send(input: &mut ChildStdin, options: &[u8], photo: &[u8], depth: Option<&[u8]>) {
    // where the process has ended, the end of its output tells
    let _ = write(input, kind::OPTIONS, options)
        .and_then(|()| write(input, kind::PHOTO, photo))
        .and_then(|()| depth.map_or(Ok(()), |depth| write(input, kind::DEPTH, depth)))
        .and_then(|()| write(input, kind::MAKE, &[]))
        .and_then(|()| input.flush());
}

/// Why there is no photo.
enum Answer {
    /// The process says so, and waits for the next one.
    Told(Fault),
    /// It ended, or was not waited for, or answers nonsense.
    Lost(Fault),
}

impl Answer {
    fn fault(self) -> Fault {
        let (Self::Told(fault) | Self::Lost(fault)) = self;
        fault
    }
}

/// Takes frames until the photo is made, refused, cancelled or late.
fn listen(child: &mut Child, output: &Frames, sink: &dyn Sink) -> Result<Product, Answer> {
    let mut product = Product { container: Vec::new(), report: Report::default(), disparity: Vec::new(), thumbnail: Vec::new() };
    let mut stage = STAGES[0];
    let lost = |problem: String| Answer::Lost(Fault::Server(format!("a process that makes photos answered what it should not: {problem}")));
    loop {
        if sink.cancelled() {
            return Err(Answer::Lost(Fault::Cancelled));
        }
        let (kind, bytes) = match output.recv_timeout(TICK) {
            Ok(Ok(frame)) => frame,
            Ok(Err(_)) | Err(RecvTimeoutError::Disconnected) => return Err(Answer::Lost(Fault::Crashed(ending(child)))),
            Err(RecvTimeoutError::Timeout) => match sink.deadline() {
                Some(deadline) if Instant::now() >= deadline => return Err(Answer::Lost(MakeError::Late { stage }.into())),
                _ => continue,
            },
        };
        match kind {
            kind::PROGRESS => {
                let told: Told = serde_json::from_slice(&bytes).map_err(|e| lost(e.to_string()))?;
                stage = STAGES.iter().find(|s| **s == told.stage).copied().unwrap_or(stage);
                sink.progress(&Progress { stage, step: told.step, steps: told.steps, elapsed_ms: told.elapsed_ms });
            }
            kind::CONTAINER => product.container = bytes,
            kind::DISPARITY => product.disparity = bytes,
            kind::THUMBNAIL => product.thumbnail = bytes,
            kind::REPORT => {
                product.report = serde_json::from_slice(&bytes).map_err(|e| lost(e.to_string()))?;
                return Ok(product);
            }
            kind::FAULT => return Err(Answer::Told(serde_json::from_slice(&bytes).map_err(|e| lost(e.to_string()))?)),
            other => return Err(lost(format!("a frame of kind {other}"))),
        }
    }
}

/// How a process ended that was not told to.
fn ending(child: &mut Child) -> String {
    // it closed its pipe: it is about to end
    std::thread::sleep(TICK);
    match child.try_wait() {
        Ok(Some(status)) => format!("the process that made it ended: {status}"),
        _ => "the process that made it ended".to_owned(),
    }
}

/// Writes progress as frames.
struct Tells<W>(Mutex<W>);

impl<W: Write + Send> Tells<W> {
    fn tell(&self, kind: u8, bytes: &[u8]) {
        let mut output = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        // where nobody listens any more, the end of the input says so
        let _ = write(&mut *output, kind, bytes).and_then(|()| output.flush());
    }
}

impl<W: Write + Send> Sink for Tells<W> {
    fn progress(&self, p: &Progress) {
        let told = Told { stage: p.stage.to_owned(), step: p.step, steps: p.steps, elapsed_ms: p.elapsed_ms };
        self.tell(kind::PROGRESS, &serde_json::to_vec(&told).unwrap_or_default());
    }
}

/// Makes photos for the server that started this process, until it closes the pipe; `memory` bounds what this process may take, in
/// bytes.
pub fn serve(maker: &PipelineMaker, memory: u64) {
    if cfg!(target_os = "linux") {
        // where that is not allowed, the kernel chooses as it likes
        let _ = std::fs::write("/proc/self/oom_score_adj", SCORE);
    }
    outlive_signals();
    if let Err(error) = bound_memory(memory) {
        tracing::warn!(%error, "memory cannot be bounded");
    }
    let (tell, frames) = channel();
    let reader = std::thread::Builder::new().name("tmpi-frames".into()).spawn(move || {
        let mut input = io::stdin().lock();
        loop {
            let passed_on = read(&mut input).is_ok_and(|frame| tell.send(frame).is_ok());
            if !passed_on {
                // the server has gone: nobody wants what is being made
                #[allow(clippy::disallowed_methods, reason = "what runs cannot be stopped otherwise, and owns nothing")]
                std::process::exit(0);
            }
        }
    });
    if let Err(error) = reader {
        tracing::error!(%error, "no thread can be started");
        return;
    }
    let output = Tells(Mutex::new(io::stdout()));
    let (mut chosen, mut photo, mut depth) = (Vec::new(), Vec::new(), None);
    for (kind, bytes) in frames {
        match kind {
            kind::OPTIONS => chosen = bytes,
            kind::PHOTO => photo = bytes,
            kind::DEPTH => depth = Some(bytes),
            kind::MAKE => {
                answer(&output, one(maker, &chosen, &std::mem::take(&mut photo), depth.take().as_deref(), &output));
            }
            _ => return,
        }
    }
}

fn one(maker: &PipelineMaker, options: &[u8], photo: &[u8], depth: Option<&[u8]>, sink: &dyn Sink) -> Result<Product, Fault> {
    let text: BTreeMap<String, String> = serde_json::from_slice(options).map_err(|e| Fault::Server(e.to_string()))?;
    let options = options::from_text(&text).map_err(Fault::Photo)?;
    super::worker::caught(|| maker.make(photo, depth, &options, sink))
}

fn answer(output: &Tells<impl Write + Send>, outcome: Result<Product, Fault>) {
    let text = |value: serde_json::Result<Vec<u8>>| value.unwrap_or_default();
    match outcome {
        Ok(product) => {
            output.tell(kind::CONTAINER, &product.container);
            output.tell(kind::DISPARITY, &product.disparity);
            output.tell(kind::THUMBNAIL, &product.thumbnail);
            output.tell(kind::REPORT, &text(serde_json::to_vec(&product.report)));
        }
        Err(fault) => output.tell(kind::FAULT, &text(serde_json::to_vec(&fault))),
    }
}

/// Signals to stop go to all processes of a service at once; the server decides what becomes of the photo that is being made.
#[cfg(unix)]
#[allow(unsafe_code, reason = "two calls of libc that run no code of ours later")]
fn outlive_signals() {
    for signal in [libc::SIGTERM, libc::SIGINT] {
        // SAFETY: ignoring a signal installs no handler
        unsafe { libc::signal(signal, libc::SIG_IGN) };
    }
}

#[cfg(not(unix))]
fn outlive_signals() {}

#[cfg(target_os = "linux")]
#[allow(unsafe_code, reason = "a call of libc that only reads the struct it is handed")]
fn bound_memory(bytes: u64) -> io::Result<()> {
    let limit = libc::rlimit { rlim_cur: bytes, rlim_max: bytes };
    // SAFETY: the struct outlives the call
    if unsafe { libc::setrlimit(libc::RLIMIT_DATA, &raw const limit) } == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

#[cfg(not(target_os = "linux"))]
fn bound_memory(_: u64) -> io::Result<()> {
    // other systems have no limit that counts what a process takes for itself
    Ok(())
}

impl From<MakeError> for Fault {
    fn from(error: MakeError) -> Self {
        use tmpi_pipeline::StageError;
        use tmpi_pipeline::depth::DepthError;
        use tmpi_pipeline::networks::OnnxError;
        match &error {
            MakeError::Cancelled => Self::Cancelled,
            MakeError::Depth(DepthError::Onnx(e)) | MakeError::Generate(StageError::Onnx(e)) => match e {
                OnnxError::Library(_) | OnnxError::Model { .. } => Self::Server(error.to_string()),
                // the same photo may bring it about again
                OnnxError::Run { .. } => Self::Crashed(error.to_string()),
            },
            _ => Self::Photo(Problem::from(&error)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_read_as_they_were_written_and_cut_ones_are_not() {
        let mut bytes = Vec::new();
        write(&mut bytes, kind::PHOTO, b"abc").unwrap();
        write(&mut bytes, kind::MAKE, b"").unwrap();
        let mut from = bytes.as_slice();
        assert_eq!(read(&mut from).unwrap(), (kind::PHOTO, b"abc".to_vec()));
        assert_eq!(read(&mut from).unwrap(), (kind::MAKE, Vec::new()));
        assert!(read(&mut from).is_err());
        for end in 0..12 {
            assert!(read(&mut &bytes[..end]).is_err(), "cut to {end}");
        }
        assert!(read(&mut [[1].as_slice(), &(FRAME + 1).to_le_bytes()].concat().as_slice()).is_err());
    }
}
