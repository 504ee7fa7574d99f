//! What a stage is, and what drives one after the other.

use super::{MakeError, Models, Movement, Options, Progress, Report, Sink, Sizes, StageTime};
use crate::photo::Limits;
use crate::usage::{self, Clock};

/// One step on the way from a photo to its container, as a value: what it carries on from one photo to the next (the last frame of a
/// room, say) is its own.
pub trait Stage {
    /// Name in progress messages and reports, one of [`super::STAGES`].
    const NAME: &'static str;
    /// What it takes.
    type Input<'a>;
    /// What it gives.
    type Output;

    /// Runs once.
    ///
    /// # Errors
    /// [`MakeError`]: what it was given, an option, or a network is at fault.
    fn run(&mut self, input: Self::Input<'_>, context: &mut Context) -> Result<Self::Output, MakeError>;
}

/// What all stages of a photo share.
pub struct Context<'a> {
    /// Networks.
    pub models: &'a Models,
    /// Limits on the photo.
    pub limits: &'a Limits,
    /// What the caller chose.
    pub options: &'a Options,
    /// Sizes of what it is made of; none in a room.
    pub sizes: Option<Sizes>,
    /// What has been done so far.
    pub report: Report,
    /// What errors of disparity do in views of a photo; none before its camera is known, and in a room, whose errors are not measured.
    pub movement: Option<Movement>,
    sink: &'a dyn Sink,
    clock: Clock,
}

impl<'a> Context<'a> {
    /// A photo at its start.
    #[must_use]
    pub fn new(models: &'a Models, limits: &'a Limits, options: &'a Options, sink: &'a dyn Sink) -> Self {
        Self { models, limits, options, sizes: None, report: Report::default(), movement: None, sink, clock: Clock::start() }
    }

    /// Runs a stage: tells that it begins, and what it took; not where the caller has given up or the time is over.
    ///
    /// # Errors
    /// [`MakeError::Cancelled`], [`MakeError::Late`], and what the stage gives.
    pub fn run<S: Stage>(&mut self, stage: &mut S, input: S::Input<'_>) -> Result<S::Output, MakeError> {
        self.check(S::NAME)?;
        let step = super::STAGES.iter().position(|s| *s == S::NAME).map_or(0, |p| p as u32 + 1);
        self.sink.progress(&Progress { stage: S::NAME, step, steps: super::STAGES.len() as u32, elapsed_ms: self.clock.ms() });
        let clock = Clock::start();
        let output = stage.run(input, self)?;
        self.report.stages.push(StageTime { name: S::NAME.into(), ms: clock.ms(), cpu_ms: clock.cpu_ms() });
        Ok(output)
    }

    /// Milliseconds since the start.
    #[must_use]
    pub fn elapsed_ms(&self) -> f64 {
        self.clock.ms()
    }

    /// The report of a photo that is done.
    #[must_use]
    pub fn finish(mut self) -> Report {
        self.report.total_ms = self.clock.ms();
        if let Some(b) = &mut self.report.budget {
            b.outcome_ms = self.report.total_ms;
        }
        self.report.peak_rss_bytes = usage::peak_rss_bytes();
        self.report
    }

    fn check(&self, stage: &'static str) -> Result<(), MakeError> {
        if self.sink.cancelled() {
            return Err(MakeError::Cancelled);
        }
        match self.sink.deadline() {
            Some(deadline) if std::time::Instant::now() >= deadline => Err(MakeError::Late { stage }),
            _ => Ok(()),
        }
    }
}
