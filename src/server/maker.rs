//! What the server asks of the way of a photo, as a seam for tests.

use std::time::Duration;

use tmpi_core::container::{self, ContainerError};
use tmpi_pipeline::Report;
use tmpi_pipeline::Sink;
use tmpi_pipeline::depth::DepthError;
use tmpi_pipeline::photo::{self, Head};
use tmpi_pipeline::strokes;
use tmpi_pipeline::{self, MakeError, Models, Options, Stereo};
use tmpi_render::{DEFAULT_QUALITY, PictureFormat, View, encode};

use super::exports::Work;
use super::identity;
use super::limits::Limits;
use super::network::Offer;
use super::problem::Problem;

/// Everything that is kept of a made photo.
#[derive(Clone, Debug, Default)]
pub struct Product {
    /// The container.
    pub container: Vec<u8>,
    /// The report.
    pub report: Report,
    /// Disparity as used, 16-bit grey PNG; where strokes went over it with the map of before within, see [`tmpi_pipeline::strokes::keep`].
    pub disparity: Vec<u8>,
    /// Small JPEG.
    pub thumbnail: Vec<u8>,
}

/// Why a photo was not made.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub enum Fault {
    /// The photo, its depth map or an option is at fault: another try would end the same way.
    Photo(Problem),
    /// The photo took down what made it, as the text says; after some tries it is given up.
    Crashed(String),
    /// The server is at fault, as the text says: no library, no room, no device. The photo is made once that is mended.
    Server(String),
    /// Nobody wants it any more, or the server stops.
    Cancelled,
}

/// What bytes are the first of.
#[derive(Clone, Copy, Debug)]
pub enum HeadOf<'a> {
    /// A photo, with all options that it comes with.
    Photo(&'a Options),
    /// A photo, where other options than these may follow.
    PhotoSoFar(&'a Options),
    /// A depth map.
    Depth,
    /// The picture of a second eye.
    Second,
}

/// Makes photos.
pub trait Maker: Send + Sync + 'static {
    /// What its products depend on besides what is uploaded: part of a photo's id, so that a better maker makes a photo anew.
    fn identity(&self) -> &str {
        identity::PIPELINE
    }

    /// Name of the network that estimates depth, as reports tell it; a maker that has no other name for it gives its identity.
    fn network(&self) -> &str {
        self.identity()
    }

    /// A better network that may be fetched; none where there is none, or it is here.
    fn better(&self) -> Option<Offer> {
        None
    }

    /// Fetches it, and has photos made with it from then on; blocks. `progress` is told the bytes that are here.
    ///
    /// # Errors
    /// Why it is not here, in words.
    fn fetch_better(&self, _progress: &mut dyn FnMut(u64)) -> Result<(), String> {
        Err("there is no better network".into())
    }

    /// Refuses early, before any work, what [`Maker::make`] would refuse for its format, its size, its depth map or its options.
    ///
    /// # Errors
    /// [`MakeError`].
    fn check(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> Result<(), MakeError>;

    /// Refuses the same of a file of which the first bytes are `head`, while the rest is on its way. Gives how many bytes from the first it
    /// needs to tell more, which are more than there are; none where only the whole tells more. It is asked on threads that may not block.
    ///
    /// # Errors
    /// As [`Maker::check`].
    fn check_head(&self, _of: HeadOf<'_>, _head: &[u8]) -> Result<Option<usize>, MakeError> {
        Ok(None)
    }

    /// Memory that making a photo takes at most, in bytes; it is asked only of what was checked.
    fn memory(&self, _photo: &[u8], _depth: Option<&[u8]>, _options: &Options) -> u64 {
        0
    }

    /// What is missing without which photos wait, for people; it is asked now and then.
    fn lacks(&self) -> Option<&'static str> {
        None
    }

    /// Gives memory back that was not used over `rest`; says whether there was some.
    fn rest(&self, _rest: Duration) -> bool {
        false
    }

    /// Writes a file of a made photo; blocks. This one does so in this process.
    ///
    /// # Errors
    /// [`Fault`].
    fn export(&self, work: &Work<'_>, sink: &dyn Sink) -> Result<Vec<u8>, Fault> {
        work.here(sink)
    }

    /// Makes a photo; blocks.
    ///
    /// # Errors
    /// [`Fault`].
    fn make(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, Fault>;
}

/// The real way of a photo.
pub struct PipelineMaker {
    models: Models,
    limits: photo::Limits,
    identity: String,
}

impl PipelineMaker {
    /// A maker with the networks and the limits of photos.
    #[must_use]
    pub fn new(models: Models, limits: photo::Limits) -> Self {
        Self { models, limits, identity: identity::PIPELINE.into() }
    }

    /// Memory that photos may take, in bytes.
    #[must_use]
    pub fn most_memory(&self) -> u64 {
        self.limits.memory
    }

    /// With networks that `text` tells from others.
    #[must_use]
    pub fn identified(self, text: &str) -> Self {
        Self { identity: format!("{} {text}", identity::PIPELINE), ..self }
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
        // first what is told while it comes in, so that it is told alike of one that is whole
        self.check_head(HeadOf::Photo(options), photo)?;
        options.stereo.check(photo, depth.is_some())?;
        let (size, map) = self.sizes(photo, depth, options)?;
        self.check_size(size, map, options)
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
            (HeadOf::Photo(options), Head::Size(w, h)) => self.check_size((w, h), None, options)?,
            (HeadOf::PhotoSoFar(options), Head::Size(w, h)) => options.check_decoded((w, h), &self.limits)?,
            (HeadOf::Depth | HeadOf::Second, Head::Size(..)) | (_, Head::Silent) => {}
        }
        Ok(None)
    }

    fn memory(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> u64 {
        let need = self.sizes(photo, depth, options).and_then(|(size, map)| Ok(options.fitted(size, map, &self.limits)?.memory(size, map)));
        // what cannot be read, or is refused, takes nothing
        need.unwrap_or(0)
    }

    fn make(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, Fault> {
        Ok(self.product(photo, depth, options, sink)?)
    }
}

/// Width and height of a photo as its file has them, and those of its depth map.
type Sizes = ((u32, u32), Option<(u32, u32)>);

impl PipelineMaker {
    /// Sizes by the headers alone.
    fn sizes(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> Result<Sizes, MakeError> {
        let (_, size) = photo::check(photo, &self.limits)?;
        let map = depth.map(|depth| match options.stereo {
            Stereo::Beside => photo::check(depth, &self.limits).map(|(_, size)| size).map_err(|e| DepthError::Second(e.to_string())),
            _ => tmpi_pipeline::depth::check(depth, &self.limits),
        });
        let map = map.transpose()?;
        Ok((size, map))
    }

    /// Refuses sizes that take too much with `options`, or lead to what no reader takes.
    fn check_size(&self, size: (u32, u32), map: Option<(u32, u32)>, options: &Options) -> Result<(), MakeError> {
        let options = options.fitted(size, map, &self.limits)?;
        let (width, height) = photo::reduced_size(size, options.max_size);
        Ok(options.check_readable(width, height)?)
    }

    fn product(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, MakeError> {
        let (size, map) = self.sizes(photo, depth, options)?;
        let fitted = options.fitted(size, map, &self.limits)?;
        let mut made = tmpi_pipeline::make(&self.models, &self.limits, photo, depth, &fitted, sink)?;
        made.report.input.fitted = fitted.max_size != options.max_size;
        // what cannot be read back is not published; layers follow from what is read here
        let (photo, _) = container::read(&made.container)?;
        let (width, height) = photo::reduced_size((photo.width, photo.height), Some(Limits::THUMBNAIL));
        let small = photo::resize(&photo, width, height);
        let disparity = tmpi_pipeline::depth::to_png(&made.disparity)?;
        let disparity = match &made.before_strokes {
            Some(before) => strokes::keep(&disparity, before)?,
            None => disparity,
        };
        Ok(Product {
            thumbnail: encode(&View::from(&small), PictureFormat::Jpeg, DEFAULT_QUALITY)
                .map_err(|e| ContainerError::Encode(e.to_string()))?,
            disparity,
            container: made.container,
            report: made.report,
        })
    }
}
