//! The picture of hidden texels: 8×8 blocks, so that no block of a picture codec mixes two layers.

use crate::{Class, Layer};

/// Side of a block in pixels, the same as in JPEG.
pub const BLOCK: u32 = 8;

/// Calls `cell(x, y)` for every 8×8 cell of the photo's pixel grid that a layer overlaps, row by row, with the cell's corner in photo
/// pixels.
fn cells(l: &Layer, mut cell: impl FnMut(u32, u32)) {
    let r = l.rect;
    for y in (r.y / BLOCK * BLOCK..r.y + r.h).step_by(BLOCK as usize) {
        for x in (r.x / BLOCK * BLOCK..r.x + r.w).step_by(BLOCK as usize) {
            cell(x, y);
        }
    }
}

/// Calls `texel(index in the layer, index in the block)` for each hidden texel in a cell.
fn hidden_in(l: &Layer, class: &[u8], (x, y): (u32, u32), mut texel: impl FnMut(usize, usize)) {
    let r = l.rect;
    for py in y.max(r.y)..(y + BLOCK).min(r.y + r.h) {
        for px in x.max(r.x)..(x + BLOCK).min(r.x + r.w) {
            let at = (py - r.y) as usize * r.w as usize + (px - r.x) as usize;
            if class[at] == Class::Hidden as u8 {
                texel(at, ((py - y) * BLOCK + px - x) as usize);
            }
        }
    }
}

/// Visits the blocks of all layers in the schema's order and calls `place(block, index in the block, index of the hidden texel)` for each
/// hidden texel. Returns the number of blocks.
pub fn walk(layers: &[Layer], class: &[u8], mut place: impl FnMut(usize, usize, usize)) -> usize {
    let mut blocks = 0;
    let mut rank: Vec<u32> = Vec::new();
    for l in layers {
        let class = &class[l.first_texel..l.first_texel + l.rect.area()];
        rank.clear();
        rank.extend(class.iter().scan(0u32, |n, &c| {
            let at = *n;
            *n += u32::from(c == Class::Hidden as u8);
            Some(at)
        }));
        cells(l, |x, y| {
            let mut any = false;
            hidden_in(l, class, (x, y), |at, in_block| {
                any = true;
                place(blocks, in_block, l.first_hidden + rank[at] as usize);
            });
            blocks += usize::from(any);
        });
    }
    blocks
}

/// Paints the blocks. Pixels without a hidden texel smoothly continue those with one, which is cheapest for a codec.
#[cfg(feature = "write")]
pub fn paint(layers: &[Layer], class: &[u8], hidden: &[[u8; 3]], blocks: usize, columns: usize) -> (u32, u32, Vec<u8>) {
    let (w, h) = (columns * BLOCK as usize, blocks.div_ceil(columns.max(1)) * BLOCK as usize);
    let mut rgb = vec![128u8; w * h * 3];
    let mut current = (usize::MAX, Patch::EMPTY);
    let close = |rgb: &mut Vec<u8>, block: usize, patch: &mut Patch| {
        if block == usize::MAX {
            return;
        }
        patch.complete();
        for (place, c) in patch.texels.iter().enumerate() {
            let (x, y) = (block % columns * 8 + place % 8, block / columns * 8 + place / 8);
            rgb[(y * w + x) * 3..][..3].copy_from_slice(&c.map(|v| v.round() as u8));
        }
    };
    walk(layers, class, |block, place, index| {
        if block != current.0 {
            close(&mut rgb, current.0, &mut current.1);
            current = (block, Patch::EMPTY);
        }
        current.1.texels[place] = hidden[index].map(f32::from);
        current.1.known |= 1 << place;
    });
    close(&mut rgb, current.0, &mut current.1);
    (w as u32, h as u32, rgb)
}

/// A block while it is painted.
#[cfg(feature = "write")]
struct Patch {
    texels: [[f32; 3]; 64],
    /// One bit for each texel that has a colour.
    known: u64,
}

#[cfg(feature = "write")]
impl Patch {
    /// A block without colours.
    const EMPTY: Self = Self { texels: [[0.0; 3]; 64], known: 0 };
    /// Number of relaxation sweeps that smooth the filled texels.
    const SWEEPS: usize = 6;

    /// Extends the known texels over the others, ring by ring, then relaxes the filled ones towards the mean of their neighbours.
    fn complete(&mut self) {
        let fixed = self.known;
        while self.known != 0 && self.known != u64::MAX {
            let before = self.known;
            for place in (0..64).filter(|p| before >> p & 1 == 0) {
                if let Some(mean) = self.mean_around(place, before) {
                    self.texels[place] = mean;
                    self.known |= 1 << place;
                }
            }
        }
        for _ in 0..Self::SWEEPS {
            for place in (0..64).filter(|p| fixed >> p & 1 == 0) {
                if let Some(mean) = self.mean_around(place, self.known) {
                    self.texels[place] = mean;
                }
            }
        }
    }

    fn mean_around(&self, place: usize, known: u64) -> Option<[f32; 3]> {
        let (x, y) = (place % 8, place / 8);
        let around = [(x > 0, place.wrapping_sub(1)), (x < 7, place + 1), (y > 0, place.wrapping_sub(8)), (y < 7, place + 8)];
        let (mut sum, mut n) = ([0f32; 3], 0f32);
        for (_, p) in around.into_iter().filter(|(inside, p)| *inside && known >> p & 1 == 1) {
            for (s, v) in sum.iter_mut().zip(self.texels[p]) {
                *s += v;
            }
            n += 1.0;
        }
        (n > 0.0).then(|| sum.map(|s| s / n))
    }
}

/// Extracts the hidden colours from a picture that is `width` pixels wide. The caller checks that it holds all blocks.
pub fn read(layers: &[Layer], class: &[u8], count: usize, columns: usize, width: usize, rgb: &[[u8; 3]]) -> Vec<[u8; 3]> {
    let mut hidden = vec![[0; 3]; count];
    walk(layers, class, |block, place, index| {
        let (x, y) = (block % columns * 8 + place % 8, block / columns * 8 + place / 8);
        hidden[index] = rgb[y * width + x];
    });
    hidden
}
