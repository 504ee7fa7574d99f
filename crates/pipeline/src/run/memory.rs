//! How much memory making a photo takes, before it is made.
//!
//! Peaks of the process were measured (`tests/load/memory.py`) on photographs, on pictures and depth maps of one ramp, of noise and of
//! blocks, of 0.5 to 50 megapixels, in tiles of 8 pixels to the whole photo, with 1 to 64 planes a tile. [`bytes`] is above all of them.

use super::{MakeError, Options, PlaneCount};
use crate::photo::{Limits, PhotoError};

/// What does not grow with the photo: program, networks, tables.
const BASE: u64 = 96 << 20;
/// Bytes a pixel of the photo, whatever its planes.
const PIXEL: u64 = 32;
/// Bytes a pixel for each plane that its tile has.
const PLANE: u64 = 14;
/// Bytes for each layer of a tile, whatever its size.
const LAYER: u64 = 1200;
/// Bytes a pixel of a file that is decoded before it is reduced, and of a depth map of another size.
const DECODED: u64 = 16;
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
        let area = |(w, h): (u32, u32)| u64::from(w) * u64::from(h);
        let (w, h) = crate::photo::reduced_size(file, self.max_size);
        let planes = match self.planes {
            PlaneCount::Fixed(n) => n,
            PlaneCount::Auto => LEAST,
        };
        let made = bytes(area((w, h)), u64::from(self.grid(w, h).tiles()), planes);
        let other = |size: (u32, u32)| if size == (w, h) { 0 } else { area(size) * DECODED };
        made + other(file).max(map.map_or(0, other))
    }

    /// Refuses what takes more memory than `limits` allow, before anything is decoded.
    ///
    /// # Errors
    /// [`PhotoError::TooMuchWork`] names the limit and the need.
    pub fn check_memory(&self, file: (u32, u32), map: Option<(u32, u32)>, limits: &Limits) -> Result<(), MakeError> {
        let bytes = self.memory(file, map);
        if bytes > limits.memory { Err(PhotoError::TooMuchWork { bytes, limit: limits.memory }.into()) } else { Ok(()) }
    }
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
        assert!(Options::default().check_memory(largest, Some(largest), &limits).is_ok());
        assert!(Options::default().check_memory(largest, Some((100, 100)), &limits).is_ok());
        let planes = |n| Options { planes: PlaneCount::Fixed(n), ..Options::default() };
        assert!(planes(16).check_memory((4000, 3000), None, &limits).is_ok());
        let refused = planes(64).check_memory((4000, 3000), None, &limits).unwrap_err().to_string();
        let need = planes(64).memory((4000, 3000), None);
        assert!(refused.contains(&need.to_string()) && refused.contains(&limits.memory.to_string()), "{refused}");
        // a map that is much larger than its photo counts, too
        assert!(Options::default().memory((80, 60), Some((8000, 6000))) > 700 << 20);
        let small = Options { tile: TileSize::Pixels(8), ..Options::default() };
        assert!(small.memory((4000, 3000), None) > Options::default().memory((4000, 3000), None) + (500 << 20));
    }
}
