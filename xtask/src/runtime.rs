//! Fetches the ONNX Runtime library. It comes from the Python package, which contains the same library for every Python version.

use std::process::Command;

use crate::command::Fault;
use crate::wheel::{Package, Wheel};

const LICENCES: [(&str, &str); 2] = [("onnxruntime/LICENSE", "LICENSE"), ("onnxruntime/ThirdPartyNotices.txt", "ThirdPartyNotices.txt")];

/// The last version whose Linux and macOS builds send no usage data to the vendor. The program looks for the library in this folder.
const RUNTIME: Package = Package {
    name: "onnxruntime",
    version: "1.28.0",
    folder: ".tmpi/onnxruntime",
    wheels: &[
        Wheel {
            os: "linux",
            arch: "x86_64",
            tag: "manylinux_2_28_x86_64",
            sha256: "0a83bdb70d143cede762b677789bf2a7acca54b3fb82565601d5c30695aa933c",
            members: &[LICENCES[0], LICENCES[1], ("onnxruntime/capi/libonnxruntime.so.1.28.0", "libonnxruntime.so")],
        },
        Wheel {
            os: "linux",
            arch: "aarch64",
            tag: "manylinux_2_28_aarch64",
            sha256: "4e81a23df16e7acb9d51b06d30cc098e49315ef9180f97bc2221d167b4b04d9c",
            members: &[LICENCES[0], LICENCES[1], ("onnxruntime/capi/libonnxruntime.so.1.28.0", "libonnxruntime.so")],
        },
        Wheel {
            os: "macos",
            arch: "aarch64",
            tag: "macosx_14_0_arm64",
            sha256: "26ff0fdd06efb6c155bae95387a09db1a2be89c7a03e4d0bffd5a171cc2826da",
            members: &[LICENCES[0], LICENCES[1], ("onnxruntime/capi/libonnxruntime.1.28.0.dylib", "libonnxruntime.dylib")],
        },
        Wheel {
            os: "windows",
            arch: "x86_64",
            tag: "win_amd64",
            sha256: "c35064f9b3c43c81c5d5d282091401d0f1ff22796d93ccade4ea2ece5e137ab8",
            members: &[LICENCES[0], LICENCES[1], ("onnxruntime/capi/onnxruntime.dll", "onnxruntime.dll")],
        },
    ],
    advice: "set ORT_DYLIB_PATH to a library file of version 1.22 or newer",
};

/// Passes the library's path to a program that is built outside the workspace and would not find it.
pub fn set_env(command: &mut Command) {
    if std::env::var_os("CARGO_TARGET_DIR").is_none() || std::env::var_os("ORT_DYLIB_PATH").is_some_and(|v| !v.is_empty()) {
        return;
    }
    if let Some(file) = RUNTIME.last().filter(|f| f.is_file()) {
        command.env("ORT_DYLIB_PATH", file);
    }
}

/// Fetches the library unless it is already installed.
pub fn fetch() -> Result<(), Fault> {
    // the program loads this file and looks nowhere else
    if std::env::var_os("ORT_DYLIB_PATH").is_some_and(|v| !v.is_empty()) {
        return Ok(());
    }
    RUNTIME.fetch()
}

/// Path of the fetched library for this platform.
pub fn library() -> Option<std::path::PathBuf> {
    let named = std::env::var_os("ORT_DYLIB_PATH").filter(|v| !v.is_empty()).map(std::path::PathBuf::from);
    // a library that the user provides has no licence files beside it
    named.is_none().then(|| RUNTIME.last()).flatten().filter(|f| f.is_file())
}
