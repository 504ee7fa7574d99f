//! Runs the fuzz targets on their seeds and on reproducible mutations of them. `cargo xtask fuzz` runs them under libFuzzer.
#![allow(clippy::unwrap_used, reason = "test")]
#![allow(unsafe_code, reason = "an allocator that counts")]

use std::collections::BTreeSet;
use std::path::Path;

use targets::{Run, TARGETS};
use tmpi_testing::png::chunk;

#[path = "../fuzz/memory.rs"]
mod memory;
#[path = "../fuzz/targets/mod.rs"]
mod targets;

/// Folder with the seeds of each target.
const SEEDS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/fuzz/seeds");

/// Mutations of each seed; `TMPI_FUZZ_CHANGES` overrides it, for longer runs without libFuzzer.
const CHANGES: usize = 400;

/// Targets that build or read a whole container get a tenth of the mutations.
const SLOW: [&str; 3] = ["built", "levels", "room"];

/// Linear congruential generator: the same bytes on every machine.
struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % n.max(1)
    }
}

/// Mutates one to four times: sets a byte, flips a bit, removes or duplicates a range, or truncates.
fn mutated(seed: &[u8], random: &mut Random) -> Vec<u8> {
    let mut data = seed.to_vec();
    for _ in 0..=random.below(4) {
        if data.is_empty() {
            break;
        }
        // prefer the index and the first section header
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
    let folder = Path::new(SEEDS).join(name);
    let mut files: Vec<_> = std::fs::read_dir(&folder).unwrap().map(|e| e.unwrap().path()).collect();
    files.sort();
    assert!(!files.is_empty(), "{} has no seeds", folder.display());
    files.into_iter().map(|p| (p.file_name().unwrap().to_string_lossy().into_owned(), std::fs::read(p).unwrap())).collect()
}

#[test]
fn targets_accept_seeds_and_mutations_within_their_memory_bound() {
    let changes = std::env::var("TMPI_FUZZ_CHANGES").map_or(CHANGES, |n| n.parse().unwrap());
    for (name, run) in TARGETS {
        let changes = if SLOW.contains(&name) { changes.div_ceil(10) } else { changes };
        for (file, seed) in seeds(name) {
            eprintln!("{name}/{file}");
            memory::hold(run, &seed);
            let mut random = Random(1);
            for _ in 0..changes {
                memory::hold(run, &mutated(&seed, &mut random));
            }
        }
    }
    // not a test of its own: memory is counted for the whole process
    huge_metadata_takes_bounded_memory();
}

/// `cargo xtask fuzz` takes the names of the targets from the folders.
#[test]
fn every_folder_of_seeds_is_a_target() {
    let folders: BTreeSet<String> =
        std::fs::read_dir(SEEDS).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    assert_eq!(folders, TARGETS.iter().map(|(name, _)| (*name).to_owned()).collect());
}

/// Little-endian TIFF data with one entry, an orientation of `count` zero values of type `kind`.
fn orientation(kind: u16, count: u32) -> Vec<u8> {
    let mut tiff = b"II*\0\x08\0\0\0\x01\0\x12\x01".to_vec();
    tiff.extend_from_slice(&kind.to_le_bytes());
    tiff.extend_from_slice(&[count.to_le_bytes(), 26u32.to_le_bytes()].concat());
    tiff.extend_from_slice(&[0; 4]);
    tiff.resize(26 + count as usize, 0);
    tiff
}

fn huge_metadata_takes_bounded_memory() {
    let run = TARGETS.iter().find(|(name, _)| *name == "png").unwrap().1;
    let seed = &seeds("png")[0].1;
    let with = |chunk: Vec<u8>| [&seed[..33], &chunk, &seed[33..]].concat();
    // an orientation of 31 million empty strings
    memory::hold(run, &with(chunk(b"eXIf", &orientation(2, 31 << 20))));
    // a profile of zeros, a thousand times larger than its chunk
    let packed = zlib(&vec![0; 64 << 20]);
    memory::hold(run, &with(chunk(b"iCCP", &[b"p\0\0".as_slice(), &packed].concat())));
    memory::hold(run, &with(chunk(b"zTXt", &[b"p\0\0".as_slice(), &packed].concat())));
    let many: Vec<u8> = (0..200_000).flat_map(|_| chunk(b"tEXt", b"a\0b")).collect();
    memory::hold(run, &with(many));
    // a JPEG segment with TIFF directories that point to each other
    let mut tiff = b"II*\0\x08\0\0\0".to_vec();
    tiff.extend_from_slice(&5000u16.to_le_bytes());
    for _ in 0..5000 {
        tiff.extend_from_slice(b"\x69\x87\x04\0\x01\0\0\0\x08\0\0\0");
    }
    let body = [b"Exif\0\0".as_slice(), &tiff].concat();
    let jpeg = &seeds("jpeg")[0].1;
    let segment = [[0xFF, 0xE1].as_slice(), &((body.len() + 2) as u16).to_be_bytes(), &body].concat();
    let jpeg = [&jpeg[..2], &segment, &jpeg[2..]].concat();
    memory::hold(run, &jpeg);
}

/// Compresses as a zlib stream.
fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut out = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::best());
    std::io::Write::write_all(&mut out, bytes).unwrap();
    out.finish().unwrap()
}

#[test]
fn a_target_above_its_memory_bound_fails() {
    let greedy: Run = |data| {
        let buffer = std::hint::black_box(vec![1u8; 64 << 20]);
        data.len() + buffer.len() / 64 / 1024
    };
    assert!(std::panic::catch_unwind(|| memory::hold(greedy, b"one")).is_err());
}
