//! Colours that continue a photo beyond its borders: those at the border, blurred more with the distance from it.
//!
//! A mirror image, even a blurred one, shows a second face beside one that the frame cuts. Here, a colour depends on the border alone: it
//! is a mean over the pixels next to the place where the border is nearest. Means over squares are kept for seven sizes, so the cost does
//! not depend on the radius of the blur.

use super::Class;

/// The widest means that [`BorderColours::with_coarsest`] takes are over squares of 128 × 128 pixels.
const MOST_COARSE: usize = 7;

/// Pixels beyond the border per pixel of blur radius. As in `tmpi.wgsl`.
const PIXELS_PER_RADIUS: f32 = 2.0;

/// One of the two borders across an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Border {
    /// The left or upper border.
    Low,
    /// The right or lower border.
    High,
}

/// The colours beyond a photo's borders.
#[derive(Clone, Debug, Default)]
pub struct BorderColours {
    /// Width and height of the whole photo.
    size: [usize; 2],
    /// The left and the right border, the upper and the lower one.
    sides: [[Side; 2]; 2],
    /// The widest means are over squares of 2 to this power pixels a side.
    coarsest: usize,
}

impl BorderColours {
    /// The widest means are over squares of 2 to this power pixels a side. A colour depends only on the 64 lines of pixels next to a
    /// border, and on pixels within 96 of it along the border, the margin that a band of rows has around its tiles. `tmpi-lab bench --only
    /// beyond` compares other widths.
    pub const COARSEST: usize = 6;
    /// Number of rows of [`Self::strips`].
    pub const STRIPS: usize = 4 * (Self::COARSEST + 1);

    /// Takes the means of a photo of `size` (width, height); `rgb` holds whole rows from row `top` on. Colours beyond the upper or lower
    /// border need the 96 rows next to it.
    pub fn new(rgb: &[[u8; 3]], size: [u32; 2], top: u32) -> Self {
        Self::with_coarsest(rgb, size, top, Self::COARSEST)
    }

    /// Like [`Self::new`], with widest means over squares of 2 to the power of `coarsest` pixels a side, at most 7. For benchmarks:
    /// whatever draws takes the default, so that all backends agree.
    #[doc(hidden)]
    pub fn with_coarsest(rgb: &[[u8; 3]], size: [u32; 2], top: u32, coarsest: usize) -> Self {
        let coarsest = coarsest.min(MOST_COARSE);
        let [width, height] = size.map(|v| v as usize);
        let (top, rows) = (top as usize, rgb.len() / width.max(1));
        // a row that is not present is the nearest one that is
        let pixel = |x: usize, y: usize| {
            let row = y.saturating_sub(top).min(rows.saturating_sub(1));
            rgb.get(row * width + x).copied().unwrap_or_default()
        };
        let [right, lower] = [width, height].map(|n| n.saturating_sub(1));
        let columns = |column: &dyn Fn(usize) -> usize| Side::new(width, top..top + rows, coarsest, |line, y| pixel(column(line), y));
        let across = |row: &dyn Fn(usize) -> usize| Side::new(height, 0..width, coarsest, |line, x| pixel(x, row(line)));
        let sides = [[columns(&|line| line), columns(&|line| right - line)], [across(&|line| line), across(&|line| lower - line)]];
        Self { size: [width, height], sides, coarsest }
    }

    /// Colours some texels of a layer, with straight alpha, that are mirrored beyond the photo's borders: those of row `y` of the photo
    /// from column `x` on, of these classes. `mirrored` has the border at which each axis (x, y) is mirrored.
    ///
    /// Visible texels take the continued colour. Hidden ones fade to it, so that layers that move apart show no mirrored outlines.
    pub fn recolour(&self, (x, y): (usize, usize), mirrored: [Option<Border>; 2], class: &[u8], texels: &mut [[u8; 4]]) {
        for (x, (class, texel)) in (x..).zip(class.iter().zip(texels)) {
            if *class == Class::Empty as u8 {
                continue;
            }
            let (colour, radius) = self.colour([x, y], mirrored);
            let share = if *class == Class::Photo as u8 { 1.0 } else { 1.0 - 1.0 / radius };
            let [r, g, b, alpha] = *texel;
            let [r, g, b] = mix([r, g, b].map(f32::from), colour, share).map(|v| (v + 0.5) as u8);
            *texel = [r, g, b, alpha];
        }
    }

    /// The means for a shader that continues the colours itself (`tmpi.wgsl`): rows of `columns` opaque texels, one for each size of squares
    /// of the left, the right, the upper and the lower border. A border of more pixels than `columns` − 1 is reduced to them; the texels
    /// after its end repeat the last one.
    pub fn strips(&self, columns: usize) -> Vec<[u8; 4]> {
        let mut out = Vec::with_capacity(Self::STRIPS * columns);
        for (axis, sides) in self.sides.iter().enumerate() {
            let pixels = self.size[1 - axis];
            let used = pixels.min(columns.saturating_sub(1)).max(1);
            let place = |column: usize| ((2 * column + 1) * pixels / (2 * used)).min(pixels.saturating_sub(1));
            for (side, n) in sides.iter().flat_map(|side| (0..=Self::COARSEST).map(move |n| (side, n))) {
                out.extend((0..columns).map(|column| {
                    let [r, g, b] = side.at(n, place(column)).map(|v| (v + 0.5) as u8);
                    [r, g, b, u8::MAX]
                }));
            }
        }
        out
    }

    /// The colour of the mirror image of a pixel (x, y), and the radius of its blur.
    fn colour(&self, pixel: [usize; 2], mirrored: [Option<Border>; 2]) -> ([f32; 3], f32) {
        let beyond = |axis: usize| {
            let at = pixel[axis] as f32 + 0.5;
            mirrored[axis].map_or(0.0, |border| if border == Border::Low { at } else { self.size[axis] as f32 - at })
        };
        let [across, down] = [beyond(0), beyond(1)];
        let radius = (1.0 + across.max(down) / PIXELS_PER_RADIUS).min((1 << self.coarsest) as f32);
        // log2 of the radius, interpolated linearly between powers of two
        let fine = (radius as usize).ilog2() as usize;
        let share = radius / (1 << fine) as f32 - 1.0;
        // the place along one axis that is nearest to the pixel
        let nearest = |axis: usize| match mirrored[axis] {
            None => pixel[axis],
            Some(Border::Low) => 0,
            Some(Border::High) => self.size[axis].saturating_sub(1),
        };
        let at = |size: usize| {
            let sides: [_; 2] =
                std::array::from_fn(|axis| mirrored[axis].map(|border| self.sides[axis][border as usize].at(size, nearest(1 - axis))));
            match sides {
                [Some(x), Some(y)] => mix(x, y, down / (across + down)),
                [x, y] => x.or(y).unwrap_or_default(),
            }
        };
        (mix(at(fine), at((fine + 1).min(self.coarsest)), share), radius)
    }
}

/// Means of the pixels along one border.
#[derive(Clone, Debug, Default)]
struct Side {
    /// The first pixel along the border that is present.
    first: usize,
    /// Means over squares of 1, 2, 4, … pixels a side, up to the widest; the first of each contains the first pixel.
    means: [Vec<[f32; 3]>; MOST_COARSE + 1],
}

impl Side {
    /// The means of `lines` lines of pixels, counted from the border; `pixel` takes the line and the place along the border. A square that
    /// reaches past the last line or pixel repeats it. The widest squares have 2 to the power of `coarsest` pixels a side.
    fn new(lines: usize, along: std::ops::Range<usize>, coarsest: usize, pixel: impl Fn(usize, usize) -> [u8; 3]) -> Self {
        if along.is_empty() {
            return Self::default();
        }
        // sums over the lines so far
        let mut sums = vec![[0_u32; 3]; along.len()];
        let mut added = 0;
        let means = std::array::from_fn(|n| {
            if n > coarsest {
                return Vec::new();
            }
            for line in added..1 << n {
                let line = line.min(lines.saturating_sub(1));
                for (sum, at) in sums.iter_mut().zip(along.clone()) {
                    let colour = pixel(line, at);
                    *sum = std::array::from_fn(|c| sum[c] + u32::from(colour[c]));
                }
            }
            added = 1 << n;
            let mean = |square: usize| {
                let each = (square << n..(square + 1) << n).map(|at| at.clamp(along.start, along.end - 1) - along.start);
                let sum = each.fold([0; 3], |sum: [u32; 3], at| std::array::from_fn(|c| sum[c] + sums[at][c]));
                sum.map(|v| v as f32 / (1 << (2 * n)) as f32)
            };
            (along.start >> n..along.end.div_ceil(1 << n)).map(mean).collect()
        });
        Self { first: along.start, means }
    }

    /// The mean over 2ⁿ × 2ⁿ pixels around a place along the border, interpolated linearly between two squares.
    fn at(&self, n: usize, place: usize) -> [f32; 3] {
        let means = &self.means[n];
        let at = ((place as f32 + 0.5) / (1 << n) as f32 - 0.5).max(0.0);
        let mean = |square: usize| {
            let last = means.len().saturating_sub(1);
            means.get(square.saturating_sub(self.first >> n).min(last)).copied().unwrap_or_default()
        };
        mix(mean(at as usize), mean(at as usize + 1), at.fract())
    }
}

fn mix(a: [f32; 3], b: [f32; 3], share: f32) -> [f32; 3] {
    std::array::from_fn(|c| a[c] + share * (b[c] - a[c]))
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEFT: [Option<Border>; 2] = [Some(Border::Low), None];

    fn colours(width: u32, height: u32, rgb: impl Fn(u32, u32) -> u8) -> BorderColours {
        let rgb: Vec<[u8; 3]> = (0..width * height).map(|i| [rgb(i % width, i / width); 3]).collect();
        BorderColours::new(&rgb, [width, height], 0)
    }

    /// The red of visible texels of a row from column `x` on.
    fn row(of: &BorderColours, (x, y): (usize, usize), count: usize, mirrored: [Option<Border>; 2]) -> Vec<u8> {
        let mut texels = vec![[0, 0, 0, 255]; count];
        of.recolour((x, y), mirrored, &vec![Class::Photo as u8; count], &mut texels);
        texels.iter().map(|t| t[0]).collect()
    }

    /// Correlation of two rows without their linear trends.
    fn correlation(a: &[u8], b: &[u8]) -> f64 {
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let detail = |values: &[u8]| -> Vec<f64> {
            let count = values.len() as f64;
            let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / count;
            let places: Vec<f64> = (0..values.len()).map(|i| i as f64 - (count - 1.0) / 2.0).collect();
            let values: Vec<f64> = values.iter().map(|v| f64::from(*v) - mean).collect();
            let slope = dot(&places, &values) / dot(&places, &places);
            values.iter().zip(&places).map(|(v, place)| v - slope * place).collect()
        };
        let (a, b) = (detail(a), detail(b));
        dot(&a, &b) / (dot(&a, &a) * dot(&b, &b)).sqrt().max(1e-9)
    }

    #[test]
    fn a_band_of_rows_gives_the_colours_of_the_whole_photo() {
        let [width, height] = [300_u32, 260];
        let photo: Vec<[u8; 3]> =
            (0..width * height).map(|i| [(i % 300 / 8 % 2 * 200) as u8, (i / 300) as u8, (i * 7919 % 251) as u8]).collect();
        let whole = BorderColours::new(&photo, [width, height], 0);
        let of = |from: u32, end: u32| BorderColours::new(&photo[(from * width) as usize..(end * width) as usize], [width, height], from);
        let classes = vec![Class::Photo as u8; 300];
        let row = |of: &BorderColours, y: u32, mirrored| {
            let mut texels = vec![[0, 0, 0, 255]; 300];
            of.recolour((0, y as usize), mirrored, &classes, &mut texels);
            texels
        };
        let (top, bottom) = (10, 250);
        for y in top + 96..bottom - 96 {
            for side in [Border::Low, Border::High] {
                assert_eq!(row(&of(top, bottom), y, [Some(side), None]), row(&whole, y, [Some(side), None]), "row {y}");
            }
        }
        // beyond the upper and the lower border, from the rows next to it
        for x in [None, Some(Border::Low), Some(Border::High)] {
            for y in [0, 30, 63] {
                assert_eq!(row(&of(0, 96), y, [x, Some(Border::Low)]), row(&whole, y, [x, Some(Border::Low)]), "row {y}");
                let y = height - 1 - y;
                assert_eq!(row(&of(height - 96, height), y, [x, Some(Border::High)]), row(&whole, y, [x, Some(Border::High)]), "row {y}");
            }
        }
    }

    #[test]
    fn colours_go_on_from_the_photo_without_a_step() {
        // a slope in both directions, steeper across the border
        let at = |x: u32, y: u32| (2 * x.min(60) + y) as u8;
        let of = colours(200, 100, at);
        for y in 0..100 {
            let row = row(&of, (0, y), 150, LEFT);
            assert!(row[0].abs_diff(at(0, y as u32)) <= 1 && row.windows(2).all(|two| two[0].abs_diff(two[1]) <= 1), "row {y}: {row:?}");
        }
        // around the corner, from beside the photo to above it
        for far in 0..100 {
            let one = |x: usize, y: usize, mirrored| row(&of, (x, y), 1, mirrored)[0];
            let corner = [Some(Border::Low); 2];
            assert!(one(far, 0, corner).abs_diff(one(far, 0, LEFT)) <= 1, "{far} pixels beside");
            assert!(one(0, far, corner).abs_diff(one(0, far, [None, Some(Border::Low)])) <= 1, "{far} pixels above");
        }
    }

    #[test]
    fn nothing_of_the_photo_is_seen_again_beyond_its_border() {
        for width in [12, 20, 32] {
            let stripe = |x: u32| if (x / width).is_multiple_of(2) { 40 } else { 210_u8 };
            let mirrored: Vec<u8> = (8..96).map(stripe).collect();
            let continued = correlation(&row(&colours(200, 150, |x, _| stripe(x)), (8, 70), 88, LEFT), &mirrored);
            assert!(continued < 0.1, "stripes of {width}: {continued}");
            // a mirror image that blurs with the distance is found
            let mean = |x: u32| ((x - x / 4..=x + x / 4).map(|x| u32::from(stripe(x))).sum::<u32>() / (2 * (x / 4) + 1)) as u8;
            let faulty = correlation(&(8..96).map(mean).collect::<Vec<u8>>(), &mirrored);
            assert!(faulty > 0.3, "stripes of {width}: {faulty}");
        }
    }

    #[test]
    fn colours_blend_no_farther_than_the_widest_means() {
        let photo: Vec<[u8; 3]> = (0..200 * 128_u32).map(|i| [if (i / 200 / 8).is_multiple_of(2) { 0 } else { 200 }; 3]).collect();
        let far = |coarsest| row(&BorderColours::with_coarsest(&photo, [200, 128], 0, coarsest), (150, 4), 1, LEFT)[0];
        // 151 pixels beyond the border, where the radius is 76: within a stripe, over whole pairs of them, and beyond the widest there is
        assert_eq!([2, 6, 7, 99].map(far), [0, 100, 100, 100]);
        let [first, second] = [6, 7].map(|coarsest| BorderColours::with_coarsest(&photo, [200, 128], 0, coarsest).colour([150, 4], LEFT).1);
        assert!((first - 64.0).abs() < 1e-6 && (second - 76.25).abs() < 1e-6, "{first} {second}");
    }

    #[test]
    fn hidden_texels_fade_to_the_colours_of_visible_ones() {
        let of = colours(200, 100, |_, _| 100);
        let mut texels = vec![[200, 0, 0, 9]; 200];
        of.recolour((0, 50), LEFT, &[Class::Hidden as u8; 200], &mut texels);
        assert!(texels.iter().all(|t| t[3] == 9) && texels.windows(2).all(|two| two[0][0] >= two[1][0]));
        assert!(texels[0][0] >= 180 && texels[126][0] <= 102, "{:?}", (texels[0], texels[126]));
        let mut empty = [[0; 4]; 3];
        of.recolour((0, 50), LEFT, &[Class::Empty as u8; 3], &mut empty);
        assert_eq!(empty, [[0; 4]; 3]);
    }

    #[test]
    fn strips_have_the_means_along_each_border() {
        let (width, height) = (140, 90);
        let at = |x: u32, y: u32| (x * 7 + y * 13) as u8;
        let of = colours(width, height, at);
        let red = |columns: usize, row: usize, column: usize| of.strips(columns)[row * columns + column][0];
        let sizes = BorderColours::STRIPS / 4;
        // squares of one pixel are the border itself
        for place in 0..90 {
            assert_eq!((red(141, 0, place), red(141, sizes, place)), (at(0, place as u32), at(139, place as u32)), "row {place}");
        }
        for place in 0..140 {
            let found = (red(141, 2 * sizes, place), red(141, 3 * sizes, place));
            assert_eq!(found, (at(place as u32, 0), at(place as u32, 89)), "column {place}");
        }
        assert!((90..141).all(|column| red(141, 0, column) == at(0, 89)) && red(141, 2 * sizes, 140) == at(139, 0), "the last repeats");
        // larger squares: at the start of each border, the mean of the whole square
        for n in [1, 3, 6] {
            let side = 1_u32 << n;
            let mean = |left: u32, top: u32| {
                let pixels = (0..side * side).map(|i| u32::from(at(left + i % side, top + i / side)));
                ((pixels.sum::<u32>() + side * side / 2) / (side * side)) as u8
            };
            let found: Vec<u8> = (0..4).map(|border| red(141, border * sizes + n, 0)).collect();
            assert_eq!(found, [mean(0, 0), mean(width - side, 0), mean(0, 0), mean(0, height - side)], "squares of {side}");
        }
        // fewer columns than pixels: the last one of those used is next to the end
        assert_eq!((red(71, 2 * sizes, 0), red(71, 2 * sizes, 69), red(71, 2 * sizes, 70)), (at(1, 0), at(139, 0), at(139, 0)));
        assert_eq!((of.strips(0).len(), of.strips(1).len()), (0, BorderColours::STRIPS));
        assert_eq!(BorderColours::default().strips(2), [[0, 0, 0, 255]; 2 * BorderColours::STRIPS]);
    }

    #[test]
    fn photos_of_one_line_or_colour_have_colours_at_any_distance() {
        let borders = [None, Some(Border::Low), Some(Border::High)];
        for (width, height) in [(1, 1), (1, 300), (300, 1), (2, 65), (63, 3)] {
            let of = colours(width, height, |_, _| 77);
            for mirrored in borders.iter().flat_map(|x| borders.map(|y| [*x, y])).skip(1) {
                for y in 0..height as usize {
                    assert!(row(&of, (0, y), width as usize, mirrored).iter().all(|v| *v == 77), "{width}×{height}");
                }
            }
        }
        // as wide as the photo: the other border does not come nearer
        let narrow = row(&colours(40, 300, |x, _| if x < 24 { 10 } else { 250 }), (0, 150), 40, LEFT);
        assert!((12..60).contains(&narrow[39]) && narrow.is_sorted(), "{narrow:?}");
        // rows that are not present are the nearest ones
        let few = BorderColours::new(&[[5; 3]; 20], [10, 100], 50);
        assert_eq!(row(&few, (0, 0), 10, [None, Some(Border::Low)]), [5; 10]);
        assert_eq!(row(&BorderColours::default(), (0, 0), 2, LEFT), [0; 2]);
    }
}
