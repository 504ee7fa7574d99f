//! What such a process is asked, and how its answer is waited for: the same for photos and for files.

use std::io::{self, Write as _};
use std::process::{Child, ChildStdin};
use std::sync::mpsc::RecvTimeoutError;
use std::time::Instant;

use super::frames::kind;
use super::{Frames, KEPT_BYTES, ProcessMaker, TICK, Worker, end, ending};
use crate::server::maker::Fault;
use tmpi_pipeline::Sink;

/// What comes back for what is asked.
pub(super) trait Answer {
    /// What is made.
    type Made;

    /// Takes a frame that is no fault. Gives what is made once all of it is there, with the most bytes of memory that the process has had.
    ///
    /// # Errors
    /// What is wrong with the frame.
    fn take(&mut self, kind: u8, bytes: Vec<u8>) -> Result<Option<(Self::Made, u64)>, String>;

    /// The fault where the deadline passes.
    fn late(&self) -> Fault;
}

/// Why nothing was made.
enum Missed {
    /// The process says so, and waits for the next.
    Told(Fault),
    /// It ended, or was not waited for, or answers nonsense.
    Lost(Fault),
}

impl Missed {
    fn fault(self) -> Fault {
        let (Self::Told(fault) | Self::Lost(fault)) = self;
        fault
    }
}

impl ProcessMaker {
    /// Sends what is asked to `worker` and waits for `answer`, until it is there, refused, cancelled or late. The process is kept for the next
    /// where it may be, else ended.
    pub(super) fn ask<A: Answer>(
        &self,
        mut worker: Worker,
        send: impl FnOnce(&mut ChildStdin) -> io::Result<()> + Send,
        mut answer: A,
        sink: &dyn Sink,
    ) -> Result<A::Made, Fault> {
        let (outcome, keep) = std::thread::scope(|scope| {
            let Worker { child, input, output, .. } = &mut worker;
            // a process that does not read would hold up whoever writes to it, past deadline and cancellation
            let sending = std::thread::Builder::new().name("tmpi-sends".into()).spawn_scoped(scope, || {
                // where the process has ended, the end of its output tells
                let _ = send(&mut *input).and_then(|()| input.flush());
            });
            if let Err(error) = sending {
                return (Err(Fault::Server(format!("no thread can be started: {error}"))), false);
            }
            let outcome = listen(child, output, &mut answer, sink);
            let keep = match &outcome {
                Ok((_, peak)) => *peak < KEPT_BYTES,
                Err(Missed::Told(Fault::Photo(_))) => true,
                // after a fault of its own a fresh one begins anew: a library that was missing may be there
                Err(_) => false,
            };
            if !keep {
                // what is still being sent to it ends with it, and what it started
                end(child);
            }
            (outcome.map(|(made, _)| made).map_err(Missed::fault), keep)
        });
        if keep {
            worker.made = Some(Instant::now());
            self.keep(worker);
        }
        outcome
    }
}

/// Takes frames until there is an answer; gives it with the most memory that the process has had.
fn listen<A: Answer>(child: &mut Child, output: &Frames, answer: &mut A, sink: &dyn Sink) -> Result<(A::Made, u64), Missed> {
    // the photo may have brought it about, and must not hold up the others for ever
    let lost = |what: String| Missed::Lost(Fault::Crashed(format!("the process that made it answered what it should not: {what}")));
    loop {
        if sink.cancelled() {
            return Err(Missed::Lost(Fault::Cancelled));
        }
        let (kind, bytes) = match output.recv_timeout(TICK) {
            Ok(Ok(frame)) => frame,
            Ok(Err(_)) | Err(RecvTimeoutError::Disconnected) => return Err(Missed::Lost(Fault::Crashed(ending(child)))),
            Err(RecvTimeoutError::Timeout) => match sink.deadline() {
                Some(deadline) if Instant::now() >= deadline => return Err(Missed::Lost(answer.late())),
                _ => continue,
            },
        };
        if kind == kind::FAULT {
            return Err(Missed::Told(serde_json::from_slice(&bytes).map_err(|e| lost(e.to_string()))?));
        }
        if let Some(made) = answer.take(kind, bytes).map_err(lost)? {
            return Ok(made);
        }
    }
}
