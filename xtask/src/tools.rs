//! Tools that the tests need: Debian packages, Node packages, and an S3 server from Python packages.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::command::{Fault, output, root, run_quietly, say};

/// Oldest Node version that runs the browser tests.
const NODE: u32 = 20;
/// Folder of the browser tests.
pub const BROWSER_TESTS: &str = "tests/browser";
/// Folder into which the S3 server is installed.
const S3_FOLDER: &str = ".tmpi/s3-server";
/// The S3 server's pinned packages.
const S3_PACKAGES: &str = "xtask/s3-server.txt";
/// Value of `TMPI_REQUIRE` (`crates/testing`): everything that this module installs, and ONNX Runtime.
const INSTALLED: &str = "gpu,onnx,ffmpeg,s3,postgres";

/// Set by `--skip-missing`: install nothing and skip tests with missing tools.
static SKIP_MISSING: AtomicBool = AtomicBool::new(false);

/// A Debian package, and whether its contents are already installed.
struct DebianPackage {
    name: &'static str,
    is_installed: fn() -> bool,
}

const DEBIAN: [DebianPackage; 6] = [
    DebianPackage { name: "chromium", is_installed: || chromium().is_some() },
    // software Vulkan, for WebGPU in the browser and for the `gpu` backend
    DebianPackage { name: "mesa-vulkan-drivers", is_installed: || cfg!(not(target_os = "linux")) || has_software_vulkan() },
    DebianPackage { name: "nodejs", is_installed: || output("node", &["--version"]).is_some() },
    DebianPackage { name: "npm", is_installed: || which("npm").is_some() || output("npm", &["--version"]).is_some() },
    DebianPackage { name: "postgresql", is_installed: has_postgres },
    DebianPackage { name: "ffmpeg", is_installed: || output("ffmpeg", &["-version"]).is_some() },
];

/// From now on, installs nothing: tests with missing tools are skipped, and the list at the end names them.
pub fn skip_missing() {
    SKIP_MISSING.store(true, Ordering::Relaxed);
}

/// Whether missing tools may be installed.
pub fn may_install() -> bool {
    !SKIP_MISSING.load(Ordering::Relaxed)
}

/// Installs missing tools, as far as this user has the rights.
pub fn fetch() -> Result<(), Fault> {
    if !may_install() {
        return node_packages(BROWSER_TESTS);
    }
    let missing: Vec<&str> = DEBIAN.iter().filter(|p| !(p.is_installed)()).map(|p| p.name).collect();
    if !missing.is_empty() {
        install(&missing)?;
    }
    let version = output("node", &["--version"]).unwrap_or_default();
    if version.trim_start_matches('v').split('.').next().and_then(|v| v.parse::<u32>().ok()).is_none_or(|v| v < NODE) {
        return Err(Fault::new(format!("the browser tests need Node {NODE} or newer, not {version}")));
    }
    node_packages(BROWSER_TESTS)?;
    s3_server()
}

/// Sets the environment of a test program: paths of installed tools, the needs that must be met, and the file of skipped tests.
pub fn set_env(tests: &mut Command) {
    if root().join(S3_FOLDER).is_dir() {
        let others: Vec<PathBuf> = std::env::var_os("PYTHONPATH").map(|p| std::env::split_paths(&p).collect()).unwrap_or_default();
        if let Ok(path) = std::env::join_paths([vec![root().join(S3_FOLDER)], others].concat()) {
            tests.env("PYTHONPATH", path);
        }
    }
    if let Some(chromium) = chromium() {
        tests.env("CHROMIUM", chromium);
    }
    tests.env("TMPI_REQUIRE", if may_install() { INSTALLED } else { "" });
    tests.env(crate::skipped::VARIABLE, crate::skipped::file());
}

/// Installs Debian packages if this user is root; otherwise fails with the command to run.
pub fn install(packages: &[&str]) -> Result<(), Fault> {
    let list = packages.join(" ");
    if output("apt-get", &["--version"]).is_none() {
        return Err(Fault::new(format!("missing: {list}. Install them with this system's package manager, then try again")));
    }
    if output("id", &["-u"]).as_deref() != Some("0") {
        let command = format!("sudo apt-get update && sudo apt-get install --yes --no-install-recommends {list}");
        return Err(Fault::new(format!("missing: {list}. Run this, then try again:\n  {command}")));
    }
    say(&format!("installing {list}"));
    let apt = |args: &[&str]| {
        let mut command = Command::new("apt-get");
        command.env("DEBIAN_FRONTEND", "noninteractive").args(["-qq", "--yes"]).args(args);
        run_quietly(command).map(drop)
    };
    apt(&["update"])?;
    apt(&[["install", "--no-install-recommends"].as_slice(), packages].concat())
}

/// An npm command that runs in a folder of the workspace.
pub fn npm(folder: &str) -> Command {
    let mut command = if cfg!(windows) { Command::new("npm.cmd") } else { Command::new("npm") };
    command.current_dir(root().join(folder));
    command
}

/// Path of Chromium: `CHROMIUM`, otherwise the first one in `PATH`.
fn chromium() -> Option<String> {
    let named = std::env::var("CHROMIUM").ok().filter(|n| !n.is_empty());
    named.or_else(|| ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"].into_iter().find_map(which))
}

fn which(name: &str) -> Option<String> {
    let path = std::env::var_os("PATH")?;
    std::env::split_paths(&path).map(|p| p.join(name)).find(|p| p.is_file()).map(|p| p.to_string_lossy().into_owned())
}

/// Debian does not add the programs of each version to `PATH`. Tests use a folder that has all three.
fn has_postgres() -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let versions = fs::read_dir("/usr/lib/postgresql").into_iter().flatten().flatten().map(|v| v.path().join("bin"));
    let mut folders = std::env::split_paths(&path).chain(versions);
    folders.any(|folder| ["initdb", "postgres", "createdb"].iter().all(|program| folder.join(program).is_file()))
}

fn has_software_vulkan() -> bool {
    ["/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d"]
        .iter()
        .filter_map(|folder| fs::read_dir(folder).ok())
        .flatten()
        .filter_map(Result::ok)
        .any(|entry| entry.file_name().to_string_lossy().starts_with("lvp_icd"))
}

/// Runs `npm ci` in a folder if the lock file is newer than the installed packages.
pub fn node_packages(folder_name: &str) -> Result<(), Fault> {
    let folder = root().join(folder_name);
    let changed = |path: &Path| path.metadata().and_then(|m| m.modified()).ok();
    let lock =
        changed(&folder.join("package-lock.json")).ok_or_else(|| Fault::new(format!("{folder_name}/package-lock.json is missing")))?;
    if changed(&folder.join("node_modules/.package-lock.json")).is_some_and(|installed| installed >= lock) {
        return Ok(());
    }
    say(&format!("installing the packages of {folder_name}"));
    let mut command = npm(folder_name);
    command.args(["ci", "--silent", "--no-audit", "--no-fund"]).env("PLAYWRIGHT_SKIP_BROWSER_DOWNLOAD", "1");
    run_quietly(command).map(drop)
}

/// Installs moto, an S3 server, into [`S3_FOLDER`] if it is missing.
fn s3_server() -> Result<(), Fault> {
    let folder = root().join(S3_FOLDER);
    let whole = folder.join("WHOLE");
    let pinned = fs::read(root().join(S3_PACKAGES)).unwrap_or_default();
    if fs::read(&whole).is_ok_and(|installed| installed == pinned) || output("python3", &["-c", "import moto.server"]).is_some() {
        return Ok(());
    }
    say(&format!("installing an S3 server into {S3_FOLDER}"));
    let _ = fs::remove_dir_all(&folder);
    let mut pip = Command::new("python3");
    pip.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps", "--only-binary=:all:", "--target"]);
    pip.arg(&folder).arg("--requirement").arg(root().join(S3_PACKAGES));
    run_quietly(pip)?;
    // written last: marks the folder as complete
    fs::copy(root().join(S3_PACKAGES), &whole).map(drop).map_err(|e| Fault::at(&whole, &e))
}
