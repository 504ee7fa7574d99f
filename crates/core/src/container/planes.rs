//! The entropy-coded section of planes: the bytes of [`super::columns`] in a range coder with few contexts.
//!
//! Each plane is coded as the difference of `a` from the previous plane in the tile, or, for a tile's first plane, from the first plane of
//! the tile to the left (above in the first column); then `b`; then `c` in the context of the size of `b`. Predicting from all neighbouring
//! tiles would save only 1 % more.

use super::ContainerError;
use super::columns::{self, BACKGROUND};
use super::range_coder::{Bit, Coder, Decoder, Encoder};
use crate::Grid;

/// Contexts of a count: the sum of the counts of the two neighbouring tiles.
const COUNTS: usize = 8;
/// Number of bits of a count minus one.
const COUNT_BITS: u32 = 6;
/// Contexts of `a`: a tile's first plane, its other planes, and background planes.
const PLACES: usize = 3;
/// Contexts of `c`: the number of bits of `b`, up to 12, divided by three.
const SIZES: usize = 5;
/// Number of bits of a bit count from 0 to 16.
const LENGTH_BITS: u32 = 5;

/// Models of a signed number: its number of bits, its sign, and the bit after the highest. Its other bits are coded with equal
/// probabilities.
#[derive(Clone, Copy)]
struct Number {
    length: [Bit; 1 << LENGTH_BITS],
    sign: Bit,
    second: [Bit; 1 << LENGTH_BITS],
}

impl Number {
    // never inlined: the arrays of models are then copies of one, not written out
    #[inline(never)]
    fn new() -> Self {
        Self { length: [Bit::default(); 1 << LENGTH_BITS], sign: Bit::default(), second: [Bit::default(); 1 << LENGTH_BITS] }
    }

    /// Writes the value, or reads one instead. Truncates values of a damaged stream to 16 bits.
    fn code(&mut self, coder: &mut impl Coder, value: i16) -> i16 {
        let size = u32::from(value.unsigned_abs());
        let length = tree(&mut self.length, LENGTH_BITS, u32::BITS - size.leading_zeros(), coder);
        if length == 0 {
            return 0;
        }
        let negative = coder.bit(&mut self.sign, value < 0);
        let mut read = 1u32;
        for i in (0..length - 1).rev() {
            let mut even = Bit::default();
            let model = if i + 2 == length { &mut self.second[length as usize] } else { &mut even };
            read = read << 1 | u32::from(coder.bit(model, size >> i & 1 == 1));
        }
        let size = read as u16 as i16;
        if negative { size.wrapping_neg() } else { size }
    }
}

/// Codes a number of `bits` bits from the highest bit.
// the page's decoder would have the loop unrolled in each caller
#[cfg_attr(target_arch = "wasm32", inline(never))]
fn tree(models: &mut [Bit], bits: u32, value: u32, coder: &mut impl Coder) -> u32 {
    let mut node = 1;
    for i in (0..bits).rev() {
        node = node << 1 | usize::from(coder.bit(&mut models[node], value >> i & 1 == 1));
    }
    node as u32 - (1 << bits)
}

/// Dimensions of the section of planes.
#[derive(Clone, Copy)]
pub struct Layout {
    /// Number of tiles in a row, at least 1.
    pub columns: usize,
    /// Number of tiles.
    pub tiles: usize,
    /// Number of planes in all tiles.
    pub planes: usize,
}

impl Layout {
    /// The layout for a grid with `planes` planes in all tiles.
    pub fn of(grid: &Grid, planes: usize) -> Self {
        Self { columns: grid.columns() as usize, tiles: grid.tiles() as usize, planes }
    }
}

/// Adaptive models of a plane coder.
pub struct Models {
    counts: [[Bit; 1 << COUNT_BITS]; COUNTS],
    background: Bit,
    a: [Number; PLACES],
    b: Number,
    c: [Number; SIZES],
}

impl Models {
    /// Untrained models.
    pub fn new() -> Box<Self> {
        Box::new(Self {
            counts: [[Bit::default(); 1 << COUNT_BITS]; COUNTS],
            background: Bit::default(),
            a: [Number::new(); PLACES],
            b: Number::new(),
            c: [Number::new(); SIZES],
        })
    }

    /// All bits in a fixed order.
    pub fn bits(&mut self) -> impl Iterator<Item = &mut Bit> {
        let numbers = self.a.iter_mut().chain([&mut self.b]).chain(&mut self.c);
        let numbers = numbers.flat_map(|n| n.length.iter_mut().chain([&mut n.sign]).chain(&mut n.second));
        self.counts.iter_mut().flatten().chain([&mut self.background]).chain(numbers)
    }
}

/// Encodes the bytes of [`columns::write`]. The models keep learning.
pub fn encode(models: &mut Models, layout: Layout, raw: &[u8]) -> Result<Vec<u8>, ContainerError> {
    let mut coder = Encoder::new();
    walk(models, layout, &mut raw.to_vec(), &mut coder)?;
    Ok(coder.finish())
}

/// Decodes to the bytes of [`columns::write`]. The models keep learning.
pub fn decode(models: &mut Models, layout: Layout, data: &[u8]) -> Result<Vec<u8>, ContainerError> {
    let mut raw = vec![0; columns::bytes(layout.tiles, layout.planes)];
    walk(models, layout, &mut raw, &mut Decoder::new(data))?;
    Ok(raw)
}

/// Visits all planes in the same order for writing and reading; reading fills `raw`.
fn walk(models: &mut Models, layout: Layout, raw: &mut [u8], coder: &mut impl Coder) -> Result<(), ContainerError> {
    let Layout { columns, tiles, planes } = layout;
    let (counts, values) = raw.split_at_mut(tiles);
    code_counts(models, columns, counts, coder);
    if counts.iter().map(|&c| columns::planes_of(c)).sum::<usize>() != planes {
        return Err(ContainerError::broken("planes: wrong count in a tile"));
    }
    let mut firsts = vec![0i16; tiles];
    let mut at = 0;
    for (t, &count) in counts.iter().enumerate() {
        let mut last = match t % columns {
            0 if t == 0 => 0,
            0 => firsts[t - columns],
            _ => firsts[t - 1],
        };
        for i in 0..columns::planes_of(count) {
            let place = if i == usize::from(count & !BACKGROUND) { 2 } else { i.min(1) };
            let [a, b, c] = [0, 1, 2].map(|column| get(values, planes, column, at));
            let a = last.wrapping_add(models.a[place].code(coder, a.wrapping_sub(last)));
            let b = models.b.code(coder, b);
            let size = (u16::BITS - b.unsigned_abs().leading_zeros()).min(12) as usize / 3;
            let c = models.c[size].code(coder, c);
            for (column, value) in [a, b, c].into_iter().enumerate() {
                put(values, planes, column, at, value);
            }
            if i == 0 {
                firsts[t] = a;
            }
            last = a;
            at += 1;
        }
    }
    Ok(())
}

fn code_counts(models: &mut Models, columns: usize, counts: &mut [u8], coder: &mut impl Coder) {
    for t in 0..counts.len() {
        let left = if t % columns == 0 { 1 } else { counts[t - 1] & !BACKGROUND };
        let above = if t < columns { 1 } else { counts[t - columns] & !BACKGROUND };
        let model = &mut models.counts[usize::from(left + above).min(COUNTS - 1)];
        let count = tree(model, COUNT_BITS, u32::from((counts[t] & !BACKGROUND).wrapping_sub(1)), coder) as u8 + 1;
        let behind = coder.bit(&mut models.background, counts[t] & BACKGROUND != 0);
        counts[t] = count | if behind { BACKGROUND } else { 0 };
    }
}

fn get(values: &[u8], planes: usize, column: usize, i: usize) -> i16 {
    let at = column * 2 * planes + i;
    i16::from_le_bytes([values[at], values[at + planes]])
}

fn put(values: &mut [u8], planes: usize, column: usize, i: usize, value: i16) {
    let at = column * 2 * planes + i;
    [values[at], values[at + planes]] = value.to_le_bytes();
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn planes_round_trip(columns in 1usize..9, counts in prop::collection::vec((1u8..=64, any::<bool>()), 1..40),
            bits in 0u32..=16, seed in any::<u64>()) {
            let counts: Vec<u8> = counts.iter().map(|(n, b)| n | if *b { BACKGROUND } else { 0 }).collect();
            let planes: usize = counts.iter().map(|&c| columns::planes_of(c)).sum();
            let mut state = seed | 1;
            let values: Vec<i16> = (0..planes * 3).map(|_| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                ((state >> 40) as i16).wrapping_shr(16 - bits.max(1))
            }).chain([i16::MIN, i16::MAX, -1]).collect();
            let mut raw = vec![0; columns::bytes(counts.len(), planes)];
            raw[..counts.len()].copy_from_slice(&counts);
            for (i, v) in values.iter().rev().take(planes * 3).enumerate() {
                put(&mut raw[counts.len()..], planes, i % 3, i / 3, *v);
            }
            let layout = Layout { columns, tiles: counts.len(), planes };
            let data = encode(&mut Models::new(), layout, &raw).unwrap();
            prop_assert!(data.len() <= raw.len() * 3 / 2 + 64);
            prop_assert_eq!(&decode(&mut Models::new(), layout, &data).unwrap(), &raw);
            for wrong in [planes - 1, planes + 1] {
                let wrong = Layout { planes: wrong, ..layout };
                prop_assert!(decode(&mut Models::new(), wrong, &data).is_err());
            }
        }

        #[test]
        fn any_bytes_give_counts_within_bounds_or_an_error(data in prop::collection::vec(any::<u8>(), 0..200), planes in 0usize..300) {
            if let Ok(raw) = decode(&mut Models::new(), Layout { columns: 3, tiles: 9, planes }, &data) {
                prop_assert!(raw[..9].iter().all(|c| (1..=64).contains(&(c & !BACKGROUND))));
            }
        }
    }
}
