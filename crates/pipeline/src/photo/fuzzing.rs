//! Doors to the readers of metadata, for the program's fuzzing targets.

use super::colour;
use super::exif::Facts;

/// Reads a TIFF structure.
pub fn exif(tiff: &[u8]) {
    let facts = Facts::read(Some(tiff));
    assert!((1..=8).contains(&facts.orientation));
    assert!(facts.focal_35.is_none_or(|f| Facts::FOCAL_35.contains(&f)));
}

/// Converts some pixels by a colour profile.
pub fn icc(profile: &[u8]) {
    let mut rgb: Vec<[u8; 3]> = (0..=255).map(|i| [i, 255 - i, i / 2]).collect();
    let before = rgb.clone();
    assert!(colour::to_srgb(&mut rgb, profile) || rgb == before, "a profile that was passed over changed pixels");
}
