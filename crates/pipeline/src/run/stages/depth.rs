//! Stages of the disparity map: estimates or reads it, denoises it, applies strokes, snaps its ramps to the photo's edges, and widens what
//! a network draws too small.

use tmpi_core::{DisparityMap, Photo};

use crate::run::{self, Context, MakeError, Switch};
use crate::stereo::{self, FusedDisparity, Measured, Stereo};
use crate::{denoise, depth, edges, photo, strokes};

/// Source of disparity.
#[derive(Clone, Debug)]
pub enum Source<'a> {
    /// The depth network.
    Network,
    /// Your own map: the file of a grey picture, and the EXIF orientation of the photo.
    Given(&'a [u8], u8),
    /// The map embedded in the photo's file.
    Embedded(depth::EmbeddedDepth),
    /// The map in the other half of the photo's picture.
    Half(Photo),
    /// Measurement against a second picture.
    Second(SecondPicture<'a>),
}

/// The second picture, by where it is stored.
#[derive(Clone, Debug)]
pub enum SecondPicture<'a> {
    /// A file of its own.
    OwnFile(&'a [u8]),
    /// A file embedded in the photo's.
    Embedded(&'a [u8]),
    /// The other half of the photo's picture.
    Half(Photo),
}

impl<'a> Source<'a> {
    /// Chooses your own map or second picture (`given`) if there is one, else a map or a second picture embedded in the photo's file if
    /// the options allow it, else the network. The report says why embedded depth was not used.
    ///
    /// # Errors
    /// [`MakeError::Depth`] if the option `photo_depth` is on and the photo's file holds no readable depth, if the option `stereo` asks for
    /// a second picture that is missing, or for a 360° picture.
    pub fn choose(photo: &'a [u8], given: Option<&'a [u8]>, context: &mut Context) -> Result<Self, MakeError> {
        let (wanted, stereo) = (context.options.photo_depth, context.options.stereo);
        stereo.check(photo, given.is_some())?;
        match given {
            Some(second) if stereo == Stereo::Beside => return Ok(Self::Second(SecondPicture::OwnFile(second))),
            Some(given) => return Ok(Self::Given(given, photo::orientation(photo))),
            // the second half is cut off after decoding
            None if stereo.halves().is_some() => return Ok(Self::Network),
            None => {}
        }
        if wanted == Switch::Off {
            return Ok(Self::Network);
        }
        match depth::embedded_depth(photo) {
            Ok(Some(embedded)) => Ok(Self::Embedded(embedded)),
            Ok(None) => match depth::second_picture(photo).filter(|_| stereo == Stereo::Auto) {
                Some(Ok(second)) => Ok(Self::Second(SecondPicture::Embedded(second))),
                Some(Err(problem)) if wanted == Switch::On => Err(depth::DepthError::Second(problem.into()).into()),
                Some(Err(problem)) => {
                    context.report.input.depth_problem = Some(problem.into());
                    Ok(Self::Network)
                }
                None if wanted == Switch::On => Err(depth::DepthError::NotEmbedded.into()),
                None => Ok(Self::Network),
            },
            Err(error) if wanted == Switch::On => Err(error.into()),
            Err(error) => {
                context.report.input.depth_problem = Some(error.to_string());
                Ok(Self::Network)
            }
        }
    }

    /// The other half of the photo's picture, if there is one and no other source was chosen: a depth map or a second picture.
    pub fn or_half(self, half: Option<Photo>, stereo: Stereo) -> Self {
        match (self, half) {
            (Self::Network, Some(half)) if stereo == Stereo::Rgbd => Self::Half(half),
            (Self::Network, Some(half)) => Self::Second(SecondPicture::Half(half)),
            (source, _) => source,
        }
    }
}

impl SecondPicture<'_> {
    /// Measures `photo` against the second picture; `None` if that fails and the network's estimate takes its place.
    ///
    /// # Errors
    /// [`MakeError`] if a file of its own cannot be read, or if measuring fails and the option `photo_depth` is on.
    fn measure(self, photo: &Photo, context: &mut Context) -> Result<Option<Measured>, MakeError> {
        let decoded = |file: &[u8]| photo::decode(file, context.limits, Some(photo.width.max(photo.height))).map(|d| d.photo);
        let given = matches!(self, Self::OwnFile(_));
        let second = match self {
            Self::Half(half) => Ok(half),
            Self::OwnFile(file) | Self::Embedded(file) => decoded(file).map_err(|e| depth::DepthError::Second(e.to_string())),
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

/// Disparity of a photo, before planes are placed.
#[derive(Clone, Debug)]
pub struct WeightedDisparity {
    /// δ at the photo's size, finite, 0 to 1.
    pub delta: DisparityMap,
    /// Confidence per pixel, 0 to 1; `None`: the same everywhere.
    pub confidence: Option<Vec<f32>>,
    /// The map was read or measured, not only estimated by the network.
    pub given: bool,
}

/// Stage from a photo and the source of its disparity to a disparity map. If the source is the network, it runs at `size`, one of
/// [`depth::Estimator::sizes`], for the frames of a room; `None`: at the size for a photo.
///
/// # Errors
/// [`MakeError`] if a map or second picture is invalid, if the network fails, or if there is no time left.
pub fn find_disparity(
    context: &mut Context,
    photo: &Photo,
    source: Source,
    size: Option<(u32, u32)>,
) -> Result<WeightedDisparity, MakeError> {
    let stage = context.begin("depth")?;
    let (width, height) = (photo.width, photo.height);
    let (source, measured) = match source {
        Source::Second(eye) => (Source::Network, eye.measure(photo, context)?),
        source => (source, None),
    };
    let read = match &source {
        Source::Network | Source::Second(_) => None,
        Source::Given(file, orientation) => {
            let kind = context.options.depth_kind;
            Some(("given", "given", depth::from_map_beside(file, kind, context.limits, (width, height), *orientation)?))
        }
        Source::Half(half) => Some(("given", "rgbd", depth::from_half(half, context.options.depth_kind)?)),
        Source::Embedded(embedded) => match embedded.read(context.limits, width, height) {
            Ok(read) => Some(("embedded", embedded.format, read)),
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
        let chosen = size.or_else(|| network.sizes(width, height).first().copied());
        let estimate =
            chosen.map_or_else(|| network.estimate(photo).map(depth::Estimate::from), |size| network.estimate_at(photo, size))?;
        context.network_ms = if size.is_some() { estimate.network_ms } else { 0.0 };
        if let Some(measured) = measured {
            let FusedDisparity { map, own, figures } = measured.fuse(photo, &estimate.map);
            context.report.depth_model = "stereo".into();
            let (width, height) = own.as_ref().map_or((width, height), |own| (own.width, own.height));
            context.report.input.depth = Some(run::InputDepth { source: "stereo".into(), width, height, stretched: false });
            context.report.error.stereo = Some(figures);
            (map, own)
        } else {
            (estimate.map, estimate.small)
        }
    };
    // values that are not finite become infinitely far, so that no input gives NaN in later stages
    for d in &mut delta.delta {
        *d = if d.is_finite() { d.clamp(0.0, 1.0) } else { 0.0 };
    }
    context.report.error.resampling = context.movement.zip(own).map(|(movement, own)| movement.resampled(&own, &delta));
    context.end(stage);
    Ok(WeightedDisparity { delta, confidence: None, given })
}

/// Stage that removes noise and outliers from the disparity map.
///
/// # Errors
/// [`MakeError`] if the network Θ fails, or if there is no time left.
pub fn remove_noise(context: &mut Context, photo: &Photo, mut map: WeightedDisparity) -> Result<WeightedDisparity, MakeError> {
    let stage = context.begin("denoise")?;
    let movement = context.movement;
    // an unchanged map has no error to report
    let moved = |before: &DisparityMap, after: &DisparityMap| movement.filter(|_| before != after).map(|m| m.between(before, after));
    let clean = match context.options.denoise {
        run::Denoise::Theta => {
            // `Models::check` has rejected these options if Θ is missing
            if let Some(theta) = context.models.theta.as_ref().filter(|_| denoise::theta::wanted(&map.delta)) {
                let (clean, confidence) = denoise::theta::run(theta.as_ref(), photo, &map.delta)?;
                map.confidence = Some(confidence);
                Some(clean)
            } else {
                None
            }
        }
        // measures noise and outliers itself
        run::Denoise::Auto => Some(denoise::local_planes::denoise(&map.delta)),
        run::Denoise::Classic => Some(denoise::median_guided::denoise(photo, &map.delta)),
        run::Denoise::Off => None,
    };
    if let Some(clean) = clean {
        context.report.error.denoise = moved(&map.delta, &clean);
        map.delta = clean;
    }
    context.end(stage);
    Ok(map)
}

/// Stage that applies the strokes of the options to the disparity map. It runs before edges are snapped, so that the outlines of strokes
/// snap to those of the photo.
pub(crate) fn apply_strokes(context: &mut Context, photo: &Photo, mut map: WeightedDisparity) -> Result<WeightedDisparity, MakeError> {
    let stage = context.begin("strokes")?;
    strokes::apply(photo, &mut map.delta, map.confidence.as_mut(), &context.options.strokes);
    context.report.input.strokes = context.options.strokes.len();
    context.end(stage);
    Ok(map)
}

/// Stage that snaps the ramps of blurred maps to the edges of a frame of video. Rooms do not widen: they snap only a part of a frame, and
/// widening looks farther than the margin of such a part.
///
/// # Errors
/// [`MakeError`] if there is no time left.
pub fn snap_to_video(context: &mut Context, photo: &Photo, map: WeightedDisparity) -> Result<WeightedDisparity, MakeError> {
    snap(context, photo, map, (edges::Rim::Video, false))
}

/// Stage that snaps the ramps of blurred maps to a photo's edges, and widens things in a network's map that are too small, unless
/// [`Switch::On`] asks for snapping alone.
///
/// # Errors
/// [`MakeError`] if there is no time left.
pub fn snap_and_widen(context: &mut Context, photo: &Photo, map: WeightedDisparity) -> Result<WeightedDisparity, MakeError> {
    let widens = !map.given && context.options.snap == Switch::Auto;
    snap(context, photo, map, (edges::Rim::Photo, widens))
}

fn snap(
    context: &mut Context,
    photo: &Photo,
    mut map: WeightedDisparity,
    (rim, widens): (edges::Rim, bool),
) -> Result<WeightedDisparity, MakeError> {
    let stage = context.begin("snap")?;
    let switch = context.options.snap;
    if switch != Switch::Off {
        // snapping sharp depth costs quality, and a given map may be sharp or blurred
        let blurred = !map.given || switch == Switch::On || edges::ramp_share(&map.delta) > edges::BLURRED;
        let mut snapped = if blurred { edges::snap(photo, &map.delta, rim) } else { edges::median(photo, &map.delta) };
        if widens {
            snapped = edges::widen(photo, &snapped);
        }
        let movement = context.movement.filter(|_| snapped != map.delta);
        context.report.error.snap = movement.map(|m| m.between(&map.delta, &snapped));
        map.delta = snapped;
    }
    context.end(stage);
    Ok(map)
}
