//! The trait of all stages, and the context that runs them.

use super::{MakeError, Models, Options, Parallax, Progress, Report, Sink, Sizes, StageTime};
use crate::photo::Limits;
use crate::usage::{self, Clock};

/// One step from a photo to its container. A stage owns the state that it keeps from one photo to the next, such as the last frame of a
/// room.
pub trait Stage {
    /// Name in progress messages and reports, one of [`super::STAGES`].
    const NAME: &'static str;
    /// Input of the stage.
    type Input<'a>;
    /// Output of the stage.
    type Output;

    /// Runs the stage once.
    ///
    /// # Errors
    /// [`MakeError`] if the input or an option is invalid or a network fails.
    fn run(&mut self, input: Self::Input<'_>, context: &mut Context) -> Result<Self::Output, MakeError>;
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
    sink: &'a dyn Sink,
    clock: Clock,
}

impl<'a> Context<'a> {
    /// Context of a photo before its first stage; starts the clock.
    pub fn new(models: &'a Models, limits: &'a Limits, options: &'a Options, sink: &'a dyn Sink) -> Self {
        Self { models, limits, options, sizes: None, report: Report::default(), movement: None, sink, clock: Clock::start() }
    }

    /// Runs a stage: sends a progress message before it and adds its time to the report.
    ///
    /// # Errors
    /// [`MakeError::Cancelled`] if the caller cancelled, [`MakeError::Late`] if the deadline has passed, or the error of the stage.
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
