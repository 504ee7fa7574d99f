//! Sets `cfg(embedded = "depth")` if there is a depth network to embed.

use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let models = Path::new(&std::env::var("CARGO_MANIFEST_DIR")?).join("../../models");
    println!("cargo:rerun-if-changed={}", models.display());
    println!("cargo:rustc-check-cfg=cfg(embedded, values(\"depth\"))");
    if models.join("depth.onnx").is_file() {
        println!("cargo:rustc-cfg=embedded=\"depth\"");
    }
    Ok(())
}
