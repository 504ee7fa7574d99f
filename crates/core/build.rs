//! Compiles the wire schemas without an external protoc.

use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = Path::new(&std::env::var("CARGO_MANIFEST_DIR")?).join("../../proto");
    let schemas = ["tmpi.proto", "live.proto"].map(|name| folder.join(name));
    for schema in &schemas {
        println!("cargo:rerun-if-changed={}", schema.display());
    }
    // `Bytes` share memory instead of copying it: one frame goes to many viewers
    prost_build::Config::new().bytes(["."]).compile_fds(protox::compile(schemas, [folder])?)?;
    Ok(())
}
