//! The context of a photo's stages.

use std::time::Instant;

use super::{MakeError, Models, Options, Parallax, Progress, Report, Sink, Sizes, StageTime};
use crate::photo::Limits;
use crate::usage::{self, Clock};

/// A stage that has begun.
#[derive(Clone, Copy, Debug)]
pub struct Begun {
    name: &'static str,
    clock: Clock,
}

/// State that all stages of a photo share.
pub struct Context<'a> {
    /// Networks.
    pub models: &'a Models,
    /// Limits on the photo.
    pub limits: &'a Limits,
    /// Options of the caller.
    pub options: &'a Options,
    /// Sizes of the pictures that the photo is made from; `None` in a room.
    pub sizes: Option<Sizes>,
    /// The report so far.
    pub report: Report,
    /// Converts disparity errors to pixels; `None` before the camera is known, and in a room, which does not measure errors.
    pub movement: Option<Parallax>,
    /// Milliseconds of the depth network alone; 0 if it did not run, or at the size for a photo.
    pub network_ms: f64,
    sink: &'a dyn Sink,
    clock: Clock,
}

impl<'a> Context<'a> {
    /// Context of a photo before its first stage; starts the clock.
    pub fn new(models: &'a Models, limits: &'a Limits, options: &'a Options, sink: &'a dyn Sink) -> Self {
        let clock = Clock::start();
        Self { models, limits, options, sizes: None, report: Report::default(), movement: None, network_ms: 0.0, sink, clock }
    }

    /// Begins a stage and sends a progress message. `name` is one of [`super::STAGES`], or that of a stage of a room.
    ///
    /// # Errors
    /// [`MakeError::Cancelled`] if the caller cancelled, [`MakeError::Late`] if the deadline has passed.
    pub fn begin(&self, name: &'static str) -> Result<Begun, MakeError> {
        if self.sink.cancelled() {
            return Err(MakeError::Cancelled);
        }
        if self.sink.deadline().is_some_and(|deadline| Instant::now() >= deadline) {
            return Err(MakeError::Late { stage: name });
        }
        let step = super::STAGES.iter().position(|s| *s == name).map_or(0, |p| p as u32 + 1);
        self.sink.progress(&Progress { stage: name, step, steps: super::STAGES.len() as u32, elapsed_ms: self.clock.ms() });
        Ok(Begun { name, clock: Clock::start() })
    }

    /// Ends a stage: adds its time to the report.
    pub fn end(&mut self, Begun { name, clock }: Begun) {
        self.report.stages.push(StageTime { name: name.into(), ms: clock.ms(), cpu_ms: clock.cpu_ms() });
    }

    /// Milliseconds since the start.
    pub fn elapsed_ms(&self) -> f64 {
        self.clock.ms()
    }

    /// Completes the report with total time and peak memory.
    pub fn finish(mut self) -> Report {
        self.report.total_ms = self.clock.ms();
        if let Some(b) = &mut self.report.budget {
            b.outcome_ms = self.report.total_ms;
        }
        self.report.peak_rss_bytes = usage::peak_rss_bytes();
        self.report
    }
}
