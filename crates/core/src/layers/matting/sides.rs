//! Statistics of the unmixed colours on both sides of a border, in a form that vectorises.

use super::matte::Side;
use crate::simd::dispatch;

/// Half the size, in pixels, of the window around a pixel that supplies the colours of either side.
pub(super) const WINDOW: usize = 4;
/// Columns that are summed together: those of the window, rounded up to whole vectors, of four numbers in WebAssembly and up to eight
/// elsewhere.
pub(super) const COLUMNS: usize = if cfg!(target_arch = "wasm32") { 12 } else { 16 };

/// Weights of the colours in a window, by vertical and horizontal distance.
const BY_DISTANCE: [[u32; WINDOW + 1]; WINDOW + 1] =
    [[16, 15, 12, 9, 6], [15, 14, 11, 8, 5], [12, 11, 9, 7, 4], [9, 8, 7, 5, 3], [6, 5, 4, 3, 2]];
/// The same by vertical distance and column, and 0 beyond the window, so that as many columns follow each of the first.
static WEIGHTS: [[u32; COLUMNS + WINDOW]; WINDOW + 1] = weights();

const fn weights() -> [[u32; COLUMNS + WINDOW]; WINDOW + 1] {
    let mut all = [[0; COLUMNS + WINDOW]; WINDOW + 1];
    let mut down = 0;
    while down <= WINDOW {
        let mut column = 0;
        while column <= 2 * WINDOW {
            all[down][column] = BY_DISTANCE[down][column.abs_diff(WINDOW)];
            column += 1;
        }
        down += 1;
    }
    all
}

/// The pixels of a tile, row by row, and [`COLUMNS`] more, of any value.
#[derive(Clone, Copy)]
pub struct Pixels<'a> {
    /// Pixels in a row.
    pub width: usize,
    /// δ of the visible surface, and the maximum around each pixel.
    pub visible: &'a [f32],
    pub most: &'a [f32],
    /// Colours as words, and the sums of the squares of their channels.
    pub words: &'a [u32],
    pub squares: &'a [u32],
}

/// Unmixed colours around a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sides {
    /// In front of the border.
    pub front: Side,
    /// Behind it.
    pub back: Side,
}

dispatch!(
    /// Sums the squares of the channels of each word.
    pub squares, squares_body, (words: &[u32], out: &mut [u32])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn squares_body(words: &[u32], out: &mut [u32]) {
    for (out, word) in out.iter_mut().zip(words) {
        let [r, g, b] = [word & 0xff, word >> 8 & 0xff, word >> 16 & 0xff];
        *out = r * r + g * g + b * b;
    }
}

dispatch!(
    /// The colours in the window around pixel `(x, y)`. In front are the pixels where `near` is at least `middle`; behind are those without
    /// anything at `middle` around them that lie in front of `farthest`.
    pub around, around_body, (pixels: Pixels, near: &[f32], at: [usize; 2], farthest: f32, middle: f32) -> Sides
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
#[allow(clippy::needless_bitwise_bool, reason = "without a branch")]
fn around_body(pixels: Pixels, near: &[f32], [x, y]: [usize; 2], farthest: f32, middle: f32) -> Sides {
    let Pixels { width, visible, most, words, squares } = pixels;
    let first = x.saturating_sub(WINDOW);
    let (inside, skipped) = (width - first, first + WINDOW - x);
    let inside: [u32; COLUMNS] = std::array::from_fn(|i| if i < inside { u32::MAX } else { 0 });
    let rows = (words.len() - COLUMNS) / width;
    let (mut front, mut back) = ([[0u32; COLUMNS]; 3], [[0u32; COLUMNS]; 3]);
    for v in y.saturating_sub(WINDOW)..(y + WINDOW + 1).min(rows) {
        let at = v * width + first;
        let weights = &WEIGHTS[v.abs_diff(y)][skipped..][..COLUMNS];
        let (near, visible, most) = (&near[at..][..COLUMNS], &visible[at..][..COLUMNS], &most[at..][..COLUMNS]);
        let (words, squares) = (&words[at..][..COLUMNS], &squares[at..][..COLUMNS]);
        for i in 0..COLUMNS {
            let weight = weights[i] & inside[i];
            let in_front = if near[i] >= middle { weight } else { 0 };
            let behind = if (most[i] < middle) & (visible[i] > farthest) { weight } else { 0 };
            // two sums in one word: the weights of a column add up to 100, so neither exceeds 16 bits
            let parts = [words[i] & 0x00ff_00ff, (words[i] >> 8 & 0xff) | (1 << 16), squares[i]];
            // no condition in this loop: the compiler would make branches of it, and vectorise nothing
            for k in 0..parts.len() {
                front[k][i] += parts[k] * in_front;
                back[k][i] += parts[k] * behind;
            }
        }
    }
    Sides { front: side(&front), back: side(&back) }
}

/// Sums the columns: red and blue, green and weight, squares.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn side([red_blue, green_weight, squares]: &[[u32; COLUMNS]; 3]) -> Side {
    let low = |columns: &[u32; COLUMNS]| columns.iter().map(|v| v & 0xffff).sum::<u32>();
    let high = |columns: &[u32; COLUMNS]| columns.iter().map(|v| v >> 16).sum::<u32>();
    Side { weight: high(green_weight), sum: [low(red_blue), low(green_weight), high(red_blue)], squares: squares.iter().sum() }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::scene::packed_rgb::words;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// Compares with one pixel at a time.
        #[test]
        fn windows_agree_with_single_pixels(
            width in 1usize..24, height in 1usize..12, at in any::<[usize; 2]>(), farthest in 0.0f32..0.5, middle in 0.4f32..0.8,
            seed in prop::collection::vec((any::<[u8; 3]>(), prop::array::uniform3(0.0f32..1.0)), 24 * 12 + COLUMNS),
        ) {
            let ([x, y], count) = ([at[0] % width, at[1] % height], width * height + COLUMNS);
            let rgb: Vec<[u8; 3]> = seed[..count].iter().map(|s| s.0).collect();
            let [near, visible, most] = [0, 1, 2].map(|k| seed[..count].iter().map(|s| s.1[k]).collect::<Vec<f32>>());
            let (mut colours, mut squared) = (vec![0; count], vec![0; count]);
            words(&rgb, &mut colours);
            squares(&colours, &mut squared);
            let pixels = Pixels { width, visible: &visible, most: &most, words: &colours, squares: &squared };
            let (mut front, mut back) = (Side::default(), Side::default());
            for i in 0..width * height {
                let (across, down) = ((i % width).abs_diff(x), (i / width).abs_diff(y));
                if across <= WINDOW && down <= WINDOW {
                    let weight = BY_DISTANCE[down][across];
                    if near[i] >= middle {
                        front.add(rgb[i], weight);
                    }
                    if most[i] < middle && visible[i] > farthest {
                        back.add(rgb[i], weight);
                    }
                }
            }
            prop_assert_eq!(around(pixels, &near, [x, y], farthest, middle), Sides { front, back });
        }
    }
}
