//! Rectification: brings the second picture of a pair to the rows of the first. Hand-held cameras, or two lenses, differ by small
//! rotations, an offset and a scale, which are fitted to sparse matches.

use rayon::prelude::*;

use tmpi_core::simd::dispatch;

use super::census::{Grey, census};
use super::fuse::Draw;
use crate::photo::around;

/// Side in pixels of the squares, each of which gives one corner to match.
const CELL: usize = 8;
/// Longest side at which corners are first searched for.
const COARSE: usize = 240;
/// Radius of a corner's window.
const HALF: usize = 2;
/// Least brightness variation of a corner in both directions: the smaller eigenvalue of its structure tensor, in levels² per pixel.
const CORNER: f32 = 40.0;
/// Range of the search to either side, as a share of the width.
const SIDES: f64 = 0.35;
/// Range of the search up and down, as a share of the height.
const UP: f64 = 0.08;
/// The best position's cost is below this share of every other one's that is not its neighbour.
const UNIQUE: f32 = 0.8;
/// Tries of a model.
const TRIES: usize = 400;
/// Pixels within which a match agrees with a model.
const AGREES: f64 = 1.5;
/// Fewest matches that must agree with a model.
const FEWEST: usize = 24;
/// Least share of all matches that must agree.
const SHARE: f64 = 0.3;
/// Largest share of the width by which the model may move a border.
const MOST: f64 = 0.12;

/// How the second picture is displaced from the rows of the first, to first order in small rotations. Positions `(u, v)` are relative to
/// the middle of the picture, in widths. What the first picture shows at `(u, v)`, the second shows, apart from parallax, at
/// `(u + right(u, v), v + down(u, v))`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Model {
    /// Downward offset, in widths.
    pub offset: f64,
    /// Rotation about the optical axis, in radians, clockwise as shown.
    pub roll: f64,
    /// Scale minus 1.
    pub scale: f64,
    /// Rotation about the vertical axis: rows spread apart towards one side.
    pub yaw: f64,
    /// Rotation about the horizontal axis.
    pub pitch: f64,
}

impl Model {
    fn of([offset, roll, scale, yaw, pitch]: [f64; 5]) -> Self {
        Self { offset, roll, scale, yaw, pitch }
    }

    fn terms(u: f64, v: f64) -> [f64; 5] {
        [1.0, u, v, u * v, v * v]
    }

    /// Downward displacement at `(u, v)`, in widths.
    pub fn down(&self, u: f64, v: f64) -> f64 {
        let all = [self.offset, self.roll, self.scale, self.yaw, self.pitch];
        all.iter().zip(Self::terms(u, v)).map(|(a, b)| a * b).sum()
    }

    /// Rightward displacement at `(u, v)`, in widths, without parallax.
    pub fn right(&self, u: f64, v: f64) -> f64 {
        -self.roll * v + self.scale * u + self.yaw * u * u + self.pitch * u * v
    }

    /// Resamples the second picture to the rows of the first.
    pub fn rectified(&self, second: &Grey) -> Grey {
        let (w, h) = (second.width, second.height);
        if *self == Self::default() {
            return second.clone();
        }
        let mut values = vec![0; w * h];
        values.par_chunks_exact_mut(w).enumerate().for_each(|(y, row)| {
            for (x, out) in row.iter_mut().enumerate() {
                let (u, v) = centred((x as f64, y as f64), (w, h));
                let place = (x as f64 + self.right(u, v) * w as f64, y as f64 + self.down(u, v) * w as f64);
                *out = at(second, place);
            }
        });
        Grey { values, ..*second }
    }
}

/// A model fitted to sparse matches.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rectified {
    /// The model; the default one moves nothing.
    pub model: Model,
    /// Median distance of the matches that agree with it from their rows, in pixels, in the pictures as given.
    pub before_px: f64,
    /// The same after rectification.
    pub after_px: f64,
}

/// Fits the model; `None` if too few matches agree with any.
pub fn rectify(first: &Grey, second: &Grey) -> Option<Rectified> {
    let size = (first.width, first.height);
    let matches = matches(first, second);
    let enough = |n: usize| n >= FEWEST && n as f64 >= SHARE * matches.len() as f64;
    let best = sample(&matches, size);
    let mut agreeing = agreeing(&matches, &best, size, AGREES);
    if !enough(agreeing.len()) {
        return None;
    }
    let mut model = best;
    for within in [AGREES, AGREES, AGREES / 2.0] {
        model = fit(&agreeing, size)?;
        agreeing = self::agreeing(&matches, &model, size, within);
    }
    let (w, h) = (size.0 as f64, size.1 as f64);
    let corners = [(-0.5, -h / w / 2.0), (0.5, -h / w / 2.0), (-0.5, h / w / 2.0), (0.5, h / w / 2.0)];
    let far = corners.iter().any(|&(u, v)| model.down(u, v).abs().max(model.right(u, v).abs()) > MOST);
    if !enough(agreeing.len()) || far {
        return None;
    }
    let (before_px, after_px) = (median(&agreeing, &Model::default(), size), median(&agreeing, &model, size));
    // pictures that already lie on their rows stay unchanged
    let better = before_px - after_px > 0.1;
    let (model, after_px) = if better { (model, after_px) } else { (Model::default(), before_px) };
    Some(Rectified { model, before_px, after_px })
}

/// A corner of the first picture, and its position in the second, in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Match {
    from: (f64, f64),
    to: (f64, f64),
}

impl Match {
    /// Signed distance in pixels of the match in the second picture from its row by a model.
    fn off(&self, model: &Model, size: (usize, usize)) -> f64 {
        let (u, v) = centred((self.to.0, self.from.1), size);
        self.to.1 - self.from.1 - model.down(u, v) * size.0 as f64
    }
}

fn centred((x, y): (f64, f64), (w, h): (usize, usize)) -> (f64, f64) {
    ((x - (w as f64 - 1.0) / 2.0) / w as f64, (y - (h as f64 - 1.0) / 2.0) / w as f64)
}

/// Brightness at a position between pixels, bilinear; beyond the border, the outermost pixels repeat.
fn at(picture: &Grey, (x, y): (f64, f64)) -> u8 {
    let (w, h) = (picture.width, picture.height);
    let ((x0, x1, fx), (y0, y1, fy)) = (around(x, w), around(y, h));
    let value = |x: usize, y: usize| f64::from(picture.values[y * w + x]);
    let line = |y: usize| value(x0, y) + (value(x1, y) - value(x0, y)) * fx;
    (line(y0) + (line(y1) - line(y0)) * fy).round() as u8
}

/// The picture reduced by a whole factor: means over squares of `by` pixels a side.
pub fn reduced(picture: &Grey, by: usize) -> Grey {
    let (width, height) = ((picture.width / by).max(1), (picture.height / by).max(1));
    let mean = |i: usize| {
        let (x, y) = (i % width * by, i / width * by);
        let rows = y..(y + by).min(picture.height);
        let sum = |y: usize| picture.values[y * picture.width..][x..(x + by).min(picture.width)].iter().map(|v| u32::from(*v)).sum::<u32>();
        let n = rows.len() * ((x + by).min(picture.width) - x);
        (rows.map(sum).sum::<u32>() / n.max(1) as u32) as u8
    };
    Grey { width, height, values: (0..width * height).map(mean).collect() }
}

/// Corners of the first picture that match the second at a single position, found at a reduced size and refined to a fraction of a pixel.
fn matches(first: &Grey, second: &Grey) -> Vec<Match> {
    let by = first.width.max(first.height).div_ceil(COARSE).max(1);
    let small = [reduced(first, by), reduced(second, by)];
    let words = [census(&small[0]), census(&small[1])];
    let fine = [census(first), census(second)];
    let (w, h) = (small[0].width, small[0].height);
    let (sides, up) = ((w as f64 * SIDES) as i64, (h as f64 * UP).ceil().max(3.0) as i64);
    let one = |corner: (usize, usize)| {
        let search = Search { about: (0, 0), reach: (sides, up), half: 1, unique: UNIQUE };
        let coarse = nearest((&words[0], &words[1]), (w, h), corner, &search)?;
        let fine_corner = (corner.0 * by + by / 2, corner.1 * by + by / 2);
        let about = (coarse.0.round() as i64 * by as i64, coarse.1.round() as i64 * by as i64);
        let search = Search { about, reach: (by as i64 + 1, by as i64 + 1), half: HALF, unique: 1.0 };
        let (dx, dy) = nearest((&fine[0], &fine[1]), (first.width, first.height), fine_corner, &search)?;
        let from = (fine_corner.0 as f64, fine_corner.1 as f64);
        Some(Match { from, to: (from.0 + dx, from.1 + dy) })
    };
    corners(&small[0]).into_par_iter().filter_map(one).collect()
}

/// The strongest corner of each square, if it is strong enough.
fn corners(picture: &Grey) -> Vec<(usize, usize)> {
    let (w, h) = (picture.width, picture.height);
    let value = |x: usize, y: usize| f32::from(picture.values[y * w + x]);
    let strength = |x: usize, y: usize| {
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for j in y - HALF..=y + HALF {
            for i in x - HALF..=x + HALF {
                let (a, b) = ((value(i + 1, j) - value(i - 1, j)) / 2.0, (value(i, j + 1) - value(i, j - 1)) / 2.0);
                (xx, xy, yy) = (xx + a * a, xy + a * b, yy + b * b);
            }
        }
        let n = ((2 * HALF + 1) * (2 * HALF + 1)) as f32;
        (f32::midpoint(xx, yy) - ((xx - yy) * (xx - yy) / 4.0 + xy * xy).sqrt()) / n
    };
    let edge = HALF + 1;
    let mut found = Vec::new();
    for top in (edge..h.saturating_sub(edge)).step_by(CELL) {
        for left in (edge..w.saturating_sub(edge)).step_by(CELL) {
            let (bottom, right) = ((top + CELL).min(h - edge), (left + CELL).min(w - edge));
            let places = (top..bottom).flat_map(|y| (left..right).map(move |x| (x, y)));
            let best = places.map(|(x, y)| (strength(x, y), (x, y))).max_by(|a, b| a.0.total_cmp(&b.0));
            found.extend(best.filter(|(s, _)| *s > CORNER).map(|(_, place)| place));
        }
    }
    found
}

/// Where to search for a corner.
#[derive(Clone, Copy, Debug)]
struct Search {
    /// Centre of the search, as an offset from the corner's own position.
    about: (i64, i64),
    /// How far to search to either side, and up or down.
    reach: (i64, i64),
    /// Radius of the window that is compared.
    half: usize,
    /// The best cost must be below this share of all costs that are not its neighbours'; 1 accepts any.
    unique: f32,
}

/// Offset of a corner in the second picture, vertically to a fraction of a pixel. `None` if another position matches as well, or if the
/// best one lies at the border of the search.
fn nearest(words: (&[u64], &[u64]), (w, h): (usize, usize), (x, y): (usize, usize), search: &Search) -> Option<(f64, f64)> {
    let Search { about, reach, half, unique } = *search;
    // positions at which the whole window lies inside
    let range = |at: usize, about: i64, reach: i64, n: usize| {
        let (own, most) = (at as i64, n as i64 - 1 - half as i64);
        let inside = at >= half && own <= most;
        let (from, to) = ((own + about - reach).max(half as i64), (own + about + reach).min(most));
        (inside && from <= to).then(|| from as usize..to as usize + 1)
    };
    let (xs, ys) = (range(x, about.0, reach.0, w)?, range(y, about.1, reach.1, h)?);
    let columns = xs.len();
    let mut costs = vec![0u32; columns * ys.len()];
    for (row, to_y) in costs.chunks_exact_mut(columns).zip(ys.clone()) {
        for j in 0..=2 * half {
            let own = &words.0[(y - half + j) * w + x - half..][..=2 * half];
            let other = &words.1[(to_y - half + j) * w + xs.start - half..][..columns + 2 * half];
            add_distances(own, other, row);
        }
    }
    let at = costs.iter().enumerate().min_by_key(|(_, c)| **c)?.0;
    let (column, line, least) = (at % columns, at / columns, costs[at]);
    let apart = |i: usize| (i % columns).abs_diff(column) > 2 || (i / columns).abs_diff(line) > 2;
    let rival = costs.iter().enumerate().filter(|(i, _)| apart(*i)).map(|(_, c)| *c).min();
    if unique < 1.0 && rival.is_none_or(|r| least as f32 > unique * r as f32) {
        return None;
    }
    let (above, below) = (costs.get(at.checked_sub(columns)?)?, costs.get(at + columns)?);
    let (above, below) = (f64::from(*above), f64::from(*below));
    let curve = above + below - 2.0 * f64::from(least);
    let part = if curve > 0.0 { ((above - below) / (2.0 * curve)).clamp(-0.5, 0.5) } else { 0.0 };
    Some(((xs.start + column) as f64 - x as f64, (ys.start + line) as f64 + part - y as f64))
}

/// Adds the census distances of one row of a window, for each position of the window in the other picture.
#[inline(always)]
fn distances(own: &[u64], other: &[u64], out: &mut [u32]) {
    let n = out.len();
    for (i, word) in own.iter().enumerate() {
        for (out, theirs) in out.iter_mut().zip(&other[i..i + n]) {
            *out += (word ^ theirs).count_ones();
        }
    }
}

dispatch!(add_distances, distances, (own: &[u64], other: &[u64], out: &mut [u32]));

/// Of models through three matches each, the one with which most matches agree. The draws are the same each time.
fn sample(matches: &[Match], size: (usize, usize)) -> Model {
    let mut draws = Draw(0x2545_F491_4F6C_DD1D);
    let mut draw = || &matches[draws.below(matches.len())];
    let mut best = (0, Model::default());
    for _ in 0..if matches.len() < FEWEST { 0 } else { TRIES } {
        let rows = [draw(), draw(), draw()].map(|m| row(m, size));
        let picked = rows.map(|(terms, value)| ([terms[0], terms[1], terms[2]], value));
        let Some([offset, roll, scale]) = solve(normal(&picked, 1e-9)) else { continue };
        let model = Model { offset, roll, scale, ..Model::default() };
        let n = matches.iter().filter(|m| m.off(&model, size).abs() < AGREES).count();
        if n > best.0 {
            best = (n, model);
        }
    }
    best.1
}

fn row(m: &Match, size: (usize, usize)) -> ([f64; 5], f64) {
    let (u, v) = centred((m.to.0, m.from.1), size);
    (Model::terms(u, v), (m.to.1 - m.from.1) / size.0 as f64)
}

fn agreeing(matches: &[Match], model: &Model, size: (usize, usize), within: f64) -> Vec<Match> {
    matches.iter().filter(|m| m.off(model, size).abs() < within).copied().collect()
}

/// Least squares; terms that the matches do not determine stay small.
fn fit(matches: &[Match], size: (usize, usize)) -> Option<Model> {
    let rows: Vec<_> = matches.iter().map(|m| row(m, size)).collect();
    solve(normal(&rows, 1e-4 * matches.len() as f64)).map(Model::of)
}

/// Normal equations of `N` unknowns, from rows of terms and their value. `ridge` is added for all unknowns but the first three.
fn normal<const N: usize>(rows: &[([f64; N], f64)], ridge: f64) -> ([[f64; N]; N], [f64; N]) {
    let (mut matrix, mut right) = ([[0.0; N]; N], [0.0; N]);
    for (terms, value) in rows {
        for i in 0..N {
            right[i] += terms[i] * value;
            for j in 0..N {
                matrix[i][j] += terms[i] * terms[j];
            }
        }
    }
    for (i, row) in matrix.iter_mut().enumerate() {
        row[i] += if i < 3 { 1e-12 } else { ridge };
    }
    (matrix, right)
}

/// Gaussian elimination with pivoting; `None` if the system is singular.
fn solve<const N: usize>((mut a, mut b): ([[f64; N]; N], [f64; N])) -> Option<[f64; N]> {
    for p in 0..N {
        let best = (p..N).max_by(|i, j| a[*i][p].abs().total_cmp(&a[*j][p].abs()))?;
        a.swap(p, best);
        b.swap(p, best);
        let pivot = a[p];
        if pivot[p].abs() < 1e-14 {
            return None;
        }
        for q in (0..N).filter(|q| *q != p) {
            let factor = a[q][p] / pivot[p];
            for (to, from) in a[q].iter_mut().zip(pivot) {
                *to -= factor * from;
            }
            b[q] -= factor * b[p];
        }
    }
    Some(std::array::from_fn(|i| b[i] / a[i][i])).filter(|x: &[f64; N]| x.iter().all(|v| v.is_finite()))
}

/// Median distance from the rows, in pixels.
fn median(matches: &[Match], model: &Model, size: (usize, usize)) -> f64 {
    let mut off: Vec<f64> = matches.iter().map(|m| m.off(model, size).abs()).collect();
    off.sort_by(f64::total_cmp);
    off.get(off.len() / 2).copied().unwrap_or_default()
}

#[cfg(test)]
mod tests;
