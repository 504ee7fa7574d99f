//! The trained state in which the coders of a chunk start. A chunk has few tiles and refers to no other chunk, so untrained models would
//! have learnt most of it only at its end.

use crate::container::range_coder::Bit;
use crate::container::{labels, planes};

/// Probabilities of a 1, in 1/65 536, in the order of [`Coders::bits`]; trained on rendered sequences by `tmpi-lab live-bench --learn`.
const PRIOR: &[u16] = &include!("coder_prior.in");

/// Number of probabilities per line of the file.
const ACROSS: usize = 16;

/// Models for the planes and labels of a chunk.
pub(super) struct Coders {
    pub labels: Box<labels::Models>,
    pub planes: Box<planes::Models>,
}

impl Coders {
    /// Untrained models.
    pub fn unlearned() -> Self {
        Self { labels: labels::Models::new(), planes: planes::Models::new() }
    }

    /// Models that start from the trained prior.
    pub fn learned() -> Self {
        let mut coders = Self::unlearned();
        for (bit, p) in coders.bits().zip(PRIOR) {
            *bit = Bit::of(*p);
        }
        coders
    }

    fn bits(&mut self) -> impl Iterator<Item = &mut Bit> {
        self.labels.bits().chain(self.planes.bits())
    }
}

/// Trains the prior on chunks.
pub struct Learning {
    coders: Coders,
    /// Sums of the probabilities after each chunk, and number of chunks.
    sums: Vec<u64>,
    chunks: u64,
}

impl Default for Learning {
    fn default() -> Self {
        let mut coders = Coders::unlearned();
        let sums = vec![0; coders.bits().count()];
        Self { coders, sums, chunks: 0 }
    }
}

impl Learning {
    /// Trains on the tiles of a chunk.
    ///
    /// # Errors
    /// [`super::LiveError`], as in [`super::chunk::encode`].
    pub fn take(&mut self, grid: &crate::Grid, area: super::chunk::Area, tiles: &[crate::Tile]) -> Result<(), super::LiveError> {
        super::chunk::streams(&mut self.coders, grid, area, tiles)?;
        self.chunks += 1;
        for (sum, bit) in self.sums.iter_mut().zip(self.coders.bits()) {
            *sum += u64::from(bit.slow());
        }
        Ok(())
    }

    /// The mean probabilities in the format of `coder_prior.in`.
    pub fn finish(&self) -> String {
        let mean = |sum: &u64| sum.checked_div(self.chunks).unwrap_or(1 << 15).to_string();
        let all: Vec<String> = self.sums.iter().map(mean).collect();
        let lines: Vec<String> = all.chunks(ACROSS).map(|line| line.join(", ")).collect();
        format!("[\n{},\n]\n", lines.join(",\n"))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "test")]

    use super::*;

    #[test]
    fn there_is_a_probability_for_every_bit() {
        assert_eq!(PRIOR.len(), Coders::unlearned().bits().count());
        assert!(PRIOR.iter().all(|p| *p > 0));
    }

    #[test]
    fn an_untrained_prior_is_uniform() {
        let text = Learning::default().finish();
        let found = text.trim_matches(['[', ']', '\n']).split([',', '\n']).filter(|n| !n.trim().is_empty());
        let values: Vec<u16> = found.map(|n| n.trim().parse().unwrap()).collect();
        assert_eq!(values, vec![1 << 15; PRIOR.len()]);
    }
}
