//! Progress on standard error: one bar per photo on a terminal, plain lines elsewhere.

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use std::io::IsTerminal;

use super::{note, result};
use tmpi_pipeline::{Progress, Sink};

/// Progress bars of photos that are made in parallel.
pub(super) struct Bars {
    all: MultiProgress,
    quiet: bool,
}

impl Bars {
    /// Starts without bars; `quiet` shows none.
    pub(super) fn new(quiet: bool) -> Self {
        Self { all: MultiProgress::new(), quiet }
    }

    pub(super) fn bar(&self, name: &str) -> Bar {
        let line = (!self.quiet && std::io::stderr().is_terminal()).then(|| {
            let bar = self.all.add(ProgressBar::new(1));
            if let Ok(style) = ProgressStyle::with_template("{prefix} [{bar:20}] {msg} {elapsed}") {
                bar.set_style(style);
            }
            bar.set_prefix(name.to_owned());
            bar
        });
        Bar { name: name.to_owned(), line, quiet: self.quiet }
    }

    /// Writes one line of results without breaking a bar.
    pub(super) fn result(&self, line: &str) -> anyhow::Result<()> {
        self.all.suspend(|| result(line))
    }

    /// Writes one line to standard error without breaking a bar.
    pub(super) fn note(&self, line: &str) {
        self.all.suspend(|| note(line));
    }
}

pub(super) struct Bar {
    name: String,
    line: Option<ProgressBar>,
    quiet: bool,
}

fn words(stage: &'static str) -> &'static str {
    match stage {
        "photo" => "reading the photo",
        "depth" => "finding depth",
        "denoise" => "cleaning the depth map",
        "snap" => "fitting depth to edges",
        "planes" => "placing planes",
        "layers" => "filling what is hidden",
        "refine" => "refining layers",
        "encode" => "packing",
        "verify" => "checking",
        other => other,
    }
}

impl Sink for Bar {
    fn progress(&self, message: &Progress) {
        let Progress { stage, step, steps, elapsed_ms } = message;
        if let Some(bar) = &self.line {
            bar.set_length((*steps).into());
            bar.set_position(step.saturating_sub(1).into());
            bar.set_message(words(stage));
        } else if !self.quiet {
            note(&format!("{}: {} ({:.1} s)", self.name, words(stage), elapsed_ms / 1e3));
        }
    }
}

/// Reports only the stages that make a depth map.
pub(super) struct DepthAlone(pub(super) Bar);

impl Sink for DepthAlone {
    fn progress(&self, message: &Progress) {
        const STAGES: [&str; 4] = ["photo", "depth", "denoise", "snap"];
        if let Some(at) = STAGES.iter().position(|stage| *stage == message.stage) {
            self.0.progress(&Progress { step: at as u32 + 1, steps: STAGES.len() as u32, ..*message });
        }
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        if let Some(bar) = &self.line {
            bar.finish_and_clear();
        }
    }
}
