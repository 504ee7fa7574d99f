//! Makes photos in a child process.

use super::ProcessMaker;
use super::exchange::Answer;
use super::pipe_frames::{StageFrame, kind, write};
use crate::server::maker::{Fault, Product};
use crate::server::photo_options;
use tmpi_pipeline::{MakeError, Options, Progress, STAGES, Sink, strokes};

impl ProcessMaker {
    /// Makes a photo in a process that is killed if the photo is unwanted or late.
    pub(super) fn make_photo(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, Fault> {
        let worker = self.take(false)?;
        let strokes = strokes::write(&options.strokes);
        let options = serde_json::to_vec(&photo_options::to_text(options)).map_err(|e| Fault::Server(e.to_string()))?;
        self.ask(
            worker,
            |input| {
                write(input, kind::OPTIONS, &options)?;
                write(input, kind::STROKES, &strokes)?;
                write(input, kind::PHOTO, photo)?;
                depth.map_or(Ok(()), |depth| write(input, kind::DEPTH, depth))?;
                write(input, kind::MAKE, &[])
            },
            Made { product: Product::default(), stage: STAGES[0], sink },
            sink,
        )
    }
}

/// A photo, as its frames arrive.
struct Made<'a> {
    product: Product,
    stage: &'static str,
    sink: &'a dyn Sink,
}

impl Answer for Made<'_> {
    type Made = Product;

    fn take(&mut self, kind: u8, bytes: Vec<u8>) -> Result<Option<(Product, u64)>, String> {
        let Self { product, stage, sink } = self;
        match kind {
            kind::PROGRESS => {
                let told: StageFrame = serde_json::from_slice(&bytes).map_err(|e| e.to_string())?;
                *stage = STAGES.iter().find(|s| **s == told.stage).copied().unwrap_or(stage);
                sink.progress(&Progress { stage, step: told.step, steps: told.steps, elapsed_ms: told.elapsed_ms });
            }
            kind::CONTAINER => product.container = bytes,
            kind::DISPARITY => product.disparity = bytes,
            kind::THUMBNAIL => product.thumbnail = bytes,
            kind::REPORT => {
                product.report = serde_json::from_slice(&bytes).map_err(|e| e.to_string())?;
                let peak = product.report.peak_rss_bytes;
                return Ok(Some((std::mem::take(product), peak)));
            }
            other => return Err(format!("a frame of kind {other}")),
        }
        Ok(None)
    }

    fn late(&self) -> Fault {
        MakeError::Late { stage: self.stage }.into()
    }
}
