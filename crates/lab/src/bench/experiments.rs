//! What is varied.

use super::measure::{Bench, Depth};
use super::subject::Subject;
use super::{Axis, BenchError, Curve, Experiment, Point, Settings};
use tmpi_core::{DisparityMap, ViewBox};
use tmpi_pipeline::networks;
use tmpi_pipeline::{Denoise, Options, PlaneCount, PlaneMethod, Switch, TileSize};

const MS: Axis = Axis { label: "making, ms", log: true, up: Some(false) };
const VIEW: Axis = Axis { label: "view, dB", log: false, up: Some(true) };
const PARALLAX: Axis = Axis { label: "parallax error, px", log: true, up: Some(false) };

const METHODS: [(&str, PlaneMethod); 4] =
    [("linear", PlaneMethod::Linear), ("lloyd", PlaneMethod::Lloyd), ("optimal", PlaneMethod::Optimal), ("slanted", PlaneMethod::Slanted)];

/// A point of a curve.
pub(super) struct Set {
    /// As on the command line.
    pub words: String,
    pub options: Options,
    pub depth: Depth,
    /// Level of the container that is looked at.
    pub level: u8,
    /// Place on the horizontal axis, where that is the setting itself.
    pub at: Option<f64>,
    /// It is what ships.
    pub default: bool,
}

impl Set {
    pub fn new(words: impl Into<String>, options: Options, depth: Depth) -> Self {
        let default = options == Options::default();
        Self { words: words.into(), options, depth, level: 0, at: None, default }
    }
}

/// One experiment to be.
pub(super) struct Plan {
    pub id: &'static str,
    pub title: &'static str,
    pub about: &'static str,
    pub axes: (Axis, Axis),
    pub curves: Vec<(&'static str, Vec<Set>)>,
}

impl Plan {
    fn run(self, bench: &Bench, subjects: &[Subject]) -> Result<Experiment, BenchError> {
        let (x, y) = self.axes;
        let mut curves = Vec::new();
        for (name, settings) in self.curves {
            let mut points: Vec<Point> = Vec::new();
            for Set { words, options, depth, level, at, default } in settings {
                let p = bench.point_of_level(subjects, &depth, &options, level, words, (x.label, y.label))?;
                points.push(Point { default, x: at.unwrap_or(p.x), ..p });
            }
            curves.push(Curve { name: name.into(), points });
        }
        Ok(Experiment { id: self.id, title: self.title.into(), about: self.about.into(), x, y, curves })
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

/// Plane placement by count and by error.
fn planes(quick: bool, axes: (Axis, Axis)) -> Plan {
    let n: &[u32] = if quick { &[1, 2, 4, 8] } else { &[1, 2, 3, 4, 6, 8, 12] };
    let mut curves: Vec<_> = METHODS.map(|(name, m)| (name, counts(m, name, n, TileSize::Pixels(64)))).into();
    curves.push(("slanted, by error", vec![known("--planes auto", |_| {})]));
    Plan {
        id: "planes",
        title: "Planes: how they are placed, and how many",
        about: "A fixed count of planes a tile by each method, and the fewest slanted planes that keep the parallax error.",
        axes,
        curves,
    }
}

/// The error that planes may leave.
fn max_error(quick: bool, axes: (Axis, Axis)) -> Plan {
    Plan {
        id: "max-error",
        title: "Largest parallax error",
        about: "How far, in pixels at the corners of the view box, planes may show a point from where it should be. A smaller error takes more planes.",
        axes,
        curves: vec![("slanted, by error", errors(quick))],
    }
}

/// The paper's figure: tile size by plane count.
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
        about: "Slanted planes on tiles of several sizes, and regular multiplane images: one tile, many fronto-parallel planes.",
        axes: (MS, VIEW),
        curves,
    }
}

/// Gaussian noise of variance 1e-3 by a fixed generator.
pub(super) fn noisy(map: &DisparityMap) -> DisparityMap {
    let mut state = 1u64;
    let mut uniform = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((state >> 40) as f32 + 0.5) / (1u64 << 24) as f32
    };
    let mut noise = || (-2.0 * uniform().ln()).sqrt() * (std::f32::consts::TAU * uniform()).cos() * 1e-3f32.sqrt();
    DisparityMap { delta: map.delta.iter().map(|d| (d + noise()).clamp(0.0, 1.0)).collect(), ..*map }
}

/// A box of 5×5 pixels: what networks do to edges.
pub(super) fn blurred(map: &DisparityMap) -> DisparityMap {
    box_blurred(map, 2)
}

/// Means over `(2r+1)²` pixels, fewer at borders.
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

/// Each step off, one at a time. `refined`: whether there is a network for it.
fn steps(refined: bool) -> Plan {
    let on = |setting: &str, change: &dyn Fn(&mut Options)| {
        let mut o = Options::default();
        change(&mut o);
        (setting.to_owned(), o)
    };
    let all = [
        on("defaults", &|_| {}),
        on("--snap off", &|o| o.snap = Switch::Off),
        on("--snap on", &|o| o.snap = Switch::On),
        on("--denoise classic", &|o| o.denoise = Denoise::Classic),
        on("--refine on", &|o| o.refine = Switch::On),
        on("--plane-method optimal", &|o| o.plane_method = PlaneMethod::Optimal),
        on("--plane-method lloyd --planes 4", &|o| (o.plane_method, o.planes) = (PlaneMethod::Lloyd, PlaneCount::Fixed(4))),
    ];
    let of = |depth: &Depth| {
        let there = all.iter().filter(|(_, o)| refined || o.refine != Switch::On);
        there.map(|(s, o)| Set::new(s.as_str(), o.clone(), depth.clone())).collect::<Vec<Set>>()
    };
    Plan {
        id: "steps",
        title: "Steps on and off",
        about: "One step changed at a time, on exact disparity and on disparity whose edges are blurred over 5 pixels.",
        axes: (MS, VIEW),
        curves: vec![("exact disparity", of(&Depth::Known)), ("blurred disparity", of(&Depth::Spoilt(blurred)))],
    }
}

/// `theta`: whether that network is there.
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
        title: "Cleaning of disparity",
        about: "Nothing, a median with a guided filter, fitted planes where the map is damaged (auto), and the network Θ, on noise of variance 1e-3 and on blurred edges.",
        axes: (MS, VIEW),
        curves: vec![("noisy disparity", of(&Depth::Spoilt(noisy))), ("blurred disparity", of(&Depth::Spoilt(blurred)))],
    }
}

fn quality(quick: bool) -> Plan {
    let all: &[u8] = if quick { &[60, 80, 90, 100] } else { &[30, 50, 60, 70, 80, 85, 90, 95, 100] };
    Plan {
        id: "quality",
        title: "Picture quality",
        about: "How large the container is, and how near its views are to the exact ones.",
        axes: (Axis { label: "container, KB", log: true, up: Some(false) }, VIEW),
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
        title: "Leaving out what is never seen",
        about: "Pixels that differ by more than 8 levels at the corners of the view box and the middles of its sides, drawn with and without the texels left out; the corner where they are most.",
        axes: (
            Axis { label: "texels for each pixel", log: false, up: Some(false) },
            Axis { label: "left out wrongly, % of pixels", log: false, up: Some(false) },
        ),
        curves: vec![("view box", all.iter().map(one).collect())],
    }
}

/// So many times the usual view box.
fn scaled(by: f64) -> ViewBox {
    let usual = Options::VIEW_BOX;
    ViewBox { x: usual.x * by, y: usual.y * by, z: usual.z * by }
}

/// How far cameras may go, by what it costs.
fn view_box(quick: bool) -> Plan {
    let all: &[f64] = if quick { &[0.5, 1.0, 2.0] } else { &[0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 4.0] };
    let one = |&s: &f64| {
        let v = scaled(s);
        known(format!("--view-box {},{},{}", v.x, v.y, v.z), |o| o.view_box = v)
    };
    Plan {
        id: "view-box",
        title: "View box",
        about: "How far from the photo's own place cameras may go, at the same parallax error: what it takes, and how near views within half of the usual box are to the exact ones.",
        axes: (Axis { label: "container, KB", log: true, up: Some(false) }, VIEW),
        curves: vec![("view box", all.iter().map(one).collect())],
    }
}

/// Photos made smaller before anything else, and containers made smaller afterwards.
fn sizes(quick: bool) -> [Plan; 2] {
    let all: &[u32] = if quick { &[96, 192] } else { &[96, 160, 240, 360, 480] };
    let mut smaller: Vec<Set> = all.iter().map(|&n| known(format!("--max-size {n}"), |o| o.max_size = Some(n))).collect();
    smaller.push(known("as it is", |_| {}));
    let level = |level: u8| Set { level, default: level == 0, ..known(format!("level {level}"), |_| {}) };
    [
        Plan {
            id: "size",
            title: "Largest side",
            about: "The photo reduced before it is made; views are drawn at the photo's own size.",
            axes: (MS, VIEW),
            curves: vec![("largest side", smaller)],
        },
        Plan {
            id: "levels",
            title: "Levels of a container",
            about: "A container at 1, 1/2, 1/4 and 1/8 of its size, as small screens and slow links get it; views are drawn at the photo's own size.",
            axes: (Axis { label: "container, KB", log: true, up: Some(false) }, VIEW),
            curves: vec![("levels", (0..=tmpi_core::container::LEVELS).map(level).collect())],
        },
    ]
}

/// The first words of a reason: a list of all places that were searched is of no use here.
pub(super) fn brief(reason: &impl std::fmt::Display) -> String {
    reason.to_string().split(':').next().unwrap_or_default().to_owned()
}

/// Experiments on scenes with exact views.
pub(super) fn on_scenes(
    bench: &Bench,
    scenes: &[Subject],
    settings: &Settings,
    skipped: &mut Vec<String>,
    progress: &dyn Fn(&str),
) -> Result<Vec<Experiment>, BenchError> {
    let quick = settings.quick;
    // the first run of a process pays for its threads and its memory
    bench.point(&scenes[..scenes.len().min(1)], &Depth::Known, &Options::default(), String::new(), ("", ""))?;
    let mut plans = vec![
        max_error(quick, (MS, VIEW)),
        planes(quick, (MS, VIEW)),
        tiles(quick),
        steps(bench.psi().is_some()),
        quality(quick),
        prune(quick),
        view_box(quick),
    ];
    plans.extend(sizes(quick));
    if let Err(reason) = networks::available() {
        skipped.push(format!("denoise networks: {}", brief(&reason)));
    } else {
        plans.push(denoise(bench.models.theta.is_some()));
    }
    run(bench, scenes, plans, settings, progress)
}

/// Those of the experiments that are asked for.
pub(super) fn run(
    bench: &Bench,
    subjects: &[Subject],
    plans: Vec<Plan>,
    settings: &Settings,
    progress: &dyn Fn(&str),
) -> Result<Vec<Experiment>, BenchError> {
    let mut all = Vec::new();
    for plan in plans.into_iter().filter(|p| settings.wants(p.id)) {
        progress(plan.title);
        all.push(plan.run(bench, subjects)?);
    }
    Ok(all)
}

/// Experiments on photos, whose disparity the network estimates.
pub(super) fn on_photos(
    bench: &Bench,
    photos: &[Subject],
    skipped: &mut Vec<String>,
    progress: &dyn Fn(&str),
) -> Result<Vec<Experiment>, BenchError> {
    if let Err(reason) = networks::available() {
        skipped.push(format!("photos: {}", brief(&reason)));
        return Ok(Vec::new());
    }
    let mut plan = Plan { id: "photos", title: "Planes on photos", ..planes(true, (MS, PARALLAX)) };
    if let Some((_, by_error)) = plan.curves.last_mut() {
        *by_error = errors(true);
    }
    progress(plan.title);
    Ok(vec![plan.run(bench, photos)?])
}
