//! Files to download, written in such a process.

use std::io::Write as _;
use std::process::{Child, ChildStdin};
use std::sync::mpsc::RecvTimeoutError;
use std::time::Instant;

use super::frames::{kind, write};
use super::{Answer, Frames, KEPT_BYTES, ProcessMaker, TICK, Worker, end, ending};
use crate::server::exports::{Work, late};
use crate::server::maker::Fault;
use tmpi_pipeline::Sink;

impl ProcessMaker {
    /// Writes a file in a process that is ended once nobody wants it, or its time is over.
    pub(super) fn write_file(&self, work: &Work<'_>, sink: &dyn Sink) -> Result<Vec<u8>, Fault> {
        let mut worker = self.take(work.gives_way)?;
        let recipe = work.recipe.text();
        let (outcome, keep) = std::thread::scope(|scope| {
            let Worker { child, input, output, .. } = &mut worker;
            // a process that does not read would hold up whoever writes to it
            let sending = std::thread::Builder::new()
                .name("tmpi-sends".into())
                .spawn_scoped(scope, || send(input, recipe.as_bytes(), work.container));
            if let Err(error) = sending {
                return (Err(Fault::Server(format!("no thread can be started: {error}"))), false);
            }
            let outcome = listen(child, output, sink);
            let keep = match &outcome {
                Ok((_, peak)) => *peak < KEPT_BYTES,
                Err(Answer::Told(Fault::Photo(_))) => true,
                Err(_) => false,
            };
            if !keep {
                // what is still being sent to it ends with it, and what it started
                end(child);
            }
            (outcome.map(|(bytes, _)| bytes).map_err(Answer::fault), keep)
        });
        if keep {
            worker.made = Some(Instant::now());
            self.keep(worker);
        }
        outcome
    }
}

fn send(input: &mut ChildStdin, recipe: &[u8], container: &[u8]) {
    // where the process has ended, the end of its output tells
    let _ = write(input, kind::RECIPE, recipe).and_then(|()| write(input, kind::WRITE, container)).and_then(|()| input.flush());
}

/// Takes frames until the file is written, refused, cancelled or late; with the most memory that the process has had.
fn listen(child: &mut Child, output: &Frames, sink: &dyn Sink) -> Result<(Vec<u8>, u64), Answer> {
    let lost = |what: String| Answer::Lost(Fault::Crashed(format!("the process that wrote it answered what it should not: {what}")));
    let mut peak = u64::MAX;
    loop {
        if sink.cancelled() {
            return Err(Answer::Lost(Fault::Cancelled));
        }
        let (kind, bytes) = match output.recv_timeout(TICK) {
            Ok(Ok(frame)) => frame,
            Ok(Err(_)) | Err(RecvTimeoutError::Disconnected) => return Err(Answer::Lost(Fault::Crashed(ending(child)))),
            Err(RecvTimeoutError::Timeout) => match sink.deadline() {
                Some(deadline) if Instant::now() >= deadline => return Err(Answer::Lost(Fault::Photo(late()))),
                _ => continue,
            },
        };
        match kind {
            kind::PEAK => peak = bytes.try_into().map(u64::from_le_bytes).map_err(|_| lost("no peak".into()))?,
            kind::FILE => return Ok((bytes, peak)),
            kind::FAULT => return Err(Answer::Told(serde_json::from_slice(&bytes).map_err(|e| lost(e.to_string()))?)),
            other => return Err(lost(format!("a frame of kind {other}"))),
        }
    }
}
