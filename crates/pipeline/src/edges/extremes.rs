//! Smallest and largest values around each pixel.

use rayon::prelude::*;

/// Rows per task.
const ROWS: usize = 32;

/// Smallest and largest value of the `(2r+1)²` window around each pixel of a map `w` pixels wide.
pub(super) fn extremes(values: &[f32], w: usize, r: usize) -> (Vec<f32>, Vec<f32>) {
    rayon::join(|| extreme(values, w, r, lowest), || extreme(values, w, r, highest))
}

/// The smaller number. It is a single vector instruction, unlike `f32::min`, which must ignore NaN; the map is finite.
pub(super) fn lowest(a: f32, b: f32) -> f32 {
    if b < a { b } else { a }
}

/// The larger number, like [`lowest`].
pub(super) fn highest(a: f32, b: f32) -> f32 {
    if b > a { b } else { a }
}

/// One of the extremes, by rows and then by columns.
pub(super) fn extreme(values: &[f32], w: usize, r: usize, pick: impl Fn(f32, f32) -> f32 + Sync) -> Vec<f32> {
    let mut rows = vec![0.0; values.len()];
    rows.par_chunks_mut(w).zip(values.par_chunks(w)).for_each_init(Runs::default, |runs, (out, row)| {
        // the values at the borders are in each window that reaches beyond them
        let beyond = |value: f32| std::iter::repeat_n(value, r);
        runs.load(beyond(row[0]).chain(row.iter().copied()).chain(beyond(row[w - 1])));
        out.copy_from_slice(runs.over(2 * r + 1, 1, &pick));
    });
    let h = values.len() / w;
    let mut out = vec![0.0; values.len()];
    out.par_chunks_mut(w * ROWS).enumerate().for_each_init(Runs::default, |runs, (band, out)| {
        let (first, count) = (band * ROWS, out.len() / w + 2 * r);
        let row = |y: usize| &rows[(first + y).saturating_sub(r).min(h - 1) * w..][..w];
        runs.load((0..count).flat_map(|y| row(y).iter().copied()));
        out.copy_from_slice(runs.over(2 * r + 1, w, &pick));
    });
    out
}

/// Extremes of runs of values.
#[derive(Default)]
struct Runs {
    values: Vec<f32>,
    spare: Vec<f32>,
}

impl Runs {
    fn load(&mut self, values: impl Iterator<Item = f32>) {
        self.values.clear();
        self.values.extend(values);
    }

    /// The extreme of each `count` values that lie `stride` apart: of twice as many in each step, as long as there are as many.
    fn over(&mut self, count: usize, stride: usize, pick: &impl Fn(f32, f32) -> f32) -> &[f32] {
        let mut length = 1;
        while length < count {
            let more = length.min(count - length);
            self.spare.clear();
            self.spare.extend(self.values.iter().zip(&self.values[more * stride..]).map(|(a, b)| pick(*a, *b)));
            std::mem::swap(&mut self.values, &mut self.spare);
            length += more;
        }
        &self.values
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_testing::pictures;

    #[test]
    fn windows_agree_with_their_definition() {
        for (w, h) in [(1usize, 1usize), (1, 40), (37, 1), (5, 3), (41, 70)] {
            let values: Vec<f32> = (0..w * h).map(|i| pictures::noise((i % w) as u32, (i / w) as u32)).collect();
            for r in [0, 1, 2, 3, 6, 10, 50] {
                let (low, high) = extremes(&values, w, r);
                for i in 0..w * h {
                    let reach = |at: usize, size: usize| at.saturating_sub(r)..(at + r + 1).min(size);
                    let window = reach(i / w, h).flat_map(|y| reach(i % w, w).map(move |x| y * w + x));
                    let (lo, hi) = window.fold((f32::MAX, f32::MIN), |(lo, hi), j| (lo.min(values[j]), hi.max(values[j])));
                    assert_eq!((low[i], high[i]), (lo, hi), "{w}×{h}, radius {r}, pixel {i}");
                }
            }
        }
    }
}
