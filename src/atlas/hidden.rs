//! The picture of hidden texels: 8×8 blocks, so that no block of a picture codec mixes two layers.

use crate::tmpi::{Class, Layer};

/// Side of a block in pixels; also the codec's.
pub const BLOCK: u32 = 8;

/// Calls `cell(x, y)` for every 8×8 cell of the photo's pixel grid that a layer touches, row by row; cell corners in photo pixels.
fn cells(l: &Layer, mut cell: impl FnMut(u32, u32)) {
    let r = l.rect;
    for y in (r.y / BLOCK * BLOCK..r.y + r.h).step_by(BLOCK as usize) {
        for x in (r.x / BLOCK * BLOCK..r.x + r.w).step_by(BLOCK as usize) {
            cell(x, y);
        }
    }
}

/// Calls `texel(index in the layer, place in the block)` for the hidden texels of a cell.
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

/// Blocks of all layers in the schema's order; `place(block, place in block, hidden index)` is told of every hidden texel.
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

/// Blocks a row for a picture that is about square.
pub fn columns_for(blocks: usize) -> usize {
    (blocks as f64).sqrt().ceil() as usize
}

/// Paints the blocks; what no hidden texel claims takes the mean of its block, which costs a codec least.
pub fn paint(layers: &[Layer], class: &[u8], hidden: &[[u8; 3]], blocks: usize, columns: usize) -> (u32, u32, Vec<u8>) {
    let (w, h) = (columns * BLOCK as usize, blocks.div_ceil(columns.max(1)) * BLOCK as usize);
    let mut rgb = vec![128u8; w * h * 3];
    let texel_at = |block: usize, place: usize| {
        let (x, y) = (block % columns * 8 + place % 8, block / columns * 8 + place / 8);
        (y * w + x) * 3
    };
    let mut current: (usize, u64, [u32; 4]) = (usize::MAX, 0, [0; 4]);
    let close = |rgb: &mut Vec<u8>, (block, mask, sum): (usize, u64, [u32; 4])| {
        if block == usize::MAX || sum[3] == 0 {
            return;
        }
        let mean = [0, 1, 2].map(|i| ((sum[i] + sum[3] / 2) / sum[3]) as u8);
        for place in (0..64).filter(|p| mask >> p & 1 == 0) {
            let at = texel_at(block, place);
            rgb[at..at + 3].copy_from_slice(&mean);
        }
    };
    walk(layers, class, |block, place, index| {
        if block != current.0 {
            close(&mut rgb, current);
            current = (block, 0, [0; 4]);
        }
        let c = hidden[index];
        let at = texel_at(block, place);
        rgb[at..at + 3].copy_from_slice(&c);
        current.1 |= 1 << place;
        for (s, v) in current.2.iter_mut().zip([c[0], c[1], c[2], 1]) {
            *s += u32::from(v);
        }
    });
    close(&mut rgb, current);
    (w as u32, h as u32, rgb)
}

/// Takes the hidden colours back out of a picture `width` pixels wide that holds all blocks (checked by the caller).
pub fn read(layers: &[Layer], class: &[u8], count: usize, columns: usize, width: usize, rgb: &[[u8; 3]]) -> Vec<[u8; 3]> {
    let mut hidden = vec![[0; 3]; count];
    walk(layers, class, |block, place, index| {
        let (x, y) = (block % columns * 8 + place % 8, block / columns * 8 + place / 8);
        hidden[index] = rgb[y * width + x];
    });
    hidden
}
