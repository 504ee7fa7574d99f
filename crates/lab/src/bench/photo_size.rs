//! Time and peak memory by photo size.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use super::measure::in_turns;
use super::{Axis, Curve, Experiment, Figures};
use crate::{LabError, files, scenes};
use tmpi_core::container::encode_jpeg;
use tmpi_core::{DisparityMap, Photo};
use tmpi_pipeline::Report;
use tmpi_pipeline::depth::to_png;
use tmpi_pipeline::photo::resize;

const PHOTO: &str = "p.jpg";
const DISPARITY: &str = "d.png";
/// Size of the rendered scene that is enlarged, 3:2.
const BASE: (u32, u32) = (1200, 800);
const MEGAPIXELS: &str = "photo, megapixels";

/// Time and memory of `tmpi make` by photo size.
pub(super) fn run(quick: bool, repeats: usize) -> Result<[Experiment; 2], LabError> {
    let megapixels: &[f64] = if quick { &[0.2, 0.8, 3.0, 12.0] } else { &[0.2, 0.5, 1.0, 3.0, 6.0, 12.0, 24.0, 49.9] };
    let sizes = measured(megapixels, repeats)?;
    Ok([
        experiment("scaling", "Scaling: time", "processing of photo and disparity, ms", &sizes, |r| r.total_ms),
        experiment("scaling-memory", "Scaling: memory", "peak resident memory, MB", &sizes, |r| r.peak_rss_bytes as f64 / 1e6),
    ])
}

/// `sizes` has the reports of all runs of each.
fn experiment(id: &str, title: &str, y: &'static str, sizes: &[Vec<Report>], value: fn(&Report) -> f64) -> Experiment {
    let point = |runs: &Vec<Report>| {
        let (mut f, mut size) = (Figures::default(), (0, 0));
        for r in runs {
            let mp = f64::from(r.width) * f64::from(r.height) / 1e6;
            size = (r.width, r.height);
            let of_run = [
                (MEGAPIXELS, mp),
                (y, value(r)),
                ("total, ms", r.total_ms),
                ("total, CPU ms", r.stages.iter().map(|s| s.cpu_ms).sum::<f64>()),
                ("ms per megapixel", r.total_ms / mp),
                ("bytes of memory per pixel", r.peak_rss_bytes as f64 / (mp * 1e6)),
                ("planes per tile", r.planes_per_tile),
            ];
            for (name, value) in of_run {
                f.add_run(name, 0, value);
            }
            r.stages.iter().for_each(|s| f.add_run(&format!("{}, ms", s.name), 0, s.ms));
        }
        f.point(format!("{}×{}", size.0, size.1), (MEGAPIXELS, y))
    };
    let points: Vec<_> = sizes.iter().map(point).collect();
    let slope = match (points.first(), points.last()) {
        (Some(a), Some(b)) if b.x > a.x => (b.y - a.y) / (b.x - a.x),
        _ => 0.0,
    };
    Experiment {
        id: id.into(),
        title: title.into(),
        about: format!(
            "One rendered scene, enlarged to each size and processed with its disparity in processes of their own. From the smallest to the largest: {slope:.1} per megapixel."
        ),
        x: Axis::new(MEGAPIXELS, true, None),
        y: Axis::new(y, true, Some(false)),
        curves: vec![Curve { name: "defaults".into(), points }],
    }
}

fn write(folder: &Path, photo: &Photo, disparity: &DisparityMap) -> Result<(), LabError> {
    files::write(&folder.join(PHOTO), &encode_jpeg(photo.width, photo.height, photo.rgb.as_flattened(), 85)?)?;
    files::write(&folder.join(DISPARITY), &to_png(disparity)?)
}

/// Runs `tmpi make` on them in a new process, because the peak memory of a process never decreases.
fn report(program: &Path, folder: &Path) -> Result<Report, LabError> {
    let [file, depth, out, report] = [PHOTO, DISPARITY, "o.tmpi", "r.json"].map(|name| folder.join(name));
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

/// The reports of all runs at each size.
fn measured(megapixels: &[f64], repeats: usize) -> Result<Vec<Vec<Report>>, LabError> {
    let scene = scenes::Scene::framed(900_100, BASE.0, BASE.1);
    let picture = scene.render(&scene.camera(), 1);
    let (program, folder) = (program()?, tempfile::tempdir().map_err(|e| LabError::file(&std::env::temp_dir(), e))?);
    let folders: Vec<PathBuf> = (0..megapixels.len()).map(|i| folder.path().join(i.to_string())).collect();
    for (mp, folder) in megapixels.iter().zip(&folders) {
        let width = (mp * 1e6 * 1.5).sqrt().round();
        write(folder, &resize(&picture.photo, width as u32, (width / 1.5).round() as u32), &picture.disparity)?;
    }
    let mut all = vec![Vec::new(); folders.len()];
    in_turns(folders.len(), repeats, |i, _| {
        let made = report(&program, &folders[i])?;
        let ms = made.total_ms;
        all[i].push(made);
        Ok(ms)
    })?;
    Ok(all)
}
