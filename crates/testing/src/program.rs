//! Runs built programs in a temporary folder.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output};

use image::{ImageBuffer, ImageFormat, Luma, Rgb, RgbImage};
use serde_json::Value;

use crate::pictures::encoded;

/// A temporary folder in which tests run a program.
#[derive(Debug)]
pub struct Folder {
    folder: tempfile::TempDir,
    program: &'static str,
}

impl Folder {
    /// An empty folder for a program: `env!("CARGO_BIN_EXE_…")`.
    pub fn of(program: &'static str) -> Self {
        Self { folder: tempfile::tempdir().expect("a folder"), program }
    }

    /// Adds `box.png` and `box.jpg`, pictures of a box in front of a wall, and `depth.png`, their depth map.
    pub fn with_box(self) -> Self {
        let depth = ImageBuffer::from_fn(150, 100, |x, y| Luma([if is_box(x, y) { 60_000u16 } else { 12_000 }]));
        self.write("box.png", &encoded(box_before_a_wall(), ImageFormat::Png));
        self.write("box.jpg", &encoded(box_before_a_wall(), ImageFormat::Jpeg));
        self.write("depth.png", &encoded(depth, ImageFormat::Png));
        self
    }

    /// The path of a file in the folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes a file.
    pub fn write(&self, name: &str, bytes: &[u8]) {
        std::fs::write(self.path(name), bytes).expect("the folder is writable");
    }

    /// The program, with this folder as its own. It does not use networks and settings of the user.
    pub fn command(&self) -> Command {
        let mut command = Command::new(self.program);
        // relative to the repository, because the program runs in another folder
        let library = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../.tmpi/onnxruntime/libonnxruntime.so");
        if std::env::var_os("ORT_DYLIB_PATH").is_none() && library.is_file() {
            command.env("ORT_DYLIB_PATH", library);
        }
        command.env("TMPI_MODELS", self.path("models")).env_remove("TMPI_DEPTH_MODEL").env_remove("RUST_LOG");
        command.current_dir(self.folder.path());
        command
    }

    /// Runs the program.
    pub fn run(&self, args: &[&str]) -> Run {
        self.command().args(args).output().expect("the program starts").into()
    }
}

fn is_box(x: u32, y: u32) -> bool {
    (50..90).contains(&x) && (30..70).contains(&y)
}

/// A picture of a box in front of a wall, 150 × 100 pixels.
pub fn box_before_a_wall() -> RgbImage {
    RgbImage::from_fn(150, 100, |x, y| {
        let texture = ((x * 7 + y * 13) % 32) as u8;
        if is_box(x, y) { Rgb([200 + texture, 120 + texture, 60]) } else { Rgb([40, 90 + texture, 160 + texture]) }
    })
}

/// A process that does not outlive its test.
#[derive(Debug)]
pub struct Killed(pub Child);

impl Killed {
    /// The first line that it writes to standard output, a pipe. A server writes its address there.
    pub fn first_line(&mut self) -> String {
        let mut line = String::new();
        BufReader::new(self.0.stdout.as_mut().expect("a pipe")).read_line(&mut line).expect("text");
        line.trim().to_owned()
    }
}

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Result of a run.
#[derive(Debug)]
pub struct Run {
    /// Exit code.
    pub code: i32,
    /// Standard output.
    pub out: String,
    /// Standard error.
    pub err: String,
}

impl From<Output> for Run {
    fn from(o: Output) -> Self {
        let text = |bytes| String::from_utf8(bytes).expect("text");
        Self { code: o.status.code().expect("an exit code"), out: text(o.stdout), err: text(o.stderr) }
    }
}

impl Run {
    /// Asserts success.
    pub fn succeeds(self) -> Self {
        assert_eq!(self.code, 0, "{}{}", self.out, self.err);
        self
    }

    /// Asserts a failure with empty standard output and an error that contains every word; returns the error.
    pub fn fails(self, code: i32, words: &[&str]) -> String {
        assert_eq!((self.code, self.out.as_str()), (code, ""), "{}", self.err);
        for word in words {
            assert!(self.err.contains(word), "{word:?} is not in: {}", self.err);
        }
        assert!(!self.err.contains("panicked"), "{}", self.err);
        self.err
    }

    /// Standard output as JSON.
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.out).expect("JSON")
    }
}
