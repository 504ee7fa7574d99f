//! Layers of a room's tiles, kept from frame to frame: what neither a tile nor a pixel near it changed stays as it was. Without a memory
//! what comes out is what would come of tiles and frame alone, without those before: at once but for hidden colours, which
//! follow within a few frames where nothing but the picture changed. With a memory labels also follow what moves, between frames for which any
//! came.

use super::motion::Motion;
use crate::container::{Part, PhotoRows};
use crate::layers::{CONTEXT, Surface};
use crate::{Class, Geometry, Inpainter, Layer, LayerMasks, Memory, Photo, Pyramid, Rect, Scene, Texels, grown};

/// A hidden colour follows from pixels so far off, and these from the surface beside them.
const AROUND: u32 = CONTEXT + 1;
/// Of the tiles whose hidden colours alone are out of date, so many parts are made anew, one a frame: they show little, and cost the most.
const TURNS: u32 = 4;
/// Frames after one for which tiles came up to which labels follow what moves.
const FOLLOWS: u32 = 3;

/// Layers and texels of all tiles.
#[derive(Default)]
pub struct Layers {
    photo: PhotoRows,
    surface: Option<Surface>,
    parts: Vec<Part>,
    /// Whose hidden colours are out of date.
    stale: Vec<bool>,
    /// Which of the [`TURNS`] is next.
    turn: u32,
    pyramid: Pyramid,
    remembers: bool,
    memory: Option<Memory>,
    /// The frame for which tiles came last, and how many came since.
    told: (Vec<[u8; 3]>, u32),
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
        Self { remembers: true, ..Self::default() }
    }

    /// The frame that is shown.
    #[must_use]
    pub const fn photo(&self) -> &PhotoRows {
        &self.photo
    }

    /// What is remembered, where anything is.
    #[must_use]
    pub const fn memory(&self) -> Option<&Memory> {
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
        let photo = Photo { width: self.photo.width, height: self.photo.height, rgb: self.photo.rgb.clone() };
        Scene { grid: geometry.grid, intrinsics: geometry.intrinsics, view_box: geometry.view_box, photo, layers, texels }
    }

    /// Takes the next frame, and the tiles, of which those are others for which `changed` is true. A frame that is not of the grid's size
    /// changes nothing.
    pub fn update(&mut self, geometry: &Geometry, changed: impl Fn(u32) -> bool, photo: Photo) -> Changes {
        let grid = &geometry.grid;
        if (photo.width, photo.height) != (grid.width, grid.height) || photo.rgb.len() != grid.width as usize * grid.height as usize {
            return Changes::default();
        }
        let anew = (self.photo.width, self.photo.height, self.parts.len()) != (grid.width, grid.height, grid.tiles() as usize);
        let mut changed: Vec<bool> = (0..grid.tiles()).map(|t| anew || changed(t)).collect();
        let pixels: Vec<Option<Rect>> =
            (0..grid.tiles()).map(|t| if anew { Some(grid.rect(t)) } else { difference(&self.photo.rgb, &photo, grid.rect(t)) }).collect();
        let kept = self.surface.take().filter(|_| !changed.contains(&true));
        let surface = kept.unwrap_or_else(|| geometry.surface());
        if anew {
            self.moved = vec![false; grid.tiles() as usize];
            self.parts = vec![Part::default(); grid.tiles() as usize];
            self.stale = vec![false; grid.tiles() as usize];
            self.memory = self.remembers.then(|| Memory::new(*grid));
        }
        let with_moved = if self.remembers { self.move_labels(geometry, &surface, &mut changed, &photo.rgb) } else { None };
        let of_moved = with_moved.as_ref().map(Geometry::surface);
        let (geometry, shown) = (with_moved.as_ref().unwrap_or(geometry), of_moved.as_ref().unwrap_or(&surface));
        if let Some(memory) = &mut self.memory {
            memory.take(&photo, shown.clone());
        }
        self.photo = PhotoRows { width: photo.width, height: photo.height, top: 0, rgb: photo.rgb };
        let changes = self.follow(geometry, shown, &changed, &pixels);
        (self.surface, self.with_moved) = (Some(surface), with_moved);
        changes
    }

    /// The tiles with labels that have followed what moved since the frame for which any came, none where none have; adds those to `changed` that
    /// have, or had in the frame before.
    fn move_labels(&mut self, geometry: &Geometry, surface: &Surface, changed: &mut [bool], now: &[[u8; 3]]) -> Option<Geometry> {
        let told = changed.contains(&true);
        for (changed, moved) in changed.iter_mut().zip(&mut self.moved) {
            *changed |= std::mem::take(moved);
        }
        if told {
            self.told = (now.to_vec(), 0);
            return None;
        }
        self.told.1 += 1;
        if self.told.1 > FOLLOWS {
            return None;
        }
        let motion = Motion::new(geometry, surface, &self.told.0, now);
        let mut out = None;
        for t in 0..geometry.grid.tiles() {
            let Some(labels) = motion.labels(t) else { continue };
            out.get_or_insert_with(|| geometry.clone()).tiles[t as usize].labels = labels;
            (changed[t as usize], self.moved[t as usize]) = (true, true);
        }
        out
    }

    fn follow(&mut self, geometry: &Geometry, surface: &Surface, changed: &[bool], pixels: &[Option<Rect>]) -> Changes {
        let grid = &geometry.grid;
        let tiles: Vec<Rect> = (0..).zip(changed).filter(|(_, c)| **c).map(|(t, _)| grid.rect(t)).collect();
        let mut inpainter = None;
        let mut out = Changes::default();
        self.turn = (self.turn + 1) % TURNS;
        for t in 0..grid.tiles() {
            let (rect, part) = (grid.rect(t), &mut self.parts[t as usize]);
            let window = geometry.window(t);
            let reshaped = changed[t as usize] || tiles.iter().any(|c| overlap(c, &window));
            if reshaped {
                let masks = geometry.masks_of(t..t + 1, surface, false).pop().unwrap_or_default();
                *part = shaped(t, masks);
                out.layers.push(t);
            }
            let around = grown(rect, AROUND, AROUND, grid);
            let near = || pixels.iter().flatten().chain(&tiles).any(|c| overlap(c, &around));
            let mut other = reshaped || pixels[t as usize].is_some();
            let stale = &mut self.stale[t as usize];
            *stale = part.texels.class.contains(&(Class::Hidden as u8)) && (reshaped || *stale || near());
            if *stale && (reshaped || t % TURNS == self.turn) {
                *stale = false;
                let inpainter = inpainter.get_or_insert_with(|| Inpainter::on(*grid, surface.clone(), &self.photo.rgb));
                let hidden = coloured(inpainter, self.memory.as_ref(), part, &mut self.pyramid);
                other |= hidden != part.texels.hidden;
                part.texels.hidden = hidden;
            }
            if other {
                out.texels.push(t);
            }
        }
        out
    }
}

/// Bounds of the pixels of a rectangle that differ; none where none does.
fn difference(old: &[[u8; 3]], new: &Photo, r: Rect) -> Option<Rect> {
    let (mut x0, mut y0, mut x1, mut y1) = (r.w as usize, 0, 0, 0);
    let mut any = false;
    for y in 0..r.h {
        let at = ((r.y + y) * new.width + r.x) as usize;
        let (old, new) = (&old[at..at + r.w as usize], &new.rgb[at..at + r.w as usize]);
        if old == new {
            continue;
        }
        let differ = |(a, b): (&[u8; 3], &[u8; 3])| a != b;
        let first = old.iter().zip(new).position(differ).unwrap_or(0);
        let last = old.iter().zip(new).rposition(differ).unwrap_or(0);
        (x0, x1) = (x0.min(first), x1.max(last + 1));
        (y0, y1) = (if any { y0 } else { y }, y + 1);
        any = true;
    }
    any.then(|| Rect { x: r.x + x0 as u32, y: r.y + y0, w: (x1 - x0) as u32, h: y1 - y0 })
}

fn overlap(a: &Rect, b: &Rect) -> bool {
    a.x < b.x + b.w && b.x < a.x + a.w && a.y < b.y + b.h && b.y < a.y + a.h
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

fn coloured(inpainter: &Inpainter, memory: Option<&Memory>, part: &Part, pyramid: &mut Pyramid) -> Vec<[u8; 3]> {
    let mut out = Vec::with_capacity(part.texels.hidden.len());
    for l in &part.layers {
        let class = &part.texels.class[l.first_texel..l.first_texel + l.rect.area()];
        let mut colours = inpainter.fill(l.tile, &l.plane, l.rect, class, pyramid);
        if let Some(memory) = memory {
            memory.recall_layer(l.tile, &l.plane, l.rect, class, &mut colours);
        }
        out.extend(colours);
    }
    out
}
