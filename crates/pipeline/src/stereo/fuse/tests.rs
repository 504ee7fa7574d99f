//! Fusing against plain references, with NaN and infinity among the measured disparities.

use proptest::prelude::*;

use super::*;

/// Measured disparities on a few levels, with gaps.
fn measured(count: usize) -> impl Strategy<Value = Vec<f32>> {
    let wild = prop::sample::select(vec![f32::NAN, f32::NAN, f32::NAN, f32::INFINITY, f32::NEG_INFINITY]);
    let level = prop::sample::select(vec![0.0f32, 0.9, 1.8, 7.0, -30.0]);
    let known = (level, 0.0f32..0.09).prop_map(|(d, off)| d + off);
    prop::collection::vec(prop_oneof![1 => wild, 2 => known], count)
}

/// Reference: each pixel takes the smallest name among its neighbours within a pixel of disparity, until none changes; all pixels of a name
/// are a piece.
fn without_specks(measured: &[f32], w: usize, least: usize) -> Vec<f32> {
    let mut names: Vec<usize> = (0..measured.len()).collect();
    let joined = |a: usize, b: usize| (measured[a] - measured[b]).abs() <= 1.0;
    for _ in 0..measured.len() {
        for i in 0..measured.len() {
            let right = (i % w + 1 < w).then_some(i + 1);
            for j in right.into_iter().chain(Some(i + w).filter(|j| *j < measured.len())).filter(|j| joined(i, *j)) {
                let name = names[i].min(names[j]);
                (names[i], names[j]) = (name, name);
            }
        }
    }
    let size = |i: usize| names.iter().filter(|n| **n == names[i]).count();
    let keeps = |i: usize| !measured[i].is_finite() || size(i) >= least;
    (0..measured.len()).map(|i| if keeps(i) { measured[i] } else { f32::NAN }).collect()
}

/// Reference: a gap is filled if it is short for the step across it.
fn hidden_filled(measured: &[f32], w: usize) -> Vec<f32> {
    let of = |i: usize| {
        let (row, x) = (&measured[i / w * w..][..w], i % w);
        let left = row[..x].iter().rposition(|d| d.is_finite());
        let right = row[x..].iter().position(|d| d.is_finite()).map(|by| x + by);
        match (left, right) {
            (Some(l), Some(r)) if r > x => {
                let step = (f64::from(row[l]) - f64::from(row[r])).abs();
                if (r - l - 1) as f64 <= 1.4 * step + 3.0 { row[l].min(row[r]) } else { row[x] }
            }
            _ => row[x],
        }
    };
    (0..measured.len()).map(of).collect()
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| if v.is_nan() { f32::NAN.to_bits() } else { v.to_bits() }).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    #[test]
    fn specks_and_hidden_gaps_agree_with_their_definitions(values in measured(14 * 11), w in 1usize..15, least in 0usize..12) {
        let values = &values[..values.len() / w / 2 * w];
        let mut got = values.to_vec();
        drop_specks(&mut got, w, least);
        prop_assert_eq!(bits(&got), bits(&without_specks(values, w, least)));
        let mut got = values.to_vec();
        fill_hidden(&mut got, w);
        prop_assert_eq!(bits(&got), bits(&hidden_filled(values, w)));
    }

    /// Known values stay; others lie between them. Squares of a side of a power of two are the same from either end, and so is what they fill.
    #[test]
    fn gaps_are_filled_within_the_known_values_and_turn_with_them(values in measured(16 * 16), w in 1usize..17, h in 1usize..17) {
        let known = |values: &[f32]| values.iter().copied().filter(|v| v.is_finite()).collect::<Vec<_>>();
        let filled = |mut values: Vec<f32>, w: usize| {
            spread(&mut values, w);
            values
        };
        let before = &values[..w * h];
        let (all, after) = (known(before), filled(before.to_vec(), w));
        let (low, high) = all.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
        for (was, is) in before.iter().zip(&after) {
            let between = if all.is_empty() { *is == 0.0 } else { (low - 1e-4..=high + 1e-4).contains(is) };
            prop_assert!(if was.is_finite() { was.to_bits() == is.to_bits() } else { between }, "{is} of {low}..{high}");
        }
        let (square, turned) = (filled(values.clone(), 16), filled(values.iter().rev().copied().collect(), 16));
        prop_assert!(square.iter().zip(turned.iter().rev()).all(|(a, b)| (a - b).abs() < 1e-3));
    }

    /// The estimate is off by scale and shift, and a third of the measured pixels by anything.
    #[test]
    fn unmeasured_pixels_follow_the_estimate(scale in 4.0f32..60.0, shift in -40.0f32..40.0, wild in 0u32..32, seed in 0u64..99) {
        let mut draw = Draw(seed);
        let estimate: Vec<f32> = (0..60 * 40).map(|i| f32::midpoint((i % 60) as f32 / 60.0, (i / 60 % 7) as f32 / 9.0)).collect();
        let truth: Vec<f32> = estimate.iter().map(|e| scale * e + shift).collect();
        let mut values = truth.clone();
        for v in &mut values {
            let at = draw.below(96) as u32;
            *v = if at < wild { shift + scale * draw.below(1000) as f32 / 1000.0 } else { *v };
        }
        let known: Vec<usize> = (0..2400).filter(|i| i % 3 != 1).collect();
        let (s, t) = align(&values, &estimate, &known);
        let within = (0.08 * scale).max(0.5);
        for (e, truth) in estimate.iter().zip(&truth) {
            prop_assert!((s * e + t - truth).abs() < within / 2.0, "{s} {t}, not {scale} {shift}");
        }
        // without relief, the estimate tells nothing
        prop_assert!(align(&values, &[0.5; 2400], &known).0.abs() < f32::EPSILON);
    }

    /// All pairs instead of some; `swapped` of 100 pixels run against the estimate.
    #[test]
    fn eyes_are_crossed_if_most_pairs_run_against_the_estimate(swapped in 0usize..=100, values in prop::collection::vec(0.0f32..1.0, 200)) {
        let measured: Vec<f32> = values.iter().zip(0..).map(|(e, i)| if i % 100 < swapped { -20.0 * e } else { 20.0 * e }).collect();
        let (mut alike, mut all) = (0.0, 0.0);
        for (a, b) in (0..200).flat_map(|a| (0..a).map(move |b| (a, b))) {
            let (m, e) = (f64::from(measured[a]) - f64::from(measured[b]), f64::from(values[a]) - f64::from(values[b]));
            if e.abs() > 0.1 && m.abs() > 1.0 {
                all += 1.0;
                alike += f64::from(u8::from(m * e > 0.0));
            }
        }
        let share: f64 = alike / all;
        // 20 000 draws are off by a hundredth
        prop_assume!((share - 0.2).abs() > 0.02);
        let gaps: Vec<f32> = measured.iter().chain([&f32::NAN; 200]).copied().collect();
        prop_assert_eq!(is_crossed(&gaps, &[values.as_slice(), &[0.5; 200]].concat()), share < 0.2, "{}", share);
    }
}
