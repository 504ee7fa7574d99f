//! SSIMULACRA2: how alike two pictures look to people.

use fast_ssim2::{PixelDescriptor, PixelSlice, Ssimulacra2Reference};

/// Smallest side of a picture that has a score.
const LEAST: usize = 8;

/// An original that others are compared with.
///
/// Source: Sneyers, SSIMULACRA 2, Cloudinary 2022.
pub struct Ssimulacra2 {
    original: Ssimulacra2Reference,
    width: usize,
}

impl Ssimulacra2 {
    /// Of a picture of `width` pixels a row; none where a side is under 8 pixels.
    #[must_use]
    pub fn of(original: &[[u8; 3]], width: usize) -> Option<Self> {
        Some(Self { original: Ssimulacra2Reference::new(&slice(original, width)?).ok()?, width })
    }

    /// Score of a picture of the same size: 100 equal, 90 not to be told apart, 70 high quality, 50 medium, below 0 beyond use; none
    /// where the size is another.
    #[must_use]
    pub fn score(&self, picture: &[[u8; 3]]) -> Option<f64> {
        self.original.compare(&slice(picture, self.width)?).ok()
    }
}

fn slice(picture: &[[u8; 3]], width: usize) -> Option<PixelSlice<'_>> {
    let height = picture.len().checked_div(width)?;
    if width < LEAST || height < LEAST || picture.len() != width * height {
        return None;
    }
    PixelSlice::new(picture.as_flattened(), width as u32, height as u32, width * 3, PixelDescriptor::RGB8_SRGB).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_pictures_have_100_and_the_score_falls_with_the_noise() {
        let a: Vec<[u8; 3]> = (0..64 * 48).map(|i: u32| [(i % 64 * 4) as u8, (i / 64 * 5) as u8, 90]).collect();
        let original = Ssimulacra2::of(&a, 64).unwrap();
        assert!((original.score(&a).unwrap() - 100.0).abs() < 1e-6);
        let noisy = |by: usize| a.iter().enumerate().map(|(i, p)| p.map(|v| v.saturating_add((i * 37 % by) as u8))).collect::<Vec<_>>();
        let scores = [3, 9, 27, 81].map(|by| original.score(&noisy(by)).unwrap());
        assert!(scores[0] < 100.0 && scores.is_sorted_by(|a, b| a > b), "{scores:?}");
    }

    #[test]
    fn what_has_no_score_gives_none() {
        let a = vec![[9u8; 3]; 64];
        for (n, width) in [(64, 0), (64, 7), (56, 8), (63, 9), (0, 8)] {
            assert!(Ssimulacra2::of(&a[..n], width).is_none(), "{n} {width}");
        }
        assert_eq!(Ssimulacra2::of(&a, 8).unwrap().score(&a[..56]), None);
    }
}
