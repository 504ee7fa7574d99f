//! Colours beyond the photo's borders in `f64`, without rounding between: what [`tmpi_core::MirrorBlur`] is held against.

use tmpi_core::Photo;

/// Coarsest level of the pyramid.
const COARSEST: usize = 6;

/// The photo, and its means of 2 × 2, 4 × 4, … pixels.
pub(super) struct Blur {
    levels: Vec<Level>,
}

struct Level {
    size: [usize; 2],
    texels: Vec<[f64; 3]>,
}

impl Level {
    fn at(&self, x: usize, y: usize) -> [f64; 3] {
        self.texels[y.min(self.size[1] - 1) * self.size[0] + x.min(self.size[0] - 1)]
    }
}

impl Blur {
    pub fn new(photo: &Photo) -> Self {
        let size = [photo.width as usize, photo.height as usize];
        let mut levels = vec![Level { size, texels: photo.rgb.iter().map(|c| c.map(f64::from)).collect() }];
        for fine in 0..COARSEST {
            let from = &levels[fine];
            let size = from.size.map(|n| n.div_ceil(2));
            let mean = |i: usize| {
                let (x, y) = (2 * (i % size[0]), 2 * (i / size[0]));
                let four = [from.at(x, y), from.at(x + 1, y), from.at(x, y + 1), from.at(x + 1, y + 1)];
                std::array::from_fn(|c| four.iter().map(|t| t[c]).sum::<f64>() / 4.0)
            };
            let texels = (0..size[0] * size[1]).map(mean).collect();
            levels.push(Level { size, texels });
        }
        Self { levels }
    }

    /// The colour of pixel `(x, y)`, `beyond` pixels from its border.
    pub fn colour(&self, x: u32, y: u32, beyond: f64) -> [u8; 3] {
        let radius = (1.0 + beyond / 2.0).min((1 << COARSEST) as f64);
        let level = radius.log2().floor() as usize;
        let share = radius / (1 << level) as f64 - 1.0;
        let [a, b] = [level, (level + 1).min(COARSEST)].map(|level| self.sample(f64::from(x) + 0.5, f64::from(y) + 0.5, level));
        std::array::from_fn(|c| ((1.0 - share) * a[c] + share * b[c]).round() as u8)
    }

    /// A level at a place in pixels, bilinear between the centres of its texels.
    fn sample(&self, x: f64, y: f64, level: usize) -> [f64; 3] {
        let at = [x, y].map(|v| (v / (1 << level) as f64 - 0.5).max(0.0));
        let mut sum = [0.0; 3];
        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let [wx, wy] = [(at[0], dx), (at[1], dy)].map(|(v, d)| if d == 0 { 1.0 - v.fract() } else { v.fract() });
            let texel = self.levels[level].at(at[0] as usize + dx, at[1] as usize + dy);
            sum.iter_mut().zip(texel).for_each(|(s, t)| *s += wx * wy * t);
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_core::MirrorBlur;

    #[test]
    fn the_blur_of_the_core_is_that_in_f64_up_to_its_rounding() {
        for (width, height) in [(157, 93), (1, 1), (1, 70), (64, 2)] {
            let rgb: Vec<[u8; 3]> =
                (0..width * height).map(|i| [(i * 7919 % 251) as u8, (i % width) as u8, 255 * (i / 9 % 2) as u8]).collect();
            let photo = Photo { width, height, rgb };
            let (blur, core) = (Blur::new(&photo), MirrorBlur::new(&photo.rgb, [width, height], 0));
            for mirrored in [[true, false], [false, true], [true, true]] {
                let mut worst = 0;
                for y in 0..height {
                    let (mut got, own) = (Vec::new(), &photo.rgb[(y * width) as usize..][..width as usize]);
                    core.row(0, y as usize, own, mirrored, &mut got);
                    assert_eq!(got.len(), width as usize);
                    for (x, got) in (0..width).zip(got) {
                        let past = [x.min(width - 1 - x), y.min(height - 1 - y)].map(|v| f64::from(v) + 0.5);
                        let beyond = past.into_iter().zip(mirrored).filter(|(_, mirrored)| *mirrored).fold(0.0, |a, (b, _)| f64::max(a, b));
                        let want = blur.colour(x, y, beyond);
                        worst = got.iter().zip(want).map(|(a, b)| a.abs_diff(b)).fold(worst, u8::max);
                    }
                }
                assert!(worst <= 3, "{width}×{height}, {mirrored:?}: {worst} levels");
            }
        }
    }
}
