//! Time and peak memory by photo size.

use std::path::PathBuf;
use std::process::{Command, Stdio};

use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder};

use super::{Axis, BenchError, Curve, Experiment, Point, figures};
use crate::scenes;
use tmpi_core::{DisparityMap, Photo};
use tmpi_pipeline::Report;
use tmpi_pipeline::depth::to_png;
use tmpi_pipeline::photo::resize;

/// Size of the rendered scene that is enlarged, 3:2.
const BASE: (u32, u32) = (1200, 800);

/// Time and memory of `tmpi make` by photo size.
pub(super) fn run(quick: bool) -> Result<[Experiment; 2], BenchError> {
    let megapixels: &[f64] = if quick { &[0.2, 0.8, 3.0, 12.0] } else { &[0.2, 0.5, 1.0, 3.0, 6.0, 12.0, 24.0, 49.9] };
    let reports = measured(megapixels)?;
    Ok([
        experiment("scaling", "Scaling: time", "processing of photo and disparity, ms", &reports, |r| r.total_ms),
        experiment("scaling-memory", "Scaling: memory", "peak resident memory, MB", &reports, |r| r.peak_rss_bytes as f64 / 1e6),
    ])
}

fn experiment(id: &str, title: &str, y: &'static str, reports: &[Report], value: fn(&Report) -> f64) -> Experiment {
    let mp = |r: &Report| f64::from(r.width) * f64::from(r.height) / 1e6;
    let point = |r: &Report| {
        let mut all = figures([
            ("total, ms", r.total_ms),
            ("total, CPU ms", r.stages.iter().map(|s| s.cpu_ms).sum()),
            ("ms per megapixel", r.total_ms / mp(r)),
            ("bytes of memory per pixel", r.peak_rss_bytes as f64 / (mp(r) * 1e6)),
            ("planes per tile", r.planes_per_tile),
        ]);
        all.extend(r.stages.iter().map(|s| (format!("{}, ms", s.name), s.ms)));
        Point { setting: format!("{}×{}", r.width, r.height), x: mp(r), y: value(r), figures: all, ..Point::default() }
    };
    let slope = match (reports.first(), reports.last()) {
        (Some(a), Some(b)) if mp(b) > mp(a) => (value(b) - value(a)) / (mp(b) - mp(a)),
        _ => 0.0,
    };
    Experiment {
        id: id.into(),
        title: title.into(),
        about: format!(
            "One rendered scene, enlarged to each size and processed with its disparity once in a separate process. From the smallest to the largest: {slope:.1} per megapixel."
        ),
        x: Axis::new("photo, megapixels", true, None),
        y: Axis::new(y, true, Some(false)),
        curves: vec![Curve { name: "defaults".into(), points: reports.iter().map(point).collect() }],
    }
}

/// Runs `tmpi make` in separate processes, in a temporary folder.
pub(super) struct ProcessRunner {
    folder: PathBuf,
    program: PathBuf,
}

impl ProcessRunner {
    /// Creates the folder.
    pub fn new() -> Result<Self, BenchError> {
        let folder = std::env::temp_dir().join(format!("tmpi-bench-{}", std::process::id()));
        let bad = |e: std::io::Error| BenchError::File { path: folder.clone(), reason: e.to_string() };
        std::fs::create_dir_all(&folder).map_err(bad)?;
        let program = program().map_err(bad)?;
        Ok(Self { folder, program })
    }

    fn bad(&self, reason: &dyn std::fmt::Display) -> BenchError {
        BenchError::File { path: self.folder.clone(), reason: reason.to_string() }
    }

    /// Writes the photo and disparity map for [`ProcessRunner::make`].
    pub fn put(&self, photo: &Photo, disparity: &DisparityMap) -> Result<(), BenchError> {
        let mut file = Vec::new();
        JpegEncoder::new_with_quality(&mut file, 85)
            .write_image(photo.rgb.as_flattened(), photo.width, photo.height, ExtendedColorType::Rgb8)
            .map_err(|e| self.bad(&e))?;
        std::fs::write(self.folder.join("p.jpg"), file).map_err(|e| self.bad(&e))?;
        let map = to_png(disparity).map_err(|e| self.bad(&e))?;
        std::fs::write(self.folder.join("d.png"), map).map_err(|e| self.bad(&e))
    }

    /// Processes the photo in a new process, because the peak memory of a process never decreases.
    pub fn make(&self, arguments: &[&str]) -> Result<Report, BenchError> {
        let [photo, depth, out, report] = ["p.jpg", "d.png", "o.tmpi", "r.json"].map(|name| self.folder.join(name));
        let mut command = Command::new(&self.program);
        command
            .args(["make", "--force"])
            .arg(photo)
            .arg("--depth")
            .arg(depth)
            .arg("-o")
            .arg(out)
            .arg("--report")
            .arg(&report)
            .args(arguments);
        let status = command.arg("--quiet").stdout(Stdio::null()).status().map_err(|e| self.bad(&e))?;
        if !status.success() {
            return Err(self.bad(&format!("`tmpi make` with {arguments:?}: {status}")));
        }
        let text = std::fs::read(&report).map_err(|e| self.bad(&e))?;
        serde_json::from_slice(&text).map_err(|e| self.bad(&e))
    }
}

/// Path of the program `tmpi`: the variable `TMPI`, otherwise the program beside this one.
fn program() -> std::io::Result<PathBuf> {
    if let Some(named) = std::env::var_os("TMPI").filter(|v| !v.is_empty()) {
        return Ok(named.into());
    }
    let path = std::env::current_exe()?.with_file_name(format!("tmpi{}", std::env::consts::EXE_SUFFIX));
    if path.is_file() {
        return Ok(path);
    }
    let reason = format!("{} does not exist: run `cargo build --release`, or set TMPI to the program", path.display());
    Err(std::io::Error::new(std::io::ErrorKind::NotFound, reason))
}

impl Drop for ProcessRunner {
    fn drop(&mut self) {
        // ignore failures: the folder is temporary
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

fn measured(megapixels: &[f64]) -> Result<Vec<Report>, BenchError> {
    let scene = scenes::Scene::framed(900_100, BASE.0, BASE.1);
    let picture = scene.render(&scene.camera(), 1);
    let runner = ProcessRunner::new()?;
    let one = |mp: &f64| {
        let width = (mp * 1e6 * 1.5).sqrt().round();
        runner.put(&resize(&picture.photo, width as u32, (width / 1.5).round() as u32), &picture.disparity)?;
        runner.make(&[])
    };
    megapixels.iter().map(one).collect()
}
