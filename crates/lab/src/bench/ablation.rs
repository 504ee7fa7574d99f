//! Ablation: disables single steps of planes, layers and rendering, and measures the loss.

use std::sync::Arc;

use super::experiments::VIEW;
use super::figures::Figures;
use super::measure::{self, Bench};
use super::subject::Subject;
use super::{Axis, Curve, Experiment, Point};
use crate::LabError;
use crate::scenes::{self, hidden_colours};
use tmpi_core::{Class, DisparityMap, Geometry, Grid, Intrinsics, LayerMasks, Photo, Rect, Scene, TexturedLayer, TileFrame, ViewBox};
use tmpi_pipeline::layers::{self, refine};
use tmpi_pipeline::networks::Network;
use tmpi_pipeline::planes::{NEIGHBOUR_COST, Placement, place};
use tmpi_pipeline::{MakeError, Options, Parallax, edges};
use tmpi_render::{Cpu, Renderer};

/// The step that is disabled or replaced, as [`ALL`] names it.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Without {
    Nothing,
    Median,
    /// Moves pixels of mixed colours to the near side.
    FarRims,
    /// Applies the median also to pixels whose colour matches their side.
    FullMedian,
    /// Adds no planes for background that is visible only in neighbouring tiles.
    Backgrounds,
    Hidden,
    Trim,
    Prune,
    Fill,
    Soft,
    Refined,
    /// Colours hidden texels from the exact surface if it lies on their plane: an upper bound for any Ψ.
    Known,
}

const ALL: [(&str, Without); 12] = [
    ("all steps", Without::Nothing),
    ("without the colour-weighted median", Without::Median),
    ("with rims on the near side", Without::FarRims),
    ("colour-weighted median of every edge pixel", Without::FullMedian),
    ("without backgrounds", Without::Backgrounds),
    ("without hidden texels", Without::Hidden),
    ("hidden texels in front of the surface too", Without::Trim),
    ("without pruning of unseen texels", Without::Prune),
    ("without inpainting: the photo's colour behind", Without::Fill),
    ("without soft rims", Without::Soft),
    ("with Ψ", Without::Refined),
    ("with true hidden colours", Without::Known),
];

/// A decoded subject with its cleaned disparity.
pub(super) struct Prepared<'a> {
    subject: &'a Subject,
    photo: Photo,
    intrinsics: Intrinsics,
    view_box: ViewBox,
    given: &'a DisparityMap,
    /// The cleaned disparity.
    pub snapped: DisparityMap,
    psi: Option<&'a dyn Network>,
}

impl<'a> Prepared<'a> {
    /// `None` if the subject's disparity is not known.
    pub fn new(subject: &'a Subject, view_box: ViewBox, psi: Option<&'a dyn Network>) -> Result<Option<Self>, LabError> {
        let Some(given) = subject.disparity.as_deref() else { return Ok(None) };
        let decoded = subject.decoded()?;
        let photo = decoded.photo;
        let intrinsics = subject.fov_x.map_or(decoded.intrinsics, |fov| Intrinsics::from_fov_x(photo.width, photo.height, fov));
        let snapped = edges::median(&photo, given);
        Ok(Some(Self { subject, photo, intrinsics, view_box, given, snapped, psi }))
    }

    /// Planes, labels and backgrounds.
    pub fn geometry(&self, without: Without, neighbour: f32) -> Geometry {
        let options = Options::default();
        let (w, h) = (self.photo.width, self.photo.height);
        let grid = Grid::new(w, h, 64);
        let most = Parallax::new(self.intrinsics, self.view_box).most(Rect { x: 0, y: 0, w, h });
        let placement = Placement { neighbour, ..options.placement(options.max_error, most) };
        let map = match without {
            Without::Median => self.given,
            Without::FarRims => &edges::join_rims(&self.photo, &self.snapped, edges::Rim::Photo),
            Without::FullMedian => &edges::full_median(&self.photo, self.given),
            _ => &self.snapped,
        };
        let tiles = place(map, None, &grid, &placement);
        let mut geometry = Geometry { grid, intrinsics: self.intrinsics, view_box: self.view_box, tiles, matte_band: 0 };
        if without != Without::Backgrounds {
            layers::add_backgrounds(&mut geometry, map);
        }
        geometry
    }

    fn scene(&self, geometry: &Geometry, without: Without) -> Result<Scene, LabError> {
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
        match (without, self.psi, self.subject.seed) {
            (Without::Fill, ..) => coloured.iter_mut().flatten().for_each(|l| self.own_colours(l)),
            (Without::Refined, Some(psi), _) => {
                let fail = |e| LabError::Make { subject: self.subject.name.clone(), source: MakeError::Generate(e) };
                refine::run(psi, &self.photo, geometry, &mut coloured).map_err(fail)?;
            }
            (Without::Known, _, Some(seed)) => {
                let scene = scenes::Scene::framed(seed, self.photo.width, self.photo.height);
                let hidden = scene.hidden(&scene.camera(), 3);
                for (t, i) in coloured.iter_mut().zip(0..) {
                    let place = TileFrame::of(&geometry.grid, i);
                    for l in t {
                        let known = hidden_colours::of_layer(&l.shape, place, self.given, &hidden);
                        l.hidden.iter_mut().zip(known).for_each(|(c, k)| *c = k.unwrap_or(*c));
                    }
                }
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

    /// Adds what the scene of a geometry looks like and consists of.
    pub fn add(&self, f: &mut Figures, geometry: &Geometry, without: Without) -> Result<(), LabError> {
        let scene = Arc::new(self.scene(geometry, without)?);
        let cpu = Cpu::default();
        for (camera, want) in &self.subject.views {
            let view = cpu.render(&scene, camera)?;
            let [psnr, ssim, l1] = measure::score(&view, want);
            f.add("view, dB", psnr);
            f.add("view SSIM", ssim);
            f.add("view L1", l1);
            let uncovered = view.rgba.iter().filter(|p| p[3] < 128).count() as f64 / view.rgba.len() as f64;
            f.add("uncovered, % of pixels", 100.0 * uncovered);
        }
        let pixels = f64::from(self.photo.width) * f64::from(self.photo.height);
        f.add("planes per tile", scene.layers.len() as f64 / f64::from(scene.grid.tiles()));
        f.add("texels per pixel", scene.texels.class.iter().filter(|c| **c != 0).count() as f64 / pixels);
        f.add("label changes, % of pixels", 100.0 * changes(geometry));
        Ok(())
    }
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
fn point(all: &[Prepared], setting: String, (without, neighbour): (Without, f32), x: &Axis) -> Result<Point, LabError> {
    let mut f = Figures::default();
    all.iter().try_for_each(|p| p.add(&mut f, &p.geometry(without, neighbour), without))?;
    Ok(f.point(setting, (&x.label, &VIEW.label)))
}

fn prepared<'a>(subjects: &'a [Subject], psi: Option<&'a dyn Network>) -> Result<Vec<Prepared<'a>>, LabError> {
    subjects.iter().filter_map(|s| Prepared::new(s, Options::VIEW_BOX, psi).transpose()).collect()
}

/// Disables one step at a time.
pub(super) fn steps(bench: &Bench, subjects: &[Subject]) -> Result<Experiment, LabError> {
    let all = prepared(subjects, bench.psi())?;
    let x = Axis::new("texels per pixel", false, Some(false));
    let mut points = Vec::new();
    for (name, without) in ALL.into_iter().filter(|(_, w)| *w != Without::Refined || bench.psi().is_some()) {
        points.push(point(&all, name.into(), (without, NEIGHBOUR_COST), &x)?);
    }
    let whole = points[0].y;
    for p in &mut points {
        p.figures.insert(0, ("loss, dB".into(), whole - p.y));
        p.default = p.setting == ALL[0].0;
    }
    Ok(Experiment {
        id: "without".into(),
        title: "Without each step".into(),
        about: "Exact disparity and the photo's own pixels, without compression; one step of planes, layers and rendering is disabled at a time. The last two rows add something: Ψ, and true colours that no photo contains.".into(),
        x,
        y: VIEW,
        curves: vec![Curve { name: "steps".into(), points }],
    })
}

pub(super) fn labels(subjects: &[Subject], quick: bool) -> Result<Experiment, LabError> {
    let all = prepared(subjects, None)?;
    let x = Axis::new("label changes, % of pixels", true, Some(false));
    let weights: &[f32] = if quick { &[0.0, 0.12, 0.3, 1.5] } else { &[0.0, 0.05, 0.12, 0.2, 0.3, 0.6, 1.5] };
    let mut points = Vec::new();
    for &w in weights {
        let p = point(&all, format!("weight {w}"), (Without::Nothing, w), &x)?;
        points.push(Point { default: (w - NEIGHBOUR_COST).abs() < 1e-6, ..p });
    }
    Ok(Experiment {
        id: "labels".into(),
        title: "Label smoothing".into(),
        about: "Cost of a neighbour with another label, relative to a pixel's squared error in units of the allowed error. Label changes determine the size of a container's label section.".into(),
        x,
        y: VIEW,
        curves: vec![Curve { name: "weight".into(), points }],
    })
}
