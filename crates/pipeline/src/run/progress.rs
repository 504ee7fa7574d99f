//! One stream of progress messages feeds the command line's bar, the server's events and the log alike.

use std::time::Instant;

use serde::Serialize;

/// One message on the way of a photo.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Progress {
    /// Name of the stage now under way: one of [`STAGES`](super::STAGES).
    pub stage: &'static str,
    /// Number of that stage, from 1.
    pub step: u32,
    /// Count of the stages that this photo goes through.
    pub steps: u32,
    /// Milliseconds since the start.
    pub elapsed_ms: f64,
}

/// Where progress messages go.
pub trait Sink: Sync {
    /// Takes a message; called at the start of every stage.
    fn progress(&self, message: &Progress);

    /// True once the caller no longer wants the result; the pipeline stops before its next stage.
    fn cancelled(&self) -> bool {
        false
    }

    /// When the result is of no more use; no stage begins after that.
    fn deadline(&self) -> Option<Instant> {
        None
    }
}

/// Drops every message.
pub struct Silent;

impl Sink for Silent {
    fn progress(&self, _: &Progress) {}
}
