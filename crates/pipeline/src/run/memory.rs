//! Upper bounds of the memory that making a photo takes, known before it is decoded.
//!
//! [`Options::memory_with`] exceeds every peak of the process that `tests/load/making_memory.py` measured: on photographs, and on pictures and
//! depth maps of one ramp, of noise and of blocks, with 0.003 to 50 megapixels, tiles from 8 pixels to the whole photo, and 1 to 64 planes per
//! tile; with Θ, with Ψ and with pruning verified, up to 2 megapixels.

use super::{Denoise, ExtraPicture, MakeError, Options, PlaneCount, Sizes, Switch};
use crate::depth::DepthError;
use crate::photo::{Limits, PhotoError, reduced_size};
use crate::stereo::Stereo;

/// Bytes that do not depend on the photo: program, tables and, for the largest part, the embedded depth network. The network's part depends on
/// the processor. The most that was measured with it is 119 MiB for a photo of 3000 pixels and 128 MiB for 0.1 megapixels, of which the other
/// terms of the formula cover 0.2 and 7 MiB; with a depth map it is 36 MiB.
const BASE: u64 = 128 << 20;
/// Bytes per pixel of the photo, with any number of planes.
const PIXEL: u64 = 32;
/// Bytes per pixel for each plane of its tile.
const PLANE: u64 = 14;
/// Bytes per layer of a tile of any size.
const LAYER: u64 = 1200;
/// Bytes per pixel of a file that is decoded and then reduced, and of a depth map of another size.
const DECODED: u64 = 16;
/// Bytes per pixel of the reduced photo, which is kept while another picture is decoded.
const PHOTO: u64 = 3;
/// Bytes for the network Θ, with those per pixel of the map that it denoises.
const THETA: u64 = 64 << 20;
const DENOISED: u64 = 40;
/// Bytes per pixel of a layer if the network Ψ refines it, or if pruning is verified on views of the whole photo.
const REFINED: u64 = 8;
const VERIFIED: u64 = 32;
/// Bytes for measuring depth against a second picture of any size: matching runs at its own size.
const STEREO: u64 = 80 << 20;
/// A photo is not reduced below this number of pixels to fit into memory: about as many as a screen has. `tmpi-lab bench --only least-size`
/// measures what views of photos of other sizes lose.
pub const MIN_PIXELS: u64 = 1_500_000;
/// Planes per tile, without background planes, that must fit into memory with [`PlaneCount::Auto`]. More planes are placed only if they
/// fit, too.
const MIN_PLANES: u32 = 2;

impl Options {
    /// Upper bound in bytes of the memory for making a scene of `pixels` pixels and `tiles` tiles, with a mean of `planes` planes per tile
    /// plus a background plane.
    fn scene_bytes(&self, pixels: u64, tiles: u64, planes: u32) -> u64 {
        self.photo_bytes(pixels) + (u64::from(planes) + 1) * self.layer_bytes(pixels, tiles)
    }

    /// The part of it that does not depend on planes.
    fn photo_bytes(&self, pixels: u64) -> u64 {
        let theta = if self.denoise == Denoise::Theta { THETA + pixels * DENOISED } else { 0 };
        BASE + pixels * PIXEL + theta
    }

    /// The part of it for one layer per tile.
    fn layer_bytes(&self, pixels: u64, tiles: u64) -> u64 {
        let refined = if self.refine == Switch::On { REFINED } else { 0 };
        let verified = if self.verify_prune { VERIFIED } else { 0 };
        pixels * (PLANE + refined + verified) + tiles * LAYER
    }

    /// The most planes per tile, without background planes, that fit into `memory` bytes; at least 1.
    pub fn most_planes(&self, pixels: u64, tiles: u64, memory: u64) -> u32 {
        let layers = memory.saturating_sub(self.photo_bytes(pixels)) / self.layer_bytes(pixels, tiles).max(1);
        u32::try_from(layers.saturating_sub(1)).unwrap_or(u32::MAX).max(1)
    }

    /// Upper bound in bytes of the memory for making a photo from pictures of these sizes. With [`PlaneCount::Auto`], it assumes 2 planes
    /// per tile; more are placed only if they fit into [`Limits::memory`].
    pub fn memory(&self, sizes: &Sizes) -> u64 {
        self.memory_at(sizes, self.max_size)
    }

    /// [`Options::memory`] with a longest side of at most `side` pixels.
    fn memory_at(&self, sizes: &Sizes, side: Option<u32>) -> u64 {
        let planes = match self.planes {
            PlaneCount::Fixed(n) => n,
            PlaneCount::Auto => MIN_PLANES,
        };
        self.memory_with(sizes, side, planes)
    }

    /// [`Options::memory`] with a longest side of at most `side` pixels and a mean of `planes` planes per tile, without background planes.
    pub fn memory_with(&self, sizes: &Sizes, side: Option<u32>, planes: u32) -> u64 {
        let (w, h) = reduced_size(self.photo_size(sizes.file), side);
        let made = self.scene_bytes(area((w, h)), u64::from(self.grid(w, h).tiles()), planes);
        let halves = matches!(self.stereo, Stereo::LeftRight | Stereo::TopBottom);
        let measures = halves || matches!(sizes.extra, Some(ExtraPicture::SecondPicture(_)));
        // decoded pictures are freed before planes are placed
        let made = made + if measures { STEREO } else { 0 };
        let decoded = |size: (u32, u32)| if size == (w, h) { 0 } else { decoding_bytes(size) + area((w, h)) * PHOTO };
        made.max(decoded(sizes.file)).max(sizes.extra.map_or(0, |extra| decoded(extra.size())))
    }

    /// Width and height in pixels of the photo in a file of size `file`: those of one half, if the file holds two pictures in halves.
    pub fn photo_size(&self, file: (u32, u32)) -> (u32, u32) {
        self.stereo.halves().map_or(file, |halves| halves.of(file))
    }

    /// The longest side, in pixels, at which making the photo fits into `limits.memory`; `None` if it fits without reduction. Photos are
    /// not reduced below 1.5 megapixels, and not to make room for a tile size or number of planes other than the defaults.
    ///
    /// # Errors
    /// [`PhotoError::TooMuchWork`] names the limit and the need; [`DepthError`] if the depth map or second picture alone exceeds the limit.
    pub fn side_by_memory(&self, sizes: &Sizes, limits: &Limits) -> Result<Option<u32>, MakeError> {
        if let Some(extra) = sizes.extra {
            check_extra(extra, limits)?;
        }
        let bytes = self.memory(sizes);
        if bytes <= limits.memory {
            return Ok(None);
        }
        let refused = PhotoError::TooMuchWork { bytes, limit: limits.memory };
        let usual = Self::default();
        if (self.planes, self.tile) != (usual.planes, usual.tile) {
            return Err(refused.into());
        }
        let shown = self.photo_size(sizes.file);
        let fits = |side: u32| self.memory_at(sizes, Some(side)) <= limits.memory;
        let (mut most, mut too_large) = (0, shown.0.max(shown.1).min(self.max_size.unwrap_or(u32::MAX)));
        while too_large - most > 1 {
            let middle = most + (too_large - most) / 2;
            *(if fits(middle) { &mut most } else { &mut too_large }) = middle;
        }
        if area(reduced_size(shown, Some(most))) < MIN_PIXELS { Err(refused.into()) } else { Ok(Some(most)) }
    }

    /// Rejects a file of this size if decoding it alone exceeds the memory limit, so that no other options help.
    ///
    /// # Errors
    /// [`PhotoError::TooMuchWork`] names the limit and the need with these options.
    pub fn check_decoded(&self, file: (u32, u32), limits: &Limits) -> Result<(), MakeError> {
        if decoding_bytes(file) <= limits.memory {
            return Ok(());
        }
        Err(PhotoError::TooMuchWork { bytes: self.memory(&Sizes::of_photo(file)), limit: limits.memory }.into())
    }

    /// These options with `max_size` lowered so that the photo fits into memory, if it does not fit already.
    ///
    /// # Errors
    /// Those of [`Options::side_by_memory`].
    pub fn fitted(&self, sizes: &Sizes, limits: &Limits) -> Result<Self, MakeError> {
        let side = self.side_by_memory(sizes, limits)?;
        Ok(Self { max_size: side.or(self.max_size), ..self.clone() })
    }
}

/// Rejects a depth map or second picture if decoding it alone exceeds the memory limit.
fn check_extra(extra: ExtraPicture, limits: &Limits) -> Result<(), DepthError> {
    let bytes = decoding_bytes(extra.size());
    if bytes <= limits.memory {
        return Ok(());
    }
    let text = PhotoError::TooMuchWork { bytes, limit: limits.memory }.to_string();
    Err(if matches!(extra, ExtraPicture::DepthMap(_)) { DepthError::Map(text) } else { DepthError::Second(text) })
}

/// Upper bound in bytes of the memory for decoding a picture, including [`BASE`].
fn decoding_bytes(size: (u32, u32)) -> u64 {
    BASE + area(size) * DECODED
}

fn area((w, h): (u32, u32)) -> u64 {
    u64::from(w) * u64::from(h)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::TileSize;

    fn with_map(file: (u32, u32), map: (u32, u32)) -> Sizes {
        Sizes { file, extra: Some(ExtraPicture::DepthMap(map)) }
    }

    fn with_eye(file: (u32, u32), eye: (u32, u32)) -> Sizes {
        Sizes { file, extra: Some(ExtraPicture::SecondPicture(eye)) }
    }

    /// Options with networks and verification.
    fn costly() -> Options {
        Options { denoise: Denoise::Theta, refine: Switch::On, verify_prune: true, ..Options::default() }
    }

    #[test]
    fn networks_and_verification_count() {
        let of = |change: fn(&mut Options)| {
            let mut options = Options::default();
            change(&mut options);
            options.scene_bytes(1000, 10, 2) - Options::default().scene_bytes(1000, 10, 2)
        };
        // two planes and a background plane
        assert_eq!([of(|o| o.verify_prune = true), of(|o| o.refine = Switch::On)], [3000 * VERIFIED, 3000 * REFINED]);
        assert_eq!(of(|o| o.denoise = Denoise::Theta), THETA + 1000 * DENOISED);
    }

    #[test]
    fn most_planes_fit_and_one_more_does_not() {
        for (pixels, tiles) in [(500_000, 165), (12_000_000, 3888), (50_000_000, 16_000), (2_000_000, 40_775)] {
            for memory in [1_u64 << 30, 6 << 30, 20 << 30] {
                for options in [Options::default(), costly()] {
                    let most = options.most_planes(pixels, tiles, memory);
                    assert!(most == 1 || options.scene_bytes(pixels, tiles, most) <= memory);
                    assert!(options.scene_bytes(pixels, tiles, most + 1) > memory);
                }
            }
        }
    }

    #[test]
    fn fifty_megapixels_fit_by_default_and_errors_name_need_and_limit() {
        let limits = Limits { memory: 6 << 30, ..Limits::default() };
        let largest = (8160, 6120);
        assert_eq!(Options::default().side_by_memory(&with_map(largest, largest), &limits).unwrap(), None);
        assert_eq!(Options::default().side_by_memory(&with_map(largest, (100, 100)), &limits).unwrap(), None);
        let planes = |n| Options { planes: PlaneCount::Fixed(n), ..Options::default() };
        assert_eq!(planes(16).side_by_memory(&Sizes::of_photo((4000, 3000)), &limits).unwrap(), None);
        let refused = planes(64).side_by_memory(&Sizes::of_photo((4000, 3000)), &limits).unwrap_err().to_string();
        let need = planes(64).memory(&Sizes::of_photo((4000, 3000)));
        assert!(refused.contains(&need.to_string()) && refused.contains(&limits.memory.to_string()), "{refused}");
        // a map much larger than its photo counts, too
        assert!(Options::default().memory(&with_map((80, 60), (8000, 6000))) > 700 << 20);
        let small = Options { tile: TileSize::Pixels(8), ..Options::default() };
        assert!(small.memory(&Sizes::of_photo((4000, 3000))) > Options::default().memory(&Sizes::of_photo((4000, 3000))) + (500 << 20));
    }

    #[test]
    fn a_file_too_large_to_decode_is_rejected_with_any_options() {
        let limits = |mib: u64| Limits { memory: mib << 20, ..Limits::default() };
        let (file, options) = ((8160, 6120), Options::default());
        // 128 MiB, and 16 bytes for each of 50 megapixels
        let refused = options.check_decoded(file, &limits(889)).unwrap_err();
        assert_eq!(refused.to_string(), options.side_by_memory(&Sizes::of_photo(file), &limits(889)).unwrap_err().to_string());
        assert!(options.check_decoded(file, &limits(891)).is_ok());
        for planes in [PlaneCount::Auto, PlaneCount::Fixed(1)] {
            for tile in [TileSize::Full, TileSize::Pixels(8)] {
                for max_size in [None, Some(1), Some(2000)] {
                    let options = Options { planes, tile, max_size, ..Options::default() };
                    for map in [None, Some((80, 60)), Some(file)] {
                        let sizes = Sizes { extra: map.map(ExtraPicture::DepthMap), ..Sizes::of_photo(file) };
                        assert!(options.side_by_memory(&sizes, &limits(889)).is_err(), "{options:?} {map:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn measuring_counts_wherever_the_second_picture_is() {
        let (auto, eye) = (Options::default(), (4000, 3000));
        let alone = auto.memory(&Sizes::of_photo(eye));
        assert_eq!(auto.memory(&with_eye(eye, eye)), alone + STEREO);
        let halves = |stereo| Options { stereo, ..Options::default() };
        assert_eq!(halves(Stereo::LeftRight).memory(&Sizes::of_photo((8000, 3000))), alone + STEREO);
        assert_eq!(halves(Stereo::Rgbd).memory(&Sizes::of_photo((8000, 3000))), alone);
        assert_eq!(halves(Stereo::TopBottom).memory(&Sizes::of_photo((4000, 6000))), alone + STEREO);
        // `max_size` applies to one half, but both halves are decoded
        let small = Options { max_size: Some(1000), ..halves(Stereo::LeftRight) };
        assert_eq!(small.memory(&Sizes::of_photo((8000, 3000))), decoding_bytes((8000, 3000)) + 750_000 * PHOTO);
        let side = small.memory_with(&Sizes::of_photo((2000, 750)), Some(1000), 6);
        assert_eq!(side, auto.memory_with(&with_eye((1000, 750), (1000, 750)), None, 6));
        // a second picture much larger than the first counts, too
        assert_eq!(auto.memory(&with_eye((80, 60), (8000, 6000))), decoding_bytes((8000, 6000)) + 4800 * PHOTO);
    }

    #[test]
    fn errors_name_a_depth_map_or_second_picture_that_does_not_fit() {
        let limits = Limits { memory: 600 << 20, ..Limits::default() };
        let options = Options::default();
        let second = options.side_by_memory(&with_eye((2000, 1500), (8000, 6000)), &limits).unwrap_err();
        assert!(matches!(&second, MakeError::Depth(DepthError::Second(text)) if text.contains(&limits.memory.to_string())), "{second}");
        let map = options.side_by_memory(&with_map((2000, 1500), (8000, 6000)), &limits).unwrap_err();
        assert!(matches!(map, MakeError::Depth(DepthError::Map(_))), "{map}");
        // each fits on its own, and both are reduced to fit together with measuring
        let both = with_eye((6000, 4000), (6000, 4000));
        let side = options.side_by_memory(&both, &limits).unwrap().expect("it does not fit as it is");
        assert!(options.memory_at(&both, Some(side)) <= limits.memory);
        assert!(side < options.side_by_memory(&Sizes::of_photo((6000, 4000)), &limits).unwrap().unwrap());
        // halves are reduced, too, by the longest side of one half
        let halves = Options { stereo: Stereo::LeftRight, ..options };
        let side = halves.side_by_memory(&Sizes::of_photo((7000, 4000)), &limits).unwrap().expect("it does not fit as it is");
        assert!(halves.memory_at(&Sizes::of_photo((7000, 4000)), Some(side)) <= limits.memory && side < 4000);
    }

    #[test]
    fn a_photo_too_large_for_memory_is_reduced_but_not_below_the_size_of_a_screen() {
        let limits = |mib: u64| Limits { memory: mib << 20, ..Limits::default() };
        let options = Options::default();
        for (file, mib) in [((8160, 6120), 960), ((6120, 8160), 1500), ((6000, 4000), 600), ((12_000, 4000), 2000), ((1633, 1225), 240)] {
            let limits = limits(mib);
            let side = options.side_by_memory(&Sizes::of_photo(file), &limits).unwrap().expect("it does not fit as it is");
            let at = |side| Options { max_size: Some(side), ..options.clone() }.memory(&Sizes::of_photo(file));
            assert!(at(side) <= limits.memory && at(side + 8) > limits.memory, "{file:?}: {side}");
            assert_eq!(options.fitted(&Sizes::of_photo(file), &limits).unwrap().max_size, Some(side));
        }
        // decoding the first exceeds the limit; the second fits only below 1.5 megapixels
        for (file, mib) in [((8160, 6120), 256), ((3000, 2000), 200)] {
            let refused = options.side_by_memory(&Sizes::of_photo(file), &limits(mib)).unwrap_err().to_string();
            assert!(refused.contains(&options.memory(&Sizes::of_photo(file)).to_string()), "{refused}");
        }
        let smaller = Options { max_size: Some(2000), ..Options::default() };
        assert_eq!(smaller.side_by_memory(&Sizes::of_photo((8160, 6120)), &limits(960)).unwrap(), None);
    }
}
