//! The child process that makes photos for a server.

use std::collections::BTreeMap;
use std::io;
use std::sync::mpsc::channel;
use std::sync::{Arc, OnceLock};

use super::messages::{Answer, Work, read, write};
use super::{GIVES_WAY, VARIABLE};
use crate::server::exports::{Drawing, ExportTask, Recipe};
use crate::server::limits::Limits;
use crate::server::maker::{Fault, Maker, PipelineMaker, Product};
use crate::server::photo_options;
use crate::server::routes::Stage;
use crate::server::workers::catch_panic;
use tmpi_pipeline::{Progress, Silent, Sink, strokes, usage};

/// If memory is short, Linux kills the process with the highest score first: never the server because of a photo.
const SCORE: &str = "500";

/// Sends an answer with its files to the server.
fn tell(answer: &Answer, files: &[Vec<u8>]) {
    // if the server has gone, the end of the input shows it
    let _ = write(&mut io::stdout().lock(), answer, files);
}

/// Sends progress to the server.
struct ServerSink;

impl Sink for ServerSink {
    fn progress(&self, message: &Progress) {
        let &Progress { stage, step, steps, elapsed_ms } = message;
        tell(&Answer::Progress(Stage { stage: stage.to_owned(), step, steps, elapsed_ms }), &[]);
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
    let (pass_on, received) = channel();
    let reader = std::thread::Builder::new().name("tmpi-reads".into()).spawn(move || {
        let mut input = io::stdin().lock();
        loop {
            let passed_on = read::<Work>(&mut input).is_ok_and(|work| pass_on.send(work).is_ok());
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
    // created for the first film and reused
    let renderer = OnceLock::new();
    let drawn = || match renderer.get() {
        Some(known) => Ok(Arc::clone(known)),
        None => drawing().map(|fresh| Arc::clone(renderer.get_or_init(|| fresh))),
    };
    for (work, files) in received {
        let done = match work {
            Work::Make(options) => make(maker, &options, &files),
            Work::Write(recipe) => write_file(&recipe, &files, limits, &drawn),
        };
        let (answer, files) = done.unwrap_or_else(|fault| (Answer::Fault(fault), Vec::new()));
        tell(&answer, &files);
    }
}

fn make(maker: &PipelineMaker, options: &BTreeMap<String, String>, files: &[Vec<u8>]) -> Result<(Answer, Vec<Vec<u8>>), Fault> {
    let [strokes, photo, depth @ ..] = files else { return Err(Fault::Server("the photo is missing".into())) };
    let mut options = photo_options::from_text(options).map_err(Fault::Photo)?;
    options.strokes = strokes::read(strokes).map_err(|e| Fault::Server(e.to_string()))?;
    let depth = depth.first().map(Vec::as_slice);
    let made = catch_panic("making the photo panicked", || maker.make(photo, depth, &options, &ServerSink));
    let Product { container, report, disparity, thumbnail } = made?;
    Ok((Answer::Made(Box::new(report)), vec![container, disparity, thumbnail]))
}

fn write_file(recipe: &str, files: &[Vec<u8>], limits: &Limits, drawing: Drawing<'_>) -> Result<(Answer, Vec<Vec<u8>>), Fault> {
    let [container] = files else { return Err(Fault::Server("the container is missing".into())) };
    let recipe = Recipe::parse(recipe, limits).map_err(Fault::Photo)?;
    let task = ExportTask { recipe: &recipe, container, drawing, is_low_priority: false };
    // the server kills this process to cancel
    let bytes = catch_panic("writing a file panicked", || task.run(&Silent))?;
    Ok((Answer::Written(usage::peak_rss_bytes()), vec![bytes]))
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
