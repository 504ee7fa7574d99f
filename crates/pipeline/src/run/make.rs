//! Runs all stages on one photo.

use super::stages::{self, Source};
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
    let mut prepared = stages::prepare(&mut job, photo, estimated)?;
    let source = source.or_half(prepared.second_half.take(), options.stereo);
    let map = stages::find_disparity(&mut job, &prepared.photo, source, None)?;
    let map = stages::remove_noise(&mut job, &prepared.photo, map)?;
    let before_strokes = (!options.strokes.is_empty()).then(|| strokes::to_keep(&map.delta));
    let map = if options.strokes.is_empty() { map } else { stages::apply_strokes(&mut job, &prepared.photo, map)? };
    let map = stages::snap_and_widen(&mut job, &prepared.photo, map)?;
    let placed = stages::place_planes(&mut job, &prepared, &map)?;
    let layered = stages::make_layers(&mut job, &mut prepared, placed, &map.delta)?;
    let layered = stages::refine_layers(&mut job, layered)?;
    let encoded = stages::encode_scene(&mut job, layered)?;
    stages::verify_container(&mut job, &prepared.photo, &encoded)?;
    Ok(Made { container: encoded.container, report: job.finish(), disparity: map.delta, before_strokes })
}
