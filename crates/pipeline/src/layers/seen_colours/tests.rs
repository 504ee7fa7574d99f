use proptest::prelude::*;

use super::*;

proptest! {
    #[test]
    fn steps_are_those_from_the_nearest_unseen_texel(w in 1usize..12, unseen in prop::collection::vec(prop::bool::weighted(0.05), 1..120)) {
        let h = unseen.len().div_ceil(w);
        let of = |i: usize| unseen.get(i).copied().unwrap_or(false);
        let mut steps: Vec<u8> = (0..w * h).map(|i| if of(i) { 0 } else { FADE }).collect();
        count_steps(&mut steps, w);
        for (i, got) in steps.into_iter().enumerate() {
            let apart = |j: usize| (i % w).abs_diff(j % w) + (i / w).abs_diff(j / w);
            let want = (0..w * h).filter(|j| of(*j)).map(apart).min().unwrap_or(usize::MAX).min(FADE.into());
            prop_assert_eq!(usize::from(got), want, "texel {} of {} a row", i, w);
        }
    }

    #[test]
    fn fading_is_a_weighted_mean(inpainted: u8, seen: u8, steps in 0..=FADE) {
        let share = f64::from(steps) / f64::from(FADE);
        let want = share * f64::from(seen) + (1.0 - share) * f64::from(inpainted);
        prop_assert!((f64::from(fade(inpainted, seen, steps)) - want).abs() <= 0.5);
    }
}
