//! The two inner loops of k-planes, written for auto-vectorisation, with run-time dispatch to AVX2.

use tmpi_core::simd::dispatch;

/// Lanes of the accumulators.
const LANES: usize = 8;

/// Weighted sums over a cluster: w, wu, wv, wδ, wuu, wuv, wvv, wuδ, wvδ.
pub type Sums = [f32; 9];

/// Columns of samples: position, disparity and weight, all of the same length.
#[derive(Clone, Copy)]
pub struct Columns<'a> {
    /// Horizontal position in half tiles from the tile's centre.
    pub u: &'a [f32],
    /// Vertical position in half tiles from the tile's centre.
    pub v: &'a [f32],
    /// Disparity.
    pub d: &'a [f32],
    /// Weight.
    pub w: &'a [f32],
}

dispatch!(
    /// Labels every sample with its nearest plane `(a, b, c)`, the first on ties, and writes its absolute error to `error`; `error` and
    /// `label` are as long as the columns. Adds the index and old label of each sample whose label changed to `moved`. Returns the weighted
    /// sum of squared errors.
    pub nearest, nearest_body,
    (planes: &[[f32; 3]], s: Columns, error: &mut [f32], label: &mut [u32], moved: &mut Vec<(u32, u32)>) -> f64
);

dispatch!(
    /// Sums over the samples with label `j`.
    pub sums, sums_body, (s: Columns, label: &[u32], j: u32) -> Sums
);

#[inline(always)]
fn nearest_body(planes: &[[f32; 3]], s: Columns, error: &mut [f32], label: &mut [u32], moved: &mut Vec<(u32, u32)>) -> f64 {
    let mut total = 0f64;
    let mut part = [0f32; LANES];
    let ((u, u_rest), (v, v_rest)) = (s.u.as_chunks::<LANES>(), s.v.as_chunks::<LANES>());
    let ((d, d_rest), (w, w_rest)) = (s.d.as_chunks::<LANES>(), s.w.as_chunks::<LANES>());
    let (e, e_rest) = error.as_chunks_mut::<LANES>();
    let (l, l_rest) = label.as_chunks_mut::<LANES>();
    let runs = e.len();
    for ((run, (e, l)), (((u, v), d), w)) in e.iter_mut().zip(l).enumerate().zip(u.iter().zip(v).zip(d).zip(w)) {
        // test all planes while these samples are in registers
        let (best, closest) = nearest_of(planes, u, v, d);
        part = lanes(|i| part[i] + w[i] * best[i] * best[i]);
        *e = best;
        if *l != closest {
            let at = run * LANES;
            moved.extend((at..).zip(*l).zip(closest).filter(|((_, old), new)| old != new).map(|((i, old), _)| (i as u32, old)));
            *l = closest;
        }
        // long `f32` sums of squares would lose small terms
        if run % 64 == 63 {
            total += f64::from(part.iter().sum::<f32>());
            part = [0.0; LANES];
        }
    }
    total += f64::from(part.iter().sum::<f32>());
    for (i, (e, l)) in e_rest.iter_mut().zip(l_rest).enumerate() {
        let (best, closest) = nearest_of(planes, &[u_rest[i]; LANES], &[v_rest[i]; LANES], &[d_rest[i]; LANES]);
        total += f64::from(w_rest[i] * best[0] * best[0]);
        *e = best[0];
        if *l != closest[0] {
            moved.push(((runs * LANES + i) as u32, *l));
            *l = closest[0];
        }
    }
    total
}

/// Absolute errors and labels of eight samples at their nearest planes.
#[inline(always)]
fn nearest_of(planes: &[[f32; 3]], u: &[f32; LANES], v: &[f32; LANES], d: &[f32; LANES]) -> ([f32; LANES], [u32; LANES]) {
    let (mut best, mut closest) = ([f32::INFINITY; LANES], [0u32; LANES]);
    for (j, &[a, b, c]) in (0u32..).zip(planes) {
        let new = lanes(|i| (a + b * u[i] + c * v[i] - d[i]).abs());
        let better: [bool; LANES] = std::array::from_fn(|i| new[i] < best[i]);
        best = lanes(|i| if better[i] { new[i] } else { best[i] });
        closest = std::array::from_fn(|i| if better[i] { j } else { closest[i] });
    }
    (best, closest)
}

#[inline(always)]
fn sums_body(s: Columns, label: &[u32], j: u32) -> Sums {
    let mut acc = [[0f32; LANES]; 9];
    let (u, u_rest) = s.u.as_chunks::<LANES>();
    let (v, v_rest) = s.v.as_chunks::<LANES>();
    let (d, d_rest) = s.d.as_chunks::<LANES>();
    let (w, w_rest) = s.w.as_chunks::<LANES>();
    let (l, l_rest) = label.as_chunks::<LANES>();
    for ((((u, v), d), w), l) in u.iter().zip(v).zip(d).zip(w).zip(l) {
        // labels form patches, so most runs of eight samples have none with this label
        if l.contains(&j) {
            add(&mut acc, *u, *v, *d, lanes(|i| if l[i] == j { w[i] } else { 0.0 }));
        }
    }
    let rest = |c: &[f32]| lanes(|i| c.get(i).copied().unwrap_or(0.0));
    let weight = lanes(|i| if l_rest.get(i) == Some(&j) { w_rest[i] } else { 0.0 });
    add(&mut acc, rest(u_rest), rest(v_rest), rest(d_rest), weight);
    acc.map(|a| a.iter().sum())
}

/// Adds eight samples. The compiler turns one loop per sum into one vector instruction.
#[inline(always)]
fn add(acc: &mut [[f32; LANES]; 9], u: [f32; LANES], v: [f32; LANES], d: [f32; LANES], w: [f32; LANES]) {
    let (wu, wv) = (lanes(|i| w[i] * u[i]), lanes(|i| w[i] * v[i]));
    let terms = [
        w,
        wu,
        wv,
        lanes(|i| w[i] * d[i]),
        lanes(|i| wu[i] * u[i]),
        lanes(|i| wu[i] * v[i]),
        lanes(|i| wv[i] * v[i]),
        lanes(|i| wu[i] * d[i]),
        lanes(|i| wv[i] * d[i]),
    ];
    for (a, t) in acc.iter_mut().zip(terms) {
        *a = lanes(|i| a[i] + t[i]);
    }
}

#[inline(always)]
fn lanes(f: impl Fn(usize) -> f32) -> [f32; LANES] {
    let mut out = [0.0; LANES];
    for (i, o) in out.iter_mut().enumerate() {
        *o = f(i);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Compares both kernels with plain `f64`.
        #[test]
        fn kernels_agree_with_f64(
            s in prop::collection::vec((-1f32..1.0, -1f32..1.0, 0f32..1.0, 0f32..1e4), 1..200),
            planes in prop::collection::vec([0f32..1.0, -0.3f32..0.3, -0.3f32..0.3], 1..7),
        ) {
            let column = |f: fn(&(f32, f32, f32, f32)) -> f32| s.iter().map(f).collect::<Vec<_>>();
            let (u, v, d, w) = (column(|s| s.0), column(|s| s.1), column(|s| s.2), column(|s| s.3));
            let c = Columns { u: &u, v: &v, d: &d, w: &w };
            let (mut error, mut label, mut moved) = (vec![0.0; s.len()], vec![0; s.len()], Vec::new());
            let cost = nearest(&planes, c, &mut error, &mut label, &mut moved);
            let want: f64 = (0..s.len()).map(|i| f64::from(w[i]) * f64::from(error[i]).powi(2)).sum();
            prop_assert!((cost - want).abs() <= 1e-5 * want + 1e-9);
            let changed: Vec<(u32, u32)> = (0..).zip(&label).filter(|(_, l)| **l != 0).map(|(i, _)| (i, 0)).collect();
            prop_assert_eq!(&moved, &changed);
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
