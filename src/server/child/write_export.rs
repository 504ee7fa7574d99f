//! Writes export files in a child process.

use super::ProcessMaker;
use super::exchange::Answer;
use super::pipe_frames::{kind, write};
use crate::server::exports::{ExportTask, timeout_problem};
use crate::server::maker::Fault;
use tmpi_pipeline::Sink;

impl ProcessMaker {
    /// Writes a file in a process that is killed if the file is unwanted or late.
    pub(super) fn write_file(&self, work: &ExportTask<'_>, sink: &dyn Sink) -> Result<Vec<u8>, Fault> {
        let recipe = work.recipe.text();
        let worker = self.take(work.is_low_priority)?;
        self.ask(
            worker,
            |input| write(input, kind::RECIPE, recipe.as_bytes()).and_then(|()| write(input, kind::WRITE, work.container)),
            Written { peak: u64::MAX },
            sink,
        )
    }
}

/// A file, as its frames arrive.
struct Written {
    /// Peak memory of the process in bytes; the maximum until it is known.
    peak: u64,
}

impl Answer for Written {
    type Made = Vec<u8>;

    fn take(&mut self, kind: u8, bytes: Vec<u8>) -> Result<Option<(Vec<u8>, u64)>, String> {
        match kind {
            kind::PEAK => self.peak = bytes.try_into().map(u64::from_le_bytes).map_err(|_| "no peak")?,
            kind::FILE => return Ok(Some((bytes, self.peak))),
            other => return Err(format!("a frame of kind {other}")),
        }
        Ok(None)
    }

    fn late(&self) -> Fault {
        Fault::Photo(timeout_problem())
    }
}
