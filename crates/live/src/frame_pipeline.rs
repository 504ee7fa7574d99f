//! Drives the pipeline for a room's frames.

use std::time::{Duration, Instant};

use tmpi_core::live::LiveError;
use tmpi_core::live::chunk::{self, Area};
use tmpi_core::live::schema::Chunk;
use tmpi_core::{self as core, DisparityMap, Grid, Intrinsics, Photo, Rect, Tile};
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::planes::MAX_AUTO_PLANES;
use tmpi_pipeline::run::Context;
use tmpi_pipeline::run::stages::{WarmStart, WeightedDisparity};
use tmpi_pipeline::usage::Clock;
use tmpi_pipeline::{MakeError, Models, Options, PlaneCount, Silent, StageTime, layers};

use crate::align;
use crate::change::{BLOCK, Change, Compare};
use crate::depth_recheck::Rechecks;
use crate::tile_displacement::tile_displacement;
use crate::tile_queue::Queue;
use crate::{Budget, DepthTime, TileBudget};

mod depth;

use depth::estimate;

/// Default displacement, in pixels, below which a tile is not sent again.
pub const PARALLAX: f64 = 0.25;

/// Default cooldown after a frame whose tiles were sent: two frames at 30 frames a second. Meanwhile, readers move labels along with the
/// motion. At lower frame rates, where objects move far between frames, no frame falls into it.
///
/// `tmpi-lab live-bench --only still --cooldown-ms N` compares 0, 50, 80 and 100 ms: 520, 311, 220 and 175 bytes of geometry a frame; 65, 34,
/// 23 and 18 ms of CPU time; flicker 0.041, 0.057, 0.065 and 0.071 levels; edges 1.9, 2.0, 2.2 and 2.1 pixels short; views equally good.
/// With more than 80 ms and late tiles, few frames remain in which labels follow.
pub const COOLDOWN: Duration = Duration::from_millis(80);

/// Default parallax error of a room's planes, in pixels at the corners of the view box. `tmpi-lab live-bench` compares it with half of it:
/// this value needs less than half the bytes and flickers less, and views of estimated depth are equally good.
pub const MAX_ERROR: f64 = 3.5;

/// Default budget of a frame's geometry, in milliseconds. `tmpi-lab live-bench --only still --budget-ms 8,12,20,30` compares: 7.8, 9.3, 13.0
/// and 17.2 ms of CPU time a frame; views of 19.2, 19.3, 19.4 and 19.5 dB; flicker 0.32, 0.31, 0.27 and 0.27 levels. At 640×480, 12, 20, 30
/// and 45 ms (`--size 640x480 --frames 120`) have views of 18.2, 18.5, 18.5 and 18.7 dB, and edges 1.5, 1.3, 1.4 and 1.3 pixels short. If
/// everything shares two cores (`glass-to-glass.mjs`, with `live.budget-ms`), 20, 30 and 45 ms have a median of 50, 57 and 76 ms from camera to
/// screen.
pub const BUDGET_MS: f64 = 20.0;

/// Factor on that error for measured depth: planes are then few, and the largest source of error in views.
const MEASURED: f64 = 0.5;

/// Changes of estimated depth up to this many pixels of parallax are mostly noise of the network; only this fraction of them is applied.
const DEPTH_NOISE: (f64, f32) = (1.5, 0.4);

/// A pixel's measured depth counts as changed if it differs from the known one by this fraction of the error.
const CHANGED: f64 = 0.3;

/// A tile with unchanged colours counts as changed if the measured depth of this fraction of its pixels changed.
const DEPTH_CHANGED: f64 = 0.02;

/// Settings of a room's geometry.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Options as for a photo, with [`MAX_ERROR`] as the error (half of it for measured depth). Sizes, quality and budget have no effect.
    pub options: Options,
    /// A tile is sent only if its new planes move some point by more than this many pixels, for some camera in the view box
    /// ([`tile_displacement`]). 0: every difference is sent.
    pub parallax: f64,
    /// After a frame whose tiles were sent, no tiles are placed or sent for this long; changes wait for a later frame. Does not apply to
    /// measured depth: its tiles are few, and accurate enough that lateness would be visible.
    pub cooldown: Duration,
    /// Milliseconds that the geometry of a frame should take ([`Budget`]); 0: no limit.
    pub frame_ms: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { options: Options { max_error: MAX_ERROR, ..Options::default() }, parallax: PARALLAX, cooldown: COOLDOWN, frame_ms: 0.0 }
    }
}

impl Settings {
    /// Geometry for frames of this size, with a camera and empty tiles.
    pub fn empty(&self, width: u32, height: u32) -> core::Geometry {
        let grid = self.options.grid(width, height);
        let intrinsics = match self.options.fov_x {
            Some(fov) => Intrinsics::from_fov_x(width, height, fov),
            None => Intrinsics::centred(width, height, Intrinsics::DEFAULT_FOCAL_PER_WIDTH * f64::from(width)),
        };
        let tiles = vec![Tile::default(); grid.tiles() as usize];
        core::Geometry { grid, intrinsics, view_box: self.options.view_box, tiles, matte_band: 0 }
    }
}

/// A decoded frame.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Frame number.
    pub number: u64,
    /// When it was captured or received, since an arbitrary time.
    pub at: Duration,
    /// Its pixels.
    pub photo: Photo,
    /// Measured disparity at the frame's size, 0 to 1, if the camera provides it.
    pub depth: Option<DisparityMap>,
}

/// Effects of a frame on the room's geometry.
#[derive(Clone, Debug, Default)]
pub struct Update {
    /// The frame starts a new scene.
    pub cut: bool,
    /// Indices of tiles whose pixels changed.
    pub changed: Vec<u32>,
    /// Tiles whose planes or labels moved by more than the tolerance, and which are sent to readers.
    pub sent: Vec<u32>,
    /// Tiles that got new planes within the tolerance. They are not sent; readers and this room keep the last sent version.
    pub kept: Vec<u32>,
    /// Largest displacement of the kept tiles in pixels: an upper bound over all cameras in the view box.
    pub kept_error: f64,
    /// The sent tiles, encoded.
    pub chunks: Vec<Chunk>,
    /// Number of changed tiles that wait for a later frame: during the cooldown, or until depth is due.
    pub waiting: usize,
    /// Number of tiles that may need more planes than there was time for; they get them when there is time.
    pub coarse: usize,
    /// Input size of the depth network, if it ran and has a choice of sizes.
    pub depth_size: Option<(u32, u32)>,
    /// Time of each stage.
    pub stages: Vec<StageTime>,
    /// Milliseconds to encode the chunks.
    pub coding_ms: f64,
}

/// The geometry of a room, updated frame by frame.
pub struct FramePipeline {
    models: Models,
    settings: Settings,
    limits: Limits,
    budget: Budget,
    compare: Compare,
    planes: WarmStart,
    state: Option<State>,
}

/// State since the last cut.
struct State {
    /// Each tile as last sent; without planes before the first depth. Tiles that are not sent do not change here either, so that errors do
    /// not accumulate.
    geometry: core::Geometry,
    /// Depth of all pixels is known.
    has_depth: bool,
    /// Time of the last frame whose tiles were sent, which starts the cooldown.
    last_sent: Option<Duration>,
    /// Disparity of each pixel as of the frame that last changed it.
    delta: DisparityMap,
    /// Changed blocks with outdated depth.
    stale: Vec<bool>,
    /// Blocks whose estimated depth needs a recheck.
    rechecks: Rechecks,
    /// Tiles that wait for planes, or for more planes.
    queue: Queue,
}

/// Why a frame has no geometry.
#[derive(Debug, thiserror::Error)]
pub enum GeometryError {
    /// A stage failed.
    #[error(transparent)]
    Make(#[from] MakeError),
    /// The tiles cannot be encoded.
    #[error(transparent)]
    Live(#[from] LiveError),
    /// The depth map and the frame differ in size.
    #[error("the depth map has {0}×{1} pixels, the frame {2}×{3}")]
    Depth(u32, u32, u32, u32),
}

impl FramePipeline {
    /// Starts without any frame.
    pub fn new(models: Models, settings: Settings) -> Self {
        let (budget, compare) = (Budget::new(settings.frame_ms), Compare::default());
        Self { models, settings, limits: Limits::default(), budget, compare, planes: WarmStart::default(), state: None }
    }

    /// All tiles as a reader of every chunk has them. `None` before the first depth, and after a cut whose geometry failed.
    pub fn geometry(&self) -> Option<&core::Geometry> {
        let geometry = self.state.as_ref().map(|state| &state.geometry);
        geometry.filter(|g| g.tiles.iter().all(|t| !t.planes.is_empty()))
    }

    /// Each pixel when its block last changed; its depth belongs to this picture.
    pub const fn reference(&self) -> Option<&Photo> {
        self.compare.reference()
    }

    /// Snapshot for new readers: all tiles as one chunk, as of frame `number`.
    ///
    /// # Errors
    /// [`LiveError`] if a tile cannot be encoded.
    pub fn snapshot(&self, number: u64) -> Result<Option<Chunk>, LiveError> {
        let coded = |g: &core::Geometry| chunk::encode(&g.grid, Area::all(&g.grid), &g.tiles, number);
        self.geometry().map(coded).transpose()
    }

    /// Processes a frame and returns what it changed.
    ///
    /// # Errors
    /// [`GeometryError`]. No tiles are sent then, and the next frame includes this frame's changes.
    pub fn next(&mut self, frame: &Frame) -> Result<Update, GeometryError> {
        if let Some(d) = frame.depth.as_ref().filter(|d| (d.width, d.height) != (frame.photo.width, frame.photo.height)) {
            return Err(GeometryError::Depth(d.width, d.height, frame.photo.width, frame.photo.height));
        }
        let models = self.models.clone();
        let mut options = self.settings.options.clone();
        if frame.depth.is_some() {
            options.max_error *= MEASURED;
        }
        let mut job = Context::new(&models, &self.limits, &options, &Silent);
        let stage = job.begin("compare")?;
        let change = self.compare.next(&frame.photo);
        job.end(stage);
        if change.cut {
            self.state = None;
            self.planes = WarmStart::default();
        }
        let mut update = Update { cut: change.cut, ..Update::default() };
        let state = self.state.get_or_insert_with(|| State::new(&frame.photo, &self.settings));
        let grid = state.geometry.grid;
        state.record_change(&change, &grid, &mut update.changed);
        if frame.depth.is_none() && state.has_depth {
            let due = state.rechecks.next(&change);
            state.record_change(&due, &grid, &mut Vec::new());
        }
        if let Some(depth) = &frame.depth {
            state.record_depth_change(depth, &grid, to_disparity(&state.geometry, CHANGED * options.max_error), change.across);
        }
        let has_depth = state.has_depth;
        // if the clock was set back, do not wait for it
        let since = state.last_sent.and_then(|sent| frame.at.checked_sub(sent));
        let cooling_down = since.is_some_and(|since| since < self.settings.cooldown);
        let measured = frame.depth.is_some();
        if !cooling_down && state.stale.contains(&true) {
            let sizes = if measured { Vec::new() } else { models.depth.sizes(frame.photo.width, frame.photo.height) };
            if let Some(size) = self.budget.depth(&sizes, measured || !has_depth) {
                let clock = Clock::start();
                let part = if has_depth { state.stale_part(change.across) } else { None };
                update.depth_size = sizes.get(size).copied();
                let map = estimate(&mut job, frame, update.depth_size, part)?;
                let cpu_ms = (!models.depth.may_use_device()).then(|| clock.cpu_ms());
                self.budget.depth_took(DepthTime { ms: clock.ms(), network_ms: job.network_ms, cpu_ms });
                state.merge_depth(map, has_depth && !measured, change.across);
            }
        }
        if !cooling_down && !state.stale.contains(&true) {
            let most = (options.planes == PlaneCount::Auto).then_some(MAX_AUTO_PLANES);
            let share = self.budget.tiles(state.queue.waiting(), most);
            let chosen_tiles = state.queue.next(share.spare);
            if !chosen_tiles.is_empty() {
                let before = Instant::now();
                let counts = state.place(&mut job, &mut self.planes, (&chosen_tiles, share, self.settings.parallax), &mut update)?;
                self.budget.tiles_took(&counts, share.planes.is_none(), ms(before));
                state.last_sent = (!update.sent.is_empty() && !measured).then_some(frame.at);
            }
        }
        (update.waiting, update.coarse) = (state.queue.waiting(), state.queue.coarse());
        update.stages = job.finish().stages;
        let before = Instant::now();
        let sent = |t: u32| update.sent.binary_search(&t).is_ok();
        let coded = |area| chunk::encode(&grid, area, &state.geometry.tiles, frame.number);
        update.chunks = Area::covering(&grid, sent).into_iter().map(coded).collect::<Result<_, _>>()?;
        update.coding_ms = ms(before);
        Ok(update)
    }
}

fn ms(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

/// Converts an error from pixels of parallax to δ.
fn to_disparity(g: &core::Geometry, pixels: f64) -> f64 {
    let all = core::Rect { x: 0, y: 0, w: g.grid.width, h: g.grid.height };
    let parallax = g.view_box.parallax(&g.intrinsics, all);
    pixels / parallax.0.max(parallax.1).max(1.0)
}

impl State {
    fn new(photo: &Photo, settings: &Settings) -> Self {
        let (width, height) = (photo.width, photo.height);
        let geometry = settings.empty(width, height);
        let blocks = width.div_ceil(BLOCK) as usize * height.div_ceil(BLOCK) as usize;
        Self {
            queue: Queue::new(geometry.tiles.len()),
            geometry,
            delta: DisparityMap { width, height, delta: vec![0.0; photo.rgb.len()] },
            stale: vec![false; blocks],
            rechecks: Rechecks::new(blocks),
            has_depth: false,
            last_sent: None,
        }
    }

    /// Bounding rectangle of the stale blocks, clipped to the picture; `None` if no block is stale.
    fn stale_part(&self, across: usize) -> Option<Rect> {
        let stale = || self.stale.iter().enumerate().filter(|(_, s)| **s).map(|(i, _)| (i % across, i / across));
        let (x0, x1) = (stale().map(|b| b.0).min()? as u32 * BLOCK, (stale().map(|b| b.0).max()? as u32 + 1) * BLOCK);
        let (y0, y1) = (stale().map(|b| b.1).min()? as u32 * BLOCK, (stale().map(|b| b.1).max()? as u32 + 1) * BLOCK);
        let (x1, y1) = (x1.min(self.delta.width), y1.min(self.delta.height));
        Some(Rect { x: x0, y: y0, w: x1 - x0, h: y1 - y0 })
    }

    /// Marks changed blocks as stale and queues changed tiles.
    fn record_change(&mut self, change: &Change, grid: &Grid, changed: &mut Vec<u32>) {
        for (stale, is_changed) in self.stale.iter_mut().zip(&change.blocks) {
            *stale |= is_changed;
        }
        for t in change.tiles(grid) {
            self.queue.add(t);
            changed.push(t);
        }
    }

    /// Queues tiles whose measured depth changed although their colours did not.
    fn record_depth_change(&mut self, depth: &DisparityMap, grid: &Grid, threshold: f64, across: usize) {
        for t in 0..grid.tiles() {
            let r = grid.rect(t);
            let changed_in_row = |y: u32| {
                let row = y as usize * grid.width as usize + r.x as usize;
                let (new, old) = (&depth.delta[row..][..r.w as usize], &self.delta.delta[row..][..r.w as usize]);
                new.iter().zip(old).filter(|(a, b)| f64::from((*a - *b).abs()) > threshold).count()
            };
            let count: usize = (r.y..r.y + r.h).map(changed_in_row).sum();
            if !self.queue.waits(t) && count as f64 > DEPTH_CHANGED * r.area() as f64 {
                self.queue.add(t);
                for y in r.y / BLOCK..(r.y + r.h).div_ceil(BLOCK) {
                    let row = y as usize * across;
                    self.stale[row + (r.x / BLOCK) as usize..row + (r.x + r.w).div_ceil(BLOCK) as usize].fill(true);
                }
            }
        }
    }

    /// Copies a new map into the stale blocks. With `align`, first aligns it with the other blocks, and damps small changes.
    fn merge_depth(&mut self, mut map: WeightedDisparity, align: bool, across: usize) {
        let width = self.delta.width as usize;
        let block = |i: usize| i / width / BLOCK as usize * across + i % width / BLOCK as usize;
        let noise = if align { (DEPTH_NOISE.0 * to_disparity(&self.geometry, 1.0)) as f32 } else { 0.0 };
        if align {
            let steady: Vec<bool> = (0..self.delta.delta.len()).map(|i| !self.stale[block(i)]).collect();
            align::fit(&map.delta, &self.delta, &steady).apply(&mut map.delta.delta);
            align::join_borders(&mut map.delta, &self.delta, &self.stale, across);
        }
        for (i, (to, new)) in self.delta.delta.iter_mut().zip(&map.delta.delta).enumerate() {
            if self.stale[block(i)] {
                *to = if (*new - *to).abs() < noise { *to + DEPTH_NOISE.1 * (*new - *to) } else { *new };
            }
        }
        self.stale.fill(false);
        self.has_depth = true;
    }

    /// Fits the planes of some tiles. Adds to `update`, in order, the tiles that moved by more than `parallax` pixels as sent and the
    /// others as kept. Returns the number of planes of each tile.
    fn place(
        &mut self,
        job: &mut Context,
        planes: &mut WarmStart,
        (chosen_tiles, share, parallax): (&[u32], TileBudget, f64),
        update: &mut Update,
    ) -> Result<Vec<usize>, MakeError> {
        let mut chosen = vec![false; self.geometry.tiles.len()];
        for t in chosen_tiles {
            chosen[*t as usize] = true;
        }
        (planes.changed, planes.most) = (chosen.clone(), share.planes);
        let mut geometry = planes.place(job, self.geometry.intrinsics, &self.delta)?;
        layers::add_backgrounds_to(&mut geometry, &self.delta, |t| chosen[t as usize]);
        let mut counts = Vec::with_capacity(chosen_tiles.len());
        for (t, new) in (0..).zip(geometry.tiles).filter(|(t, _)| chosen[*t as usize]) {
            counts.push(new.planes.len());
            self.queue.done(t, share.planes.is_some_and(|most| new.planes.len() >= most as usize));
            let old = &self.geometry.tiles[t as usize];
            if *old == new {
                continue;
            }
            let error = tile_displacement(&self.geometry, t, old, &new);
            if error > parallax {
                self.geometry.tiles[t as usize] = new;
                update.sent.push(t);
            } else {
                // the next fit starts from the planes that readers have
                planes.set_last_tile(t, old);
                update.kept.push(t);
                update.kept_error = update.kept_error.max(error);
            }
        }
        Ok(counts)
    }
}

#[cfg(test)]
mod tests;
#[cfg(test)]
mod view_quality_tests;
