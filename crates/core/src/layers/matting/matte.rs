//! Decomposition of a pixel beside a depth border: `C = α F + (1 − α) B`.

/// Minimum distance of foreground and background in RGB, in levels. Below it, noise in the photo decides where a colour lies between the
/// two.
const CONTRAST: f64 = 24.0;
/// Minimum distance of foreground and background in standard deviations of the colours that they are means of.
const DEVIATIONS: f64 = 2.0;
/// Maximum distance of a colour from the line between the two, as a share of the line's length. Colours farther off belong to something
/// else.
const MAX_OFFSET: f64 = 0.25;

/// A far side is plain if the standard deviation of its colours, by their distances in RGB, is at most this many levels, and their weight
/// at least `PLAIN_WEIGHT`, a tenth of the window's. Fewer colours do not tell.
const PLAIN: f64 = 12.0;
const PLAIN_WEIGHT: u32 = 64;
/// A colour does not belong to a plain far side if it differs by more than so many levels and standard deviations. Noise differs less.
const NOISE: f64 = 8.0;
const NOISE_DEVIATIONS: f64 = 3.0;

/// Alpha from which a pixel counts as all foreground, in 255ths: renderers treat a texel of 0.99 as opaque.
const OPAQUE: i32 = 253;

/// Statistics of the unmixed colours on one side of a border.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Side {
    /// Sum of the weights.
    pub weight: u32,
    /// Sums of the weighted colours.
    pub sum: [u32; 3],
    /// Weighted sum of the squares of all three channels.
    pub squares: u32,
}

impl Side {
    /// Adds a colour.
    #[cfg(test)]
    pub fn add(&mut self, colour: [u8; 3], weight: u32) {
        let colour = colour.map(u32::from);
        self.weight += weight;
        for (sum, c) in self.sum.iter_mut().zip(colour) {
            *sum += weight * c;
        }
        self.squares += weight * colour.iter().map(|c| c * c).sum::<u32>();
    }

    /// The mean colour, 0 to 255, and the variance summed over the channels; `None` if there are no colours.
    fn mean(&self) -> Option<([f64; 3], f64)> {
        let weight = f64::from(self.weight);
        let mean = self.sum.map(|s| f64::from(s) / weight);
        let square = f64::from(self.squares) / weight - mean.iter().map(|m| m * m).sum::<f64>();
        (self.weight > 0).then_some((mean, square.max(0.0)))
    }
}

/// The line between the mean colours of two sides.
struct Line {
    back: [f64; 3],
    /// From the mean of the far side to that of the near side, and the square of its length.
    along: [f64; 3],
    apart: f64,
    /// Variance of the far side.
    variance: f64,
}

impl Line {
    /// `None` if the two sides cannot be told apart.
    fn between(near: &Side, far: &Side) -> Option<Self> {
        let ((front, front_off), (back, back_off)) = (near.mean()?, far.mean()?);
        let along: [f64; 3] = std::array::from_fn(|c| front[c] - back[c]);
        let apart: f64 = along.iter().map(|d| d * d).sum();
        let told = apart >= CONTRAST * CONTRAST && apart >= DEVIATIONS * DEVIATIONS * (front_off + back_off);
        told.then_some(Self { back, along, apart, variance: back_off })
    }

    /// Share of the near side in a colour: between 0 and 1 for mixtures, below 0 for colours beyond the far side.
    fn share(&self, colour: [u8; 3]) -> f64 {
        let dot: f64 = (0..3).map(|c| (f64::from(colour[c]) - self.back[c]) * self.along[c]).sum();
        dot / self.apart
    }
}

/// A decomposed pixel: compositing the foreground over the background with `alpha` gives the pixel exactly, in whole levels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Matte {
    /// Share of the foreground in 255ths, at least 1.
    pub alpha: u8,
    /// Colour of the foreground.
    pub foreground: [u8; 3],
    /// Colour of the background.
    pub background: [u8; 3],
}

/// Mattes of a pixel behind a border.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mattes {
    /// If its colour is a mixture of both sides.
    pub mixture: Option<Matte>,
    /// If its colour does not belong to a plain far side.
    pub halo: Option<Matte>,
}

impl Mattes {
    /// Decomposes `colour`, which lies between a `near` and a `far` side. Both are `None` if the sides cannot be told apart.
    pub fn of(colour: [u8; 3], near: &Side, far: &Side) -> Self {
        let Some(line) = Line::between(near, far) else { return Self { mixture: None, halo: None } };
        let mixture = Matte::mixture(colour, &line);
        Self { mixture, halo: Matte::halo(colour, mixture, &line, far.weight) }
    }
}

impl Matte {
    /// Decomposes `colour` as a mixture of both sides. `None` if it is not one, or if it is all background.
    ///
    /// A deviation from the line between the two means is detail of the photo. Each side gets its share of it, so that a pixel that is
    /// almost all background keeps its colour.
    fn mixture(colour: [u8; 3], line: &Line) -> Option<Self> {
        let &Line { back, along, apart, .. } = line;
        let share = line.share(colour).clamp(0.0, 1.0);
        let off: [f64; 3] = std::array::from_fn(|c| f64::from(colour[c]) - (back[c] + share * along[c]));
        let alpha = (255.0 * share + 0.5) as u8;
        if alpha == 0 || off.iter().map(|v| v * v).sum::<f64>() > MAX_OFFSET * MAX_OFFSET * apart {
            return None;
        }
        // rounds to nearest; the cast clamps to 0..=255
        let background = std::array::from_fn(|c| (back[c] + (1.0 - share) * off[c] + 0.5) as u8);
        Some(Self::with(colour, background, alpha))
    }

    /// Decomposes `colour` beside a plain far side, of this `weight`, that it does not belong to: a `mixture`, if it is one, or a colour
    /// beyond the far side, as sharpening leaves it. The background is the mean of that side, and the foreground takes the whole difference,
    /// with the alpha of the mixture, otherwise with the least. `None` if the far side is not plain, or if the difference may be noise or
    /// detail.
    fn halo(colour: [u8; 3], mixture: Option<Self>, line: &Line, weight: u32) -> Option<Self> {
        let off: f64 = colour.iter().zip(line.back).map(|(c, b)| (f64::from(*c) - b).powi(2)).sum();
        let is_plain = weight >= PLAIN_WEIGHT && line.variance <= PLAIN * PLAIN;
        let may_be_noise = off <= NOISE * NOISE || off <= NOISE_DEVIATIONS * NOISE_DEVIATIONS * line.variance;
        let may_be_detail = mixture.is_none() && line.share(colour) > 0.0;
        if !is_plain || may_be_noise || may_be_detail {
            return None;
        }
        Some(Self::with(colour, line.back.map(|b| (b + 0.5) as u8), mixture.map_or(1, |m| m.alpha)))
    }

    /// The matte of `colour` over `background` with `alpha` of at least 1; computes the foreground. Raises alpha if the foreground would
    /// otherwise be out of range.
    fn with(colour: [u8; 3], background: [u8; 3], alpha: u8) -> Self {
        let both = colour.map(i32::from).into_iter().zip(background.map(i32::from));
        let alpha = both.clone().fold(i32::from(alpha), |alpha, (c, b)| alpha.max(min_alpha(c, b)));
        let alpha = if alpha >= OPAQUE { 255 } else { alpha };
        let mut foreground = colour;
        for (f, (c, b)) in foreground.iter_mut().zip(both) {
            *f = ((255 * c - (255 - alpha) * b + alpha / 2).max(0) / alpha).min(255) as u8;
        }
        Self { alpha: alpha as u8, foreground, background }
    }
}

/// Minimum alpha, in 255ths, at which a foreground in 0..=255 over `background` gives `colour`, to a quarter of a level.
fn min_alpha(colour: i32, background: i32) -> i32 {
    // rounded up
    let share = |part: i32, of: i32| if part > 0 { (255 * (4 * part - 1) + 4 * of - 1) / (4 * of) } else { 0 };
    share(background - colour, background).max(share(colour - background, 255 - background))
}
