//! Runs the target that `TMPI_FUZZ` names under libFuzzer.
#![no_main]

use std::sync::OnceLock;

use libfuzzer_sys::fuzz_target;
use targets::{Run, TARGETS};

mod memory;
mod targets;

/// Callers of the decoders of video and of OpenEXR catch their panics, but the panic hook of libFuzzer's crate would abort first.
fn ignore_panics_of_decoders() {
    let before = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        if !info.location().is_some_and(|l| ["rusty_h264", "rusty_vp9", "/exr-", "/zune-inflate-"].iter().any(|c| l.file().contains(c))) {
            before(info);
        }
    }));
}

fn target() -> Run {
    static NAMED: OnceLock<Run> = OnceLock::new();
    *NAMED.get_or_init(|| {
        ignore_panics_of_decoders();
        let name = std::env::var("TMPI_FUZZ").unwrap_or_default();
        let found = TARGETS.iter().find(|(n, _)| *n == name);
        found.unwrap_or_else(|| panic!("TMPI_FUZZ must be one of {:?}", TARGETS.map(|(n, _)| n))).1
    })
}

fuzz_target!(|data: &[u8]| memory::hold(target(), data));
