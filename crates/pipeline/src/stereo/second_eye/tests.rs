//! A square in front of a wall, as two eyes see it, and the projection against its definition.

use std::ops::Range;
use std::sync::Arc;

use image::{ImageFormat, RgbImage};
use proptest::prelude::*;
use tmpi_core::{
    Class, DisparityMap, Geometry, Grid, Intrinsics, LayerMasks, Plane, TexturedLayer, Tile, ViewBox, container, texture_with,
};
use tmpi_testing::pictures::encoded;

use super::super::tests::spots;
use super::super::{FusedDisparity, Stereo, StereoFigures, measure};
use super::*;
use crate::layers::{Seen, recolour};
use crate::photo::Limits;
use crate::{Models, Options, Silent, make};

const W: u32 = 400;
const H: u32 = 280;
/// Disparity of the wall and of the square, in pixels.
const SHIFTS: [u32; 2] = [4, 52];
/// Columns and rows of the square in the first picture.
const SQUARE: [Range<u32>; 2] = [150..290, 60..220];
/// Part of the wall that the square hides from the first eye alone, without a margin in which the square's outlines blur.
const STRIP: [Range<u32>; 2] = [250..290, 70..210];

fn within(range: &[Range<u32>; 2], x: u32, y: u32) -> bool {
    range[0].contains(&x) && range[1].contains(&y)
}

/// Spots of all colours.
fn coloured(seed: u32) -> Photo {
    let channels = [0, 1, 2].map(|c| spots(W + SHIFTS[1], H, seed + c));
    Photo::from_fn(W + SHIFTS[1], H, |x, y| [0, 1, 2].map(|c: usize| channels[c].at(x, y)[0] / 2 + 50))
}

/// What an eye sees from which wall and square lie so many pixels further to the left.
fn seen_by_eye([wall, square]: [u32; 2]) -> Photo {
    let (far, near) = (coloured(1), coloured(11));
    Photo::from_fn(W, H, |x, y| if within(&SQUARE, x + square, y) { near.at(x + square, y) } else { far.at(x + wall, y) })
}

/// The picture from right to left.
fn mirrored(photo: &Photo, mirror: bool) -> Photo {
    Photo::from_fn(photo.width, photo.height, |x, y| photo.at(if mirror { photo.width - 1 - x } else { x }, y))
}

/// The picture with `share` of the light.
fn exposed(photo: &Photo, share: f64) -> Photo {
    let level = |v: u8| {
        let v = f64::from(v) / 255.0;
        let light = share * if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) };
        let v = if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 };
        (v * 255.0).round() as u8
    };
    Photo { rgb: photo.rgb.iter().map(|p| p.map(level)).collect(), ..*photo }
}

/// A pair, and where its square and strip are.
struct Pair {
    first: Photo,
    second: Photo,
    mirror: bool,
}

impl Pair {
    fn new(mirror: bool, exposure: f64) -> Self {
        let second = exposed(&seen_by_eye(SHIFTS), exposure);
        Self { first: mirrored(&seen_by_eye([0, 0]), mirror), second: mirrored(&second, mirror), mirror }
    }

    fn column(&self, x: u32) -> u32 {
        if self.mirror { W - 1 - x } else { x }
    }

    fn fused(&self) -> FusedDisparity {
        let estimate = DisparityMap::from_fn(W, H, |x, y| u8::from(within(&SQUARE, self.column(x), y)).into());
        measure(&self.first, &self.second).unwrap().fuse(&self.first, &estimate)
    }

    /// The exact planes and labels.
    fn geometry(&self, figures: &StereoFigures) -> Geometry {
        let delta = |shift: u32| (f64::from(shift) - figures.infinity_px) / (figures.nearest_px - figures.infinity_px);
        let planes = SHIFTS.map(|shift| Plane::fronto_parallel(delta(shift)).quantised()).to_vec();
        let grid = Grid::new(W, H, 64);
        let tile = |t: u32| {
            let r = grid.rect(t);
            let label = |i: u32| u8::from(within(&SQUARE, self.column(r.x + i % r.w), r.y + i / r.w));
            Tile { planes: planes.clone(), labels: (0..r.area() as u32).map(label).collect(), background: None }
        };
        let view_box = ViewBox { x: 0.2, y: 0.05, z: 0.0 };
        let tiles = (0..grid.tiles()).map(tile).collect();
        Geometry { grid, intrinsics: Intrinsics::centred(W, H, 300.0), view_box, tiles, matted: false, short_reach: false }
    }

    /// PSNR of the hidden colours of the strip, in the order of the masks, against the wall.
    fn psnr(&self, masks: &[LayerMasks], hidden: &[[u8; 3]]) -> f64 {
        let wall = coloured(1);
        let (mut squares, mut count) = (0.0, 0.0);
        for ((x, y), colour) in places(masks).zip(hidden) {
            let x = self.column(x);
            if within(&STRIP, x, y) {
                squares += wall.at(x, y).iter().zip(colour).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum::<f64>();
                count += 3.0;
            }
        }
        assert!(count > 3000.0, "{count} values");
        10.0 * (255.0 * 255.0 * count / squares).log10()
    }
}

/// Positions of all hidden texels.
fn places(masks: &[LayerMasks]) -> impl Iterator<Item = (u32, u32)> {
    masks.iter().flat_map(|m| &m.layers).flat_map(|l| {
        let hidden = (0u32..).zip(&l.class).filter(|(_, c)| **c == Class::Hidden as u8);
        hidden.map(move |(i, _)| (l.rect.x + i % l.rect.w, l.rect.y + i / l.rect.w))
    })
}

fn colours(tiles: &[Vec<TexturedLayer>]) -> Vec<[u8; 3]> {
    tiles.iter().flatten().flat_map(|l| l.hidden.clone()).collect()
}

/// Hidden colours without and with the second eye.
fn textured(pair: &Pair, eye: &SecondEye, geometry: &Geometry, delta: &DisparityMap) -> (Seen, [Vec<[u8; 3]>; 2]) {
    let mut seen = Seen::default();
    let mut inpainted = Vec::new();
    let tiles = texture_with(&pair.first, geometry, geometry.masks(), |tiles| {
        inpainted = colours(tiles);
        seen = recolour((eye, &pair.second), geometry, delta, tiles);
    });
    (seen, [inpainted, colours(&tiles)])
}

#[test]
fn the_strip_behind_a_silhouette_is_taken_from_the_second_eye_whichever_it_is_and_however_exposed() {
    for (mirror, exposure) in [(false, 1.0), (true, 1.0), (false, 0.6), (true, 1.5)] {
        let pair = Pair::new(mirror, exposure);
        let FusedDisparity { map, figures, second: eye, .. } = pair.fused();
        assert_eq!(figures.crossed, mirror);
        let gain = exposure.powf(-1.0 / 2.4);
        assert!((figures.gain - gain).abs() < 0.02, "{} of {gain}", figures.gain);
        let geometry = pair.geometry(&figures);
        let (seen, hidden) = textured(&pair, &eye, &geometry, &map);
        let [without, with] = hidden.map(|hidden| pair.psnr(&geometry.masks(), &hidden));
        assert!(seen.used && seen.seen < seen.hidden, "{seen:?}");
        assert!(with > without + 10.0 && with > 25.0, "mirrored {mirror}, exposure {exposure}: {with} dB, {without} dB without");
    }
}

#[test]
fn colours_of_the_square_do_not_spill_onto_the_wall() {
    let pair = Pair::new(false, 1.0);
    // the square alone is red
    let red = |photo: &Photo, shift: u32| {
        Photo::from_fn(W, H, |x, y| {
            let [r, g, b] = photo.at(x, y);
            if within(&SQUARE, x + shift, y) { [r / 4 + 190, g / 8, b / 8] } else { [r / 8, g, b] }
        })
    };
    let pair = Pair { first: red(&pair.first, 0), second: red(&pair.second, SHIFTS[1]), ..pair };
    let FusedDisparity { map, figures, second: eye, .. } = pair.fused();
    let geometry = pair.geometry(&figures);
    let (seen, [_, hidden]) = textured(&pair, &eye, &geometry, &map);
    assert!(seen.used, "{seen:?}");
    let spilled = hidden.iter().filter(|c| c[0] > 110).count();
    assert!(spilled * 200 < seen.seen, "{spilled} of {seen:?}");
}

#[test]
fn a_gap_takes_the_disparity_of_several_pixels_behind_it() {
    let row = |gap: usize| [vec![52.0; 12], vec![f32::NAN; gap], vec![7.0, 6.0], vec![4.0; 12]].concat();
    let filled = |mut row: Vec<f32>| {
        let w = row.len();
        fill_hidden(&mut row, w);
        row
    };
    let want = [vec![52.0_f32; 12], vec![4.0; 40], vec![7.0, 6.0], vec![4.0; 12]].concat();
    assert_eq!(filled(row(40)), want);
    let mirrored = |row: Vec<f32>| row.into_iter().rev().collect::<Vec<_>>();
    assert_eq!(filled(mirrored(row(40))), mirrored(want));
    // wider than the step hides
    assert_eq!(filled(row(90)).iter().filter(|d| d.is_nan()).count(), 90);
    // nothing known on one side, or on both
    for row in [vec![f32::NAN; 9], [vec![f32::NAN; 9], vec![3.0; 4]].concat()] {
        assert_eq!(filled(row).iter().filter(|d| d.is_nan()).count(), 9);
    }
}

#[test]
fn an_eye_that_shows_too_little_changes_nothing() {
    type Change = fn(usize, f32) -> f32;
    let pair = Pair::new(false, 1.0);
    let FusedDisparity { map, figures, second: eye, .. } = pair.fused();
    let geometry = pair.geometry(&figures);
    let unlike: [(bool, Change); 4] = [
        (false, |_, _| f32::NAN),
        // nearer than the whole scene
        (false, |_, _| 90.0),
        (false, |_, _| f32::INFINITY),
        // three rows alone
        (true, |y, d| if (140..143).contains(&y) { d } else { f32::NAN }),
    ];
    for (sees, change) in unlike {
        let disparity = eye.disparity.iter().enumerate().map(|(i, d)| change(i / W as usize, *d)).collect();
        let (seen, [before, after]) = textured(&pair, &SecondEye { disparity, ..eye.clone() }, &geometry, &map);
        assert!((seen.seen > 0) == sees && !seen.used && seen.hidden == before.len(), "{seen:?}");
        assert!(before == after);
    }
}

#[test]
fn values_that_are_not_finite_show_nothing() {
    let pair = Pair::new(false, 1.0);
    let FusedDisparity { map, figures, second: eye, .. } = pair.fused();
    let geometry = pair.geometry(&figures);
    let [far, near] = [0, 1].map(|i: usize| geometry.tiles[0].planes[i].a as f32);
    let at = |delta: f32, visible: f32| eye.colour(&pair.second, (270, 140), delta, visible);
    assert!(at(far, near).is_some());
    // a point that the first picture shows is not behind anything
    assert_eq!((at(far, far), at(near, far)), (None, None));
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        assert_eq!((at(bad, near), at(far, bad), at(bad, bad)), (None, None, None), "{bad}");
        let holes =
            DisparityMap { delta: map.delta.iter().enumerate().map(|(i, d)| if i.is_multiple_of(7) { bad } else { *d }).collect(), ..map };
        let (seen, [inpainted, hidden]) = textured(&pair, &eye, &geometry, &holes);
        let masks = geometry.masks();
        let mut unknown = places(&masks).zip(inpainted.iter().zip(&hidden)).filter(|((x, y), _)| (y * W + x).is_multiple_of(7));
        assert!(seen.used && unknown.all(|(_, (a, b))| a == b), "{bad}: {seen:?}");
    }
    assert_eq!((at(f32::MAX, near), at(f32::MIN, near)), (None, None));
}

#[test]
fn a_container_carries_what_the_second_eye_shows() {
    let pair = Pair::new(false, 0.8);
    let file = |photo: &Photo| encoded(RgbImage::from_vec(W, H, photo.rgb.as_flattened().to_vec()).unwrap(), ImageFormat::Png);
    let even = |photo: &Photo| Ok(DisparityMap::from_fn(photo.width, photo.height, |_, _| 0.5));
    let models = Models { depth: Arc::new(("even", even)), theta: None, psi: None };
    let options = Options { stereo: Stereo::Beside, ..Options::default() };
    let made = make(&models, &Limits::default(), &file(&pair.first), Some(&file(&pair.second)), &options, &Silent).unwrap();
    let (report, figures) = (&made.report, made.report.error.stereo.unwrap());
    let section = container::sections(&made.container).unwrap().into_iter().find(|s| s.kind == "hidden").unwrap();
    assert_eq!((section.length, section.codec), (report.bytes.hidden as u64, "jpeg"));
    assert!(figures.hidden_seen * 20 >= figures.hidden && figures.hidden_seen < figures.hidden, "{figures:?}");
    assert!(report.error.hidden_psnr.unwrap() > 25.0 && report.error.identity_psnr > 25.0, "{:?}", report.error);
    let geometry = container::read_geometry(&made.container).unwrap();
    let masks = geometry.masks();
    assert!(geometry.matted && places(&masks).count() == figures.hidden);
    let psnr = |bytes: &[u8]| pair.psnr(&masks, &container::carried_colours(&geometry, &container::decode(bytes).unwrap()).unwrap());
    // without the section, readers derive the colours
    let derived = container::select(&made.container, &["photo", "planes", "labels"]).unwrap();
    let [with, without] = [psnr(&made.container), psnr(&derived)];
    assert!(with > without + 6.0, "{with} dB, {without} dB without");
}

proptest! {
    /// Reference in units of the pictures' widths, by the definition of the model.
    #[test]
    fn a_point_is_projected_by_definition(
        at in (0u32..300, 0u32..200), disparity in -40.0..40.0f64, terms in prop::array::uniform5(-0.05..0.05f64), crossed: bool,
        sizes in ((300u32..400, 200u32..300), (100usize..300, 80usize..200), (90usize..500, 90usize..400)),
    ) {
        let (first, size, second) = sizes;
        let [offset, roll, scale, yaw, pitch] = terms;
        let model = Model { offset, roll, scale, yaw, pitch };
        let eye = SecondEye { first, size, model, disparity: Vec::new(), scale: (0.0, 1.0), crossed, gains: [1.0; 3] };
        let got = scaled(model.place(eye.rectified(at, disparity), size), size, second);
        let [w, h] = [size.0, size.1].map(|n| n as f64);
        let side = if crossed { -1.0 } else { 1.0 };
        let u = (f64::from(at.0) + 0.5) / f64::from(first.0) - 0.5 - side * disparity / w;
        let v = ((f64::from(at.1) + 0.5) / f64::from(first.1) - 0.5) * h / w;
        let right = u - roll * v + scale * u + yaw * u * u + pitch * u * v;
        let down = v + offset + roll * u + scale * v + yaw * u * v + pitch * v * v;
        let want = ((right + 0.5) * second.0 as f64 - 0.5, (down * w / h + 0.5) * second.1 as f64 - 0.5);
        prop_assert!((got.0 - want.0).abs() < 1e-9 && (got.1 - want.1).abs() < 1e-9, "{got:?}, not {want:?}");
    }

    /// Between pixels, levels are a weighted mean of the four around; outside there are none.
    #[test]
    fn a_picture_is_sampled_by_definition(w in 1u32..6, h in 1u32..6, at in (-2.0..8.0f64, -2.0..8.0f64), seed in 0u32..1000) {
        let photo = Photo::from_fn(w, h, |x, y| [0, 1, 2].map(|c| ((x * 7 + y * 31 + c * 5 + seed).wrapping_mul(0x9E37_79B1) >> 24) as u8));
        let inside = |p: f64, n: u32| p >= -0.5 && p <= f64::from(n) - 0.5;
        let got = sample(&photo, at);
        prop_assert_eq!(got.is_some(), inside(at.0, w) && inside(at.1, h));
        let Some(got) = got else { return Ok(()) };
        let place = (at.0.clamp(0.0, f64::from(w - 1)), at.1.clamp(0.0, f64::from(h - 1)));
        for (c, got) in got.into_iter().enumerate() {
            let texels = (0..h).flat_map(|y| (0..w).map(move |x| (x, y)));
            let share = |x: u32, y: u32| (1.0 - (f64::from(x) - place.0).abs()).max(0.0) * (1.0 - (f64::from(y) - place.1).abs()).max(0.0);
            let want: f64 = texels.map(|(x, y)| share(x, y) * f64::from(photo.at(x, y)[c])).sum();
            prop_assert!((got - want).abs() < 1e-9, "{got}, not {want}");
        }
    }
}
