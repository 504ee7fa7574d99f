//! Feeds damaged access units to a room's decoder, and measures time and memory.

use std::fmt::Write as _;
use std::time::Instant;

use serde::Serialize;

use tmpi_live::video::{self, VideoError};
use tmpi_pipeline::usage::{Clock, peak_rss_bytes};

use super::sequence::{Kind, Sequence};
use super::{LiveBenchError, encoder};

/// Frames in the stream to damage.
const FRAMES: u32 = 120;
/// Undamaged units to decode before memory is measured.
const WARM_UP: u64 = 1000;
/// Limit of additional memory for damaged units, in bytes.
const MEMORY: u64 = 64 << 20;
/// Limit of CPU time per unit, in milliseconds: the longest delay of a room's frames on an idle machine.
const LONGEST: f64 = 1000.0;
/// Maximum number of changes per unit.
const CHANGES: u64 = 16;

/// Results for damaged units.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Damaged {
    /// Number of damaged units.
    pub units: u64,
    /// Units that still decoded to a picture.
    pub pictures: u64,
    /// Units that decoded without a picture.
    pub without: u64,
    /// Units that were refused.
    pub refused: u64,
    /// Refused units at which the decoder panicked; the panic was caught.
    pub contained: u64,
    /// Total time in seconds.
    pub seconds: f64,
    /// Longest wall time of a unit in milliseconds, including other load.
    pub longest_ms: f64,
    /// Longest CPU time of a unit in milliseconds; wall time if CPU time is unknown.
    pub longest_cpu_ms: f64,
    /// Peak memory in bytes beyond that of an undamaged stream.
    pub memory: u64,
}

impl Damaged {
    /// Checks that time and memory are within their limits, and that the decoder did not panic. Even a caught panic is a fault.
    ///
    /// # Errors
    /// Lists each violation with its value.
    pub fn check(&self) -> Result<(), String> {
        let mut wrong = Vec::new();
        if self.longest_cpu_ms > LONGEST {
            wrong.push(format!("a unit took {:.0} ms of CPU time, more than {LONGEST:.0}", self.longest_cpu_ms));
        }
        if self.memory > MEMORY {
            wrong.push(format!("{} bytes of memory, more than {MEMORY}", self.memory));
        }
        if self.contained > 0 {
            wrong.push(format!("the decoder panicked at {} units", self.contained));
        }
        if wrong.is_empty() { Ok(()) } else { Err(wrong.join("; ")) }
    }

    /// The results as a text table.
    #[must_use]
    pub fn table(&self) -> String {
        let mut out = String::new();
        let Self { units, pictures, without, refused, contained, seconds, longest_ms, longest_cpu_ms, memory } = self;
        let _ = writeln!(out, "damaged access units              {units}");
        let _ = writeln!(out, "decoded                           {pictures} with a picture, {without} without");
        let _ = writeln!(out, "refused                           {refused}, {contained} of them after a caught panic");
        let _ = writeln!(out, "time                              {seconds:.0} s, longest {longest_ms:.1} ms");
        let _ = writeln!(out, "longest CPU time                  {longest_cpu_ms:.1} ms (limit {LONGEST:.0} ms)");
        let _ = writeln!(out, "additional memory                 {:.1} MiB (limit {} MiB)", *memory as f64 / 1_048_576.0, MEMORY >> 20);
        out
    }
}

/// Damages and decodes `count` units of a stream: frames of this size, as H.264 at `bitrate` bits per second, or as JPEG.
///
/// After each refused unit, an undamaged key frame follows, which is not counted, so that the next unit reaches a working decoder.
/// `progress` is called from time to time.
///
/// # Errors
/// [`LiveBenchError`] if the stream cannot be encoded, or an undamaged key frame is refused after a damaged unit.
pub fn run(size: (u32, u32), bitrate: Option<u32>, count: u64, progress: &dyn Fn(&str)) -> Result<Damaged, LiveBenchError> {
    let mut encoder = encoder(size, bitrate)?;
    let sequence = Sequence::new(Kind::Measured, super::SEED, size, FRAMES, super::measure::SIDE_OFFSET);
    let units = (0..FRAMES).map(|n| encoder.encode(&sequence.shot(n).noisy)).collect::<Result<Vec<_>, _>>()?;
    let key = units.iter().find(|(_, key)| *key).map(|(data, _)| data.clone());
    let key = key.ok_or_else(|| LiveBenchError::Encode("the stream has no key frame".into()))?;
    let mut decoder = video::decoder(encoder.codec(), size)?;
    for n in 0..WARM_UP {
        decoder.decode(&units[n as usize % units.len()].0)?;
    }
    // count the decoder's panics instead of printing them
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let (mut out, mut random, began, before) = (Damaged::default(), Random(0x9E37_79B9_7F4A_7C15), Instant::now(), peak_rss_bytes());
    let mut result = Ok(());
    while out.units < count {
        let (unit, other) = (&units[out.units as usize % units.len()].0, &units[random.below(units.len())].0);
        let data = damage(unit, other, &mut random);
        let clock = Clock::start();
        let decoded = decoder.decode(&data);
        let (wall, cpu) = (clock.ms(), clock.cpu_ms());
        out.longest_ms = out.longest_ms.max(wall);
        out.longest_cpu_ms = out.longest_cpu_ms.max(if cpu > 0.0 { cpu } else { wall });
        out.units += 1;
        match decoded {
            Ok(Some(_)) => out.pictures += 1,
            Ok(None) => out.without += 1,
            Err(error) => {
                out.refused += 1;
                out.contained += u64::from(matches!(&error, VideoError::Broken(what) if what == video::FAILED));
                if let Err(error) = decoder.decode(&key) {
                    result = Err(error.into());
                    break;
                }
            }
        }
        if out.units.is_multiple_of(100_000) {
            progress(&format!("{} of {count} damaged units", out.units));
        }
    }
    std::panic::set_hook(hook);
    out.seconds = began.elapsed().as_secs_f64();
    out.memory = peak_rss_bytes().saturating_sub(before);
    result.map(|()| out)
}

/// Damages a unit: changes, truncates, inserts and duplicates bytes, or continues with another unit.
fn damage(unit: &[u8], other: &[u8], random: &mut Random) -> Vec<u8> {
    let mut data = unit.to_vec();
    for _ in 0..=random.next() % CHANGES {
        if data.is_empty() {
            return data;
        }
        let at = random.below(data.len());
        match random.next() % 12 {
            0 => data.truncate(at),
            1 => {
                let end = (at + random.below(64)).min(data.len());
                let copy = data[at..end].to_vec();
                data.splice(at..at, copy);
            }
            2 => {
                data.truncate(at);
                data.extend_from_slice(&other[at.min(other.len())..]);
            }
            3 => drop(data.splice(at..at, [0, 0, 1, random.next() as u8])),
            4..8 => data[at] ^= 1 << (random.next() % 8),
            _ => data[at] = random.next() as u8,
        }
    }
    data
}

/// Xorshift generator (Marsaglia 2003) with reproducible values.
struct Random(u64);

impl Random {
    const fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 >> 11
    }

    const fn below(&mut self, end: usize) -> usize {
        (self.next() % end as u64) as usize
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "test")]

    use super::*;

    #[test]
    fn all_damaged_frames_are_counted() {
        let found = run((80, 64), Some(100_000), 300, &|_| {}).unwrap();
        assert_eq!((found.units, found.pictures + found.without + found.refused), (300, 300));
        assert!(found.longest_cpu_ms > 0.0 && found.longest_ms > 0.0);
        assert!(found.pictures > 0 && found.refused > 0 && found.contained <= found.refused, "{found:?}");
    }

    #[test]
    fn panics_and_exceeded_limits_are_reported() {
        let good = Damaged { units: 9, pictures: 5, refused: 4, longest_cpu_ms: LONGEST, memory: MEMORY, ..Damaged::default() };
        assert_eq!(good.check(), Ok(()));
        let panicked = Damaged { contained: 2, ..good.clone() }.check().unwrap_err();
        assert!(panicked.contains("panicked at 2 units"), "{panicked}");
        let all = Damaged { contained: 1, longest_cpu_ms: LONGEST + 1.0, memory: MEMORY + 1, ..good }.check().unwrap_err();
        assert_eq!(all.matches(';').count(), 2, "{all}");
    }

    #[test]
    fn damage_changes_units() {
        let (unit, other) = ((0..200u8).collect::<Vec<_>>(), vec![7; 90]);
        let mut random = Random(1);
        let changed = (0..100).filter(|_| damage(&unit, &other, &mut random) != unit).count();
        assert!(changed > 95, "{changed}");
        assert!(damage(&[], &other, &mut random).is_empty());
    }
}
