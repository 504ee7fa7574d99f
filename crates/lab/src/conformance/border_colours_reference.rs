//! Colours beyond the photo's borders in `f64`, without rounding between: what [`tmpi_core::BorderColours`] is held against.

use tmpi_core::{Border, Photo};

/// The widest means are over squares of 2⁶ pixels.
const COARSEST: usize = 6;

/// Means along the four borders.
pub(super) struct Continued {
    size: [usize; 2],
    /// By axis, then by border.
    sides: [[Side; 2]; 2],
}

/// Means of squares along one border, for each size of squares.
struct Side([Vec<[f64; 3]>; COARSEST + 1]);

impl Continued {
    pub fn new(photo: &Photo) -> Self {
        let size = [photo.width as usize, photo.height as usize];
        let side = |axis: usize, border: Border| {
            // a pixel by its distance from the border and its place along it, the nearest one if there is none
            let pixel = |line: usize, along: usize| {
                let (line, along) = (line.min(size[axis] - 1), along.min(size[1 - axis] - 1));
                let line = if border == Border::Low { line } else { size[axis] - 1 - line };
                let (x, y) = if axis == 0 { (line, along) } else { (along, line) };
                photo.rgb[y * size[0] + x].map(f64::from)
            };
            let mean = |n: usize, square: usize| {
                let places = (0..1 << n).flat_map(|line| (square << n..(square + 1) << n).map(move |along| (line, along)));
                let sum = places.fold([0.0; 3], |sum: [f64; 3], (line, along)| {
                    let colour = pixel(line, along);
                    std::array::from_fn(|c| sum[c] + colour[c])
                });
                sum.map(|v| v / 4_f64.powi(n as i32))
            };
            Side(std::array::from_fn(|n| (0..size[1 - axis].div_ceil(1 << n)).map(|square| mean(n, square)).collect()))
        };
        Self { size, sides: [0, 1].map(|axis| [Border::Low, Border::High].map(|border| side(axis, border))) }
    }

    /// The colour of the mirror image of pixel `place`: of a visible texel, or of a hidden one that has a colour of its own.
    pub fn texel(&self, place: [u32; 2], mirrored: [Option<Border>; 2], hidden: Option<[u8; 3]>) -> [u8; 3] {
        let place = place.map(|v| v as usize);
        let beyond: [f64; 2] = std::array::from_fn(|axis| match mirrored[axis] {
            None => 0.0,
            Some(Border::Low) => place[axis] as f64 + 0.5,
            Some(Border::High) => self.size[axis] as f64 - place[axis] as f64 - 0.5,
        });
        let radius = (1.0 + beyond[0].max(beyond[1]) / 2.0).min((1 << COARSEST) as f64);
        let level = radius.log2().floor() as usize;
        let share = radius / (1 << level) as f64 - 1.0;
        let [fine, coarse] = [level, (level + 1).min(COARSEST)].map(|level| self.around(place, mirrored, beyond, level));
        let own = hidden.map_or(0.0, |_| 1.0 / radius);
        std::array::from_fn(|c| {
            let continued = (1.0 - share) * fine[c] + share * coarse[c];
            (own * f64::from(hidden.unwrap_or_default()[c]) + (1.0 - own) * continued).round() as u8
        })
    }

    /// The mean at the borders, each weighted by the distance from it.
    fn around(&self, place: [usize; 2], mirrored: [Option<Border>; 2], beyond: [f64; 2], level: usize) -> [f64; 3] {
        let mut sum = [0.0; 3];
        for axis in 0..2 {
            let Some(border) = mirrored[axis] else { continue };
            let along = match mirrored[1 - axis] {
                None => place[1 - axis],
                Some(Border::Low) => 0,
                Some(Border::High) => self.size[1 - axis] - 1,
            };
            let mean = self.sides[axis][usize::from(border == Border::High)].at(along, level);
            let weight = beyond[axis] / (beyond[0] + beyond[1]);
            sum.iter_mut().zip(mean).for_each(|(sum, v)| *sum += weight * v);
        }
        sum
    }
}

impl Side {
    /// A mean at a place along the border, linear between the centres of its squares.
    fn at(&self, along: usize, level: usize) -> [f64; 3] {
        let means = &self.0[level];
        let at = ((along as f64 + 0.5) / (1 << level) as f64 - 0.5).max(0.0);
        let [a, b] = [0, 1].map(|next| means[(at as usize + next).min(means.len() - 1)]);
        std::array::from_fn(|c| (1.0 - at.fract()) * a[c] + at.fract() * b[c])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_core::{BorderColours, Class};

    const BORDERS: [Option<Border>; 3] = [None, Some(Border::Low), Some(Border::High)];

    #[test]
    fn the_colours_of_the_core_are_those_in_f64_up_to_rounding() {
        for (width, height) in [(157, 93), (1, 1), (1, 70), (64, 2), (129, 65)] {
            let photo = Photo::from_fn(width, height, |x, y| {
                let i = y * width + x;
                [(i * 7919 % 251) as u8, (i % width) as u8, 255 * (i / 9 % 2) as u8]
            });
            let (reference, core) = (Continued::new(&photo), BorderColours::new(&photo.rgb, [width, height], 0));
            for mirrored in BORDERS.iter().flat_map(|x| BORDERS.map(|y| [*x, y])).skip(1) {
                for class in [Class::Photo, Class::Hidden] {
                    let mut worst = 0;
                    for y in 0..height {
                        let mut got = vec![[9, 200, 77, 31]; width as usize];
                        core.recolour((0, y as usize), mirrored, &vec![class as u8; width as usize], &mut got);
                        for (x, [r, g, b, alpha]) in (0..width).zip(got) {
                            let want = reference.texel([x, y], mirrored, (class == Class::Hidden).then_some([9, 200, 77]));
                            worst = [r, g, b].iter().zip(want).map(|(a, b)| a.abs_diff(b)).fold(worst, u8::max);
                            assert_eq!(alpha, 31);
                        }
                    }
                    assert!(worst <= 1, "{width}×{height}, {mirrored:?}, {class:?}: {worst} levels");
                }
            }
        }
    }
}
