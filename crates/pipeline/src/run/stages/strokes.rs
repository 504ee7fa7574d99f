//! What a person put right.

use tmpi_core::Photo;

use super::Estimated;
use crate::run::{self, Context, MakeError};
use crate::strokes;

/// The strokes of the options applied to a disparity map. Before its edges are snapped, so that outlines go where those of the photo are.
#[derive(Debug, Default)]
pub struct Strokes;

impl run::Stage for Strokes {
    const NAME: &'static str = "strokes";
    type Input<'a> = (&'a Photo, Estimated);
    type Output = Estimated;

    fn run(&mut self, (photo, mut map): (&Photo, Estimated), context: &mut Context) -> Result<Estimated, MakeError> {
        strokes::apply(photo, &mut map.delta, map.confidence.as_mut(), &context.options.strokes);
        context.report.input.strokes = context.options.strokes.len();
        Ok(map)
    }
}
