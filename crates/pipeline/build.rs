//! Tells the code which networks there are to embed.

use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let models = Path::new(&std::env::var("CARGO_MANIFEST_DIR")?).join("../../models");
    println!("cargo:rerun-if-changed={}", models.display());
    println!("cargo:rustc-check-cfg=cfg(embedded, values(\"depth\", \"theta\", \"psi\"))");
    for network in ["depth", "theta", "psi"] {
        if models.join(network).with_extension("onnx").is_file() {
            println!("cargo:rustc-cfg=embedded=\"{network}\"");
        }
    }
    Ok(())
}
