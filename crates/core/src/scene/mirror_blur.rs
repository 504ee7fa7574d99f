//! Colours that continue a photo beyond its borders: its mirror image, blurred more with the distance from the border.
//!
//! A sharp mirror image would show a second face beside one that the frame cuts. The blur samples a pyramid of means, so its cost does not
//! depend on its radius.

/// Number of pyramid levels: the coarsest has means of 64 × 64 pixels. A blurred pixel depends only on pixels within 96 of it along each
/// axis, the margin that a band of rows has around its tiles.
const COARSEST: usize = 6;

/// Pixels beyond the border per pixel of blur radius.
const PIXELS_PER_RADIUS: f32 = 2.0;

/// Blurs the rows of a photo's mirror image, each pixel by its distance from the border at which the photo is mirrored.
#[derive(Clone, Debug, Default)]
pub struct MirrorBlur {
    /// Width and height of the whole photo.
    size: [usize; 2],
    /// The pyramid, starting with means of 2 × 2 pixels.
    levels: Vec<Level<Vec<[u8; 3]>>>,
}

/// Some rows of one level of the pyramid.
#[derive(Clone, Debug)]
struct Level<T> {
    /// Index of the first row in the level of the whole photo.
    top: usize,
    width: usize,
    texels: T,
}

impl MirrorBlur {
    /// Builds the pyramid for a photo of `size` (width, height); `rgb` holds whole rows from row `top` on.
    pub fn new(rgb: &[[u8; 3]], size: [u32; 2], top: u32) -> Self {
        let size = size.map(|v| v as usize);
        let mut levels: Vec<Level<Vec<_>>> = Vec::with_capacity(COARSEST);
        for _ in 0..COARSEST {
            let next = levels.last().map_or_else(|| Level { top: top as usize, width: size[0], texels: rgb }.halved(), Level::halved);
            levels.push(next);
        }
        Self { size, levels }
    }

    /// Appends the blurred colours of row `y` from column `x` on, one for each pixel of `sharp`, their unblurred colours. `mirrored`
    /// selects the axes (x, y) along which the nearer border mirrors the row.
    pub fn row(&self, x: usize, y: usize, sharp: &[[u8; 3]], mirrored: [bool; 2], out: &mut Vec<[u8; 3]>) {
        let Some(last) = (x + sharp.len()).checked_sub(1) else { return };
        let beyond = |at: usize, axis: usize| if mirrored[axis] { at.min(self.size[axis] - 1 - at) as f32 + 0.5 } else { 0.0 };
        let down = beyond(y, 1);
        let radius = |x: usize| (1.0 + beyond(x, 0).max(down) / PIXELS_PER_RADIUS).min((1 << COARSEST) as f32);
        // in a narrow photo, the pixel farthest from a border can lie between the ends of the row
        let farthest = (self.size[0] / 2).clamp(x, last);
        let coarsest = (1 + radius(farthest).max(radius(x)).max(radius(last)) as usize).ilog2() as usize + 1;
        let lines: Vec<Line> = self.levels.iter().zip(1..).take(coarsest).map(|(level, n)| level.line(x..last + 1, y, n)).collect();
        out.extend(sharp.iter().zip(x..).map(|(own, x)| {
            let radius = radius(x);
            // log2 of the radius, interpolated linearly between powers of two
            let fine = (radius as usize).ilog2() as usize;
            let share = radius / (1 << fine) as f32 - 1.0;
            let a = if fine == 0 { own.map(f32::from) } else { lines[fine - 1].at(x) };
            let b = lines[fine.min(COARSEST - 1)].at(x);
            std::array::from_fn(|c| (a[c] + share * (b[c] - a[c]) + 0.5) as u8)
        }));
    }
}

/// Colours of a level along one row of pixels.
struct Line {
    /// Texels per pixel.
    scale: f32,
    /// Index of the first texel.
    first: usize,
    texels: Vec<[f32; 3]>,
}

/// Index of the last texel whose centre is not beyond the pixel's centre, and the weight of the next texel.
fn place(pixel: usize, scale: f32) -> (usize, f32) {
    let at = ((pixel as f32 + 0.5) * scale - 0.5).max(0.0);
    (at as usize, at.fract())
}

impl Line {
    /// The colour at the centre of a pixel, interpolated linearly between two texels.
    fn at(&self, x: usize) -> [f32; 3] {
        let (i, share) = place(x, self.scale);
        let (a, b) = (self.texels[i - self.first], self.texels[i + 1 - self.first]);
        std::array::from_fn(|c| a[c] + share * (b[c] - a[c]))
    }
}

impl<T: AsRef<[[u8; 3]]>> Level<T> {
    /// A texel by its position in the whole level, clamped to the rows that are present.
    fn texel(&self, x: usize, y: usize) -> [u8; 3] {
        let texels = self.texels.as_ref();
        let rows = texels.len() / self.width.max(1);
        let row = y.saturating_sub(self.top).min(rows.saturating_sub(1));
        texels.get(row * self.width + x.min(self.width.saturating_sub(1))).copied().unwrap_or_default()
    }

    /// The next coarser level: means of 2 × 2 texels.
    fn halved(&self) -> Level<Vec<[u8; 3]>> {
        let rows = self.texels.as_ref().len() / self.width.max(1);
        let (top, width) = (self.top / 2, self.width.div_ceil(2));
        let mean = |(x, y): (usize, usize)| {
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| self.texel(2 * x + i, 2 * y + j));
            std::array::from_fn(|c| ((four.iter().map(|t| u16::from(t[c])).sum::<u16>() + 2) / 4) as u8)
        };
        let places = (top..(self.top + rows).div_ceil(2)).flat_map(|y| (0..width).map(move |x| (x, y)));
        Level { top, width, texels: places.map(mean).collect() }
    }

    /// Colours of this level around columns `xs` in row `y` of the photo, interpolated between texel rows. A texel covers 2ⁿ × 2ⁿ pixels.
    fn line(&self, xs: std::ops::Range<usize>, y: usize, n: usize) -> Line {
        let scale = 1.0 / (1 << n) as f32;
        let (first, last) = (place(xs.start, scale).0, place(xs.end - 1, scale).0 + 1);
        let (row, share) = place(y, scale);
        let mix = |x: usize| {
            let (a, b) = (self.texel(x, row).map(f32::from), self.texel(x, row + 1).map(f32::from));
            std::array::from_fn(|c| a[c] + share * (b[c] - a[c]))
        };
        Line { scale, first, texels: (first..=last).map(mix).collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [u32; 2] = [300, 260];

    fn photo() -> Vec<[u8; 3]> {
        (0..SIZE[0] * SIZE[1]).map(|i| [(i % 300 / 8 % 2 * 200) as u8, (i / 300) as u8, (i * 7919 % 251) as u8]).collect()
    }

    fn blurred(rgb: &[[u8; 3]], top: u32, y: u32) -> Vec<[u8; 3]> {
        let mut out = Vec::new();
        let own = &rgb[((y - top) * SIZE[0]) as usize..][..SIZE[0] as usize];
        MirrorBlur::new(rgb, SIZE, top).row(0, y as usize, own, [true, false], &mut out);
        out
    }

    #[test]
    fn a_band_of_rows_gives_the_colours_of_the_whole_photo() {
        let photo = photo();
        let (top, bottom) = (10, 250);
        let band = &photo[top as usize * 300..bottom as usize * 300];
        for y in top + 96..bottom - 96 {
            assert_eq!(blurred(band, top, y), blurred(&photo, 0, y), "row {y}");
        }
    }
}
