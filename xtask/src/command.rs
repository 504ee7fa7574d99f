//! Runs other programs.

use std::cell::RefCell;
use std::fmt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Mutex;

/// An error, with the step that failed.
pub struct Fault {
    step: Option<&'static str>,
    text: String,
}

impl Fault {
    pub fn new(text: impl Into<String>) -> Self {
        Self { step: None, text: text.into() }
    }

    /// An error of a file or folder.
    pub fn at(path: &Path, error: &std::io::Error) -> Self {
        Self::new(format!("{}: {error}", path.display()))
    }

    /// Names the step, unless one is already named.
    pub fn in_step(mut self, step: &'static str) -> Self {
        self.step.get_or_insert(step);
        self
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.step {
            Some(step) => write!(f, "step \"{step}\" failed: {}", self.text),
            None => f.write_str(&self.text),
        }
    }
}

pub fn root() -> PathBuf {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    here.parent().unwrap_or(here).to_owned()
}

/// A build profile of `Cargo.toml`.
#[derive(Clone, Copy)]
pub enum Profile {
    /// For users.
    Release,
    /// For lints and tests.
    Checks,
}

impl Profile {
    /// Name of the profile and of its build folder.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Release => "release",
            Self::Checks => "checks",
        }
    }
}

pub fn target() -> PathBuf {
    std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root().join("target"), |t| root().join(t))
}

/// Path of a program of the workspace, built with a profile.
pub fn built(profile: Profile, name: &str) -> PathBuf {
    target().join(profile.name()).join(format!("{name}{}", std::env::consts::EXE_SUFFIX))
}

/// Absolute path of the test data, for programs that run in another folder.
pub fn data() -> PathBuf {
    let named = std::env::var_os("TMPI_DATA").filter(|v| !v.is_empty());
    root().join(named.unwrap_or_else(|| "../shared/data".into()))
}

/// A command of the cargo that runs this task.
pub fn cargo(args: &[&str]) -> Command {
    let mut command = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.args(args).current_dir(root());
    command.env("TMPI_DATA", data());
    crate::runtime::set_env(&mut command);
    command
}

/// The command as you would type it in a shell.
pub fn command_line(command: &Command) -> String {
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    words.map(|w| w.to_string_lossy().into_owned()).collect::<Vec<_>>().join(" ")
}

thread_local! {
    /// Captured output of this thread's step; `None` if the step prints directly.
    static CAPTURED: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// Calls `run` and returns its result with everything that it and its programs print.
pub fn capture<T>(run: impl FnOnce() -> T) -> (T, String) {
    CAPTURED.set(Some(String::new()));
    let result = run();
    (result, CAPTURED.take().unwrap_or_default())
}

/// Prints a line, or captures it during [`capture`].
pub fn say(text: &str) {
    CAPTURED.with_borrow_mut(|captured| match captured {
        Some(captured) => {
            captured.push_str(text);
            captured.push('\n');
        }
        None => println!("{text}"),
    });
}

/// The error of a program that does not start.
pub fn not_started(command: &Command, error: &std::io::Error) -> Fault {
    Fault::new(format!("cannot start `{}`: {error}", command_line(command)))
}

/// Runs a program and shows its output.
pub fn run(mut command: Command) -> Result<(), Fault> {
    let status = if CAPTURED.with_borrow(Option::is_some) {
        let output = command.output().map_err(|e| not_started(&command, &e))?;
        say(&[output.stdout, output.stderr].map(|b| String::from_utf8_lossy(&b).into_owned()).concat());
        output.status
    } else {
        command.status().map_err(|e| not_started(&command, &e))?
    };
    if status.success() { Ok(()) } else { Err(Fault::new(format!("`{}`: {status}", command_line(&command)))) }
}

/// Runs a program and returns its output, standard output before standard error.
pub fn run_quietly(mut command: Command) -> Result<String, Fault> {
    let output = command.output().map_err(|e| not_started(&command, &e))?;
    let text = [output.stdout, output.stderr].map(|b| String::from_utf8_lossy(&b).trim().to_owned()).join("\n");
    if output.status.success() {
        return Ok(text);
    }
    Err(Fault::new(format!("`{}`: {}\n{}", command_line(&command), output.status, text.trim())))
}

/// A program with a timeout; if it runs out, the exit status is 124.
pub fn within_minutes(minutes: u64, program: &str) -> Command {
    let mut command = Command::new("timeout");
    command.args(["--kill-after=10s", &format!("{minutes}m"), program]).current_dir(root());
    command
}

/// Standard output of a program; `None` if it fails.
pub fn output(program: &str, args: &[&str]) -> Option<String> {
    let output = Command::new(program).args(args).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// Replaces this process by a program, so that signals reach only that program.
#[cfg(unix)]
pub fn exec(mut command: Command) -> Result<(), Fault> {
    use std::os::unix::process::CommandExt;
    let error = command.exec();
    Err(not_started(&command, &error))
}

/// Runs a program as the last action of this one.
#[cfg(not(unix))]
pub fn exec(command: Command) -> Result<(), Fault> {
    run(command)
}

/// Calls `work` with each item on `threads` threads; returns the results.
pub fn in_parallel<T: Send, R: Send>(threads: usize, items: impl Iterator<Item = T> + Send, work: impl Fn(T) -> R + Sync) -> Vec<R> {
    let items = Mutex::new(items);
    let next = || items.lock().ok().and_then(|mut items| items.next());
    let worker = || std::iter::from_fn(next).map(&work).collect::<Vec<R>>();
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads).map(|_| scope.spawn(worker)).collect();
        workers.into_iter().flat_map(|w| w.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    })
}

pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}
