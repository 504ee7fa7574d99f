//! A band of rows: depth, opaque colour, and a list of soft samples per pixel.

use fearless_simd::{Level, Simd};

use super::lanes::{LANES, Pixels, Run, Soften, neighbours, weights};
use super::span::Draw;
use super::vector::opaque;
use crate::OPAQUE;

/// A sample between transparent and opaque.
#[derive(Clone, Copy, Debug)]
struct Soft {
    delta: f32,
    /// The next farther sample of the same pixel, or [`NONE`].
    next: u32,
    /// Premultiplied, 0 to 255.
    rgba: [f32; 4],
}

/// End of a pixel's list.
const NONE: u32 = u32::MAX;

/// Buffers of a band. A thread reuses them for its next band.
#[derive(Debug, Default)]
pub(super) struct Band {
    /// Target disparity of the opaque texel; below 0 if there is none.
    depth: Vec<f32>,
    /// Nearest soft sample of each pixel, or [`NONE`].
    head: Vec<u32>,
    /// Samples of all pixels, linked from near to far for each pixel.
    soft: Vec<Soft>,
}

/// Maximum capacity for soft samples that stays allocated from one band to the next.
const MAX_KEPT: usize = 1 << 16;

/// A transmittance below this is invisible in 8 bits, and further products would leave the normal range of `f32`.
const DARK: f32 = 1e-6;

impl Band {
    /// Draws rows from `first_row` on into `out`, which must be transparent; `draws` are sorted, nearest first.
    pub fn draw(&mut self, draws: &[Draw], texels: &[[u8; 4]], first_row: u32, width: usize, out: &mut [[u8; 4]]) {
        self.depth.clear();
        self.depth.resize(out.len(), -1.0);
        self.head.clear();
        self.head.resize(out.len(), NONE);
        self.walk_all(draws, texels, first_row, width, out);
        self.blend(out);
        // frees the room that a scene of many soft layers took
        self.soft.clear();
        self.soft.shrink_to(MAX_KEPT);
    }

    /// Walks every draw, with this processor's vector instructions.
    fn walk_all(&mut self, draws: &[Draw], texels: &[[u8; 4]], first_row: u32, width: usize, out: &mut [[u8; 4]]) {
        fearless_simd::dispatch!(Level::new(), simd => self.walk(simd, draws, texels, first_row, width, out));
    }

    #[inline(always)]
    fn walk<S: Simd>(&mut self, simd: S, draws: &[Draw], texels: &[[u8; 4]], first_row: u32, width: usize, out: &mut [[u8; 4]]) {
        let rows = (out.len() / width) as u32;
        for draw in draws {
            let (from, to) = (draw.footprint.y0.max(first_row), draw.footprint.y1.min(first_row + rows));
            let layer = &texels[draw.first_texel..];
            for y in from..to {
                let Some(span) = draw.span(y) else { continue };
                let first = (y - first_row) as usize * width + span.start;
                let pixels = first..first + (span.end - span.start);
                let (depth, out) = (&mut self.depth[pixels.clone()], &mut out[pixels]);
                let mut run = Run::new(&span, draw, layer);
                let (depths, depth_rest) = depth.as_chunks_mut::<LANES>();
                let (outs, out_rest) = out.as_chunks_mut::<LANES>();
                let full = depths.len() * LANES;
                for (depth, out) in depths.iter_mut().zip(outs) {
                    let soft = opaque(simd, &run, Pixels { depth, out });
                    if soft.lanes != 0 {
                        soften(&soft, layer, run.stride, &mut self.head[first + run.at..], &mut self.soft, depth, out);
                    }
                    run.at += LANES;
                }
                if !depth_rest.is_empty() {
                    // treats lanes past the end as covered by something that nothing is nearer than
                    let (mut depth, mut out) = ([f32::INFINITY; LANES], [[0; 4]; LANES]);
                    depth[..depth_rest.len()].copy_from_slice(depth_rest);
                    out[..out_rest.len()].copy_from_slice(out_rest);
                    let soft = opaque(simd, &run, Pixels { depth: &mut depth, out: &mut out });
                    if soft.lanes != 0 {
                        soften(&soft, layer, run.stride, &mut self.head[first + full..], &mut self.soft, &mut depth, &mut out);
                    }
                    depth_rest.copy_from_slice(&depth[..depth_rest.len()]);
                    out_rest.copy_from_slice(&out[..out_rest.len()]);
                }
            }
        }
    }

    fn blend(&self, out: &mut [[u8; 4]]) {
        if self.soft.is_empty() {
            return;
        }
        let runs = out.chunks_mut(LANES).zip(self.head.chunks(LANES)).zip(self.depth.chunks(LANES));
        // most runs of eight have no soft pixel
        let runs = runs.filter(|((_, head), _)| head.iter().any(|h| *h != NONE));
        for ((out, &head), &depth) in runs.flat_map(|((out, head), depth)| out.iter_mut().zip(head).zip(depth)) {
            let (mut at, mut sum, mut through) = (head, [0.0; 3], 1.0);
            while let Some(s) = self.soft.get(at as usize) {
                // this sample was taken before the opaque texel was drawn
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

/// Samples the pixels whose texels are neither all opaque nor all transparent; `head` starts at the first of the eight pixels.
#[inline(never)]
fn soften(
    lanes: &Soften,
    texels: &[[u8; 4]],
    stride: usize,
    head: &mut [u32],
    soft: &mut Vec<Soft>,
    depth: &mut [f32; LANES],
    out: &mut [[u8; 4]; LANES],
) {
    let mut left = lanes.lanes;
    while left != 0 {
        let i = left.trailing_zeros() as usize;
        left &= left - 1;
        let (x, y, delta) = (lanes.x[i], lanes.y[i], lanes.delta[i]);
        let rgba = mix_premultiplied(neighbours(texels, stride, x, y), x & 255, y & 255);
        if rgba[3] >= OPAQUE * 255.0 {
            depth[i] = delta;
            out[i] = rgba.map(|v| (v * (255.0 / rgba[3]) + 0.5) as u8);
        } else if rgba[3] > 0.0 {
            link(soft, &mut head[i], delta, rgba);
        }
    }
}

/// Inserts a sample into a pixel's list, after those that are at least as near: layers arrive in the order of the tie-break.
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

/// Interpolates four texels; the result is premultiplied, 0 to 255.
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
