use proptest::prelude::*;

use super::*;

const SIZES: [(u32, u32); 4] = [(192, 128), (160, 128), (128, 96), (96, 64)];

fn pixels(i: usize) -> f64 {
    f64::from(SIZES[i].0) * f64::from(SIZES[i].1)
}

/// Depth on an idle machine.
fn time(ms: f64, network_ms: f64) -> DepthTime {
    DepthTime { ms, network_ms, cpu_ms: Some(ms) }
}

/// A simulated machine that takes `load` times as long for everything.
#[derive(Clone, Copy)]
struct Machine {
    load: f64,
}

impl Machine {
    fn network(self, i: usize) -> f64 {
        self.load * 20.0 * pixels(i) / pixels(0)
    }

    fn depth(self, i: usize) -> f64 {
        self.network(i) + self.load * 4.0
    }

    /// Tiles divisible by nine need six planes, the others divisible by three need three, the rest one.
    fn planes(tile: usize, most: Option<u32>) -> usize {
        let needs = if tile.is_multiple_of(9) {
            6
        } else if tile.is_multiple_of(3) {
            3
        } else {
            1
        };
        needs.min(most.map_or(usize::MAX, |m| m as usize))
    }

    fn tiles(self, planes: &[usize]) -> f64 {
        self.load * 0.2 * planes.iter().map(|p| 1 + p).sum::<usize>() as f64
    }

    /// Simulates a frame with `waiting` tiles. Returns the choices, and the milliseconds of depth and of tiles.
    fn frame(self, budget: &mut Budget, waiting: usize) -> (Option<usize>, TileBudget, f64, f64) {
        let size = budget.depth(&SIZES, false);
        if let Some(i) = size {
            budget.depth_took(time(self.depth(i), self.network(i)));
        }
        let share = budget.tiles(waiting, Some(6));
        let planes: Vec<usize> = (0..waiting).map(|t| Self::planes(t, share.planes)).collect();
        let ms = self.tiles(&planes);
        budget.tiles_took(&planes, share.planes.is_none(), ms);
        (size, share, size.map_or(0.0, |i| self.depth(i)), ms)
    }
}

/// A budget that has measured a machine.
fn measured(frame_ms: f64, load: f64, frames: usize) -> Budget {
    let mut budget = Budget::new(frame_ms);
    (0..frames).for_each(|_| {
        Machine { load }.frame(&mut budget, 36);
    });
    budget
}

#[test]
fn with_enough_time_nothing_is_limited() {
    let all = TileBudget { planes: None, spare: usize::MAX - 1_000_000 };
    for frame_ms in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let mut budget = measured(frame_ms, 100.0, 20);
        assert_eq!((budget.depth(&SIZES, false), budget.tiles(1_000_000, Some(6))), (Some(0), all), "{frame_ms}");
    }
    let mut budget = measured(1e4, 1.0, 20);
    assert_eq!(budget.depth(&SIZES, false), Some(0));
    assert!(budget.tiles(500, Some(6)).spare > 0 && budget.tiles(500, Some(6)).planes.is_none());
    // before the first frame there are no measurements
    let mut first = Budget::new(1.0);
    assert_eq!((first.depth(&SIZES, false), first.tiles(1_000_000, Some(6))), (Some(0), all));
}

#[test]
fn depth_keeps_to_the_budget_and_tiles_do_if_two_planes_fit() {
    for frame_ms in [8.0, 10.0, 16.0, 21.0, 30.0, 45.0, 80.0] {
        let (mut budget, machine) = (measured(frame_ms, 1.0, 40), Machine { load: 1.0 });
        for _ in 0..20 {
            let (_, share, depth, tiles) = machine.frame(&mut budget, 36);
            let left = frame_ms - depth.min(DEPTH_SHARE * frame_ms);
            let fewest: Vec<usize> = (0..36).map(|t| Machine::planes(t, Some(2))).collect();
            assert!(depth < SIZE_OVERRUN * DEPTH_SHARE * frame_ms, "{frame_ms}: {depth}");
            assert!(tiles <= left.max(machine.tiles(&fewest)) + 1.5, "{frame_ms}: {tiles}, {share:?}");
        }
    }
}

#[test]
fn depth_that_fits_at_no_size_skips_frames() {
    let (mut budget, machine) = (measured(5.0, 1.0, 40), Machine { load: 1.0 });
    // depth's share is 3 ms a frame; the smallest size takes 9
    assert!(machine.depth(3) > 8.9 && machine.depth(3) < 9.1);
    let sizes: Vec<usize> = (0..30).filter_map(|_| machine.frame(&mut budget, 36).0).collect();
    assert!(sizes.iter().all(|i| *i == 3) && (10..=15).contains(&sizes.len()), "{sizes:?}");
    // a new scene does not wait
    assert!((0..10).all(|_| budget.depth(&SIZES, true) == Some(3)));
    // an estimator without a choice of sizes skips frames too
    let mut single = Budget::new(30.0);
    single.depth_took(time(0.0, 0.0));
    single.depth_took(time(60.0, 0.0));
    assert_eq!((0..30).filter(|_| single.depth(&[], false).is_some()).count(), 10);
}

#[test]
fn other_programs_make_depth_smaller_but_not_less_frequent() {
    let count = |cpu_share: Option<f64>| {
        let mut budget = Budget::new(20.0);
        let mut sizes = Vec::new();
        for _ in 0..100 {
            if let Some(i) = budget.depth(&SIZES, false) {
                let machine = Machine { load: 20.0 };
                budget.depth_took(DepthTime {
                    cpu_ms: cpu_share.map(|s| s * machine.depth(i)),
                    ..time(machine.depth(i), machine.network(i))
                });
                sizes.push(i);
            }
        }
        assert!(sizes.iter().skip(2).all(|i| *i == 3), "{sizes:?}");
        sizes.len()
    };
    // the smallest size takes 180 ms, of which the budget allows 12 a frame
    assert!((6..12).contains(&count(Some(1.0))), "{}", count(Some(1.0)));
    assert!(count(Some(0.05)) > 85, "{}", count(Some(0.05)));
    // unknown processor time counts as all of it
    for unknown in [None, Some(0.0)] {
        assert_eq!(count(unknown), count(Some(1.0)));
    }
}

#[test]
fn load_reduces_depth_size_and_planes_until_it_ends() {
    let mut budget = measured(50.0, 1.0, 40);
    let run = |budget: &mut Budget, load: f64| {
        let mut last = None;
        (0..60).for_each(|_| last = Some(Machine { load }.frame(budget, 36)));
        last.map(|(size, share, ..)| (size, share.planes))
    };
    let idle = run(&mut budget, 1.0);
    assert_eq!(idle, Some((Some(0), None)));
    let (size, planes) = run(&mut budget, 3.0).unwrap_or_default();
    assert!(size.is_none_or(|i| i > 0) && planes == Some(2), "{size:?} {planes:?}");
    assert_eq!(run(&mut budget, 1.0), idle);
}

#[test]
fn a_size_near_the_limit_does_not_oscillate() {
    // depth takes 24 ms of the allowed 24.1: kept if it is the current size, but not switched to
    let mut budget = measured(24.1 / (SIZE_OVERRUN * DEPTH_SHARE), 1.0, 30);
    let sizes = |budget: &mut Budget, load: f64| -> Vec<Option<usize>> {
        (0..20).map(|n| Machine { load: load * if n % 2 == 0 { 1.002 } else { 0.998 } }.frame(budget, 4).0).collect()
    };
    assert!(sizes(&mut budget, 1.0).iter().all(|s| *s == Some(0)));
    (0..40).for_each(|_| {
        Machine { load: 1.1 }.frame(&mut budget, 4);
    });
    assert!(sizes(&mut budget, 1.0).iter().all(|s| *s == Some(1)));
}

#[test]
fn invalid_times_are_ignored() {
    let mut budget = measured(30.0, 1.0, 30);
    let before = (budget.depth(&SIZES, false), budget.tiles(36, Some(6)));
    for wild in [f64::NAN, f64::INFINITY, -5.0] {
        budget.depth_took(time(wild, 1.0));
        budget.depth_took(time(wild, wild));
        budget.depth_took(DepthTime { cpu_ms: Some(wild), ..time(1.0, 1.0) });
        budget.tiles_took(&[1, 2], true, wild);
    }
    budget.tiles_took(&[], true, 9.0);
    assert_eq!((budget.depth(&SIZES, false), budget.tiles(36, Some(6))), before);
    // a cost of zero always fits
    let mut free = Budget::new(1e-9);
    (0..5).for_each(|_| {
        free.depth_took(time(0.0, 0.0));
        free.tiles_took(&[6; 9], true, 0.0);
    });
    assert_eq!((free.depth(&SIZES, false), free.tiles(1000, Some(6))), (Some(0), TileBudget { planes: None, spare: usize::MAX - 1000 }));
    let mut slow = measured(1e-6, 1e6, 5);
    assert_eq!(slow.tiles(36, Some(6)), TileBudget { planes: Some(2), spare: 0 });
    // coarse tiles finish, one a frame
    assert_eq!(slow.tiles(0, Some(6)), TileBudget { planes: None, spare: 1 });
    assert!((0..3).all(|_| slow.depth(&SIZES, true) == Some(3)));
}

#[test]
fn a_fixed_number_of_planes_is_never_reduced() {
    let budget = measured(12.0, 1.0, 30);
    assert_eq!(budget.tiles(1000, None).planes, None);
    assert_eq!(budget.tiles(1000, Some(6)).planes, Some(2));
}

proptest! {
    /// At the same costs, more time never yields a smaller size, fewer planes or fewer spare tiles, and limited planes leave none.
    #[test]
    fn more_time_never_yields_less(load in 0.05f64..20.0, less in 0.5f64..200.0, more in 0.0f64..200.0, waiting in 1usize..300, at in 0usize..4) {
        let mut known = measured(f64::INFINITY, load, 20);
        known.size = (pixels(at), at > 0);
        let chosen = |frame_ms: f64| {
            let mut budget = Budget { frame_ms, ..known.clone() };
            let size = budget.depth(&SIZES, true);
            (size, budget.tiles(waiting, Some(6)))
        };
        let (a, b) = (chosen(less), chosen(less + more));
        prop_assert!(b.0 <= a.0, "{a:?} {b:?}");
        let planes = |s: TileBudget| s.planes.unwrap_or(6);
        prop_assert!(planes(b.1) >= planes(a.1) && b.1.spare >= a.1.spare, "{a:?} {b:?}");
        prop_assert!(a.1.planes.is_none() || a.1.spare == 0);
    }
}
