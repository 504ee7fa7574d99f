//! The region of a stroke: the geodesic Voronoi cell of its centre line against everything farther than two radii from it.
//!
//! A path costs its length in radii and, more, the edges that it crosses. Both sides therefore meet at the strongest edge between them
//! and, without an edge, midway, at the brush's own radius (geodesic segmentation: Bai and Sapiro, ICCV 2007; Criminisi, Sharp and Blake,
//! ECCV 2008). Regions that grow from a stroke without a bound on the other side, as by a random walker, leak through weak edges; between
//! two radii they cannot. `static/app/stroke-region.js` shows the same outline while it is drawn.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use tmpi_core::{DisparityMap, Photo};

use super::Stroke;
use crate::photo::{bilinear, reduced_size, resize};

/// Longest side, in pixels, of the picture in which outlines are found: finer than a hand draws, and a bound on time.
pub(super) const SIDE: u32 = 640;
/// Cost of a pixel's step along an edge from black to white, in radii.
const EDGE: f32 = 36.0;
/// Weight of an edge of the disparity map relative to one of the photo: the map's edge may be what is wrong.
const DEPTH: f32 = 0.5;
/// Edges count above this many times the median of those around, because texture has edges everywhere.
const TEXTURE: f32 = 2.0;

/// Scharr's smoothing across a derivative.
const SMOOTH: [f32; 3] = [3.0 / 16.0, 10.0 / 16.0, 3.0 / 16.0];
/// Pixels whose middle is at most this far from a line are on it: half a diagonal, so that it has no gaps.
const LINE: f32 = 0.71;

/// A photo prepared for finding outlines.
#[derive(Clone, Debug)]
pub struct Outlines {
    width: usize,
    height: usize,
    /// Squared strength of the edge at each pixel, 0 to about 1.
    edges: Vec<f32>,
}

/// The pixels of a region, in a rectangle of the reduced photo.
#[derive(Clone, Debug, PartialEq)]
pub struct Region {
    x0: usize,
    y0: usize,
    width: usize,
    height: usize,
    /// 1 inside.
    mask: Vec<u8>,
    /// Size of the reduced photo.
    whole: (usize, usize),
}

/// The pixels around a stroke: a rectangle of the reduced photo.
pub(super) struct Near {
    corner: (usize, usize),
    pub(super) size: (usize, usize),
    /// Distance of each pixel from the centre line, in pixels.
    pub(super) away: Vec<f32>,
    /// Radius of the brush, in pixels.
    pub(super) radius: f64,
}

impl Outlines {
    /// Finds the edges of a photo and its disparity map, both of one size.
    pub fn new(photo: &Photo, map: &DisparityMap) -> Self {
        let (w, h) = reduced_size((photo.width, photo.height), Some(SIDE));
        let small = if (w, h) == (photo.width, photo.height) { None } else { Some(resize(photo, w, h)) };
        let rgb = &small.as_ref().unwrap_or(photo).rgb;
        let (width, height) = (w as usize, h as usize);
        let at = |v: usize, n: usize, all: u32| ((v as f64 + 0.5) / n as f64 * f64::from(all)) as usize;
        let delta = |x: usize, y: usize| map.delta[at(y, height, map.height) * map.width as usize + at(x, width, map.width)];
        let mut edges = vec![0.0; width * height];
        for y in 0..height {
            for x in 0..width {
                let colour = |c: usize| move |x: usize, y: usize| f32::from(rgb[y * width + x][c]) / 255.0;
                let squares: f32 = (0..3).map(|c| slope((width, height), (x, y), colour(c))).sum();
                edges[y * width + x] = squares / 3.0 + DEPTH * slope((width, height), (x, y), delta);
            }
        }
        Self { width, height, edges }
    }

    /// The region of a stroke, which must pass [`Stroke::check`].
    pub fn region(&self, stroke: &Stroke) -> Region {
        let Near { corner: (x0, y0), size: (width, height), away, radius } = self.near(stroke);
        let step = self.steps((x0, y0), (width, height), &away, radius);
        let mask = cell((width, height), &away, &step, radius);
        Region { x0, y0, width, height, mask, whole: (self.width, self.height) }
    }

    /// The pixels that a stroke may reach.
    fn near(&self, stroke: &Stroke) -> Near {
        let longer = self.width.max(self.height) as f64;
        let radius = (stroke.radius * longer).max(1.0);
        let line = thinned(stroke, (self.width, self.height), radius / 8.0);
        let reach = 2.0 * radius + 2.0;
        let span = |axis: usize, n: usize| {
            let (low, high) = line.iter().fold((f64::MAX, f64::MIN), |(l, h), p| (l.min(p[axis]), h.max(p[axis])));
            let low = ((low - reach).max(0.0) as usize).min(n - 1);
            (low, ((high + reach).ceil() as usize).clamp(low + 1, n))
        };
        let ((x0, x1), (y0, y1)) = (span(0, self.width), span(1, self.height));
        let size = (x1 - x0, y1 - y0);
        Near { corner: (x0, y0), size, away: distances(&line, (x0, y0), size, reach), radius }
    }

    /// The mask of [`Outlines::region`], the costs of steps, and the pixels around the stroke.
    #[cfg(test)]
    pub(super) fn traced(&self, stroke: &Stroke) -> (Vec<u8>, Vec<f32>, Near) {
        let near = self.near(stroke);
        let step = self.steps(near.corner, near.size, &near.away, near.radius);
        (self.region(stroke).mask, step, near)
    }

    /// Cost of a step through each pixel of a rectangle, in radii.
    fn steps(&self, (x0, y0): (usize, usize), (width, height): (usize, usize), away: &[f32], radius: f64) -> Vec<f32> {
        let edge = |i: usize| self.edges[(y0 + i / width) * self.width + x0 + i % width];
        let mut near: Vec<f32> = (0..width * height).filter(|&i| f64::from(away[i]) < 2.0 * radius).map(edge).collect();
        let middle = near.len() / 2;
        let texture = if near.is_empty() { 0.0 } else { TEXTURE * *near.select_nth_unstable_by(middle, f32::total_cmp).1 };
        (0..width * height).map(|i| 1.0 / radius as f32 + EDGE * (edge(i) - texture).max(0.0)).collect()
    }
}

impl Region {
    /// Calls `f` with the index of each pixel of the region in a picture of `width` × `height`, row by row.
    pub fn each(&self, width: u32, height: u32, mut f: impl FnMut(usize)) {
        let (w, h) = (width as usize, height as usize);
        let scale = (self.whole.0 as f64 / w as f64, self.whole.1 as f64 / h as f64);
        let first = |low: usize, s: f64| ((low as f64 - 1.0) / s).max(0.0) as usize;
        let last = |high: usize, s: f64, n: usize| (((high as f64 + 1.0) / s).ceil() as usize).min(n);
        for y in first(self.y0, scale.1)..last(self.y0 + self.height, scale.1, h) {
            for x in first(self.x0, scale.0)..last(self.x0 + self.width, scale.0, w) {
                if self.share((x as f64 + 0.5) * scale.0 - 0.5, (y as f64 + 0.5) * scale.1 - 0.5) >= 0.5 {
                    f(y * w + x);
                }
            }
        }
    }

    /// Share, 0 to 1, of a position between pixels of the reduced photo that is inside: bilinear, so that outlines on larger photos are
    /// smooth. What lies beyond the photo's border is like the border.
    fn share(&self, x: f64, y: f64) -> f64 {
        bilinear((x, y), self.whole, |x, y| match (x.checked_sub(self.x0), y.checked_sub(self.y0)) {
            (Some(x), Some(y)) if x < self.width && y < self.height => f64::from(self.mask[y * self.width + x]),
            _ => 0.0,
        })
    }
}

/// The cell of a line, 1 inside it, by Dijkstra's algorithm from both sides at once. `away` is each pixel's distance from the line,
/// `step` the cost of a step through it.
fn cell((width, height): (usize, usize), away: &[f32], step: &[f32], radius: f64) -> Vec<u8> {
    let (mut least, mut inside) = (vec![f32::MAX; away.len()], vec![0; away.len()]);
    let mut heap = BinaryHeap::new();
    for (i, &d) in away.iter().enumerate() {
        let on_line = d <= LINE;
        if on_line || f64::from(d) >= 2.0 * radius {
            (least[i], inside[i]) = (0.0, u8::from(on_line));
            // costs are not negative, so their bits are in their order
            heap.push(Reverse((0_u32, i)));
        }
    }
    while let Some(Reverse((bits, i))) = heap.pop() {
        let cost = f32::from_bits(bits);
        if cost > least[i] {
            continue;
        }
        let (x, y) = (i % width, i / width);
        for ny in y.saturating_sub(1)..(y + 2).min(height) {
            for nx in x.saturating_sub(1)..(x + 2).min(width) {
                let n = ny * width + nx;
                let length = if nx != x && ny != y { std::f32::consts::SQRT_2 } else { 1.0 };
                let reached = cost + length * 0.5 * (step[i] + step[n]);
                if reached < least[n] {
                    (least[n], inside[n]) = (reached, inside[i]);
                    heap.push(Reverse((reached.to_bits(), n)));
                }
            }
        }
    }
    inside
}

/// Squared strength of the edge at a pixel, by Scharr's kernels, scaled so that a step of 1 between two halves of a picture has strength
/// 1 beside it.
fn slope((width, height): (usize, usize), (x, y): (usize, usize), value: impl Fn(usize, usize) -> f32) -> f32 {
    let (xs, ys) = ([x.saturating_sub(1), x, (x + 1).min(width - 1)], [y.saturating_sub(1), y, (y + 1).min(height - 1)]);
    let across = |k: usize| value(xs[2], ys[k]) - value(xs[0], ys[k]);
    let down = |k: usize| value(xs[k], ys[2]) - value(xs[k], ys[0]);
    let (mut gx, mut gy) = (0.0, 0.0);
    for (k, w) in SMOOTH.into_iter().enumerate() {
        gx += w * across(k);
        gy += w * down(k);
    }
    gx * gx + gy * gy
}

/// The centre line of a stroke in pixels, without points that are closer than `least` to the one before.
fn thinned(stroke: &Stroke, (width, height): (usize, usize), least: f64) -> Vec<[f64; 2]> {
    let mut line: Vec<[f64; 2]> = Vec::with_capacity(stroke.points.len());
    for (i, p) in stroke.points.iter().enumerate() {
        let p = [p[0] * width as f64, p[1] * height as f64];
        let far = line.last().is_none_or(|q| (p[0] - q[0]).hypot(p[1] - q[1]) >= least);
        if far || i + 1 == stroke.points.len() {
            line.push(p);
        }
    }
    line
}

/// Distance of each pixel of a rectangle from a line, in pixels; `f32::MAX` beyond `reach`.
fn distances(line: &[[f64; 2]], (x0, y0): (usize, usize), (width, height): (usize, usize), reach: f64) -> Vec<f32> {
    // squares until the end: even so, lines of thousands of points over the whole picture take a second
    let mut squares = vec![f64::INFINITY; width * height];
    let ends = line.windows(2).map(|p| (p[0], p[1])).chain(line.first().map(|&p| (p, p)));
    for (a, b) in ends {
        let span = |axis: usize, from: usize, n: usize| {
            let low = a[axis].min(b[axis]) - reach - from as f64;
            let high = a[axis].max(b[axis]) + reach - from as f64;
            (low.max(0.0) as usize).min(n)..(high.ceil().max(0.0) as usize).min(n)
        };
        let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
        let square = dx * dx + dy * dy;
        let (tx, ty) = if square > 0.0 { (dx / square, dy / square) } else { (0.0, 0.0) };
        let columns = span(0, x0, width);
        let left = (x0 + columns.start) as f64 + 0.5 - a[0];
        for y in span(1, y0, height) {
            let py = (y0 + y) as f64 + 0.5 - a[1];
            for (x, here) in squares[y * width..][columns.clone()].iter_mut().enumerate() {
                let px = left + x as f64;
                let t = (px * tx + py * ty).clamp(0.0, 1.0);
                let (ex, ey) = (px - t * dx, py - t * dy);
                let d = ex * ex + ey * ey;
                *here = if d < *here { d } else { *here };
            }
        }
    }
    squares.into_iter().map(|d| if d.is_finite() { d.sqrt() as f32 } else { f32::MAX }).collect()
}
