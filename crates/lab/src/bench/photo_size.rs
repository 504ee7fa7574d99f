//! Time and peak memory by photo size.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use super::{Axis, Curve, Experiment, Point, figures};
use crate::{LabError, files, scenes};
use tmpi_core::container::encode_jpeg;
use tmpi_core::{DisparityMap, Photo};
use tmpi_pipeline::Report;
use tmpi_pipeline::depth::to_png;
use tmpi_pipeline::photo::resize;

/// Size of the rendered scene that is enlarged, 3:2.
const BASE: (u32, u32) = (1200, 800);

/// Time and memory of `tmpi make` by photo size.
pub(super) fn run(quick: bool) -> Result<[Experiment; 2], LabError> {
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

/// Runs `tmpi make` in a new process, because the peak memory of a process never decreases.
fn report(program: &Path, folder: &Path, photo: &Photo, disparity: &DisparityMap) -> Result<Report, LabError> {
    let [file, depth, out, report] = ["p.jpg", "d.png", "o.tmpi", "r.json"].map(|name| folder.join(name));
    files::write(&file, &encode_jpeg(photo.width, photo.height, photo.rgb.as_flattened(), 85)?)?;
    files::write(&depth, &to_png(disparity)?)?;
    let mut command = Command::new(program);
    command.args(["make", "--force", "--quiet"]).arg(file).arg("--depth").arg(depth).arg("-o").arg(out).arg("--report").arg(&report);
    let status = command.stdout(Stdio::null()).status().map_err(|e| LabError::file(program, e))?;
    if !status.success() {
        return Err(LabError::file(program, format!("`make`: {status}")));
    }
    files::read_json(&report)
}

/// Path of the program `tmpi`: the variable `TMPI`, otherwise the program beside this one.
fn program() -> Result<PathBuf, LabError> {
    if let Some(named) = std::env::var_os("TMPI").filter(|v| !v.is_empty()) {
        return Ok(named.into());
    }
    let own = std::env::current_exe().map_err(|e| LabError::file(Path::new("tmpi"), e))?;
    let path = own.with_file_name(format!("tmpi{}", std::env::consts::EXE_SUFFIX));
    if path.is_file() { Ok(path) } else { Err(LabError::file(&path, "run `cargo build --release`, or set TMPI to the program")) }
}

fn measured(megapixels: &[f64]) -> Result<Vec<Report>, LabError> {
    let scene = scenes::Scene::framed(900_100, BASE.0, BASE.1);
    let picture = scene.render(&scene.camera(), 1);
    let (program, folder) = (program()?, tempfile::tempdir().map_err(|e| LabError::file(&std::env::temp_dir(), e))?);
    let one = |mp: &f64| {
        let width = (mp * 1e6 * 1.5).sqrt().round();
        let photo = resize(&picture.photo, width as u32, (width / 1.5).round() as u32);
        report(&program, folder.path(), &photo, &picture.disparity)
    };
    megapixels.iter().map(one).collect()
}
