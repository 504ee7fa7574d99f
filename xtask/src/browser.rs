//! The browser tests and the tools that they need.

use std::path::Path;
use std::process::Command;

use crate::command::{Fault, data, output, program, root, run, run_quietly};

const FOLDER: &str = "tests/browser";
const NODE: u32 = 20;

/// Path of Chromium: `CHROMIUM`, else the first one in the search path.
fn chromium() -> Option<String> {
    if let Ok(named) = std::env::var("CHROMIUM")
        && !named.is_empty()
    {
        return Some(named);
    }
    ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"].into_iter().find_map(which)
}

fn which(name: &str) -> Option<String> {
    let path = std::env::var_os("PATH")?;
    std::env::split_paths(&path).map(|p| p.join(name)).find(|p| p.is_file()).map(|p| p.to_string_lossy().into_owned())
}

fn node_is_recent() -> bool {
    let version = output("node", &["--version"]).unwrap_or_default();
    version.trim_start_matches('v').split('.').next().and_then(|v| v.parse::<u32>().ok()).is_some_and(|v| v >= NODE)
}

/// A Vulkan driver that draws without a graphics card, for WebGPU in the browser and for the `gpu` host.
fn has_software_vulkan() -> bool {
    ["/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d"]
        .iter()
        .filter_map(|folder| std::fs::read_dir(folder).ok())
        .flatten()
        .filter_map(Result::ok)
        .any(|entry| entry.file_name().to_string_lossy().starts_with("lvp_icd"))
}

/// Whether tests find a `nats-server`; Debian keeps it where only root looks.
pub fn nats_is_there() -> bool {
    output("nats-server", &["--version"]).is_some() || Path::new("/usr/sbin/nats-server").exists()
}

/// Makes sure that browser, driver and Node are there; installs them where it may.
pub fn tools() -> Result<(), Fault> {
    let mut missing = Vec::new();
    if chromium().is_none() {
        missing.push("chromium");
    }
    if cfg!(target_os = "linux") && !has_software_vulkan() {
        missing.push("mesa-vulkan-drivers");
    }
    if output("node", &["--version"]).is_none() {
        missing.push("nodejs");
    }
    if which("npm").is_none() && output("npm", &["--version"]).is_none() {
        missing.push("npm");
    }
    // the tests of rooms that several servers share
    if cfg!(target_os = "linux") && !nats_is_there() {
        missing.push("nats-server");
    }
    if !missing.is_empty() {
        install(&missing)?;
    }
    if !node_is_recent() {
        let version = output("node", &["--version"]).unwrap_or_default();
        return Err(Fault::new(format!("the browser tests need Node {NODE} or newer, not {version}")));
    }
    packages()
}

/// Packs the element for npm; the archive is in `target/npm`.
pub fn pack_element() -> Result<(), Fault> {
    let mut node = Command::new("node");
    node.arg("npm/pack.mjs").current_dir(root());
    run(node).map_err(|e| e.in_step("npm"))
}

/// Installs Debian packages as root; else names the command.
pub fn install(packages: &[&str]) -> Result<(), Fault> {
    let list = packages.join(" ");
    if output("apt-get", &["--version"]).is_none() {
        return Err(Fault::new(format!("missing: {list}. Install them with this system's package manager, then try again")));
    }
    if output("id", &["-u"]).as_deref() != Some("0") {
        let command = format!("sudo apt-get update && sudo apt-get install --yes --no-install-recommends {list}");
        return Err(Fault::new(format!("missing: {list}. Run this, then try again:\n  {command}")));
    }
    println!("installing {list}");
    let apt = |args: &[&str]| {
        let mut command = Command::new("apt-get");
        command.env("DEBIAN_FRONTEND", "noninteractive").args(["-qq", "--yes"]).args(args);
        run_quietly(command)
    };
    apt(&["update"])?;
    apt(&[["install", "--no-install-recommends"].as_slice(), packages].concat())
}

fn npm() -> Command {
    let mut command = if cfg!(windows) { Command::new("npm.cmd") } else { Command::new("npm") };
    command.current_dir(root().join(FOLDER));
    command
}

/// `npm ci`, where the lock file is newer than what is installed.
fn packages() -> Result<(), Fault> {
    let folder = root().join(FOLDER);
    let changed = |path: &Path| path.metadata().and_then(|m| m.modified()).ok();
    let lock = changed(&folder.join("package-lock.json"))
        .ok_or_else(|| Fault::new(format!("{FOLDER}/package-lock.json is missing: there are no browser tests")))?;
    if changed(&folder.join("node_modules/.package-lock.json")).is_some_and(|installed| installed >= lock) {
        return Ok(());
    }
    println!("installing the packages of {FOLDER}");
    let mut command = npm();
    command.args(["ci", "--silent", "--no-audit", "--no-fund"]).env("PLAYWRIGHT_SKIP_BROWSER_DOWNLOAD", "1");
    run_quietly(command)
}

/// Types, lint and format of the pages' scripts.
pub fn check() -> Result<(), Fault> {
    let mut command = npm();
    command.args(["run", "check", "--silent"]);
    run(command)
}

/// Runs the browser tests against the release build.
pub fn test() -> Result<(), Fault> {
    let mut command = npm();
    command.args(["test", "--silent"]).env("TMPI_BIN", program()).env("TMPI_DATA", data());
    if let Some(chromium) = chromium() {
        command.env("CHROMIUM", chromium);
    }
    run(command)
}
