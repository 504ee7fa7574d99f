//! Ablation: disables single steps of planes, layers and rendering, and measures the loss.

use std::sync::Arc;

use super::measure::{self, Bench, Figures};
use super::subject::{self, Subject};
use super::{Axis, BenchError, Curve, Experiment, Point};
use crate::eval::mesh;
use crate::scenes::hidden_colours;
use tmpi_core::TexturedLayer;
use tmpi_core::{Class, DisparityMap, Geometry, Grid, Intrinsics, LayerMasks, Photo, Rect, Scene, TileFrame};
use tmpi_pipeline::edges;
use tmpi_pipeline::layers;
use tmpi_pipeline::layers::refine;
use tmpi_pipeline::networks::Network;
use tmpi_pipeline::photo::{self, Limits};
use tmpi_pipeline::planes::{Method, NEIGHBOUR_COST, Placement, overlap_disagreement, place};
use tmpi_pipeline::{MakeError, Options, Parallax};
use tmpi_render::{Cpu, Reference, Renderer};

/// The step that is disabled or replaced.
#[derive(Clone, Copy, PartialEq, Default)]
pub(super) enum Without {
    #[default]
    Nothing,
    /// Uses the map without the median filter.
    Median,
    /// Leaves pixels of mixed colours on the side where the map has them.
    Rims,
    /// Applies the median also to pixels whose colour matches their side.
    FullMedian,
    /// Uses fronto-parallel planes with the same error bound.
    Slant,
    /// Assigns every pixel to its nearest plane.
    Smoothing,
    /// Adds no planes for background that is visible only in neighbouring tiles.
    Backgrounds,
    /// Has no texels behind the visible surface.
    Hidden,
    /// Keeps hidden texels in front of the visible surface.
    Trim,
    /// Keeps hidden texels that cannot be seen from the view box.
    Prune,
    /// Colours hidden texels with the photo's colour at the same pixel.
    Fill,
    /// Has no soft rims.
    Soft,
    /// Sorts every pixel of the view separately, in `f64`.
    Passes,
    /// Renders the photo as a mesh that is torn at stretched triangles.
    Planes,
    /// Lets Ψ colour hidden texels.
    Refined,
    /// Colours hidden texels from the exact surface if it lies on their plane: an upper bound for any Ψ.
    Known,
}

const ALL: [(&str, Without); 16] = [
    ("all steps", Without::Nothing),
    ("without the colour-weighted median", Without::Median),
    ("without moving rims to the near side", Without::Rims),
    ("colour-weighted median of every edge pixel", Without::FullMedian),
    ("without slant (optimal, same error)", Without::Slant),
    ("without label smoothing", Without::Smoothing),
    ("without backgrounds", Without::Backgrounds),
    ("without hidden texels", Without::Hidden),
    ("hidden texels in front of the surface too", Without::Trim),
    ("without pruning of unseen texels", Without::Prune),
    ("without inpainting: the photo's colour behind", Without::Fill),
    ("without soft rims", Without::Soft),
    ("rendered with a full sort of every pixel", Without::Passes),
    ("mesh of photo and disparity", Without::Planes),
    ("with Ψ", Without::Refined),
    ("with true hidden colours", Without::Known),
];

/// A decoded subject with its cleaned disparity.
pub(super) struct Prepared<'a> {
    subject: &'a Subject,
    photo: Photo,
    intrinsics: Intrinsics,
    given: DisparityMap,
    snapped: DisparityMap,
    psi: Option<&'a dyn Network>,
}

impl<'a> Prepared<'a> {
    pub(super) fn new(subject: &'a Subject, psi: Option<&'a dyn Network>) -> Result<Option<Self>, BenchError> {
        let Some(map) = &subject.disparity else { return Ok(None) };
        let fail = |e| BenchError::Make { subject: subject.name.clone(), source: MakeError::Photo(e) };
        let decoded = photo::decode(&subject.file, &Limits::default(), None).map_err(fail)?;
        let (photo, mut intrinsics) = (decoded.photo, decoded.intrinsics);
        if let Some(fov) = subject.fov_x {
            intrinsics = Intrinsics::from_fov_x(photo.width, photo.height, fov);
        }
        let given = DisparityMap::clone(map);
        let snapped = edges::clean(&photo, &given);
        Ok(Some(Self { subject, photo, intrinsics, given, snapped, psi }))
    }

    /// Planes, labels and backgrounds.
    fn geometry(&self, without: Without, neighbour: f32) -> Geometry {
        let options = Options::default();
        let (w, h) = (self.photo.width, self.photo.height);
        let grid = Grid::new(w, h, 64);
        let most = Parallax::new(self.intrinsics, options.view_box).most(Rect { x: 0, y: 0, w, h });
        let placement = options.placement(options.max_error, most);
        let placement = match without {
            Without::Slant => Placement { method: Method::Optimal, most: 64, ..placement },
            Without::Smoothing => Placement { neighbour: 0.0, ..placement },
            _ => Placement { neighbour, ..placement },
        };
        let map = match without {
            Without::Median => &self.given,
            Without::Rims => &edges::median(&self.photo, &self.given),
            Without::FullMedian => &edges::full_median(&self.photo, &self.given),
            _ => &self.snapped,
        };
        let tiles = place(map, None, &grid, &placement);
        let mut geometry = Geometry { grid, intrinsics: self.intrinsics, view_box: options.view_box, tiles, matted: false };
        if without != Without::Backgrounds {
            layers::add_backgrounds(&mut geometry, map);
        }
        geometry
    }

    fn scene(&self, geometry: &Geometry, without: Without) -> Result<Scene, BenchError> {
        let mut shapes = if without == Without::Prune { geometry.masks_unpruned() } else { geometry.masks() };
        for (class, alpha) in texels(&mut shapes) {
            let (hidden, soft) = (*class == Class::Hidden as u8, *class == Class::Photo as u8 && *alpha < 255);
            if (without == Without::Hidden && hidden) || (without == Without::Soft && soft) {
                (*class, *alpha) = (Class::Empty as u8, 0);
            } else if without == Without::Trim && *class == Class::Empty as u8 {
                (*class, *alpha) = (Class::Hidden as u8, 255);
            }
        }
        let mut coloured = tmpi_core::texture(&self.photo, geometry, shapes);
        if without == Without::Fill {
            coloured.iter_mut().flatten().for_each(|l| self.own_colours(l));
        }
        let fail = |e| BenchError::Make { subject: self.subject.name.clone(), source: MakeError::Generate(e) };
        match (without, self.psi, self.subject.seed) {
            (Without::Refined, Some(psi), _) => drop(refine::run(psi, &self.photo, geometry, &mut coloured).map_err(fail)?),
            (Without::Known, _, Some(seed)) => {
                let hidden = subject::hidden(seed, (self.photo.width, self.photo.height));
                coloured.iter_mut().zip(0..).for_each(|(t, i)| {
                    let place = TileFrame::of(&geometry.grid, i);
                    for l in t {
                        let known = hidden_colours::of_layer(&l.shape, place, &self.given, &hidden);
                        l.hidden.iter_mut().zip(known).for_each(|(c, k)| *c = k.unwrap_or(*c));
                    }
                });
            }
            _ => {}
        }
        Ok(tmpi_core::compose(self.photo.clone(), geometry, coloured))
    }

    fn own_colours(&self, l: &mut TexturedLayer) {
        let r = l.shape.rect;
        let hidden = l.shape.class.iter().enumerate().filter(|(_, c)| **c == Class::Hidden as u8);
        for ((i, _), colour) in hidden.zip(&mut l.hidden) {
            *colour = self.photo.at(r.x + i as u32 % r.w, r.y + i as u32 / r.w);
        }
    }

    /// Difference between neighbouring tiles in their overlap, in δ.
    pub(super) fn neighbour_difference(&self) -> f64 {
        let b = self.geometry(Without::Nothing, NEIGHBOUR_COST);
        overlap_disagreement(&b.grid, &b.tiles)
    }

    /// Measures one setting.
    fn figures(&self, without: Without, neighbour: f32) -> Result<Vec<(&'static str, f64)>, BenchError> {
        if without == Without::Planes {
            let views = self.subject.views.iter().map(|(camera, want)| {
                let warp = mesh::warp(&self.photo, &self.given, &self.intrinsics, camera, mesh::LONGEST);
                let uncovered = warp.covered.iter().filter(|c| !**c).count() as f64 / warp.covered.len() as f64;
                (measure::compared(&warp.rgb, want), uncovered)
            });
            return Ok(means(&views.collect::<Vec<_>>()));
        }
        let geometry = self.geometry(without, neighbour);
        let scene = Arc::new(self.scene(&geometry, without)?);
        let renderer: &dyn Renderer = if without == Without::Passes { &Reference } else { &Cpu::default() };
        let mut views = Vec::new();
        for (camera, want) in &self.subject.views {
            let view = renderer.render(&scene, camera)?;
            let rgb: Vec<[u8; 3]> = view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect();
            let uncovered = view.rgba.iter().filter(|p| p[3] < 128).count() as f64 / view.rgba.len() as f64;
            views.push((measure::compared(&rgb, want), uncovered));
        }
        let mut all = means(&views);
        let pixels = f64::from(self.photo.width) * f64::from(self.photo.height);
        all.push(("planes per tile", scene.layers.len() as f64 / f64::from(scene.grid.tiles())));
        all.push(("texels per pixel", scene.texels.class.iter().filter(|c| **c != 0).count() as f64 / pixels));
        all.push(("label changes, % of pixels", 100.0 * changes(&geometry)));
        Ok(all)
    }
}

/// PSNR, SSIM and L1 of a view, and its uncovered fraction.
type View = ([f64; 3], f64);

/// Means over all views.
fn means(views: &[View]) -> Vec<(&'static str, f64)> {
    let mean = |f: &dyn Fn(&View) -> f64| views.iter().map(f).sum::<f64>() / views.len().max(1) as f64;
    vec![
        ("view, dB", mean(&|v| v.0[0])),
        ("view SSIM", mean(&|v| v.0[1])),
        ("view L1", mean(&|v| v.0[2])),
        ("uncovered, % of pixels", 100.0 * mean(&|v| v.1)),
    ]
}

/// Class and alpha of every texel.
fn texels(shapes: &mut [LayerMasks]) -> impl Iterator<Item = (&mut u8, &mut u8)> {
    shapes.iter_mut().flat_map(|s| &mut s.layers).flat_map(|l| l.class.iter_mut().zip(&mut l.alpha))
}

/// Fraction of pixels, over all tiles, whose right neighbour has another label. The size of the label section follows it.
fn changes(b: &Geometry) -> f64 {
    let rows = (0..b.grid.tiles()).zip(&b.tiles).flat_map(|(i, t)| t.labels.chunks(b.grid.rect(i).w as usize));
    let (mut changed, mut all) = (0usize, 0usize);
    for row in rows {
        changed += row.windows(2).filter(|p| p[0] != p[1]).count();
        all += row.len();
    }
    changed as f64 / all.max(1) as f64
}

/// Measures a setting on all subjects; the figures are means.
pub(super) fn point(all: &[Prepared], setting: String, without: Without, neighbour: f32, axes: (&str, &str)) -> Result<Point, BenchError> {
    let mut figures = Figures::default();
    for p in all {
        for (name, value) in p.figures(without, neighbour)? {
            figures.add(name, value);
        }
    }
    Ok(figures.point(setting, axes))
}

const VIEW: Axis = Axis { label: "view, dB", log: false, up: Some(true) };

fn prepared<'a>(subjects: &'a [Subject], psi: Option<&'a dyn Network>) -> Result<Vec<Prepared<'a>>, BenchError> {
    subjects.iter().filter_map(|s| Prepared::new(s, psi).transpose()).collect()
}

/// Disables one step at a time.
pub(super) fn steps(bench: &Bench, subjects: &[Subject], progress: &dyn Fn(&str)) -> Result<Experiment, BenchError> {
    progress("Without each step");
    let all = prepared(subjects, bench.psi())?;
    let texels = Axis { label: "texels per pixel", log: false, up: Some(false) };
    let mut points = Vec::new();
    for (name, without) in ALL.into_iter().filter(|(_, w)| *w != Without::Refined || bench.psi().is_some()) {
        points.push(point(&all, name.into(), without, NEIGHBOUR_COST, (texels.label, VIEW.label))?);
    }
    let whole = points[0].y;
    for p in &mut points {
        p.figures.insert(0, ("loss, dB", whole - p.y));
        p.default = p.setting == ALL[0].0;
    }
    Ok(Experiment {
        id: "without",
        title: "Without each step".into(),
        about: "Exact disparity and the photo's own pixels, without compression; one step of planes, layers and rendering is disabled at a time. The comparison of the mesh includes the black holes where it is torn. The last two rows add something: Ψ, and true colours that no photo contains.".into(),
        x: texels,
        y: VIEW,
        curves: vec![Curve { name: "steps".into(), points }],
    })
}

/// Varies the weight of label smoothing.
pub(super) fn labels(subjects: &[Subject], quick: bool, progress: &dyn Fn(&str)) -> Result<Experiment, BenchError> {
    progress("Label smoothing");
    let all = prepared(subjects, None)?;
    let changes = Axis { label: "label changes, % of pixels", log: true, up: Some(false) };
    let weights: &[f32] = if quick { &[0.0, 0.12, 0.3, 1.5] } else { &[0.0, 0.05, 0.12, 0.2, 0.3, 0.6, 1.5] };
    let mut points = Vec::new();
    for &w in weights {
        let mut p = point(&all, format!("neighbour weight {w}"), Without::Nothing, w, (changes.label, VIEW.label))?;
        p.default = (w - NEIGHBOUR_COST).abs() < 1e-6;
        points.push(p);
    }
    Ok(Experiment {
        id: "labels",
        title: "Label smoothing".into(),
        about: "Cost of a neighbour with another label, relative to a pixel's squared error in units of the allowed error. Label changes determine the size of a container's label section.".into(),
        x: changes,
        y: VIEW,
        curves: vec![Curve { name: "weight".into(), points }],
    })
}

/// Measures each kind of motion, and compares errors near tile borders with errors elsewhere.
pub(super) fn moves(bench: &Bench, subjects: &[Subject], progress: &dyn Fn(&str)) -> Result<Experiment, BenchError> {
    /// Pixels on each side of a tile border that count as near it.
    const NEAR: u32 = 8;
    const NAMES: [&str; 4] = ["sideways", "up and down", "forward", "combined, with rotation"];
    progress("Kinds of motion, and seams");
    let mut sums = [[0f64; 6]; 4];
    let mut count = 0usize;
    for s in subjects {
        let Some(p) = Prepared::new(s, None)? else { continue };
        let Some(made) = bench.runs(s, &measure::Depth::Known, &Options::default())?.pop() else { continue };
        let scene = Arc::new(tmpi_core::container::decode(&made.container)?);
        // a copy of the scene that is white near borders shows where they appear in a view
        let (w, h, grid) = (p.photo.width, p.photo.height, scene.grid);
        let borders = |start: fn(&Rect) -> u32, length: fn(&Rect) -> u32, side: u32| -> Vec<bool> {
            let tiles: Vec<Rect> = (0..grid.tiles()).map(|t| grid.rect(t)).collect();
            let lines = tiles.iter().flat_map(|r| [start(r), start(r) + length(r)]).filter(|&b| b > 0 && b < side);
            let mut near = vec![false; side as usize];
            lines.for_each(|b| near[b.saturating_sub(NEAR) as usize..(b + NEAR).min(side) as usize].fill(true));
            near
        };
        let (columns, rows) = (borders(|r| r.x, |r| r.w, w), borders(|r| r.y, |r| r.h, h));
        let white = |i: u32| if columns[(i % w) as usize] || rows[(i / w) as usize] { [255; 3] } else { [0; 3] };
        let mut painted = Scene::clone(&scene);
        painted.photo.rgb = (0..w * h).map(white).collect();
        painted.texels.hidden.fill([0; 3]);
        let painted = Arc::new(painted);
        let cpu = Cpu::default();
        count += 1;
        for (sum, (camera, want)) in sums.iter_mut().zip(&s.views) {
            let (view, mask) = (cpu.render(&scene, camera)?, cpu.render(&painted, camera)?);
            let rgb: Vec<[u8; 3]> = view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect();
            let [psnr, ssim, l1] = measure::compared(&rgb, want);
            let mut error = [(0f64, 0usize); 2];
            for ((got, want), mask) in rgb.iter().zip(&want.rgb).zip(&mask.rgba) {
                let e = &mut error[usize::from(mask[0] < 128)];
                e.0 += got.iter().zip(want).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / 3.0;
                e.1 += 1;
            }
            let [near, elsewhere] = error.map(|(sum, n)| sum / n.max(1) as f64);
            for (s, v) in sum.iter_mut().zip([psnr, ssim, l1, near, elsewhere, 100.0 * error[0].1 as f64 / rgb.len() as f64]) {
                *s += v;
            }
        }
    }
    let (x, y) = (
        Axis { label: "error elsewhere, levels", log: false, up: Some(false) },
        Axis { label: "error near tile borders, levels", log: false, up: Some(false) },
    );
    let points = NAMES.iter().zip(sums).map(|(name, s)| {
        let [psnr, ssim, l1, near, elsewhere, share] = s.map(|v| v / count.max(1) as f64);
        let figures = vec![
            ("view, dB", psnr),
            ("view SSIM", ssim),
            ("view L1", l1),
            ("near ÷ elsewhere", near / elsewhere),
            ("near, % of pixels", share),
        ];
        Point { setting: (*name).into(), x: elsewhere, y: near, figures, default: true, ..Point::default() }
    });
    Ok(Experiment {
        id: "moves",
        title: "Kinds of motion, and seams".into(),
        about: format!(
            "Exact views by kind of motion: mean error of pixels within {NEAR} pixels of a tile border, and of all others. Both are equal on the diagonal."
        ),
        x,
        y,
        curves: vec![Curve { name: "motion".into(), points: points.collect() }],
    })
}
