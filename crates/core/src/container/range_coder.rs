//! Adaptive binary range coder: 12-bit probabilities from the mean of a quick and a slow estimate, 32-bit range, carry propagation by
//! counting.
//!
//! All arithmetic is in integers, so writers and readers agree bit for bit on every machine, including browsers.

/// An adaptive model of one bit: the probability of a 1 in 1/65 536, estimated at two speeds.
#[derive(Clone, Copy, Debug)]
pub struct Bit {
    quick: u16,
    slow: u16,
}

impl Default for Bit {
    fn default() -> Self {
        Self { quick: 1 << 15, slow: 1 << 15 }
    }
}

const QUICK: u32 = 4;
const SLOW: u32 = 7;
/// Below this range, the coder shifts out a byte.
const BOTTOM: u32 = 1 << 24;

impl Bit {
    /// A model that starts with a probability of `p` in 65 536 for a 1.
    pub const fn of(p: u16) -> Self {
        Self { quick: p, slow: p }
    }

    /// The slow estimate of the probability of a 1, in 65 536.
    pub const fn slow(self) -> u16 {
        self.slow
    }

    /// Share of the range for a 1, in 1/4096: 1 to 4095.
    fn share(self) -> u32 {
        ((u32::from(self.quick) + u32::from(self.slow)) >> 5).clamp(1, 4095)
    }

    fn learn(&mut self, bit: bool) {
        let towards = |p: u16, rate: u32| if bit { p + ((u16::MAX - p) >> rate) } else { p - (p >> rate) };
        self.quick = towards(self.quick, QUICK);
        self.slow = towards(self.slow, SLOW);
    }
}

/// Writes bits to a stream.
pub struct Encoder {
    low: u64,
    range: u32,
    /// The last byte, held back because a carry may still increment it, and the number of 0xFF bytes after it.
    held: u8,
    ones: usize,
    started: bool,
    out: Vec<u8>,
}

impl Encoder {
    /// An empty stream.
    pub fn new() -> Self {
        Self { low: 0, range: u32::MAX, held: 0, ones: 0, started: false, out: Vec::new() }
    }

    fn shift(&mut self) {
        let carry = (self.low >> 32) as u8;
        let top = (self.low >> 24) as u8;
        if top != 0xff || carry != 0 {
            if self.started {
                self.out.push(self.held.wrapping_add(carry));
            }
            self.out.extend(std::iter::repeat_n(0xffu8.wrapping_add(carry), self.ones));
            self.ones = 0;
            self.held = top;
            self.started = true;
        } else {
            self.ones += 1;
        }
        self.low = (self.low & 0x00ff_ffff) << 8;
    }

    /// Ends the stream. Omits trailing zero bytes; the decoder reads zeros there.
    pub fn finish(mut self) -> Vec<u8> {
        for _ in 0..5 {
            self.shift();
        }
        let end = self.out.iter().rposition(|b| *b != 0).map_or(0, |p| p + 1);
        self.out.truncate(end);
        self.out
    }
}

/// Reads bits from a stream.
pub struct Decoder<'a> {
    code: u32,
    range: u32,
    data: &'a [u8],
}

impl<'a> Decoder<'a> {
    /// Starts at the beginning of a stream.
    pub fn new(data: &'a [u8]) -> Self {
        let mut d = Self { code: 0, range: u32::MAX, data };
        for _ in 0..4 {
            d.shift();
        }
        d
    }

    fn shift(&mut self) {
        let (next, rest) = self.data.split_first().map_or((0, self.data), |(b, r)| (*b, r));
        self.data = rest;
        self.code = (self.code << 8) | u32::from(next);
    }
}

/// Writes or reads bits, so that one function can do both.
pub trait Coder {
    /// Writes `bit` and returns it, or ignores it and returns the bit read.
    fn bit(&mut self, model: &mut Bit, bit: bool) -> bool;
}

impl Coder for Encoder {
    fn bit(&mut self, model: &mut Bit, bit: bool) -> bool {
        let split = (self.range >> 12) * model.share();
        if bit {
            self.range = split;
        } else {
            self.low += u64::from(split);
            self.range -= split;
        }
        model.learn(bit);
        while self.range < BOTTOM {
            self.range <<= 8;
            self.shift();
        }
        bit
    }
}

impl Coder for Decoder<'_> {
    fn bit(&mut self, model: &mut Bit, _: bool) -> bool {
        let split = (self.range >> 12) * model.share();
        let bit = self.code < split;
        if bit {
            self.range = split;
        } else {
            self.code -= split;
            self.range -= split;
        }
        model.learn(bit);
        while self.range < BOTTOM {
            self.range <<= 8;
            self.shift();
        }
        bit
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn bits_round_trip(bits in prop::collection::vec((0usize..4, prop::bool::weighted(0.03)), 0..4000), flip in any::<bool>()) {
            let mut models = [Bit::default(); 4];
            let mut e = Encoder::new();
            for (m, b) in &bits { e.bit(&mut models[*m], *b ^ flip); }
            let data = e.finish();
            prop_assert!(data.len() <= bits.len() / 2 + 8);
            let mut models = [Bit::default(); 4];
            let mut d = Decoder::new(&data);
            for (m, b) in &bits { prop_assert_eq!(d.bit(&mut models[*m], false), *b ^ flip); }
        }

        /// Any bytes decode to bits, and encoding these bits gives a stream that decodes to the same bits.
        #[test]
        fn any_bytes_can_be_read(data in prop::collection::vec(any::<u8>(), 0..200)) {
            let read = |data: &[u8]| {
                let (mut d, mut models) = (Decoder::new(data), [Bit::default(); 3]);
                (0..5000).map(|i| d.bit(&mut models[i % 3], false)).collect::<Vec<_>>()
            };
            let bits = read(&data);
            let (mut e, mut models) = (Encoder::new(), [Bit::default(); 3]);
            for (i, bit) in bits.iter().enumerate() { e.bit(&mut models[i % 3], *bit); }
            prop_assert_eq!(read(&e.finish()), bits);
        }
    }
}
