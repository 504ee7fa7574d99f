//! Damaged access units into the decoder of a room: time and memory that they take.

use std::fmt::Write as _;
use std::time::Instant;

use serde::Serialize;

use tmpi_live::video::{self, VideoError};
use tmpi_pipeline::clock::{Clock, peak_rss_bytes};

use super::sequence::{Kind, Sequence};
use super::{LiveBenchError, encoder};

/// Frames of the stream that is damaged.
const FRAMES: u32 = 120;
/// Units that are decoded before memory is looked at: what a sound stream takes.
const WARM: u64 = 1000;
/// Bytes that damage may make the decoder take beyond that.
const MEMORY: u64 = 64 << 20;
/// Milliseconds of the processor that a unit may take: on a machine that does nothing else a room's frames wait so long at the most.
const LONGEST: f64 = 1000.0;
/// Changes of a unit, at most.
const CHANGES: u64 = 16;

/// What became of the units.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Damaged {
    /// Units that were damaged.
    pub units: u64,
    /// Of these decoded to a picture all the same.
    pub pictures: u64,
    /// Without a picture.
    pub without: u64,
    /// Refused.
    pub refused: u64,
    /// Refused, as the decoder panicked within its bounds: nothing outside it notices.
    pub contained: u64,
    /// Seconds in all.
    pub seconds: f64,
    /// Milliseconds of the one that took longest, by the clock: whatever else the machine does is in it.
    pub longest_ms: f64,
    /// The most of the processor that one took, in milliseconds; by the clock where the system does not tell.
    pub longest_cpu_ms: f64,
    /// Bytes of memory beyond what a sound stream takes, at the most.
    pub memory: u64,
}

impl Damaged {
    /// Whether time and memory are within their bounds, and nothing has panicked: contained or not, that is a fault.
    ///
    /// # Errors
    /// What is not as it should be, with its figure.
    pub fn check(&self) -> Result<(), String> {
        let mut wrong = Vec::new();
        if self.longest_cpu_ms > LONGEST {
            wrong.push(format!("a unit took {:.0} ms of the processor, more than {LONGEST:.0}", self.longest_cpu_ms));
        }
        if self.memory > MEMORY {
            wrong.push(format!("{} bytes of memory, more than {MEMORY}", self.memory));
        }
        if self.contained > 0 {
            wrong.push(format!("the decoder panicked at {} units", self.contained));
        }
        if wrong.is_empty() { Ok(()) } else { Err(wrong.join("; ")) }
    }

    /// As lines.
    #[must_use]
    pub fn table(&self) -> String {
        let mut out = String::new();
        let Self { units, pictures, without, refused, contained, seconds, longest_ms, longest_cpu_ms, memory } = self;
        let _ = writeln!(out, "damaged access units              {units}");
        let _ = writeln!(out, "decoded all the same              {pictures}, without a picture {without}");
        let _ = writeln!(out, "refused                           {refused}, of which the decoder gave up within its bounds {contained}");
        let _ = writeln!(out, "time                              {seconds:.0} s, the longest {longest_ms:.1} ms");
        let _ = writeln!(out, "of the processor                  {longest_cpu_ms:.1} ms at the most (bound {LONGEST:.0} ms)");
        let _ = writeln!(out, "memory beyond a sound stream's    {:.1} MiB (bound {} MiB)", *memory as f64 / 1_048_576.0, MEMORY >> 20);
        out
    }
}

/// Damages `count` units of a stream – frames of that size, H.264 of `bitrate` bits a second or JPEG – and decodes them. After each that is refused a sound key frame follows, which is not counted: the next
/// one finds a decoder at work. `told` is told how far it is.
///
/// # Errors
/// [`LiveBenchError`] where there is no stream, or a sound key frame is refused after a damaged one.
pub fn run(size: (u32, u32), bitrate: Option<u32>, count: u64, told: &dyn Fn(&str)) -> Result<Damaged, LiveBenchError> {
    let mut encoder = encoder(size, bitrate)?;
    let sequence = Sequence::new(Kind::Measured, super::SEED, size, FRAMES, super::measure::ASIDE);
    let units = (0..FRAMES).map(|n| encoder.encode(&sequence.shot(n).noisy)).collect::<Result<Vec<_>, _>>()?;
    let key = units.iter().find(|(_, key)| *key).map(|(data, _)| data.clone());
    let key = key.ok_or_else(|| LiveBenchError::Encode("a stream without a key frame".into()))?;
    let mut decoder = video::decoder(encoder.codec(), size)?;
    for n in 0..WARM {
        decoder.decode(&units[n as usize % units.len()].0)?;
    }
    // what the decoder's own panics say is counted, not printed
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
            told(&format!("{} of {count} damaged units", out.units));
        }
    }
    std::panic::set_hook(hook);
    out.seconds = began.elapsed().as_secs_f64();
    out.memory = peak_rss_bytes().saturating_sub(before);
    result.map(|()| out)
}

/// Bytes changed, cut off, doubled, or gone on with as another unit does.
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

/// Xorshift (Marsaglia 2003): the same each time.
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
    fn damaged_frames_are_refused_or_shown_and_all_are_counted() {
        let found = run((80, 64), Some(100_000), 300, &|_| {}).unwrap();
        assert_eq!((found.units, found.pictures + found.without + found.refused), (300, 300));
        assert!(found.longest_cpu_ms > 0.0 && found.longest_ms > 0.0);
        assert!(found.pictures > 0 && found.refused > 0 && found.contained <= found.refused, "{found:?}");
    }

    #[test]
    fn what_is_beyond_its_bound_and_any_panic_is_a_failure_that_says_so() {
        let good = Damaged { units: 9, pictures: 5, refused: 4, longest_cpu_ms: LONGEST, memory: MEMORY, ..Damaged::default() };
        assert_eq!(good.check(), Ok(()));
        let panicked = Damaged { contained: 2, ..good.clone() }.check().unwrap_err();
        assert!(panicked.contains("panicked at 2 units"), "{panicked}");
        let all = Damaged { contained: 1, longest_cpu_ms: LONGEST + 1.0, memory: MEMORY + 1, ..good }.check().unwrap_err();
        assert_eq!(all.matches(';').count(), 2, "{all}");
    }

    #[test]
    fn damage_changes_what_it_is_given() {
        let (unit, other) = ((0..200u8).collect::<Vec<_>>(), vec![7; 90]);
        let mut random = Random(1);
        let changed = (0..100).filter(|_| damage(&unit, &other, &mut random) != unit).count();
        assert!(changed > 95, "{changed}");
        assert!(damage(&[], &other, &mut random).is_empty());
    }
}
