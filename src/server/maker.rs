//! The [`Maker`] trait: what the server needs to make photos, replaceable in tests.

use std::time::Duration;

use tmpi_core::container::{self, ContainerError};
use tmpi_pipeline::depth::DepthError;
use tmpi_pipeline::photo::{self, Head};
use tmpi_pipeline::{self, MakeError, Models, Options, Report, Sink, Sizes, strokes};
use tmpi_render::{DEFAULT_QUALITY, PictureFormat, View, encode};

use super::depth_network_download::NetworkOffer;
use super::exports::ExportTask;
use super::limits::Limits;
use super::problem::Problem;
use super::program_digest;

/// The stored results of a photo.
#[derive(Clone, Debug, Default)]
pub struct Product {
    /// The container.
    pub container: Vec<u8>,
    /// The report.
    pub report: Report,
    /// Disparity as used, 16-bit grey PNG; with strokes it contains the map before them, see [`tmpi_pipeline::strokes::keep`].
    pub disparity: Vec<u8>,
    /// Small JPEG.
    pub thumbnail: Vec<u8>,
}

/// Why a photo was not made.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub enum Fault {
    /// The photo, its depth map or an option is at fault; a retry would fail, too.
    Photo(Problem),
    /// The photo crashed the process, as the text says; it fails after some tries.
    Crashed(String),
    /// The server is at fault, as the text says: no library, no space, no device. The photo is made once that is fixed.
    Server(String),
    /// The photo is unwanted, or the server stops.
    Cancelled,
}

/// What the first bytes belong to.
#[derive(Clone, Copy, Debug)]
pub enum HeadOf<'a> {
    /// A photo, with all its options.
    Photo(&'a Options),
    /// A photo; further options may follow.
    PhotoSoFar(&'a Options),
    /// A depth map.
    Depth,
    /// The picture of a second eye.
    Second,
}

/// Makes photos.
pub trait Maker: Send + Sync + 'static {
    /// What its results depend on besides the upload. It is part of a photo's id, so that a better maker makes photos anew.
    fn identity(&self) -> &str {
        program_digest::PIPELINE
    }

    /// Name of the depth network, as in reports; the identity by default.
    fn network(&self) -> &str {
        self.identity()
    }

    /// A better network to download; `None` if there is none, or it is installed.
    fn better(&self) -> Option<NetworkOffer> {
        None
    }

    /// Downloads it and uses it from then on; blocks. Calls `progress` with the bytes downloaded so far.
    ///
    /// # Errors
    /// Why the download failed, as text.
    fn download_better(&self, _progress: &mut dyn FnMut(u64)) -> Result<(), String> {
        Err("there is no better network".into())
    }

    /// Refuses early what [`Maker::make`] would refuse for its format, size, depth map or options.
    ///
    /// # Errors
    /// [`MakeError`].
    fn check(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> Result<(), MakeError>;

    /// Makes the same checks on the first bytes of a file, `head`, while the rest arrives. Returns how many bytes from the start it needs
    /// for further checks (more than `head` has); `None` if those need the whole file. Runs on threads that must not block.
    ///
    /// # Errors
    /// As [`Maker::check`].
    fn check_head(&self, _of: HeadOf<'_>, _head: &[u8]) -> Result<Option<usize>, MakeError> {
        Ok(None)
    }

    /// Most memory that making a photo takes, in bytes; only called for checked photos.
    fn memory(&self, _photo: &[u8], _depth: Option<&[u8]>, _options: &Options) -> u64 {
        0
    }

    /// What is missing so that photos wait, for people; called periodically.
    fn lacks(&self) -> Option<&'static str> {
        None
    }

    /// Frees memory that was unused for `idle_time`; returns whether there was some.
    fn release_idle_memory(&self, _idle_time: Duration) -> bool {
        false
    }

    /// Writes an export file; blocks. By default in this process.
    ///
    /// # Errors
    /// [`Fault`].
    fn export(&self, work: &ExportTask<'_>, sink: &dyn Sink) -> Result<Vec<u8>, Fault> {
        work.run(sink)
    }

    /// Makes a photo; blocks.
    ///
    /// # Errors
    /// [`Fault`].
    fn make(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, Fault>;
}

/// The maker that runs the pipeline.
pub struct PipelineMaker {
    models: Models,
    limits: photo::Limits,
    identity: String,
}

impl PipelineMaker {
    /// A maker with these networks and limits.
    pub fn new(models: Models, limits: photo::Limits) -> Self {
        Self { models, limits, identity: program_digest::PIPELINE.into() }
    }

    /// Memory for making photos, in bytes.
    pub fn max_memory(&self) -> u64 {
        self.limits.memory
    }

    /// With networks that `text` identifies.
    pub fn with_identity(self, text: &str) -> Self {
        Self { identity: format!("{} {text}", program_digest::PIPELINE), ..self }
    }
}

impl Maker for PipelineMaker {
    fn identity(&self) -> &str {
        &self.identity
    }

    fn network(&self) -> &str {
        self.models.depth.name()
    }

    fn check(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> Result<(), MakeError> {
        // the checks of the upload's head come first, so that a whole file gets the same errors
        self.check_head(HeadOf::Photo(options), photo)?;
        options.stereo.check(photo, depth.is_some())?;
        self.check_size(&Sizes::of(photo, depth, options, &self.limits)?, options)
    }

    fn check_head(&self, of: HeadOf<'_>, head: &[u8]) -> Result<Option<usize>, MakeError> {
        if let HeadOf::Photo(options) = of {
            options.validate()?;
            self.models.check(options)?;
        }
        let told = match of {
            HeadOf::Photo(_) | HeadOf::PhotoSoFar(_) => photo::head(head, &self.limits)?,
            HeadOf::Depth => tmpi_pipeline::depth::head(head, &self.limits)?,
            HeadOf::Second => photo::head(head, &self.limits).map_err(|e| DepthError::Second(e.to_string()))?,
        };
        match (of, told) {
            (_, Head::Needs(bytes)) => return Ok(Some(bytes)),
            (HeadOf::Photo(options), Head::Size(w, h)) => self.check_size(&Sizes::of_photo((w, h)), options)?,
            (HeadOf::PhotoSoFar(options), Head::Size(w, h)) => options.check_decoded((w, h), &self.limits)?,
            (HeadOf::Depth | HeadOf::Second, Head::Size(..)) | (_, Head::Silent) => {}
        }
        Ok(None)
    }

    fn memory(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> u64 {
        let sizes = Sizes::of(photo, depth, options, &self.limits);
        let need = sizes.and_then(|sizes| Ok(options.fitted(&sizes, &self.limits)?.memory(&sizes)));
        // unreadable or refused photos take nothing
        need.unwrap_or(0)
    }

    fn make(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, Fault> {
        Ok(self.product(photo, depth, options, sink)?)
    }
}

impl PipelineMaker {
    /// Refuses sizes that take too much with `options`, or give containers that no reader accepts.
    fn check_size(&self, sizes: &Sizes, options: &Options) -> Result<(), MakeError> {
        let options = options.fitted(sizes, &self.limits)?;
        let (width, height) = photo::reduced_size(options.photo_size(sizes.file), options.max_size);
        Ok(options.check_readable(width, height)?)
    }

    fn product(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, MakeError> {
        let fitted = options.fitted(&Sizes::of(photo, depth, options, &self.limits)?, &self.limits)?;
        let mut made = tmpi_pipeline::make(&self.models, &self.limits, photo, depth, &fitted, sink)?;
        made.report.input.fitted = fitted.max_size != options.max_size;
        let (thumbnail, disparity) = rayon::join(|| thumbnail(&made.container), || tmpi_pipeline::depth::to_png(&made.disparity));
        let disparity = disparity?;
        let disparity = match &made.before_strokes {
            Some(before) => strokes::keep(&disparity, before)?,
            None => disparity,
        };
        Ok(Product { thumbnail: thumbnail?, disparity, container: made.container, report: made.report })
    }
}

/// A small JPEG file of a container's photo. Reads the whole container, to publish only what can be read back.
fn thumbnail(bytes: &[u8]) -> Result<Vec<u8>, ContainerError> {
    // layers follow from what is read here
    let (photo, _) = container::read(bytes)?;
    let (width, height) = photo::reduced_size((photo.width, photo.height), Some(Limits::THUMBNAIL));
    let small = photo::resize(&photo, width, height);
    encode(&View::from(&small), PictureFormat::Jpeg, DEFAULT_QUALITY).map_err(|e| ContainerError::Encode(e.to_string()))
}
