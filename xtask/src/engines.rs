//! Engines that tests start and stop themselves: an S3 server (moto, out of Python packages); `nats-server` comes with the tools.

use std::fs;
use std::path::PathBuf;
use std::process::Command;

use crate::command::{Fault, output, root, run_quietly};

const FOLDER: &str = ".tmpi/s3-server";
/// Versions are pinned there.
const WANTED: &str = "xtask/s3-server.txt";
const IMPORT: &str = "import moto.server";

/// Installs the S3 server below the root where there is none; tests that need it are skipped where that cannot be done, as they say.
pub fn fetch() {
    if there() {
        return;
    }
    println!("fetching an S3 server for tests into {FOLDER}");
    if let Err(fault) = install() {
        println!("no S3 server for tests: pip install 'moto[server]'\n{fault}");
    }
}

/// Names it to the tests, and what they must not be skipped without; `required` is what they must not be anyway.
pub fn name_to(tests: &mut Command, required: &str) -> String {
    let folder = root().join(FOLDER);
    if folder.is_dir() {
        let others: Vec<PathBuf> = std::env::var_os("PYTHONPATH").map(|p| std::env::split_paths(&p).collect()).unwrap_or_default();
        if let Ok(path) = std::env::join_paths([vec![folder], others].concat()) {
            tests.env("PYTHONPATH", path);
        }
    }
    let nats = crate::browser::nats_is_there().then_some("nats");
    let s3 = there().then_some("s3");
    [Some(required), nats, s3].into_iter().flatten().collect::<Vec<_>>().join(",")
}

/// Whether Python finds it, installed by this task or by whoever owns the machine.
fn there() -> bool {
    let whole = root().join(FOLDER).join("WHOLE");
    let pinned = fs::read(root().join(WANTED)).unwrap_or_default();
    fs::read(whole).is_ok_and(|installed| installed == pinned) || output("python3", &["-c", IMPORT]).is_some()
}

fn install() -> Result<(), Fault> {
    let folder = root().join(FOLDER);
    let _ = fs::remove_dir_all(&folder);
    let mut pip = Command::new("python3");
    pip.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps", "--only-binary=:all:", "--target"]);
    pip.arg(&folder).arg("--requirement").arg(root().join(WANTED));
    run_quietly(pip)?;
    // written last: a folder without it is half of one
    let whole = folder.join("WHOLE");
    fs::copy(root().join(WANTED), &whole).map(drop).map_err(|e| Fault::new(format!("{}: {e}", whole.display())))
}
