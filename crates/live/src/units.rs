//! Access units out of a stream of H.264 in Annex B, as it comes.

/// Bytes of an access unit that is not at its end yet, at most.
const MOST: usize = 4 << 20;

/// NAL unit types (ITU-T H.264, table 7-1).
const SLICE: u8 = 1;
const KEY: u8 = 5;
const SEI: u8 = 6;
const PARAMETERS: u8 = 7;
const DELIMITER: u8 = 9;
/// Type of the SEI message that says how pictures are to be turned (ITU-T H.264, D.1).
const ORIENTATION: usize = 47;

/// One access unit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unit {
    /// Its bytes, start codes included.
    pub data: Vec<u8>,
    /// It can be decoded without any other.
    pub key: bool,
}

/// Splits a stream into access units.
#[derive(Debug, Default)]
pub struct Splitter {
    bytes: Vec<u8>,
    /// How far start codes were looked for.
    looked: usize,
    /// The unit at hand has a slice, or one of a key frame.
    slice: bool,
    key: bool,
}

/// The stream is none that can be split.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{MOST} bytes without the end of an access unit: not H.264 in Annex B")]
pub struct NoUnits;

impl Splitter {
    /// Takes what came; gives the units that are complete.
    ///
    /// # Errors
    /// [`NoUnits`].
    pub fn push(&mut self, bytes: &[u8]) -> Result<Vec<Unit>, NoUnits> {
        self.bytes.extend_from_slice(bytes);
        let mut units = Vec::new();
        // the byte after the NAL unit's head tells whether a slice is the first of its picture
        while let Some(at) = (self.looked..self.bytes.len().saturating_sub(4)).find(|&i| self.bytes[i..i + 3] == [0, 0, 1]) {
            let (kind, first) = (self.bytes[at + 3] & 31, self.bytes[at + 4] & 0x80 != 0);
            let slice = matches!(kind, SLICE..=KEY);
            let begins = self.slice && ((slice && first) || matches!(kind, SEI..=DELIMITER));
            let mut next = at + 3;
            if begins {
                // a start code of four bytes begins with the zero
                let end = if at > 0 && self.bytes[at - 1] == 0 { at - 1 } else { at };
                let rest = self.bytes.split_off(end);
                next -= end;
                units.push(Unit { data: std::mem::replace(&mut self.bytes, rest), key: self.key });
                (self.slice, self.key) = (false, false);
            }
            self.slice |= slice;
            self.key |= kind == KEY;
            self.looked = next;
        }
        self.looked = self.looked.max(self.bytes.len().saturating_sub(4));
        if self.bytes.len() > MOST { Err(NoUnits) } else { Ok(units) }
    }

    /// The last unit, where the stream is at its end.
    #[must_use]
    pub fn finish(self) -> Option<Unit> {
        self.slice.then_some(Unit { data: self.bytes, key: self.key })
    }
}

/// Codec string of `WebCodecs` for a stream that begins with this unit; none where it has no sequence parameter set.
#[must_use]
pub fn codec(unit: &[u8]) -> Option<String> {
    let at = unit.windows(4).position(|w| w[..3] == [0, 0, 1] && w[3] & 31 == PARAMETERS)?;
    let [profile, constraints, level] = *unit.get(at + 4..)?.first_chunk::<3>()?;
    Some(format!("avc1.{profile:02x}{constraints:02x}{level:02x}"))
}

/// Whether a unit has a slice that refers to later pictures, too (a B slice): it is not shown in the order in which it comes.
#[must_use]
pub fn is_bidirectional(unit: &[u8]) -> bool {
    nals(unit, |kind| matches!(kind, SLICE | KEY)).any(|slice| matches!(slice_type(slice), Some(1 | 6)))
}

/// Whether a unit says that its picture is to be turned or mirrored as it is shown (a display orientation SEI message).
#[must_use]
pub fn is_turned(unit: &[u8]) -> bool {
    nals(unit, |kind| kind == SEI).any(|nal| {
        let end = nal.windows(3).position(|w| w[..2] == [0, 0] && w[2] <= 1).unwrap_or(nal.len());
        turns(&without_stuffing(&nal[..end])).unwrap_or(false)
    })
}

/// What is behind the heads of the NAL units of some types, up to the end of the access unit.
fn nals(unit: &[u8], wanted: impl Fn(u8) -> bool) -> impl Iterator<Item = &[u8]> {
    let heads = unit.windows(4).enumerate().filter(move |(_, w)| w[..3] == [0, 0, 1] && wanted(w[3] & 31));
    heads.filter_map(|(at, _)| unit.get(at + 4..))
}

/// Bytes without those that keep start codes out (ITU-T H.264, 7.4.1).
fn without_stuffing(bytes: &[u8]) -> Vec<u8> {
    let (mut out, mut zeros) = (Vec::with_capacity(bytes.len()), 0);
    for &byte in bytes {
        if byte != 3 || zeros < 2 {
            out.push(byte);
        }
        zeros = if byte == 0 { zeros + 1 } else { 0 };
    }
    out
}

/// Whether one of the messages of an SEI NAL unit turns the picture; none where they are cut short (ITU-T H.264, 7.3.2.3.1 and D.1.27).
fn turns(mut messages: &[u8]) -> Option<bool> {
    loop {
        let [kind, size] = [number(&mut messages)?, number(&mut messages)?];
        let (message, rest) = messages.split_at_checked(size)?;
        if kind == ORIENTATION {
            // whether that of before ends, whether left and right, above and below are exchanged; the angle
            let &[flags, angle, last] = message.first_chunk()?;
            return Some(flags & 0x80 == 0 && (flags & 0x7F, angle, last & 0xE0) != (0, 0, 0));
        }
        messages = rest;
    }
}

/// A number of an SEI message: the sum of the bytes up to one that is not 255.
fn number(bytes: &mut &[u8]) -> Option<usize> {
    let end = bytes.iter().position(|&byte| byte != 0xFF)?;
    let number = end * 0xFF + usize::from(bytes[end]);
    *bytes = &bytes[end + 1..];
    Some(number)
}

/// Type of a slice by its header (ITU-T H.264, 7.3.3).
fn slice_type(slice: &[u8]) -> Option<u32> {
    // two numbers of 33 bits at most, and what keeps start codes out
    let head = without_stuffing(&slice[..slice.len().min(16)]);
    let mut bits = head.iter().flat_map(|byte| (0..8).rev().map(move |i| u32::from(byte >> i & 1)));
    let mut number = || {
        let zeros = bits.by_ref().take_while(|&bit| bit == 0).count();
        let value = (0..zeros.min(33)).try_fold(1u64, |value, _| Some(value << 1 | u64::from(bits.next()?)))?;
        u32::try_from(value - 1).ok()
    };
    let _first_block = number()?;
    number()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// NAL units of three pictures, the first a key with parameter sets, the second of two slices.
    fn pictures() -> Vec<Vec<u8>> {
        let nal =
            |long: bool, kind: u8, first: u8| [if long { &[0, 0, 0, 1][..] } else { &[0, 0, 1][..] }, &[kind, first, 7, 7, 7]].concat();
        vec![
            [nal(true, 0x67, 0x42), nal(true, 0x68, 0xCE), nal(false, 0x65, 0x88)].concat(),
            [nal(true, 0x41, 0x9A), nal(false, 0x41, 0x12)].concat(),
            [nal(true, 0x09, 0xF0), nal(true, 0x41, 0x9B)].concat(),
        ]
    }

    proptest! {
        /// In pieces of any size.
        #[test]
        fn units_come_back(sizes in prop::collection::vec(1usize..20, 1..40)) {
            let stream = pictures().concat();
            let (mut splitter, mut units, mut rest) = (Splitter::default(), Vec::new(), stream.as_slice());
            for size in sizes.iter().cycle() {
                if rest.is_empty() {
                    break;
                }
                let (piece, after) = rest.split_at((*size).min(rest.len()));
                rest = after;
                units.extend(splitter.push(piece).unwrap());
            }
            units.extend(splitter.finish());
            let (data, keys): (Vec<_>, Vec<_>) = units.into_iter().map(|u| (u.data, u.key)).unzip();
            prop_assert_eq!(data, pictures());
            prop_assert_eq!(keys, [true, false, false]);
        }
    }

    #[test]
    fn what_is_no_stream_is_refused_and_the_codec_is_read() {
        let mut splitter = Splitter::default();
        assert!(splitter.push(&vec![7; MOST]).is_ok());
        assert_eq!(splitter.push(&[7]), Err(NoUnits));
        assert_eq!(codec(&pictures()[0]).unwrap(), "avc1.420707");
        assert_eq!(codec(&pictures()[1]), None);
    }

    #[test]
    fn b_slices_are_noticed_in_any_slice_of_a_unit_and_others_are_none() {
        assert!(pictures().iter().all(|unit| !is_bidirectional(unit)));
        let unit = |slices: &[&[u8]]| slices.iter().flat_map(|s| [&[0, 0, 1, 0x41][..], s].concat()).collect::<Vec<u8>>();
        // first block 0; types 1 and 6 are B, 0 and 5 P, 2 and 7 I
        for (head, is) in [(0xA0, true), (0x9E, true), (0xC0, false), (0x9A, false), (0xB0, false), (0x88, false)] {
            assert_eq!(is_bidirectional(&unit(&[&[head, 7, 7]])), is, "{head:#x}");
        }
        assert!(is_bidirectional(&unit(&[&[0x9A, 7], &[0x49, 0x7F, 7]])), "first block 1, type 1, in the second slice");
        // first block 65 535: sixteen zeros, a one, sixteen zeros, with a byte 3 behind each two of zero; then type 1
        assert!(is_bidirectional(&unit(&[&[0, 0, 3, 0x80, 0, 0x28]])));
        assert!(!is_bidirectional(&unit(&[&[0, 0, 3, 0x80, 0, 0x4C]])));
        for cut in [&[][..], &[0], &[0; 16], &[0, 0, 3, 0, 0, 3]] {
            assert!(!is_bidirectional(&unit(&[cut])));
        }
    }

    #[test]
    fn pictures_that_are_to_be_turned_are_noticed_behind_other_messages_and_others_are_none() {
        assert!(pictures().iter().all(|unit| !is_turned(unit)));
        let unit = |messages: &[u8]| [&[0, 0, 0, 1, 6][..], messages, &[0x80, 0, 0, 1, 0x65, 0x88, 0x84]].concat();
        // the flags, 16 bits of the angle, when it is said again, a bit that says no more, and what fills the byte
        for (message, is) in [
            // a quarter, and the same mirrored; upside down; mirrored alone
            ([0b0000_1000, 0, 0b0000_1010], true),
            ([0b0100_1000, 0, 0b0000_1010], true),
            ([0b0001_0000, 0, 0b0000_1010], true),
            ([0b0100_0000, 0, 0b0000_1010], true),
            ([0b0010_0000, 0, 0b0000_1010], true),
            // upright; that of before ends
            ([0, 0, 0b0000_1010], false),
            ([0b1000_0000, 0, 0b0000_1010], false),
        ] {
            let own = [&[47, 3][..], &message].concat();
            assert_eq!(is_turned(&unit(&own)), is, "{message:?}");
            // behind 300 bytes of a user's own; with a byte 3 behind two of zero
            let long = [&[5, 0xFF, 45][..], &[9; 300], &own].concat();
            assert_eq!(is_turned(&unit(&long)), is, "{message:?}");
            assert_eq!(is_turned(&unit(&[&[6, 2, 0, 0, 3][..], &own].concat())), is, "{message:?}");
        }
        let own = [47, 3, 0b0000_1000, 0, 0b0000_1010];
        for cut in 0..own.len() {
            assert!(!is_turned(&[&[0, 0, 1, 6][..], &own[..cut]].concat()));
        }
        assert!(!is_turned(&unit(&[0xFF; 40])) && !is_turned(&[&[0, 0, 1, 0x65][..], &own].concat()));
    }
}
