//! Scenes for the tests of several crates.
#![allow(clippy::unwrap_used, clippy::missing_panics_doc, reason = "for tests alone")]

use super::{EncodedPhoto, OptionalSections, PhotoFormat, encode_in, encode_lossless};
use crate::{Geometry, Grid, Intrinsics, MATTE_BAND, Photo, Plane, Scene, TexturedLayer, Tile, ViewBox, compose};

/// Near discs in front of a slanted wall; some tiles have background planes, some alphas are refined, and hidden colours survive JPEG well.
pub fn discs(width: u32, height: u32) -> (Geometry, Scene) {
    let grid = Grid::new(width, height, 64);
    let photo = Photo::from_fn(width, height, |x, y| [(x * 255 / width) as u8, (y * 255 / height) as u8, 90]);
    let disc = |x: u32, y: u32| (x % 41).abs_diff(20).pow(2) + (y % 37).abs_diff(18).pow(2) < 150;
    let tiles = (0..grid.tiles())
        .map(|t| {
            let r = grid.rect(t);
            let labels: Vec<u8> = (0..r.h).flat_map(|y| (0..r.w).map(move |x| u8::from(disc(r.x + x, r.y + y)))).collect();
            Tile {
                planes: vec![Plane { a: 0.25, b: 0.125, c: -0.0625 }, Plane::fronto_parallel(0.75)],
                labels,
                background: (t % 2 == 1).then(|| Plane::fronto_parallel(0.05).quantised()),
            }
        })
        .collect();
    let geometry =
        Geometry { grid, intrinsics: Intrinsics::centred(width, height, 300.0), view_box: ViewBox::cube(0.03), tiles, matte_band: 0 };
    let coloured = geometry
        .masks()
        .into_iter()
        .map(|s| {
            let hidden = |class: &[u8]| vec![[120, 130, 140]; class.iter().filter(|c| **c == 2).count()];
            s.layers.into_iter().map(|shape| TexturedLayer { hidden: hidden(&shape.class), shape }).collect()
        })
        .collect();
    let mut scene = compose(photo, &geometry, coloured);
    for a in scene.texels.alpha.iter_mut().filter(|a| (1..255).contains(*a)).step_by(3) {
        *a = 17;
    }
    assert_eq!(scene.validate(), Ok(()));
    (geometry, scene)
}

/// The same scene matted, with a photo in which the discs are red with soft outlines. Use only its planes, labels and photo.
pub fn matted((mut geometry, mut scene): (Geometry, Scene)) -> (Geometry, Scene) {
    geometry.matte_band = MATTE_BAND;
    let width = scene.photo.width;
    for (i, colour) in (0..).zip(&mut scene.photo.rgb) {
        let off = |at: u32, period: u32, middle: u32| f64::from(at % period) - f64::from(middle);
        let from_middle = off(i % width, 41, 20).hypot(off(i / width, 37, 18));
        let share = (12.25 + 1.5 - from_middle).clamp(0.0, 3.0) / 3.0;
        for (c, disc) in colour.iter_mut().zip([230.0, 40.0, 30.0]) {
            *c = (disc * share + f64::from(*c) * (1.0 - share)).round() as u8;
        }
    }
    (geometry, scene)
}

/// The same scene with planes that differ from tile to tile, as in photos. Use only its planes and labels.
pub fn rough((mut geometry, scene): (Geometry, Scene)) -> (Geometry, Scene) {
    let planes = geometry.tiles.iter_mut().flat_map(|t| t.planes.iter_mut().chain(&mut t.background));
    for (i, p) in (1u32..).zip(planes) {
        let share = |k: u32| f64::from(i.wrapping_mul(k) >> 16) / 65_536.0 - 0.5;
        *p = Plane { a: p.a * (1.0 + share(0x9E37_79B1) / 4.0), b: p.a * share(0x85EB_CA77) / 2.0, c: p.a * share(0xC2B2_AE3D) / 2.0 }
            .quantised();
    }
    (geometry, scene)
}

/// A container with only photo (lossless PNG), planes, and labels in bands of `rows` rows of tiles or in a single stream.
pub fn bare_in(rows: Option<u32>, (geometry, s): &(Geometry, Scene)) -> Vec<u8> {
    let png = encode_lossless(image::ImageFormat::Png, s.photo.width, s.photo.height, s.photo.rgb.as_flattened()).unwrap();
    let photo = EncodedPhoto { bytes: png, format: PhotoFormat::Png };
    encode_in(rows, geometry, s, &photo, OptionalSections::default()).unwrap().0
}
