//! The census transform (Zabih and Woodfill 1994): which neighbours of a pixel are darker than it. It does not change with exposure.

use rayon::prelude::*;

/// Radius of the window, x and y: 9 × 7 pixels, of which 62 are compared.
const RADIUS: (usize, usize) = (4, 3);

/// A grey picture, row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct Grey {
    /// Width in pixels, at least 1.
    pub width: usize,
    /// Height in pixels, at least 1.
    pub height: usize,
    /// Brightness, 0 to 255.
    pub values: Vec<u8>,
}

/// Census transform of a picture, one word per pixel. Beyond the border, the outermost pixels repeat.
pub fn census(picture: &Grey) -> Vec<u64> {
    let (w, h) = (picture.width, picture.height);
    let (rx, ry) = RADIUS;
    let mut out = vec![0u64; w * h];
    out.par_chunks_exact_mut(w).enumerate().for_each_init(Vec::new, |line: &mut Vec<u8>, (y, out)| {
        let own = &picture.values[y * w..(y + 1) * w];
        // eight comparisons per byte: sixteen pixels at once on any processor
        let mut bytes = [const { Vec::new() }; 8];
        let mut count = 0;
        for dy in 0..=2 * ry {
            let row = &picture.values[(y + dy).saturating_sub(ry).min(h - 1) * w..][..w];
            line.clear();
            line.extend(std::iter::repeat_n(row[0], rx));
            line.extend_from_slice(row);
            line.extend(std::iter::repeat_n(row[w - 1], rx));
            for dx in (0..=2 * rx).filter(|dx| (*dx, dy) != (rx, ry)) {
                let byte = &mut bytes[count / 8];
                byte.resize(w, 0u8);
                for ((byte, neighbour), own) in byte.iter_mut().zip(&line[dx..dx + w]).zip(own) {
                    *byte = *byte << 1 | u8::from(neighbour < own);
                }
                count += 1;
            }
        }
        for (x, out) in out.iter_mut().enumerate() {
            *out = u64::from_le_bytes(std::array::from_fn(|k| bytes[k][x]));
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Reference: for each of the 62 neighbours of a pixel, whether it is darker.
    fn darker(picture: &Grey, i: usize) -> Vec<bool> {
        let (w, h) = (picture.width as i64, picture.height as i64);
        let (x, y) = (i as i64 % w, i as i64 / w);
        let at = |x: i64, y: i64| picture.values[(y.clamp(0, h - 1) * w + x.clamp(0, w - 1)) as usize];
        let around = (-3..=3).flat_map(|dy| (-4..=4).map(move |dx| (dx, dy))).filter(|by| *by != (0, 0));
        around.map(|(dx, dy)| at(x + dx, y + dy) < at(x, y)).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// The order of the comparisons in a word does not matter, as long as it is the same everywhere.
        #[test]
        fn words_differ_in_as_many_bits_as_comparisons_do(
            width in 1usize..24, height in 1usize..9, levels in 1u8..=255, values in prop::collection::vec(any::<u8>(), 24 * 9),
        ) {
            let picture = Grey { width, height, values: values[..width * height].iter().map(|v| v % levels).collect() };
            let (words, want) = (census(&picture), (0..width * height).map(|i| darker(&picture, i)).collect::<Vec<_>>());
            for (i, j) in (0..width * height).flat_map(|i| (0..i).map(move |j| (i, j))) {
                let differ = want[i].iter().zip(&want[j]).filter(|(a, b)| a != b).count();
                prop_assert_eq!((words[i] ^ words[j]).count_ones() as usize, differ, "pixels {} and {}", i, j);
            }
            prop_assert!(words.iter().zip(&want).all(|(w, d)| w.count_ones() as usize == d.iter().filter(|d| **d).count()));
        }
    }
}
