//! Identity of the program that makes and renders, as digests that the build takes of its sources: results depend on it besides the
//! uploads.

use sha2::{Digest, Sha256};

use super::finished_photo::FinishedPhoto;
use tmpi_library::hex;

/// Sources, networks and dependencies that make photos.
pub const PIPELINE: &str = env!("TMPI_PIPELINE");
/// The same, with those that render and export.
const PROGRAM: &str = env!("TMPI_PROGRAM");

/// Everything besides the container that a server's views, levels and exports depend on.
pub fn of_server(backend: &str) -> String {
    format!("{PROGRAM} {backend}")
}

/// Names everything that a server of identity `build` derives from one version of a photo: 16 hex digits.
pub fn of_results(build: &str, done: &FinishedPhoto) -> String {
    short(&format!("{build} {} {}", done.atlas_hash, done.at_ms))
}

/// The first 64 bits of the SHA-256 of `text`, in hex.
pub fn short(text: &str) -> String {
    hex(&Sha256::digest(text)[..8])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_program_backend_and_making_has_its_own_identity() {
        let done = |hash: &str, at_ms| FinishedPhoto { at_ms, width: 1, height: 1, atlas_bytes: 1, atlas_hash: hash.into() };
        let all = [
            of_results(&of_server("cpu"), &done("a", 1)),
            of_results(&of_server("gpu"), &done("a", 1)),
            of_results("another program cpu", &done("a", 1)),
            of_results(&of_server("cpu"), &done("b", 1)),
            of_results(&of_server("cpu"), &done("a", 2)),
        ];
        assert!(all.iter().enumerate().all(|(i, x)| !all[..i].contains(x)), "{all:?}");
        assert!(PIPELINE.len() == 64 && PROGRAM.len() == 64 && PIPELINE != PROGRAM);
    }
}
