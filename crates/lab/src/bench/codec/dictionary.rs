//! What a dictionary would save that every reader has: index and planes of each container by zstd with those of all other containers
//! before it, against what they take now. Over 18 photos of 630×350 it takes 108 of the 1 554 bytes that zstd makes of both, an eighth
//! of a percent of a container; the range coder of planes takes 227 without one. It does not pay.

use serde::Serialize;

use super::ZSTD_MOST;
use crate::bench::BenchError;
use tmpi_core::container;

/// Index and planes of one container.
pub struct Plain {
    index: Vec<u8>,
    planes: Vec<u8>,
    /// Bytes that both take now.
    now: usize,
}

impl Plain {
    /// Of a container.
    pub fn of(container: &[u8]) -> Result<Self, BenchError> {
        let (index, planes) = container::read_plain(container)?;
        let sections = container::sections(container)?;
        let coded: u64 = sections.iter().filter(|s| s.kind == "planes").map(|s| s.length).sum();
        Ok(Self { now: index.len() + coded as usize, index: index.to_vec(), planes })
    }
}

/// Bytes of index and planes of one container.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct SharedRow {
    /// As they are now.
    pub now: usize,
    /// By zstd.
    pub zstd: usize,
    /// By zstd with the dictionary.
    pub shared: usize,
}

/// Each container with what all others hold as the dictionary.
pub fn compare(all: &[Plain]) -> Result<Vec<SharedRow>, BenchError> {
    let failed = |e: std::io::Error| BenchError::Picture(e.to_string());
    let row = |i: usize, own: &Plain| {
        let others = all.iter().enumerate().filter(|(k, _)| *k != i).map(|(_, p)| p);
        let dictionary: Vec<u8> = others.flat_map(|p| p.planes.iter().chain(&p.index)).copied().collect();
        let bytes = |dictionary: &[u8]| -> Result<usize, BenchError> {
            let mut zstd = zstd::bulk::Compressor::with_dictionary(ZSTD_MOST, dictionary).map_err(failed)?;
            Ok(zstd.compress(&own.index).map_err(failed)?.len() + zstd.compress(&own.planes).map_err(failed)?.len())
        };
        Ok(SharedRow { now: own.now, zstd: bytes(&[])?, shared: bytes(&dictionary)? })
    };
    all.iter().enumerate().map(|(i, own)| row(i, own)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_others_hold_costs_less() {
        let plain = |k: u32| Plain {
            index: b"the same in all of them".repeat(3),
            planes: (0..400u32).map(|i| ((i + k).wrapping_mul(2_654_435_761) >> 24) as u8).collect(),
            now: 1000,
        };
        let rows = compare(&[plain(0), plain(0), plain(9000)]).unwrap();
        assert!(rows.iter().all(|r| r.now == 1000 && r.shared < r.zstd), "{rows:?}");
        assert!(rows[0].shared < rows[2].shared, "{rows:?}");
    }
}
