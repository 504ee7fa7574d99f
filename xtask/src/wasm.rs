//! Builds the pages' decoders and the unpacker as WebAssembly.

use std::path::Path;
use std::process::Command;

use crate::command::{Fault, Profile, cargo, output, root, run};
use crate::rust_tests;

const TARGET: &str = "wasm32-unknown-unknown";
/// Features that all browsers of recent years support. No relaxed SIMD: results must be the same on every machine.
const FLAGS: &str = "-C target-feature=+simd128,+bulk-memory";

/// Packages, and the files below `static` that they become. Each is built alone; built together, the decoder would contain the unpacker's
/// zstd.
const MODULES: [(&str, &str); 3] =
    [("tmpi-decoder", "decode/decoder.wasm"), ("tmpi-unpacker", "decode/unpacker.wasm"), ("tmpi-live-decoder", "live/decoder.wasm")];

/// Builds the modules in `static`, and records the sources that they were built from.
pub fn build() -> Result<(), Fault> {
    let sysroot = output("rustc", &["--print", "sysroot"]).ok_or_else(|| Fault::new("cannot run rustc"))?;
    for (package, name) in MODULES {
        module(&sysroot, package, name)?;
    }
    // built like all tests; otherwise the core would be compiled a second time
    let mut written = cargo(&["test", "--workspace", "--profile", Profile::Checks.name(), "--test", "built"]);
    rust_tests::lint(&mut written);
    written.env("TMPI_BLESS", "wasm");
    run(written)
}

fn module(sysroot: &str, package: &str, name: &str) -> Result<(), Fault> {
    let args = ["build", "--profile", "wasm", "--target", TARGET, "--package", package, "--lib"];
    let mut build = if Path::new(sysroot).join("lib/rustlib").join(TARGET).is_dir() {
        cargo(&args)
    } else if output("apt-get", &["--version"]).is_some() {
        let mut script = Command::new(root().join("crates/decoder/wasm32-std.sh"));
        script.args(args).current_dir(root());
        script
    } else {
        return Err(Fault::new(format!("the target {TARGET} is not installed; run `rustup target add {TARGET}`")));
    };
    // the committed file must not contain paths of this machine
    let home = std::env::var("CARGO_HOME").or_else(|_| std::env::var("HOME").map(|home| format!("{home}/.cargo"))).unwrap_or_default();
    let mut flags = format!("{FLAGS} --remap-path-prefix={home}=cargo --remap-path-prefix={sysroot}=rust");
    // nor the names of registries
    let registries = std::fs::read_dir(Path::new(&home).join("registry/src")).into_iter().flatten().flatten();
    flags.extend(registries.map(|registry| format!(" --remap-path-prefix={}=crates", registry.path().display())));
    build.env("RUSTFLAGS", flags);
    let target = root().join("target");
    build.env("CARGO_TARGET_DIR", &target);
    run(build)?;
    let from = target.join(TARGET).join("wasm").join(package.replace('-', "_")).with_extension("wasm");
    let to = root().join("static").join(name);
    let bytes = std::fs::copy(&from, &to).map_err(|e| Fault::at(&from, &e))?;
    println!("{}: {bytes} bytes", to.display());
    Ok(())
}
