//! Checks the decoder on the containers below `tests/golden`, and on damaged variants of them. `tests/golden/digests.txt` has the expected
//! digests; `tests/browser/decode/wasm.test.mjs` checks the wasm decoder against the same file. `TMPI_BLESS=digests` writes it.
#![allow(clippy::unwrap_used, reason = "a test")]

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};
use tmpi_core::Photo;
use tmpi_core::container::{PhotoFormat, decode_with};

/// Number of damaged variants of each container.
const VARIANTS: u32 = 200;
/// Maximum number of pixels of a picture, because damaged containers can declare any size.
const MAX_PIXELS: u32 = 200_000;

/// A picture that every decoder can compute without a codec.
fn pattern(width: u32, height: u32) -> Photo {
    let at = |x: u32, y: u32| [(x * 7 + y * 3) as u8, ((x * 5) ^ (y * 11)) as u8, (x * y + 13) as u8];
    Photo { width, height, rgb: (0..height).flat_map(|y| (0..width).map(move |x| at(x, y))).collect() }
}

/// Digest of a container, decoded with the pattern as its pictures, or `refused`.
fn outcome(bytes: &[u8]) -> String {
    let pictures = |_: PhotoFormat, _: &[u8], (width, height): (u32, u32)| {
        if u64::from(width) * u64::from(height) > u64::from(MAX_PIXELS) {
            return Err(tmpi_core::container::ContainerError::Broken("too large for a test".into()));
        }
        Ok(pattern(width, height))
    };
    decode_with(bytes, &pictures).map_or_else(|_| "refused".into(), |scene| scene.digest())
}

/// A pseudorandom sequence that is easy to repeat in other languages: 32-bit xorshift.
struct Random(u32);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 17;
        self.0 ^= self.0 << 5;
        self.0 as usize % n
    }
}

/// The container with one to four changes of a byte, half of them in the first 300 bytes; some cut off the end.
fn damaged(bytes: &[u8], random: &mut Random) -> Vec<u8> {
    let mut out = bytes.to_vec();
    for _ in 0..=random.below(4) {
        let reach = if random.below(2) == 0 { out.len().min(300) } else { out.len() };
        let at = random.below(reach);
        match random.below(8) {
            0 => out.truncate(at.max(1)),
            1 => out[at] = random.below(256) as u8,
            _ => out[at] ^= 1 << random.below(8),
        }
    }
    out
}

fn containers(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            containers(&path, found);
        } else if path.extension().is_some_and(|e| e == "tmpi") {
            found.push(path);
        }
    }
}

#[test]
fn golden_and_damaged_containers_decode_as_recorded() {
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden");
    let mut files = Vec::new();
    containers(&golden, &mut files);
    files.sort();
    let mut lines = String::new();
    let (mut refused, mut read) = (0, 0);
    for (seed, file) in (1..).zip(&files) {
        let bytes = std::fs::read(file).unwrap();
        let name = file.strip_prefix(&golden).unwrap().to_string_lossy().replace('\\', "/");
        let whole = outcome(&bytes);
        assert_ne!(whole, "refused", "{name}");
        let mut random = Random(seed);
        let mut all = Sha256::new();
        for _ in 0..VARIANTS {
            let outcome = outcome(&damaged(&bytes, &mut random));
            if outcome == "refused" {
                refused += 1;
            } else {
                read += 1;
            }
            all.update(outcome);
        }
        let all = all.finalize().iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}"));
        writeln!(lines, "{name} {whole} {all}").unwrap();
    }
    assert!(refused > 100 && read > 100, "{refused} refused, {read} read: the damage tests too little");
    let kept = golden.join("digests.txt");
    if std::env::var("TMPI_BLESS").is_ok_and(|v| v == "digests") {
        std::fs::write(&kept, &lines).unwrap();
    }
    assert_eq!(lines, std::fs::read_to_string(&kept).unwrap());
}
