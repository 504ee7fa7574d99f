//! Runs all stages on one photo.

use super::stages::{Denoise, Depth, Encode, Layers, Planes, Prepare, Refine, Snap, Source, Strokes, Verify};
use super::{Context, Made, MakeError, Models, Options, Sink, Sizes};
use crate::photo::Limits;
use crate::stereo::Stereo;
use crate::strokes;

/// Makes a photo: runs all stages and returns the container and the report. `depth` is the file of your own depth map, if any, or of the
/// second picture with [`crate::Stereo::Beside`].
///
/// # Errors
/// [`MakeError`] if the photo, `depth` or an option is invalid, a network or stage fails, the caller cancels, or the deadline passes.
pub fn make(
    models: &Models,
    limits: &Limits,
    photo: &[u8],
    depth: Option<&[u8]>,
    options: &Options,
    sink: &dyn Sink,
) -> Result<Made, MakeError> {
    options.validate()?;
    models.check(options)?;
    let mut job = Context::new(models, limits, options, sink);
    let source = Source::choose(photo, depth, &mut job)?;
    job.sizes = Some(Sizes::of(photo, depth, options, limits)?);
    let estimated = matches!(source, Source::Network) && options.stereo != Stereo::Rgbd;
    let mut prepared = job.run(&mut Prepare, (photo, estimated))?;
    let source = source.or_half(prepared.second_half.take(), options.stereo);
    let map = job.run(&mut Depth::default(), (&prepared.photo, source))?;
    let map = job.run(&mut Denoise, (&prepared.photo, map))?;
    let before_strokes = (!options.strokes.is_empty()).then(|| strokes::to_keep(&map.delta));
    let map = if options.strokes.is_empty() { map } else { job.run(&mut Strokes, (&prepared.photo, map))? };
    let map = job.run(&mut Snap, (&prepared.photo, map))?;
    let placed = job.run(&mut Planes::default(), (&prepared, &map))?;
    let layered = job.run(&mut Layers, (&mut prepared, placed, &map.delta))?;
    let layered = job.run(&mut Refine, layered)?;
    let encoded = job.run(&mut Encode, layered)?;
    job.run(&mut Verify, (&prepared.photo, &encoded))?;
    Ok(Made { container: encoded.container, report: job.finish(), disparity: map.delta, before_strokes })
}
