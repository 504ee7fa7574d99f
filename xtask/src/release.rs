//! Builds an archive with the program, ONNX Runtime, a depth network and licences, and tests it in an empty environment.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::command::{Fault, Profile, built, cargo, output, root, run, run_quietly};
use crate::{OFFLINE, runtime};

/// Files of the workspace to include, and their paths in the archive.
const FILES: [(&str, &str); 5] = [
    ("README.md", "README.md"),
    ("LICENSE-MIT", "LICENSE-MIT"),
    ("LICENSE-APACHE", "LICENSE-APACHE"),
    ("models/depth.md", "licences/embedded depth network.md"),
    ("docs/sample.jpg", "sample.jpg"),
];
/// Prefixes of the names of licence and notice files.
const LICENCES: [&str; 5] = ["license", "licence", "copying", "notice", "copyright"];

/// Builds, packs and tests the archive in `target/archive`.
pub fn release(args: &[String]) -> Result<(), Fault> {
    let step = |step: &'static str| move |fault: Fault| fault.in_step(step);
    runtime::fetch().map_err(step("ONNX Runtime"))?;
    run(cargo(&["build", "--release", "--package", "tmpi", "--locked"])).map_err(step("build"))?;
    let version = output(&built(Profile::Release, "tmpi").to_string_lossy(), &["--version"]).unwrap_or_default();
    let version = version.split_whitespace().nth(1).ok_or_else(|| Fault::new("`tmpi --version` prints no version"))?;
    let name = format!("tmpi-{version}-{}-{}", std::env::consts::OS, std::env::consts::ARCH);
    let folder = root().join("target/archive");
    let stage = folder.join(&name);
    if stage.exists() {
        fs::remove_dir_all(&stage).map_err(|e| Fault::at(&stage, &e))?;
    }
    fill(&stage, args.iter().any(|a| a == OFFLINE)).map_err(step("files"))?;
    let archive = format!("{name}.tar.gz");
    let mut tar = Command::new("tar");
    tar.arg("-czf").arg(&archive).arg(&name).current_dir(&folder);
    run_quietly(tar).map_err(step("archive"))?;
    let trial_folder = folder.join(format!("try-{}", std::process::id()));
    fs::create_dir_all(&trial_folder).map_err(|e| Fault::at(&trial_folder, &e))?;
    let done = try_out(&folder.join(&archive), &trial_folder, &name).map_err(step("trial"));
    let _ = fs::remove_dir_all(&trial_folder);
    done?;
    let bytes = fs::metadata(folder.join(&archive)).map_or(0, |m| m.len());
    println!("{}: {} MB", folder.join(&archive).display(), bytes.div_ceil(1_000_000));
    Ok(())
}

/// Copies a file and creates the target's folder if needed.
fn copy(from: &Path, to: &Path) -> Result<(), Fault> {
    let folder = to.parent().unwrap_or(to);
    fs::create_dir_all(folder).map_err(|e| Fault::at(folder, &e))?;
    fs::copy(from, to).map(|_| ()).map_err(|e| Fault::at(from, &e))
}

/// Fills the folder `stage` with the archive's contents.
fn fill(stage: &Path, offline: bool) -> Result<(), Fault> {
    copy(&built(Profile::Release, "tmpi"), &stage.join(built(Profile::Release, "tmpi").file_name().unwrap_or_default()))?;
    for (from, to) in FILES {
        copy(&root().join(from), &stage.join(to))?;
    }
    let library = runtime::library().ok_or_else(|| Fault::new("no ONNX Runtime was fetched for this platform"))?;
    // the program looks for the library beside itself
    copy(&library, &stage.join(library.file_name().unwrap_or_default()))?;
    for name in ["LICENSE", "ThirdPartyNotices.txt"] {
        copy(&library.with_file_name(name), &stage.join("licences/onnxruntime").join(name))?;
    }
    if let Some(network) = if offline { None } else { network(&root().join("target/archive/models")) } {
        copy(&network, &stage.join("models").join(network.file_name().unwrap_or_default()))?;
        let list = output(&built(Profile::Release, "tmpi").to_string_lossy(), &["models", "list"]).unwrap_or_default();
        fs::write(stage.join("models/README.txt"), list).map_err(|e| Fault::at(stage, &e))?;
    }
    let list = stage.join("licences/crates.txt");
    fs::write(&list, crates()?).map_err(|e| Fault::at(&list, &e))
}

/// Fetches the recommended depth network. If that fails, the program prints why, and this returns `None`.
fn network(folder: &Path) -> Option<PathBuf> {
    let mut get = Command::new(built(Profile::Release, "tmpi"));
    get.args(["models", "get", "auto"]).env("TMPI_MODELS", folder);
    let output = get.stderr(std::process::Stdio::inherit()).output().ok()?;
    let path = PathBuf::from(String::from_utf8_lossy(&output.stdout).trim());
    path.is_file().then_some(path)
}

/// List of the program's dependencies with their licences; each licence text appears once.
fn crates() -> Result<String, Fault> {
    let words = ["tree", "--locked", "-p", "tmpi", "-e", "normal", "--prefix", "none", "--no-dedupe", "-f", "{p}|{l}|{r}"];
    let listed = cargo(&words).output().map_err(|e| Fault::new(format!("cargo tree: {e}")))?;
    if !listed.status.success() {
        return Err(Fault::new(String::from_utf8_lossy(&listed.stderr).trim()));
    }
    let mut all = String::from("tmpi contains these crates. Their licences and notices follow.\n\n");
    let mut texts: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let mut lines: Vec<String> = String::from_utf8_lossy(&listed.stdout).lines().map(str::to_owned).collect();
    lines.sort();
    lines.dedup();
    for line in &lines {
        let mut parts = line.split('|');
        let package = parts.next().unwrap_or_default();
        let mut words = package.split_whitespace();
        let (name, version) = (words.next().unwrap_or_default(), words.next().unwrap_or_default().trim_start_matches('v'));
        // cargo prints a path for the workspace's own crates
        if name.is_empty() || package.contains(&*root().to_string_lossy()) {
            continue;
        }
        let (licence, repository) = (parts.next().unwrap_or_default(), parts.next().unwrap_or_default());
        all.extend([name, " ", version, ": ", licence, " ", repository, "\n"]);
        for text in licence_texts(&format!("{name}-{version}")) {
            texts.entry(text).or_default().push(format!("{name} {version}"));
        }
    }
    for (text, of) in texts {
        all.extend(["\n", &"-".repeat(100), "\n", &of.join(", "), "\n\n", text.trim(), "\n"]);
    }
    Ok(all)
}

/// Licence texts in the sources of a crate in cargo's registry.
fn licence_texts(package: &str) -> Vec<String> {
    let home = std::env::var_os("CARGO_HOME").map(PathBuf::from);
    let home = home.or_else(|| Some(PathBuf::from(std::env::var_os("HOME").or_else(|| std::env::var_os("USERPROFILE"))?).join(".cargo")));
    let files = |folder: PathBuf| fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path());
    let sources = home.into_iter().flat_map(|home| files(home.join("registry/src")));
    let is_licence = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        path.is_file() && LICENCES.iter().any(|start| name.starts_with(start))
    };
    let mut found: Vec<PathBuf> = sources.flat_map(|index| files(index.join(package))).filter(is_licence).collect();
    found.sort();
    found.iter().filter_map(|path| fs::read_to_string(path).ok()).collect()
}

/// Unpacks the archive, then processes, renders and exports the sample photo with it, without any variable of this environment.
fn try_out(archive: &Path, place: &Path, name: &str) -> Result<(), Fault> {
    let mut tar = Command::new("tar");
    tar.arg("-xzf").arg(archive).arg("-C").arg(place);
    run_quietly(tar)?;
    let folder = place.join(name);
    let tmpi = |args: &[&str]| {
        let mut command = Command::new(folder.join(built(Profile::Release, "tmpi").file_name().unwrap_or_default()));
        command.env_clear().env("HOME", place).current_dir(place).args(args);
        run_quietly(command).map(drop)
    };
    let sample = folder.join("sample.jpg");
    tmpi(&["make", &sample.to_string_lossy(), "-o", "sample.tmpi", "--max-size", "256", "-q"])?;
    tmpi(&["render", "sample.tmpi", "-o", "view.png", "--pose", "0.02,0,0"])?;
    tmpi(&["export", "sample.tmpi", "-o", "sample.html"])?;
    println!("tested: {name} processes, renders and exports a photo on its own");
    Ok(())
}
