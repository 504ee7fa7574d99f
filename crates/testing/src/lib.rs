//! What the tests of several crates share: pictures, servers, and requirements. A test whose requirement is missing is skipped and listed in a
//! file, or fails if `TMPI_REQUIRE` names the requirement.
#![allow(clippy::expect_used, clippy::missing_panics_doc, clippy::unwrap_used, reason = "a panic fails the test")]

#[cfg(unix)]
mod database;
pub mod jpeg;
mod object_stores;
pub mod pictures;
pub mod png;
pub mod program;
mod stand_in;

use std::ffi::OsStr;
use std::fmt::Display;
use std::fs::OpenOptions;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

#[cfg(unix)]
pub use database::database;
pub use object_stores::Engine;
pub use stand_in::{Answer, Request, StandIn};

/// Environment variable: what must be there, by the names of [`Need`], separated by commas.
pub const VARIABLE: &str = "TMPI_REQUIRE";

/// Environment variable: the file that gets a line for each skipped test, `NEED<TAB>TEST<TAB>REASON`. The test runner hides what a test
/// that passes prints, so a line on standard error is not enough.
pub const SKIPPED: &str = "TMPI_SKIPPED";

/// Environment variable: the folder of photos and measured scenes that some tests read.
pub const DATA: &str = "TMPI_DATA";

/// A requirement of a test.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Need {
    /// `gpu`: a graphics adapter, one in software included.
    Gpu,
    /// `onnx`: the ONNX Runtime library.
    Onnx,
    /// `ffmpeg`: the program.
    Ffmpeg,
    /// `s3`: moto, an S3 server in Python.
    S3,
    /// `postgres`: the programs `initdb`, `postgres` and `createdb`.
    Postgres,
    /// `data`: the folder that `TMPI_DATA` names.
    Data,
}

impl Need {
    const ALL: [Self; 6] = [Self::Gpu, Self::Onnx, Self::Ffmpeg, Self::S3, Self::Postgres, Self::Data];

    const fn name(self) -> &'static str {
        match self {
            Self::Gpu => "gpu",
            Self::Onnx => "onnx",
            Self::Ffmpeg => "ffmpeg",
            Self::S3 => "s3",
            Self::Postgres => "postgres",
            Self::Data => "data",
        }
    }

    /// Returns `found`. If it is an error, lists the test in the file `TMPI_SKIPPED` and returns `None`; the test must then return.
    ///
    /// # Panics
    /// The need is missing and `TMPI_REQUIRE` names it, `TMPI_REQUIRE` holds an unknown word, or the list cannot be written.
    pub fn or_skip<T, E: Display>(self, found: Result<T, E>) -> Option<T> {
        let required = std::env::var(VARIABLE).unwrap_or_default();
        let missing = match self.judged(&required, found) {
            Ok(Ok(found)) => return Some(found),
            Ok(Err(reason)) => reason,
            Err(failure) => panic!("{failure}"),
        };
        eprintln!("skipped, no {}: {missing}", self.name());
        if let Some(list) = std::env::var_os(SKIPPED).filter(|l| !l.is_empty()) {
            let listed = append(Path::new(&list), &self.line(&test(), &missing));
            listed.unwrap_or_else(|e| panic!("{SKIPPED} names {}: {e}", Path::new(&list).display()));
        }
        None
    }

    /// What was found, or why the test is skipped, by the value of `TMPI_REQUIRE`; the outer error is what the test fails with.
    fn judged<T, E: Display>(self, required: &str, found: Result<T, E>) -> Result<Result<T, String>, String> {
        let words = || required.split(',').map(str::trim).filter(|w| !w.is_empty());
        if let Some(word) = words().find(|w| Self::ALL.iter().all(|n| n.name() != *w)) {
            return Err(format!("{VARIABLE} knows no {word:?}; it knows {}", Self::ALL.map(Self::name).join(", ")));
        }
        match found {
            Err(reason) if words().any(|w| w == self.name()) => Err(format!("{VARIABLE} names {}: {reason}", self.name())),
            found => Ok(found.map_err(|reason| reason.to_string())),
        }
    }

    /// A line of the list of skipped tests.
    fn line(self, test: &str, reason: &str) -> String {
        let reason: Vec<&str> = reason.split_whitespace().collect();
        format!("{}\t{test}\t{}\n", self.name(), reason.join(" "))
    }
}

/// Appends in one write, so that lines of several processes do not mix.
fn append(list: &Path, line: &str) -> io::Result<()> {
    OpenOptions::new().create(true).append(true).open(list)?.write_all(line.as_bytes())
}

/// Name of the running test: the test runner gives it to the test's thread; where a test runs on the main thread, the program's name.
fn test() -> String {
    let named = std::thread::current().name().filter(|name| *name != "main").map(str::to_owned);
    let program = || std::env::current_exe().ok().and_then(|p| Some(p.file_stem()?.to_string_lossy().into_owned()));
    named.or_else(program).unwrap_or_else(|| "unknown".into())
}

/// A folder in `TMPI_DATA`; `None` if it is missing, so that the test is skipped.
pub fn data(folder: &str) -> Option<PathBuf> {
    let root = std::env::var_os(DATA).filter(|root| !root.is_empty());
    let found = root.ok_or_else(|| format!("{DATA} names no folder")).and_then(|root| {
        let folder = Path::new(&root).join(folder);
        if folder.is_dir() { Ok(folder) } else { Err(format!("there is no folder {}", folder.display())) }
    });
    Need::Data.or_skip(found)
}

/// All files in a folder and in the folders below it.
pub fn files_below(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    let below = |path: PathBuf| if path.is_dir() { files_below(&path) } else { vec![path] };
    entries.flatten().flat_map(|entry| below(entry.path())).collect()
}

/// The folder with the newest PostgreSQL's `initdb`, `postgres` and `createdb`; `None` if one is missing, so that the test is skipped.
pub fn postgres() -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    Need::Postgres.or_skip(postgres_in(&path, Path::new(DEBIAN)).ok_or("apt-get install postgresql"))
}

/// Debian keeps PostgreSQL's programs out of the PATH, by version.
const DEBIAN: &str = "/usr/lib/postgresql";

fn postgres_in(path: &OsStr, versions: &Path) -> Option<PathBuf> {
    let is_whole = |folder: &PathBuf| ["initdb", "postgres", "createdb"].iter().all(|p| folder.join(p).is_file());
    let version = |folder: &PathBuf| folder.file_name().and_then(|n| n.to_str()?.parse::<u32>().ok());
    let mut debian: Vec<PathBuf> = std::fs::read_dir(versions).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
    debian.sort_by_key(|folder| std::cmp::Reverse(version(folder)));
    std::env::split_paths(path).chain(debian.into_iter().map(|folder| folder.join("bin"))).find(is_whole)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_need_skips_a_test_unless_required() {
        let missing = || Err::<(), _>("not here");
        assert_eq!(Need::Gpu.judged("", missing()), Ok(Err("not here".into())));
        assert_eq!(Need::Gpu.judged("onnx, ffmpeg", missing()), Ok(Err("not here".into())));
        assert_eq!(Need::Gpu.judged("onnx, gpu", missing()), Err("TMPI_REQUIRE names gpu: not here".into()));
        assert_eq!(Need::Onnx.judged("onnx", Ok::<_, &str>(7)), Ok(Ok(7)));
    }

    #[test]
    fn an_unknown_word_fails_though_everything_is_there() {
        let error = Need::Onnx.judged("gpu,onxx", Ok::<_, &str>(7)).unwrap_err();
        assert!(error.contains("\"onxx\"") && error.contains("gpu, onnx, ffmpeg, s3, postgres, data"), "{error}");
    }

    #[test]
    fn each_skip_is_a_line_of_three_columns() {
        let folder = tempfile::tempdir().unwrap();
        let list = folder.path().join("skipped");
        for (need, reason) in [(Need::S3, "no\tmoto\nhere "), (Need::Data, "none")] {
            append(&list, &need.line("tests::own", reason)).unwrap();
        }
        assert_eq!(std::fs::read_to_string(&list).unwrap(), "s3\ttests::own\tno moto here\ndata\ttests::own\tnone\n");
    }

    #[test]
    fn a_test_is_named_by_its_thread_or_its_program() {
        let named = |name: &str| std::thread::Builder::new().name(name.into()).spawn(test).unwrap().join().unwrap();
        assert_eq!(named("tests::own"), "tests::own");
        assert!(named("main").starts_with("tmpi_testing"), "{}", named("main"));
    }

    #[test]
    fn postgres_is_found_in_the_path_or_by_newest_version() {
        let root = tempfile::tempdir().unwrap();
        let install = |folder: &str, programs: &[&str]| {
            let folder = root.path().join(folder);
            std::fs::create_dir_all(&folder).unwrap();
            for program in programs {
                std::fs::write(folder.join(program), b"").unwrap();
            }
            folder
        };
        let all = ["initdb", "postgres", "createdb"];
        let half = install("half", &["postgres"]);
        let versions = root.path().join("lib");
        assert_eq!(postgres_in(half.as_os_str(), &versions), None);
        install("lib/9/bin", &all);
        let newest = install("lib/17/bin", &all);
        install("lib/18/bin", &["postgres"]);
        assert_eq!(postgres_in(half.as_os_str(), &versions), Some(newest));
        let own = install("own", &all);
        assert_eq!(postgres_in(own.as_os_str(), &versions), Some(own));
    }
}
