//! Time and peak memory by photo size.

use std::path::PathBuf;
use std::process::{Command, Stdio};

use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder};

use super::{Axis, BenchError, Curve, Experiment, Point};
use crate::scenes;
use tmpi_core::{DisparityMap, Photo};
use tmpi_pipeline::Report;
use tmpi_pipeline::depth::to_png;
use tmpi_pipeline::photo::resize;

/// Size of the rendered scene that is enlarged, 3:2.
const BASE: (u32, u32) = (1200, 800);

pub(super) fn run(quick: bool, skipped: &mut Vec<String>, progress: &dyn Fn(&str)) -> Vec<Experiment> {
    progress("scaling");
    let megapixels: &[f64] = if quick { &[0.2, 0.8, 3.0, 12.0] } else { &[0.2, 0.5, 1.0, 3.0, 6.0, 12.0, 24.0, 49.9] };
    match measured(megapixels) {
        Ok(points) => vec![
            experiment("scaling-time", "Scaling: time", "processing of photo and disparity, ms", &points, |r| r.total_ms),
            experiment("scaling-memory", "Scaling: memory", "peak resident memory, MB", &points, |r| r.peak_rss_bytes as f64 / 1e6),
        ],
        Err(reason) => {
            skipped.push(format!("scaling: {reason}"));
            Vec::new()
        }
    }
}

fn experiment(id: &'static str, title: &str, y: &'static str, reports: &[Report], value: fn(&Report) -> f64) -> Experiment {
    let mp = |r: &Report| f64::from(r.width) * f64::from(r.height) / 1e6;
    let point = |r: &Report| {
        let mut figures = vec![
            ("total, ms", r.total_ms),
            ("total, CPU ms", r.stages.iter().map(|s| s.cpu_ms).sum()),
            ("ms per megapixel", r.total_ms / mp(r)),
            ("bytes of memory per pixel", r.peak_rss_bytes as f64 / (mp(r) * 1e6)),
            ("planes per tile", r.planes_per_tile),
        ];
        for (name, figure) in [("planes", "planes, ms"), ("layers", "layers, ms"), ("encode", "encode, ms"), ("verify", "verify, ms")] {
            figures.extend(r.stages.iter().filter(|s| s.name == name).map(|s| (figure, s.ms)));
        }
        Point { setting: format!("{}×{}", r.width, r.height), x: mp(r), y: value(r), figures, ..Point::default() }
    };
    let slope = match (reports.first(), reports.last()) {
        (Some(a), Some(b)) if mp(b) > mp(a) => (value(b) - value(a)) / (mp(b) - mp(a)),
        _ => 0.0,
    };
    Experiment {
        id,
        title: title.into(),
        about: format!(
            "One rendered scene, enlarged to each size and processed with its disparity once in a separate process. From the smallest to the largest: {slope:.1} per megapixel."
        ),
        x: Axis { label: "photo, megapixels", log: true, up: None },
        y: Axis { label: y, log: true, up: Some(false) },
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
        let program = super::program().map_err(bad)?;
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
