//! Colours as a file tells them, to sRGB.

use moxcms::{
    CicpColorPrimaries, CicpProfile, ColorProfile, DataColorSpace, Layout, MatrixCoefficients, TransferCharacteristics, TransformExecutor,
    TransformOptions,
};
use rayon::prelude::*;
use std::sync::Arc;

/// Levels of 255 that a profile may differ from sRGB and still count as sRGB: profiles of sRGB itself differ by their rounding.
const SAME: u8 = 2;
/// Pixels that are converted at a time.
pub(super) const CHUNK: usize = 1 << 14;

/// What a file says of its colours.
#[derive(Clone, Debug)]
pub(super) enum Profile {
    /// An ICC profile.
    Icc(Vec<u8>),
    /// PNG's `cICP`: primaries and transfer function by their numbers in ITU-T H.273.
    Cicp(CicpProfile),
}

/// A conversion to sRGB of pixels with samples of 8 or 16 bits.
pub(super) struct Conversion<S> {
    transform: Arc<dyn TransformExecutor<S> + Send + Sync>,
    /// The profile is one of grey: the three channels are alike, and the first is taken.
    grey: bool,
}

impl Profile {
    /// Reads the contents of a `cICP` chunk; none where they are of no RGB in full range, or of primaries or a transfer function that are
    /// not known.
    pub(super) fn cicp(chunk: &[u8]) -> Option<Self> {
        let &[primaries, transfer, 0, 1] = chunk else { return None };
        let cicp = CicpProfile {
            color_primaries: CicpColorPrimaries::try_from(primaries).ok()?,
            transfer_characteristics: TransferCharacteristics::try_from(transfer).ok()?,
            matrix_coefficients: MatrixCoefficients::Identity,
            full_range: true,
        };
        ColorProfile::new_from_cicp(cicp).red_trc.is_some().then_some(Self::Cicp(cicp))
    }

    /// The profile and how its pixels lie, where it fits what the file holds: a grey profile fits grey pixels alone, one of RGB both; others
    /// (CMYK) and damaged ones fit nothing, and the picture is taken as sRGB.
    fn fitting(&self, grey: bool) -> Option<(ColorProfile, Layout)> {
        let profile = match self {
            Self::Icc(bytes) => ColorProfile::new_from_slice(bytes).ok()?,
            Self::Cicp(cicp) => ColorProfile::new_from_cicp(*cicp),
        };
        match profile.color_space {
            DataColorSpace::Rgb => Some((profile, Layout::Rgb)),
            DataColorSpace::Gray if grey => Some((profile, Layout::Gray)),
            _ => None,
        }
    }

    /// The conversion of pixels of 8 bits, where it is more than the identity.
    pub(super) fn bytes(&self, grey: bool) -> Option<Conversion<u8>> {
        let (profile, layout) = self.fitting(grey)?;
        let transform = profile.create_transform_8bit(layout, &ColorProfile::new_srgb(), Layout::Rgb, TransformOptions::default()).ok()?;
        let conversion = Conversion { transform, grey: layout == Layout::Gray };
        let levels = [0u8, 32, 64, 96, 128, 160, 192, 224, 255];
        let probes: Vec<[u8; 3]> = levels.iter().flat_map(|&r| levels.iter().flat_map(move |&g| levels.map(|b| [r, g, b]))).collect();
        let probes = if grey { levels.map(|v| [v; 3]).to_vec() } else { probes };
        let mut converted = probes.clone();
        conversion.chunk(&mut converted);
        let differs = |(a, b): (&u8, &u8)| a.abs_diff(*b) > SAME;
        probes.as_flattened().iter().zip(converted.as_flattened()).any(differs).then_some(conversion)
    }

    /// The conversion of pixels of 16 bits, where it is more than the identity.
    pub(super) fn words(&self, grey: bool) -> Option<Conversion<u16>> {
        self.bytes(grey)?;
        let (profile, layout) = self.fitting(grey)?;
        let transform = profile.create_transform_16bit(layout, &ColorProfile::new_srgb(), Layout::Rgb, TransformOptions::default()).ok()?;
        Some(Conversion { transform, grey: layout == Layout::Gray })
    }
}

impl<S: Copy + Default + Send + Sync> Conversion<S> {
    /// Converts pixels in place, side by side.
    pub(super) fn run(&self, pixels: &mut [[S; 3]]) {
        pixels.par_chunks_mut(CHUNK).for_each(|chunk| self.chunk(chunk));
    }

    /// Converts pixels in place; they stay as they are where the conversion fails.
    pub(super) fn chunk(&self, pixels: &mut [[S; 3]]) {
        let source: Vec<[S; 3]> = pixels.to_vec();
        let target = pixels.as_flattened_mut();
        let done = if self.grey {
            let samples: Vec<S> = source.iter().map(|p| p[0]).collect();
            self.transform.transform(&samples, target)
        } else {
            self.transform.transform(source.as_flattened(), target)
        };
        if done.is_err() {
            pixels.copy_from_slice(&source);
        }
    }
}
