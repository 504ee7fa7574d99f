//! How much memory making a photo takes, before it is made.
//!
//! Peaks of the process were measured (`tests/load/memory.py`) on photographs, on pictures and depth maps of one ramp, of noise and of
//! blocks, of 0.5 to 50 megapixels, in tiles of 8 pixels to the whole photo, with 1 to 64 planes a tile. [`bytes`] is above all of them.

use super::{MakeError, Options, PlaneCount};
use crate::photo::{Limits, PhotoError};
use crate::stereo::Stereo;

/// What does not grow with the photo: program, tables, and the embedded depth network, which takes the most of it. With a depth map the program takes
/// 16 MiB for a photo of 3000 pixels; with the network 99, and 118 for 0.25 and 0.5 megapixels, of which the rest of the formula covers 15 and 29.
const BASE: u64 = 112 << 20;
/// Bytes a pixel of the photo, whatever its planes.
const PIXEL: u64 = 32;
/// Bytes a pixel for each plane that its tile has.
const PLANE: u64 = 14;
/// Bytes for each layer of a tile, whatever its size.
const LAYER: u64 = 1200;
/// Bytes a pixel of a file that is decoded before it is reduced, and of a depth map of another size.
const DECODED: u64 = 16;
/// Bytes a pixel of a photo that is kept beside that.
const PHOTO: u64 = 3;
/// What measuring depth against a second picture takes, at the size of matching.
const STEREO: u64 = 80 << 20;
/// Fewest pixels that a photo is brought to so that it fits: as many as a screen has.
const LEAST_PIXELS: u64 = 2_000_000;
/// Fewest planes a tile, without its background, for which there must be room: where it is up to the program, it takes more only as far
/// as memory goes.
const LEAST: u32 = 2;

/// Memory that making a scene of `pixels` takes at most, in bytes, in so many tiles of `planes` planes in the mean; each may have a
/// background besides.
#[must_use]
pub fn bytes(pixels: u64, tiles: u64, planes: u32) -> u64 {
    let layers = u64::from(planes) + 1;
    BASE + pixels * (PIXEL + PLANE * layers) + tiles * layers * LAYER
}

/// The most planes a tile that fit into `memory` bytes; at least 1.
#[must_use]
pub fn most_planes(pixels: u64, tiles: u64, memory: u64) -> u32 {
    let layer = pixels * PLANE + tiles * LAYER;
    let layers = memory.saturating_sub(BASE + pixels * PIXEL) / layer.max(1);
    u32::try_from(layers.saturating_sub(1)).unwrap_or(u32::MAX).max(1)
}

impl Options {
    /// Memory that making a photo takes at most, in bytes, where the file holds `file` and the depth map, if there is one, `map` pixels
    /// (width, height). Where planes are [`PlaneCount::Auto`], more are placed only as far as [`Limits::memory`] goes.
    #[must_use]
    pub fn memory(&self, file: (u32, u32), map: Option<(u32, u32)>) -> u64 {
        self.memory_at(file, map, self.max_size)
    }

    /// The same, with the longest side at most `side`.
    fn memory_at(&self, file: (u32, u32), map: Option<(u32, u32)>, side: Option<u32>) -> u64 {
        let planes = match self.planes {
            PlaneCount::Fixed(n) => n,
            PlaneCount::Auto => LEAST,
        };
        self.memory_with(file, map, side, planes)
    }

    /// The same, with so many planes a tile, without its background, in the mean.
    #[must_use]
    pub fn memory_with(&self, file: (u32, u32), map: Option<(u32, u32)>, side: Option<u32>, planes: u32) -> u64 {
        let (w, h) = crate::photo::reduced_size(file, side);
        let made = bytes(area((w, h)), u64::from(self.grid(w, h).tiles()), planes);
        // what is decoded is let go before planes are placed
        let made = made + if matches!(self.stereo, Stereo::Auto | Stereo::None) { 0 } else { STEREO };
        let other = |size: (u32, u32)| if size == (w, h) { 0 } else { BASE + area(size) * DECODED + area((w, h)) * PHOTO };
        made.max(other(file)).max(map.map_or(0, other))
    }

    /// The longest side, in pixels, to which a photo is brought so that making it takes no more memory than `limits` allow; none where it
    /// fits as it is. It is not brought below 2 megapixels, nor where tiles or planes were asked for that take so much.
    ///
    /// # Errors
    /// [`PhotoError::TooMuchWork`] names the limit and the need.
    pub fn side_by_memory(&self, file: (u32, u32), map: Option<(u32, u32)>, limits: &Limits) -> Result<Option<u32>, MakeError> {
        let bytes = self.memory(file, map);
        if bytes <= limits.memory {
            return Ok(None);
        }
        let refused = PhotoError::TooMuchWork { bytes, limit: limits.memory };
        let usual = Self::default();
        if (self.planes, self.tile) != (usual.planes, usual.tile) {
            return Err(refused.into());
        }
        let fits = |side: u32| self.memory_at(file, map, Some(side)) <= limits.memory;
        let (mut most, mut too_large) = (0, file.0.max(file.1).min(self.max_size.unwrap_or(u32::MAX)));
        while too_large - most > 1 {
            let middle = most + (too_large - most) / 2;
            *(if fits(middle) { &mut most } else { &mut too_large }) = middle;
        }
        if area(crate::photo::reduced_size(file, Some(most))) < LEAST_PIXELS { Err(refused.into()) } else { Ok(Some(most)) }
    }

    /// Refuses a file of that size that does not fit into memory whatever other options are chosen: where it is decoded at all.
    ///
    /// # Errors
    /// [`PhotoError::TooMuchWork`] names the limit and the need with these options.
    pub fn check_decoded(&self, file: (u32, u32), limits: &Limits) -> Result<(), MakeError> {
        if BASE + area(file) * DECODED <= limits.memory {
            return Ok(());
        }
        Err(PhotoError::TooMuchWork { bytes: self.memory(file, None), limit: limits.memory }.into())
    }

    /// These options, with a photo brought to the size at which it fits into memory, where it does not as it is.
    ///
    /// # Errors
    /// As [`Options::side_by_memory`].
    pub fn fitted(&self, file: (u32, u32), map: Option<(u32, u32)>, limits: &Limits) -> Result<Self, MakeError> {
        let side = self.side_by_memory(file, map, limits)?;
        Ok(Self { max_size: side.or(self.max_size), ..self.clone() })
    }
}

fn area((w, h): (u32, u32)) -> u64 {
    u64::from(w) * u64::from(h)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::TileSize;

    #[test]
    fn planes_that_fit_fit_and_one_more_do_not() {
        for (pixels, tiles) in [(500_000, 165), (12_000_000, 3888), (50_000_000, 16_000), (2_000_000, 40_775)] {
            for memory in [1_u64 << 30, 6 << 30, 20 << 30] {
                let most = most_planes(pixels, tiles, memory);
                assert!(most == 1 || bytes(pixels, tiles, most) <= memory);
                assert!(bytes(pixels, tiles, most + 1) > memory);
            }
        }
    }

    #[test]
    fn fifty_megapixels_fit_by_default_and_what_is_asked_for_beyond_that_is_named() {
        let limits = Limits { memory: 6 << 30, ..Limits::default() };
        let largest = (8160, 6120);
        assert_eq!(Options::default().side_by_memory(largest, Some(largest), &limits).unwrap(), None);
        assert_eq!(Options::default().side_by_memory(largest, Some((100, 100)), &limits).unwrap(), None);
        let planes = |n| Options { planes: PlaneCount::Fixed(n), ..Options::default() };
        assert_eq!(planes(16).side_by_memory((4000, 3000), None, &limits).unwrap(), None);
        let refused = planes(64).side_by_memory((4000, 3000), None, &limits).unwrap_err().to_string();
        let need = planes(64).memory((4000, 3000), None);
        assert!(refused.contains(&need.to_string()) && refused.contains(&limits.memory.to_string()), "{refused}");
        // a map that is much larger than its photo counts, too
        assert!(Options::default().memory((80, 60), Some((8000, 6000))) > 700 << 20);
        let small = Options { tile: TileSize::Pixels(8), ..Options::default() };
        assert!(small.memory((4000, 3000), None) > Options::default().memory((4000, 3000), None) + (500 << 20));
    }

    #[test]
    fn what_is_refused_whatever_the_options_is_refused_with_each() {
        let limits = |mib: u64| Limits { memory: mib << 20, ..Limits::default() };
        let (file, options) = ((8160, 6120), Options::default());
        // 112 MiB, and 50 megapixels of 16 bytes
        let refused = options.check_decoded(file, &limits(873)).unwrap_err();
        assert_eq!(refused.to_string(), options.side_by_memory(file, None, &limits(873)).unwrap_err().to_string());
        assert!(options.check_decoded(file, &limits(875)).is_ok());
        for planes in [PlaneCount::Auto, PlaneCount::Fixed(1)] {
            for tile in [TileSize::Full, TileSize::Pixels(8)] {
                for max_size in [None, Some(1), Some(2000)] {
                    let options = Options { planes, tile, max_size, ..Options::default() };
                    for map in [None, Some((80, 60)), Some(file)] {
                        assert!(options.side_by_memory(file, map, &limits(873)).is_err(), "{options:?} {map:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_photo_that_is_too_large_is_brought_to_what_fits_and_no_further_than_a_screen() {
        let limits = |mib: u64| Limits { memory: mib << 20, ..Limits::default() };
        let options = Options::default();
        for (file, mib) in [((8160, 6120), 960), ((6120, 8160), 1500), ((6000, 4000), 600), ((12_000, 4000), 2000)] {
            let limits = limits(mib);
            let side = options.side_by_memory(file, None, &limits).unwrap().expect("it does not fit as it is");
            let at = |side| Options { max_size: Some(side), ..options.clone() }.memory(file, None);
            assert!(at(side) <= limits.memory && at(side + 8) > limits.memory, "{file:?}: {side}");
            assert_eq!(options.fitted(file, None, &limits).unwrap().max_size, Some(side));
        }
        // decoding alone takes too much; what fits is too small
        for (file, mib) in [((8160, 6120), 256), ((3000, 2000), 200)] {
            let refused = options.side_by_memory(file, None, &limits(mib)).unwrap_err().to_string();
            assert!(refused.contains(&options.memory(file, None).to_string()), "{refused}");
        }
        let smaller = Options { max_size: Some(2000), ..Options::default() };
        assert_eq!(smaller.side_by_memory((8160, 6120), None, &limits(960)).unwrap(), None);
    }
}
