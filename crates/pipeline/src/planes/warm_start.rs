//! Warm start: a tile starts from its planes in the last frame. It keeps them while they fit, refits them if that is enough, and otherwise
//! places new planes. What stays the same is not sent again, and does not flicker.

use tmpi_core::{DisparityMap, Grid, Plane, Tile};

use rayon::prelude::*;

use super::{Method, Placement, Samples, finish_labelled, k_planes, place_tile};

/// A tile keeps its planes while their error is at most this multiple of the target.
const KEPT: f64 = 1.5;
/// Rounds of refitting.
const ROUNDS: usize = 2;
/// Hysteresis of labels: how much smaller the squared error of another plane must be, in units of the squared target, before a pixel
/// changes to it.
const MARGIN: f32 = 4.0;

/// Places the planes of some tiles again, starting from their current planes. `tiles` are those of the whole grid; only those for whose
/// number `wanted` returns true change. A tile without planes gets new ones.
pub fn place_again(
    delta: &DisparityMap,
    confidence: Option<&[f32]>,
    grid: &Grid,
    placement: &Placement,
    tiles: &mut [Tile],
    wanted: impl Fn(u32) -> bool + Sync,
) {
    tiles.par_iter_mut().enumerate().filter(|(i, _)| wanted(*i as u32)).for_each_init(Samples::default, |samples, (i, tile)| {
        samples.gather(delta, confidence, grid, i as u32);
        *tile = place_tile_from(samples, placement, tile);
    });
}

/// Places the planes of one tile, starting from those of `last`. Places new planes if `last` is empty or of another size, or without a
/// target.
pub fn place_tile_from(samples: &Samples, placement: &Placement, last: &Tile) -> Tile {
    let known = !last.planes.is_empty() && last.labels.len() == samples.len();
    let (Some(target), true) = (placement.target, known) else { return place_tile(samples, placement) };
    let (mut labels, mut errors) = (Vec::new(), Vec::new());
    samples.assign(&last.planes, &mut labels, &mut errors);
    if super::sample::percentile_99(&mut errors.clone()) <= KEPT * target {
        return finish_labelled(samples, last.planes.clone(), steady(samples, &last.planes, &last.labels, &labels, target), placement);
    }
    if placement.method == Method::Slanted && last.planes.len() <= placement.most as usize {
        let mut planes = last.planes.clone();
        for _ in 0..ROUNDS {
            k_planes::refit(samples, &labels, &mut planes);
            samples.assign(&planes, &mut labels, &mut errors);
        }
        if super::sample::percentile_99(&mut errors) <= target {
            return super::finish(samples, planes, placement).tile;
        }
    }
    place_tile(samples, placement)
}

/// Labels with hysteresis: a pixel keeps its `last` label unless the `nearest` plane is better by [`MARGIN`].
fn steady(s: &Samples, planes: &[Plane], last: &[u8], nearest: &[u32], target: f64) -> Vec<u8> {
    let some: Vec<[f32; 3]> = planes.iter().map(|p| [p.a as f32, p.b as f32, p.c as f32]).collect();
    let scale = (1.0 / target.max(f64::from(f32::MIN_POSITIVE))) as f32;
    let squared = |i: usize, l: usize| (s.error(i, some[l]) * scale).powi(2);
    let pixel = |(i, (&was, &near)): (usize, (&u8, &u32))| {
        let stays = usize::from(was) < some.len() && squared(i, was.into()) <= squared(i, near as usize) + MARGIN;
        if stays { was } else { near as u8 }
    };
    last.iter().zip(nearest).enumerate().map(pixel).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: Grid = Grid { width: 64, height: 64, size: 64, stride: 56 };

    fn map(delta: impl Fn(usize, usize) -> f32) -> DisparityMap {
        DisparityMap { width: 64, height: 64, delta: (0..4096).map(|i| delta(i % 64, i / 64)).collect() }
    }

    fn step(at: usize, noise: f32) -> DisparityMap {
        map(|x, y| if x < at { 0.2 } else { 0.8 } + if (x * 31 + y * 17) % 7 < 3 { noise } else { -noise })
    }

    fn placed(map: &DisparityMap, last: &Tile) -> Tile {
        let mut tiles = [last.clone()];
        place_again(map, None, &GRID, &Placement::fewest(Method::Slanted, 6, 0.05), &mut tiles, |_| true);
        let [tile] = tiles;
        tile
    }

    #[test]
    fn a_map_with_different_noise_keeps_planes_and_labels() {
        let first = placed(&step(30, 0.0), &Tile::default());
        assert_eq!(first.planes.len(), 2);
        assert_eq!(placed(&step(30, 0.02), &first), first);
    }

    #[test]
    fn a_moving_edge_keeps_planes_and_moves_labels() {
        let first = placed(&step(30, 0.0), &Tile::default());
        let second = placed(&step(40, 0.0), &first);
        assert_eq!(first.planes, second.planes);
        assert_eq!(second.labels.iter().filter(|l| **l == 1).count(), 64 * 24);
    }

    #[test]
    fn an_approaching_surface_gets_another_plane() {
        let first = placed(&step(30, 0.0), &Tile::default());
        let nearer = map(|x, _| if x < 30 { 0.2 } else { 0.95 });
        let second = placed(&nearer, &first);
        let samples = {
            let mut s = Samples::default();
            s.gather(&nearer, None, &GRID, 0);
            s
        };
        assert!(samples.error_p99(&first.planes) > 0.075 && samples.error_p99(&second.planes) <= 0.05, "{:?}", second.planes);
    }

    #[test]
    fn a_plane_without_pixels_is_dropped() {
        let first = placed(&step(30, 0.0), &Tile::default());
        assert_eq!(placed(&map(|_, _| 0.2), &first).planes.len(), 1);
    }
}
