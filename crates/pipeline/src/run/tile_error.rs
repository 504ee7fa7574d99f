//! How far each tile's planes move the picture wrongly.

use rayon::prelude::*;

use tmpi_core::{DisparityMap, Grid, Tile};

/// Mean parallax error of each tile in pixels, row by row: how far, over a view box that moves a disparity of 1 by `parallax` pixels,
/// the plane of a pixel moves it away from where the map that planes were fitted to does. Rounded to thousandths.
pub(super) fn tile_errors(delta: &DisparityMap, grid: &Grid, tiles: &[Tile], parallax: f64) -> Vec<f64> {
    let half = grid.half();
    let of = |(index, tile): (usize, &Tile)| {
        let (rect, centre) = (grid.rect(index as u32), grid.centre(index as u32));
        let mut sum = 0.0;
        for (i, label) in tile.labels.iter().enumerate() {
            let (x, y) = (rect.x as usize + i % rect.w as usize, rect.y as usize + i / rect.w as usize);
            let Some(plane) = tile.planes.get(usize::from(*label)) else { continue };
            let at = plane.disparity((x as f64 + 0.5 - centre.0) / half, (y as f64 + 0.5 - centre.1) / half);
            sum += (at - f64::from(delta.delta[y * delta.width as usize + x])).abs();
        }
        (sum * parallax / tile.labels.len().max(1) as f64 * 1e3).round() / 1e3
    };
    tiles.par_iter().enumerate().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_core::Plane;

    #[test]
    fn a_plane_beside_the_map_errs_by_its_distance_times_the_parallax() {
        let grid = Grid::new(100, 60, 64);
        let delta = DisparityMap { width: 100, height: 60, delta: vec![0.5; 6000] };
        let tile = |index: u32, planes: Vec<Plane>| {
            let labels = (0..grid.rect(index).area()).map(|i| (i % planes.len()) as u8).collect();
            Tile { planes, labels, background: None }
        };
        let plane = Plane::fronto_parallel;
        let tiles = [tile(0, vec![plane(0.5)]), tile(1, vec![plane(0.4), plane(0.5)])];
        assert_eq!(tile_errors(&delta, &grid, &tiles, 10.0), [0.0, 0.5]);
    }
}
