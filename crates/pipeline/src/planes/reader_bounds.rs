//! Checks options against the bounds of container readers.

use crate::StageError;
use crate::run::{Options, PlaneCount, TileSize};
use tmpi_core::Grid;
use tmpi_core::container::most_planes;

impl Options {
    /// The grid of tiles of a scene of this size in pixels.
    pub fn grid(&self, width: u32, height: u32) -> Grid {
        match self.tile {
            TileSize::Pixels(size) => Grid::new(width, height, size),
            TileSize::Full => Grid::full(width, height),
        }
    }

    /// Rejects options that, for a scene of this size in pixels, could give a container beyond the bounds of readers.
    ///
    /// # Errors
    /// [`StageError::Bound`] names the option and its bound.
    pub fn check_readable(&self, width: u32, height: u32) -> Result<(), StageError> {
        let most = most_planes(&self.grid(width, height));
        if most == 0 {
            let detail = format!("tiles this small are too many for {width}×{height} pixels: readers limit the work of deriving texels");
            return Err(StageError::Bound { field: "tile", detail });
        }
        match self.planes {
            PlaneCount::Fixed(n) if n > most => {
                let detail =
                    format!("{n} planes per tile exceed the {most} that readers accept for {width}×{height} pixels with this tile size");
                Err(StageError::Bound { field: "planes", detail })
            }
            PlaneCount::Fixed(_) | PlaneCount::Auto => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth::DepthKind;
    use crate::photo::Limits;
    use crate::run::{Denoise, MakeError, Models, PlaneMethod, Report, Silent, Switch, make};
    use image::{Rgb, RgbImage};
    use tmpi_core::{DisparityMap, ViewBox, container};
    use tmpi_testing::pictures::{jpeg, noise};

    #[test]
    fn planes_at_the_bound_pass_and_one_more_is_rejected_by_name() {
        let tile = TileSize::Pixels(8);
        let most = most_planes(&Grid::new(640, 480, 8));
        let at = |n| Options { tile, planes: PlaneCount::Fixed(n), ..Options::default() }.check_readable(640, 480);
        assert!(most < 64 && at(most).is_ok());
        assert!(matches!(at(most + 1), Err(StageError::Bound { field: "planes", .. })));
        let small = Options { tile, ..Options::default() }.check_readable(8192, 6000);
        assert!(matches!(small, Err(StageError::Bound { field: "tile", .. })));
        assert!(Options::default().check_readable(8192, 6000).is_ok());
    }

    /// Noise as a JPEG and a depth map: each pixel has its own depth.
    fn noisy(w: u32, h: u32) -> (Vec<u8>, Vec<u8>) {
        let photo = RgbImage::from_fn(w, h, |x, y| Rgb([0, 1, 2].map(|c| (256.0 * noise(3 * x + c, y)) as u8)));
        (jpeg(photo, 90), crate::depth::to_png(&DisparityMap::from_fn(w, h, |x, y| noise(x, y + h))).unwrap())
    }

    /// Makes a photo and reads its container and levels. Returns false if the options were rejected with the option's name; panics if the
    /// container is unreadable or making fails otherwise.
    fn makes_readable_photo(models: &Models, (w, h): (u32, u32), files: &(Vec<u8>, Vec<u8>), options: &Options) -> bool {
        match make(models, &Limits::default(), &files.0, Some(&files.1), options, &Silent) {
            Ok(got) => {
                let scene = container::decode(&got.container);
                assert!(scene.is_ok(), "{options:?}: {:?}", scene.err());
                for level in 1..=container::LEVELS {
                    let small = container::level(&got.container, level).unwrap();
                    assert!(container::decode(&small).is_ok(), "level {level} of {options:?}");
                }
                // JSON has no NaN or infinity, so a figure that is not finite would not survive this round trip
                let report = serde_json::to_vec(&got.report).unwrap();
                assert_eq!(serde_json::from_slice::<Report>(&report).unwrap(), got.report, "{options:?}");
                true
            }
            Err(MakeError::Generate(StageError::Bound { .. })) => {
                assert!(options.check_readable(w, h).is_err(), "{options:?} were rejected late");
                false
            }
            Err(e) => panic!("{options:?}: {e}"),
        }
    }

    fn models() -> Models {
        crate::networks::models::load(&crate::networks::models::Settings::default()).unwrap()
    }

    /// Options at the extremes of tile size, planes, error, view box and camera, for a photo of `w` × `h` pixels.
    fn extremes(w: u32, h: u32) -> Vec<Options> {
        let mut all = Vec::new();
        let wide = ViewBox { x: 10.0, y: 10.0, z: 10.0 };
        for tile in [8, 16, 1024].map(TileSize::Pixels).into_iter().chain([TileSize::Full]) {
            let most = most_planes(&Options { tile, ..Options::default() }.grid(w, h)).clamp(1, 64);
            for planes in [PlaneCount::Auto, PlaneCount::Fixed(1), PlaneCount::Fixed(most), PlaneCount::Fixed(64)] {
                all.push(Options { tile, planes, max_error: 0.0, view_box: wide, ..Options::default() });
            }
        }
        let none = ViewBox { x: 0.0, y: 0.0, z: 0.0 };
        all.push(Options { view_box: none, quality: 1, max_error: 1000.0, ..Options::default() });
        all.push(Options { fov_x: Some(0.001), quality: 100, ..Options::default() });
        all.push(Options { fov_x: Some(179.999), ..Options::default() });
        all.push(Options { max_size: Some(1), ..Options::default() });
        all
    }

    #[test]
    fn every_choice_and_both_ends_of_every_range_make_a_readable_photo() {
        let (w, h) = (64, 48);
        let (models, files) = (models(), noisy(w, h));
        let mut count = 0;
        let mut one = |options: &Options| {
            assert!(makes_readable_photo(&models, (w, h), &files, options), "{options:?} were rejected");
            count += 1;
        };
        let number = |x: f64| ViewBox { x, y: x, z: x };
        let low = |options: &Options| Options {
            fov_x: Some(1e-3),
            planes: PlaneCount::Fixed(1),
            max_size: Some(1),
            quality: 1,
            max_error: 0.0,
            view_box: number(0.0),
            budget_ms: Some(1.0),
            ..options.clone()
        };
        let high = |options: &Options| Options {
            fov_x: Some(179.999),
            planes: PlaneCount::Fixed(64),
            max_size: Some(Limits::SIDE),
            quality: 100,
            max_error: 1e3,
            view_box: number(10.0),
            budget_ms: Some(1e7),
            ..options.clone()
        };
        for plane_method in [PlaneMethod::Linear, PlaneMethod::Lloyd, PlaneMethod::Optimal, PlaneMethod::Slanted] {
            for tile in [TileSize::Pixels(8), TileSize::Pixels(1024), TileSize::Full] {
                let options = Options { plane_method, tile, ..Options::default() };
                for options in [options.clone(), low(&options), high(&options), Options { max_size: None, ..low(&options) }] {
                    one(&options);
                }
            }
        }
        for depth_kind in [DepthKind::Disparity, DepthKind::Metric] {
            // without choices that need a network's file: they are rejected without it
            for denoise in [Denoise::Auto, Denoise::Classic, Denoise::Off] {
                for snap in [Switch::Auto, Switch::On, Switch::Off] {
                    for refine in [Switch::Auto, Switch::Off] {
                        let photo_depth = if refine == Switch::Auto { Switch::On } else { Switch::Off };
                        one(&Options { depth_kind, denoise, snap, refine, photo_depth, verify_prune: true, ..Options::default() });
                    }
                }
            }
        }
        assert_eq!(count, 4 * 3 * 4 + 2 * 3 * 3 * 2);
    }

    #[test]
    fn extreme_options_make_readable_photos() {
        let (w, h) = (96, 64);
        let (models, files) = (models(), noisy(w, h));
        let all = extremes(w, h);
        assert_eq!(all.len(), 20);
        assert!(all.iter().all(|options| makes_readable_photo(&models, (w, h), &files, options)));
    }

    #[test]
    fn at_twelve_megapixels_five_extreme_options_are_rejected() {
        // tiles of 8 pixels with any number of planes, and 64 planes in tiles of 16 pixels
        let rejected: Vec<Options> = extremes(4000, 3000).into_iter().filter(|o| o.check_readable(4000, 3000).is_err()).collect();
        let tiles: Vec<TileSize> = rejected.iter().map(|o| o.tile).collect();
        assert_eq!(tiles, [[TileSize::Pixels(8); 4].as_slice(), &[TileSize::Pixels(16)]].concat());
        assert_eq!(rejected[4].planes, PlaneCount::Fixed(64));
    }
}
