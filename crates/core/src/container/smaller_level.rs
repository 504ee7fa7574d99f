//! Smaller levels of a container, for slow connections and small screens: photo and labels at half, a quarter or an eighth of the size.
//!
//! Planes do not change, because δ is affine in units of half a tile, and tiles shrink with the photo. Nothing is estimated again.

use super::{ContainerError, EncodedPhoto, OptionalSections, bounds, decode, encode};
use crate::{Geometry, Grid, Intrinsics, Photo, Scene, Texels, Tile};

/// The smallest level: an eighth of the size.
pub const LEVELS: u8 = 3;
/// JPEG quality of a level's photo.
pub(super) const QUALITY: u8 = 90;

/// Makes a container of `1 / 2^level` of the size. Stops at the smallest possible level: [`LEVELS`], or less if a tile's size or stride is
/// odd, or if readers would reject so many planes for the size. Level 0 is the container itself.
///
/// # Errors
/// [`ContainerError::Broken`], [`ContainerError::Bound`], [`ContainerError::Newer`] or [`ContainerError::Encode`].
pub fn level(container: &[u8], level: u8) -> Result<Vec<u8>, ContainerError> {
    let (photo, geometry) = decode::read(container)?;
    let (photo, geometry, done) = smaller(photo, geometry, level);
    if done == 0 {
        return Ok(container.to_vec());
    }
    encode_geometry(&geometry, &EncodedPhoto::from_photo(&photo, QUALITY)?)
}

/// Photo and geometry at `1 / 2^level` of their size, or at the smallest possible level, and the number of halvings.
pub(super) fn smaller(mut photo: Photo, mut geometry: Geometry, level: u8) -> (Photo, Geometry, u8) {
    let mut done = 0;
    while done < level.min(LEVELS)
        && let Some(half) = halved(&geometry).filter(|half| bounds::geometry(half).is_ok())
    {
        photo = halved_photo(&photo);
        geometry = half;
        done += 1;
    }
    (photo, geometry, done)
}

/// Encodes a container with only photo and geometry, which determine all texels.
///
/// # Errors
/// As in [`encode()`].
pub fn encode_geometry(geometry: &Geometry, photo_file: &EncodedPhoto) -> Result<Vec<u8>, ContainerError> {
    let Geometry { grid, intrinsics, view_box, .. } = *geometry;
    // the photo is in its file, and no section has texels
    let scene = Scene { grid, intrinsics, view_box, photo: Photo::default(), layers: Vec::new(), texels: Texels::default() };
    Ok(encode(geometry, &scene, photo_file, OptionalSections::default())?.0)
}

/// The same planes over tiles of half the size; `None` if a tile's size or stride is odd.
fn halved(b: &Geometry) -> Option<Geometry> {
    let (g, k) = (b.grid, b.intrinsics);
    if !g.size.is_multiple_of(2) || !g.stride.is_multiple_of(2) {
        return None;
    }
    let grid = Grid { width: g.width.div_ceil(2), height: g.height.div_ceil(2), size: g.size / 2, stride: g.stride / 2 };
    let intrinsics = Intrinsics { fx: k.fx / 2.0, fy: k.fy / 2.0, cx: k.cx / 2.0, cy: k.cy / 2.0 };
    let tiles = b.tiles.iter().enumerate().map(|(i, t)| halved_tile(t, &g, &grid, i as u32)).collect();
    Some(Geometry { grid, intrinsics, view_box: b.view_box, tiles, matte_band: b.matte_band })
}

/// Chooses each label by majority of the four pixels that it replaces; ties go to the nearer plane, so that thin objects survive.
fn halved_tile(tile: &Tile, from: &Grid, to: &Grid, index: u32) -> Tile {
    let (r, half) = (from.rect(index), to.rect(index));
    let mut labels = Vec::with_capacity(half.area());
    for y in 0..half.h {
        for x in 0..half.w {
            let mut four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| {
                let (x, y) = ((2 * x + dx).min(r.w - 1), (2 * y + dy).min(r.h - 1));
                tile.labels[(y * r.w + x) as usize]
            });
            four.sort_unstable();
            let votes = |l: u8| four.iter().filter(|&&k| k == l).count();
            labels.push(four.into_iter().max_by_key(|&l| votes(l)).unwrap_or(0));
        }
    }
    // planes without a pixel disappear
    let used: Vec<u8> = (0..tile.planes.len() as u8).filter(|l| labels.contains(l)).collect();
    let planes = used.iter().map(|&l| tile.planes[usize::from(l)]).collect();
    let mut places = [0; 256];
    for (place, &l) in (0..).zip(&used) {
        places[usize::from(l)] = place;
    }
    for l in &mut labels {
        *l = places[usize::from(*l)];
    }
    Tile { planes, labels, background: tile.background }
}

/// Means of 2×2 pixels; an odd last row or column counts twice.
fn halved_photo(p: &Photo) -> Photo {
    Photo::from_fn(p.width.div_ceil(2), p.height.div_ceil(2), |x, y| {
        let (x1, y1) = ((2 * x + 1).min(p.width - 1), (2 * y + 1).min(p.height - 1));
        let four = [p.at(2 * x, 2 * y), p.at(x1, 2 * y), p.at(2 * x, y1), p.at(x1, y1)];
        std::array::from_fn(|c| ((four.iter().map(|q| u16::from(q[c])).sum::<u16>() + 2) / 4) as u8)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Plane, ViewBox};

    #[test]
    fn a_level_halves_the_intrinsics_and_keeps_the_order_of_planes() {
        let planes: Vec<Plane> = [0.1, 0.4, 0.6, 0.9].map(Plane::fronto_parallel).to_vec();
        // the second plane covers one pixel of four and disappears; of two planes with two pixels each, the nearer one stays
        let labels = (0..64u8).map(|i| match (i % 8 / 4, i % 2 + i / 8 % 2 * 2) {
            (0, 0) => 1,
            (0, _) => 0,
            (_, 0 | 3) => 2,
            _ => 3,
        });
        let grid = Grid { width: 8, height: 8, size: 8, stride: 8 };
        let intrinsics = Intrinsics { fx: 7.0, fy: 9.0, cx: 3.0, cy: 5.0 };
        let tile = Tile { planes: planes.clone(), labels: labels.collect(), background: Some(planes[0]) };
        let whole = Geometry { grid, intrinsics, view_box: ViewBox { x: 0.1, y: 0.2, z: 0.3 }, tiles: vec![tile], matte_band: 0 };
        let half = halved(&whole).unwrap();
        assert_eq!(half.grid, Grid { width: 4, height: 4, size: 4, stride: 4 });
        assert_eq!(half.intrinsics, Intrinsics { fx: 3.5, fy: 4.5, cx: 1.5, cy: 2.5 });
        assert_eq!(half.view_box, whole.view_box);
        let labels = [0, 0, 1, 1].repeat(4);
        assert_eq!(half.tiles, [Tile { planes: vec![planes[0], planes[3]], labels, background: Some(planes[0]) }]);
        for odd in [Grid { size: 7, ..grid }, Grid { stride: 7, ..grid }] {
            assert!(halved(&Geometry { grid: odd, ..whole.clone() }).is_none());
        }
    }

    #[test]
    fn halving_a_photo_averages_pixels_and_repeats_an_odd_border() {
        let photo = Photo { width: 3, height: 3, rgb: (0..9).map(|i| [i * 10, 255, i]).collect() };
        let half = halved_photo(&photo);
        assert_eq!((half.width, half.height), (2, 2));
        // the mean of 0, 1, 3 and 4 is 2; that of 2, 2, 5 and 5 is 3.5, rounded up
        assert_eq!(half.rgb, [[20, 255, 2], [35, 255, 4], [65, 255, 7], [80, 255, 8]]);
    }
}
