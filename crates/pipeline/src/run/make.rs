//! The driver of a photo.

use super::stages::{Denoise, Depth, Encode, Layers, Planes, Prepare, Refine, Snap, Source, Strokes, Verify};
use super::{Context, Made, MakeError, Models, Options, Sink, Sizes};
use crate::photo::Limits;
use crate::strokes;

/// Runs a photo through all stages. `depth` is the user's own depth map as a picture file, if there is one; or
/// the picture of the second eye, where [`crate::Stereo::Beside`] is chosen.
///
/// # Errors
/// [`MakeError`]: the photo, the depth map, an option, or a network is at fault, or the caller has given up.
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
    let mut prepared = job.run(&mut Prepare, (photo, matches!(source, Source::Network)))?;
    let source = source.or_half(prepared.other_eye.take());
    let map = job.run(&mut Depth::default(), (&prepared.photo, source))?;
    let map = job.run(&mut Denoise, (&prepared.photo, map))?;
    let before_strokes = (!options.strokes.is_empty()).then(|| strokes::to_keep(&map.delta));
    let map = if options.strokes.is_empty() { map } else { job.run(&mut Strokes, (&prepared.photo, map))? };
    let map = job.run(&mut Snap, (&prepared.photo, map))?;
    let placed = job.run(&mut Planes::default(), (&prepared, &map))?;
    let layered = job.run(&mut Layers, (&mut prepared, placed, &map.delta))?;
    let layered = job.run(&mut Refine, (&prepared.photo, layered))?;
    let encoded = job.run(&mut Encode, (prepared.photo, layered))?;
    job.run(&mut Verify, &encoded)?;
    Ok(Made { container: encoded.container, report: job.finish(), disparity: map.delta, before_strokes })
}
