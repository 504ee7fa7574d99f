//! Entry points to the metadata readers for the fuzz targets.

use super::colour::Profile;
use super::exif::Facts;

/// Reads a TIFF structure.
pub fn exif(tiff: &[u8]) {
    let facts = Facts::read(Some(tiff));
    assert!((1..=8).contains(&facts.orientation));
    assert!(facts.focal_35.is_none_or(|f| Facts::FOCAL_35.contains(&f)));
}

/// Converts some pixels by an ICC profile.
pub fn icc(profile: &[u8]) {
    let profile = Profile::Icc(profile.to_vec());
    for grey in [false, true] {
        let mut bytes: Vec<[u8; 3]> = (0..=255).map(|i| if grey { [i; 3] } else { [i, 255 - i, i / 2] }).collect();
        let mut words: Vec<[u16; 3]> = bytes.iter().map(|p| p.map(|v| u16::from(v) * 257)).collect();
        profile.bytes(grey).iter().for_each(|conversion| conversion.run(&mut bytes));
        profile.words(grey).iter().for_each(|conversion| conversion.run(&mut words));
    }
}
