//! What the coders of a chunk know before its first tile. A chunk holds few tiles and refers to no other: models that knew nothing would
//! have learnt the most of it at its end.

use crate::container::range_coder::Bit;
use crate::container::{labels, planes};

/// Probabilities of a 1 in 65 536, in the order of [`Coders::bits`]; learnt from rendered sequences by `tmpi-lab live-bench --learn`.
const PRIOR: &[u16] = &include!("coder_prior.in");

/// Probabilities in a line of the file.
const ACROSS: usize = 16;

/// The models of a chunk's planes and labels.
pub(super) struct Coders {
    pub labels: Box<labels::Models>,
    pub planes: Box<planes::Models>,
}

impl Coders {
    /// Models that know nothing.
    pub fn unlearned() -> Self {
        Self { labels: labels::Models::new(), planes: planes::Models::new() }
    }

    /// Models that know what was learnt beforehand.
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

/// Learns from chunks what the coders of others begin with.
pub struct Learning {
    coders: Coders,
    /// Sums of the probabilities after each chunk, and the count of chunks.
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
    /// Lets the coders go on with the tiles of a chunk.
    ///
    /// # Errors
    /// [`super::LiveError`] as [`super::chunk::encode`] gives it.
    pub fn take(&mut self, grid: &crate::Grid, area: super::chunk::Area, tiles: &[crate::Tile]) -> Result<(), super::LiveError> {
        super::chunk::streams(&mut self.coders, grid, area, tiles)?;
        self.chunks += 1;
        for (sum, bit) in self.sums.iter_mut().zip(self.coders.bits()) {
            *sum += u64::from(bit.slow());
        }
        Ok(())
    }

    /// The probabilities as `coder_prior.in` has them.
    #[must_use]
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
    fn what_was_learnt_of_nothing_is_that_all_is_as_likely() {
        let text = Learning::default().finish();
        let found = text.trim_matches(['[', ']', '\n']).split([',', '\n']).filter(|n| !n.trim().is_empty());
        let values: Vec<u16> = found.map(|n| n.trim().parse().unwrap()).collect();
        assert_eq!(values, vec![1 << 15; PRIOR.len()]);
    }
}
