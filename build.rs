//! Compiles the wire schema without an external protoc.
fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo:rerun-if-changed=proto/tmpi.proto");
    prost_build::Config::new().compile_fds(protox::compile(["proto/tmpi.proto"], ["proto"])?)?;
    Ok(())
}
