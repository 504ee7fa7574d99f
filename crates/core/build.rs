//! Compiles the wire schema without an external protoc.

use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = Path::new(&std::env::var("CARGO_MANIFEST_DIR")?).join("../../proto");
    let schema = folder.join("tmpi.proto");
    println!("cargo:rerun-if-changed={}", schema.display());
    prost_build::Config::new().compile_fds(protox::compile([schema], [folder])?)?;
    Ok(())
}
