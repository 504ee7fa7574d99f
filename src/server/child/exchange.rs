//! Sends work to a child process and waits for its answer.

use std::io::ErrorKind;
use std::process::Child;
use std::sync::mpsc::RecvTimeoutError;
use std::time::Instant;

use super::messages::{Answer, Work, write};
use super::{Answers, ChildProcess, KEPT_BYTES, ProcessMaker, TICK, end, ending};
use crate::server::exports::{ExportTask, timeout_problem};
use crate::server::maker::{Fault, Product};
use crate::server::photo_options;
use tmpi_pipeline::{MakeError, Options, Progress, STAGES, Sink, strokes};

impl ProcessMaker {
    /// Makes a photo in a process that is killed if the photo is unwanted or late.
    pub(super) fn make_photo(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, Fault> {
        let strokes = strokes::write(&options.strokes);
        let mut files = vec![strokes.as_slice(), photo];
        files.extend(depth);
        let work = Work::Make(photo_options::to_text(options));
        self.ask(self.take(false)?, (&work, &files), sink, |answer, files| match (answer, <[_; 3]>::try_from(files)) {
            (Answer::Made(report), Ok([container, disparity, thumbnail])) => {
                Some(Product { container, report: *report, disparity, thumbnail })
            }
            _ => None,
        })
    }

    /// Writes a file in a process that is killed if the file is unwanted or late.
    pub(super) fn write_file(&self, task: &ExportTask<'_>, sink: &dyn Sink) -> Result<Vec<u8>, Fault> {
        let work = Work::Write(task.recipe.text());
        self.ask(self.take(task.is_low_priority)?, (&work, &[task.container]), sink, |answer, files| {
            match (answer, <[_; 1]>::try_from(files)) {
                (Answer::Written(_), Ok([bytes])) => Some(bytes),
                _ => None,
            }
        })
    }

    /// Sends work with its files to `worker` and waits for an answer, until the work is done, refused, cancelled or late. `made` takes the
    /// answer, unless it does not belong to the work. Keeps the process for reuse if possible, else ends it.
    fn ask<T>(
        &self,
        mut worker: ChildProcess,
        (work, files): (&Work, &[&[u8]]),
        sink: &dyn Sink,
        made: impl Fn(Answer, Vec<Vec<u8>>) -> Option<T>,
    ) -> Result<T, Fault> {
        let (outcome, keep) = std::thread::scope(|scope| {
            let ChildProcess { child, input, output, .. } = &mut worker;
            // send on a thread: a process that does not read would block past deadline and cancellation
            let sending = std::thread::Builder::new().name("tmpi-sends".into()).spawn_scoped(scope, || {
                // if the process has ended, the end of its output shows it
                let _ = write(&mut *input, work, files);
            });
            if let Err(error) = sending {
                return (Err(Fault::Server(format!("cannot start a thread: {error}"))), false);
            }
            let (outcome, keep) = listen(child, output, work, sink, made).unwrap_or_else(|fault| (Err(fault), false));
            if !keep {
                // ends sending, and what the process started
                end(child);
            }
            (outcome, keep)
        });
        if keep {
            worker.made = Some(Instant::now());
            self.keep(worker);
        }
        outcome
    }
}

/// Waits for the answer to `work`. Returns the outcome, and whether the process can be reused.
///
/// # Errors
/// The process ended, was given up, or sent an invalid answer.
fn listen<T>(
    child: &mut Child,
    output: &Answers,
    work: &Work,
    sink: &dyn Sink,
    made: impl Fn(Answer, Vec<Vec<u8>>) -> Option<T>,
) -> Result<(Result<T, Fault>, bool), Fault> {
    // the photo may be the cause, so it must not block others forever
    let invalid = |what: &str| Fault::Crashed(format!("the process that made it answered what it should not: {what}"));
    let mut stage = STAGES[0];
    loop {
        if sink.cancelled() {
            return Err(Fault::Cancelled);
        }
        let (answer, files) = match output.recv_timeout(TICK) {
            Ok(Ok(received)) => received,
            Ok(Err(error)) if error.kind() == ErrorKind::InvalidData => return Err(invalid(&error.to_string())),
            Ok(Err(_)) | Err(RecvTimeoutError::Disconnected) => return Err(Fault::Crashed(ending(child))),
            Err(RecvTimeoutError::Timeout) if sink.deadline().is_some_and(|deadline| Instant::now() >= deadline) => {
                return Err(match work {
                    Work::Make(_) => MakeError::Late { stage }.into(),
                    Work::Write(_) => Fault::Photo(timeout_problem()),
                });
            }
            Err(RecvTimeoutError::Timeout) => continue,
        };
        let peak = match &answer {
            Answer::Progress(told) => {
                stage = STAGES.iter().find(|name| **name == told.stage).copied().unwrap_or(stage);
                sink.progress(&Progress { stage, step: told.step, steps: told.steps, elapsed_ms: told.elapsed_ms });
                continue;
            }
            // after a fault of its own, start a new one: a missing library may be installed by then
            Answer::Fault(fault) => return Ok((Err(fault.clone()), matches!(fault, Fault::Photo(_)))),
            Answer::Made(report) => report.peak_rss_bytes,
            Answer::Written(peak) => *peak,
        };
        let made = made(answer, files).ok_or_else(|| invalid("the result of other work"))?;
        return Ok((Ok(made), peak < KEPT_BYTES));
    }
}
