//! Progress on standard error: a bar on a terminal, plain lines elsewhere.

use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;

use tmpi_pipeline::{Progress, Sink};

/// Progress of one photo.
pub(super) struct Bar {
    name: String,
    line: Option<ProgressBar>,
    quiet: bool,
}

impl Bar {
    /// Starts for the photo `name`; `quiet` shows nothing.
    pub(super) fn new(name: &str, quiet: bool) -> Self {
        let bar = (!quiet && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::new(1);
            if let Ok(style) = ProgressStyle::with_template("{prefix} [{bar:20}] {msg} {elapsed}") {
                bar.set_style(style);
            }
            bar.set_prefix(name.to_owned());
            bar
        });
        Self { name: name.to_owned(), line: bar, quiet }
    }
}

impl Sink for Bar {
    fn progress(&self, message: &Progress) {
        let Progress { stage, step, steps, elapsed_ms } = message;
        if let Some(bar) = &self.line {
            bar.set_length((*steps).into());
            bar.set_position(step.saturating_sub(1).into());
            bar.set_message(*stage);
        } else if !self.quiet {
            eprintln!("{}: {stage} ({step}/{steps}, {elapsed_ms:.0} ms)", self.name);
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
