//! Compares second views with the truth, for each way to make a scene from a photo and its depth (paper, section 5, table 1).

mod cases;
mod error_sources;
pub mod mesh;
mod public_datasets;
mod score;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use image::ExtendedColorType;
use serde::Serialize;

use self::cases::{Case, Truth};
use self::error_sources::Parts;
pub use self::error_sources::Sources;
pub use self::score::{DepthScore, Score};
use self::score::{Fit, Mask};
use crate::table::table;
use crate::{LabError, files};
use tmpi_core::{Camera, DisparityMap, Intrinsics, Photo, Pose};
use tmpi_pipeline::networks::{Config, Session};
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::{self, Denoise, Models, Options, PlaneCount, PlaneMethod, Silent, Switch, TileSize, depth};
use tmpi_render::{Cpu, Renderer};
use tmpi_testing::pictures::png;

/// Maximum share of blank pixels among a view's scored pixels. If any way exceeds it, the view does not count (paper, section 5).
const BLANK: f64 = 0.15;
/// Where depth comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Depth {
    /// The depth network.
    Own,
    /// The scene's true disparity.
    #[default]
    True,
}

/// Ways with another width of the band of mattes, in pixels; they run only if they are named.
const BANDS: [(&str, usize); 4] = [("ours-matte-0", 0), ("ours-matte-1", 1), ("ours-matte-3", 3), ("ours-matte-4", 4)];

/// Ways by name; `None` draws the photo as a mesh.
fn ways() -> Vec<(&'static str, Option<Options>)> {
    let with = |change: fn(&mut Options)| {
        let mut options = Options::default();
        change(&mut options);
        Some(options)
    };
    let mut ways = vec![
        ("mesh", None),
        ("mpi-32", with(|o| (o.tile, o.planes, o.plane_method) = (TileSize::Full, PlaneCount::Fixed(32), PlaneMethod::Linear))),
        ("mpi-64", with(|o| (o.tile, o.planes, o.plane_method) = (TileSize::Full, PlaneCount::Fixed(64), PlaneMethod::Linear))),
        ("tmpi-linear", with(|o| (o.planes, o.plane_method) = (PlaneCount::Fixed(4), PlaneMethod::Linear))),
        ("tmpi-lloyd", with(|o| (o.planes, o.plane_method) = (PlaneCount::Fixed(4), PlaneMethod::Lloyd))),
        ("ours-plain", with(|o| (o.denoise, o.refine, o.snap) = (Denoise::Off, Switch::Off, Switch::Off))),
        ("ours-refined", with(|o| o.refine = Switch::On)),
        ("ours", with(|_| {})),
    ];
    ways.extend(BANDS.map(|(name, _)| (name, with(|_| {}))));
    ways
}

#[derive(Clone, Debug, Default, Serialize)]
pub struct Row {
    pub way: &'static str,
    /// Mean over all views that count.
    pub score: Score,
    pub sources: Sources,
    /// Wall time to make a scene, in ms; includes depth if it is estimated.
    pub make_ms: f64,
    /// Wall time to draw a view on the processor, in ms.
    pub draw_ms: f64,
    /// Size of the sent data, in bytes.
    pub bytes: f64,
    /// Texels of all layers, or vertices, in millions.
    pub texels_m: f64,
    /// Mean number of planes per tile.
    pub planes: f64,
    /// Score of each scene, by name.
    pub scenes: Vec<(String, Score)>,
}

#[derive(Clone, Debug, Serialize)]
pub struct Results {
    pub depth: Depth,
    /// Number of views that count.
    pub views: usize,
    /// Number of views that do not count, because some way leaves too much of them blank.
    pub blank: usize,
    pub rows: Vec<Row>,
    /// Score of the estimated disparity; `None` if the true disparity was used.
    pub depth_score: Option<DepthScore>,
}

/// A view drawn in one way: colours, and which pixels are blank.
struct Drawn {
    rgb: Vec<[u8; 3]>,
    blank: Vec<bool>,
}

/// A scene made in one way, ready to be drawn.
enum Model {
    Mesh(Box<(Photo, DisparityMap)>),
    Layers(Arc<tmpi_core::Scene>, Cpu),
}

struct Made {
    model: Model,
    row: Row,
    disparity: DisparityMap,
}

/// Settings of a measurement.
#[derive(Clone, Debug, clap::Args)]
pub struct Settings {
    /// Source of depth
    #[arg(long, value_enum, default_value_t, value_name = "DEPTH")]
    pub depth: Depth,
    /// Run only these methods
    #[arg(long, value_delimiter = ',', value_parser = ways().into_iter().map(|way| way.0).collect::<Vec<_>>(), value_name = "WAY,…")]
    pub only: Vec<String>,
    /// Also compute LPIPS with this network: an ONNX file with two inputs [1, 3, height, width] in −1 to 1
    #[arg(long, value_name = "FILE.onnx")]
    pub lpips: Option<PathBuf>,
    /// Write the true views and those of each method to this folder
    #[arg(long, value_name = "DIR")]
    pub files: Option<PathBuf>,
}

/// Measures the named ways, or all of them, on all scenes below the folders.
pub fn run(models: &Models, folders: &[PathBuf], settings: &Settings, progress: &dyn Fn(&str)) -> Result<Results, LabError> {
    let Settings { depth, only, lpips, files } = settings;
    let depth = *depth;
    let lpips = lpips.as_deref().map(lpips_network).transpose()?;
    // without names, measures every way whose networks are available; a named way fails without its networks
    let possible = |options: &Option<Options>| options.as_ref().is_none_or(|o| models.check(o).is_ok());
    let is_band = |name: &str| BANDS.iter().any(|band| band.0 == name);
    let wanted = |name: &str, options: &Option<Options>| {
        if only.is_empty() { possible(options) && !is_band(name) } else { only.iter().any(|o| o == name) }
    };
    let chosen: Vec<_> = ways().into_iter().filter(|(name, options)| wanted(name, options)).collect();
    let mut rows: Vec<Row> = chosen.iter().map(|(way, _)| Row { way, ..Row::default() }).collect();
    let mut scores: Vec<Vec<Score>> = vec![Vec::new(); rows.len()];
    let mut sources: Vec<Vec<Sources>> = vec![Vec::new(); rows.len()];
    let (mut blank, mut views, mut depth_scores, mut cases) = (0, 0, Vec::new(), 0.0);
    for folder in folders {
        for case in cases::read(folder, models.depth.as_ref())? {
            progress(&case.name);
            cases += 1.0;
            let all: Vec<Made> =
                chosen.iter().map(|(way, options)| made(models, &case, way, options.as_ref(), depth)).collect::<Result<_, _>>()?;
            if let (Depth::Own, Some(first)) = (depth, all.first()) {
                depth_scores.push(DepthScore::new(&first.disparity, &case.truth));
            }
            let photo = photo(&case)?;
            let mut own: Vec<Vec<Score>> = vec![Vec::new(); all.len()];
            for (view, truth) in case.views.iter().enumerate() {
                let warp = mesh::warp(&photo, &case.truth, &case.intrinsics, &truth.camera, mesh::LONGEST);
                let mask = Mask::new(truth.camera.width as usize, &warp.depth);
                let parts = Parts::new(&warp, &truth.camera);
                let folder = files.as_ref().map(|folder| folder.join(&case.name).join(view.to_string()));
                if let Some(folder) = &folder {
                    written(folder, "true", &truth.camera, &truth.rgb)?;
                }
                let scored = |m: &Made| scored(m, &case, truth, (&mask, &parts), depth, lpips.as_ref(), folder.as_deref());
                let drawn: Vec<Scored> = all.iter().map(scored).collect::<Result<_, _>>()?;
                if drawn.iter().any(|d| d.blank > BLANK) {
                    blank += 1;
                    continue;
                }
                views += 1;
                for (i, d) in drawn.into_iter().enumerate() {
                    own[i].push(d.score);
                    sources[i].push(d.sources);
                    rows[i].draw_ms += d.ms;
                }
            }
            for ((row, made), own) in rows.iter_mut().zip(&all).zip(&own) {
                row.make_ms += made.row.make_ms;
                row.bytes += made.row.bytes;
                row.texels_m += made.row.texels_m;
                row.planes += made.row.planes;
                row.scenes.push((case.name.clone(), Score::mean(own)));
            }
            scores.iter_mut().zip(own).for_each(|(all, own)| all.extend(own));
        }
    }
    for ((row, scores), sources) in rows.iter_mut().zip(&scores).zip(&sources) {
        (row.score, row.sources) = (Score::mean(scores), Sources::mean(sources));
        row.draw_ms /= f64::from(u32::try_from(views).unwrap_or(u32::MAX)).max(1.0);
        for v in [&mut row.make_ms, &mut row.bytes, &mut row.texels_m, &mut row.planes] {
            *v /= cases;
        }
    }
    Ok(Results { depth, views, blank, rows, depth_score: DepthScore::mean(&depth_scores) })
}

/// Loads the network of an ONNX file, which must take two pictures.
fn lpips_network(path: &Path) -> Result<Session, LabError> {
    let session = Session::load("lpips", &files::read(path)?, &[], &Config::default())?;
    if session.inputs().len() != 2 {
        return Err(LabError::file(path, format!("it has {} inputs; a network for LPIPS has two", session.inputs().len())));
    }
    Ok(session)
}

fn photo(case: &Case) -> Result<Photo, LabError> {
    let path = Path::new(&case.name);
    let photo = decoded(&case.photo, path)?;
    if (photo.width, photo.height) != (case.truth.width, case.truth.height) {
        return Err(LabError::file(path, "photo and disparity have different sizes"));
    }
    Ok(photo)
}

fn decoded(file: &[u8], path: &Path) -> Result<Photo, LabError> {
    let decoded = image::load_from_memory(file).map_err(|e| LabError::file(path, e))?.into_rgb8();
    Ok(Photo { width: decoded.width(), height: decoded.height(), rgb: decoded.pixels().map(|p| p.0).collect() })
}

fn made(models: &Models, case: &Case, way: &'static str, options: Option<&Options>, depth: Depth) -> Result<Made, LabError> {
    let given = (depth == Depth::True).then(|| depth::to_png(&case.truth)).transpose()?;
    // a mesh takes the depth as it is
    let plain = Options { denoise: Denoise::Off, snap: Switch::Off, planes: PlaneCount::Fixed(1), ..Options::default() };
    let options =
        Options { fov_x: Some(case.intrinsics.fov_x(case.truth.width)), view_box: case.view_box(), ..options.unwrap_or(&plain).clone() };
    let done = tmpi_pipeline::make(models, &Limits::default(), &case.photo, given.as_deref(), &options, &Silent)
        .map_err(|source| LabError::Make { subject: case.name.clone(), source })?;
    let mut row = Row { way, planes: done.report.planes_per_tile, ..Row::default() };
    if way == "mesh" {
        let own = done.report.stages.iter().filter(|s| ["photo", "depth"].contains(&s.name.as_str()));
        row.make_ms = own.map(|s| s.ms).sum();
        row.bytes = (done.report.bytes.photo + depth::to_png(&done.disparity)?.len()) as f64;
        row.texels_m = done.disparity.delta.len() as f64 / 1e6;
        row.planes = 0.0;
        return Ok(Made { model: Model::Mesh(Box::new((photo(case)?, done.disparity.clone()))), row, disparity: done.disparity });
    }
    let scene = Arc::new(match BANDS.iter().find(|band| band.0 == way) {
        Some((_, band)) => crate::ghosts::with_band(&done.container, *band)?.0,
        None => tmpi_core::container::decode(&done.container)?,
    });
    row.make_ms = done.report.total_ms;
    row.bytes = done.container.len() as f64;
    row.texels_m = scene.texels.class.len() as f64 / 1e6;
    // a viewer prepares a scene only once, so preparation does not count as part of a view's time
    let cpu = Cpu::default();
    cpu.render(&scene, &Camera { pose: Pose::default(), intrinsics: scene.intrinsics, width: 1, height: 1 })?;
    Ok(Made { model: Model::Layers(scene, cpu), row, disparity: done.disparity })
}

fn draw(made: &Made, reference: &Intrinsics, camera: &Camera) -> Result<Drawn, LabError> {
    Ok(match &made.model {
        Model::Mesh(parts) => {
            // like viewers of depth maps: a sheet that is stretched, not torn
            let warp = mesh::warp(&parts.0, &parts.1, reference, camera, f64::INFINITY);
            Drawn { blank: (0..warp.rgb.len()).map(|i| !warp.covers(i)).collect(), rgb: warp.rgb }
        }
        Model::Layers(scene, cpu) => {
            let view = cpu.render(scene, camera)?;
            Drawn { rgb: view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect(), blank: view.rgba.iter().map(|p| p[3] < 128).collect() }
        }
    })
}

struct Scored {
    score: Score,
    sources: Sources,
    /// Share of the scored pixels that are blank.
    blank: f64,
    /// Time to draw the view, in ms.
    ms: f64,
}

fn scored(
    made: &Made,
    case: &Case,
    truth: &Truth,
    (mask, parts): (&Mask, &Parts),
    depth: Depth,
    lpips: Option<&Session>,
    folder: Option<&Path>,
) -> Result<Scored, LabError> {
    let camera = if depth == Depth::Own { seen(&truth.camera, Fit::new(&made.disparity, &case.truth)) } else { truth.camera };
    let start = Instant::now();
    let drawn = draw(made, &case.intrinsics, &camera)?;
    let ms = start.elapsed().as_secs_f64() * 1e3;
    if let Some(folder) = folder {
        written(folder, made.row.way, &camera, &drawn.rgb)?;
    }
    let mut score = mask.score(&drawn.rgb, &truth.rgb);
    score.lpips = lpips.map(|network| mask.lpips(network, &drawn.rgb, &truth.rgb)).transpose()?;
    let sources = parts.sources(&drawn.rgb, &truth.rgb, &mask.inside);
    Ok(Scored { score, sources, blank: mask.share(|i| drawn.blank[i]), ms })
}

fn written(folder: &Path, name: &str, camera: &Camera, rgb: &[[u8; 3]]) -> Result<(), LabError> {
    let path = folder.join(format!("{name}.png"));
    files::write(&path, &png(camera.width, camera.height, rgb.as_flattened(), ExtendedColorType::Rgb8))
}

/// The camera that sees a scene of estimated disparity δ as `camera` sees the true scene. The estimate has neither scale nor zero; the true
/// disparity is `scale · δ + shift`. The shift in `x̂ + t (scale · δ + shift)` becomes a change of intrinsics. Exact for cameras that do
/// not turn.
fn seen(camera: &Camera, fit: Fit) -> Camera {
    let (p, k) = (camera.pose, camera.intrinsics);
    let nearer = 1.0 / (1.0 - p.tz * fit.shift);
    let step = nearer * fit.scale;
    let (fx, fy) = (k.fx * nearer, k.fy * nearer);
    let intrinsics = Intrinsics { fx, fy, cx: k.cx - fx * p.tx * fit.shift, cy: k.cy - fy * p.ty * fit.shift };
    Camera { pose: Pose { tx: p.tx * step, ty: p.ty * step, tz: p.tz * step, ..p }, intrinsics, ..*camera }
}

impl Results {
    pub fn table(&self) -> String {
        use std::fmt::Write;
        let mut out = format!("{} views", self.views);
        if self.blank > 0 {
            let _ = write!(out, ", {} left out: more than {:.0} % blank in some way", self.blank, 100.0 * BLANK);
        }
        let _ = writeln!(out, "; depth: {}", if self.depth == Depth::Own { "estimated" } else { "true" });
        let head = ["way", "PSNR", "borders", "uncovered", "SSIM", "L1", "FLIP", "LPIPS", "make ms", "view ms", "KB", "Mtexel", "planes"];
        let line = |r: &Row| {
            let s = r.score;
            let [psnr, borders, uncovered] = [s.psnr, s.borders, s.uncovered].map(|v| format!("{v:.2}"));
            let [ssim, l1, flip] = [s.ssim, s.l1, s.flip].map(|v| format!("{v:.4}"));
            let lpips = s.lpips.map_or("-".into(), |v| format!("{v:.4}"));
            let [make, draw] = [format!("{:.0}", r.make_ms), format!("{:.1}", r.draw_ms)];
            let [kb, texels, planes] = [format!("{:.1}", r.bytes / 1e3), format!("{:.2}", r.texels_m), format!("{:.2}", r.planes)];
            vec![r.way.into(), psnr, borders, uncovered, ssim, l1, flip, lpips, make, draw, kb, texels, planes]
        };
        out += &table(1, &head, self.rows.iter().map(line));
        out += &error_sources::table(self.depth, &self.rows);
        if let Some(d) = self.depth_score {
            let _ = write!(
                out,
                "depth, scaled and shifted to fit: AbsRel {:.3}, RMSE {:.3} of the deviation, δ<1.25 {:.1} %, Spearman {:.3}",
                d.abs_rel,
                d.rmse,
                100.0 * d.within_125,
                d.spearman
            );
        }
        out.trim_end().to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_core::homography;

    #[test]
    fn a_camera_sees_estimated_disparity_where_the_other_sees_the_true_one() {
        let k = Intrinsics::centred(100, 60, 80.0);
        let camera = Camera { pose: Pose::at(0.05, -0.03, 0.04), intrinsics: k, width: 100, height: 60 };
        let fit = Fit { scale: 0.7, shift: -0.15 };
        let other = seen(&camera, fit);
        for delta in [0.0, 0.3, 1.0] {
            let at = |camera: &Camera, delta: f64| {
                let h = homography([0.0, 0.0, delta], &k, camera);
                let p = h.map(|row| row[0] * 12.5 + row[1] * 44.5 + row[2]);
                (p[0] / p[2], p[1] / p[2])
            };
            let (want, got) = (at(&camera, fit.scale * delta + fit.shift), at(&other, delta));
            assert!((want.0 - got.0).abs() < 1e-9 && (want.1 - got.1).abs() < 1e-9, "{want:?} {got:?}");
        }
    }
}
