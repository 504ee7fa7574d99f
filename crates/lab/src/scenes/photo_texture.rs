//! Textures cut from photographs.

use std::sync::Arc;

use super::math::{Rng, V3, v3};
use tmpi_core::Photo;

/// Photographs to cut textures from; empty by default.
///
/// With pictures, a scene depends on its seed and on these pictures in this order.
#[derive(Clone, Debug, Default)]
pub struct Pictures(pub(super) Arc<[Arc<Levels>]>);

/// Mipmap of a picture, in linear light.
#[derive(Debug)]
pub(super) struct Levels {
    /// Width, height and texels, finest first.
    levels: Vec<(usize, usize, Vec<[f32; 3]>)>,
}

impl Pictures {
    /// Prepares photographs as textures; ignores empty ones.
    pub fn new(photos: &[Photo]) -> Self {
        Self(photos.iter().filter(|p| !p.rgb.is_empty()).map(|p| Arc::new(Levels::new(p))).collect())
    }
}

impl Levels {
    pub(super) fn new(photo: &Photo) -> Self {
        let linear = |p: &[u8; 3]| p.map(|v| (f32::from(v) / 255.0).powf(2.2));
        let mut levels = vec![(photo.width as usize, photo.height as usize, photo.rgb.iter().map(linear).collect::<Vec<_>>())];
        while let Some((w, h, texels)) = levels.last().filter(|l| l.0 >= 4 && l.1 >= 4) {
            let (w2, h2) = (w / 2, h / 2);
            let mean = |i: usize| {
                let at = (i / w2) * 2 * w + (i % w2) * 2;
                std::array::from_fn(|c| 0.25 * (texels[at][c] + texels[at + 1][c] + texels[at + w][c] + texels[at + w + 1][c]))
            };
            let next = (w2, h2, (0..w2 * h2).map(mean).collect());
            levels.push(next);
        }
        Self { levels }
    }

    /// Linear colour at `(u, v)`. The picture spans 1 and repeats; `width` is the size of a pixel in these units.
    pub(super) fn repeated(&self, u: f64, v: f64, width: f64) -> V3 {
        let side = self.levels[0].0.max(self.levels[0].1) as f64;
        let (w, h, texels) = &self.levels[((width * side).max(1.0).log2() as usize).min(self.levels.len() - 1)];
        let place = |t: f64, n: usize| t.rem_euclid(1.0) * n as f64 - 0.5;
        let (x, y) = (place(u, *w), place(v, *h));
        let (s, t) = ((x - x.floor()) as f32, (y - y.floor()) as f32);
        let around = |x: f64, n: usize| (x.floor().rem_euclid(n as f64) as usize, (x.floor() + 1.0).rem_euclid(n as f64) as usize);
        let ((i, i1), (j, j1)) = (around(x, *w), around(y, *h));
        mixed(texels, *w, [(i, i1), (j, j1)], (s, t))
    }
}

/// The bilinear mix of the texels in these two columns and rows.
fn mixed(texels: &[[f32; 3]], width: usize, [(i, i1), (j, j1)]: [(usize, usize); 2], (s, t): (f32, f32)) -> V3 {
    let mix = |c: usize| {
        let row = |j: usize| texels[j * width + i][c] * (1.0 - s) + texels[j * width + i1][c] * s;
        f64::from(row(j) * (1.0 - t) + row(j1) * t)
    };
    v3(mix(0), mix(1), mix(2))
}

/// A square piece of a picture, or a whole picture, repeated with mirroring.
#[derive(Clone, Debug)]
pub(super) struct Patch {
    picture: Arc<Levels>,
    /// Left, top, width, height, in texels of the finest level.
    x: f64,
    y: f64,
    extent: (f64, f64),
    pub mean: V3,
}

impl Patch {
    /// A random square with a side of a quarter to two thirds of the picture's shorter side; larger ones would show a recognisable scene.
    pub fn cut(picture: &Arc<Levels>, rng: &Rng) -> Self {
        let (w, h) = (picture.levels[0].0 as f64, picture.levels[0].1 as f64);
        let side = w.min(h) * rng.range(0.25, 0.66);
        let (x, y) = (rng.range(0.0, w - side), rng.range(0.0, h - side));
        Self::of(picture, (x, y), (side, side))
    }

    pub fn whole(picture: &Arc<Levels>) -> Self {
        let (w, h) = (picture.levels[0].0 as f64, picture.levels[0].1 as f64);
        Self::of(picture, (0.0, 0.0), (w, h))
    }

    fn of(picture: &Arc<Levels>, (x, y): (f64, f64), extent: (f64, f64)) -> Self {
        let mut patch = Self { picture: Arc::clone(picture), x, y, extent, mean: V3::default() };
        let sum = (0..64).fold(V3::default(), |s, i| s + patch.at((f64::from(i % 8) + 0.5) / 8.0, (f64::from(i / 8) + 0.5) / 8.0, 0.12));
        patch.mean = sum * (1.0 / 64.0);
        patch
    }

    /// Its centre, in the coordinates of [`Self::at`].
    pub fn middle(&self) -> (f64, f64) {
        let side = self.side();
        (0.5 * self.extent.0 / side, 0.5 * self.extent.1 / side)
    }

    fn side(&self) -> f64 {
        self.extent.0.max(self.extent.1)
    }

    /// Linear colour at `(u, v)`. The longer side of the piece spans 1; `width` is the size of a pixel in these units.
    pub fn at(&self, u: f64, v: f64, width: f64) -> V3 {
        let fold = |t: f64| 1.0 - (t.rem_euclid(2.0) - 1.0).abs();
        let side = self.side();
        let level = ((width * side).max(1.0).log2() as usize).min(self.picture.levels.len() - 1);
        let (w, h, texels) = &self.picture.levels[level];
        let shrink = 1.0 / (1u64 << level) as f64;
        let place = |t: f64, from: f64, extent: f64, n: usize| {
            ((from + fold(t * side / extent) * extent) * shrink - 0.5).min(n as f64 - 1.001).max(0.0)
        };
        let (x, y) = (place(u, self.x, self.extent.0, *w), place(v, self.y, self.extent.1, *h));
        let (i, j) = (x as usize, y as usize);
        let (i1, j1) = ((i + 1).min(w - 1), (j + 1).min(h - 1));
        let (s, t) = ((x - i as f64) as f32, (y - j as f64) as f32);
        mixed(texels, *w, [(i, i1), (j, j1)], (s, t))
    }
}
