//! What a pixel beside a depth border is mixed of: `C = α F + (1 − α) B`.

/// Levels that foreground and background are apart at least, as the length of their difference in red, green and blue: below it noise of the
/// photo decides where between both a colour lies.
const CONTRAST: f64 = 24.0;
/// They are also apart by so many times the deviation of the colours that they are means of.
const DEVIATIONS: f64 = 2.0;
/// A colour lies off the line between both by so much of its length at most: else it is of something else.
const OFF: f64 = 0.25;

/// From this share on, in 255ths, a pixel is all foreground: renderers take a texel of 0.99 as opaque.
const WHOLE: i32 = 253;

/// Colours beyond the mixed ones, on one side of a border.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Side {
    /// Sum of the weights.
    pub weight: u32,
    /// Sums of the colours times their weights.
    pub sum: [u32; 3],
    /// Sum of the squares of all three channels times the weight.
    pub squares: u32,
}

impl Side {
    /// Adds a colour.
    #[inline]
    pub fn add(&mut self, colour: [u8; 3], weight: u32) {
        let colour = colour.map(u32::from);
        self.weight += weight;
        for (sum, c) in self.sum.iter_mut().zip(colour) {
            *sum += weight * c;
        }
        self.squares += weight * colour.iter().map(|c| c * c).sum::<u32>();
    }

    /// The mean, 0 to 255, and the mean square of what lies off it, over all three channels; none of nothing.
    fn mean(&self) -> Option<([f64; 3], f64)> {
        let weight = f64::from(self.weight);
        let mean = self.sum.map(|s| f64::from(s) / weight);
        let square = f64::from(self.squares) / weight - mean.iter().map(|m| m * m).sum::<f64>();
        (self.weight > 0).then_some((mean, square.max(0.0)))
    }
}

/// A pixel taken apart, so that `alpha` of the foreground over the background is the pixel again, to the level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Matte {
    /// The foreground's share, in 255ths; at least 1.
    pub alpha: u8,
    /// Its colour.
    pub foreground: [u8; 3],
    /// Colour of the background.
    pub background: [u8; 3],
}

impl Matte {
    /// Takes `colour` apart, which lies between a `near` and a `far` side; none where these cannot be told from each other, where it is no mixture
    /// of both, and where it is all background.
    ///
    /// What of the colour lies off the line between both means is detail of the photo. Either side gets of it by its share, so that a pixel of
    /// almost nothing but background keeps its colour.
    #[must_use]
    pub fn of(colour: [u8; 3], near: &Side, far: &Side) -> Option<Self> {
        let ((front, front_off), (back, back_off)) = (near.mean()?, far.mean()?);
        let along: [f64; 3] = std::array::from_fn(|c| front[c] - back[c]);
        let apart: f64 = along.iter().map(|d| d * d).sum();
        if apart < CONTRAST * CONTRAST || apart < DEVIATIONS * DEVIATIONS * (front_off + back_off) {
            return None;
        }
        let dot: f64 = (0..3).map(|c| (f64::from(colour[c]) - back[c]) * along[c]).sum();
        let share = (dot / apart).clamp(0.0, 1.0);
        let off: [f64; 3] = std::array::from_fn(|c| f64::from(colour[c]) - (back[c] + share * along[c]));
        let alpha = (255.0 * share + 0.5) as u8;
        if alpha == 0 || off.iter().map(|v| v * v).sum::<f64>() > OFF * OFF * apart {
            return None;
        }
        // rounded; the cast takes what lies outside to 0 and 255
        let background = std::array::from_fn(|c| (back[c] + (1.0 - share) * off[c] + 0.5) as u8);
        Some(Self::with(colour, background, alpha))
    }

    /// The matte of a colour before a background, of a share of at least 1: the foreground follows. Where no colour could be that bright or dark,
    /// it has a larger share.
    fn with(colour: [u8; 3], background: [u8; 3], alpha: u8) -> Self {
        let both = colour.map(i32::from).into_iter().zip(background.map(i32::from));
        let alpha = both.clone().fold(i32::from(alpha), |alpha, (c, b)| alpha.max(least(c, b)));
        let alpha = if alpha >= WHOLE { 255 } else { alpha };
        let mut foreground = colour;
        for (f, (c, b)) in foreground.iter_mut().zip(both) {
            *f = ((255 * c - (255 - alpha) * b + alpha / 2).max(0) / alpha).min(255) as u8;
        }
        Self { alpha: alpha as u8, foreground, background }
    }
}

/// The least share, in 255ths, that a foreground of 0 to 255 has where it makes `colour` of `background`, to a quarter of a level.
fn least(colour: i32, background: i32) -> i32 {
    // rounded up
    let share = |part: i32, of: i32| if part > 0 { (255 * (4 * part - 1) + 4 * of - 1) / (4 * of) } else { 0 };
    share(background - colour, background).max(share(colour - background, 255 - background))
}
