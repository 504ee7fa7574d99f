//! Converts a file's colours to sRGB.

use moxcms::{
    CicpColorPrimaries, CicpProfile, ColorProfile, DataColorSpace, Layout, MatrixCoefficients, ToneReprCurve, TransferCharacteristics,
    TransformExecutor, TransformOptions,
};
use rayon::prelude::*;

use super::pq_hlg::Hdr;
use super::upright_srgb::Sample;

/// Largest difference from sRGB, in levels of 255, at which a profile still counts as sRGB: profiles of sRGB itself differ by rounding.
const SAME: u8 = 2;
/// Pixels per chunk of a conversion.
pub(super) const CHUNK: usize = 1 << 14;

/// How a file declares its colours.
#[derive(Clone, Debug)]
pub(super) enum Profile {
    /// An ICC profile.
    Icc(Vec<u8>),
    /// PNG's `cICP`: primaries and transfer function by their code points in ITU-T H.273.
    Cicp(CicpProfile),
}

/// A conversion of pixels with 8-bit or 16-bit samples to sRGB. The three channels of a grey pixel are equal.
pub(super) struct Conversion<S>(Run<S>);

type Run<S> = Box<dyn Fn(&mut [[S; 3]]) + Send + Sync>;

impl<S: Sample> Conversion<S> {
    /// Converts pixels in place, in parallel.
    pub(super) fn run(&self, pixels: &mut [[S; 3]]) {
        pixels.par_chunks_mut(CHUNK).for_each(|chunk| self.chunk(chunk));
    }

    /// Converts a few pixels in place, on this thread.
    pub(super) fn chunk(&self, pixels: &mut [[S; 3]]) {
        (self.0)(pixels);
    }

    /// Wraps a transform whose source pixels have this `layout`. If the transform fails, pixels stay unchanged.
    fn of(transform: impl AsRef<dyn TransformExecutor<S> + Send + Sync> + Send + Sync + 'static, layout: Layout) -> Self {
        Self(Box::new(move |pixels| {
            let source: Vec<S> =
                if layout == Layout::Gray { pixels.iter().map(|p| p[0]).collect() } else { pixels.as_flattened().to_vec() };
            // it fails if the lengths disagree
            let _ = transform.as_ref().transform(&source, pixels.as_flattened_mut());
        }))
    }
}

impl Profile {
    /// Reads the contents of a `cICP` chunk. Returns `None` unless it declares full-range RGB with known primaries and a known transfer
    /// function.
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

    /// The profile and its pixel layout if it fits the file: a grey profile fits only grey pixels, an RGB profile fits both. Other
    /// profiles (CMYK) and damaged ones fit nothing, and the picture is read as sRGB.
    fn fitting(&self, grey: bool) -> Option<(ColorProfile, Layout)> {
        let profile = match self {
            Self::Icc(bytes) => ColorProfile::new_from_slice(bytes).ok()?,
            Self::Cicp(cicp) => standard(*cicp),
        };
        match profile.color_space {
            DataColorSpace::Rgb => Some((profile, Layout::Rgb)),
            DataColorSpace::Gray if grey => Some((profile, Layout::Gray)),
            _ => None,
        }
    }

    fn hdr(&self) -> Option<Hdr> {
        if let Self::Cicp(cicp) = self { Hdr::of(*cicp) } else { None }
    }

    /// The conversion of 8-bit pixels; `None` if it would change nothing.
    pub(super) fn bytes(&self, grey: bool) -> Option<Conversion<u8>> {
        if let Some(hdr) = self.hdr() {
            return Some(Conversion(Box::new(move |pixels| {
                for p in pixels {
                    *p = hdr.convert(p.map(|v| u16::from(v) * 257)).map(u16::byte);
                }
            })));
        }
        let (profile, layout) = self.fitting(grey)?;
        let transform = profile.create_transform_8bit(layout, &ColorProfile::new_srgb(), Layout::Rgb, TransformOptions::default()).ok()?;
        let conversion = Conversion::of(transform, layout);
        let levels = [0u8, 32, 64, 96, 128, 160, 192, 224, 255];
        let coloured = || levels.iter().flat_map(|&r| levels.iter().flat_map(move |&g| levels.map(|b| [r, g, b]))).collect();
        let probes: Vec<[u8; 3]> = if grey { levels.map(|v| [v; 3]).to_vec() } else { coloured() };
        let mut converted = probes.clone();
        conversion.chunk(&mut converted);
        let differs = |(a, b): (&u8, &u8)| a.abs_diff(*b) > SAME;
        probes.as_flattened().iter().zip(converted.as_flattened()).any(differs).then_some(conversion)
    }

    /// The conversion of 16-bit pixels; `None` if it would change nothing.
    pub(super) fn words(&self, grey: bool) -> Option<Conversion<u16>> {
        if let Some(hdr) = self.hdr() {
            return Some(Conversion(Box::new(move |pixels| pixels.iter_mut().for_each(|p| *p = hdr.convert(*p)))));
        }
        self.bytes(grey)?;
        let (profile, layout) = self.fitting(grey)?;
        let transform = profile.create_transform_16bit(layout, &ColorProfile::new_srgb(), Layout::Rgb, TransformOptions::default()).ok()?;
        Some(Conversion::of(transform, layout))
    }
}

/// The profile of standard-range code points. Screens do not invert the camera curves of video: they show video by the curve of ITU-R
/// BT.1886.
fn standard(cicp: CicpProfile) -> ColorProfile {
    use TransferCharacteristics::{Bt601, Bt709, Bt202010bit, Bt202012bit};
    let mut profile = ColorProfile::new_from_cicp(cicp);
    if matches!(cicp.transfer_characteristics, Bt709 | Bt601 | Bt202010bit | Bt202012bit) {
        let curve = ToneReprCurve::Parametric(vec![2.4, 1.0, 0.0, 0.0, 0.0]);
        (profile.red_trc, profile.green_trc, profile.blue_trc) = (Some(curve.clone()), Some(curve.clone()), Some(curve));
        profile.cicp = None;
    }
    profile
}
