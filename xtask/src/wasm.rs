//! The page's decoder, and its unpacker, as WebAssembly.

use std::path::Path;
use std::process::Command;

use crate::command::{Fault, Profile, cargo, output, root, run};
use crate::rust_tests;

const TARGET: &str = "wasm32-unknown-unknown";
/// What every browser of the last years has; vectors that are the same on every machine alone.
const FLAGS: &str = "-C target-feature=+simd128,+bulk-memory";

/// Packages, and what they are called below `static`. Each is built alone: together the decoder would have the unpacker's zstd.
const MODULES: [(&str, &str); 3] =
    [("tmpi-decoder", "decode/decoder.wasm"), ("tmpi-unpacker", "decode/unpacker.wasm"), ("tmpi-live-decoder", "live/decoder.wasm")];

/// Builds the modules of `static`, and writes down what they were built from.
pub fn build() -> Result<(), Fault> {
    let sysroot = output("rustc", &["--print", "sysroot"]).ok_or_else(|| Fault::new("there is no rustc"))?;
    for (package, name) in MODULES {
        module(&sysroot, package, name)?;
    }
    // as all tests are built: otherwise the core would be built a second time
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
        return Err(Fault::new(format!("the compiler has no target {TARGET}: `rustup target add {TARGET}` brings it")));
    };
    // no path of this machine in what is committed
    let home = std::env::var("CARGO_HOME").or_else(|_| std::env::var("HOME").map(|home| format!("{home}/.cargo"))).unwrap_or_default();
    let mut flags = format!("{FLAGS} --remap-path-prefix={home}=cargo --remap-path-prefix={sysroot}=rust");
    // nor where its crates come from
    let registries = std::fs::read_dir(Path::new(&home).join("registry/src")).into_iter().flatten().flatten();
    flags.extend(registries.map(|registry| format!(" --remap-path-prefix={}=crates", registry.path().display())));
    build.env("RUSTFLAGS", flags);
    let target = root().join("target");
    build.env("CARGO_TARGET_DIR", &target);
    run(build)?;
    let from = target.join(TARGET).join("wasm").join(package.replace('-', "_")).with_extension("wasm");
    let to = root().join("static").join(name);
    let bytes = std::fs::copy(&from, &to).map_err(|e| Fault::new(format!("{}: {e}", from.display())))?;
    println!("{}: {bytes} bytes", to.display());
    Ok(())
}
