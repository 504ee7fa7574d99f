//! Fuses measured disparity with a network's estimate. The estimate is brought to the scale of the measured pixels, over the whole
//! picture and then locally, and fills what was not measured.

/// Pairs of pixels in which both are compared.
const PAIRS: usize = 20_000;
/// Share of pairs with the same order below which the eyes are swapped.
const CROSSED: f64 = 0.2;
/// Least differences of a pair that has an order: of the estimate, and of the measured disparity in pixels.
const TELLS: (f32, f32) = (0.1, 1.0);
/// Tries of scale and shift.
const TRIES: usize = 200;
/// Share of the measured range within which a pixel agrees with scale and shift.
const AGREES: f32 = 0.08;
/// A gap in a row is hidden from the other eye if it is at most this factor times the step of disparity across it, plus this many pixels.
const HIDDEN: (f32, f32) = (1.4, 3.0);

/// A deterministic sequence of random numbers.
pub(super) struct Draw(pub(super) u64);

impl Draw {
    pub(super) fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % n.max(1)
    }
}

/// Whether the measured disparities (NaN where unmeasured) run against the estimate. Then the second picture is the left eye's.
pub fn is_crossed(measured: &[f32], estimate: &[f32]) -> bool {
    let known: Vec<usize> = (0..measured.len()).filter(|i| measured[*i].is_finite()).collect();
    if known.is_empty() {
        return false;
    }
    let mut draw = Draw(0x9E37_79B9_7F4A_7C15);
    let (mut alike, mut all) = (0usize, 0usize);
    for _ in 0..PAIRS {
        let (a, b) = (known[draw.below(known.len())], known[draw.below(known.len())]);
        let (m, e) = (measured[a] - measured[b], estimate[a] - estimate[b]);
        if e.abs() > TELLS.0 && m.abs() > TELLS.1 {
            all += 1;
            alike += usize::from((m > 0.0) == (e > 0.0));
        }
    }
    all > PAIRS / 100 && (alike as f64) < CROSSED * all as f64
}

/// Fills unmeasured pixels (NaN) of a picture `w` pixels wide, and returns the share of pixels that took their depth from the estimate.
/// Disparity grows towards the eye, and so does the estimate, 0 to 1.
pub fn fill(measured: &mut [f32], estimate: &[f32], w: usize) -> f64 {
    fill_hidden(measured, w);
    let known: Vec<usize> = (0..measured.len()).filter(|i| measured[*i].is_finite()).collect();
    let (scale, shift) = align(measured, estimate, &known);
    let mut rest: Vec<f32> = measured.iter().zip(estimate).map(|(m, e)| m - (scale * e + shift)).collect();
    spread(&mut rest, w);
    for ((m, e), rest) in measured.iter_mut().zip(estimate).zip(&rest) {
        if !m.is_finite() {
            *m = scale * e + shift + rest;
        }
    }
    1.0 - known.len() as f64 / measured.len().max(1) as f64
}

/// Fills gaps where a nearer surface hides the scene from the other eye with the farther of the two sides.
fn fill_hidden(measured: &mut [f32], w: usize) {
    for row in measured.chunks_exact_mut(w) {
        let mut left: Option<usize> = None;
        for x in 0..w {
            if !row[x].is_finite() {
                continue;
            }
            if let Some(l) = left.filter(|l| x - l > 1) {
                let (gap, step) = ((x - l - 1) as f32, (row[x] - row[l]).abs());
                if gap <= HIDDEN.0 * step + HIDDEN.1 {
                    let far = row[l].min(row[x]);
                    row[l + 1..x].fill(far);
                }
            }
            left = Some(x);
        }
    }
}

/// Scale and shift that bring the estimate to the measured pixels `known`: those with which most pixels agree, then least squares over
/// these. The scale is 0 if the estimate carries no information.
fn align(measured: &[f32], estimate: &[f32], known: &[usize]) -> (f32, f32) {
    let mut sorted: Vec<f32> = known.iter().map(|i| measured[*i]).collect();
    sorted.sort_by(f32::total_cmp);
    let at = |share: f32| sorted.get(((sorted.len() as f32 - 1.0) * share).max(0.0) as usize).copied().unwrap_or_default();
    let (middle, range) = (at(0.5), at(0.98) - at(0.02));
    let within = (range * AGREES).max(0.5);
    let mut draw = Draw(0xD1B5_4A32_D192_ED03);
    let few: Vec<usize> = (0..known.len().min(4000)).map(|_| known[draw.below(known.len())]).collect();
    let count = |s: f32, t: f32| few.iter().filter(|i| (measured[**i] - s * estimate[**i] - t).abs() < within).count();
    let mut best = (count(0.0, middle), 0.0, middle);
    for _ in 0..TRIES {
        if few.is_empty() {
            break;
        }
        let (a, b) = (few[draw.below(few.len())], few[draw.below(few.len())]);
        if (estimate[a] - estimate[b]).abs() < 0.02 {
            continue;
        }
        let s = (measured[a] - measured[b]) / (estimate[a] - estimate[b]);
        let t = measured[a] - s * estimate[a];
        let n = count(s, t);
        if s > 0.0 && n > best.0 {
            best = (n, s, t);
        }
    }
    let (_, mut s, mut t) = best;
    for _ in 0..3 {
        let mut sums = [0f64; 5];
        for i in known.iter().filter(|i| (measured[**i] - s * estimate[**i] - t).abs() < within) {
            let (e, m) = (f64::from(estimate[*i]), f64::from(measured[*i]));
            for (sum, v) in sums.iter_mut().zip([1.0, e, m, e * e, e * m]) {
                *sum += v;
            }
        }
        let [n, e, m, ee, em] = sums;
        let spread = n * ee - e * e;
        if s > 0.0 && spread > 1e-9 * n * n {
            let scale = ((n * em - e * m) / spread).max(0.0);
            (s, t) = (scale as f32, ((m - scale * e) / n) as f32);
        }
    }
    (s, t)
}

/// Fills non-finite values smoothly from finite ones: by means over ever larger squares, interpolated between them.
fn spread(values: &mut [f32], w: usize) {
    let h = values.len() / w.max(1);
    if values.iter().all(|v| v.is_finite()) || w == 0 {
        return;
    }
    if w == 1 && h == 1 {
        values[0] = 0.0;
        return;
    }
    let (cw, ch) = (w.div_ceil(2), h.div_ceil(2));
    let mut coarse: Vec<f32> = (0..cw * ch)
        .map(|i| {
            let (x, y) = (i % cw * 2, i / cw * 2);
            let of = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)];
            let known = of.iter().filter(|(x, y)| *x < w && *y < h).map(|(x, y)| values[y * w + x]).filter(|v| v.is_finite());
            let (sum, n) = known.fold((0.0, 0.0), |(s, n), v| (s + v, n + 1.0));
            sum / n
        })
        .collect();
    spread(&mut coarse, cw);
    let between = |p: usize, n: usize| {
        let at = (p as f32 / 2.0 - 0.25).clamp(0.0, (n - 1) as f32);
        (at as usize, (at as usize + 1).min(n - 1), at.fract())
    };
    for (i, value) in values.iter_mut().enumerate().filter(|(_, v)| !v.is_finite()) {
        let ((x0, x1, fx), (y0, y1, fy)) = (between(i % w, cw), between(i / w, ch));
        let line = |y: usize| coarse[y * cw + x0] * (1.0 - fx) + coarse[y * cw + x1] * fx;
        *value = line(y0) * (1.0 - fy) + line(y1) * fy;
    }
}

/// Sets connected pieces of fewer than `least` pixels to NaN: they match by chance. Neighbours within 1 pixel of disparity are connected.
pub fn drop_specks(measured: &mut [f32], w: usize, least: usize) {
    let mut seen = vec![false; measured.len()];
    let (mut piece, mut open) = (Vec::new(), Vec::new());
    for start in 0..measured.len() {
        if seen[start] || !measured[start].is_finite() {
            continue;
        }
        seen[start] = true;
        piece.clear();
        open.push(start);
        while let Some(i) = open.pop() {
            piece.push(i);
            let x = i % w;
            let sides =
                [(x > 0).then(|| i - 1), (x + 1 < w).then_some(i + 1), i.checked_sub(w), Some(i + w).filter(|n| *n < measured.len())];
            for n in sides.into_iter().flatten() {
                if !seen[n] && (measured[n] - measured[i]).abs() <= 1.0 {
                    seen[n] = true;
                    open.push(n);
                }
            }
        }
        if piece.len() < least {
            for i in &piece {
                measured[*i] = f32::NAN;
            }
        }
    }
}

#[cfg(test)]
mod tests;
