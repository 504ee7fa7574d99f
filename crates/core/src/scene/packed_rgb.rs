//! Colours as 32-bit words, because vector code handles words where it cannot handle three bytes.

use crate::simd::dispatch;

dispatch!(
    /// Converts colours to words, with red in the lowest byte and 0 in the highest. Converts as many as the shorter slice holds.
    pub words, words_body, (rgb: &[[u8; 3]], out: &mut [u32])
);

#[inline(always)]
fn words_body(rgb: &[[u8; 3]], out: &mut [u32]) {
    let count = rgb.len().min(out.len());
    let ((fours, rest), (words, last)) = (rgb[..count].as_chunks::<4>(), out[..count].as_chunks_mut::<4>());
    for (four, out) in fours.iter().zip(words) {
        // three words of four bytes hold four colours of three bytes
        let b = four.as_flattened();
        let word = |i: usize| u32::from_le_bytes([b[i], b[i + 1], b[i + 2], b[i + 3]]);
        let (x, y, z) = (word(0), word(4), word(8));
        *out = [x, x >> 24 | y << 8, y >> 16 | z << 16, z >> 8].map(|word| word & 0x00ff_ffff);
    }
    for ([r, g, b], out) in rest.iter().zip(last) {
        *out = u32::from_le_bytes([*r, *g, *b, 0]);
    }
}

/// Converts a word back to a colour.
pub const fn of_word(word: u32) -> [u8; 3] {
    let [r, g, b, _] = word.to_le_bytes();
    [r, g, b]
}

/// Absolute difference of two colours in levels, summed over the channels: 0 to 765.
#[inline(always)]
pub fn difference(a: u32, b: u32) -> u32 {
    let channel = |shift: u32| ((a >> shift & 0xff) as i32 - (b >> shift & 0xff) as i32).unsigned_abs();
    channel(0) + channel(8) + channel(16)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn words_have_the_colours_of_their_pixels(rgb in prop::collection::vec(any::<[u8; 3]>(), 0..40), other in any::<[u8; 3]>()) {
            let mut out = vec![7; rgb.len()];
            words(&rgb, &mut out);
            let mut word = [0];
            words(&[other], &mut word);
            for (word_of, colour) in out.iter().zip(&rgb) {
                prop_assert_eq!((of_word(*word_of), word_of >> 24), (*colour, 0));
                let want: u32 = colour.iter().zip(other).map(|(a, b)| u32::from(a.abs_diff(b))).sum();
                prop_assert_eq!(difference(*word_of, word[0]), want);
            }
        }
    }
}
