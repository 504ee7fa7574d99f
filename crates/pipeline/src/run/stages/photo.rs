//! Checks and decodes the photo, turns it upright and scales it down.

use tmpi_core::container::PhotoFormat;
use tmpi_core::{Intrinsics, Photo};

use crate::photo::{self, Decoded};
use crate::run::time_budget::Costs;
use crate::run::{Context, Input, MakeError, Parallax};

/// A decoded photo, as the other stages need it.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// Pixels.
    pub photo: Photo,
    /// The reference camera.
    pub intrinsics: Intrinsics,
    /// Format of the uploaded file.
    pub format: PhotoFormat,
    /// The uploaded file without metadata, if it shows the same picture as `photo`.
    pub uploaded: Option<Vec<u8>>,
    /// Longest side in pixels that a time budget chose, if it reduced the photo.
    pub reduced: Option<u32>,
    /// The second picture, or the depth map, if the file holds two in halves.
    pub second_half: Option<Photo>,
}

/// Stage from the bytes of a file to photo and camera. `estimated` says whether the network estimates its depth.
pub(crate) fn prepare(context: &mut Context, file: &[u8], estimated: bool) -> Result<Prepared, MakeError> {
    let stage = context.begin("photo")?;
    let options = context.options;
    let reduced = match options.budget_ms {
        Some(budget) => {
            let size = photo::reduced_size(photo::check(file, context.limits)?.1, options.max_size);
            Costs::of_this_machine().side(budget, size, estimated)
        }
        None => None,
    };
    let most = reduced.or(options.max_size);
    let most =
        if let Some((side, halves)) = most.zip(options.stereo.halves()) { Some(halves.of_both(file, context.limits, side)?) } else { most };
    let decoded = photo::decode(file, context.limits, most)?;
    let Decoded { mut photo, original, format, mut intrinsics, stripped: mut uploaded, damaged, reduction, .. } = decoded;
    let mut second_half = None;
    if let Some((first, second)) = options.stereo.halves().and_then(|halves| halves.split(&photo)) {
        let focal = intrinsics.fx * f64::from(first.width) / f64::from(photo.width);
        intrinsics = Intrinsics::centred(first.width, first.height, focal);
        (photo, second_half, uploaded) = (first, Some(second), None);
    }
    options.check_readable(photo.width, photo.height)?;
    if let Some(fov) = options.fov_x {
        intrinsics = Intrinsics::from_fov_x(photo.width, photo.height, fov);
    }
    context.report.input = Input { width: original.0, height: original.1, bytes: file.len(), damaged, ..context.report.input.clone() };
    (context.report.width, context.report.height) = (photo.width, photo.height);
    context.report.error.reduction = reduction;
    context.movement = Some(Parallax::new(intrinsics, options.view_box));
    context.end(stage);
    Ok(Prepared { photo, intrinsics, format, uploaded, reduced, second_half })
}
