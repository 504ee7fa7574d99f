//! Encodes baseline JPEG without subsampling, in forms that vectorise. The file has the bytes that `image` writes, which also supplies the
//! header with all tables.

use std::array::from_fn;
use std::ops::Range;

use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder, ImageResult};

use crate::scene::packed_rgb::words;
use crate::simd::dispatch;

/// Side of a block in pixels.
const SIDE: usize = 8;
/// Number of pixels, or coefficients, of a block.
const BLOCK: usize = SIDE * SIDE;
/// Order in which a file has the coefficients of a block.
static ZIGZAG: [usize; BLOCK] = [
    0, 1, 8, 16, 9, 2, 3, 10, 17, 24, 32, 25, 18, 11, 4, 5, 12, 19, 26, 33, 40, 48, 41, 34, 27, 20, 13, 6, 7, 14, 21, 28, 35, 42, 49, 56,
    57, 50, 43, 36, 29, 22, 15, 23, 30, 37, 44, 51, 58, 59, 52, 45, 38, 31, 39, 46, 53, 60, 61, 54, 47, 55, 62, 63,
];
/// Markers of segments: tables of divisors and of codes, frame header, scan header.
const DQT: u8 = 0xDB;
const DHT: u8 = 0xC4;
const SOF: u8 = 0xC0;
const SOS: u8 = 0xDA;
/// Marker of the end of a file.
const END: [u8; 2] = [0xFF, 0xD9];

/// Encodes pixels with a quality from 1 to 100; `None` if the file takes at least `limit` bytes.
///
/// # Errors
/// [`image::ImageError`] if a side is 0 or over 65 535 pixels.
pub fn encode((width, height): (u32, u32), rgb: &[[u8; 3]], quality: u8, limit: usize) -> ImageResult<Option<Vec<u8>>> {
    let (Ok(w @ 1..), Ok(h @ 1..)) = (u16::try_from(width), u16::try_from(height)) else {
        return JpegEncoder::new(Vec::new()).write_image(rgb.as_flattened(), width, height, ExtendedColorType::Rgb8).map(|()| None);
    };
    let Codec { header, divisors, codes } = Codec::new(w, h, quality)?;
    let (mut strip, mut last) = (Strip::new(usize::from(w)), [0; 3]);
    let mut bits = Bits { out: header, word: 0, count: 0 };
    for y in (0..usize::from(h)).step_by(SIDE) {
        strip.load(rgb, usize::from(w), y..usize::from(h));
        // one component of luma and two of chroma
        let components = [0, 1, 1];
        for ((plane, blocks), table) in strip.planes.iter().zip(&mut strip.blocks).zip(components) {
            quantise(plane, &divisors[table], blocks);
        }
        for i in 0..strip.blocks[0].len() {
            for ((blocks, last), table) in strip.blocks.iter().zip(&mut last).zip(components) {
                bits.block(&blocks[i], *last, [&codes[table], &codes[2 + table]]);
                *last = blocks[i][0];
            }
        }
        if bits.out.len() >= limit {
            return Ok(None);
        }
    }
    let file = bits.finish();
    Ok((file.len() < limit).then_some(file))
}

/// A code of a symbol.
#[derive(Clone, Copy, Default)]
struct Code {
    bits: u32,
    /// Number of bits.
    size: u32,
}

/// Codes by symbol.
type Codes = [Code; 256];

/// All that a file depends on but pixels.
struct Codec {
    /// The file up to its first block.
    header: Vec<u8>,
    /// Divisors of the coefficients of luma and chroma.
    divisors: [[f32; BLOCK]; 2],
    /// Codes of the constant coefficients of luma and chroma, and of their other coefficients.
    codes: [Codes; 4],
}

impl Codec {
    fn new(width: u16, height: u16, quality: u8) -> ImageResult<Self> {
        let mut header = Vec::new();
        JpegEncoder::new_with_quality(&mut header, quality).write_image(&[0; 3], 1, 1, ExtendedColorType::Rgb8)?;
        let (mut divisors, mut codes) = ([[1.0; BLOCK]; 2], [[Code::default(); 256]; 4]);
        let (mut at, mut size_at) = (2, 0);
        while let Some(&[0xFF, marker, high, low]) = header.get(at..).and_then(|rest| rest.first_chunk::<4>()) {
            let body = at + 4..at + 2 + usize::from(u16::from_be_bytes([high, low]));
            at = body.end;
            match (marker, &header[body.clone()]) {
                (DQT, [table, values @ ..]) => {
                    for (to, value) in ZIGZAG.iter().zip(values) {
                        divisors[usize::from(table & 1)][*to] = f32::from(*value);
                    }
                }
                (DHT, [table, rest @ ..]) => codes[usize::from(table >> 4 & 1) * 2 + usize::from(table & 1)] = read_codes(rest),
                (SOF, _) => size_at = body.start + 1,
                (SOS, _) => break,
                _ => {}
            }
        }
        header.truncate(at);
        header[size_at..size_at + 4].copy_from_slice(&[height.to_be_bytes(), width.to_be_bytes()].concat());
        Ok(Self { header, divisors, codes })
    }
}

/// Codes from the numbers of codes of 1 to 16 bits, and their symbols.
fn read_codes(table: &[u8]) -> Codes {
    let (counts, symbols) = table.split_at(16.min(table.len()));
    let (mut symbols, mut codes, mut next) = (symbols.iter(), [Code::default(); 256], 0);
    for (size, count) in (1..).zip(counts) {
        for symbol in symbols.by_ref().take(usize::from(*count)) {
            codes[usize::from(*symbol)] = Code { bits: next, size };
            next += 1;
        }
        next <<= 1;
    }
    codes
}

/// Eight rows of pixels. Blocks have their pixels column by column.
struct Strip {
    /// One row.
    line: Vec<u32>,
    words: Vec<u32>,
    /// Luma, blue and red.
    planes: [Vec<i32>; 3],
    /// Quantised coefficients.
    blocks: [Vec<[i32; BLOCK]>; 3],
}

impl Strip {
    fn new(width: usize) -> Self {
        let blocks = width.div_ceil(SIDE);
        Self {
            line: vec![0; blocks * SIDE],
            words: vec![0; blocks * BLOCK],
            planes: from_fn(|_| vec![0; blocks * BLOCK]),
            blocks: from_fn(|_| vec![[0; BLOCK]; blocks]),
        }
    }

    /// Loads the first of these rows of a photo. The last row and the last column repeat.
    fn load(&mut self, rgb: &[[u8; 3]], width: usize, rows: Range<usize>) {
        for row in 0..SIDE {
            let y = (rows.start + row).min(rows.end - 1);
            words(&rgb[y * width..][..width], &mut self.line);
            let last = self.line[width - 1];
            self.line[width..].fill(last);
            for (column, word) in self.words.chunks_mut(SIDE).zip(&self.line) {
                column[row] = *word;
            }
        }
        let [luma, blue, red] = &mut self.planes;
        convert(&self.words, luma, blue, red);
    }
}

dispatch!(
    /// Converts colours, as words, to luma and chroma.
    convert, convert_body, (words: &[u32], luma: &mut [i32], blue: &mut [i32], red: &mut [i32])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn convert_body(words: &[u32], luma: &mut [i32], blue: &mut [i32], red: &mut [i32]) {
    // 16 bits after the point; a half rounds down
    const HALF: i32 = (1 << 15) - 1;
    const MIDDLE: i32 = (128 << 16) + HALF;
    for (((word, luma), blue), red) in words.iter().zip(luma).zip(blue).zip(red) {
        let [r, g, b] = [word & 0xff, word >> 8 & 0xff, word >> 16 & 0xff].map(|v| v as i32);
        *luma = (19_595 * r + 38_469 * g + 7_471 * b + HALF) >> 16;
        *blue = (32_768 * b - 11_059 * r - 21_709 * g + MIDDLE) >> 16;
        *red = (32_768 * r - 27_439 * g - 5_329 * b + MIDDLE) >> 16;
    }
}

/// One value of each row or column of a block.
type Lanes = [i32; SIDE];

dispatch!(
    /// Transforms blocks of pixels and divides their coefficients.
    quantise, quantise_body, (pixels: &[i32], divisors: &[f32; BLOCK], blocks: &mut [[i32; BLOCK]])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn quantise_body(pixels: &[i32], divisors: &[f32; BLOCK], blocks: &mut [[i32; BLOCK]]) {
    for (pixels, block) in pixels.as_chunks::<BLOCK>().0.iter().zip(blocks) {
        let columns = from_fn(|x| from_fn(|y| pixels[x * SIDE + y]));
        let sums = transform(&columns);
        let across: [Lanes; SIDE] = from_fn(|k| {
            sums[k].map(|sum| match k {
                0 => (sum - 1024) << 2,
                4 => sum << 2,
                _ => (sum + (1 << 10)) >> 11,
            })
        });
        let rows = from_fn(|y| from_fn(|k| across[k][y]));
        let sums = transform(&rows);
        let (to, _) = block.as_chunks_mut::<SIDE>();
        let (divisors, _) = divisors.as_chunks::<SIDE>();
        for (k, ((to, divisors), sums)) in to.iter_mut().zip(divisors).zip(sums).enumerate() {
            let coefficients = sums.map(|sum| match k {
                0 | 4 => (sum + 2) >> 2,
                2 | 6 => (sum + (1 << 14)) >> 15,
                // as `image` rounds, less than to nearest
                _ => (sum + (1 << 10)) >> 15,
            });
            *to = divide(coefficients, divisors);
        }
    }
}

/// Divides coefficients, which are eight times too large, and rounds; halves away from 0.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn divide(coefficients: Lanes, divisors: &[f32; SIDE]) -> Lanes {
    from_fn(|i| {
        let quotient = (coefficients[i] / 8) as f32 / divisors[i];
        // never as close below a half that the sum would round up to the next integer: divisors are at most 255
        (quotient + 0.5f32.copysign(quotient)) as i32
    })
}

/// The discrete cosine transform of eight values in each lane, with 13 bits after the point of all but sums 0 and 4.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn transform(v: &[Lanes; SIDE]) -> [Lanes; SIDE] {
    let [s0, s1, s2, s3]: [Lanes; 4] = from_fn(|k| add(&v[k], &v[7 - k]));
    let [d0, d1, d2, d3]: [Lanes; 4] = from_fn(|k| sub(&v[k], &v[7 - k]));
    let (outer, inner) = (add(&s0, &s3), add(&s1, &s2));
    let (outer_step, inner_step) = (sub(&s0, &s3), sub(&s1, &s2));
    let (even, odd) = (add(&d0, &d2), add(&d1, &d3));
    let (of_even, of_odd) = (mix(&even, 9_633 - 3_196, &odd, 9_633), mix(&even, 9_633, &odd, 9_633 - 16_069));
    let (ends, middle) = (add(&d0, &d3), add(&d1, &d2));
    [
        add(&outer, &inner),
        add(&mix(&d0, 12_299, &ends, -7_373), &of_even),
        mix(&outer_step, 4_433 + 6_270, &inner_step, 4_433),
        add(&mix(&d1, 25_172, &middle, -20_995), &of_odd),
        sub(&outer, &inner),
        add(&mix(&d2, 16_819, &middle, -20_995), &of_even),
        mix(&outer_step, 4_433, &inner_step, 4_433 - 15_137),
        add(&mix(&d3, 2_446, &ends, -7_373), &of_odd),
    ]
}

#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn add(a: &Lanes, b: &Lanes) -> Lanes {
    from_fn(|i| a[i] + b[i])
}

#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn sub(a: &Lanes, b: &Lanes) -> Lanes {
    from_fn(|i| a[i] - b[i])
}

/// Sum of two vectors, each times a factor.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn mix(a: &Lanes, by_a: i32, b: &Lanes, by_b: i32) -> Lanes {
    from_fn(|i| a[i] * by_a + b[i] * by_b)
}

/// Bits of a file after its header.
struct Bits {
    out: Vec<u8>,
    /// The last bits, of which `count` are not yet in `out`, fewer than 32.
    word: u64,
    count: u32,
}

impl Bits {
    fn put(&mut self, bits: u32, size: u32) {
        self.word = self.word << size | u64::from(bits);
        self.count += size;
        if self.count >= 32 {
            self.count -= 32;
            self.bytes(&((self.word >> self.count) as u32).to_be_bytes());
        }
    }

    /// Adds whole bytes. A zero follows each that could begin a marker.
    fn bytes(&mut self, bytes: &[u8]) {
        if !bytes.contains(&0xFF) {
            self.out.extend_from_slice(bytes);
            return;
        }
        for byte in bytes {
            self.out.push(*byte);
            if *byte == 0xFF {
                self.out.push(0);
            }
        }
    }

    fn block(&mut self, block: &[i32; BLOCK], last: i32, [constant, other]: [&Codes; 2]) {
        self.coefficient(constant, 0, block[0] - last);
        let mut zeros = 0;
        for at in &ZIGZAG[1..] {
            let value = block[*at];
            if value == 0 {
                zeros += 1;
                continue;
            }
            while zeros > 15 {
                self.put(other[0xF0].bits, other[0xF0].size);
                zeros -= 16;
            }
            self.coefficient(other, zeros, value);
            zeros = 0;
        }
        if zeros > 0 {
            self.put(other[0].bits, other[0].size);
        }
    }

    /// Adds a coefficient after some zeros.
    fn coefficient(&mut self, codes: &Codes, zeros: u32, value: i32) {
        let size = u32::BITS - value.unsigned_abs().leading_zeros();
        let code = codes[(zeros << 4 | size) as usize & 0xff];
        // a negative value is one less, without the sign
        let bits = (value - i32::from(value < 0)) as u32 & ((1 << size) - 1);
        self.put(code.bits << size | bits, code.size + size);
    }

    /// The file.
    fn finish(mut self) -> Vec<u8> {
        // ones fill the last byte
        self.put(0x7F, 7);
        while self.count >= 8 {
            self.count -= 8;
            self.bytes(&[(self.word >> self.count) as u8]);
        }
        self.out.extend_from_slice(&END);
        self.out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As `image` encodes.
    fn reference((width, height): (u32, u32), rgb: &[[u8; 3]], quality: u8) -> Vec<u8> {
        let mut file = Vec::new();
        let encoder = JpegEncoder::new_with_quality(&mut file, quality);
        encoder.write_image(rgb.as_flattened(), width, height, ExtendedColorType::Rgb8).unwrap();
        file
    }

    #[test]
    fn files_have_the_bytes_of_the_image_crate() {
        let noise =
            |x: u32, y: u32| x.wrapping_mul(2_654_435_761).wrapping_add(y.wrapping_mul(40_503)).wrapping_mul(0x85EB_CA77).to_be_bytes();
        let pictures: [&dyn Fn(u32, u32) -> [u8; 3]; 5] = [
            &|x, y| [0, 1, 2].map(|c| noise(x + 1, y + 1)[c]),
            &|x, y| [0, 1, 2].map(|c| (128 + x * 3 + y * (c + 1)) as u8 / 2 + noise(x, y)[0] / 16),
            &|x, y| [if (x + y).is_multiple_of(2) { 255 } else { 0 }; 3],
            &|x, y| if (x / 4 + y / 4).is_multiple_of(2) { [255, 0, 0] } else { [0, 0, 255] },
            &|_, _| [200, 30, 10],
        ];
        for (n, picture) in pictures.iter().enumerate() {
            for size in [(1, 1), (8, 8), (7, 9), (17, 5), (64, 33), (130, 70)] {
                let rgb: Vec<[u8; 3]> = (0..size.0 * size.1).map(|i| picture(i % size.0, i / size.0)).collect();
                for quality in [1, 10, 30, 50, 75, 90, 97, 100] {
                    let (got, want) = (encode(size, &rgb, quality, usize::MAX).unwrap(), reference(size, &rgb, quality));
                    assert!(got == Some(want), "picture {n} of {size:?} at quality {quality}");
                }
            }
        }
    }

    #[test]
    fn a_side_of_no_pixels_or_too_many_is_an_error() {
        for size in [(0, 0), (0, 9), (65_536, 1)] {
            assert!(encode(size, &vec![[0; 3]; size.0 as usize * size.1 as usize], 90, usize::MAX).is_err(), "{size:?}");
        }
    }
}
