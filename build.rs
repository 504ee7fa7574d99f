//! Compiles the wire schema without an external protoc, and tells the code which networks there are to embed.
fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo:rerun-if-changed=proto/tmpi.proto");
    prost_build::Config::new().compile_fds(protox::compile(["proto/tmpi.proto"], ["proto"])?)?;
    println!("cargo:rerun-if-changed=models");
    println!("cargo:rustc-check-cfg=cfg(embedded, values(\"depth\", \"theta\", \"psi\"))");
    for network in ["depth", "theta", "psi"] {
        if std::path::Path::new("models").join(network).with_extension("onnx").is_file() {
            println!("cargo:rustc-cfg=embedded=\"{network}\"");
        }
    }
    Ok(())
}
