//! Progress messages: one stream for the command line's progress bar, the server's events and the log.

use std::time::Instant;

use serde::Serialize;

/// Message at the start of a stage.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Progress {
    /// Name of the stage, one of [`STAGES`](super::STAGES).
    pub stage: &'static str,
    /// Number of the stage, from 1.
    pub step: u32,
    /// Total number of stages.
    pub steps: u32,
    /// Milliseconds since making started.
    pub elapsed_ms: f64,
}

/// Receives progress messages.
pub trait Sink: Sync {
    /// Called at the start of every stage.
    fn progress(&self, message: &Progress);

    /// Whether the caller has cancelled; if so, the pipeline stops before its next stage.
    fn cancelled(&self) -> bool {
        false
    }

    /// Deadline after which no stage starts; `None`: no deadline.
    fn deadline(&self) -> Option<Instant> {
        None
    }
}

/// A sink that drops every message.
pub struct Silent;

impl Sink for Silent {
    fn progress(&self, _: &Progress) {}
}
