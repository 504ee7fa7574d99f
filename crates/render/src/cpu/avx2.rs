//! [`portable`](super::lanes::portable) in AVX2 instructions: the same bits, eight pixels at once.

#[allow(clippy::wildcard_imports, reason = "forty instructions, all of one prefix")]
use std::arch::x86_64::*;

use super::lanes::{LANES, Pixels, Run, Soften};

/// Draws the opaque ones of eight pixels.
#[target_feature(enable = "avx2")]
#[inline]
#[allow(unsafe_code, reason = "loads and stores of whole arrays, and gathers from places that are clamped to the layer")]
#[allow(clippy::cast_ptr_alignment, reason = "loads and stores of unaligned places")]
pub(super) fn opaque(run: &Run, pixels: Pixels) -> Soften {
    let Pixels { depth, out } = pixels;
    let step = _mm256_add_ps(_mm256_set1_ps(run.at as f32), _mm256_setr_ps(0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0));
    let along = |f: [f32; 2]| _mm256_add_ps(_mm256_set1_ps(f[0]), _mm256_mul_ps(step, _mm256_set1_ps(f[1])));
    let zero = _mm256_setzero_ps();
    // of two operands, `max` and `min` give the second where the first is NaN
    let delta = _mm256_max_ps(along(run.span.delta), zero);
    // SAFETY: `depth` has eight values.
    let before = unsafe { _mm256_loadu_ps(depth.as_ptr()) };
    // unordered, as a comparison that is not less or equal
    let nearer = _mm256_cmp_ps::<_CMP_NLE_UQ>(delta, before);
    if _mm256_movemask_ps(nearer) == 0 {
        return Soften::default();
    }
    let z = _mm256_div_ps(_mm256_set1_ps(1.0), along(run.span.lambda));
    let place = |f: [f32; 2], last: f32| {
        let v = _mm256_sub_ps(_mm256_mul_ps(along(f), z), _mm256_set1_ps(0.5));
        let v = _mm256_min_ps(_mm256_max_ps(v, zero), _mm256_set1_ps(last));
        let bits = _mm256_castps_si256(_mm256_add_ps(_mm256_mul_ps(v, _mm256_set1_ps(256.0)), _mm256_set1_ps(8_388_608.0)));
        _mm256_and_si256(bits, _mm256_set1_epi32(0x007f_ffff))
    };
    let (x, y) = (place(run.span.x, run.last[0]), place(run.span.y, run.last[1]));
    let four = neighbours(run, x, y);
    let [a, b, c, d] = four;
    let alpha = _mm256_set1_epi32(0xff00_0000_u32 as i32);
    let all = _mm256_and_si256(_mm256_and_si256(a, b), _mm256_and_si256(c, d));
    let any = _mm256_or_si256(_mm256_or_si256(a, b), _mm256_or_si256(c, d));
    let full = _mm256_cmpeq_epi32(_mm256_and_si256(all, alpha), alpha);
    let empty = _mm256_cmpeq_epi32(_mm256_and_si256(any, alpha), _mm256_setzero_si256());
    let nearer = _mm256_castps_si256(nearer);
    let drawn = _mm256_and_si256(full, nearer);
    if _mm256_testz_si256(drawn, drawn) == 0 {
        let between = _mm256_set1_epi32(255);
        // as in the photo's own view: every pixel's centre is a texel's
        let exact = _mm256_testz_si256(_mm256_or_si256(x, y), between) == 1;
        let mixed = if exact { a } else { mix(four, x, y) };
        // SAFETY: both have eight values.
        unsafe {
            let at = out.as_mut_ptr().cast::<__m256i>();
            _mm256_storeu_si256(at, _mm256_blendv_epi8(_mm256_loadu_si256(at), mixed, drawn));
            _mm256_storeu_ps(depth.as_mut_ptr(), _mm256_blendv_ps(before, delta, _mm256_castsi256_ps(drawn)));
        }
    }
    let left = _mm256_andnot_si256(_mm256_or_si256(full, empty), nearer);
    let lanes = _mm256_movemask_ps(_mm256_castsi256_ps(left)) as u32;
    if lanes == 0 {
        return Soften::default();
    }
    let mut soft = Soften { lanes, ..Soften::default() };
    const { assert!(LANES == 8) };
    // SAFETY: each has eight values.
    unsafe {
        _mm256_storeu_ps(soft.delta.as_mut_ptr(), delta);
        _mm256_storeu_si256(soft.x.as_mut_ptr().cast(), x);
        _mm256_storeu_si256(soft.y.as_mut_ptr().cast(), y);
    }
    soft
}

/// The four texels around each lane's place.
#[target_feature(enable = "avx2")]
#[inline]
#[allow(unsafe_code, reason = "loads and gathers from places that are clamped to the layer")]
fn neighbours(run: &Run, x: __m256i, y: __m256i) -> [__m256i; 4] {
    let (column, row) = (_mm256_srli_epi32::<8>(x), _mm256_srli_epi32::<8>(y));
    let spread = |v: __m256i| _mm256_broadcastd_epi32(_mm256_castsi256_si128(v));
    let (right, down) = (_mm256_sub_epi32(column, spread(column)), _mm256_sub_epi32(row, spread(row)));
    let base = run.texels.as_ptr();
    // columns are at most w − 1 and rows h − 1 (clamped, NaN to 0)
    if _mm256_testz_si256(_mm256_or_si256(_mm256_andnot_si256(_mm256_set1_epi32(7), right), down), _mm256_set1_epi32(-1)) == 1 {
        // all in one row and within eight columns: two loads a row cost less than gathering
        let first = _mm256_cvtsi256_si32(row) as usize * run.stride + _mm256_cvtsi256_si32(column) as usize;
        return [first, first + 1, first + run.stride, first + run.stride + 1].map(|at| {
            // SAFETY: `at` is at most the layer's last texel, and eight more follow it.
            let eight = unsafe { _mm256_loadu_si256(base.add(at).cast()) };
            _mm256_permutevar8x32_epi32(eight, right)
        });
    }
    let stride = _mm256_set1_epi32(run.stride as i32);
    let upper = _mm256_add_epi32(_mm256_mullo_epi32(row, stride), column);
    let pairs = |at: __m256i| {
        // SAFETY: the texels have a column and a row more than the layer.
        let (low, high) = unsafe {
            let low = _mm256_i32gather_epi64::<4>(base.cast(), _mm256_castsi256_si128(at));
            (low, _mm256_i32gather_epi64::<4>(base.cast(), _mm256_extracti128_si256::<1>(at)))
        };
        let (low, high) = (_mm256_castsi256_ps(low), _mm256_castsi256_ps(high));
        let ordered = |v: __m256| _mm256_permute4x64_epi64::<0b11_01_10_00>(_mm256_castps_si256(v));
        [ordered(_mm256_shuffle_ps::<0b10_00_10_00>(low, high)), ordered(_mm256_shuffle_ps::<0b11_01_11_01>(low, high))]
    };
    let ([a, b], [c, d]) = (pairs(upper), pairs(_mm256_add_epi32(upper, stride)));
    [a, b, c, d]
}

/// Interpolates four opaque texels a lane: even and odd bytes in 16 bits each, of which the sums take all.
#[target_feature(enable = "avx2")]
#[inline]
fn mix(four: [__m256i; 4], x: __m256i, y: __m256i) -> __m256i {
    let low = _mm256_set1_epi32(255);
    let (fx, fy) = (_mm256_and_si256(x, low), _mm256_and_si256(y, low));
    let both = _mm256_srli_epi32::<8>(_mm256_add_epi32(_mm256_mullo_epi16(fx, fy), _mm256_set1_epi32(128)));
    let (right, down) = (_mm256_sub_epi32(fx, both), _mm256_sub_epi32(fy, both));
    let first = _mm256_sub_epi32(_mm256_set1_epi32(256), _mm256_add_epi32(fx, down));
    let even = _mm256_set1_epi32(0x00ff_00ff);
    let (mut sum_even, mut sum_odd) = (_mm256_set1_epi32(0x0080_0080), _mm256_set1_epi32(0x0080_0080));
    for (t, weight) in four.into_iter().zip([first, right, down, both]) {
        let weight = _mm256_or_si256(weight, _mm256_slli_epi32::<16>(weight));
        sum_even = _mm256_add_epi16(sum_even, _mm256_mullo_epi16(_mm256_and_si256(t, even), weight));
        sum_odd = _mm256_add_epi16(sum_odd, _mm256_mullo_epi16(_mm256_srli_epi16::<8>(t), weight));
    }
    _mm256_or_si256(_mm256_srli_epi16::<8>(sum_even), _mm256_andnot_si256(even, sum_odd))
}
