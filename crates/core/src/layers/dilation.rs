//! Box dilation of byte masks.

use crate::scene::Rect;
use crate::simd::dispatch;

/// A dilated mask, and scratch memory.
#[derive(Clone, Debug, Default)]
pub struct Dilation {
    line: Vec<u8>,
    column: Vec<u8>,
    /// The dilated part, row-major.
    pub out: Vec<u8>,
}

/// Dilates the mask `open` (0 or 1, `width` pixels wide) with a box of `radius` pixels: `radius.0` to the left and right, `radius.1` up and
/// down. Writes the part `inner` of the result.
pub fn dilate(open: &[u8], width: u32, inner: Rect, radius: (u32, u32), Dilation { line, column, out }: &mut Dilation) {
    let (width, rx, ry) = (width as usize, radius.0 as usize, radius.1 as usize);
    let (x0, y0, w, h) = (inner.x as usize, inner.y as usize, inner.w as usize, inner.h as usize);
    let height = open.len() / width.max(1);
    // dilate horizontally each row that the result depends on
    let first = y0.saturating_sub(ry);
    let last = (y0 + h + ry).min(height);
    let above = ry.saturating_sub(y0);
    column.clear();
    column.resize((h + 2 * ry) * w, 0);
    for (from, to) in open[first * width..last * width].chunks(width).zip(column[above * w..].chunks_mut(w)) {
        line.clear();
        line.resize(w + 2 * rx, 0);
        // the line starts at column `x0 − rx` of the mask
        let (skip, start) = ((rx).saturating_sub(x0), x0.saturating_sub(rx));
        let count = (width - start).min(line.len() - skip);
        let (any, all) = from[start..start + count].iter().fold((0, 1), |(any, all), v| (any | v, all & v));
        if any == all {
            // the row is uniform, as most are; outside the mask all is 0
            to.fill(any);
            continue;
        }
        line[skip..skip + count].copy_from_slice(&from[start..start + count]);
        spread(line, 1, 2 * rx + 1);
        to.copy_from_slice(&line[..w]);
    }
    // dilate vertically, whole rows at a time
    spread(column, w, 2 * ry + 1);
    out.clear();
    out.extend_from_slice(&column[..h * w]);
}

/// ORs into every value the values at the next `count - 1` steps of `stride`. Doubles the distance each time.
fn spread(values: &mut [u8], stride: usize, count: usize) {
    let mut reached = 1;
    while reached < count {
        let by = reached.min(count - reached) * stride;
        let n = values.len().saturating_sub(by);
        or_from(values, by, n);
        reached += by / stride;
    }
}

dispatch!(
    /// ORs into each of the first `n` values the value `by` places later.
    or_from, or_from_body, (values: &mut [u8], by: usize, n: usize)
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn or_from_body(values: &mut [u8], by: usize, n: usize) {
    const BLOCK: usize = 32;
    // reads a block's later values before it changes them, even if the blocks overlap
    let mut at = 0;
    while at + BLOCK <= n {
        let mut later = [0u8; BLOCK];
        later.copy_from_slice(&values[at + by..at + by + BLOCK]);
        for (v, l) in values[at..at + BLOCK].iter_mut().zip(later) {
            *v |= l;
        }
        at += BLOCK;
    }
    for i in at..n {
        values[i] |= values[i + by];
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        #[test]
        fn dilation_is_a_box(
            mask in prop::collection::vec(prop::bool::weighted(0.05).prop_map(u8::from), 15 * 11),
            rx in 0u32..20, ry in 0u32..20, x in 0u32..15, y in 0u32..11,
        ) {
            let inner = Rect { x, y, w: (15 - x).min(7), h: (11 - y).min(4) };
            let mut d = Dilation::default();
            dilate(&mask, 15, inner, (rx, ry), &mut d);
            prop_assert_eq!(d.out.len(), inner.area());
            for (i, got) in d.out.into_iter().enumerate() {
                let (px, py) = (x + i as u32 % inner.w, y + i as u32 / inner.w);
                let near = |j: u32| px.abs_diff(j % 15) <= rx && py.abs_diff(j / 15) <= ry;
                let want = (0..15 * 11).any(|j| mask[j as usize] != 0 && near(j));
                prop_assert_eq!(got, u8::from(want), "at {}, {}", px, py);
            }
        }
    }
}
