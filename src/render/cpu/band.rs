//! A band of rows: depth, opaque colour, and per pixel the soft samples before it.

use super::span::{Draw, Span};
use crate::render::OPAQUE;

/// A sample between transparent and opaque.
#[derive(Clone, Copy, Debug)]
struct Soft {
    delta: f32,
    /// The next farther one of the same pixel, or [`NONE`].
    next: u32,
    /// Premultiplied, 0 to 255.
    rgba: [f32; 4],
}

/// End of a pixel's list.
const NONE: u32 = u32::MAX;

/// Buffers of a band, kept from one band to the next of a thread.
#[derive(Debug, Default)]
pub(super) struct Band {
    /// Target disparity of the opaque texel; below 0 where there is none.
    depth: Vec<f32>,
    /// Per pixel its nearest soft sample, or [`NONE`].
    head: Vec<u32>,
    /// Samples of all pixels; each pixel's are linked from near to far.
    soft: Vec<Soft>,
}

/// Less than this share of what lies behind cannot be seen in 8 bits, and further products would leave the normal range of `f32`.
const DARK: f32 = 1e-6;

impl Band {
    /// Draws rows from `first_row` on into `out`, which starts transparent; `draws` come nearest first.
    pub fn draw(&mut self, draws: &[Draw], texels: &[[u8; 4]], first_row: u32, width: usize, out: &mut [[u8; 4]]) {
        let rows = (out.len() / width) as u32;
        self.depth.clear();
        self.depth.resize(out.len(), -1.0);
        self.head.clear();
        self.head.resize(out.len(), NONE);
        self.soft.clear();
        for draw in draws {
            let (from, to) = (draw.footprint.y0.max(first_row), draw.footprint.y1.min(first_row + rows));
            let layer = &texels[draw.first_texel..draw.first_texel + (draw.w + 1) * (draw.h + 1)];
            for y in from..to {
                if let Some(span) = draw.span(y) {
                    let row = (y - first_row) as usize * width;
                    self.walk(draw, &span, layer, row + span.start, out);
                }
            }
        }
        self.blend(out);
    }

    fn walk(&mut self, draw: &Draw, span: &Span, texels: &[[u8; 4]], first: usize, out: &mut [[u8; 4]]) {
        let (pixels, stride) = (first..first + (span.end - span.start), draw.w + 1);
        let (depth, head, out) = (&mut self.depth[pixels.clone()], &mut self.head[pixels.clone()], &mut out[pixels]);
        for (chunk, ((depth, head), out)) in depth.chunks_mut(LANES).zip(head.chunks_mut(LANES)).zip(out.chunks_mut(LANES)).enumerate() {
            let Some(lanes) = Lanes::new(span, (chunk * LANES) as f32, draw, depth) else { continue };
            for (i, ((depth, head), out)) in depth.iter_mut().zip(head).zip(out).enumerate() {
                if lanes.delta[i] <= *depth {
                    continue;
                }
                let (column, row) = ((lanes.x[i] >> 8) as usize, (lanes.y[i] >> 8) as usize);
                let [upper, lower] = [row, row + 1].map(|row| &texels[row * stride + column..][..2]);
                let four = [upper[0], upper[1], lower[0], lower[1]];
                let (fx, fy) = (lanes.x[i] & 255, lanes.y[i] & 255);
                let alphas = four.map(|t| t[3]);
                if alphas == [255; 4] {
                    *depth = lanes.delta[i];
                    *out = mix(four, fx, fy);
                } else if alphas != [0; 4] {
                    let rgba = mix_premultiplied(four, fx, fy);
                    if rgba[3] >= OPAQUE * 255.0 {
                        *depth = lanes.delta[i];
                        *out = rgba.map(|v| (v * (255.0 / rgba[3]) + 0.5) as u8);
                    } else if rgba[3] > 0.0 {
                        link(&mut self.soft, head, lanes.delta[i], rgba);
                    }
                }
            }
        }
    }

    fn blend(&self, out: &mut [[u8; 4]]) {
        if self.soft.is_empty() {
            return;
        }
        for ((out, &head), &depth) in out.iter_mut().zip(&self.head).zip(&self.depth) {
            let (mut at, mut sum, mut through) = (head, [0.0; 3], 1.0);
            while let Some(s) = self.soft.get(at as usize) {
                // the opaque texel was not there yet when this sample was taken
                if s.delta < depth || through < DARK {
                    break;
                }
                for (sum, v) in sum.iter_mut().zip(s.rgba) {
                    *sum += through * v;
                }
                through *= 1.0 - s.rgba[3] / 255.0;
                at = s.next;
            }
            if head != NONE {
                let [r, g, b]: [u8; 3] = std::array::from_fn(|c| (sum[c] + through * f32::from(out[c]) + 0.5) as u8);
                let alpha = 255.0 - through * (255.0 - f32::from(out[3]));
                *out = [r, g, b, (alpha + 0.5) as u8];
            }
        }
    }
}

/// Adds a sample to a pixel's list, after those at least as near: layers come in the order of the tie-break.
fn link(soft: &mut Vec<Soft>, head: &mut u32, delta: f32, rgba: [f32; 4]) {
    let new = soft.len() as u32;
    let (mut before, mut at) = (NONE, *head);
    while let Some(s) = soft.get(at as usize) {
        if s.delta < delta {
            break;
        }
        (before, at) = (at, s.next);
    }
    soft.push(Soft { delta, next: at, rgba });
    match soft.get_mut(before as usize) {
        Some(s) => s.next = new,
        None => *head = new,
    }
}

/// Pixels computed side by side.
const LANES: usize = 8;

/// Target disparity and texel coordinates of neighbouring pixels.
struct Lanes {
    delta: [f32; LANES],
    /// Columns from the first texel's centre in 256ths.
    x: [u32; LANES],
    /// Rows from the first texel's centre in 256ths.
    y: [u32; LANES],
}

impl Lanes {
    /// Pixels from `first` of the span on, none where all lie behind `depth`; plain loops over arrays, which the compiler turns into
    /// vector instructions.
    fn new(span: &Span, first: f32, draw: &Draw, depth: &[f32]) -> Option<Self> {
        let step: [f32; LANES] = std::array::from_fn(|i| first + i as f32);
        let along = |f: [f32; 2]| step.map(|s| f[0] + s * f[1]);
        let delta = along(span.delta).map(|d| d.max(0.0));
        if depth.iter().zip(&delta).all(|(depth, delta)| delta <= depth) {
            return None;
        }
        let z = along(span.lambda).map(|v| 1.0 / v);
        let place = |f: [f32; 2], length: usize| {
            let (v, last) = (along(f), (length - 1) as f32);
            std::array::from_fn(|i| in_256ths((v[i] * z[i] - 0.5).max(0.0).min(last)))
        };
        Some(Self { delta, x: place(span.x, draw.w), y: place(span.y, draw.h) })
    }
}

/// `v` in 0 to 16 384, rounded to 256ths: added to 2²³, it is the mantissa.
fn in_256ths(v: f32) -> u32 {
    (v * 256.0 + 8_388_608.0).to_bits() & 0x007f_ffff
}

/// Bilinear weights in 256ths; they add up to 256.
fn weights(fx: u32, fy: u32) -> [u32; 4] {
    let both = (fx * fy + 128) >> 8;
    [256 + both - fx - fy, fx - both, fy - both, both]
}

/// Interpolates four opaque texels, all channels in one word of 16 bits each.
fn mix(four: [[u8; 4]; 4], fx: u32, fy: u32) -> [u8; 4] {
    const EVEN: u32 = 0x00ff_00ff;
    let mut sum = 0x0080_0080_0080_0080_u64;
    for (t, weight) in four.iter().zip(weights(fx, fy)) {
        let t = u32::from_le_bytes(*t);
        let spread = u64::from(t & EVEN) | (u64::from((t >> 8) & EVEN) << 32);
        sum += spread * u64::from(weight);
    }
    let (even, odd) = ((sum as u32 >> 8) & EVEN, ((sum >> 32) as u32 >> 8) & EVEN);
    (even | (odd << 8)).to_le_bytes()
}

/// Interpolates four texels premultiplied, 0 to 255.
fn mix_premultiplied(four: [[u8; 4]; 4], fx: u32, fy: u32) -> [f32; 4] {
    let mut sum = [0.0; 4];
    for (t, weight) in four.iter().zip(weights(fx, fy)) {
        let alpha = f32::from(t[3]) * (1.0 / 255.0);
        let weight = weight as f32 * (1.0 / 256.0);
        for c in 0..3 {
            sum[c] += weight * alpha * f32::from(t[c]);
        }
        sum[3] += weight * f32::from(t[3]);
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinates_in_256ths() {
        for (v, want) in [(0.0, 0), (1.0, 256), (0.5, 128), (16_384.0, 4_194_304), (62.999_99, 16_128), (100.251, 25_664)] {
            assert_eq!(in_256ths(v), want, "{v}");
        }
    }

    #[test]
    fn interpolation_is_exact_at_texels_and_within_a_level_between() {
        let four = [[0, 10, 255, 255], [255, 20, 0, 255], [7, 200, 128, 255], [255, 255, 255, 255]];
        assert_eq!(mix(four, 0, 0), four[0]);
        assert_eq!(mix(four, 256, 0), four[1]);
        assert_eq!(mix(four, 0, 256), four[2]);
        assert_eq!(mix(four, 256, 256), four[3]);
        for (fx, fy) in [(1, 1), (128, 128), (37, 201), (255, 3)] {
            let (got, want) = (mix(four, fx, fy), mix_premultiplied(four, fx, fy));
            for c in 0..4 {
                assert!((f32::from(got[c]) - want[c]).abs() <= 0.51, "{fx} {fy}: {got:?} {want:?}");
            }
        }
    }
}
