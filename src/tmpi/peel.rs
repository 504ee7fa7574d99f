//! Which texels each layer has: derived from planes and labels alone, so that a container need not carry it.
//!
//! Writer and readers (the browser's is `static/peel.js`) run the same steps in `f64` on values rounded to `f32` at the same
//! places, and so come to the same texels bit for bit.

use rayon::prelude::*;

use super::{Class, Grid, Intrinsics, Plane, Rect, ViewBox};

/// Widest search for the edge that uncovers a hidden texel, in pixels.
const MAX_REACH: f64 = 96.0;
/// Pixels added to the parallax: bilinear footprint and rounding.
const MARGIN: f64 = 1.5;
/// A surface counts as open for a layer that lies at most this far in front of it, in δ.
const OPEN: f64 = 0.004;

/// A layer whose rim lies in front of its neighbour by at most this many pixels of parallax is one surface with it.
const SEAM: f64 = 1.0;

/// The planes of one tile and which of them each pixel lies on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tile {
    /// Planes on the container's grid, from far to near at the tile's centre; 1 to 64.
    pub planes: Vec<Plane>,
    /// Plane that each pixel of the tile's rectangle lies on, row-major.
    pub labels: Vec<u8>,
    /// A plane behind all that the tile shows, known from its neighbourhood: hidden texels only.
    pub backstop: Option<Plane>,
}

/// Everything that the texels of a scene follow from, but their colours.
#[derive(Clone, Debug, PartialEq)]
pub struct Blueprint {
    /// The tiles.
    pub grid: Grid,
    /// The reference camera.
    pub intrinsics: Intrinsics,
    /// Camera positions that the scene is made for.
    pub view_box: ViewBox,
    /// One entry a tile of the grid.
    pub tiles: Vec<Tile>,
}

/// Shape of one layer.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// Its plane.
    pub plane: Plane,
    /// Its label, none for a backstop.
    pub label: Option<u8>,
    /// Photo pixels that its texels stand for.
    pub rect: Rect,
    /// [`Class`] per texel.
    pub class: Vec<u8>,
    /// Straight alpha per texel.
    pub alpha: Vec<u8>,
}

/// Shapes of the layers of a tile, from far to near at its centre.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shapes {
    /// The layers that have any texel.
    pub layers: Vec<Shape>,
    /// Texels behind something that no camera of the view box looks past, and that were therefore left out.
    pub never_seen: usize,
}

impl ViewBox {
    /// Parallax in pixels, right and down, that a unit of disparity has within `rect` between the photo and the farthest
    /// camera of the box.
    #[must_use]
    pub fn parallax(&self, k: &Intrinsics, rect: Rect) -> (f64, f64) {
        // forward motion moves a pixel by its distance from the principal point
        let reach = |from: u32, len: u32, c: f64| (f64::from(from) - c).abs().max((f64::from(from + len) - c).abs());
        (k.fx * self.x + reach(rect.x, rect.w, k.cx) * self.z, k.fy * self.y + reach(rect.y, rect.h, k.cy) * self.z)
    }
}

/// Where `(u, v)` of a tile lies in the photo.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    /// Tile centre in pixels.
    pub centre: (f64, f64),
    /// Half a tile in pixels.
    pub half: f64,
}

impl Place {
    /// Of tile `index`.
    #[must_use]
    pub fn of(grid: &Grid, index: u32) -> Self {
        Self { centre: grid.centre(index), half: grid.half() }
    }

    /// δ of a plane at the centre of pixel `(x, y)`.
    #[must_use]
    pub fn disparity(&self, plane: &Plane, x: u32, y: u32) -> f32 {
        plane.disparity((f64::from(x) + 0.5 - self.centre.0) / self.half, (f64::from(y) + 0.5 - self.centre.1) / self.half) as f32
    }
}

/// The rectangle grown by `x`, `y` pixels and clipped to the photo.
#[must_use]
pub fn grown(r: Rect, x: u32, y: u32, grid: &Grid) -> Rect {
    let (x0, y0) = (r.x.saturating_sub(x), r.y.saturating_sub(y));
    Rect { x: x0, y: y0, w: (r.x + r.w + x).min(grid.width) - x0, h: (r.y + r.h + y).min(grid.height) - y0 }
}

impl Blueprint {
    /// Shapes of all layers, tile by tile.
    #[must_use]
    pub fn peel(&self) -> Vec<Shapes> {
        self.peeled(false)
    }

    /// The same with every texel behind something, seen or not: what leaving them out is measured against.
    #[must_use]
    pub fn peel_all(&self) -> Vec<Shapes> {
        self.peeled(true)
    }

    fn peeled(&self, all: bool) -> Vec<Shapes> {
        let surface = self.surface();
        let scratch = || Scratch { all, ..Scratch::default() };
        (0..self.tiles.len()).into_par_iter().map_init(scratch, |s, i| self.peel_tile(i as u32, &surface, s)).collect()
    }

    /// δ of the visible surface per pixel; where tiles overlap, of the one that comes last.
    #[must_use]
    pub fn surface(&self) -> Vec<f32> {
        let mut surface = vec![0f32; self.grid.width as usize * self.grid.height as usize];
        for (i, t) in self.tiles.iter().enumerate() {
            let (r, place) = (self.grid.rect(i as u32), Place::of(&self.grid, i as u32));
            for (j, &l) in t.labels.iter().enumerate() {
                let (x, y) = (r.x + j as u32 % r.w, r.y + j as u32 / r.w);
                surface[y as usize * self.grid.width as usize + x as usize] = place.disparity(&t.planes[l as usize], x, y);
            }
        }
        surface
    }

    /// Pixels that [`Blueprint::peel`] looks at, at most: a reader's bound on its work.
    #[must_use]
    pub fn work(&self) -> u64 {
        let reach = MAX_REACH as u32;
        (0..self.grid.tiles())
            .zip(&self.tiles)
            .map(|(i, t)| grown(self.grid.rect(i), reach, reach, &self.grid).area() as u64 * (t.planes.len() as u64 + 1))
            .sum()
    }

    fn peel_tile(&self, index: u32, surface: &[f32], s: &mut Scratch) -> Shapes {
        let (tile, r, place) = (&self.tiles[index as usize], self.grid.rect(index), Place::of(&self.grid, index));
        s.visible.clear();
        for (i, &l) in tile.labels.iter().enumerate() {
            s.visible.push(place.disparity(&tile.planes[l as usize], r.x + i as u32 % r.w, r.y + i as u32 / r.w));
        }
        let parallax = self.view_box.parallax(&self.intrinsics, r);
        let parallax = parallax.0.max(parallax.1);
        let mut out = Shapes::default();
        let labelled = tile.planes.iter().enumerate().map(|(j, q)| (Some(j as u8), *q));
        for (label, plane) in labelled.chain(tile.backstop.map(|q| (None, q))) {
            out.never_seen += self.mark_hidden(r, place, tile, label, &plane, surface, s);
            out.layers.extend(shape(r, place, tile, label, plane, parallax, &s.hidden, &s.visible));
        }
        // a backstop is the farthest at most places, but the order is by the tile's centre for all alike
        out.layers.sort_by(|a, b| a.plane.a.total_cmp(&b.plane.a));
        out
    }

    /// Marks the texels of a layer that lie behind the visible surface and that a camera in the view box can look at; gives
    /// the count of those that lie behind it but are never seen.
    #[allow(clippy::too_many_arguments, reason = "the parts of one tile")]
    fn mark_hidden(&self, r: Rect, place: Place, tile: &Tile, label: Option<u8>, plane: &Plane, surface: &[f32], s: &mut Scratch) -> usize {
        s.hidden.clear();
        s.hidden.resize(r.area(), false);
        let (mut behind, mut step) = (0usize, 0f64);
        for (i, h) in s.hidden.iter_mut().enumerate() {
            let d = place.disparity(plane, r.x + i as u32 % r.w, r.y + i as u32 / r.w);
            if Some(tile.labels[i]) != label && d < s.visible[i] && d >= 0.0 {
                *h = true;
                behind += 1;
                step = step.max(f64::from(s.visible[i]) - f64::from(d));
            }
        }
        if behind == 0 || s.all {
            return 0;
        }
        let parallax = self.view_box.parallax(&self.intrinsics, r);
        let reach = |parallax: f64, step: f64| (step * parallax + MARGIN).min(MAX_REACH).ceil() as u32;
        let win = grown(r, reach(parallax.0, step), reach(parallax.1, step), &self.grid);
        let (mut nearest, mut least) = (0f64, f64::INFINITY);
        s.open.clear();
        for y in win.y..win.y + win.h {
            let row = y as usize * self.grid.width as usize;
            for x in win.x..win.x + win.w {
                let (d, q) = (f64::from(surface[row + x as usize]), f64::from(place.disparity(plane, x, y)));
                s.open.push(d <= q + OPEN);
                nearest = nearest.max(d);
                least = least.min(q);
            }
        }
        // an occluder of the neighbourhood may be nearer still, and its edge uncovers more
        let step = (nearest - least.max(0.0)).max(step);
        dilate(s, win.w as usize, reach(parallax.0, step) as usize, reach(parallax.1, step) as usize);
        let mut never_seen = 0;
        for (i, h) in s.hidden.iter_mut().enumerate() {
            let (x, y) = (r.x - win.x + i as u32 % r.w, r.y - win.y + i as u32 / r.w);
            if *h && !s.reach[(y * win.w + x) as usize] {
                *h = false;
                never_seen += 1;
            }
        }
        never_seen
    }
}

#[derive(Default)]
struct Scratch {
    /// Nothing is left out.
    all: bool,
    visible: Vec<f32>,
    hidden: Vec<bool>,
    open: Vec<bool>,
    rows: Vec<bool>,
    reach: Vec<bool>,
}

/// Box dilation of `open` by `rx`, `ry` pixels into `reach`.
fn dilate(s: &mut Scratch, width: usize, rx: usize, ry: usize) {
    s.rows.clear();
    s.rows.resize(s.open.len(), false);
    s.reach.clear();
    s.reach.resize(s.open.len(), false);
    for (line, to) in s.open.chunks(width).zip(s.rows.chunks_mut(width)) {
        let mut done = 0;
        for (x, _) in line.iter().enumerate().filter(|(_, o)| **o) {
            let end = (x + rx + 1).min(width);
            to[x.saturating_sub(rx).max(done).min(end)..end].fill(true);
            done = end;
        }
    }
    // columns: how far down the last set pixel reaches, then the same upwards
    let height = s.open.len() / width;
    let mut until = vec![0usize; width];
    for y in 0..height {
        for x in 0..width {
            if s.rows[y * width + x] {
                until[x] = y + ry + 1;
            }
            s.reach[y * width + x] = y < until[x];
        }
    }
    until.fill(usize::MAX);
    for y in (0..height).rev() {
        for x in 0..width {
            if s.rows[y * width + x] {
                until[x] = y.saturating_sub(ry);
            }
            s.reach[y * width + x] |= until[x] != usize::MAX && y >= until[x];
        }
    }
}

/// Joins visible, hidden and soft texels into a layer cut to its bounds; none where nothing is left.
#[allow(clippy::too_many_arguments, reason = "the parts of one tile")]
fn shape(
    r: Rect,
    place: Place,
    tile: &Tile,
    label: Option<u8>,
    plane: Plane,
    parallax: f64,
    hidden: &[bool],
    visible: &[f32],
) -> Option<Shape> {
    let (w, h) = (r.w as usize, r.h as usize);
    let mut class: Vec<u8> = (0..w * h)
        .map(|i| {
            if Some(tile.labels[i]) == label {
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
        let pixels_in_front = |i: usize| {
            let own = place.disparity(&plane, r.x + (i % w) as u32, r.y + (i / w) as u32);
            (f64::from(own) - f64::from(visible[i])) * parallax
        };
        soften(&mut class, &mut alpha, w, h, pixels_in_front);
    }
    let b = bounds(&class, w, h);
    let cut = |v: &[u8]| -> Vec<u8> {
        (b.y..b.y + b.h).flat_map(|y| v[y as usize * w + b.x as usize..][..b.w as usize].iter().copied()).collect()
    };
    Some(Shape { plane, label, rect: Rect { x: r.x + b.x, y: r.y + b.y, w: b.w, h: b.h }, class: cut(&class), alpha: cut(&alpha) })
}

/// One ring of soft texels outside: alpha is the 3×3 box of the opaque mask, colour the photo's, so that the identity view
/// stays exact. Only where the layer lies in front: elsewhere the photo's colour belongs to something else. Where it lies
/// hardly in front the surface goes on, bent by a crease: there the ring is opaque, or a hairline would open along the crease.
fn soften(class: &mut [u8], alpha: &mut [u8], w: usize, h: usize, pixels_in_front: impl Fn(usize) -> f64) {
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
            let front = if set > 0 { pixels_in_front(at) } else { 0.0 };
            if front > 0.0 {
                class[at] = Class::Photo as u8;
                alpha[at] = if front <= SEAM { 255 } else { ((255 * set + all / 2) / all) as u8 };
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
            let mut s = Scratch { open: mask.clone(), ..Scratch::default() };
            dilate(&mut s, 15, rx, ry);
            for y in 0..11usize { for x in 0..15usize {
                let want = (0..11usize).any(|b| (0..15usize).any(|a| mask[b * 15 + a] && a.abs_diff(x) <= rx && b.abs_diff(y) <= ry));
                prop_assert_eq!(s.reach[y * 15 + x], want);
            }}
        }
    }

    #[test]
    fn background_is_hidden_only_near_the_edge_that_uncovers_it() {
        // a near square in the middle of a far wall
        let grid = Grid::new(64, 64, 64);
        let labels = (0..4096u32).map(|i| u8::from((16..48).contains(&(i % 64)) && (16..48).contains(&(i / 64)))).collect();
        let tile = Tile { planes: vec![Plane::fronto_parallel(0.25), Plane::fronto_parallel(1.0)], labels, backstop: None };
        let b = Blueprint {
            grid,
            intrinsics: Intrinsics::centred(64, 64, 100.0),
            view_box: ViewBox { x: 0.04, y: 0.0, z: 0.0 },
            tiles: vec![tile],
        };
        let shapes = &b.peel()[0];
        let far = &shapes.layers[0];
        let hidden = |x: u32, y: u32| far.class[((y - far.rect.y) * far.rect.w + x - far.rect.x) as usize] == Class::Hidden as u8;
        // parallax 4 px times a step of 0.75, and the margin: 5 px from the left and right edges, 2 from the others
        assert!(hidden(20, 32) && !hidden(21, 32) && hidden(43, 32) && !hidden(42, 32));
        assert!(hidden(32, 17) && !hidden(32, 18));
        assert_eq!(shapes.never_seen, 22 * 28);
        let near = &shapes.layers[1];
        assert!(near.alpha.iter().any(|a| (1..255).contains(a)), "the near layer has a soft rim");
    }
}
