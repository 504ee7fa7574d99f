//! A folder with a photo, in which tests run the built program.

use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use image::{DynamicImage, ImageBuffer, ImageFormat, Luma, Rgb};
use serde_json::Value;

/// A temporary folder with a photo of a box in front of a wall, and its depth map.
pub struct Folder(tempfile::TempDir);

impl Folder {
    pub fn new() -> Self {
        let folder = Self(tempfile::tempdir().unwrap());
        let inside = |x: u32, y: u32| (50..90).contains(&x) && (30..70).contains(&y);
        let texture = |x: u32, y: u32| ((x * 7 + y * 13) % 32) as u8;
        let photo = ImageBuffer::from_fn(150, 100, |x, y| {
            let t = texture(x, y);
            if inside(x, y) { Rgb([200 + t, 120 + t, 60]) } else { Rgb([40, 90 + t, 160 + t]) }
        });
        let depth = ImageBuffer::from_fn(150, 100, |x, y| Luma([if inside(x, y) { 60_000u16 } else { 12_000 }]));
        folder.write("box.png", &encoded(photo.clone(), ImageFormat::Png));
        folder.write("box.jpg", &encoded(photo, ImageFormat::Jpeg));
        folder.write("depth.png", &encoded(depth, ImageFormat::Png));
        folder
    }

    pub fn write(&self, name: &str, bytes: &[u8]) {
        std::fs::write(self.path(name), bytes).unwrap();
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    pub fn run(&self, args: &[&str]) -> Run {
        let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
        // relative to the repository, because the program runs in another folder
        let library = Path::new(env!("CARGO_MANIFEST_DIR")).join(".tmpi/onnxruntime/libonnxruntime.so");
        if std::env::var_os("ORT_DYLIB_PATH").is_none() && library.is_file() {
            command.env("ORT_DYLIB_PATH", library);
        }
        // tests must not use networks that the user has downloaded
        command.env("TMPI_MODELS", self.path("models")).env_remove("TMPI_DEPTH_MODEL");
        Run::from(command.current_dir(self.0.path()).env_remove("RUST_LOG").args(args).output().unwrap())
    }

    /// Makes `box.tmpi` from the photo and its depth map.
    pub fn container(&self) -> &Self {
        self.run(&["make", "box.png", "--depth", "depth.png", "-o", "box.tmpi", "-q"]).succeeds();
        self
    }

    /// Whether the embedded depth network can run.
    pub fn has_depth(&self) -> bool {
        let run = self.run(&["depth", "box.png", "-q", "--raw", "-o", "probe.pfm"]);
        // skip only if ONNX Runtime is missing
        assert!(run.code == 0 || run.err.contains("ONNX Runtime"), "{}", run.err);
        tmpi_testing::Need::Onnx.or_skip(if run.code == 0 { Ok(()) } else { Err(run.err) }).is_some()
    }

    pub fn names(&self) -> Vec<String> {
        let mut all: Vec<_> = std::fs::read_dir(self.0.path()).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        all.sort();
        all
    }
}

fn encoded(image: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
    let mut out = Cursor::new(Vec::new());
    image.into().write_to(&mut out, format).unwrap();
    out.into_inner()
}

pub struct Run {
    pub code: i32,
    pub out: String,
    pub err: String,
}

impl From<Output> for Run {
    fn from(o: Output) -> Self {
        let text = |b| String::from_utf8(b).unwrap();
        Self { code: o.status.code().unwrap(), out: text(o.stdout), err: text(o.stderr) }
    }
}

impl Run {
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

    pub fn json(&self) -> Value {
        serde_json::from_str(&self.out).unwrap()
    }
}

/// Asserts that every path (`a.b`) exists.
pub fn has(value: &Value, paths: &[&str]) {
    for path in paths {
        assert!(!value.pointer(&format!("/{}", path.replace('.', "/"))).unwrap_or(&Value::Null).is_null(), "{path} is missing: {value}");
    }
}
