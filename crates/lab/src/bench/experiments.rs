//! Definitions of the experiments.

use super::measure::{Bench, Depth, Setting};
use super::subject::Subject;
use super::{Axis, Curve, Experiment, Figures, Log, Point};
use crate::LabError;
use tmpi_core::{DisparityMap, ViewBox};
use tmpi_pipeline::{Denoise, Options, PlaneCount, PlaneMethod, TileSize, networks};

const MS: Axis = Axis::new("processing, ms", true, Some(false));
pub(super) const VIEW: Axis = Axis::new("view, dB", false, Some(true));
const PARALLAX: Axis = Axis::new("parallax error, px", true, Some(false));
pub(super) const KB: Axis = Axis::new("container, KB", true, Some(false));

pub(super) const METHODS: [(&str, PlaneMethod); 4] =
    [("linear", PlaneMethod::Linear), ("lloyd", PlaneMethod::Lloyd), ("optimal", PlaneMethod::Optimal), ("slanted", PlaneMethod::Slanted)];

/// A setting to measure: one point of a curve.
pub(super) struct Set {
    /// The setting as on the command line.
    pub words: String,
    pub options: Options,
    pub depth: Depth,
    /// Level of the container to measure.
    pub level: u8,
    /// Position on the horizontal axis, if that shows the setting itself.
    pub at: Option<f64>,
    pub default: bool,
}

impl Set {
    pub fn new(words: impl Into<String>, options: Options, depth: Depth) -> Self {
        let default = options == Options::default();
        Self { words: words.into(), options, depth, level: 0, at: None, default }
    }
}

pub(super) struct Plan {
    pub id: &'static str,
    pub title: &'static str,
    pub about: &'static str,
    pub axes: (Axis, Axis),
    pub curves: Vec<(&'static str, Vec<Set>)>,
}

impl Plan {
    /// Measures each setting on all subjects.
    pub fn run(self, bench: &Bench, subjects: &[Subject]) -> Result<Experiment, LabError> {
        let (x, y) = self.axes;
        let settings: Vec<Setting> = self.curves.iter().flat_map(|(_, sets)| sets).map(|s| (&s.depth, &s.options, s.level)).collect();
        let mut measured = bench.figures(subjects, &settings)?.into_iter();
        let curve = |(name, sets): &(&str, Vec<Set>)| {
            let point = |(set, f): (&Set, Figures)| {
                let p = f.point(set.words.clone(), (&x.label, &y.label));
                Point { default: set.default, x: set.at.unwrap_or(p.x), ..p }
            };
            Curve { name: (*name).into(), points: sets.iter().zip(measured.by_ref()).map(point).collect() }
        };
        let curves = self.curves.iter().map(curve).collect();
        Ok(Experiment { id: self.id.into(), title: self.title.into(), about: self.about.into(), x, y, curves })
    }
}

fn known(setting: impl Into<String>, change: impl FnOnce(&mut Options)) -> Set {
    let mut options = Options::default();
    change(&mut options);
    Set::new(setting, options, Depth::Known)
}

fn errors(quick: bool) -> Vec<Set> {
    let all: &[f64] = if quick { &[0.5, 1.0, 1.75, 3.5, 7.0] } else { &[0.35, 0.5, 0.75, 1.0, 1.4, 1.75, 2.5, 3.5, 7.0, 14.0] };
    all.iter().map(|&e| known(format!("--max-error {e}"), |o| o.max_error = e)).collect()
}

fn counts(method: PlaneMethod, name: &str, counts: &[u32], tile: TileSize) -> Vec<Set> {
    let one = |&n: &u32| {
        known(format!("--plane-method {name} --planes {n}"), |o| {
            (o.plane_method, o.planes, o.tile) = (method, PlaneCount::Fixed(n), tile);
        })
    };
    counts.iter().map(one).collect()
}

fn planes(quick: bool, axes: (Axis, Axis)) -> Plan {
    let n: &[u32] = if quick { &[1, 2, 4, 8] } else { &[1, 2, 3, 4, 6, 8, 12] };
    let mut curves: Vec<_> = METHODS.map(|(name, m)| (name, counts(m, name, n, TileSize::Pixels(64)))).into();
    curves.push(("slanted, by error", vec![known("--planes auto", |_| {})]));
    Plan {
        id: "planes",
        title: "Planes: method and number",
        about: "A fixed number of planes per tile by each method, and the fewest slanted planes that meet the parallax error.",
        axes,
        curves,
    }
}

/// The error that planes may leave.
fn max_error(quick: bool, axes: (Axis, Axis)) -> Plan {
    Plan {
        id: "max-error",
        title: "Largest parallax error",
        about: "How many pixels planes may misplace a point, at the corners of the view box. A smaller error takes more planes.",
        axes,
        curves: vec![("slanted, by error", errors(quick))],
    }
}

/// Tile size by number of planes, as in the paper's figure.
fn tiles(quick: bool) -> Plan {
    let sizes: &[(&'static str, TileSize)] = &[
        ("tiles of 32", TileSize::Pixels(32)),
        ("tiles of 64", TileSize::Pixels(64)),
        ("tiles of 128", TileSize::Pixels(128)),
        ("tiles of 256", TileSize::Pixels(256)),
    ];
    let errors: &[f64] = if quick { &[1.0, 3.5, 14.0] } else { &[1.0, 1.75, 3.5, 7.0, 14.0] };
    let of = |&(name, tile): &(&'static str, TileSize)| {
        let one = |&e: &f64| known(format!("{name}, --max-error {e}"), |o| (o.tile, o.max_error) = (tile, e));
        (name, errors.iter().map(one).collect())
    };
    let full: &[u32] = if quick { &[8, 32] } else { &[4, 8, 16, 32, 64] };
    let mut curves: Vec<_> = sizes.iter().map(of).collect();
    curves.push(("one tile, fronto-parallel", counts(PlaneMethod::Lloyd, "lloyd --tile full", full, TileSize::Full)));
    Plan {
        id: "tiles",
        title: "Tile size",
        about: "Slanted planes on tiles of several sizes, and ordinary multiplane images: one tile with many fronto-parallel planes.",
        axes: (MS, VIEW),
        curves,
    }
}

/// Adds Gaussian noise of variance 1e-3 from a fixed generator.
pub(super) fn noisy(map: &DisparityMap) -> DisparityMap {
    let mut state = 1u64;
    let mut uniform = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((state >> 40) as f32 + 0.5) / (1u64 << 24) as f32
    };
    let mut noise = || (-2.0 * uniform().ln()).sqrt() * (std::f32::consts::TAU * uniform()).cos() * 1e-3f32.sqrt();
    DisparityMap { delta: map.delta.iter().map(|d| (d + noise()).clamp(0.0, 1.0)).collect(), ..*map }
}

/// Blurs with a box of 5×5 pixels, similar to what networks do to edges.
pub(super) fn blurred(map: &DisparityMap) -> DisparityMap {
    box_blurred(map, 2)
}

/// Box blur over `(2r+1)²` pixels, fewer at borders.
pub(super) fn box_blurred(map: &DisparityMap, r: usize) -> DisparityMap {
    let (w, h) = (map.width as usize, map.height as usize);
    let mean = |i: usize| {
        let (x, y) = (i % w, i / w);
        let (rows, columns) = (y.saturating_sub(r)..(y + r + 1).min(h), x.saturating_sub(r)..(x + r + 1).min(w));
        let n = (rows.len() * columns.len()) as f32;
        rows.map(|y| map.delta[y * w + columns.start..y * w + columns.end].iter().sum::<f32>()).sum::<f32>() / n
    };
    DisparityMap { delta: (0..w * h).map(mean).collect(), ..*map }
}

/// Cleaning methods. `theta`: whether the network Θ is available.
fn denoise(theta: bool) -> Plan {
    let of = |depth: &Depth| {
        [("off", Denoise::Off), ("classic", Denoise::Classic), ("auto", Denoise::Auto), ("theta", Denoise::Theta)]
            .into_iter()
            .filter(|(_, d)| theta || *d != Denoise::Theta)
            .map(|(name, d)| Set::new(format!("--denoise {name}"), Options { denoise: d, ..Options::default() }, depth.clone()))
            .collect()
    };
    Plan {
        id: "denoise",
        title: "Disparity cleaning",
        about: "No cleaning, a median with a guided filter, planes fitted where the map is damaged (auto), and the network Θ, with noise of variance 1e-3 and with blurred edges.",
        axes: (MS, VIEW),
        curves: vec![("noisy disparity", of(&Depth::Degraded(noisy))), ("blurred disparity", of(&Depth::Degraded(blurred)))],
    }
}

fn quality(quick: bool) -> Plan {
    let all: &[u8] = if quick { &[60, 80, 90, 100] } else { &[30, 50, 60, 70, 80, 85, 90, 95, 100] };
    Plan {
        id: "quality",
        title: "Picture quality",
        about: "Size of the container, and similarity of its views to the exact ones.",
        axes: (KB, VIEW),
        curves: vec![("quality", all.iter().map(|&q| known(format!("--quality {q}"), |o| o.quality = q)).collect())],
    }
}

fn prune(quick: bool) -> Plan {
    let all: &[f64] = if quick { &[0.125, 0.5, 1.0] } else { &[0.125, 0.25, 0.5, 1.0, 2.0] };
    let one = |&s: &f64| {
        let v = scaled(s);
        let words = format!("--view-box {},{},{} --verify-prune", v.x, v.y, v.z);
        Set { default: v == Options::VIEW_BOX, ..known(words, |o| (o.view_box, o.verify_prune) = (v, true)) }
    };
    Plan {
        id: "prune",
        title: "Pruning of unseen texels",
        about: "Pixels of which pruned texels would take more than 8 levels of 255, at the corners and side centres of the view box; the worst of these cameras.",
        axes: (Axis::new("texels per pixel", false, Some(false)), Axis::new("wrongly pruned, % of pixels", false, Some(false))),
        curves: vec![("view box", all.iter().map(one).collect())],
    }
}

/// A multiple of the default view box.
pub(super) fn scaled(by: f64) -> ViewBox {
    let usual = Options::VIEW_BOX;
    ViewBox { x: usual.x * by, y: usual.y * by, z: usual.z * by }
}

fn view_box(quick: bool) -> Plan {
    let all: &[f64] = if quick { &[0.5, 1.0, 2.0] } else { &[0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 4.0] };
    let one = |&s: &f64| {
        let v = scaled(s);
        known(format!("--view-box {},{},{}", v.x, v.y, v.z), |o| o.view_box = v)
    };
    Plan {
        id: "view-box",
        title: "View box",
        about: "How far cameras may move from the photo's camera, at the same parallax error: costs, and similarity of views within half of the default box to the exact ones.",
        axes: (KB, VIEW),
        curves: vec![("view box", all.iter().map(one).collect())],
    }
}

/// Photos reduced before processing, and containers reduced afterwards.
fn sizes(quick: bool) -> [Plan; 2] {
    let all: &[u32] = if quick { &[96, 192] } else { &[96, 160, 240, 360, 480] };
    let mut smaller: Vec<Set> = all.iter().map(|&n| known(format!("--max-size {n}"), |o| o.max_size = Some(n))).collect();
    smaller.push(known("original size", |_| {}));
    let level = |level: u8| Set { level, default: level == 0, ..known(format!("level {level}"), |_| {}) };
    [
        Plan {
            id: "size",
            title: "Largest side",
            about: "The photo is reduced before processing; views are rendered at its original size.",
            axes: (MS, VIEW),
            curves: vec![("largest side", smaller)],
        },
        Plan {
            id: "levels",
            title: "Levels of a container",
            about: "A container at 1, 1/2, 1/4 and 1/8 of its size, as for small screens and slow connections; views are rendered at the photo's original size.",
            axes: (KB, VIEW),
            curves: vec![("levels", (0..=tmpi_core::container::LEVELS).map(level).collect())],
        },
    ]
}

/// Shortens a reason to the part before its list of searched paths.
pub(super) fn brief(reason: &impl std::fmt::Display) -> String {
    reason.to_string().split(':').next().unwrap_or_default().to_owned()
}

pub(super) fn on_scenes(bench: &Bench, scenes: &[Subject], log: &mut Log) -> Result<(), LabError> {
    let quick = log.settings.flags.quick;
    // warm-up: the first run of a process pays for threads and memory
    if let Some(scene) = scenes.first() {
        bench.runs(scene, &Depth::Known, &Options::default())?;
    }
    let mut plans =
        vec![max_error(quick, (MS, VIEW)), planes(quick, (MS, VIEW)), tiles(quick), quality(quick), prune(quick), view_box(quick)];
    plans.extend(sizes(quick));
    if let Err(reason) = networks::available() {
        log.results.skipped.push(format!("denoise networks: {}", brief(&reason)));
    } else {
        plans.push(denoise(bench.models.theta.is_some()));
    }
    plans.into_iter().try_for_each(|plan| log.run(plan.id, || plan.run(bench, scenes)))
}

pub(super) fn on_photos(bench: &Bench, photos: &[Subject], log: &mut Log) -> Result<(), LabError> {
    if let Err(reason) = networks::available() {
        log.results.skipped.push(format!("photos: {}", brief(&reason)));
        return Ok(());
    }
    let mut plan = Plan { id: "photos", title: "Planes on photos", ..planes(true, (MS, PARALLAX)) };
    if let Some((_, by_error)) = plan.curves.last_mut() {
        *by_error = errors(true);
    }
    log.run(plan.id, || plan.run(bench, photos))
}
