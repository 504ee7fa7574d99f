//! Colour of hidden texels: push-pull pyramid over the neighbourhood, sources at or behind the layer only (RECIPE, step 5).

use crate::tmpi::{Class, DisparityMap, Grid, Photo, Place, Rect, Shape};

/// Context around a layer in pixels.
const CONTEXT: u32 = 32;
/// How far in front of the layer a source may lie, in δ.
const IN_FRONT: f32 = 0.015;
/// A pixel that touches a surface nearer by this much is mixed with it, and no source.
const TOUCH: f32 = 0.03;
/// Distance behind the layer, in δ, at which a source's weight has fallen to a half.
const BEHIND: f32 = 0.06;

/// Sources of hidden colour, found once a photo.
pub struct Filler<'a> {
    photo: &'a Photo,
    delta: &'a DisparityMap,
    /// True where a pixel touches something nearer.
    rim: Vec<bool>,
}

impl<'a> Filler<'a> {
    /// Marks the pixels that touch something nearer.
    #[must_use]
    pub fn new(photo: &'a Photo, delta: &'a DisparityMap) -> Self {
        use rayon::prelude::*;
        let (w, h) = (delta.width as usize, delta.height as usize);
        let d = &delta.delta;
        let mut rim = vec![false; d.len()];
        rim.par_chunks_mut(w).enumerate().for_each(|(y, row)| {
            let (y0, y1) = (y.saturating_sub(1), (y + 1).min(h - 1));
            let column = |x: usize| (y0..=y1).fold(f32::NEG_INFINITY, |m, yy| m.max(d[yy * w + x]));
            let (mut before, mut here) = (f32::NEG_INFINITY, column(0));
            for (x, r) in row.iter_mut().enumerate() {
                let after = if x + 1 < w { column(x + 1) } else { f32::NEG_INFINITY };
                *r = before.max(here).max(after) - d[y * w + x] > TOUCH;
                (before, here) = (here, after);
            }
        });
        Self { photo, delta, rim }
    }

    /// Colours of the hidden texels of a layer, in the order of `class`.
    #[must_use]
    pub fn fill(&self, grid: &Grid, shape: &Shape, place: Place) -> Vec<[u8; 3]> {
        let Shape { plane, rect, class, .. } = shape;
        let rect = *rect;
        let (x0, y0) = (rect.x.saturating_sub(CONTEXT), rect.y.saturating_sub(CONTEXT));
        let (w, h) = ((rect.x + rect.w + CONTEXT).min(grid.width) - x0, (rect.y + rect.h + CONTEXT).min(grid.height) - y0);
        let mut level = Level::new(w as usize, h as usize);
        for y in 0..h {
            for x in 0..w {
                let at = (y0 + y) as usize * grid.width as usize + (x0 + x) as usize;
                let behind = place.disparity(plane, x0 + x, y0 + y) - self.delta.delta[at];
                if behind < -IN_FRONT || self.rim[at] {
                    continue;
                }
                let far = behind.max(0.0) / BEHIND;
                let weight = 1.0 / (1.0 + far * far);
                let c = self.photo.rgb[at].map(|v| f32::from(v) * weight);
                level.texels[(y * w + x) as usize] = [c[0], c[1], c[2], weight];
            }
        }
        let mut levels = vec![level];
        while let Some(l) = levels.last().filter(|l| l.width > 1 || l.height > 1) {
            let half = l.pulled();
            levels.push(half);
        }
        if levels.last().is_none_or(|top| top.texels[0][3] <= 0.0) {
            // nothing lies behind anywhere near: the layer's own surroundings are all there is
            let mean = self.mean(rect);
            return class.iter().filter(|&&c| c == Class::Hidden as u8).map(|_| mean).collect();
        }
        let coarse = levels[1..].iter().rev().fold(None::<Level>, |up, l| Some(l.pushed(up.as_ref())));
        let done = levels[0].pushed(coarse.as_ref());
        let (dx, dy) = ((rect.x - x0) as usize, (rect.y - y0) as usize);
        class
            .iter()
            .enumerate()
            .filter(|(_, c)| **c == Class::Hidden as u8)
            .map(|(i, _)| {
                let t = done.texels[(dy + i / rect.w as usize) * w as usize + dx + i % rect.w as usize];
                [t[0], t[1], t[2]].map(|v| v.round().clamp(0.0, 255.0) as u8)
            })
            .collect()
    }

    fn mean(&self, r: Rect) -> [u8; 3] {
        let mut sum = [0u64; 3];
        for y in r.y..r.y + r.h {
            for x in r.x..r.x + r.w {
                let p = self.photo.at(x, y);
                for (s, v) in sum.iter_mut().zip(p) {
                    *s += u64::from(v);
                }
            }
        }
        sum.map(|s| (s / r.area().max(1) as u64) as u8)
    }
}

/// One level of the pyramid: colour times weight, and weight in 0..=1.
struct Level {
    width: usize,
    height: usize,
    texels: Vec<[f32; 4]>,
}

impl Level {
    fn new(width: usize, height: usize) -> Self {
        Self { width, height, texels: vec![[0.0; 4]; width * height] }
    }

    /// Half the size: sums of 2×2 texels, weight saturated at 1, so that one source suffices where there is no other.
    fn pulled(&self) -> Self {
        let mut l = Self::new(self.width.div_ceil(2), self.height.div_ceil(2));
        for y in 0..self.height {
            for x in 0..self.width {
                let t = self.texels[y * self.width + x];
                let to = &mut l.texels[y / 2 * l.width + x / 2];
                for (a, b) in to.iter_mut().zip(t) {
                    *a += b;
                }
            }
        }
        for t in &mut l.texels {
            if t[3] > 1.0 {
                let s = 1.0 / t[3];
                *t = t.map(|v| v * s);
            }
        }
        l
    }

    /// Full colours: own where the weight is 1, the coarser level's where it is 0.
    fn pushed(&self, coarse: Option<&Self>) -> Self {
        let mut l = Self::new(self.width, self.height);
        for y in 0..self.height {
            for x in 0..self.width {
                let t = self.texels[y * self.width + x];
                let out = match coarse {
                    Some(c) if t[3] < 1.0 => {
                        let up = c.bilinear(x, y);
                        let rest = 1.0 - t[3];
                        [t[0] + rest * up[0], t[1] + rest * up[1], t[2] + rest * up[2], 1.0]
                    }
                    _ if t[3] > 0.0 => t.map(|v| v / t[3]),
                    _ => t,
                };
                l.texels[y * l.width + x] = out;
            }
        }
        l
    }

    /// Colour of a finer level's texel `(x, y)` from this level, bilinear between texel centres.
    fn bilinear(&self, x: usize, y: usize) -> [f32; 4] {
        let split = |i: usize, n: usize| {
            let (near, other) = (i / 2, if i.is_multiple_of(2) { (i / 2).saturating_sub(1) } else { (i / 2 + 1).min(n - 1) });
            (near.min(n - 1), other)
        };
        let ((x0, x1), (y0, y1)) = (split(x, self.width), split(y, self.height));
        let at = |x: usize, y: usize| self.texels[y * self.width + x];
        let (a, b, c, d) = (at(x0, y0), at(x1, y0), at(x0, y1), at(x1, y1));
        std::array::from_fn(|i| 0.5625 * a[i] + 0.1875 * (b[i] + c[i]) + 0.0625 * d[i])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tmpi::Plane;

    #[test]
    fn hidden_colour_comes_from_behind_only() {
        // left half green at δ .2, right half red at δ .8; a layer at .2 under the red half must be green
        let (w, h) = (64u32, 64u32);
        let photo = Photo { width: w, height: h, rgb: (0..w * h).map(|i| if i % w < 32 { [0, 200, 0] } else { [200, 0, 0] }).collect() };
        let delta = DisparityMap { width: w, height: h, delta: (0..w * h).map(|i| if i % w < 32 { 0.2 } else { 0.8 }).collect() };
        let grid = Grid::new(w, h, 64);
        let place = Place { centre: grid.centre(0), half: 32.0 };
        let class: Vec<u8> = (0..w * h).map(|i| if i % w < 32 { Class::Photo } else { Class::Hidden } as u8).collect();
        let shape = Shape { plane: Plane::fronto_parallel(0.2), label: Some(0), rect: grid.rect(0), alpha: vec![255; class.len()], class };
        let colours = Filler::new(&photo, &delta).fill(&grid, &shape, place);
        assert_eq!(colours.len(), 32 * 64);
        assert!(colours.iter().all(|c| *c == [0, 200, 0]));
    }

    #[test]
    fn without_any_source_the_fill_is_still_a_colour_of_the_photo() {
        let photo = Photo { width: 8, height: 8, rgb: vec![[90, 80, 70]; 64] };
        let delta = DisparityMap { width: 8, height: 8, delta: vec![0.9; 64] };
        let grid = Grid::new(8, 8, 64);
        let place = Place { centre: grid.centre(0), half: 32.0 };
        let shape = Shape {
            plane: Plane::fronto_parallel(0.1),
            label: None,
            rect: grid.rect(0),
            alpha: vec![255; 64],
            class: vec![Class::Hidden as u8; 64],
        };
        let colours = Filler::new(&photo, &delta).fill(&grid, &shape, place);
        assert_eq!(colours, vec![[90, 80, 70]; 64]);
    }
}
