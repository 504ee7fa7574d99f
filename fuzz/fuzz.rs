//! Runs the target named by `TMPI_FUZZ` on the bytes that libFuzzer finds.
#![no_main]

use std::sync::OnceLock;

use libfuzzer_sys::fuzz_target;
use tmpi::fuzzing::{Run, TARGETS};

#[path = "memory.rs"]
mod memory;

fn target() -> Run {
    static NAMED: OnceLock<Run> = OnceLock::new();
    *NAMED.get_or_init(|| {
        let name = std::env::var("TMPI_FUZZ").unwrap_or_default();
        let found = TARGETS.iter().find(|(n, _)| *n == name);
        found.unwrap_or_else(|| panic!("TMPI_FUZZ must be one of {:?}", TARGETS.map(|(n, _)| n))).1
    })
}

fuzz_target!(|data: &[u8]| memory::hold(target(), data));
