//! Makes photos in a child process, which can be killed at any time without harm to the server.
//!
//! Image decoders and networks cannot be cancelled, and running out of memory ends their process. So the server runs its own program again,
//! with [`VARIABLE`] set, and keeps the process for the next photo. It gets only the arguments for making photos and the variables of
//! [`is_passed`], so that an exploited decoder finds no credentials.

mod child_main;
mod exchange;
mod messages;
mod scratch;

use std::ffi::{OsStr, OsString};
use std::io::{self, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use super::better_network::BetterNetwork;
use super::depth_network_download::{InstalledNetwork, NetworkOffer};
use super::exports::ExportTask;
use super::maker::{Fault, HeadOf, Maker, PipelineMaker, Product};
use super::problem::Problem;
pub use child_main::serve;
use messages::{Answer, read};
use scratch::Scratch;
pub use scratch::remove_leftovers;
use tmpi_pipeline::{MakeError, Options, Sink, networks};

/// Environment variable that marks a process that makes photos for a server.
pub const VARIABLE: &str = "TMPI_MAKES_PHOTOS";
/// Its value for a low-priority process.
const GIVES_WAY: &str = "gives-way";
/// Interval of the checks for cancellation and the deadline.
const TICK: Duration = Duration::from_millis(10);
/// A process with a higher peak memory is not reused: allocators do not return all of it.
const KEPT_BYTES: u64 = 768 << 20;

/// Makes photos in child processes.
pub struct ProcessMaker {
    checks: PipelineMaker,
    idle: Mutex<Vec<ChildProcess>>,
    command: Box<dyn Fn() -> io::Result<Command> + Send + Sync>,
    /// Parent folder of the processes' temporary files.
    scratch: PathBuf,
    /// It may be downloaded; processes that start later use it.
    better: Option<BetterNetwork>,
    /// Maker identity and network after the download.
    renewed: OnceLock<InstalledNetwork>,
}

/// The answers of a process with their files, until it ends.
type Answers = Receiver<io::Result<(Answer, Vec<Vec<u8>>)>>;

struct ChildProcess {
    /// When it made its last photo; `None` if it has made none.
    made: Option<Instant>,
    /// Whether it started with the better network.
    renewed: bool,
    is_low_priority: bool,
    child: Child,
    input: ChildStdin,
    output: Answers,
    /// Its temporary files; removed last, after it has ended.
    scratch: Scratch,
}

impl Drop for ChildProcess {
    fn drop(&mut self) {
        end(&mut self.child);
        let _ = self.child.wait();
    }
}

/// Kills a process and its children, such as ffmpeg.
fn end(child: &mut Child) {
    end_group(child);
    // it may have ended already
    let _ = child.kill();
}

/// Kills a process group, even if its leader has ended; does nothing once the leader was waited for.
#[cfg(unix)]
#[allow(unsafe_code, reason = "the standard library sends no signals to groups, and does not look at a child without waiting for it")]
fn end_group(child: &Child) {
    // SAFETY: all zeros is a value of this struct of integers
    let mut info: libc::siginfo_t = unsafe { std::mem::zeroed() };
    let look = libc::WEXITED | libc::WNOHANG | libc::WNOWAIT;
    // SAFETY: the struct outlives the call, which only writes it
    let ours = unsafe { libc::waitid(libc::P_PID, child.id() as libc::id_t, &raw mut info, look) } == 0;
    if ours {
        // SAFETY: no memory is touched; the process was not waited for, so that the number is still its own
        let _ = unsafe { libc::kill(-(child.id() as libc::pid_t), libc::SIGKILL) };
    }
}

#[cfg(not(unix))]
fn end_group(_: &Child) {}

/// A command that runs this program with `arguments` to make photos.
fn this_program(arguments: &[OsString]) -> io::Result<Command> {
    // the file may be replaced meanwhile
    let program = if cfg!(target_os = "linux") { "/proc/self/exe".into() } else { std::env::current_exe()? };
    let mut command = Command::new(program);
    let passed = std::env::vars_os().filter(|(name, _)| is_passed(name));
    command.args(arguments).env_clear().envs(passed).env(VARIABLE, "1");
    Ok(command)
}

/// Whether child processes get an environment variable of the server: only those about programs, libraries, networks, graphics adapters and
/// logging.
fn is_passed(name: &OsStr) -> bool {
    const NAMES: [&str; 17] = [
        "CUDA_VISIBLE_DEVICES",
        "HOME",
        "LOCALAPPDATA",
        "MALLOC_ARENA_MAX",
        "NODEVICE_SELECT",
        "ORT_DYLIB_PATH",
        "PATH",
        "RAYON_NUM_THREADS",
        "RUST_BACKTRACE",
        "RUST_LOG",
        "SYSTEMROOT",
        "TMPI_COSTS",
        "TMPI_MODELS",
        "USERPROFILE",
        "XDG_CACHE_HOME",
        "XDG_DATA_HOME",
        "XDG_RUNTIME_DIR",
    ];
    const BEGINNINGS: [&str; 5] = ["DYLD_", "LD_", "LP_", "MESA_", "VK_"];
    name.to_str().is_some_and(|name| NAMES.contains(&name) || BEGINNINGS.iter().any(|begin| name.starts_with(begin)))
}

/// Keeps other processes of the same user, such as child processes, from reading the memory and environment of this one; also disables core
/// dumps.
#[cfg(target_os = "linux")]
#[allow(unsafe_code, reason = "a call of libc without memory of ours")]
pub fn disable_process_inspection() {
    // SAFETY: it takes no pointer
    if unsafe { libc::prctl(libc::PR_SET_DUMPABLE, 0, 0, 0, 0) } != 0 {
        tracing::warn!(error = %io::Error::last_os_error(), "other processes of this user can read the memory of this one");
    }
}

/// Not available on other systems.
#[cfg(not(target_os = "linux"))]
pub fn disable_process_inspection() {}

impl ProcessMaker {
    /// A maker that checks photos itself, and starts a process ahead of the first photo. `arguments` is the command line of the processes
    /// without the program; their temporary files are in the data directory `data`. It may download the network `better` while it runs.
    pub fn new(checks: PipelineMaker, arguments: Vec<OsString>, data: &Path, better: Option<BetterNetwork>) -> Self {
        let command = Box::new(move || this_program(&arguments));
        let scratch = scratch::folder(data);
        let maker = Self { checks, idle: Mutex::default(), command, scratch, better, renewed: OnceLock::new() };
        maker.prepare();
        maker
    }

    /// Starts an idle process.
    fn prepare(&self) {
        match self.start(false) {
            Ok(worker) => self.keep(worker),
            // the first photo retries, and reports the failure
            Err(error) => tracing::warn!(%error, "starting a process that makes photos"),
        }
    }

    fn start(&self, is_low_priority: bool) -> io::Result<ChildProcess> {
        // before the process looks for its network
        let renewed = self.renewed.get().is_some();
        let mut command = (self.command)()?;
        if is_low_priority {
            command.env(VARIABLE, GIVES_WAY);
        }
        let scratch = Scratch::below(&self.scratch);
        command.env(scratch::VARIABLE, scratch.path());
        // Ctrl-C in a terminal is for the server only
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let (Some(input), Some(output)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(io::Error::other("a process has no pipes"));
        };
        let (tell, told) = channel();
        std::thread::Builder::new().name("tmpi-child".into()).spawn(move || {
            let mut output = BufReader::new(output);
            loop {
                let answer = read(&mut output);
                let last = answer.is_err();
                if tell.send(answer).is_err() || last {
                    return;
                }
            }
        })?;
        Ok(ChildProcess { made: None, renewed, is_low_priority, child, input, output: told, scratch })
    }

    fn keep(&self, worker: ChildProcess) {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner).push(worker);
    }

    /// An idle or new process of this priority, with a folder for temporary files.
    fn take(&self, is_low_priority: bool) -> Result<ChildProcess, Fault> {
        let worker = self.waiting(is_low_priority).map_or_else(|| self.start(is_low_priority), Ok);
        let worker = worker.map_err(|e| Fault::Server(format!("cannot start a process to make photos: {e}")))?;
        if let Err(error) = worker.scratch.make() {
            // only films need it, and report it: on a full disk all else works
            tracing::warn!(%error, "a folder for temporary files");
        }
        Ok(worker)
    }

    /// An idle process of this priority.
    fn waiting(&self, is_low_priority: bool) -> Option<ChildProcess> {
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        while let Some(at) = idle.iter().rposition(|worker| worker.is_low_priority == is_low_priority) {
            let mut worker = idle.swap_remove(at);
            if worker.renewed == self.renewed.get().is_some() && matches!(worker.child.try_wait(), Ok(None)) {
                return Some(worker);
            }
        }
        None
    }
}

impl Maker for ProcessMaker {
    fn identity(&self) -> &str {
        self.renewed.get().map_or_else(|| self.checks.identity(), |renewed| &renewed.identity)
    }

    fn network(&self) -> &str {
        self.renewed.get().map_or_else(|| self.checks.network(), |renewed| &renewed.network)
    }

    fn better(&self) -> Option<NetworkOffer> {
        self.better.as_ref().filter(|_| self.renewed.get().is_none()).map(BetterNetwork::offer)
    }

    fn download_better(&self, progress: &mut dyn FnMut(u64)) -> Result<(), String> {
        let better = self.better.as_ref().ok_or("there is no better network")?;
        let renewed = better.fetch(progress)?;
        // one download runs at a time
        let _ = self.renewed.set(renewed);
        Ok(())
    }

    fn check(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> Result<(), MakeError> {
        self.checks.check(photo, depth, options)
    }

    fn check_head(&self, of: HeadOf<'_>, head: &[u8]) -> Result<Option<usize>, MakeError> {
        self.checks.check_head(of, head)
    }

    fn memory(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> u64 {
        self.checks.memory(photo, depth, options)
    }

    fn lacks(&self) -> Option<&'static str> {
        let missing = "ONNX Runtime is missing: photos without a depth map wait for it; the server's log says where it was looked for";
        networks::available().is_err().then_some(missing)
    }

    fn release_idle_memory(&self, idle_time: Duration) -> bool {
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        let before = idle.len();
        idle.retain(|worker| worker.made.is_none_or(|at| at.elapsed() < idle_time));
        let (ended, none) = (before - idle.len(), idle.iter().all(|worker| worker.is_low_priority));
        drop(idle);
        if ended > 0 && none {
            // so the next photo need not wait for a process to start; a process that has made none is small
            self.prepare();
        }
        ended > 0
    }

    fn export(&self, work: &ExportTask<'_>, sink: &dyn Sink) -> Result<Vec<u8>, Fault> {
        self.write_file(work, sink)
    }

    fn make(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, Fault> {
        // earlier photos' memory in a process must not be missing for this one
        let large = self.memory(photo, depth, options) > self.checks.max_memory() / 2;
        if large {
            self.idle.lock().unwrap_or_else(PoisonError::into_inner).clear();
        }
        self.make_photo(photo, depth, options, sink)
    }
}

/// How a process ended that the server did not kill.
fn ending(child: &mut Child) -> String {
    // it closed its pipe and is about to end
    std::thread::sleep(TICK);
    // before waiting for it: after that, the group id may be reused
    end_group(child);
    match child.try_wait() {
        Ok(Some(status)) => format!("the process that made it ended: {status}"),
        _ => "the process that made it ended".to_owned(),
    }
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
                // the same photo may cause it again
                OnnxError::Run { .. } => Self::Crashed(error.to_string()),
            },
            _ => Self::Photo(Problem::from(&error)),
        }
    }
}

#[cfg(test)]
#[cfg(unix)]
mod tests;
