//! Semi-global matching (Hirschmüller 2008): the disparity of each pixel of a picture against another, along eight paths.
//!
//! Rows are matched in bands, each with extra rows before and after it on which its paths begin. The picture determines the height of the
//! bands, so the result is the same on any number of threads, and memory is bounded.

use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use tmpi_core::simd::dispatch;

/// Cost of a step of one pixel between neighbours.
const SMALL: u8 = 7;
/// Cost of a larger step where the picture has no edge.
const LARGE: u8 = 100;
/// Difference of brightness, in levels, that halves the cost of a larger step.
const EDGE: u32 = 12;
/// Cost of a position outside the other picture.
const OUTSIDE: u8 = 30;
/// Most rows of a band.
const ROWS: usize = 96;
/// Rows on either side of a band on which its paths begin.
const BEFORE: usize = 24;
/// Most bytes of the sums of all bands that are matched at the same time.
const BYTES: usize = 48 << 20;
/// The number of disparities is a multiple of this, so that vectors are full.
pub const STEP: usize = 32;
/// The best sum of costs must be below this share of every other sum but its neighbours', or the pixel is not measured.
const UNIQUE: f32 = 0.97;

/// Disparities that are searched: `x_own − x_other` in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Range {
    /// The least disparity; negative if the pictures are crossed.
    pub first: i32,
    /// Number of disparities, a multiple of [`STEP`].
    pub count: usize,
}

impl Range {
    /// The smallest range that contains both ends.
    pub fn holding(low: i32, high: i32) -> Self {
        Self { first: low, count: ((high - low).max(0) as usize + 1).next_multiple_of(STEP) }
    }
}

/// Input of matching: brightness of a picture, and the census transforms of it and of the other, all of one size.
#[derive(Clone, Copy, Debug)]
pub struct Views<'a> {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Brightness of the picture itself.
    pub grey: &'a [u8],
    /// Its census transform.
    pub own: &'a [u64],
    /// The other picture's census transform.
    pub other: &'a [u64],
}

/// Disparity of each pixel, to a fraction of a pixel. NaN where it is not measured: the two directions disagree, or two positions match
/// equally well.
pub fn disparity(views: &Views, range: Range) -> Vec<f32> {
    let (w, h) = (views.width, views.height);
    let mut out = vec![f32::NAN; w * h];
    // bands of equal height, so that none waits for a longer one
    let rows = h.div_ceil(h.div_ceil(ROWS).max(1)).max(1);
    let bands = h.div_ceil(rows);
    let beside = BYTES / (rows * w * range.count * size_of::<u16>()).max(1);
    let workers = beside.min(bands).min(rayon::current_num_threads()).max(1);
    let left = Mutex::new(out.chunks_mut((w * rows).max(1)).enumerate());
    // memory is allocated once per worker: new pages cost more than what is written to them
    (0..workers).into_par_iter().for_each(|_| {
        let mut band = Band::new(views, range, rows);
        let next = || left.lock().unwrap_or_else(PoisonError::into_inner).next();
        while let Some((i, out)) = next() {
            band.run(i * rows, out);
        }
    });
    out
}

/// Costs of the paths that end in a row, for each of its pixels: one per disparity, between two guards; and the least of them.
struct Paths {
    costs: Vec<u8>,
    least: Vec<u8>,
}

/// A band of rows in progress.
struct Band<'a> {
    views: &'a Views<'a>,
    range: Range,
    /// Matching costs of a row.
    row: Vec<u8>,
    /// Paths from the three neighbours in the row before.
    before: [Paths; 3],
    /// Paths of this row.
    now: [Paths; 3],
    /// Sums of the costs of paths, for all rows.
    sums: Vec<u16>,
}

impl<'a> Band<'a> {
    fn new(views: &'a Views<'a>, range: Range, rows: usize) -> Self {
        let (w, n) = (views.width, range.count);
        let paths = || Paths { costs: vec![u8::MAX; w * (n + 2)], least: vec![0; w] };
        let three = || [paths(), paths(), paths()];
        Self { views, range, row: vec![0; w * n], before: three(), now: three(), sums: vec![0; rows * w * n] }
    }

    /// Measures as many rows as `out` holds, starting at `first`.
    fn run(&mut self, first: usize, out: &mut [f32]) {
        let w = self.views.width;
        let end = first + out.len() / w;
        for y in first.saturating_sub(BEFORE)..end {
            self.pass(y, y.checked_sub(1).filter(|b| *b + BEFORE >= first), false, y.checked_sub(first));
        }
        let last = (end + BEFORE).min(self.views.height);
        for y in (first..last).rev() {
            self.pass(y, Some(y + 1).filter(|b| *b < last), true, (y < end).then_some(y - first));
        }
        for (out, sums) in out.chunks_exact_mut(w).zip(self.sums.chunks_exact(w * self.range.count)) {
            choose(sums, self.range, out);
        }
    }

    /// Aggregates row `y`, coming from row `from`. The sums go to row `row` of the band, if there is one.
    fn pass(&mut self, y: usize, from: Option<usize>, back: bool, row: Option<usize>) {
        let (w, n) = (self.views.width, self.range.count);
        match_costs(&self.views.own[y * w..(y + 1) * w], &self.views.other[y * w..(y + 1) * w], self.range.first, n, &mut self.row);
        std::mem::swap(&mut self.before, &mut self.now);
        let grey = |y: usize| &self.views.grey[y * w..(y + 1) * w];
        let along = Along { w, n, back, own: grey(y), above: from.map(grey), costs: &self.row };
        let sums = row.map(|row| &mut self.sums[row * w * n..(row + 1) * w * n]);
        aggregate(along, &self.before, &mut self.now, sums);
    }
}

/// Input of a pass along a row.
#[derive(Clone, Copy)]
struct Along<'a> {
    w: usize,
    n: usize,
    /// From the last pixel to the first: this is the second pass, which adds to the sums of the first.
    back: bool,
    own: &'a [u8],
    above: Option<&'a [u8]>,
    costs: &'a [u8],
}

/// Census distances of a row for `n` disparities, starting at `first`.
#[inline(always)]
fn costs_of(own: &[u64], other: &[u64], first: i32, n: usize, out: &mut [u8]) {
    let w = own.len();
    for (x, (word, out)) in own.iter().zip(out.chunks_exact_mut(n)).enumerate() {
        // the position in the other picture falls as the disparity grows
        let most = x as i64 - i64::from(first);
        let (start, end) = inside(most, w, n);
        out.fill(OUTSIDE);
        if start < end {
            let others = &other[(most - end as i64 + 1) as usize..=(most - start as i64) as usize];
            for (o, theirs) in out[start..end].iter_mut().zip(others.iter().rev()) {
                *o = (word ^ theirs).count_ones() as u8;
            }
        }
    }
}

dispatch!(match_costs, costs_of, (own: &[u64], other: &[u64], first: i32, n: usize, out: &mut [u8]));

/// Penalty of a large step between pixels of these brightnesses.
#[inline(always)]
fn large(a: u8, b: u8) -> u8 {
    let even = u32::from(LARGE) * EDGE / (EDGE + u32::from(a.abs_diff(b)));
    (even as u8).max(SMALL + 2)
}

/// One step of a path: from the costs `from` (with guards), whose least is `least`, to `to`. Returns the least of `to`.
#[inline(always)]
fn step<'a>(costs: &'a [u8], from: &'a [u8], least: u8, large: u8, to: &mut [u8]) -> u8 {
    let n = costs.len();
    let far = least.saturating_add(large);
    let blocks = |values: &'a [u8]| values.as_chunks::<STEP>().0.iter();
    let (below, same, above) = (blocks(&from[..n]), blocks(&from[1..=n]), blocks(&from[2..n + 2]));
    let mut lowest = [u8::MAX; STEP];
    let (to, _) = to[1..=n].as_chunks_mut::<STEP>();
    for ((((to, costs), below), same), above) in to.iter_mut().zip(blocks(costs)).zip(below).zip(same).zip(above) {
        for i in 0..STEP {
            let near = below[i].min(above[i]).saturating_add(SMALL);
            // no cost that a path comes from is below the least, so this does not wrap
            to[i] = costs[i].saturating_add(same[i].min(near).min(far).wrapping_sub(least));
            lowest[i] = lowest[i].min(to[i]);
        }
    }
    least_of(&lowest)
}

#[inline(always)]
fn least_of(costs: &[u8]) -> u8 {
    costs.iter().fold(u8::MAX, |a, b| a.min(*b))
}

/// Sets the sums to the costs of four paths, or adds them if `add` is set.
#[inline(always)]
fn add_paths(add: bool, sums: &mut [u16], paths: [&[u8]; 4]) {
    let [a, b, c, d] = paths.map(|path| path.as_chunks::<STEP>().0);
    for ((((sums, a), b), c), d) in sums.as_chunks_mut::<STEP>().0.iter_mut().zip(a).zip(b).zip(c).zip(d) {
        for i in 0..STEP {
            let four = u16::from(a[i]).wrapping_add(u16::from(b[i])).wrapping_add(u16::from(c[i])).wrapping_add(u16::from(d[i]));
            // eight paths of one byte each do not wrap
            sums[i] = if add { sums[i].wrapping_add(four) } else { four };
        }
    }
}

#[inline(always)]
fn aggregate_row(along: Along, before: &[Paths; 3], now: &mut [Paths; 3], mut sums: Option<&mut [u16]>) {
    let Along { w, n, back, own, above, costs } = along;
    let mut last = vec![u8::MAX; n + 2];
    let mut next = last.clone();
    let mut least = 0;
    for i in 0..w {
        let x = if back { w - 1 - i } else { i };
        let cost = &costs[x * n..(x + 1) * n];
        if i == 0 {
            next[1..=n].copy_from_slice(cost);
            least = least_of(cost);
        } else {
            let before = if back { x + 1 } else { x - 1 };
            least = step(cost, &last, least, large(own[x], own[before]), &mut next);
        }
        std::mem::swap(&mut last, &mut next);
        for (k, (from, to)) in before.iter().zip(now.iter_mut()).enumerate() {
            let to_costs = &mut to.costs[x * (n + 2)..(x + 1) * (n + 2)];
            let source = (x + k).checked_sub(1).filter(|s| *s < w).zip(above);
            to.least[x] = if let Some((s, grey)) = source {
                step(cost, &from.costs[s * (n + 2)..(s + 1) * (n + 2)], from.least[s], large(own[x], grey[s]), to_costs)
            } else {
                to_costs[1..=n].copy_from_slice(cost);
                least_of(cost)
            };
        }
        if let Some(sums) = sums.as_deref_mut() {
            let path = |k: usize| &now[k].costs[x * (n + 2) + 1..][..n];
            add_paths(back, &mut sums[x * n..(x + 1) * n], [&last[1..=n], path(0), path(1), path(2)]);
        }
    }
}

dispatch!(aggregate, aggregate_row, (along: Along<'_>, before: &[Paths; 3], now: &mut [Paths; 3], sums: Option<&mut [u16]>));

/// Chooses the disparity with the least sum for each pixel of a row, if the other picture's pixel would choose the same and no other
/// position matches as well.
#[inline(always)]
fn choose_row(sums: &[u16], range: Range, out: &mut [f32]) {
    let (w, n) = (out.len(), range.count);
    // for each position in the other picture: the least sum in the high bits, the index of its disparity in the low bits
    let mut other = vec![u32::MAX; w];
    for (x, sums) in sums.chunks_exact(n).enumerate() {
        let most = x as i64 - i64::from(range.first);
        let (start, end) = inside(most, w, n);
        if start < end {
            let places = &mut other[(most - end as i64 + 1) as usize..=(most - start as i64) as usize];
            for ((i, sum), place) in (start as u32..end as u32).zip(&sums[start..end]).zip(places.iter_mut().rev()) {
                *place = (*place).min(u32::from(*sum) << 16 | i);
            }
        }
    }
    for (x, (sums, out)) in sums.chunks_exact(n).zip(out).enumerate() {
        let least = sums.iter().fold(u16::MAX, |a, b| if *b < a { *b } else { a });
        let Some(i) = sums.iter().position(|s| *s == least) else { continue };
        let d = range.first + i as i32;
        let Some(back) = usize::try_from(x as i64 - i64::from(d)).ok().and_then(|place| other.get(place)) else { continue };
        let rival = sums[..i.saturating_sub(1)].iter().chain(&sums[(i + 2).min(n)..]).fold(u16::MAX, |a, b| if *b < a { *b } else { a });
        if (back & 0xFFFF).abs_diff(i as u32) <= 1 && f32::from(least) < UNIQUE * f32::from(rival) {
            *out = d as f32 + between(i.checked_sub(1).map(|i| sums[i]), least, sums.get(i + 1).copied());
        }
    }
}

dispatch!(choose, choose_row, (sums: &[u16], range: Range, out: &mut [f32]));

/// Indices of the disparities, as begin and end, that lead into the other picture, `w` wide, from a pixel whose first disparity leads to
/// `most`.
#[inline(always)]
fn inside(most: i64, w: usize, n: usize) -> (usize, usize) {
    ((most - w as i64 + 1).clamp(0, n as i64) as usize, (most + 1).clamp(0, n as i64) as usize)
}

/// Minimum of two lines of equal slope through three sums, −0.5 to 0.5 from the middle one; 0 at an end.
fn between(before: Option<u16>, least: u16, after: Option<u16>) -> f32 {
    let (Some(before), Some(after)) = (before, after) else { return 0.0 };
    let (a, b, c) = (f32::from(before), f32::from(least), f32::from(after));
    let steep = (a - b).max(c - b);
    if steep > 0.0 { (a - c) / (2.0 * steep) } else { 0.0 }
}
