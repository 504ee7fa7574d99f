//! Labels peeled into RGBA layers: visible texels, hidden texels where they can be seen from the view box, soft alpha outwards.

use rayon::prelude::*;

use super::fill::Filler;
use super::planes::{TilePlanes, fit_points};
use crate::tmpi::{Class, DisparityMap, Grid, Photo, Plane, Rect};

/// What is needed to peel layers.
pub struct Peel<'a> {
    /// The photo.
    pub photo: &'a Photo,
    /// Its disparity, as the planes were fitted to.
    pub delta: &'a DisparityMap,
    /// The tiles.
    pub grid: Grid,
    /// Parallax in pixels, right and down, of a unit of disparity over the view box.
    pub parallax: (f64, f64),
}

/// One layer of a tile before all tiles are joined.
#[derive(Clone, Debug)]
pub struct PeeledLayer {
    /// Its plane.
    pub plane: Plane,
    /// Photo pixels that its texels stand for.
    pub rect: Rect,
    /// [`Class`] per texel.
    pub class: Vec<u8>,
    /// Straight alpha per texel.
    pub alpha: Vec<u8>,
    /// Colours of hidden texels in the order of `class`.
    pub hidden: Vec<[u8; 3]>,
}

/// The layers of a tile, from far to near at its centre.
#[derive(Clone, Debug, Default)]
pub struct PeeledTile {
    /// The layers.
    pub layers: Vec<PeeledLayer>,
    /// Layers and hidden texels that the view box never shows and that were therefore not made.
    pub left_out: LeftOut,
}

/// What a tile did without.
#[derive(Clone, Copy, Debug, Default)]
pub struct LeftOut {
    /// Hidden texels behind something that no camera of the view box looks past.
    pub hidden: usize,
}

/// Pixels around a tile that a backstop plane is fitted to (RECIPE, step 4).
const BACKSTOP_REACH: u32 = 32;
/// Fewest pixels that a backstop is fitted to.
const BACKSTOP_PIXELS: usize = 32;
/// How much farther than the whole tile they must be.
const BACKSTOP_STEP: f32 = 0.05;
/// Widest search for the edge that uncovers a hidden texel, in pixels.
const MAX_REACH: f64 = 96.0;
/// Pixels added to the parallax: bilinear footprint and rounding.
const MARGIN: f64 = 1.5;
/// A surface counts as open for a layer that lies at most this far in front of it.
const OPEN: f32 = 0.004;

/// Peels all tiles.
#[must_use]
pub fn peel(p: &Peel, planes: &[TilePlanes]) -> Vec<PeeledTile> {
    let filler = Filler::new(p.photo, p.delta);
    planes.par_iter().enumerate().map_init(Scratch::default, |s, (i, t)| peel_tile(p, &filler, i as u32, t, s)).collect()
}

#[derive(Default)]
struct Scratch {
    visible: Vec<f32>,
    open: Vec<bool>,
    reach: Vec<bool>,
}

fn peel_tile(p: &Peel, filler: &Filler, tile: u32, planes: &TilePlanes, s: &mut Scratch) -> PeeledTile {
    let r = p.grid.rect(tile);
    let place = Place { centre: p.grid.centre(tile), half: p.grid.half() };
    s.visible.clear();
    for (i, &l) in planes.labels.iter().enumerate() {
        let (x, y) = (r.x + i as u32 % r.w, r.y + i as u32 / r.w);
        s.visible.push(place.disparity(&planes.planes[l as usize], x, y));
    }
    let backstop = backstop(p, r, place, &s.visible);
    let mut out = PeeledTile::default();
    let all = planes.planes.iter().enumerate().map(|(j, q)| (Some(j as u8), *q)).chain(backstop.map(|q| (None, q)));
    for (label, plane) in all {
        let hidden = hidden_mask(p, r, place, planes, label, &plane, s, &mut out.left_out);
        let Some(layer) = assemble(p, filler, r, place, planes, label, plane, &hidden, &s.visible) else { continue };
        out.layers.push(layer);
    }
    // the backstop is the farthest at most places, but the order is by the tile's centre for all alike
    out.layers.sort_by(|a, b| a.plane.a.total_cmp(&b.plane.a));
    out
}

/// Where `(u, v)` of a tile lies in the photo.
#[derive(Clone, Copy)]
pub struct Place {
    /// Tile centre in pixels.
    pub centre: (f64, f64),
    /// Half a tile in pixels.
    pub half: f64,
}

impl Place {
    /// δ of a plane at the centre of pixel `(x, y)`.
    #[must_use]
    pub fn disparity(&self, plane: &Plane, x: u32, y: u32) -> f32 {
        plane.disparity((f64::from(x) + 0.5 - self.centre.0) / self.half, (f64::from(y) + 0.5 - self.centre.1) / self.half) as f32
    }
}

/// The rectangle grown by `x`, `y` pixels and clipped to the photo.
fn grown(r: Rect, x: u32, y: u32, grid: &Grid) -> Rect {
    let (x0, y0) = (r.x.saturating_sub(x), r.y.saturating_sub(y));
    Rect { x: x0, y: y0, w: (r.x + r.w + x).min(grid.width) - x0, h: (r.y + r.h + y).min(grid.height) - y0 }
}

/// A plane for background that only the neighbourhood shows: without it, gaps wider than the tile's reach stay empty.
fn backstop(p: &Peel, r: Rect, place: Place, visible: &[f32]) -> Option<Plane> {
    let nearest_back = visible.iter().copied().fold(f32::INFINITY, f32::min);
    let win = grown(r, BACKSTOP_REACH, BACKSTOP_REACH, &p.grid);
    let mut points = Vec::new();
    for y in win.y..win.y + win.h {
        let row = y as usize * p.delta.width as usize;
        for x in win.x..win.x + win.w {
            let inside = x >= r.x && x < r.x + r.w && y >= r.y && y < r.y + r.h;
            let d = p.delta.delta[row + x as usize];
            if inside || d >= nearest_back - BACKSTOP_STEP {
                continue;
            }
            let (ux, uy) = (f64::from(x) + 0.5 - place.centre.0, f64::from(y) + 0.5 - place.centre.1);
            points.push((ux / place.half, uy / place.half, f64::from(d), 1.0));
        }
    }
    if points.len() < BACKSTOP_PIXELS {
        return None;
    }
    let plane = fit_points(points.iter().copied())?;
    // extrapolated into the tile it must stay behind everything there, else the slope is not to be trusted
    let mean = points.iter().map(|q| q.2).sum::<f64>() / points.len() as f64;
    let corners = [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)].map(|(u, v)| plane.disparity(u, v));
    let sane = corners.iter().all(|&d| d >= 0.0 && d < f64::from(nearest_back));
    Some(if sane { plane } else { Plane::fronto_parallel(mean) }.quantised())
}

/// Texels of a layer that lie behind the visible surface and that a camera in the view box can look at.
#[allow(clippy::too_many_arguments, reason = "the parts of one tile, each used once")]
fn hidden_mask(
    p: &Peel,
    r: Rect,
    place: Place,
    planes: &TilePlanes,
    label: Option<u8>,
    plane: &Plane,
    s: &mut Scratch,
    left_out: &mut LeftOut,
) -> Vec<bool> {
    let mut hidden = vec![false; r.area()];
    let (mut any, mut step) = (false, 0f32);
    for (i, h) in hidden.iter_mut().enumerate() {
        let d = place.disparity(plane, r.x + i as u32 % r.w, r.y + i as u32 / r.w);
        if Some(planes.labels[i]) != label && d < s.visible[i] && d >= 0.0 {
            *h = true;
            any = true;
            step = step.max(s.visible[i] - d);
        }
    }
    if !any {
        return hidden;
    }
    // an occluder of the neighbourhood may be nearer still; its edge uncovers more
    let bound = |parallax: f64, step: f32| (f64::from(step) * parallax + MARGIN).min(MAX_REACH).ceil() as u32;
    let (rx, ry) = (bound(p.parallax.0, step), bound(p.parallax.1, step));
    let win = grown(r, rx, ry, &p.grid);
    let (mut nearest, mut least) = (0f32, f32::INFINITY);
    s.open.clear();
    for y in win.y..win.y + win.h {
        let row = y as usize * p.delta.width as usize;
        for x in win.x..win.x + win.w {
            let (d, q) = (p.delta.delta[row + x as usize], place.disparity(plane, x, y));
            s.open.push(d <= q + OPEN);
            nearest = nearest.max(d);
            least = least.min(q);
        }
    }
    let step = (nearest - least.max(0.0)).max(step);
    dilate(&s.open, win.w as usize, bound(p.parallax.0, step) as usize, bound(p.parallax.1, step) as usize, &mut s.reach);
    for (i, h) in hidden.iter_mut().enumerate() {
        let (x, y) = (r.x - win.x + i as u32 % r.w, r.y - win.y + i as u32 / r.w);
        if *h && !s.reach[(y * win.w + x) as usize] {
            *h = false;
            left_out.hidden += 1;
        }
    }
    hidden
}

/// Box dilation by `rx`, `ry` pixels.
fn dilate(mask: &[bool], width: usize, rx: usize, ry: usize, out: &mut Vec<bool>) {
    let height = mask.len() / width;
    let run = |get: &dyn Fn(usize) -> bool, len: usize, radius: usize, set: &mut dyn FnMut(usize)| {
        let mut until = 0usize;
        // forward: how far the last set pixel reaches; pixels before a set one are marked as it comes
        let mut done = 0usize;
        for i in 0..len {
            if get(i) {
                for j in i.saturating_sub(radius).max(done)..i {
                    set(j);
                }
                until = i + radius + 1;
            }
            if i < until {
                set(i);
                done = i + 1;
            }
        }
    };
    let mut rows = vec![false; mask.len()];
    for y in 0..height {
        let (line, to) = (&mask[y * width..(y + 1) * width], &mut rows[y * width..(y + 1) * width]);
        run(&|i| line[i], width, rx, &mut |i| to[i] = true);
    }
    out.clear();
    out.resize(mask.len(), false);
    for x in 0..width {
        run(&|i| rows[i * width + x], height, ry, &mut |i| out[i * width + x] = true);
    }
}

/// Joins visible, hidden and soft texels into a layer cut to its bounds; none where nothing is left.
#[allow(clippy::too_many_arguments, reason = "the parts of one tile, each used once")]
fn assemble(
    p: &Peel,
    filler: &Filler,
    r: Rect,
    place: Place,
    planes: &TilePlanes,
    label: Option<u8>,
    plane: Plane,
    hidden: &[bool],
    visible: &[f32],
) -> Option<PeeledLayer> {
    let (w, h) = (r.w as usize, r.h as usize);
    let mut class: Vec<u8> = (0..w * h)
        .map(|i| {
            if Some(planes.labels[i]) == label {
                Class::Photo as u8
            } else if hidden[i] {
                Class::Hidden as u8
            } else {
                Class::Empty as u8
            }
        })
        .collect();
    if class.iter().all(|&c| c == Class::Empty as u8) {
        return None;
    }
    let mut alpha: Vec<u8> = class.iter().map(|&c| if c == Class::Empty as u8 { 0 } else { 255 }).collect();
    if label.is_some() {
        soften(&mut class, &mut alpha, w, h, |i| place.disparity(&plane, r.x + (i % w) as u32, r.y + (i / w) as u32) > visible[i]);
    }
    let b = bounds(&class, w, h);
    let rect = Rect { x: r.x + b.x, y: r.y + b.y, w: b.w, h: b.h };
    let cut = |v: &[u8]| -> Vec<u8> {
        (b.y..b.y + b.h).flat_map(|y| v[y as usize * w + b.x as usize..][..b.w as usize].iter().copied()).collect()
    };
    let (class, alpha) = (cut(&class), cut(&alpha));
    let hidden = if class.contains(&(Class::Hidden as u8)) { filler.fill(&p.grid, rect, &class, place, &plane) } else { Vec::new() };
    Some(PeeledLayer { plane, rect, class, alpha, hidden })
}

/// One ring of soft texels outside: alpha is the 3×3 box of the opaque mask, colour the photo's, so that the identity view
/// stays exact. Only where the layer lies in front: elsewhere the photo's colour belongs to something else.
fn soften(class: &mut [u8], alpha: &mut [u8], w: usize, h: usize, in_front: impl Fn(usize) -> bool) {
    let opaque: Vec<bool> = alpha.iter().map(|&a| a == 255).collect();
    for y in 0..h {
        for x in 0..w {
            let at = y * w + x;
            if opaque[at] {
                continue;
            }
            let (mut set, mut all) = (0u32, 0u32);
            for ny in y.saturating_sub(1)..(y + 2).min(h) {
                for nx in x.saturating_sub(1)..(x + 2).min(w) {
                    all += 1;
                    set += u32::from(opaque[ny * w + nx]);
                }
            }
            if set > 0 && in_front(at) {
                class[at] = Class::Photo as u8;
                alpha[at] = ((255 * set + all / 2) / all) as u8;
            }
        }
    }
}

/// Bounds of what is not empty, with one empty pixel around where the tile has it, so that bilinear samples fade out.
fn bounds(class: &[u8], w: usize, h: usize) -> Rect {
    let (mut x0, mut y0, mut x1, mut y1) = (w, h, 0, 0);
    for y in 0..h {
        for x in 0..w {
            if class[y * w + x] != Class::Empty as u8 {
                x0 = x0.min(x);
                x1 = x1.max(x + 1);
                y0 = y0.min(y);
                y1 = y1.max(y + 1);
            }
        }
    }
    let (x0, y0, x1, y1) = (x0.saturating_sub(1), y0.saturating_sub(1), (x1 + 1).min(w), (y1 + 1).min(h));
    Rect { x: x0 as u32, y: y0 as u32, w: (x1 - x0) as u32, h: (y1 - y0) as u32 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn dilation_is_a_box(mask in prop::collection::vec(prop::bool::weighted(0.05), 15 * 11), rx in 0usize..20, ry in 0usize..20) {
            let mut out = Vec::new();
            dilate(&mask, 15, rx, ry, &mut out);
            for y in 0..11usize { for x in 0..15usize {
                let want = (0..11usize).any(|b| (0..15usize).any(|a| mask[b * 15 + a] && a.abs_diff(x) <= rx && b.abs_diff(y) <= ry));
                prop_assert_eq!(out[y * 15 + x], want);
            }}
        }
    }
}
