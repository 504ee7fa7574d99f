#![allow(clippy::unwrap_used, clippy::float_cmp, reason = "test")]
use proptest::prelude::*;

use super::borders::owned;
use super::matte::{Matte, Mattes, Side};
use crate::layers::{Tile, TileFrame};
use crate::{Class, Geometry, Grid, Intrinsics, MATTE_BAND, Photo, Plane, TexturedLayer, ViewBox, texture};

/// `α F + (1 − α) B`, rounded.
fn over(m: Matte) -> [u8; 3] {
    let share = f64::from(m.alpha) / 255.0;
    std::array::from_fn(|c| (f64::from(m.foreground[c]) * share + f64::from(m.background[c]) * (1.0 - share)).round() as u8)
}

fn side(colours: &[([u8; 3], u32)]) -> Side {
    let mut side = Side::default();
    for (c, w) in colours {
        side.add(*c, *w);
    }
    side
}

/// Reference in `f64`: mean, variance summed over the channels, and weight of some colours.
fn statistics(all: &[([u8; 3], u32)]) -> ([f64; 3], f64, f64) {
    let weight: f64 = all.iter().map(|(_, w)| f64::from(*w)).sum();
    let mean: [f64; 3] = std::array::from_fn(|c| all.iter().map(|(p, w)| f64::from(p[c]) * f64::from(*w)).sum::<f64>() / weight);
    let off = |p: [u8; 3]| (0..3).map(|c| (f64::from(p[c]) - mean[c]).powi(2)).sum::<f64>();
    (mean, all.iter().map(|(p, w)| off(*p) * f64::from(*w)).sum::<f64>() / weight, weight)
}

/// A colour between two sides.
struct Between {
    /// Share of the near side, 0 to 1.
    share: f64,
    /// Whether the sides can be told apart, and whether the colour is a mixture of them.
    told: bool,
    mixed: bool,
}

/// Reference in `f64`.
fn between(colour: [u8; 3], near: &[([u8; 3], u32)], far: &[([u8; 3], u32)]) -> Between {
    let ((near, near_off, _), (far, far_off, _)) = (statistics(near), statistics(far));
    let along: Vec<f64> = (0..3).map(|c| near[c] - far[c]).collect();
    let apart: f64 = along.iter().map(|v| v * v).sum();
    let dot: f64 = (0..3).map(|c| (f64::from(colour[c]) - far[c]) * along[c]).sum();
    let share = (dot / apart).clamp(0.0, 1.0);
    let off: f64 = (0..3).map(|c| (f64::from(colour[c]) - far[c] - share * along[c]).powi(2)).sum();
    let told = apart >= 24.0 * 24.0 && apart >= 4.0 * (near_off + far_off);
    Between { share, told, mixed: told && off <= 0.0625 * apart && share * 255.0 >= 0.5 }
}

fn colours() -> impl Strategy<Value = Vec<([u8; 3], u32)>> {
    let noise = prop_oneof![Just(0u8), Just(8), Just(20), Just(200)];
    (any::<[u8; 3]>(), noise, prop::collection::vec((any::<[u8; 3]>(), 1u32..17), 1..30)).prop_map(|(base, noise, all)| {
        let near = |c: u8, n: u8| (i32::from(c) + i32::from(n) * i32::from(noise) / 255 - i32::from(noise) / 2).clamp(0, 255) as u8;
        all.into_iter().map(|(p, w)| (std::array::from_fn(|c| near(base[c], p[c])), w)).collect()
    })
}

proptest! {
    #[test]
    fn a_matte_composites_to_its_colour_and_alpha_matches_a_reference_projection(
        at in -0.2..1.2f64, noise in any::<[u8; 3]>(), near in colours(), far in colours(),
    ) {
        let mix = |c: usize| f64::from(near[0].0[c]) * at + f64::from(far[0].0[c]) * (1.0 - at) + f64::from(noise[c] / 8) - 16.0;
        let colour = std::array::from_fn(|c| mix(c) as u8);
        let Between { share, mixed, .. } = between(colour, &near, &far);
        let got = Mattes::of(colour, &side(&near), &side(&far)).mixture;
        prop_assert_eq!(got.is_some(), mixed);
        let Some(got) = got else { return Ok(()) };
        prop_assert_eq!(over(got), colour);
        // alpha is larger only if no foreground could be that bright or dark
        let least = |c: usize| {
            let (v, b) = (f64::from(colour[c]), f64::from(got.background[c]));
            if v < b { (b - v) / b } else { (v - b) / (255.0 - b).max(1e-9) }
        };
        let most = (0..3).map(least).fold(share, f64::max);
        let alpha = f64::from(got.alpha);
        prop_assert!(alpha >= 255.0 * share - 0.5 - 1e-9 && (alpha <= 255.0 * most + 1.0 || alpha == 255.0 && most > 0.98), "{alpha} {share} {most}");
    }

    #[test]
    fn what_does_not_belong_to_a_plain_far_side_leaves_it_and_matches_a_reference(
        off in any::<[i8; 3]>(), scale in 1i16..9, near in colours(), far in colours(),
    ) {
        let add = |c: usize| (i16::from(far[0].0[c]) + i16::from(off[c]) / scale).clamp(0, 255) as u8;
        let colour = std::array::from_fn(add);
        let Mattes { mixture, halo: got } = Mattes::of(colour, &side(&near), &side(&far));
        let Between { share, told, mixed } = between(colour, &near, &far);
        let (mean, variance, weight) = statistics(&far);
        let apart: f64 = (0..3).map(|c| (f64::from(colour[c]) - mean[c]).powi(2)).sum();
        let is_plain = weight >= 64.0 && variance <= 144.0;
        prop_assert_eq!(got.is_some(), told && (mixed || share == 0.0) && is_plain && apart > 64.0 && apart > 9.0 * variance);
        let Some(got) = got else { return Ok(()) };
        prop_assert_eq!(over(got), colour);
        prop_assert!((0..3).all(|c| (f64::from(got.background[c]) - mean[c]).abs() <= 0.5 + 1e-9));
        prop_assert!(got.alpha >= mixture.map_or(1, |m| m.alpha));
    }

    #[test]
    fn a_mixture_of_two_uniform_sides_is_decomposed(near in prop::array::uniform3(50u8..206), far in any::<[u8; 3]>(), share in 5u8..=255) {
        let mix = |c: usize| ((f64::from(near[c]) * f64::from(share) + f64::from(far[c]) * f64::from(255 - share)) / 255.0).round() as u8;
        let colour = std::array::from_fn(mix);
        let apart = (0..3).map(|c| f64::from(near[c].abs_diff(far[c])).powi(2)).sum::<f64>().sqrt();
        let Some(got) = Mattes::of(colour, &side(&[(near, 3)]), &side(&[(far, 5)])).mixture else {
            // too near to each other, or so little of the near one that it is rounded away
            prop_assert!(apart < 24.5 || colour == far);
            return Ok(());
        };
        // the colour was rounded
        let slack = 255.0 / apart + 1.0;
        prop_assert!((f64::from(got.alpha) - f64::from(share)).abs() <= slack + f64::from(u8::from(got.alpha == 255)) * 2.0, "{} {share}", got.alpha);
        prop_assert!((0..3).all(|c| got.background[c].abs_diff(far[c]) <= 1));
    }
}

#[test]
fn missing_or_equal_sides_have_no_matte() {
    let (dark, light) = (side(&[([10; 3], 4)]), side(&[([200; 3], 1)]));
    let mixture = |near: &Side, far: &Side| Mattes::of([90; 3], near, far).mixture;
    assert_eq!(mixture(&Side::default(), &dark), None);
    assert_eq!(mixture(&dark, &Side::default()), None);
    assert_eq!(mixture(&dark, &dark), None);
    assert!(mixture(&dark, &light).is_some());
    // noise as large as the distance of the two sides
    let noise = side(&[([0; 3], 1), ([255; 3], 1)]);
    assert_eq!(mixture(&noise, &light), None);
}

#[test]
fn whole_rows_of_tiles_surround_any_tiles() {
    for (width, height, size, stride) in [(70, 200, 16, 12), (200, 70, 16, 12), (60, 60, 20, 6), (90, 50, 16, 16), (9, 9, 16, 12)] {
        let grid = Grid { width, height, size, stride };
        for (start, end) in (0..grid.tiles()).flat_map(|start| (start + 1..=grid.tiles()).map(move |end| (start, end))) {
            let overlap = |t: u32| {
                let r = grid.rect(t);
                let meets = |o: crate::Rect| r.y < o.y + o.h && o.y < r.y + r.h;
                [start, end - 1].map(|t| grid.rect(t)).into_iter().any(meets) || (start..end).contains(&t)
            };
            let rows: Vec<u32> = (0..grid.rows()).filter(|row| overlap(row * grid.columns())).collect();
            let want = rows[0] * grid.columns()..(rows[rows.len() - 1] + 1) * grid.columns();
            assert_eq!(super::around(&grid, start..end), want, "tiles {start}..{end} of {grid:?}");
        }
    }
}

/// Near patches in front of a wall, and a photo of two colours that are mixed at random along the borders.
fn any_scene() -> impl Strategy<Value = (Photo, Geometry)> {
    let slant = || -0.15..0.15f64;
    let planes = prop::collection::vec((0.05..1.0f64, slant(), slant()), 2..4);
    (3u32..75, 3u32..75, 8u32..40, 0u32..9, planes, 2u32..20, any::<u32>()).prop_map(
        |(width, height, size, overlap, planes, patch, seed)| {
            let grid = Grid { width, height, size, stride: size - overlap.min(size - 1) };
            let noise = |i: u32, k: u32| {
                (i.wrapping_mul(2_654_435_761).wrapping_add(k.wrapping_mul(40_503)) ^ seed).wrapping_mul(0x85EB_CA77) >> 24
            };
            let mut planes: Vec<Plane> = planes.into_iter().map(|(a, b, c)| Plane { a, b, c }.quantised()).collect();
            planes.sort_by(|p, q| p.a.total_cmp(&q.a));
            let count = planes.len() as u32;
            let label = |x: u32, y: u32| noise(x / patch + y / patch * 64, 9) % count;
            let tile = |t: u32| {
                let r = grid.rect(t);
                // one tile in eight disagrees
                let other = u32::from(noise(t, 3) < 32);
                let labels = (0..r.area() as u32).map(|i| ((label(r.x + i % r.w, r.y + i / r.w) + other) % count) as u8).collect();
                Tile { planes: planes.clone(), labels, background: None }
            };
            let colour = |x: u32, y: u32| {
                let mean: u32 =
                    (0..4).map(|k| label((x + k % 2).saturating_sub(1), (y + k / 2).saturating_sub(1)) * 255 / count).sum::<u32>() / 4;
                [mean, 255 - mean, noise(x + 80 * y, 5) / 4].map(|v| v as u8)
            };
            let rgb = (0..width * height).map(|i| colour(i % width, i / width)).collect();
            let (tiles, intrinsics) = ((0..grid.tiles()).map(tile).collect(), Intrinsics::centred(width, height, 60.0));
            (
                Photo { width, height, rgb },
                Geometry { grid, intrinsics, view_box: ViewBox { x: 0.2, y: 0.1, z: 0.0 }, tiles, matte_band: MATTE_BAND },
            )
        },
    )
}

/// One texel at a pixel.
struct Over {
    delta: f32,
    colour: [u8; 3],
    alpha: u8,
}

/// All texels at each pixel of the photo, nearest first.
fn stacks(photo: &Photo, geometry: &Geometry, tiles: &[Vec<TexturedLayer>]) -> Vec<Vec<Over>> {
    let mut all: Vec<Vec<Over>> = photo.rgb.iter().map(|_| Vec::new()).collect();
    for (t, layers) in (0..).zip(tiles) {
        for TexturedLayer { shape, hidden } in layers {
            let mut hidden = hidden.iter();
            for (i, (&class, &alpha)) in (0..).zip(shape.class.iter().zip(&shape.alpha)) {
                let (x, y) = (shape.rect.x + i % shape.rect.w, shape.rect.y + i / shape.rect.w);
                let colour = if class == Class::Hidden as u8 { *hidden.next().unwrap() } else { photo.at(x, y) };
                if class != Class::Empty as u8 {
                    let delta = TileFrame::of(&geometry.grid, t).disparity(&shape.plane, x, y);
                    all[(y * photo.width + x) as usize].push(Over { delta, colour, alpha });
                }
            }
            assert!(hidden.next().is_none());
        }
    }
    for stack in &mut all {
        // of equal disparities, the later layer is nearer
        stack.reverse();
        stack.sort_by(|a, b| b.delta.total_cmp(&a.delta));
    }
    all
}

/// Pixels of a rectangle within [`MATTE_BAND`] of another pixel.
fn around(r: crate::Rect, x: u32, y: u32) -> impl Iterator<Item = (u32, u32)> {
    let by = MATTE_BAND as u32;
    let range = |at: u32, from: u32, length: u32| at.saturating_sub(by).max(from)..(at + by + 1).min(from + length);
    let columns = range(x, r.x, r.w);
    range(y, r.y, r.h).flat_map(move |v| columns.clone().map(move |u| (u, v)))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    #[test]
    fn the_reference_view_is_the_photo((photo, geometry) in any_scene()) {
        let tiles = texture(&photo, &geometry, geometry.masks());
        for (i, stack) in stacks(&photo, &geometry, &tiles).iter().enumerate() {
            let (mut sum, mut left) = ([0.0; 3], 1.0);
            for texel in stack {
                let share = left * f64::from(texel.alpha) / 255.0;
                sum = std::array::from_fn(|c| sum[c] + share * f64::from(texel.colour[c]));
                left -= share;
            }
            prop_assert!(left < 1e-9);
            let got = sum.map(|v: f64| v.round() as u8);
            prop_assert_eq!(got, photo.rgb[i], "pixel {} of {} a row", i, photo.width);
        }
    }

    /// Only pixels on the far side of a border are matted, nothing else changes, and no layer covers a mixed colour twice.
    #[test]
    fn only_the_far_side_of_borders_is_matted((photo, geometry) in any_scene()) {
        let plain = Geometry { matte_band: 0, ..geometry.clone() };
        let (with, without) = (texture(&photo, &geometry, geometry.masks()), texture(&photo, &plain, plain.masks()));
        for (t, (with, without)) in (0..).zip(with.iter().zip(&without)) {
            prop_assert_eq!(with.len(), without.len());
            let (r, frame, tile) = (geometry.grid.rect(t), TileFrame::of(&geometry.grid, t), &geometry.tiles[t as usize]);
            let shown = |x: u32, y: u32| frame.disparity(&tile.planes[usize::from(tile.labels[((y - r.y) * r.w + x - r.x) as usize])], x, y);
            let own = owned(&geometry.grid, t);
            for (w, o) in with.iter().zip(without) {
                prop_assert!(r.contains(&w.shape.rect) && w.shape.rect.contains(&o.shape.rect));
                for i in 0..w.shape.class.len() as u32 {
                    let (x, y) = (w.shape.rect.x + i % w.shape.rect.w, w.shape.rect.y + i / w.shape.rect.w);
                    let before = super::within(o.shape.rect, x, y).map_or((0, 0), |at| (o.shape.class[at], o.shape.alpha[at]));
                    let after = (w.shape.class[i as usize], w.shape.alpha[i as usize]);
                    if before == after {
                        continue;
                    }
                    // a hidden texel never changes
                    prop_assert_ne!(before.0, Class::Hidden as u8);
                    let within = own.contains(&crate::Rect { x, y, w: 1, h: 1 });
                    if within {
                        let most = around(r, x, y).map(|(u, v)| shown(u, v)).fold(f32::NEG_INFINITY, f32::max);
                        prop_assert!(most > shown(x, y), "beside something nearer");
                    } else {
                        // other tiles add no foreground
                        prop_assert!(after == (Class::Empty as u8, 0) || after == (Class::Hidden as u8, 255));
                    }
                }
            }
        }
    }
}
