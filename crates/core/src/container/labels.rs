//! Entropy-coded label maps: the plane that each pixel of each tile lies on.
//!
//! A pixel is coded as a series of binary decisions (is it the label to the left? the one above? …). Their contexts are which neighbours
//! agree, and whether an earlier, overlapping tile has an edge there.

use super::ContainerError;
use super::range_coder::{Bit, Coder, Decoder, Encoder};
use crate::Grid;

/// Contexts per decision: five bits of agreement, and three states of the overlapping tile.
const CONTEXTS: usize = 32 * 3;
/// Maximum number of labels per tile, and of leaves in the tree that codes a label without a matching neighbour.
const TREE: usize = 64;

/// Adaptive models of a label coder.
pub struct Models {
    left: [Bit; CONTEXTS],
    above: [Bit; CONTEXTS],
    diagonal: [Bit; CONTEXTS],
    tree: [Bit; TREE * 2],
}

impl Models {
    /// All bits in a fixed order.
    pub fn bits(&mut self) -> impl Iterator<Item = &mut Bit> {
        self.left.iter_mut().chain(&mut self.above).chain(&mut self.diagonal).chain(&mut self.tree)
    }

    /// Untrained models.
    // never inlined: the page's decoder would have it in each caller
    #[inline(never)]
    pub fn new() -> Box<Self> {
        Box::new(Self {
            left: [Bit::default(); CONTEXTS],
            above: [Bit::default(); CONTEXTS],
            diagonal: [Bit::default(); CONTEXTS],
            tree: [Bit::default(); TREE * 2],
        })
    }
}

/// What earlier tiles say about each pixel: tile index plus one, and label.
struct LabelMap {
    width: usize,
    tile: Vec<u32>,
    label: Vec<u8>,
}

impl LabelMap {
    /// 0 if unknown, 1 if both pixels have the same label, 2 if there is an edge between them.
    fn edge(&self, p: usize, q: usize) -> usize {
        if self.tile[p] == 0 || self.tile[p] != self.tile[q] { 0 } else { 1 + usize::from(self.label[p] != self.label[q]) }
    }
}

/// Encodes the labels of all tiles, row-major within each tile. Each label is below its tile's count. A tile with a single label takes no
/// bits.
pub fn encode(grid: &Grid, counts: &[u8], labels: &[u8]) -> Vec<u8> {
    encode_by(&mut Models::new(), grid, counts, labels)
}

/// Like [`encode`], with models that keep learning.
pub fn encode_by(models: &mut Models, grid: &Grid, counts: &[u8], labels: &[u8]) -> Vec<u8> {
    let mut coder = Encoder::new();
    let mut labels = labels.to_vec();
    walk(models, grid, counts, &mut labels, &mut coder);
    coder.finish()
}

/// Decodes the labels of all tiles; `counts` has an entry from 1 to 64 for each tile of the grid.
pub fn decode(grid: &Grid, counts: &[u8], data: &[u8]) -> Result<Vec<u8>, ContainerError> {
    let mut labels = vec![0; grid.tile_pixels()];
    decode_by(&mut Models::new(), grid, counts, data, &mut labels)?;
    Ok(labels)
}

/// Like [`decode`], into a slice of zeros with one entry for each pixel of each tile, and with models that keep learning.
pub fn decode_by(models: &mut Models, grid: &Grid, counts: &[u8], data: &[u8], labels: &mut [u8]) -> Result<(), ContainerError> {
    if counts.len() != grid.tiles() as usize || counts.iter().any(|c| !(1..=TREE as u8).contains(c)) {
        return Err(ContainerError::broken("labels: a tile must have 1 to 64 of them"));
    }
    walk(models, grid, counts, labels, &mut Decoder::new(data));
    Ok(())
}

fn walk(models: &mut Models, grid: &Grid, counts: &[u8], labels: &mut [u8], coder: &mut impl Coder) {
    let width = grid.width as usize;
    let mut map = LabelMap { width, tile: vec![0; width * grid.height as usize], label: vec![0; width * grid.height as usize] };
    let mut first = 0;
    for tile in 0..grid.tiles() {
        let area = grid.rect(tile).area();
        let own = &mut labels[first..first + area];
        first += area;
        tile_labels(grid, tile, counts[tile as usize], own, &mut map, models, coder);
    }
}

fn tile_labels(grid: &Grid, tile: u32, count: u8, own: &mut [u8], map: &mut LabelMap, models: &mut Models, coder: &mut impl Coder) {
    let r = grid.rect(tile);
    let (w, h) = (r.w as usize, r.h as usize);
    let photo = |x: usize, y: usize| (r.y as usize + y) * map.width + r.x as usize + x;
    if count > 1 {
        for y in 0..h {
            for x in 0..w {
                let at = |dx: usize, dy: usize| if x >= dx && y >= dy { Some(own[(y - dy) * w + x - dx]) } else { None };
                let (left, above) = (at(1, 0), at(0, 1));
                let fallback = left.or(above).unwrap_or(0);
                let (l, a) = (left.or(above), above.or(left));
                let corner = at(1, 1).unwrap_or(fallback);
                let right = if y > 0 && x + 1 < w { own[(y - 1) * w + x + 1] } else { a.unwrap_or(0) };
                let left2 = at(2, 0).unwrap_or(l.unwrap_or(0));
                let above2 = at(0, 2).unwrap_or(a.unwrap_or(0));
                let p = photo(x, y);
                let edge_left = if x > 0 { map.edge(p, p - 1) } else { 0 };
                let edge_above = if y > 0 { map.edge(p, p - map.width) } else { 0 };
                let bit = |b: bool, i: u32| usize::from(b) << i;
                let label = own[y * w + x];
                own[y * w + x] = 'label: {
                    let (Some(l), Some(a)) = (l, a) else { break 'label spell(models, count, label, coder) };
                    let context =
                        (bit(l == a, 0) + bit(a == corner, 1) + bit(a == right, 2) + bit(l == left2, 3) + bit(a == above2, 4)) * 3;
                    if coder.bit(&mut models.left[context + edge_left], label == l) {
                        break 'label l;
                    }
                    if a != l && coder.bit(&mut models.above[context + edge_above], label == a) {
                        break 'label a;
                    }
                    let diagonal = if right != l && right != a { right } else { corner };
                    if diagonal != l && diagonal != a && coder.bit(&mut models.diagonal[context + edge_above], label == diagonal) {
                        break 'label diagonal;
                    }
                    spell(models, count, label, coder)
                };
            }
        }
    }
    for y in 0..h {
        for x in 0..w {
            let p = photo(x, y);
            map.tile[p] = tile + 1;
            map.label[p] = own[y * w + x];
        }
    }
}

/// Codes a label without a matching neighbour, from the highest bit. If a damaged stream exceeds the count, returns the last label.
fn spell(models: &mut Models, count: u8, label: u8, coder: &mut impl Coder) -> u8 {
    let bits = u8::BITS - (count - 1).leading_zeros();
    let (mut node, mut value) = (1usize, 0u8);
    for i in (0..bits).rev() {
        let b = coder.bit(&mut models.tree[node], label >> i & 1 == 1);
        node = node << 1 | usize::from(b);
        value = value << 1 | u8::from(b);
    }
    value.min(count - 1)
}

#[cfg(test)]
pub(super) mod testing {
    use crate::Grid;

    /// Counts and labels in stripes that continue from tile to tile.
    pub fn maps(grid: &Grid, seed: u32) -> (Vec<u8>, Vec<u8>) {
        let (mut counts, mut labels) = (Vec::new(), Vec::new());
        for t in 0..grid.tiles() {
            let r = grid.rect(t);
            let n = 1 + ((t.wrapping_mul(7) + seed) % 5) as u8;
            counts.push(n);
            labels.extend(
                (0..r.h).flat_map(|y| (0..r.w).map(move |x| (((x + r.x) / 9 + (y + r.y) / 13 + (x * y) / 400) % u32::from(n)) as u8)),
            );
        }
        (counts, labels)
    }
}

#[cfg(test)]
mod tests {
    use super::testing::maps;
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]

        #[test]
        fn labels_round_trip(w in 1u32..150, h in 1u32..150, size in 8u32..70, seed in 0u32..100) {
            let grid = Grid::new(w, h, size);
            let (counts, labels) = maps(&grid, seed);
            prop_assert_eq!(decode(&grid, &counts, &encode(&grid, &counts, &labels)).unwrap(), labels);
        }
    }

    #[test]
    fn extreme_labels_round_trip() {
        let grid = Grid::new(256, 192, 64);
        let pixels: usize = (0..grid.tiles()).map(|t| grid.rect(t).area()).sum();
        let sixty_four = |i: usize| ((i as u32).wrapping_mul(2_654_435_761) >> 26) as u8;
        let maps: [(u8, &dyn Fn(usize) -> u8); 4] = [
            (64, &sixty_four),
            // the likeliest symbol over and over, then the least likely one
            (2, &|i| u8::from(i + 1 == pixels)),
            (2, &|i| ((i + i / 64) % 2) as u8),
            (3, &|i| (i / 2048 % 3) as u8),
        ];
        for (count, label) in maps {
            let counts = vec![count; grid.tiles() as usize];
            let labels: Vec<u8> = (0..pixels).map(label).collect();
            assert_eq!(decode(&grid, &counts, &encode(&grid, &counts, &labels)).unwrap(), labels);
        }
        let one = Grid::new(64, 64, 64);
        assert!(decode(&one, &[0], &[]).is_err() && decode(&one, &[65], &[]).is_err());
    }
}
