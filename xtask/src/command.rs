//! Running other programs.

use std::cell::RefCell;
use std::fmt;
use std::path::{Path, PathBuf};
use std::process::Command;

/// What went wrong, and in which step.
pub struct Fault {
    step: Option<&'static str>,
    text: String,
}

impl Fault {
    pub fn new(text: impl Into<String>) -> Self {
        Self { step: None, text: text.into() }
    }

    /// Names the step, where none has been named.
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

/// Root of the workspace.
pub fn root() -> PathBuf {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    here.parent().unwrap_or(here).to_owned()
}

/// A profile of `Cargo.toml`: a way to build the program.
#[derive(Clone, Copy)]
pub enum Profile {
    /// What people run.
    Release,
    /// What lints and tests look at.
    Checks,
}

impl Profile {
    /// Its name in cargo, and of its build folder.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Release => "release",
            Self::Checks => "checks",
        }
    }
}

/// The folder that cargo builds into.
pub fn target() -> PathBuf {
    std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root().join("target"), |t| root().join(t))
}

/// A program of the workspace as built with that profile.
pub fn built(profile: Profile, name: &str) -> PathBuf {
    target().join(profile.name()).join(format!("{name}{}", std::env::consts::EXE_SUFFIX))
}

/// Data for measuring, for programs that run in any folder.
pub fn data() -> PathBuf {
    let named = std::env::var_os("TMPI_DATA").filter(|v| !v.is_empty());
    root().join(named.unwrap_or_else(|| "../shared/data".into()))
}

/// The cargo that runs this task.
pub fn cargo(args: &[&str]) -> Command {
    let mut command = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.args(args).current_dir(root());
    command.env("TMPI_DATA", data());
    crate::runtime::name_to(&mut command);
    command
}

/// The command as typed in a shell.
pub fn shown(command: &Command) -> String {
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    words.map(|w| w.to_string_lossy().into_owned()).collect::<Vec<_>>().join(" ")
}

thread_local! {
    /// What steps of this thread have printed; none where they print at once.
    static HELD_BACK: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// Runs something on this thread and gives what it and its programs print.
pub fn quietly<T>(run: impl FnOnce() -> T) -> (T, String) {
    HELD_BACK.set(Some(String::new()));
    let result = run();
    (result, HELD_BACK.take().unwrap_or_default())
}

/// Prints a text and a line's end, or holds both back.
pub fn say(text: &str) {
    HELD_BACK.with_borrow_mut(|held| match held {
        Some(held) => {
            held.push_str(text);
            held.push('\n');
        }
        None => println!("{text}"),
    });
}

/// Runs a program and shows its output.
pub fn run(mut command: Command) -> Result<(), Fault> {
    let failed = |e: std::io::Error, command: &Command| Fault::new(format!("`{}` does not start: {e}", shown(command)));
    let status = if HELD_BACK.with_borrow(Option::is_some) {
        let output = command.output().map_err(|e| failed(e, &command))?;
        say(&[output.stdout, output.stderr].map(|b| String::from_utf8_lossy(&b).into_owned()).concat());
        output.status
    } else {
        command.status().map_err(|e| failed(e, &command))?
    };
    if status.success() { Ok(()) } else { Err(Fault::new(format!("`{}`: {status}", shown(&command)))) }
}

/// Runs a program and gives what it prints, on both streams.
pub fn run_quietly(mut command: Command) -> Result<String, Fault> {
    let output = command.output().map_err(|e| Fault::new(format!("`{}` does not start: {e}", shown(&command))))?;
    let text = [output.stdout, output.stderr].map(|b| String::from_utf8_lossy(&b).trim().to_owned()).join("\n");
    if output.status.success() {
        return Ok(text);
    }
    Err(Fault::new(format!("`{}`: {}\n{}", shown(&command), output.status, text.trim())))
}

/// A program with a timeout, after which its status is 124.
pub fn within_minutes(minutes: u64, program: &str) -> Command {
    let mut command = Command::new("timeout");
    command.args(["--kill-after=10s", &format!("{minutes}m"), program]).current_dir(root());
    command
}

/// Standard output of a program that succeeds.
pub fn output(program: &str, args: &[&str]) -> Option<String> {
    let output = Command::new(program).args(args).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// Runs a program in place of this one, so that signals reach it alone.
#[cfg(unix)]
pub fn become_it(mut command: Command) -> Result<(), Fault> {
    use std::os::unix::process::CommandExt;
    let error = command.exec();
    Err(Fault::new(format!("`{}` does not start: {error}", shown(&command))))
}

/// Runs a program in place of this one.
#[cfg(not(unix))]
pub fn become_it(command: Command) -> Result<(), Fault> {
    run(command)
}

/// Processors of this machine.
pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}
