//! The two inner loops of k-planes, written so that they vectorise, with run-time dispatch to AVX2.

/// Lanes of the accumulators.
const LANES: usize = 8;

/// Sums of a cluster: w, wu, wv, wδ, wuu, wuv, wvv, wuδ, wvδ.
pub type Sums = [f32; 9];

/// Columns of samples: place, disparity, weight. All of one length.
#[derive(Clone, Copy)]
pub struct Columns<'a> {
    /// Horizontal place in half tiles.
    pub u: &'a [f32],
    /// Vertical place.
    pub v: &'a [f32],
    /// Disparity.
    pub d: &'a [f32],
    /// Weight.
    pub w: &'a [f32],
}

macro_rules! dispatch {
    ($(#[$doc:meta])* $name:ident, $body:ident, $avx2:ident, ($($arg:ident: $ty:ty),*) $(-> $ret:ty)?) => {
        $(#[$doc])*
        #[allow(unsafe_code, reason = "the call is guarded by the test for the features that it needs")]
        pub fn $name($($arg: $ty),*) $(-> $ret)? {
            #[cfg(target_arch = "x86_64")]
            if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: both features were just found.
                return unsafe { $avx2($($arg),*) };
            }
            $body($($arg),*)
        }

        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,fma")]
        fn $avx2($($arg: $ty),*) $(-> $ret)? {
            $body($($arg),*)
        }
    };
}

dispatch!(
    /// Labels every sample with its nearest plane `(a, b, c)`, the first of equals, and leaves its absolute error in `error`;
    /// `error` and `label` are as long as the columns.
    nearest, nearest_body, nearest_avx2, (planes: &[[f32; 3]], s: Columns, error: &mut [f32], label: &mut [u32])
);

dispatch!(
    /// Sums of the samples of label `j`.
    sums, sums_body, sums_avx2, (s: Columns, label: &[u32], j: u32) -> Sums
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn nearest_body(planes: &[[f32; 3]], s: Columns, error: &mut [f32], label: &mut [u32]) {
    error.fill(f32::INFINITY);
    label.fill(0);
    for (j, p) in planes.iter().enumerate() {
        let [a, b, c] = *p;
        for ((((u, v), d), e), l) in s.u.iter().zip(s.v).zip(s.d).zip(error.iter_mut()).zip(label.iter_mut()) {
            let new = (a + b * u + c * v - d).abs();
            let better = new < *e;
            *e = if better { new } else { *e };
            *l = if better { j as u32 } else { *l };
        }
    }
}

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn sums_body(s: Columns, label: &[u32], j: u32) -> Sums {
    let mut acc = [[0f32; LANES]; 9];
    let add = |acc: &mut [[f32; LANES]; 9], lane: usize, u: f32, v: f32, d: f32, w: f32, l: u32| {
        let w = if l == j { w } else { 0.0 };
        let (wu, wv) = (w * u, w * v);
        acc[0][lane] += w;
        acc[1][lane] += wu;
        acc[2][lane] += wv;
        acc[3][lane] += w * d;
        acc[4][lane] += wu * u;
        acc[5][lane] += wu * v;
        acc[6][lane] += wv * v;
        acc[7][lane] += wu * d;
        acc[8][lane] += wv * d;
    };
    let whole = label.len() / LANES * LANES;
    let (u, v, d, w) = (s.u.as_chunks::<LANES>().0, s.v.as_chunks::<LANES>().0, s.d.as_chunks::<LANES>().0, s.w.as_chunks::<LANES>().0);
    for ((((u, v), d), w), l) in u.iter().zip(v).zip(d).zip(w).zip(label.as_chunks::<LANES>().0) {
        for i in 0..LANES {
            add(&mut acc, i, u[i], v[i], d[i], w[i], l[i]);
        }
    }
    for i in whole..label.len() {
        add(&mut acc, 0, s.u[i], s.v[i], s.d[i], s.w[i], label[i]);
    }
    acc.map(|a| a.iter().sum())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Both kernels against plain `f64`.
        #[test]
        fn kernels_agree_with_f64(
            s in prop::collection::vec((-1f32..1.0, -1f32..1.0, 0f32..1.0, 0f32..1e4), 1..200),
            planes in prop::collection::vec([0f32..1.0, -0.3f32..0.3, -0.3f32..0.3], 1..7),
        ) {
            let column = |f: fn(&(f32, f32, f32, f32)) -> f32| s.iter().map(f).collect::<Vec<_>>();
            let (u, v, d, w) = (column(|s| s.0), column(|s| s.1), column(|s| s.2), column(|s| s.3));
            let c = Columns { u: &u, v: &v, d: &d, w: &w };
            let (mut error, mut label) = (vec![0.0; s.len()], vec![0; s.len()]);
            nearest(&planes, c, &mut error, &mut label);
            for i in 0..s.len() {
                let e = |p: &[f32; 3]| (f64::from(p[0]) + f64::from(p[1]) * f64::from(u[i]) + f64::from(p[2]) * f64::from(v[i]) - f64::from(d[i])).abs();
                let least = planes.iter().map(e).fold(f64::INFINITY, f64::min);
                prop_assert!((f64::from(error[i]) - least).abs() < 1e-6);
                prop_assert!((e(&planes[label[i] as usize]) - least).abs() < 1e-6);
            }
            for j in 0..planes.len() as u32 {
                let got = sums(c, &label, j);
                let mut want = [0f64; 9];
                let mut scale = 0f64;
                for i in (0..s.len()).filter(|&i| label[i] == j) {
                    let (u, v, d, w) = (f64::from(u[i]), f64::from(v[i]), f64::from(d[i]), f64::from(w[i]));
                    for (a, b) in want.iter_mut().zip([w, w * u, w * v, w * d, w * u * u, w * u * v, w * v * v, w * u * d, w * v * d]) { *a += b; }
                    scale += w;
                }
                for (a, b) in got.iter().zip(want) { prop_assert!((f64::from(*a) - b).abs() <= 1e-5 * scale + 1e-6); }
            }
        }
    }
}
