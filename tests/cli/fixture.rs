//! A folder with a photo, in which tests run the built program.

use std::ops::Deref;

use serde_json::Value;
use tmpi_testing::program;
pub use tmpi_testing::program::Run;

/// A temporary folder with a photo of a box in front of a wall, and its depth map.
pub struct Folder(program::Folder);

impl Deref for Folder {
    type Target = program::Folder;

    fn deref(&self) -> &program::Folder {
        &self.0
    }
}

impl Folder {
    pub fn new() -> Self {
        Self(program::Folder::of(env!("CARGO_BIN_EXE_tmpi")).with_box())
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
        let mut all: Vec<_> = std::fs::read_dir(self.path("")).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        all.sort();
        all
    }
}

/// Asserts that every path (`a.b`) exists.
pub fn has(value: &Value, paths: &[&str]) {
    for path in paths {
        assert!(!value.pointer(&format!("/{}", path.replace('.', "/"))).unwrap_or(&Value::Null).is_null(), "{path} is missing: {value}");
    }
}
