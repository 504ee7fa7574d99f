//! The stages of a photo, one after the other.

use super::budget::Costs;
use super::tile_error::tile_errors;
use super::{
    Budget, Denoise, ErrorFigures, Input, LeftOut, Made, MakeError, Models, Options, PlaneCount, PlaneMethod, Progress, Report, Sink,
    Stage, Switch, TileSize,
};
use crate::StageError;
use crate::clock::{self, Clock};
use crate::denoise;
use crate::layers::{self, refine};
use crate::photo::{self, Decoded, Limits};
use crate::planes::{MAX_AUTO_PLANES, MAX_PLANES, Method, Placement, busy_share, discretisation_error, place};
use crate::{depth, edges};
use tmpi_core::container::{self, Carried, PhotoFormat};
use tmpi_core::{DisparityMap, Geometry, Grid, Intrinsics, LayerMasks, Photo, Rect, Scene};

/// Stages of every photo, in order.
pub const STAGES: [&str; 9] = ["photo", "depth", "denoise", "snap", "planes", "layers", "refine", "encode", "verify"];

/// Whether Ψ runs where nothing is said. With the weights shipped it is worth 0.03 dB of the 0.37 that exact hidden colours would be
/// (`tmpi bench --only without`), and the container has to carry its colours: so it does not.
const REFINEMENT_HELPS: bool = false;

/// Runs the whole way of a photo. `depth` is the user's own depth map as a PNG file, if there is one.
///
/// # Errors
/// [`MakeError`]: the photo, the depth map, an option, or a network is at fault.
pub fn make(
    models: &Models,
    limits: &Limits,
    photo: &[u8],
    depth: Option<&[u8]>,
    options: &Options,
    sink: &dyn Sink,
) -> Result<Made, MakeError> {
    options.validate()?;
    let mut trip = Trip { sink, clock: Clock::start(), stage: None, report: Report::default() };
    trip.enter("photo")?;
    let input = photo;
    let mut options = options.clone();
    let reduced = match options.budget_ms {
        Some(budget) => options.fit_size(budget, photo::check(input, limits)?.1, depth.is_none()),
        None => None,
    };
    let Decoded { photo, original, format, mut intrinsics, carried, .. } = photo::decode(input, limits, options.max_size)?;
    let (w, h) = (photo.width, photo.height);
    if let Some(fov) = options.fov_x {
        intrinsics = Intrinsics::from_fov_x(w, h, fov);
    }
    trip.report.input = Input { width: original.0, height: original.1, bytes: input.len() };
    (trip.report.width, trip.report.height) = (w, h);

    trip.enter("depth")?;
    let mut delta = match depth {
        Some(png) => depth::from_png(png, options.depth_kind, limits, w, h)?,
        None => models.depth.estimate(&photo)?,
    };
    let given = depth.is_some();
    trip.report.depth_model = if given { "given".into() } else { models.depth.name().into() };
    sanitise(&mut delta);

    trip.enter("denoise")?;
    let mut confidence = None;
    match (options.denoise, &models.theta) {
        (Denoise::Theta, Some(_)) if !denoise::confidence::wanted(&delta) => {}
        (Denoise::Theta, Some(theta)) => {
            let (clean, c) = denoise::confidence::run(theta.as_ref(), &photo, &delta)?;
            delta = clean;
            confidence = Some(c);
        }
        (Denoise::Theta, None) => {
            let range = "other than theta where ONNX Runtime or the network is missing";
            return Err(StageError::Option { field: "denoise", range, value: "theta".into() }.into());
        }
        // It looks for damage first
        (Denoise::Auto, _) => delta = denoise::local_planes::denoise(&delta),
        (Denoise::Classic, _) => delta = denoise::median_guided::denoise(&photo, &delta),
        (Denoise::Off, _) => {}
    }

    trip.enter("snap")?;
    if options.snap != Switch::Off {
        // snapping true depth costs quality, and a map that is given may be either
        let blurred = !given || options.snap == Switch::On || edges::ramp_share(&delta) > edges::BLURRED;
        delta = if blurred { edges::snap(&photo, &delta) } else { edges::median(&photo, &delta) };
    }

    trip.enter("planes")?;
    let options = &mut options;
    let grid = match options.tile {
        TileSize::Pixels(size) => Grid::new(w, h, size),
        TileSize::Full => Grid::full(w, h),
    };
    let whole = Rect { x: 0, y: 0, w, h };
    let parallax = options.view_box.parallax(&intrinsics, whole);
    trip.report.budget = options.fit_error(&delta, &grid, parallax, trip.clock.ms(), reduced);
    let placement = options.placement(parallax);
    let tiles = place(&delta, confidence.as_deref(), &grid, &placement);
    drop(confidence);
    let (mae, mse, q25) = discretisation_error(&delta, &grid, &tiles);
    let tile_px = tile_errors(&delta, &grid, &tiles, parallax.0.max(parallax.1));

    trip.enter("layers")?;
    let mut geometry = Geometry { grid, intrinsics, view_box: options.view_box, tiles };
    layers::add_backgrounds(&mut geometry, &delta);
    let shapes = geometry.masks();
    trip.count(&geometry, &shapes, &placement);
    // the file for the container takes one core; beside the layers, which take all there are, it costs no time of its own
    let file = || carry(carried, format, &photo, options.quality);
    let (mut coloured, carried) = rayon::join(|| tmpi_core::texture(&photo, &geometry, shapes), file);
    let carried = carried?;

    trip.enter("refine")?;
    trip.report.left_out.tiles_not_refined = coloured.len();
    let wanted = options.refine == Switch::On || (options.refine == Switch::Auto && REFINEMENT_HELPS);
    let mut carries = container::Carries::default();
    if wanted && let Some(psi) = &models.psi {
        let refined = refine::run(psi.as_ref(), &photo, &geometry, &mut coloured)?;
        trip.report.left_out.tiles_not_refined = refined.skipped;
        carries = container::Carries { alpha: true, hidden: refined.colours.then_some(container::HiddenAs::Jpeg(options.quality)) };
    }

    trip.enter("encode")?;
    let scene = tmpi_core::compose(photo, &geometry, coloured);
    let (container, bytes) = container::encode(&geometry, &scene, &carried, carries)?;
    trip.report.bytes = bytes.into();

    trip.enter("verify")?;
    trip.report.error = ErrorFigures { depth_mae: mae, depth_mse: mse, depth_q25: q25, tile_px, ..ErrorFigures::default() };
    verify(&scene, &carried, &mut trip.report.error)?;
    if options.verify_prune {
        let change = super::prune::verify(&scene.photo, &geometry)?;
        trip.report.error.prune_max_abs = Some(change.max_abs.into());
        trip.report.error.prune_share_off = Some(change.share);
    }
    Ok(Made { container, report: trip.finish(), disparity: delta })
}

/// A photo on its way through the stages.
struct Trip<'a> {
    sink: &'a dyn Sink,
    clock: Clock,
    stage: Option<(&'static str, Clock)>,
    report: Report,
}

impl Trip<'_> {
    fn enter(&mut self, stage: &'static str) -> Result<(), MakeError> {
        self.leave();
        if self.sink.cancelled() {
            return Err(MakeError::Cancelled);
        }
        self.stage = Some((stage, Clock::start()));
        let step = STAGES.iter().position(|s| *s == stage).map_or(0, |p| p as u32 + 1);
        self.sink.progress(&Progress { stage, step, steps: STAGES.len() as u32, elapsed_ms: self.clock.ms() });
        Ok(())
    }

    fn leave(&mut self) {
        if let Some((name, c)) = self.stage.take() {
            self.report.stages.push(Stage { name: name.into(), ms: c.ms(), cpu_ms: c.cpu_ms() });
        }
    }

    fn finish(mut self) -> Report {
        self.leave();
        self.report.total_ms = self.clock.ms();
        if let Some(b) = &mut self.report.budget {
            b.outcome_ms = self.report.total_ms;
        }
        self.report.peak_rss_bytes = clock::peak_rss_bytes();
        self.report
    }

    /// Counts what there is and what was left out, against the most planes that a tile may have, each as large as its tile.
    fn count(&mut self, geometry: &Geometry, shapes: &[LayerMasks], placement: &Placement) {
        let r = &mut self.report;
        r.tiles = shapes.len();
        r.planes = shapes.iter().map(|s| s.layers.len()).sum();
        r.planes_per_tile = r.planes as f64 / r.tiles.max(1) as f64;
        let placed: usize = geometry.tiles.iter().map(|t| t.planes.len()).sum();
        let full: usize = (0..geometry.grid.tiles()).map(|t| geometry.grid.rect(t).area()).sum::<usize>() * placement.most as usize;
        let kept: usize = shapes.iter().flat_map(|s| &s.layers).map(|l| l.class.iter().filter(|c| **c != 0).count()).sum();
        r.texels = kept;
        r.left_out = LeftOut {
            planes: (r.tiles * placement.most as usize).saturating_sub(placed),
            tiles_not_refined: 0,
            texels: full.saturating_sub(kept),
            bytes: full.saturating_sub(kept) * 4,
        };
    }
}

/// Puts anything that is no disparity at infinity: no input may give NaN further on.
fn sanitise(delta: &mut DisparityMap) {
    for d in &mut delta.delta {
        *d = if d.is_finite() { d.clamp(0.0, 1.0) } else { 0.0 };
    }
}

impl Options {
    /// Reduces the size for a budget of run time, before anything is decoded; gives the longest side where it does.
    fn fit_size(&mut self, budget: f64, size: (u32, u32), estimated: bool) -> Option<u32> {
        let size = photo::reduced_size(size, self.max_size);
        let side = Costs::of_this_machine().side(budget, size, estimated)?;
        self.max_size = Some(side);
        Some(side)
    }

    /// Chooses the parallax error for what is left of a budget of run time.
    fn fit_error(&mut self, delta: &DisparityMap, grid: &Grid, parallax: (f64, f64), elapsed: f64, reduced: Option<u32>) -> Option<Budget> {
        let asked_ms = self.budget_ms?;
        let busy = busy_share(delta, grid, self.max_error / parallax.0.max(parallax.1).max(1.0));
        let megapixels = f64::from(delta.width) * f64::from(delta.height) / 1e6;
        let (rate, ms, enough) = Costs::of_this_machine().choose(asked_ms - elapsed, megapixels, busy);
        self.max_error *= rate.factor;
        let size = reduced.map_or(String::new(), |side| format!("--max-size {side} "));
        let reason = match (enough, rate.factor > 1.0 || reduced.is_some()) {
            (false, _) if elapsed >= asked_ms => "the photo and its depth alone took longer",
            (false, _) => "the cheapest setting takes longer",
            (true, true) => "the best that fits",
            (true, false) => "nothing had to be given up",
        };
        Some(Budget {
            asked_ms,
            predicted_ms: elapsed + ms,
            outcome_ms: 0.0,
            chose: format!("{size}--max-error {}", self.max_error),
            reason: reason.into(),
            busy,
        })
    }

    /// How planes are to be placed for a view box of that parallax.
    #[must_use]
    pub fn placement(&self, parallax: (f64, f64)) -> Placement {
        let method = match self.plane_method {
            PlaneMethod::Linear => Method::Linear,
            PlaneMethod::Lloyd => Method::Lloyd,
            PlaneMethod::Optimal => Method::Optimal,
            PlaneMethod::Slanted => Method::Slanted,
        };
        match self.planes {
            PlaneCount::Fixed(n) => Placement::fixed(method, n),
            PlaneCount::Auto => Placement::fewest(method, MAX_AUTO_PLANES, self.max_error / parallax.0.max(parallax.1).max(1.0)),
        }
    }

    /// Checks every number against its range.
    ///
    /// # Errors
    /// [`StageError::Option`] names the option and its range.
    pub fn validate(&self) -> Result<(), StageError> {
        let check = |ok: bool, field, range, value: &dyn std::fmt::Display| {
            if ok { Ok(()) } else { Err(StageError::Option { field, range, value: value.to_string() }) }
        };
        if let Some(f) = self.fov_x {
            check(f > 0.0 && f < 180.0, "fov-x", "between 0 and 180 degrees", &f)?;
        }
        if let PlaneCount::Fixed(n) = self.planes {
            check((1..=MAX_PLANES).contains(&n), "planes", "auto or 1 to 64", &n)?;
        }
        if let TileSize::Pixels(h) = self.tile {
            check((8..=1024).contains(&h), "tile", "full or 8 to 1024 pixels", &h)?;
        }
        if let Some(m) = self.max_size {
            check((1..=Limits::SIDE).contains(&m), "max-size", "1 to 16384 pixels", &m)?;
        }
        check((1..=100).contains(&self.quality), "quality", "1 to 100", &self.quality)?;
        check(self.max_error >= 0.0 && self.max_error <= 1e3, "max-error", "0 to 1000 pixels", &self.max_error)?;
        if let Some(b) = self.budget_ms {
            check((1.0..=1e7).contains(&b), "budget-ms", "1 to 10000000 milliseconds", &b)?;
        }
        for e in [self.view_box.x, self.view_box.y, self.view_box.z] {
            check((0.0..=10.0).contains(&e), "view-box", "three numbers of 0 to 10", &e)?;
        }
        Ok(())
    }
}

/// The photo's file for the container: the uploaded one where it is no larger than a new one at the asked quality.
fn carry(uploaded: Option<Vec<u8>>, format: PhotoFormat, photo: &Photo, quality: u8) -> Result<Carried, MakeError> {
    let anew = Carried::from_photo(photo, quality)?;
    Ok(match uploaded {
        Some(bytes) if bytes.len() <= anew.bytes.len() => Carried { bytes, format },
        _ => anew,
    })
}

/// Measures the identity view and the carried photo.
fn verify(scene: &Scene, carried: &Carried, error: &mut ErrorFigures) -> Result<(), MakeError> {
    let photo = &scene.photo;
    let identity = || {
        let view = tmpi_render::draw_reference_view(scene)?;
        let rgb: Vec<[u8; 3]> = view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect();
        Ok::<_, MakeError>(tmpi_render::difference::psnr(rgb.as_flattened(), photo.rgb.as_flattened()))
    };
    let codec = || Ok::<_, MakeError>(tmpi_render::difference::psnr(carried.decode()?.rgb.as_flattened(), photo.rgb.as_flattened()));
    let (identity, codec) = rayon::join(identity, codec);
    (error.identity_psnr, error.codec_psnr) = (identity?, codec?);
    Ok(())
}
