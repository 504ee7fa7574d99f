//! Checks spelling with `typos` and the words in `_typos.toml`.

use std::process::Command;

use crate::command::{Fault, root, run};
use crate::wheel::{Package, Wheel};

/// Pinned, because the dictionary of a newer version may reject words that pass today.
const TYPOS: Package = Package {
    name: "typos",
    version: "1.52.0",
    folder: ".tmpi/typos",
    wheels: &[
        Wheel {
            os: "linux",
            arch: "x86_64",
            tag: "manylinux2014_x86_64",
            sha256: "418fd85f7fc11dec14e5482e747f6e916af56da96207cde0cdd69540a4b389f6",
            members: &[("typos-1.52.0.data/scripts/typos", "typos")],
        },
        Wheel {
            os: "linux",
            arch: "aarch64",
            tag: "manylinux2014_aarch64",
            sha256: "5e870133c7e9cace94183e4d638697004a1473e79abcd01b8f75e362049a9b5c",
            members: &[("typos-1.52.0.data/scripts/typos", "typos")],
        },
        Wheel {
            os: "macos",
            arch: "aarch64",
            tag: "macosx_11_0_arm64",
            sha256: "257324274303a459fef79978cae942568419d2e8b18519e5f66b93a7e2df2ba1",
            members: &[("typos-1.52.0.data/scripts/typos", "typos")],
        },
        Wheel {
            os: "windows",
            arch: "x86_64",
            tag: "win_amd64",
            sha256: "b7ef28f4503bd5d25ba987d33af0c6acf5a7e63d5c2ff1c025ae7fa6ae56c07c",
            members: &[("typos-1.52.0.data/scripts/typos.exe", "typos.exe")],
        },
    ],
    advice: "set TYPOS to a program of that version",
};

/// Checks all files that git tracks or does not ignore.
pub fn check() -> Result<(), Fault> {
    let named = std::env::var_os("TYPOS").filter(|v| !v.is_empty());
    let program = if let Some(named) = named {
        named.into()
    } else {
        TYPOS.fetch()?;
        root().join(TYPOS.folder).join(format!("typos{}", std::env::consts::EXE_SUFFIX))
    };
    let mut command = Command::new(program);
    command.current_dir(root()).args(["--format", "brief"]);
    run(command)
}
