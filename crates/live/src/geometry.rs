//! The driver of a room's frames.

use std::time::{Duration, Instant};

use tmpi_core::container::PhotoFormat;
use tmpi_core::live::LiveError;
use tmpi_core::live::chunk::{self, Area};
use tmpi_core::live::wire::Chunk;
use tmpi_core::{self as core, DisparityMap, Grid, Intrinsics, Photo, Rect, Tile};
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::planes::MAX_AUTO_PLANES;
use tmpi_pipeline::run::Context;
use tmpi_pipeline::run::stages::{Estimated, Planes, Prepared};
use tmpi_pipeline::{MakeError, Models, Options, PlaneCount, Silent, StageTime, layers};

use crate::align;
use crate::change::{BLOCK, Change, Compare, Tolerance};
use crate::moved::moved;
use crate::queue::Queue;
use crate::settle::{SETTLES, Settle, Settling};
use crate::{Budget, Share};

mod estimate;

use estimate::estimate;

/// Pixels of parallax by which what readers hold of a tile may be off, where nothing else is said.
pub const PARALLAX: f64 = 0.25;

/// Time for which a room rests after a frame of which tiles were sent, where nothing else is said: at 30 frames a second two frames, between which readers
/// move labels along with what moves. `tmpi-lab live-bench --only still --rest-ms N` compares 0, 50, 80 and 100: 520, 311, 220 and 175 bytes of geometry a frame,
/// 65, 34, 23 and 18 ms of processor; flicker .041, .057, .065 and .071 levels; edges 1.9, 2.0, 2.2 and 2.1 pixels short, and views as good. More than
/// 80 leaves little of the frames in which labels follow, where tiles are late besides. Where frames come more seldom none rests: what moves goes far between two.
pub const REST: Duration = Duration::from_millis(80);

/// Default parallax error that planes of a room may leave, in pixels at the corners of the view box. `tmpi-lab live-bench` compares it with half of it:
/// less than half the bytes and less flicker, and views of estimated depth are as good.
pub const MAX_ERROR: f64 = 3.5;

/// Share of that error where depth is measured: planes are then what views lose the most by, and few.
const MEASURED: f64 = 0.5;

/// Pixels of parallax up to which a change of a pixel's estimated depth is mostly the network's own trembling, and the share of it that is taken.
const TREMBLES: (f64, f32) = (1.5, 0.4);

/// Share of that error by which measured depth of a pixel must leave the known one to count as changed.
const CHANGED: f64 = 0.3;

/// Share of a tile's pixels whose measured depth must leave the known one for the tile to count as changed though its colours did not.
const DEPTH_CHANGED: f64 = 0.02;

/// What a room is made with.
#[derive(Clone, Debug)]
pub struct Settings {
    /// As for a photo, but for the error ([`MAX_ERROR`]), of which measured depth has half; sizes, quality and budget do not count here.
    pub options: Options,
    /// How far an unchanged block may be from what its geometry was made of.
    pub tolerance: Tolerance,
    /// Pixels by which a tile that is not sent anew may show any point beside where its new planes would, from any camera of the view box
    /// ([`moved`]); 0: what differs at all is sent.
    pub parallax: f64,
    /// For how long frames rest after one of which tiles were sent: what changed in them waits for a later one. None does where depth is measured:
    /// tiles are then few, and right enough for their being late to show.
    pub rest: Duration,
    /// When estimated depth beside what moved is looked at once more.
    pub settles: Settling,
    /// Milliseconds that the geometry of a frame may take ([`Budget`]); 0: as long as it takes.
    pub frame_ms: f64,
    /// Nothing is carried from frame to frame: what a photo's driver would do, to compare with.
    pub separate: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            options: Options { max_error: MAX_ERROR, ..Options::default() },
            tolerance: Tolerance::default(),
            parallax: PARALLAX,
            rest: REST,
            settles: SETTLES,
            frame_ms: 0.0,
            separate: false,
        }
    }
}

impl Settings {
    /// The tiles of frames of that size, and the camera, before anything is known of them.
    #[must_use]
    pub fn empty(&self, width: u32, height: u32) -> core::Geometry {
        let grid = self.options.grid(width, height);
        let intrinsics = match self.options.fov_x {
            Some(fov) => Intrinsics::from_fov_x(width, height, fov),
            None => Intrinsics::centred(width, height, Intrinsics::DEFAULT_FOCAL_PER_WIDTH * f64::from(width)),
        };
        let tiles = vec![Tile::default(); grid.tiles() as usize];
        core::Geometry { grid, intrinsics, view_box: self.options.view_box, tiles, matted: false }
    }
}

/// A decoded frame.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Its number.
    pub number: u64,
    /// When it was taken, or came, counted from any time.
    pub at: Duration,
    /// Its pixels.
    pub photo: Photo,
    /// Measured disparity at the frame's size, 0 to 1, where the camera gives it.
    pub depth: Option<DisparityMap>,
}

/// What a frame changed.
#[derive(Clone, Debug, Default)]
pub struct Update {
    /// A new scene begins with it.
    pub cut: bool,
    /// Tiles whose pixels changed, by number.
    pub changed: Vec<u32>,
    /// Tiles whose planes or labels moved by more than the tolerance: readers get them.
    pub sent: Vec<u32>,
    /// Tiles that were placed anew and are not sent: readers and this room go on with what was sent of them last.
    pub kept: Vec<u32>,
    /// Pixels by which these are off at the most: a bound, from any camera of the view box.
    pub kept_off: f64,
    /// These, coded.
    pub chunks: Vec<Chunk>,
    /// Changed tiles that wait for a later frame.
    pub waiting: usize,
    /// Tiles that were given fewer planes than they may need, as there was no time for more; they are looked at again when there is.
    pub coarse: usize,
    /// Size that the depth network ran at, where it did and has a choice.
    pub depth_size: Option<(u32, u32)>,
    /// What the stages took.
    pub stages: Vec<StageTime>,
    /// What coding the chunks took, in milliseconds.
    pub coding_ms: f64,
}

/// Geometry that goes on from frame to frame.
pub struct Geometry {
    models: Models,
    settings: Settings,
    limits: Limits,
    budget: Budget,
    compare: Compare,
    planes: Planes,
    state: Option<State>,
    /// All tiles as readers have them: after a cut those of the scene before, where there was no time yet for a tile of this one.
    told: Option<core::Geometry>,
}

/// What is known of the last frame, and of others since the last cut.
struct State {
    /// As it was sent last, tile by tile: what is not sent is not taken here either, so that errors never add up. Without planes where nothing was.
    geometry: core::Geometry,
    /// Depth has been looked at.
    known: bool,
    /// When the last frame was taken of which tiles were sent and after which others rest.
    sent: Option<Duration>,
    /// Disparity of each pixel as of the frame that last changed it.
    delta: DisparityMap,
    /// Changed blocks whose depth has not been looked at yet.
    stale: Vec<bool>,
    /// Blocks whose estimated depth is to be looked at once more.
    settle: Settle,
    /// Tiles whose planes have not been placed yet, or not as many as they need.
    queue: Queue,
}

/// Why a frame has no geometry.
#[derive(Debug, thiserror::Error)]
pub enum GeometryError {
    /// A stage failed.
    #[error(transparent)]
    Make(#[from] MakeError),
    /// The tiles cannot be sent.
    #[error(transparent)]
    Live(#[from] LiveError),
    /// The depth is not of the frame's size.
    #[error("depth of {0}×{1} with a frame of {2}×{3}")]
    Depth(u32, u32, u32, u32),
}

impl Geometry {
    /// Knows no frame yet.
    #[must_use]
    pub fn new(models: Models, settings: Settings) -> Self {
        let (budget, compare) = (Budget::new(settings.frame_ms), Compare::new(settings.tolerance));
        Self { models, settings, limits: Limits::default(), budget, compare, planes: Planes::carrying(), state: None, told: None }
    }

    /// All tiles as readers have them now, who took every chunk: those of the scene before a cut as long as they wait for a later frame. None before
    /// each was placed once.
    #[must_use]
    pub fn geometry(&self) -> Option<&core::Geometry> {
        self.told.as_ref().filter(|g| g.tiles.iter().all(|t| !t.planes.is_empty()))
    }

    /// Of each pixel what it was when its block changed last, which is what its depth was told of.
    #[must_use]
    pub const fn reference(&self) -> Option<&Photo> {
        self.compare.reference()
    }

    /// All tiles as one chunk, as of frame `number`: what a reader that has none begins with.
    ///
    /// # Errors
    /// [`LiveError`] where a tile cannot be coded.
    pub fn snapshot(&self, number: u64) -> Result<Option<Chunk>, LiveError> {
        let coded = |g: &core::Geometry| chunk::encode(&g.grid, Area::all(&g.grid), &g.tiles, number);
        self.geometry().map(coded).transpose()
    }

    /// Takes a frame; gives what it changed.
    ///
    /// # Errors
    /// [`GeometryError`]; what is known stays as it was, and the frame's changes are taken up with the next one.
    pub fn next(&mut self, frame: &Frame) -> Result<Update, GeometryError> {
        if let Some(d) = frame.depth.as_ref().filter(|d| (d.width, d.height) != (frame.photo.width, frame.photo.height)) {
            return Err(GeometryError::Depth(d.width, d.height, frame.photo.width, frame.photo.height));
        }
        if self.settings.separate {
            // the first frame of any is a cut
            self.compare = Compare::new(self.settings.tolerance);
        }
        let models = self.models.clone();
        let mut options = self.settings.options.clone();
        if frame.depth.is_some() && !self.settings.separate {
            options.max_error *= MEASURED;
        }
        let mut job = Context::new(&models, &self.limits, &options, &Silent);
        let change = job.run(&mut self.compare, &frame.photo)?;
        if change.cut {
            self.state = None;
            self.planes.forget();
        }
        let mut update = Update { cut: change.cut, ..Update::default() };
        let state = self.state.get_or_insert_with(|| State::new(&frame.photo, &self.settings));
        let grid = state.geometry.grid;
        state.take(&change, &grid, &mut update.changed);
        if frame.depth.is_none() && state.known {
            let due = state.settle.next(&change);
            state.take(&due, &grid, &mut Vec::new());
        }
        if let Some(depth) = &frame.depth {
            state.take_depth(depth, &grid, target(&state.geometry, CHANGED * options.max_error), change.across);
        }
        let known = state.known;
        // a clock that was put back gives no reason to wait for it
        let since = state.sent.and_then(|sent| frame.at.checked_sub(sent));
        let rests = since.is_some_and(|since| since < self.settings.rest);
        let measured = frame.depth.is_some();
        if !rests && state.stale.contains(&true) {
            let sizes = if measured { Vec::new() } else { models.depth.sizes(frame.photo.width, frame.photo.height) };
            if let Some(size) = self.budget.depth(&sizes, measured || !known) {
                let before = Instant::now();
                let part = if known { state.stale_part(change.across) } else { None };
                update.depth_size = sizes.get(size).copied();
                let (map, network_ms) = estimate(&mut job, frame, update.depth_size, part)?;
                self.budget.depth_took(ms(before), network_ms);
                state.join(map, known && !measured, change.across);
            }
        }
        if !rests && !state.stale.contains(&true) {
            let most = (options.planes == PlaneCount::Auto).then_some(MAX_AUTO_PLANES);
            let share = self.budget.tiles(state.queue.waiting(), most);
            let wanted = state.queue.next(share.tiles, share.planes.is_none());
            if !wanted.is_empty() {
                let before = Instant::now();
                let counts = state.place(&mut job, &mut self.planes, frame, (&wanted, share, self.settings.parallax), &mut update)?;
                self.budget.tiles_took(&counts, share.planes.is_none(), ms(before));
                state.sent = (!update.sent.is_empty() && !measured).then_some(frame.at);
            }
        }
        state.queue.age();
        (update.waiting, update.coarse) = (state.queue.waiting(), state.queue.coarse());
        update.stages = job.finish().stages;
        let before = Instant::now();
        let sent = |t: u32| update.sent.binary_search(&t).is_ok();
        let coded = |area| chunk::encode(&grid, area, &state.geometry.tiles, frame.number);
        update.chunks = Area::covering(&grid, sent).into_iter().map(coded).collect::<Result<_, _>>()?;
        update.coding_ms = ms(before);
        tell(&mut self.told, &state.geometry, &update.sent);
        Ok(update)
    }
}

/// Notes that readers have these tiles now.
fn tell(told: &mut Option<core::Geometry>, now: &core::Geometry, sent: &[u32]) {
    match told {
        Some(told) if told.grid == now.grid => {
            for t in sent {
                told.tiles[*t as usize] = now.tiles[*t as usize].clone();
            }
        }
        _ => *told = Some(now.clone()),
    }
}

fn ms(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

/// Error in δ that is so many pixels of parallax.
fn target(g: &core::Geometry, pixels: f64) -> f64 {
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
            settle: Settle::new(blocks, settings.settles),
            known: false,
            sent: None,
        }
    }

    /// The rectangle of all stale blocks, clipped to the picture; none where there is none.
    fn stale_part(&self, across: usize) -> Option<Rect> {
        let stale = || self.stale.iter().enumerate().filter(|(_, s)| **s).map(|(i, _)| (i % across, i / across));
        let (x0, x1) = (stale().map(|b| b.0).min()? as u32 * BLOCK, (stale().map(|b| b.0).max()? as u32 + 1) * BLOCK);
        let (y0, y1) = (stale().map(|b| b.1).min()? as u32 * BLOCK, (stale().map(|b| b.1).max()? as u32 + 1) * BLOCK);
        let (x1, y1) = (x1.min(self.delta.width), y1.min(self.delta.height));
        Some(Rect { x: x0, y: y0, w: x1 - x0, h: y1 - y0 })
    }

    /// Notes what changed.
    fn take(&mut self, change: &Change, grid: &Grid, changed: &mut Vec<u32>) {
        for (stale, by) in self.stale.iter_mut().zip(&change.blocks) {
            *stale |= *by > 0;
        }
        for (t, by) in (0..).zip(change.tiles(grid)) {
            self.queue.add(t, by);
            if by > 0 {
                changed.push(t);
            }
        }
    }

    /// Notes tiles whose measured depth has changed though their colours have not.
    fn take_depth(&mut self, depth: &DisparityMap, grid: &Grid, target: f64, across: usize) {
        for t in 0..grid.tiles() {
            let r = grid.rect(t);
            let off = |y: u32| {
                let row = y as usize * grid.width as usize + r.x as usize;
                let (new, old) = (&depth.delta[row..][..r.w as usize], &self.delta.delta[row..][..r.w as usize]);
                new.iter().zip(old).filter(|(a, b)| f64::from((*a - *b).abs()) > target).count()
            };
            let count: usize = (r.y..r.y + r.h).map(off).sum();
            if !self.queue.waits(t) && count as f64 > DEPTH_CHANGED * r.area() as f64 {
                self.queue.add(t, count as u64);
                for y in r.y / BLOCK..(r.y + r.h).div_ceil(BLOCK) {
                    let row = y as usize * across;
                    self.stale[row + (r.x / BLOCK) as usize..row + (r.x + r.w).div_ceil(BLOCK) as usize].fill(true);
                }
            }
        }
    }

    /// Takes a new map over where blocks are stale; with `align`, brought to the scale of the others first, and small changes in part.
    fn join(&mut self, mut map: Estimated, align: bool, across: usize) {
        let width = self.delta.width as usize;
        let block = |i: usize| i / width / BLOCK as usize * across + i % width / BLOCK as usize;
        let trembles = if align { (TREMBLES.0 * target(&self.geometry, 1.0)) as f32 } else { 0.0 };
        if align {
            let steady: Vec<bool> = (0..self.delta.delta.len()).map(|i| !self.stale[block(i)]).collect();
            align::fit(&map.delta, &self.delta, &steady).apply(&mut map.delta.delta);
            align::meet(&mut map.delta, &self.delta, &self.stale, across);
        }
        for (i, (to, new)) in self.delta.delta.iter_mut().zip(&map.delta.delta).enumerate() {
            if self.stale[block(i)] {
                *to = if (*new - *to).abs() < trembles { *to + TREMBLES.1 * (*new - *to) } else { *new };
            }
        }
        self.stale.fill(false);
        self.known = true;
    }

    /// Places the planes of some tiles; `update` is told, in order, of those that moved by more than `parallax` pixels, and of the others. Gives how
    /// many planes each was found to have.
    fn place(
        &mut self,
        job: &mut Context,
        planes: &mut Planes,
        frame: &Frame,
        (wanted, share, parallax): (&[u32], Share, f64),
        update: &mut Update,
    ) -> Result<Vec<usize>, MakeError> {
        let mut chosen = vec![false; self.geometry.tiles.len()];
        for t in wanted {
            chosen[*t as usize] = true;
        }
        planes.change(chosen.clone());
        planes.at_most(share.planes);
        let intrinsics = self.geometry.intrinsics;
        // the stage looks at camera and map alone
        let photo = Photo { width: frame.photo.width, height: frame.photo.height, rgb: Vec::new() };
        let prepared = Prepared { photo, intrinsics, format: PhotoFormat::Jpeg, uploaded: None, reduced: None, other_eye: None };
        let map = Estimated {
            delta: std::mem::replace(&mut self.delta, DisparityMap { width: 0, height: 0, delta: Vec::new() }),
            confidence: None,
            given: true,
        };
        let placed = job.run(planes, (&prepared, &map));
        self.delta = map.delta;
        let mut geometry = placed?.geometry;
        layers::add_backgrounds_to(&mut geometry, &self.delta, |t| chosen[t as usize]);
        let mut counts = Vec::with_capacity(wanted.len());
        for (t, new) in (0..).zip(geometry.tiles).filter(|(t, _)| chosen[*t as usize]) {
            counts.push(new.planes.len());
            self.queue.done(t, share.planes.is_some_and(|most| new.planes.len() >= most as usize));
            let held = &self.geometry.tiles[t as usize];
            if *held == new {
                continue;
            }
            let off = moved(&self.geometry, t, held, &new);
            if off > parallax {
                self.geometry.tiles[t as usize] = new;
                update.sent.push(t);
            } else {
                // the next ones start from what readers have
                planes.hold(t, held);
                update.kept.push(t);
                update.kept_off = update.kept_off.max(off);
            }
        }
        Ok(counts)
    }
}

#[cfg(test)]
mod tests;
#[cfg(test)]
mod viewer_tests;
