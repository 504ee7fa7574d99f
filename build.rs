//! Generates the table of embedded pages, and digests of the sources that identify the program.

use std::fmt::Write as _;
use std::path::Path;

use sha2::{Digest, Sha256};

/// Sources that determine the bytes of a container.
const PIPELINE: [&str; 6] = ["Cargo.lock", "crates/core", "crates/pipeline", "models", "proto", "build.rs"];
/// Further sources that determine the bytes of views and exports.
const PROGRAM: [&str; 5] = ["crates/render", "src/export", "src/server", "static", "Cargo.toml"];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo:rerun-if-changed=static");
    let mut names = Vec::new();
    list(Path::new("static"), "", &mut names)?;
    names.sort();
    let mut table = String::from("&[\n");
    for name in names {
        writeln!(table, "    ({name:?}, include_bytes!(concat!(env!(\"CARGO_MANIFEST_DIR\"), \"/static/\", {name:?}))),")?;
    }
    table.push(']');
    std::fs::write(Path::new(&std::env::var("OUT_DIR")?).join("pages.rs"), table)?;
    println!("cargo:rustc-env=TMPI_PIPELINE={}", digest(&PIPELINE)?);
    println!("cargo:rustc-env=TMPI_PROGRAM={}", digest(&[PIPELINE.as_slice(), &PROGRAM].concat())?);
    Ok(())
}

/// SHA-256 of the names and contents of all files below `roots`, as hexadecimal digits.
fn digest(roots: &[&str]) -> std::io::Result<String> {
    let mut hash = Sha256::new();
    // floating-point results differ between targets
    hash.update(std::env::var("TARGET").unwrap_or_default());
    for root in roots {
        println!("cargo:rerun-if-changed={root}");
        let path = Path::new(root);
        let mut names = Vec::new();
        if path.is_dir() {
            list(path, &format!("{root}/"), &mut names)?;
        } else {
            names.push((*root).to_owned());
        }
        names.sort();
        for name in names {
            let bytes = std::fs::read(&name)?;
            hash.update(name.as_bytes());
            hash.update((bytes.len() as u64).to_le_bytes());
            hash.update(bytes);
        }
    }
    Ok(hash.finalize().iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}")))
}

/// Appends the names of all files below `dir`, with `/` between folders; skips hidden files.
fn list(dir: &Path, prefix: &str, names: &mut Vec<String>) -> std::io::Result<()> {
    for entry in std::fs::read_dir(dir)? {
        let entry = entry?;
        let Ok(file) = entry.file_name().into_string() else { continue };
        if file.starts_with('.') {
            continue;
        }
        let name = format!("{prefix}{file}");
        if entry.file_type()?.is_dir() {
            list(&entry.path(), &format!("{name}/"), names)?;
        } else {
            names.push(name);
        }
    }
    Ok(())
}
