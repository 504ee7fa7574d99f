//! Detects which blocks of a frame differ from the previous one.

use tmpi_core::{Grid, Photo};

/// Side of a block in pixels. The stride of tiles is a multiple of it.
pub const BLOCK: u32 = 8;
/// Bins of the luma histogram.
const BINS: usize = 32;
/// A frame is a cut if at least this fraction of pixels moved to another histogram bin …
const CUT: f64 = 0.35;
/// … and this fraction of blocks changed. A light that is switched on changes all blocks; a person who passes by does not.
const CUT_BLOCKS: f64 = 0.8;

/// How much a block may differ from the frame that its geometry comes from and still count as unchanged.
#[derive(Clone, Copy, Debug)]
struct Tolerance {
    /// Largest difference of a channel, in levels.
    most: u8,
    /// Mean difference over a block, in levels.
    mean: f32,
}

/// Tolerates noise with a standard deviation of 2 levels, raw or re-encoded, with some margin. Encoders that repeat still areas exactly
/// need no tolerance.
impl Default for Tolerance {
    fn default() -> Self {
        Self { most: 24, mean: 4.0 }
    }
}

/// Compares each frame with a reference frame.
#[derive(Clone, Debug, Default)]
pub struct Compare {
    tolerance: Tolerance,
    /// Each block's pixels when it last changed, so that slow changes accumulate and are detected.
    reference: Option<Photo>,
    histogram: [u32; BINS],
}

/// The changed blocks of a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Change {
    /// Whether each block changed, row by row. At a cut, all did.
    pub blocks: Vec<bool>,
    /// Blocks per row.
    pub across: usize,
    /// The frame starts a new scene.
    pub cut: bool,
}

impl Change {
    /// Indices of the tiles of a grid that contain a changed block.
    pub fn tiles(&self, grid: &Grid) -> Vec<u32> {
        let is_changed = |t: &u32| {
            let r = grid.rect(*t);
            let (columns, rows) = (r.x / BLOCK..(r.x + r.w).div_ceil(BLOCK), r.y / BLOCK..(r.y + r.h).div_ceil(BLOCK));
            rows.flat_map(|y| columns.clone().map(move |x| (x, y))).any(|(x, y)| self.blocks[y as usize * self.across + x as usize])
        };
        (0..grid.tiles()).filter(is_changed).collect()
    }
}

impl Compare {
    /// Each block's pixels when it last changed; `None` before the first frame.
    pub const fn reference(&self) -> Option<&Photo> {
        self.reference.as_ref()
    }

    /// Compares a frame with the reference and updates the reference. The first frame, and one with a new size, is a cut.
    pub fn next(&mut self, photo: &Photo) -> Change {
        let across = photo.width.div_ceil(BLOCK) as usize;
        let count = across * photo.height.div_ceil(BLOCK) as usize;
        let histogram = histogram(photo);
        let before = std::mem::replace(&mut self.histogram, histogram);
        let Some(reference) = self.reference.as_mut().filter(|r| (r.width, r.height) == (photo.width, photo.height)) else {
            self.reference = Some(photo.clone());
            return Change { blocks: vec![true; count], across, cut: true };
        };
        let mut blocks = vec![false; count];
        let width = photo.width as usize;
        let band = width * BLOCK as usize;
        for ((new, old), out) in photo.rgb.chunks(band).zip(reference.rgb.chunks_mut(band)).zip(blocks.chunks_mut(across)) {
            // fast path: most rows of blocks are unchanged
            if new == &*old {
                continue;
            }
            for (b, out) in out.iter_mut().enumerate() {
                *out = differs(new, old, width, b * BLOCK as usize, self.tolerance);
            }
        }
        let changed = blocks.iter().filter(|b| **b).count();
        let moved: u64 = before.iter().zip(&histogram).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
        // each pixel that moves to another bin counts twice
        let cut = changed as f64 > CUT_BLOCKS * count as f64 && moved as f64 > 2.0 * CUT * photo.rgb.len() as f64;
        if cut {
            // blocks that happen to look the same change too: their depth and planes belong to the old scene
            blocks.fill(true);
            self.reference = Some(photo.clone());
        }
        Change { blocks, across, cut }
    }
}

/// Whether the block at column `x` differs by more than the tolerance. If so, copies it to the reference (`old`).
fn differs(new: &[[u8; 3]], old: &mut [[u8; 3]], width: usize, x: usize, tolerance: Tolerance) -> bool {
    let end = (x + BLOCK as usize).min(width);
    let (mut sum, mut most) = (0u32, 0u8);
    for (new, old) in new.chunks(width).zip(old.chunks(width)) {
        for (a, b) in new[x..end].as_flattened().iter().zip(old[x..end].as_flattened()) {
            let d = a.abs_diff(*b);
            sum += u32::from(d);
            most = most.max(d);
        }
    }
    let values = (end - x) * new.len() / width * 3;
    if most == 0 || (most <= tolerance.most && sum as f32 <= tolerance.mean * values as f32) {
        return false;
    }
    for (new, old) in new.chunks(width).zip(old.chunks_mut(width)) {
        old[x..end].copy_from_slice(&new[x..end]);
    }
    true
}

fn histogram(photo: &Photo) -> [u32; BINS] {
    let mut bins = [0; BINS];
    for [r, g, b] in &photo.rgb {
        let luma = (u32::from(*r) * 54 + u32::from(*g) * 183 + u32::from(*b) * 19) >> 8;
        bins[(luma as usize * BINS) >> 8] += 1;
    }
    bins
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn tolerating(most: u8, mean: f32) -> Compare {
        Compare { tolerance: Tolerance { most, mean }, ..Compare::default() }
    }

    fn is_nothing(change: &Change) -> bool {
        !change.blocks.contains(&true)
    }

    fn photo(width: u32, height: u32, seed: u32) -> Photo {
        let pixel = |i: u32| (i.wrapping_mul(2_654_435_761).wrapping_add(seed) >> 24) as u8;
        Photo { width, height, rgb: (0..width * height).map(|i| [pixel(i), pixel(i + 7), pixel(i + 13)]).collect() }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        /// A change of one pixel marks exactly the tiles that contain its block.
        #[test]
        fn a_change_marks_exactly_its_tiles(w in 1u32..150, h in 1u32..150, at in any::<u32>(), by in 1u8..) {
            let first = photo(w, h, 1);
            let mut compare = tolerating(0, 0.0);
            prop_assert!(compare.next(&first).cut);
            prop_assert!(is_nothing(&compare.next(&first)));
            let mut second = first.clone();
            let at = at % (w * h);
            second.rgb[at as usize][1] ^= by;
            let change = compare.next(&second);
            let (x, y) = (at % w, at / w);
            let grid = Grid::new(w, h, 64);
            let tiles = change.tiles(&grid);
            for t in 0..grid.tiles() {
                // at the picture's border, a tile may end within a block
                let r = grid.rect(t);
                let near = |from: u32, size: u32, p: u32| from / BLOCK <= p / BLOCK && p / BLOCK < (from + size).div_ceil(BLOCK);
                prop_assert_eq!(tiles.contains(&t), near(r.x, r.w, x) && near(r.y, r.h, y));
            }
            prop_assert!(is_nothing(&compare.next(&second)));
        }
    }

    #[test]
    fn slow_changes_accumulate_beyond_the_tolerance() {
        let mut compare = tolerating(8, 0.5);
        let mut now = photo(64, 64, 1);
        now.rgb.iter_mut().for_each(|p| p[0] = 0);
        compare.next(&now);
        let mut steps = 0;
        loop {
            now.rgb.iter_mut().for_each(|p| p[0] += 1);
            steps += 1;
            if !is_nothing(&compare.next(&now)) {
                break;
            }
        }
        // one of three channels changes: 1.5 levels of it are a mean of 0.5
        assert_eq!(steps, 2);
    }

    #[test]
    fn noise_of_two_levels_does_not_hide_changes() {
        let clean = photo(96, 64, 5);
        let mut seed = 1u64;
        // the sum of twelve uniform values has a standard deviation of 1
        let mut noise = || {
            let mut unit = || {
                seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (seed >> 40) as f64 / f64::from(1u32 << 24)
            };
            2.0 * ((0..12).map(|_| unit()).sum::<f64>() - 6.0)
        };
        let mut noisy = |p: &Photo| {
            let rgb = p.rgb.iter().map(|c| c.map(|v| (f64::from(v) + noise()).round().clamp(0.0, 255.0) as u8)).collect();
            Photo { rgb, ..p.clone() }
        };
        let mut compare = Compare::default();
        compare.next(&noisy(&clean));
        for frame in 0..100 {
            assert!(is_nothing(&compare.next(&noisy(&clean))), "frame {frame}");
        }
        let mut other = clean.clone();
        (0..64).for_each(|i| other.rgb[i / 8 * 96 + i % 8] = clean.rgb[i / 8 * 96 + i % 8].map(|v| v ^ 16));
        let change = compare.next(&noisy(&other));
        assert_eq!(change.blocks.iter().position(|b| *b), Some(0));
        assert_eq!(change.blocks.iter().filter(|b| **b).count(), 1);
    }

    #[test]
    fn another_picture_is_a_cut_but_noise_is_not() {
        let mut compare = tolerating(0, 0.0);
        let dark = Photo { width: 64, height: 64, rgb: (0..4096).map(|i| [20 + (i % 40) as u8; 3]).collect() };
        compare.next(&dark);
        let noisy = Photo { rgb: dark.rgb.iter().map(|p| p.map(|v| v + 1)).collect(), ..dark.clone() };
        let change = compare.next(&noisy);
        assert!(!change.cut && change.blocks.iter().all(|b| *b));
        let bright = Photo { rgb: dark.rgb.iter().map(|p| p.map(|v| v + 150)).collect(), ..dark };
        assert!(compare.next(&bright).cut);
    }

    #[test]
    fn every_block_changes_at_a_cut() {
        let mut compare = tolerating(0, 0.0);
        // a letterboxed film: the black bar stays when the scene changes
        let barred = |v: u8| Photo { width: 64, height: 64, rgb: (0..4096).map(|i| if i < 512 { [0; 3] } else { [v; 3] }).collect() };
        compare.next(&barred(40));
        let change = compare.next(&barred(200));
        assert!(change.cut && change.blocks.iter().all(|b| *b), "{:?}", change.blocks);
        assert_eq!(compare.reference(), Some(&barred(200)));
        assert!(is_nothing(&compare.next(&barred(200))));
    }
}
