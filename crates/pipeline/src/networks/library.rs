//! Where the ONNX Runtime library is looked for.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, OnceLock, PoisonError};

use ort::environment::Environment;
use ort::logging::LogLevel;

use super::OnnxError;

/// Environment variable that names the library file; where it is set, nothing else is tried.
const VARIABLE: &str = "ORT_DYLIB_PATH";
/// Folder that `cargo xtask serve` fetches the library into.
const LOCAL: &str = ".tmpi/onnxruntime";

#[cfg(target_os = "windows")]
const FILE: &str = "onnxruntime.dll";
#[cfg(target_os = "macos")]
const FILE: &str = "libonnxruntime.dylib";
#[cfg(not(any(target_os = "windows", target_os = "macos")))]
const FILE: &str = "libonnxruntime.so";

/// Has libraries send nothing to anyone: those from 1.29 to the newest known send their maker what they are used for, from their
/// loading on, unless this is set before. The one that `cargo xtask serve` fetches is older, but a user may name another.
///
/// # Safety
/// As [`std::env::set_var`]: no other thread may be running.
#[allow(unsafe_code, clippy::disallowed_methods, reason = "the library reads it from the environment alone; called before any thread")]
pub unsafe fn keep_to_yourself() {
    // SAFETY: by the condition above
    unsafe { std::env::set_var("ORT_DISABLE_TELEMETRY", "1") };
}

/// Checks that ONNX Runtime can be loaded; the first call loads it for the whole process.
///
/// # Errors
/// [`OnnxError::Library`] tells where it was looked for and what to do.
pub fn available() -> Result<(), OnnxError> {
    environment().map(|_| ())
}

/// The process's ONNX Runtime environment. Loaded once; a library that is not there is looked for again each time.
pub(super) fn environment() -> Result<&'static Environment, OnnxError> {
    static ENVIRONMENT: Once<Environment> = Once::new();
    ENVIRONMENT.get(load)
}

/// What is made once, by whoever needs it first; an error is not kept.
pub(super) struct Once<T> {
    made: OnceLock<T>,
    making: Mutex<()>,
}

impl<T> Once<T> {
    pub(super) const fn new() -> Self {
        Self { made: OnceLock::new(), making: Mutex::new(()) }
    }

    /// It, made by `make` where it is not there yet.
    pub(super) fn get<E>(&self, make: impl FnOnce() -> Result<T, E>) -> Result<&T, E> {
        if let Some(made) = self.made.get() {
            return Ok(made);
        }
        let _alone = self.making.lock().unwrap_or_else(PoisonError::into_inner);
        match self.made.get() {
            Some(made) => Ok(made),
            None => make().map(|new| self.made.get_or_init(|| new)),
        }
    }
}

fn load() -> Result<Environment, OnnxError> {
    let named = std::env::var_os(VARIABLE).filter(|v| !v.is_empty()).map(PathBuf::from);
    let exe = std::env::current_exe().ok();
    let places = places(named.as_deref(), exe.as_deref());
    let mut tried = Vec::new();
    for place in &places {
        // A path that is not there needs no loader to say so; a bare name is the system's to resolve
        if place.is_absolute() && !place.exists() {
            tried.push(format!("{} (not there)", place.display()));
            continue;
        }
        match ort::init_from(place) {
            Ok(builder) => {
                let built = builder.with_name("tmpi").with_telemetry(false).build();
                // Every error comes back as a result; the library need not print it as well
                return built
                    .inspect(|environment| environment.set_log_level(LogLevel::Fatal))
                    .map_err(|e| OnnxError::Library(format!("{}: {e}", place.display())));
            }
            Err(e) => tried.push(format!("{} ({e})", place.display())),
        }
    }
    let advice = if named.is_some() {
        format!("{VARIABLE} must name a library file of version 1.22 or newer; unset it to search the usual places")
    } else {
        format!("`cargo xtask serve` fetches it into {LOCAL}; or set {VARIABLE} to a library file of version 1.22 or newer")
    };
    Err(OnnxError::Library(format!("looked for {}. {advice}", tried.join(", "))))
}

/// Places to try in order: the named file alone, or the workspace's local folder where the executable was built in one, beside the
/// executable, the system's own search. Never the current directory: whoever can write there could have their code loaded.
fn places(named: Option<&Path>, exe: Option<&Path>) -> Vec<PathBuf> {
    if let Some(named) = named {
        // Absolute, or the loader would search its own path for a name without a slash
        return vec![std::path::absolute(named).unwrap_or_else(|_| named.to_owned())];
    }
    let mut places: Vec<PathBuf> = Vec::new();
    let mut push = |p: PathBuf| {
        if !places.contains(&p) {
            places.push(p);
        }
    };
    if let Some(folder) = exe.and_then(Path::parent) {
        // Up from target/release/deps to the workspace
        let built = folder.ancestors().take(3).find(|f| f.file_name().is_some_and(|name| name == "target"));
        if let Some(workspace) = built.and_then(Path::parent) {
            push(workspace.join(LOCAL).join(FILE));
        }
        push(folder.join(LOCAL).join(FILE));
        push(folder.join(FILE));
        if let Some(up) = folder.parent() {
            push(up.join("lib").join(FILE));
        }
    }
    push(PathBuf::from(FILE));
    places
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_is_not_kept_and_what_was_made_is() {
        let once = Once::new();
        assert_eq!(once.get(|| Err("not there")), Err("not there"));
        assert_eq!(once.get(|| Ok::<_, &str>(1)), Ok(&1));
        assert_eq!(once.get(|| Err("not asked")), Ok(&1));
    }

    #[test]
    fn a_named_file_is_the_only_place() {
        let cwd = std::env::current_dir().unwrap();
        assert_eq!(places(Some(Path::new("lib/x.so")), None), [cwd.join("lib/x.so")]);
        let absolute = cwd.join("y.so");
        assert_eq!(places(Some(&absolute), None), [absolute]);
    }

    #[test]
    fn the_workspaces_folder_comes_first_and_the_system_last() {
        let root = Path::new("/work space");
        for exe in ["target/release/tmpi", "target/release/deps/tmpi-0123"] {
            let got = places(None, Some(&root.join(exe)));
            assert_eq!(got.first(), Some(&root.join(LOCAL).join(FILE)), "{exe}");
            assert!(got.contains(&root.join(exe).with_file_name(FILE)));
            assert_eq!(got.last(), Some(&PathBuf::from(FILE)));
        }
    }

    #[test]
    fn nothing_is_loaded_from_where_the_program_happens_to_be_called() {
        let here = std::env::current_dir().unwrap();
        for exe in [None, Some(Path::new("/opt/tmpi/bin/tmpi"))] {
            for place in places(None, exe) {
                assert!(!place.starts_with(&here) && (place.is_absolute() || place == Path::new(FILE)), "{}", place.display());
            }
        }
        // nor from folders above an installed program, some of which are anybody's to write
        assert!(!places(None, Some(Path::new("/tmp/a/tmpi"))).contains(&Path::new("/tmp").join(LOCAL).join(FILE)));
    }
}
