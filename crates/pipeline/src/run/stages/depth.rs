//! Disparity: estimated or given, cleaned, its ramps drawn back to the photo's edges.

use tmpi_core::{DisparityMap, Photo};

use crate::run::{self, Context, MakeError, Switch};
use crate::{denoise, depth, edges};

/// Photo, and the user's own map as a PNG file if there is one → disparity.
#[derive(Debug, Default)]
pub struct Depth;

/// Disparity of a photo on its way to the planes.
#[derive(Clone, Debug)]
pub struct Estimated {
    /// δ, finite, 0 to 1.
    pub delta: DisparityMap,
    /// How far it is to be trusted, 0 to 1 a pixel; none: everywhere alike.
    pub confidence: Option<Vec<f32>>,
    /// It is the user's own.
    pub given: bool,
}

impl run::Stage for Depth {
    const NAME: &'static str = "depth";
    type Input<'a> = (&'a Photo, Option<&'a [u8]>);
    type Output = Estimated;

    fn run(&mut self, (photo, given): (&Photo, Option<&[u8]>), context: &mut Context) -> Result<Estimated, MakeError> {
        let mut delta = match given {
            Some(png) => depth::from_png(png, context.options.depth_kind, context.limits, photo.width, photo.height)?,
            None => context.models.depth.estimate(photo)?,
        };
        context.report.depth_model = if given.is_some() { "given".into() } else { context.models.depth.name().into() };
        // anything that is no disparity lies at infinity: no input may give NaN further on
        for d in &mut delta.delta {
            *d = if d.is_finite() { d.clamp(0.0, 1.0) } else { 0.0 };
        }
        Ok(Estimated { delta, confidence: None, given: given.is_some() })
    }
}

/// Noise and outliers taken away, where there are any.
#[derive(Debug, Default)]
pub struct Denoise;

impl run::Stage for Denoise {
    const NAME: &'static str = "denoise";
    type Input<'a> = (&'a Photo, Estimated);
    type Output = Estimated;

    fn run(&mut self, (photo, mut map): (&Photo, Estimated), context: &mut Context) -> Result<Estimated, MakeError> {
        match context.options.denoise {
            run::Denoise::Theta => {
                // Without Θ the options were refused before
                if let Some(theta) = context.models.theta.as_ref().filter(|_| denoise::confidence::wanted(&map.delta)) {
                    let (clean, confidence) = denoise::confidence::run(theta.as_ref(), photo, &map.delta)?;
                    (map.delta, map.confidence) = (clean, Some(confidence));
                }
            }
            // It looks for degradation first
            run::Denoise::Auto => map.delta = denoise::local_planes::denoise(&map.delta),
            run::Denoise::Classic => map.delta = denoise::median_guided::denoise(photo, &map.delta),
            run::Denoise::Off => {}
        }
        Ok(map)
    }
}

/// Ramps of blurred maps snapped to the photo's edges.
#[derive(Debug, Default)]
pub struct Snap;

impl run::Stage for Snap {
    const NAME: &'static str = "snap";
    type Input<'a> = (&'a Photo, Estimated);
    type Output = Estimated;

    fn run(&mut self, (photo, mut map): (&Photo, Estimated), context: &mut Context) -> Result<Estimated, MakeError> {
        let switch = context.options.snap;
        if switch != Switch::Off {
            // snapping true depth costs quality, and a map that is given may be either
            let blurred = !map.given || switch == Switch::On || edges::ramp_share(&map.delta) > edges::BLURRED;
            map.delta = if blurred { edges::snap(photo, &map.delta) } else { edges::median(photo, &map.delta) };
        }
        Ok(map)
    }
}
