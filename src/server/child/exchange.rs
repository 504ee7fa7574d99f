//! Sends work to a child process and waits for the answer, for photos and for files.

use std::io::{self, Write as _};
use std::process::{Child, ChildStdin};
use std::sync::mpsc::RecvTimeoutError;
use std::time::Instant;

use super::pipe_frames::kind;
use super::{ChildProcess, Frames, KEPT_BYTES, ProcessMaker, TICK, end, ending};
use crate::server::maker::Fault;
use tmpi_pipeline::Sink;

/// The answer of a process.
pub(super) trait Answer {
    /// What is made.
    type Made;

    /// Takes a frame that is no fault. Returns the result once it is complete, with the peak memory of the process in bytes.
    ///
    /// # Errors
    /// What is wrong with the frame.
    fn take(&mut self, kind: u8, bytes: Vec<u8>) -> Result<Option<(Self::Made, u64)>, String>;

    /// The fault if the deadline passes.
    fn late(&self) -> Fault;
}

/// Why there is no result.
enum NoResult {
    /// The process reported it, and waits for the next work.
    Reported(Fault),
    /// The process ended, was given up, or sent an invalid answer.
    Lost(Fault),
}

impl NoResult {
    fn fault(self) -> Fault {
        let (Self::Reported(fault) | Self::Lost(fault)) = self;
        fault
    }
}

impl ProcessMaker {
    /// Sends work to `worker` and waits for `answer`, until it is complete, refused, cancelled or late. Keeps the process for reuse if
    /// possible, else ends it.
    pub(super) fn ask<A: Answer>(
        &self,
        mut worker: ChildProcess,
        send: impl FnOnce(&mut ChildStdin) -> io::Result<()> + Send,
        mut answer: A,
        sink: &dyn Sink,
    ) -> Result<A::Made, Fault> {
        let (outcome, keep) = std::thread::scope(|scope| {
            let ChildProcess { child, input, output, .. } = &mut worker;
            // send on a thread: a process that does not read would block past deadline and cancellation
            let sending = std::thread::Builder::new().name("tmpi-sends".into()).spawn_scoped(scope, || {
                // if the process has ended, the end of its output shows it
                let _ = send(&mut *input).and_then(|()| input.flush());
            });
            if let Err(error) = sending {
                return (Err(Fault::Server(format!("cannot start a thread: {error}"))), false);
            }
            let outcome = listen(child, output, &mut answer, sink);
            let keep = match &outcome {
                Ok((_, peak)) => *peak < KEPT_BYTES,
                Err(NoResult::Reported(Fault::Photo(_))) => true,
                // after a fault of its own, start a new one: a missing library may be installed by then
                Err(_) => false,
            };
            if !keep {
                // ends sending, and what the process started
                end(child);
            }
            (outcome.map(|(made, _)| made).map_err(NoResult::fault), keep)
        });
        if keep {
            worker.made = Some(Instant::now());
            self.keep(worker);
        }
        outcome
    }
}

/// Takes frames until the answer is complete; returns it with the peak memory of the process.
fn listen<A: Answer>(child: &mut Child, output: &Frames, answer: &mut A, sink: &dyn Sink) -> Result<(A::Made, u64), NoResult> {
    // the photo may be the cause, so it must not block others forever
    let lost = |what: String| NoResult::Lost(Fault::Crashed(format!("the process that made it answered what it should not: {what}")));
    loop {
        if sink.cancelled() {
            return Err(NoResult::Lost(Fault::Cancelled));
        }
        let (kind, bytes) = match output.recv_timeout(TICK) {
            Ok(Ok(frame)) => frame,
            Ok(Err(_)) | Err(RecvTimeoutError::Disconnected) => return Err(NoResult::Lost(Fault::Crashed(ending(child)))),
            Err(RecvTimeoutError::Timeout) => match sink.deadline() {
                Some(deadline) if Instant::now() >= deadline => return Err(NoResult::Lost(answer.late())),
                _ => continue,
            },
        };
        if kind == kind::FAULT {
            return Err(NoResult::Reported(serde_json::from_slice(&bytes).map_err(|e| lost(e.to_string()))?));
        }
        if let Some(made) = answer.take(kind, bytes).map_err(lost)? {
            return Ok(made);
        }
    }
}
