//! The fuzzing targets on their seeds, and on changes of these by a fixed generator. `cargo xtask fuzz` goes on from there.
#![allow(clippy::unwrap_used, reason = "test")]
#![allow(unsafe_code, reason = "an allocator that counts and hands on")]

use std::path::Path;

use tmpi::fuzzing::{Run, TARGETS};

#[path = "../fuzz/memory.rs"]
mod memory;

/// Changes of each seed; `TMPI_FUZZ_CHANGES` sets another count, for a longer run where libFuzzer cannot be built.
const CHANGES: usize = 400;

/// Multiplicative generator: the same bytes on every machine.
struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % n.max(1)
    }
}

/// One to four of: a byte set, a bit flipped, a stretch cut out, a stretch doubled, an end cut off.
fn changed(seed: &[u8], random: &mut Random) -> Vec<u8> {
    let mut data = seed.to_vec();
    for _ in 0..=random.below(4) {
        if data.is_empty() {
            break;
        }
        // the index and a section's head matter most
        let n = data.len();
        let at = if random.below(2) == 0 { random.below(n.min(200)) } else { random.below(n) };
        let end = at + random.below((n - at).min(32));
        match random.below(6) {
            0 => data[at] = random.below(256) as u8,
            1 => data[at] ^= 1 << random.below(8),
            2 => data[at] = [0, 1, 127, 128, 255][random.below(5)],
            3 => drop(data.drain(at..end)),
            4 => data.splice(at..at, seed[at.min(seed.len())..end.min(seed.len())].to_vec()).for_each(drop),
            _ => data.truncate(at),
        }
    }
    data
}

fn seeds(name: &str) -> Vec<(String, Vec<u8>)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds").join(name);
    let mut files: Vec<_> = std::fs::read_dir(&folder).unwrap().map(|e| e.unwrap().path()).collect();
    files.sort();
    assert!(!files.is_empty(), "{} holds no seed", folder.display());
    files.into_iter().map(|p| (p.file_name().unwrap().to_string_lossy().into_owned(), std::fs::read(p).unwrap())).collect()
}

#[test]
fn targets_hold_on_seeds_and_on_changes_of_them() {
    let changes = std::env::var("TMPI_FUZZ_CHANGES").map_or(CHANGES, |n| n.parse().unwrap());
    for (name, run) in TARGETS {
        for (file, seed) in seeds(name) {
            eprintln!("{name}/{file}");
            memory::hold(run, &seed);
            let mut random = Random(1);
            for _ in 0..changes {
                memory::hold(run, &changed(&seed, &mut random));
            }
        }
    }
}

#[test]
fn a_target_that_takes_too_much_is_caught() {
    let greedy: Run = |data| {
        let taken = std::hint::black_box(vec![1u8; 64 << 20]);
        data.len() + taken.len() / 64 / 1024
    };
    assert!(std::panic::catch_unwind(|| memory::hold(greedy, b"one")).is_err());
}
