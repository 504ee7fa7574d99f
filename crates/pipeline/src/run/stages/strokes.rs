//! Touch-up of the disparity map.

use tmpi_core::Photo;

use super::WeightedDisparity;
use crate::run::{self, Context, MakeError};
use crate::strokes;

/// Stage that applies the strokes of the options to the disparity map. It runs before edges are snapped, so that the outlines of strokes
/// snap to those of the photo.
#[derive(Debug, Default)]
pub struct Strokes;

impl run::Stage for Strokes {
    const NAME: &'static str = "strokes";
    type Input<'a> = (&'a Photo, WeightedDisparity);
    type Output = WeightedDisparity;

    fn run(&mut self, (photo, mut map): (&Photo, WeightedDisparity), context: &mut Context) -> Result<WeightedDisparity, MakeError> {
        strokes::apply(photo, &mut map.delta, map.confidence.as_mut(), &context.options.strokes);
        context.report.input.strokes = context.options.strokes.len();
        Ok(map)
    }
}
