//! Embedded ICC profiles to sRGB.

use moxcms::{ColorProfile, DataColorSpace, Layout, Transform8BitExecutor, TransformOptions};
use rayon::prelude::*;
use std::sync::Arc;

/// Levels that a profile may differ from sRGB and still count as sRGB: profiles of sRGB itself differ by their rounding.
const SAME: u8 = 2;

/// Converts `rgb` from the profile to sRGB in place; false where it is sRGB already.
///
/// Profiles of other than RGB colour (grey, CMYK) and damaged ones are passed over: the picture is then taken as sRGB.
pub(super) fn to_srgb(rgb: &mut [[u8; 3]], profile: &[u8]) -> bool {
    let Some(transform) = transform(profile) else { return false };
    rgb.par_chunks_mut(1 << 14).for_each(|chunk| {
        let source = chunk.to_vec();
        if transform.transform(source.as_flattened(), chunk.as_flattened_mut()).is_err() {
            chunk.copy_from_slice(&source);
        }
    });
    true
}

/// The conversion, where it is more than the identity.
fn transform(profile: &[u8]) -> Option<Arc<Transform8BitExecutor>> {
    let source = ColorProfile::new_from_slice(profile).ok().filter(|p| p.color_space == DataColorSpace::Rgb)?;
    let transform = source.create_transform_8bit(Layout::Rgb, &ColorProfile::new_srgb(), Layout::Rgb, TransformOptions::default()).ok()?;
    let levels = [0u8, 32, 64, 96, 128, 160, 192, 224, 255];
    let probes: Vec<[u8; 3]> = levels.iter().flat_map(|&r| levels.iter().flat_map(move |&g| levels.map(|b| [r, g, b]))).collect();
    let mut converted = vec![[0; 3]; probes.len()];
    transform.transform(probes.as_flattened(), converted.as_flattened_mut()).ok()?;
    let differs = |(a, b): (&u8, &u8)| a.abs_diff(*b) > SAME;
    probes.as_flattened().iter().zip(converted.as_flattened()).any(differs).then_some(transform)
}
