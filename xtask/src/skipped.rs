//! Skipped tests: each appends a line to a file, and the list is printed at the end of a run.

use std::collections::BTreeSet;
use std::fs;
use std::io::Write as _;
use std::path::PathBuf;

use crate::command::{Fault, say, target};

/// Environment variable that names the file to which a skipped test appends `NEED<TAB>TEST<TAB>REASON`.
pub const VARIABLE: &str = "TMPI_SKIPPED";

/// The file that the tests of this workspace append to.
pub fn file() -> PathBuf {
    target().join("skipped.tsv")
}

/// Starts an empty list.
pub fn clear() -> Result<(), Fault> {
    let file = file();
    fs::create_dir_all(target()).and_then(|()| fs::write(&file, "")).map_err(|e| Fault::at(&file, &e))
}

pub fn add(need: &str, test: &str, reason: &str) -> Result<(), Fault> {
    let file = file();
    let open = fs::OpenOptions::new().append(true).create(true).open(&file);
    open.and_then(|mut f| f.write_all(format!("{need}\t{test}\t{reason}\n").as_bytes())).map_err(|e| Fault::at(&file, &e))
}

/// Prints the skipped tests, each with its reason, and their number.
pub fn print() -> Result<(), Fault> {
    let file = file();
    let list = fs::read_to_string(&file).map_err(|e| Fault::at(&file, &e))?;
    let lines: BTreeSet<&str> = list.lines().collect();
    for line in &lines {
        let mut fields = line.splitn(3, '\t');
        let [need, test, reason] = [(); 3].map(|()| fields.next().unwrap_or("?"));
        say(&format!("skipped, no {need}: {test}: {reason}"));
    }
    say(&format!("{} skipped", lines.len()));
    Ok(())
}
