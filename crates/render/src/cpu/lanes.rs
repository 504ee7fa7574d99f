//! Eight neighbouring pixels of a row at once.

use super::span::{Draw, Span};

/// Number of pixels computed side by side.
pub(super) const LANES: usize = 8;

/// Progress along one row of a layer.
#[derive(Clone, Copy, Debug)]
pub(super) struct Run<'a> {
    pub span: Span,
    /// Texels from the layer's first one on: the layer's `(w + 1) · (h + 1)`, and at least [`LANES`] more.
    pub texels: &'a [[u8; 4]],
    /// Texels per row: the layer's width plus one.
    pub stride: usize,
    /// Column and row of the last texel.
    pub last: [f32; 2],
    /// Number of finished pixels of the span.
    pub at: usize,
}

impl<'a> Run<'a> {
    /// Starts at the beginning of `span`; `texels` starts at the first texel of `draw`.
    ///
    /// # Panics
    /// Panics if fewer than [`LANES`] texels follow those of the layer.
    #[inline(always)]
    pub fn new(span: &Span, draw: &Draw, texels: &'a [[u8; 4]]) -> Self {
        assert!(texels.len() >= (draw.w + 1) * (draw.h + 1) + LANES, "the texels are padded");
        Self { span: *span, texels, stride: draw.w + 1, last: [(draw.w - 1) as f32, (draw.h - 1) as f32], at: 0 }
    }
}

/// The pixels to draw.
pub(super) struct Pixels<'a> {
    /// Target disparity of the opaque texel; below 0 if there is none.
    pub depth: &'a mut [f32; LANES],
    pub out: &'a mut [[u8; 4]; LANES],
}

/// Pixels in front of the opaque texel whose own texels are neither all opaque nor all transparent.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Soften {
    /// One bit per pixel.
    pub lanes: u32,
    /// Target disparity of all pixels.
    pub delta: [f32; LANES],
    /// Columns from the first texel's centre, in 256ths.
    pub x: [u32; LANES],
    /// Rows from the first texel's centre, in 256ths.
    pub y: [u32; LANES],
}

/// The four texels around a position, which is in 256ths.
pub(super) fn neighbours(texels: &[[u8; 4]], stride: usize, x: u32, y: u32) -> [[u8; 4]; 4] {
    let (column, row) = ((x >> 8) as usize, (y >> 8) as usize);
    let [upper, lower] = [row, row + 1].map(|row| &texels[row * stride + column..][..2]);
    [upper[0], upper[1], lower[0], lower[1]]
}

/// Bilinear weights in 256ths; their sum is 256.
pub(super) fn weights(fx: u32, fy: u32) -> [u32; 4] {
    let both = (fx * fy + 128) >> 8;
    [256 + both - fx - fy, fx - both, fy - both, both]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use fearless_simd::Level;

    use super::super::vector;
    use super::*;

    /// [`vector::opaque`] a pixel at a time.
    fn plain(run: &Run, pixels: Pixels) -> Soften {
        let Pixels { depth, out } = pixels;
        let step: [f32; LANES] = std::array::from_fn(|i| (run.at + i) as f32);
        let along = |f: [f32; 2]| step.map(|s| f[0] + s * f[1]);
        let delta = along(run.span.delta).map(|d| d.max(0.0));
        if depth.iter().zip(&delta).all(|(depth, delta)| delta <= depth) {
            return Soften::default();
        }
        let z = along(run.span.lambda).map(|v| 1.0 / v);
        let place = |f: [f32; 2], last: f32| {
            let v = along(f);
            std::array::from_fn(|i| in_256ths((v[i] * z[i] - 0.5).max(0.0).min(last)))
        };
        let mut soft = Soften { lanes: 0, delta, x: place(run.span.x, run.last[0]), y: place(run.span.y, run.last[1]) };
        for i in 0..LANES {
            if delta[i] <= depth[i] {
                continue;
            }
            let four = neighbours(run.texels, run.stride, soft.x[i], soft.y[i]);
            let alphas = four.map(|t| t[3]);
            if alphas == [255; 4] {
                depth[i] = delta[i];
                out[i] = mix(four, soft.x[i] & 255, soft.y[i] & 255);
            } else if alphas != [0; 4] {
                soft.lanes |= 1 << i;
            }
        }
        soft
    }

    /// `v` in 0 to 16 384, rounded to 256ths: added to 2²³, it is the mantissa.
    fn in_256ths(v: f32) -> u32 {
        (v * 256.0 + 8_388_608.0).to_bits() & 0x007f_ffff
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
            let got = mix(four, fx, fy);
            let [u, v] = [fx, fy].map(|f| f64::from(f) / 256.0);
            for c in 0..4 {
                let [a, b, p, q] = four.map(|t| f64::from(t[c]));
                let want = (a * (1.0 - u) + b * u) * (1.0 - v) + (p * (1.0 - u) + q * u) * v;
                // one product is rounded to 256ths, by at most a half, and with it all four weights; then the sum
                let bound = 0.5 + (a - b - p + q).abs() * 0.5 / 256.0 + 1e-9;
                assert!((f64::from(got[c]) - want).abs() <= bound, "{fx} {fy}: {got:?} {want}");
            }
        }
    }

    /// Any float, NaN and infinities among them, and often one as scenes have them.
    fn number(usual: std::ops::Range<f32>) -> impl Strategy<Value = f32> {
        prop_oneof![4 => usual, 1 => any::<f32>()]
    }

    /// All kinds of vectors that this processor has.
    fn levels() -> Vec<Level> {
        let mut all = vec![Level::baseline(), Level::new()];
        #[cfg(target_arch = "x86_64")]
        all.extend([Level::new().as_sse4_2().map(Level::Sse4_2), Level::new().as_avx2().map(Level::Avx2)].into_iter().flatten());
        all
    }

    prop_compose! {
        fn spans()(
            lambda in number(0.5..2.0), bend in number(-0.01..0.01), x in number(-1.0..9.0), dx in number(-1.5..1.5),
            y in number(-1.0..9.0), dy in number(-1.5..1.5), delta in number(-0.1..1.0), slope in number(-0.1..0.1),
        ) -> Span {
            Span { start: 0, end: 24, lambda: [lambda, bend], x: [x, dx], y: [y, dy], delta: [delta, slope] }
        }
    }

    proptest! {
        /// The kernel gives the very bits of single pixels, by all kinds of vectors that this processor has, whatever the span is.
        #[test]
        fn kernels_agree(
            span in spans(),
            (w, h) in (1usize..9, 1usize..9),
            at in 0usize..17,
            depth in prop::array::uniform8(prop_oneof![Just(-1.0f32), Just(f32::INFINITY), 0.0f32..1.0]),
            (seed, opaque) in (any::<u32>(), 0u32..4),
        ) {
            let mut state = seed;
            let mut byte = || { state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223); (state >> 24) as u8 };
            let texels: Vec<[u8; 4]> = (0..(w + 1) * (h + 1) + LANES)
                .map(|_| [byte(), byte(), byte(), if u32::from(byte()) < 64 * opaque { 255 } else { [0, 7, 200, 254][usize::from(byte() % 4)] }])
                .collect();
            let run = Run { span, texels: &texels, stride: w + 1, last: [(w - 1) as f32, (h - 1) as f32], at };
            let (mut want_depth, mut want) = (depth, [[1, 2, 3, 4]; LANES]);
            let want_soft = plain(&run, Pixels { depth: &mut want_depth, out: &mut want });
            for level in levels() {
                let (mut got_depth, mut got) = (depth, [[1, 2, 3, 4]; LANES]);
                let soft = fearless_simd::dispatch!(level, simd => vector::opaque(simd, &run, Pixels { depth: &mut got_depth, out: &mut got }));
                // which zero `max` gives is left open; adding 0 makes both the positive one
                let bits = |v: f32| (v + 0.0).to_bits();
                prop_assert_eq!(got_depth.map(bits), want_depth.map(bits), "{:?}", level);
                prop_assert_eq!(got, want);
                prop_assert_eq!(soft.lanes, want_soft.lanes);
                for i in (0..LANES).filter(|i| soft.lanes >> i & 1 == 1) {
                    prop_assert_eq!((soft.x[i], soft.y[i], bits(soft.delta[i])), (want_soft.x[i], want_soft.y[i], bits(want_soft.delta[i])));
                }
            }
        }
    }
}
