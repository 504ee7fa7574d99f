//! The child process that makes photos for a server.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use super::pipe_frames::{StageFrame, kind, read, write};
use super::{GIVES_WAY, VARIABLE};
use crate::server::exports::{Drawing, ExportTask, Recipe};
use crate::server::limits::Limits;
use crate::server::maker::{Fault, Maker, PipelineMaker, Product};
use crate::server::photo_options;
use crate::server::problem::Problem;
use crate::server::workers::{catch_panic, panic_message};
use tmpi_pipeline::{Progress, Silent, Sink, strokes};

/// If memory is short, Linux kills the process with the highest score first: never the server because of a photo.
const SCORE: &str = "500";

/// Writes progress as frames.
struct FrameWriter<W>(Mutex<W>);

impl<W: Write + Send> FrameWriter<W> {
    fn tell(&self, kind: u8, bytes: &[u8]) {
        let mut output = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        // if the server has gone, the end of the input shows it
        let _ = write(&mut *output, kind, bytes).and_then(|()| output.flush());
    }
}

impl<W: Write + Send> Sink for FrameWriter<W> {
    fn progress(&self, p: &Progress) {
        let told = StageFrame { stage: p.stage.to_owned(), step: p.step, steps: p.steps, elapsed_ms: p.elapsed_ms };
        self.tell(kind::PROGRESS, &serde_json::to_vec(&told).unwrap_or_default());
    }
}

/// `nice` increment of a low-priority process.
#[cfg(unix)]
const NICE: i32 = 10;

/// Makes photos, and writes files with the renderer of `drawing`, for the server that started this process, until it closes the pipe.
/// [`Limits::job_memory`] bounds the memory of this process.
pub fn serve(maker: &PipelineMaker, limits: &Limits, drawing: Drawing<'_>) {
    let memory = limits.job_memory;
    if std::env::var_os(VARIABLE).is_some_and(|how| how == GIVES_WAY) {
        give_way();
    }
    if cfg!(target_os = "linux") {
        // if that is not allowed, the kernel chooses freely
        let _ = std::fs::write("/proc/self/oom_score_adj", SCORE);
    }
    outlive_signals();
    if let Err(error) = bound_memory(memory) {
        tracing::warn!(%error, "cannot limit memory");
    }
    let (tell, frames) = channel();
    let reader = std::thread::Builder::new().name("tmpi-frames".into()).spawn(move || {
        let mut input = io::stdin().lock();
        loop {
            let passed_on = read(&mut input).is_ok_and(|frame| tell.send(frame).is_ok());
            if !passed_on {
                // the server has gone
                #[allow(clippy::disallowed_methods, reason = "what runs cannot be stopped otherwise, and owns nothing")]
                std::process::exit(0);
            }
        }
    });
    if let Err(error) = reader {
        tracing::error!(%error, "cannot start a thread");
        return;
    }
    let output = FrameWriter(Mutex::new(io::stdout()));
    let mut recipe = Vec::new();
    // created for the first film and reused
    let renderer = OnceLock::new();
    let drawn = || match renderer.get() {
        Some(known) => Ok(Arc::clone(known)),
        None => drawing().map(|fresh| Arc::clone(renderer.get_or_init(|| fresh))),
    };
    let (mut chosen, mut strokes, mut photo, mut depth) = (Vec::new(), Vec::new(), Vec::new(), None);
    for (kind, bytes) in frames {
        match kind {
            kind::OPTIONS => chosen = bytes,
            kind::STROKES => strokes = bytes,
            kind::PHOTO => photo = bytes,
            kind::DEPTH => depth = Some(bytes),
            kind::MAKE => {
                answer(&output, one(maker, (&chosen, &strokes), &std::mem::take(&mut photo), depth.take().as_deref(), &output));
            }
            kind::RECIPE => recipe = bytes,
            kind::WRITE => tell_file(&output, file(&recipe, &bytes, limits, &drawn)),
            _ => return,
        }
    }
}

fn file(recipe: &[u8], container: &[u8], limits: &Limits, drawing: Drawing<'_>) -> Result<Vec<u8>, Fault> {
    let recipe = Recipe::parse(&String::from_utf8_lossy(recipe), limits).map_err(Fault::Photo)?;
    let work = ExportTask { recipe: &recipe, container, drawing, is_low_priority: false };
    // the server kills this process to cancel
    catch_unwind(AssertUnwindSafe(|| work.run(&Silent)))
        .unwrap_or_else(|panic| Err(Fault::Photo(Problem::internal("writing a file panicked", &panic_message(panic.as_ref())))))
}

fn tell_file(output: &FrameWriter<impl Write + Send>, outcome: Result<Vec<u8>, Fault>) {
    match outcome {
        Ok(bytes) => {
            output.tell(kind::PEAK, &tmpi_pipeline::usage::peak_rss_bytes().to_le_bytes());
            output.tell(kind::FILE, &bytes);
        }
        Err(fault) => output.tell(kind::FAULT, &serde_json::to_vec(&fault).unwrap_or_default()),
    }
}

/// Lowers the priority of this process.
#[cfg(unix)]
#[allow(unsafe_code, reason = "a call of libc without memory of ours")]
fn give_way() {
    // SAFETY: it takes no pointer; if it fails, nothing changes
    let _ = unsafe { libc::nice(NICE) };
}

#[cfg(not(unix))]
fn give_way() {}

fn one(
    maker: &PipelineMaker,
    (options, strokes): (&[u8], &[u8]),
    photo: &[u8],
    depth: Option<&[u8]>,
    sink: &dyn Sink,
) -> Result<Product, Fault> {
    let text: BTreeMap<String, String> = serde_json::from_slice(options).map_err(|e| Fault::Server(e.to_string()))?;
    let mut options = photo_options::from_text(&text).map_err(Fault::Photo)?;
    options.strokes = strokes::read(strokes).map_err(|e| Fault::Server(e.to_string()))?;
    catch_panic(|| maker.make(photo, depth, &options, sink))
}

fn answer(output: &FrameWriter<impl Write + Send>, outcome: Result<Product, Fault>) {
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

/// Ignores stop signals: a service manager sends them to all its processes, but the server decides about the current photo.
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
    // other systems have no limit on the memory that a process allocates
    Ok(())
}
