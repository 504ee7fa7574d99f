//! Layers of a room's tiles, kept from frame to frame: what neither a tile nor a pixel near it changed stays as it was. Without a memory
//! what comes out is what would come of tiles and frame alone, without those before: at once but for hidden colours, which
//! follow within a quarter of a second where nothing but the picture changed. With a memory labels also follow what moves, between frames for which any
//! came.

use std::time::Duration;

use super::changed_blocks::Blocks;
use super::label_motion::{Motion, Way};
use super::shown_frames::{self, History, Shown, When};
use crate::container::{Part, texels};
use crate::layers::{CONTEXT, MOST, STEADY, Surface};
use crate::scene::packed_rgb;
use crate::{Class, Geometry, Inpainter, Layer, LayerMasks, Photo, Pyramid, Scene, SeenBackground, Texels, grown};

/// A hidden colour follows from pixels so far off, and these from the surface beside them.
const AROUND: u32 = CONTEXT + 1;
/// Of the tiles whose hidden colours alone are out of date, so many parts are made anew, one each [`TURN`]: they show little, and cost the most.
pub(super) const TURNS: u32 = 8;
/// A frame's time at 30 a second. Where frames are shown more seldom several parts have their turn, so that none waits longer.
pub(super) const TURN: Duration = Duration::from_micros(33_333);
/// Frames after one for which tiles came up to which labels follow what moves.
pub const FOLLOWS: u32 = shown_frames::KEPT as u32;

/// Layers and texels of all tiles.
#[derive(Default)]
pub struct Layers {
    photo: Photo,
    /// Its colours as words.
    words: Vec<u32>,
    /// The tiles' visible surface as they came.
    surface: Option<Surface>,
    /// The same with labels that have followed what moved, where there are such.
    moved_surface: Option<Surface>,
    parts: Vec<Part>,
    /// Whose hidden colours are out of date.
    stale: Vec<bool>,
    /// Frames, at 30 a second, since anything changed that the hidden colours of a tile depend on.
    since: Vec<u8>,
    /// Which of the [`TURNS`] is next.
    turn: u32,
    pyramid: Pyramid,
    remembers: bool,
    /// Frames up to which labels follow what moves.
    follows: u32,
    memory: Option<SeenBackground>,
    /// The frame that the tiles which came last are of, and how many came since.
    told: (Shown, u32),
    /// The frames before, for tiles that come late.
    history: History,
    /// Number of the frame that is shown, and when it was taken.
    now: (u64, Duration),
    /// Where the things in each tile were last found to go.
    ways: Vec<Option<Way>>,
    /// Tiles whose labels have followed what moved.
    moved: Vec<bool>,
    /// All tiles with these labels, where there are such.
    with_moved: Option<Geometry>,
}

/// Numbers of the tiles that are others than before, in order.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Changes {
    /// Any of whose texels may be another.
    pub texels: Vec<u32>,
    /// Those of them that have other layers, or layers of another shape.
    pub layers: Vec<u32>,
}

impl Layers {
    /// The same that show what was seen before something came in front of it.
    #[must_use]
    pub fn remembering() -> Self {
        Self { remembers: true, follows: FOLLOWS, ..Self::default() }
    }

    /// The same whose labels follow what moves in so many frames after one that tiles came of, [`FOLLOWS`] at most; 0: they stay where they were.
    #[must_use]
    pub fn following(self, frames: u32) -> Self {
        Self { follows: frames.min(FOLLOWS), ..self }
    }

    /// The frame that is shown.
    #[must_use]
    pub const fn photo(&self) -> &Photo {
        &self.photo
    }

    /// Adds the texels of a layer of a tile to `out`, row by row, premultiplied; false where there is no such layer.
    pub fn texels(&self, tile: u32, layer: usize, out: &mut Vec<[u8; 4]>) -> bool {
        let Some((part, layer)) = self.tile(tile).and_then(|part| Some((part, part.layers.get(layer)?))) else { return false };
        texels(part, layer, (&self.words, self.photo.width as usize), out);
        true
    }

    /// What is remembered, where anything is.
    #[must_use]
    pub const fn memory(&self) -> Option<&SeenBackground> {
        self.memory.as_ref()
    }

    /// The tiles as they are shown, where labels of some have followed what moved; none where all are as they came.
    #[must_use]
    pub const fn with_moved(&self) -> Option<&Geometry> {
        self.with_moved.as_ref()
    }

    /// Layers of a tile, and their texels.
    #[must_use]
    pub fn tile(&self, index: u32) -> Option<&Part> {
        self.parts.get(index as usize)
    }

    /// All that is shown, of a room whose grid and camera are those of `geometry`; nothing before the first frame.
    #[must_use]
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

    /// Takes the next frame, and the tiles, of which those are others for which `changed` is true. Where these are of a frame before, their labels
    /// follow what has moved since. A frame that is not of the grid's size changes nothing.
    pub fn update(&mut self, geometry: &Geometry, changed: impl Fn(u32) -> bool, photo: Photo, when: When) -> Changes {
        let grid = &geometry.grid;
        if (photo.width, photo.height) != (grid.width, grid.height) || photo.rgb.len() != grid.width as usize * grid.height as usize {
            return Changes::default();
        }
        let mut words = vec![0; photo.rgb.len()];
        packed_rgb::words(&photo.rgb, &mut words);
        let anew = (self.photo.width, self.photo.height, self.parts.len()) != (grid.width, grid.height, grid.tiles() as usize);
        let mut changed: Vec<bool> = (0..grid.tiles()).map(|t| anew || changed(t)).collect();
        let before = if anew { &[][..] } else { &self.words };
        let pixels = Blocks::that_differ(grid.width, before, &words);
        let last = std::mem::replace(&mut self.words, words);
        let kept = self.surface.as_ref().filter(|_| !changed.contains(&true));
        let surface = kept.cloned().unwrap_or_else(|| geometry.surface());
        if anew {
            self.moved = vec![false; grid.tiles() as usize];
            self.parts = vec![Part::default(); grid.tiles() as usize];
            self.stale = vec![false; grid.tiles() as usize];
            self.since = vec![0; grid.tiles() as usize];
            self.memory = self.remembers.then(|| SeenBackground::new(*grid));
            self.ways = vec![None; grid.tiles() as usize];
            self.history.clear();
        } else if self.remembers && when.gone.is_some() {
            self.history.add(Shown { number: self.now.0, at: self.now.1, words: last });
        }
        self.now = (when.frame, self.now.1 + when.gone.unwrap_or_default());
        let with_moved = if self.remembers { self.move_labels(geometry, &surface, when, &mut changed) } else { None };
        let of_moved = with_moved.as_ref().map(Geometry::surface);
        let (geometry, shown) = (with_moved.as_ref().unwrap_or(geometry), of_moved.as_ref().unwrap_or(&surface));
        let was = self.moved_surface.take().or_else(|| self.surface.take()).filter(|_| !anew);
        let depth = Blocks::that_differ(grid.width, was.as_ref().map_or(&[], Surface::all), shown.all());
        let unmixed = shown.without_mixed();
        if let Some(memory) = &mut self.memory {
            memory.take(&self.words, shown, &unmixed, frames(when.gone));
        }
        self.photo = photo;
        let changes = self.follow(geometry, (shown, unmixed), &changed, (&pixels, &depth), frames(when.gone));
        (self.surface, self.moved_surface, self.with_moved) = (Some(surface), of_moved, with_moved);
        changes
    }

    /// The tiles with labels that have followed what moved since the frame that they are of, none where none have; adds those to `changed` that
    /// have, or had in the frame before.
    fn move_labels(&mut self, geometry: &Geometry, surface: &Surface, when: When, changed: &mut [bool]) -> Option<Geometry> {
        let told = changed.contains(&true);
        for (changed, moved) in changed.iter_mut().zip(&mut self.moved) {
            *changed |= std::mem::take(moved);
        }
        if told {
            let late = when.tiles.filter(|of| *of < when.frame).and_then(|of| self.history.since(of));
            let now = || (Shown { number: self.now.0, at: self.now.1, words: self.words.clone() }, 0);
            self.told = late.map_or_else(now, |(shown, late)| (shown.clone(), late));
        } else {
            self.told.1 += u32::from(when.gone.is_some());
        }
        let (told, since) = &self.told;
        if *since == 0 || *since > self.follows {
            return None;
        }
        let motion = Motion::new(geometry, surface, (&told.words, &self.words), self.now.1.saturating_sub(told.at));
        let mut out = None;
        let before = self.ways.clone();
        for t in 0..geometry.grid.tiles() {
            let way = motion.way(t, &before);
            self.ways[t as usize] = way;
            let Some(tile) = way.and_then(|way| motion.moved(t, way)) else { continue };
            out.get_or_insert_with(|| geometry.clone()).tiles[t as usize] = tile;
            (changed[t as usize], self.moved[t as usize]) = (true, true);
        }
        out
    }

    /// Brings the tiles up to what is others than before: `changed` tiles, `pixels`, and `depth` of the visible surface, which is given with and without what
    /// is mixed.
    fn follow(
        &mut self,
        geometry: &Geometry,
        (surface, unmixed): (&Surface, Surface),
        changed: &[bool],
        (pixels, depth): (&Blocks, &Blocks),
        frames: u8,
    ) -> Changes {
        let grid = &geometry.grid;
        let inpainter = Inpainter::among(*grid, unmixed, &self.photo.rgb);
        let mut out = Changes::default();
        let (first, turns) = (self.turn, u32::from(frames).min(TURNS));
        self.turn = (first + turns) % TURNS;
        for t in 0..grid.tiles() {
            let (rect, part) = (grid.rect(t), &mut self.parts[t as usize]);
            let around = grown(rect, AROUND, AROUND, grid);
            let (stale, its_turn) = (&mut self.stale[t as usize], (t + TURNS - first) % TURNS < turns);
            let mut other = pixels.any(&rect);
            let (since, changes) = (&mut self.since[t as usize], pixels.any(&around) || depth.any(&around));
            *stale |= changes;
            *since = if changes { 0 } else { since.saturating_add(frames.min(MOST)) };
            let new = (changed[t as usize] || depth.any(&geometry.window(t)))
                .then(|| shaped(t, geometry.masks_of(t..t + 1, surface, false).pop().unwrap_or_default()))
                .filter(|new| !alike(new, part));
            let (reshaped, turn) = (new.is_some(), *stale && its_turn);
            if reshaped || turn {
                let of = new.as_ref().unwrap_or(part);
                // a layer that is what it was waits for its turn
                let before = if turn { &Part::default() } else { &*part };
                let (hidden, all_anew) = coloured(&inpainter, self.memory.as_ref(), (of, before), &mut self.pyramid);
                other |= reshaped || hidden != part.texels.hidden;
                // what is seen since then is remembered only later
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

/// Frames of 30 a second that a time is as long as, at least one, also where a publisher's clock stands still.
fn frames(gone: Option<Duration>) -> u8 {
    gone.map_or(0, |gone| ((gone.as_secs_f64() / TURN.as_secs_f64()).round() as u8).max(1))
}

/// Whether two parts have the same layers and texels, whatever colours these have.
fn alike(a: &Part, b: &Part) -> bool {
    a.layers == b.layers && a.texels.class == b.texels.class && a.texels.alpha == b.texels.alpha
}

/// Layers of a tile without their hidden colours.
fn shaped(tile: u32, masks: LayerMasks) -> Part {
    let (mut layers, mut texels, mut hidden) = (Vec::new(), Texels::default(), 0);
    for mask in masks.layers {
        layers.push(Layer { tile, plane: mask.plane, rect: mask.rect, first_texel: texels.class.len(), first_hidden: hidden });
        hidden += mask.class.iter().filter(|&&c| c == Class::Hidden as u8).count();
        texels.class.extend_from_slice(&mask.class);
        texels.alpha.extend_from_slice(&mask.alpha);
    }
    Part { layers, texels }
}

/// Hidden colours of a tile: those of `before` of layers that it has, too; those that were seen; and for the rest such as are made up, which costs
/// the most by far. And whether all are made anew.
fn coloured(
    inpainter: &Inpainter,
    memory: Option<&SeenBackground>,
    (part, before): (&Part, &Part),
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
fn classes<'a>(part: &'a Part, l: &Layer) -> &'a [u8] {
    &part.texels.class[l.first_texel..l.first_texel + l.rect.area()]
}
