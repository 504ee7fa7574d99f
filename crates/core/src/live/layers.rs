//! Layers of a room's tiles, updated incrementally: tiles stay unchanged unless their own data or nearby pixels change.
//!
//! Without a memory, the result depends only on the current tiles and frame, as if computed from scratch. It is immediate except for hidden
//! colours, which follow within a quarter of a second if only the picture changed. With a memory, labels also follow motion in frames
//! without new tiles.

use std::time::Duration;

use super::changed_blocks::Blocks;
use super::label_motion::{MotionSearch, MotionVector};
use super::shown_frames::{self, FrameTiming, History, Shown};
use crate::container::{TileLayers, texels};
use crate::layers::{BLOCK, CONTEXT, MAX_FRAMES, STEADY, Surface};
use crate::scene::packed_rgb;
use crate::{Class, Geometry, Inpainter, Layer, LayerMasks, Photo, Pyramid, Scene, SeenBackground, Texels, grown};

/// Distance, in pixels, that a hidden colour depends on: the inpainting context, plus one pixel of the surface around it.
const AROUND: u32 = CONTEXT + 1;
/// Tiles with nothing but stale hidden colours are recomputed in this many groups, one per [`TURN`], because they show little and cost
/// most.
pub(super) const TURNS: u32 = 8;
/// Duration of a frame at 30 a second. If frames are less frequent, several groups have their turn at once, so that none waits longer.
pub(super) const TURN: Duration = Duration::from_micros(33_333);
/// Maximum number of shown frames, after the frame of the last tiles, in which labels follow motion.
pub const MAX_MOTION_FRAMES: u32 = shown_frames::KEPT as u32;

/// Layers and texels of all tiles, updated from frame to frame.
#[derive(Default)]
pub struct Layers {
    photo: Photo,
    /// Colours of the photo as words.
    words: Vec<u32>,
    /// Visible surface of the tiles as received.
    surface: Option<Surface>,
    /// Visible surface with labels that have followed motion, if there are any.
    moved_surface: Option<Surface>,
    parts: Vec<TileLayers>,
    /// Tiles whose hidden colours are out of date.
    stale: Vec<bool>,
    /// Frames, at 30 a second, since the last change to what a tile's hidden colours depend on.
    since: Vec<u8>,
    /// The next of the [`TURNS`] groups.
    turn: u32,
    pyramid: Pyramid,
    remembers: bool,
    /// Number of frames in which labels follow motion.
    follows: u32,
    memory: Option<SeenBackground>,
    /// The frame of the tiles received last, and the number of frames since: known ones until the tiles arrived, then shown ones.
    received: (Shown, u32),
    /// The previous frames, for tiles that arrive late.
    history: History,
    /// Frames since the shown one that are not shown, oldest first; they join the history with the next shown frame.
    skipped: Vec<Shown>,
    /// Number and capture time of the shown frame.
    now: (u64, Duration),
    /// Last known motion of the objects in each tile.
    motion_vectors: Vec<Option<MotionVector>>,
    /// Tiles whose labels have followed motion.
    moved: Vec<bool>,
    /// All tiles with these labels, if there are any.
    moved_geometry: Option<Geometry>,
}

/// Indices of changed tiles, in ascending order.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Changes {
    /// Tiles with any changed texels.
    pub texels: Vec<u32>,
    /// Those of them whose layers changed in number, plane or shape.
    pub layers: Vec<u32>,
}

impl Layers {
    /// Layers with a memory: they show what was visible before something moved in front of it, and their labels follow motion.
    pub fn with_memory() -> Self {
        Self { remembers: true, follows: MAX_MOTION_FRAMES, ..Self::default() }
    }

    /// Limits the number of frames, after the frame of the last tiles, in which labels follow motion: at most [`MAX_MOTION_FRAMES`]. With
    /// 0, labels do not move.
    pub fn with_motion_frames(self, frames: u32) -> Self {
        Self { follows: frames.min(MAX_MOTION_FRAMES), ..self }
    }

    /// The shown frame.
    pub const fn photo(&self) -> &Photo {
        &self.photo
    }

    /// Appends the texels of a layer of a tile to `out`, row by row, as premultiplied RGBA. Returns false if there is no such layer.
    pub fn texels(&self, tile: u32, layer: usize, out: &mut Vec<[u8; 4]>) -> bool {
        let Some((part, layer)) = self.tile(tile).and_then(|part| Some((part, part.layers.get(layer)?))) else { return false };
        texels(part, layer, (&self.words, self.photo.width as usize), out);
        true
    }

    /// The memory, if these layers have one.
    pub const fn memory(&self) -> Option<&SeenBackground> {
        self.memory.as_ref()
    }

    /// The shown tiles, if labels of some have followed motion; `None` if all are as received.
    pub const fn moved_geometry(&self) -> Option<&Geometry> {
        self.moved_geometry.as_ref()
    }

    /// Layers and texels of a tile.
    pub fn tile(&self, index: u32) -> Option<&TileLayers> {
        self.parts.get(index as usize)
    }

    /// Everything that is shown, as a scene with the grid and camera of `geometry`; empty before the first frame.
    pub fn scene(&self, geometry: &Geometry) -> Scene {
        let (mut layers, mut texels) = (Vec::new(), Texels::default());
        for part in &self.parts {
            let (first_texel, first_hidden) = (texels.class.len(), texels.hidden.len());
            let placed = |l: &Layer| Layer { first_texel: l.first_texel + first_texel, first_hidden: l.first_hidden + first_hidden, ..*l };
            layers.extend(part.layers.iter().map(placed));
            texels.class.extend_from_slice(&part.texels.class);
            texels.alpha.extend_from_slice(&part.texels.alpha);
            texels.hidden.extend_from_slice(&part.texels.hidden);
        }
        let photo = self.photo.clone();
        Scene { grid: geometry.grid, intrinsics: geometry.intrinsics, view_box: geometry.view_box, photo, layers, texels }
    }

    /// Remembers a frame that was captured `elapsed` after the shown one and is not shown itself: labels of its tiles, which arrive later,
    /// then follow motion from this frame on. Ignores a frame whose size is not that of the shown one.
    pub fn skip(&mut self, photo: &Photo, frame: u64, elapsed: Duration) {
        if !self.remembers || photo.rgb.len() != self.words.len() || photo.width != self.photo.width {
            return;
        }
        let mut words = vec![0; photo.rgb.len()];
        packed_rgb::words(&photo.rgb, &mut words);
        if self.skipped.len() >= shown_frames::kept(words.len()) {
            self.skipped.remove(0);
        }
        self.skipped.push(Shown { number: frame, at: self.now.1 + elapsed, words });
    }

    /// Updates to the next frame and tiles; `changed` is true for the tiles that differ from the previous call. If the tiles belong to an
    /// earlier frame, their labels follow the motion since then. Ignores a frame whose size is not the grid's.
    pub fn update(&mut self, geometry: &Geometry, changed: impl Fn(u32) -> bool, photo: Photo, when: FrameTiming) -> Changes {
        let grid = &geometry.grid;
        if (photo.width, photo.height) != (grid.width, grid.height) || photo.rgb.len() != grid.width as usize * grid.height as usize {
            return Changes::default();
        }
        let mut words = vec![0; photo.rgb.len()];
        packed_rgb::words(&photo.rgb, &mut words);
        let anew = (self.photo.width, self.photo.height, self.parts.len()) != (grid.width, grid.height, grid.tiles() as usize);
        let mut changed: Vec<bool> = (0..grid.tiles()).map(|t| anew || changed(t)).collect();
        let before = if anew { &[][..] } else { &self.words };
        let pixels = Blocks::differing(grid.width, before, &words);
        let last = std::mem::replace(&mut self.words, words);
        let kept = self.surface.as_ref().filter(|_| !changed.contains(&true));
        let surface = kept.cloned().unwrap_or_else(|| geometry.surface());
        if anew {
            self.moved = vec![false; grid.tiles() as usize];
            self.parts = vec![TileLayers::default(); grid.tiles() as usize];
            self.stale = vec![false; grid.tiles() as usize];
            self.since = vec![0; grid.tiles() as usize];
            self.memory = self.remembers.then(|| SeenBackground::new(*grid));
            self.motion_vectors = vec![None; grid.tiles() as usize];
            self.history.clear();
            self.skipped.clear();
        } else if self.remembers && when.elapsed.is_some() {
            self.history.add(Shown { number: self.now.0, at: self.now.1, words: last });
            self.skipped.drain(..).for_each(|skipped| self.history.add(skipped));
        }
        self.now = (when.frame, self.now.1 + when.elapsed.unwrap_or_default());
        let moved_geometry = if self.remembers { self.move_labels(geometry, &surface, when, &mut changed) } else { None };
        let of_moved = moved_geometry.as_ref().map(Geometry::surface);
        let (geometry, shown) = (moved_geometry.as_ref().unwrap_or(geometry), of_moved.as_ref().unwrap_or(&surface));
        let was = self.moved_surface.take().or_else(|| self.surface.take()).filter(|_| !anew);
        let depth = Blocks::differing(grid.width, was.as_ref().map_or(&[], Surface::all), shown.all());
        let unmixed = shown.without_mixed();
        if let Some(memory) = &mut self.memory {
            memory.take(&self.words, shown, &unmixed, frames(when.elapsed));
        }
        self.photo = photo;
        let changes = self.update_tiles(geometry, (shown, unmixed), &changed, (&pixels, &depth), frames(when.elapsed));
        (self.surface, self.moved_surface, self.moved_geometry) = (Some(surface), of_moved, moved_geometry);
        changes
    }

    /// The tiles with labels that have followed the motion since the frame of the tiles; `None` if no label moved. Sets `changed` for tiles
    /// whose labels moved now or in the previous frame.
    fn move_labels(&mut self, geometry: &Geometry, surface: &Surface, when: FrameTiming, changed: &mut [bool]) -> Option<Geometry> {
        let received = changed.contains(&true);
        for (changed, moved) in changed.iter_mut().zip(&mut self.moved) {
            *changed |= std::mem::take(moved);
        }
        if received {
            let late = when.tiles.filter(|of| *of < when.frame).and_then(|of| self.history.since(of));
            let now = || (Shown { number: self.now.0, at: self.now.1, words: self.words.clone() }, 0);
            self.received = late.map_or_else(now, |(shown, late)| (shown.clone(), late));
        } else {
            self.received.1 += u32::from(when.elapsed.is_some());
        }
        let (received, since) = &self.received;
        if *since == 0 || *since > self.follows {
            return None;
        }
        let motion = MotionSearch::new(geometry, surface, (&received.words, &self.words), self.now.1.saturating_sub(received.at));
        let mut out = None;
        self.motion_vectors = motion.vectors(&self.motion_vectors);
        for (t, vector) in (0..).zip(&self.motion_vectors) {
            let Some(tile) = vector.and_then(|vector| motion.moved(t, vector)) else { continue };
            out.get_or_insert_with(|| geometry.clone()).tiles[t as usize] = tile;
            (changed[t as usize], self.moved[t as usize]) = (true, true);
        }
        out
    }

    /// Updates the tiles that depend on a change: in the tiles `changed`, in `pixels`, or in the `depth` of the visible surface, which is
    /// passed with and without mixed pixels.
    fn update_tiles(
        &mut self,
        geometry: &Geometry,
        (surface, unmixed): (&Surface, Surface),
        changed: &[bool],
        (pixels, depth): (&Blocks, &Blocks),
        frames: u8,
    ) -> Changes {
        let grid = &geometry.grid;
        let inpainter = Inpainter::with_sources(*grid, unmixed, &self.photo.rgb);
        let mut out = Changes::default();
        let (x, y) = geometry.reach();
        let (first, turns) = (self.turn, u32::from(frames).min(TURNS));
        self.turn = (first + turns) % TURNS;
        for t in 0..grid.tiles() {
            let (rect, part) = (grid.rect(t), &mut self.parts[t as usize]);
            let around = grown(rect, AROUND, AROUND, grid);
            let (stale, its_turn) = (&mut self.stale[t as usize], (t + TURNS - first) % TURNS < turns);
            let mut other = pixels.any(&rect);
            let (since, changes) = (&mut self.since[t as usize], pixels.any(&around) || depth.any(&around));
            *stale |= changes;
            *since = if changes { 0 } else { since.saturating_add(frames.min(MAX_FRAMES)) };
            let tile = &geometry.tiles[t as usize];
            // the window takes a search, so the largest that it can be is tried first
            let depends = || {
                (tile.planes.len() > 1 || tile.background.is_some())
                    && depth.any(&grown(rect, x + BLOCK, y + BLOCK, grid))
                    && depth.any(&geometry.window(t, surface))
            };
            let new = (changed[t as usize] || depends())
                .then(|| part_of(t, geometry.masks_of(t..t + 1, surface, false).pop().unwrap_or_default()))
                .filter(|new| !same_texels(new, part));
            let (reshaped, turn) = (new.is_some(), *stale && its_turn);
            if reshaped || turn {
                let of = new.as_ref().unwrap_or(part);
                // unchanged layers wait for their turn
                let before = if turn { &TileLayers::default() } else { &*part };
                let (hidden, all_anew) = hidden_colours(&inpainter, self.memory.as_ref(), (of, before), &mut self.pyramid);
                other |= reshaped || hidden != part.texels.hidden;
                // pixels seen since then are remembered only later
                *stale &= !all_anew || (self.memory.is_some() && *since <= STEADY);
                *part = new.unwrap_or_else(|| std::mem::take(part));
                part.texels.hidden = hidden;
            }
            *stale &= !part.texels.hidden.is_empty();
            if reshaped {
                out.layers.push(t);
            }
            if other {
                out.texels.push(t);
            }
        }
        out
    }
}

/// A duration in frames at 30 a second, rounded, at least 1 even if the publisher's clock stands still; 0 for `None`.
fn frames(elapsed: Option<Duration>) -> u8 {
    elapsed.map_or(0, |elapsed| ((elapsed.as_secs_f64() / TURN.as_secs_f64()).round() as u8).max(1))
}

/// True if two parts have the same layers, classes and alphas; ignores colours.
fn same_texels(a: &TileLayers, b: &TileLayers) -> bool {
    a.layers == b.layers && a.texels.class == b.texels.class && a.texels.alpha == b.texels.alpha
}

/// Layers of a tile, without hidden colours.
fn part_of(tile: u32, masks: LayerMasks) -> TileLayers {
    let (mut layers, mut texels, mut hidden) = (Vec::new(), Texels::default(), 0);
    for mask in masks.layers {
        layers.push(Layer { tile, plane: mask.plane, rect: mask.rect, first_texel: texels.class.len(), first_hidden: hidden });
        hidden += mask.class.iter().filter(|&&c| c == Class::Hidden as u8).count();
        texels.class.extend_from_slice(&mask.class);
        texels.alpha.extend_from_slice(&mask.alpha);
    }
    TileLayers { layers, texels }
}

/// Hidden colours of a tile: those of `before` for layers that it shares, then remembered ones, and the rest inpainted, which costs by far
/// the most. Also returns whether all colours are new.
fn hidden_colours(
    inpainter: &Inpainter,
    memory: Option<&SeenBackground>,
    (part, before): (&TileLayers, &TileLayers),
    pyramid: &mut Pyramid,
) -> (Vec<[u8; 3]>, bool) {
    let (mut out, mut all_anew) = (Vec::with_capacity(part.texels.hidden.len()), true);
    for l in &part.layers {
        let class = classes(part, l);
        let count = class.iter().filter(|&&c| c == Class::Hidden as u8).count();
        if count == 0 {
            continue;
        }
        let same = |b: &&Layer| (b.plane, b.rect) == (l.plane, l.rect) && classes(before, b) == class;
        if let Some(kept) = before.layers.iter().find(same).and_then(|b| before.texels.hidden.get(b.first_hidden..b.first_hidden + count)) {
            out.extend_from_slice(kept);
            all_anew = false;
            continue;
        }
        let seen = memory.map_or_else(|| vec![None; count], |m| m.seen_of(l.tile, &l.plane, l.rect, class));
        let mut wanted = class.to_vec();
        for (wanted, seen) in wanted.iter_mut().filter(|c| **c == Class::Hidden as u8).zip(&seen) {
            *wanted = if seen.is_some() { Class::Empty as u8 } else { Class::Hidden as u8 };
        }
        let mut made_up = inpainter.fill_some(l.tile, &l.plane, l.rect, (class, &wanted), pyramid).into_iter();
        out.extend(seen.into_iter().filter_map(|seen| seen.or_else(|| made_up.next())));
    }
    (out, all_anew)
}

/// Classes of a layer's texels.
fn classes<'a>(part: &'a TileLayers, l: &Layer) -> &'a [u8] {
    &part.texels.class[l.first_texel..l.first_texel + l.rect.area()]
}
