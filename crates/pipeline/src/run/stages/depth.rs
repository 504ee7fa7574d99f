//! Disparity: estimated or given, cleaned, its ramps drawn back to the photo's edges.

use tmpi_core::{DisparityMap, Photo};

use crate::run::{self, Context, MakeError, Switch};
use crate::stereo::{self, Joined, Measured, Stereo};
use crate::{denoise, depth, edges, photo};

/// Photo, and where its disparity is to come from → disparity.
///
/// The frames of a room may have the network run [at a smaller size](Depth::at) than a photo.
#[derive(Debug, Default)]
pub struct Depth {
    size: Option<(u32, u32)>,
    network_ms: f64,
}

impl Depth {
    /// The network, where disparity comes from it, runs at one of [`depth::Estimator::sizes`]; none: as for a photo.
    #[must_use]
    pub const fn at(size: Option<(u32, u32)>) -> Self {
        Self { size, network_ms: 0.0 }
    }

    /// Milliseconds that the network took by itself; 0 where it did not run at a size that was asked for.
    #[must_use]
    pub const fn network_ms(&self) -> f64 {
        self.network_ms
    }
}

/// Where disparity comes from.
#[derive(Clone, Debug)]
pub enum Source<'a> {
    /// The network.
    Network,
    /// A map that the user gives: a grey picture's file, and the EXIF orientation of the photo.
    Given(&'a [u8], u8),
    /// The map that the photo brings along.
    Carried(depth::Carried),
    /// The picture of a second eye.
    Second(Eye<'a>),
}

/// Where the picture of a second eye is.
#[derive(Clone, Debug)]
pub enum Eye<'a> {
    /// A file beside the photo.
    Beside(&'a [u8]),
    /// A file within the photo's.
    Within(&'a [u8]),
    /// The other half of the photo's picture.
    Half(Photo),
}

impl<'a> Source<'a> {
    /// The user's own map or second eye if there is one, else what the photo brings along as far as that is wanted – a map, then a second eye – else
    /// the network. What the photo brings along and cannot be read is told in the report, and only fails where nothing else is wanted.
    ///
    /// # Errors
    /// [`MakeError::Depth`] where the photo's own depth is wanted and is not there or not readable.
    pub fn choose(photo: &'a [u8], given: Option<&'a [u8]>, context: &mut Context) -> Result<Self, MakeError> {
        let (wanted, stereo) = (context.options.photo_depth, context.options.stereo);
        stereo.check(photo, given.is_some())?;
        match given {
            Some(second) if stereo == Stereo::Beside => return Ok(Self::Second(Eye::Beside(second))),
            Some(given) => return Ok(Self::Given(given, photo::orientation(photo))),
            // its half is cut off once it is decoded
            None if stereo.halves().is_some() => return Ok(Self::Network),
            None => {}
        }
        if wanted == Switch::Off {
            return Ok(Self::Network);
        }
        match depth::carried(photo) {
            Ok(Some(carried)) => Ok(Self::Carried(carried)),
            Ok(None) => match depth::second_eye(photo).filter(|_| stereo == Stereo::Auto) {
                Some(Ok(second)) => Ok(Self::Second(Eye::Within(second))),
                Some(Err(problem)) if wanted == Switch::On => Err(depth::DepthError::Second(problem.into()).into()),
                Some(Err(problem)) => {
                    context.report.input.depth_problem = Some(problem.into());
                    Ok(Self::Network)
                }
                None if wanted == Switch::On => Err(depth::DepthError::NotCarried.into()),
                None => Ok(Self::Network),
            },
            Err(error) if wanted == Switch::On => Err(error.into()),
            Err(error) => {
                context.report.input.depth_problem = Some(error.to_string());
                Ok(Self::Network)
            }
        }
    }

    /// The half of the photo's picture, where there is one and nothing else was given.
    #[must_use]
    pub fn or_half(self, half: Option<Photo>) -> Self {
        match (self, half) {
            (Self::Network, Some(half)) => Self::Second(Eye::Half(half)),
            (source, _) => source,
        }
    }
}

impl Eye<'_> {
    /// Measures `photo` against it; none where that tells nothing, and the network's estimate will do.
    ///
    /// # Errors
    /// [`MakeError`]: a file that was given cannot be read; or nothing was measured, and nothing else will do.
    fn measure(self, photo: &Photo, context: &mut Context) -> Result<Option<Measured>, MakeError> {
        let decoded = |file: &[u8]| photo::decode(file, context.limits, Some(photo.width.max(photo.height))).map(|d| d.photo);
        let given = matches!(self, Self::Beside(_));
        let second = match self {
            Self::Half(half) => Ok(half),
            Self::Beside(file) | Self::Within(file) => decoded(file).map_err(|e| depth::DepthError::Second(e.to_string())),
        };
        let problem = match second.map(|second| stereo::measure(photo, &second)) {
            Ok(Ok(measured)) => return Ok(Some(measured)),
            Ok(Err(why)) => depth::DepthError::Second(why.to_string()),
            Err(error) if given => return Err(error.into()),
            Err(error) => error,
        };
        if context.options.photo_depth == Switch::On {
            return Err(problem.into());
        }
        context.report.input.depth_problem = Some(problem.to_string());
        Ok(None)
    }
}

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
    type Input<'a> = (&'a Photo, Source<'a>);
    type Output = Estimated;

    fn run(&mut self, (photo, source): (&Photo, Source), context: &mut Context) -> Result<Estimated, MakeError> {
        let (width, height) = (photo.width, photo.height);
        let (source, measured) = match source {
            Source::Second(eye) => (Source::Network, eye.measure(photo, context)?),
            other => (other, None),
        };
        let read = match &source {
            Source::Network | Source::Second(_) => None,
            Source::Given(file, orientation) => {
                let kind = context.options.depth_kind;
                Some(("given", "given", depth::from_map_beside(file, kind, context.limits, (width, height), *orientation)?))
            }
            Source::Carried(carried) => match carried.read(context.limits, width, height) {
                Ok(read) => Some(("carried", carried.format, read)),
                Err(error) if context.options.photo_depth == Switch::On => return Err(error.into()),
                Err(error) => {
                    context.report.input.depth_problem = Some(error.to_string());
                    None
                }
            },
        };
        let given = read.is_some() || measured.is_some();
        let (mut delta, own) = if let Some((name, format, read)) = read {
            context.report.depth_model = name.into();
            let (w, h) = read.size;
            let stretched = !depth::fits((w, h), (width, height));
            context.report.input.depth = Some(run::InputDepth { source: format.into(), width: w, height: h, stretched });
            (context.report.error.depth_filled, context.report.error.depth_clipped) = (read.filled, read.clipped);
            (read.map, read.own)
        } else {
            context.report.depth_model = context.models.depth.name().into();
            let network = &context.models.depth;
            let size = self.size.or_else(|| network.sizes(width, height).first().copied());
            let estimate =
                size.map_or_else(|| network.estimate(photo).map(depth::Estimate::from), |size| network.estimate_at(photo, size))?;
            self.network_ms = if self.size.is_some() { estimate.network_ms } else { 0.0 };
            if let Some(measured) = measured {
                let Joined { map, own, figures } = measured.joined(photo, &estimate.map);
                context.report.depth_model = "stereo".into();
                let (width, height) = own.as_ref().map_or((width, height), |own| (own.width, own.height));
                context.report.input.depth = Some(run::InputDepth { source: "stereo".into(), width, height, stretched: false });
                context.report.error.stereo = Some(figures);
                (map, own)
            } else {
                (estimate.map, estimate.small)
            }
        };
        // anything that is no disparity lies at infinity: no input may give NaN further on
        for d in &mut delta.delta {
            *d = if d.is_finite() { d.clamp(0.0, 1.0) } else { 0.0 };
        }
        context.report.error.resampling = context.movement.zip(own).map(|(movement, own)| movement.resampled(&own, &delta));
        Ok(Estimated { delta, confidence: None, given })
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
        let movement = context.movement;
        // not told of a map that stays as it is
        let moved = |before: &DisparityMap, after: &DisparityMap| movement.filter(|_| before != after).map(|m| m.between(before, after));
        let clean = match context.options.denoise {
            run::Denoise::Theta => {
                // Without Θ the options were refused before
                if let Some(theta) = context.models.theta.as_ref().filter(|_| denoise::theta::wanted(&map.delta)) {
                    let (clean, confidence) = denoise::theta::run(theta.as_ref(), photo, &map.delta)?;
                    map.confidence = Some(confidence);
                    Some(clean)
                } else {
                    None
                }
            }
            // It looks for degradation first
            run::Denoise::Auto => Some(denoise::local_planes::denoise(&map.delta)),
            run::Denoise::Classic => Some(denoise::median_guided::denoise(photo, &map.delta)),
            run::Denoise::Off => None,
        };
        if let Some(clean) = clean {
            context.report.error.denoise = moved(&map.delta, &clean);
            map.delta = clean;
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
            let snapped = if blurred { edges::snap(photo, &map.delta) } else { edges::clean(photo, &map.delta) };
            let movement = context.movement.filter(|_| snapped != map.delta);
            context.report.error.snap = movement.map(|m| m.between(&map.delta, &snapped));
            map.delta = snapped;
        }
        Ok(map)
    }
}
