//! Finds and loads the ONNX Runtime library.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, OnceLock, PoisonError};

use ort::environment::Environment;
use ort::logging::LogLevel;

use super::OnnxError;

/// Environment variable that names the library file. If it is set, nothing else is tried.
const VARIABLE: &str = "ORT_DYLIB_PATH";
/// Folder into which `cargo xtask serve` fetches the library.
const LOCAL: &str = ".tmpi/onnxruntime";

#[cfg(target_os = "windows")]
const FILE: &str = "onnxruntime.dll";
#[cfg(target_os = "macos")]
const FILE: &str = "libonnxruntime.dylib";
#[cfg(not(any(target_os = "windows", target_os = "macos")))]
const FILE: &str = "libonnxruntime.so";

/// Turns the library's telemetry off. Versions from 1.29 to the newest known report their use to their maker as soon as they are loaded,
/// unless this is set before. The version that `cargo xtask serve` fetches is older, but a user may name another.
///
/// # Safety
/// As for [`std::env::set_var`], no other thread may be running.
#[allow(unsafe_code, clippy::disallowed_methods, reason = "the library reads it from the environment only; called before any thread")]
pub unsafe fn disable_telemetry() {
    // SAFETY: by the condition above
    unsafe { std::env::set_var("ORT_DISABLE_TELEMETRY", "1") };
}

/// Checks that ONNX Runtime can be loaded. The first call loads it for the whole process.
///
/// # Errors
/// [`OnnxError::Library`] lists what was tried and what to do.
pub fn available() -> Result<(), OnnxError> {
    environment().map(|_| ())
}

/// The process's ONNX Runtime environment, loaded once. A missing library is searched again on each call.
pub(super) fn environment() -> Result<&'static Environment, OnnxError> {
    static ENVIRONMENT: Once<Environment> = Once::new();
    ENVIRONMENT.get(load)
}

/// A value that its first user makes, once. Errors are not kept.
pub(super) struct Once<T> {
    made: OnceLock<T>,
    making: Mutex<()>,
}

impl<T> Once<T> {
    pub(super) const fn new() -> Self {
        Self { made: OnceLock::new(), making: Mutex::new(()) }
    }

    /// Returns the value, after calling `make` if it does not exist yet.
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
        // a missing path needs no loader to say so; a bare name is for the system to resolve
        if place.is_absolute() && !place.exists() {
            tried.push(format!("{} (missing)", place.display()));
            continue;
        }
        match ort::init_from(place) {
            Ok(builder) => {
                let built = builder.with_name("tmpi").with_telemetry(false).build();
                // every error is returned as a result, so the library need not print it
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

/// Paths to try in order: only the named file if there is one; else the workspace's local folder if the executable was built in one, the
/// folders of the executable, and the system's own search. Never the current directory: anyone who can write there could have their code
/// loaded.
fn places(named: Option<&Path>, exe: Option<&Path>) -> Vec<PathBuf> {
    if let Some(named) = named {
        // absolute, or the loader would search its own path for a name without a slash
        return vec![std::path::absolute(named).unwrap_or_else(|_| named.to_owned())];
    }
    let mut places: Vec<PathBuf> = Vec::new();
    let mut push = |p: PathBuf| {
        if !places.contains(&p) {
            places.push(p);
        }
    };
    if let Some(folder) = exe.and_then(Path::parent) {
        // up from target/release/deps to the workspace
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
    fn a_value_is_kept_and_an_error_is_not() {
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
    fn nothing_is_loaded_from_the_current_directory() {
        let here = std::env::current_dir().unwrap();
        for exe in [None, Some(Path::new("/opt/tmpi/bin/tmpi"))] {
            for place in places(None, exe) {
                assert!(!place.starts_with(&here) && (place.is_absolute() || place == Path::new(FILE)), "{}", place.display());
            }
        }
        // nor from folders above an installed program, some of which anyone can write to
        assert!(!places(None, Some(Path::new("/tmp/a/tmpi"))).contains(&Path::new("/tmp").join(LOCAL).join(FILE)));
    }
}
