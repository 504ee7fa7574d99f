//! The page's decoder as WebAssembly.

use std::path::Path;
use std::process::Command;

use super::command::{Fault, cargo, output, root, run};

const TARGET: &str = "wasm32-unknown-unknown";
/// What every browser of the last years has; vectors that are the same on every machine alone.
const FLAGS: &str = "-C target-feature=+simd128,+bulk-memory";

/// Builds `static/decode/decoder.wasm`, and writes down what it was built from.
pub fn build() -> Result<(), Fault> {
    let args = ["build", "--profile", "wasm", "--target", TARGET, "--package", "tmpi-decoder", "--lib"];
    let sysroot = output("rustc", &["--print", "sysroot"]).ok_or_else(|| Fault::new("there is no rustc"))?;
    let mut build = if Path::new(&sysroot).join("lib/rustlib").join(TARGET).is_dir() {
        cargo(&args)
    } else if output("apt-get", &["--version"]).is_some() {
        let mut script = Command::new(root().join("crates/decoder/wasm32-std.sh"));
        script.args(args).current_dir(root());
        script
    } else {
        return Err(Fault::new(format!("the compiler has no target {TARGET}: `rustup target add {TARGET}` brings it")));
    };
    // no path of this machine in what is committed
    let home = std::env::var("CARGO_HOME").or_else(|_| std::env::var("HOME").map(|home| format!("{home}/.cargo"))).unwrap_or_default();
    build.env("RUSTFLAGS", format!("{FLAGS} --remap-path-prefix={home}=cargo --remap-path-prefix={sysroot}=rust"));
    let target = root().join("target");
    build.env("CARGO_TARGET_DIR", &target);
    run(build)?;
    let (from, to) = (target.join(TARGET).join("wasm/tmpi_decoder.wasm"), root().join("static/decode/decoder.wasm"));
    let bytes = std::fs::copy(&from, &to).map_err(|e| Fault::new(format!("{}: {e}", from.display())))?;
    println!("{}: {bytes} bytes", to.display());
    let mut written = cargo(&["test", "--release", "--package", "tmpi-decoder", "--test", "built"]);
    written.env("TMPI_BLESS", "wasm");
    run(written)
}
