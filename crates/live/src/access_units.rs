//! Splits an H.264 Annex B stream into access units as it arrives.

/// Maximum size of an incomplete access unit in bytes.
const MAX_UNIT_BYTES: usize = 4 << 20;

/// NAL unit types (ITU-T H.264, table 7-1).
const SLICE: u8 = 1;
const KEY: u8 = 5;
const SEI: u8 = 6;
const PARAMETERS: u8 = 7;
const DELIMITER: u8 = 9;
/// SEI message type of the display orientation (ITU-T H.264, D.1).
const ORIENTATION: usize = 47;

/// One access unit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unit {
    /// Its bytes, including start codes.
    pub data: Vec<u8>,
    /// Whether it is a key frame, which decodes without any other.
    pub key: bool,
}

/// Splits a stream into access units.
#[derive(Debug, Default)]
pub struct Splitter {
    bytes: Vec<u8>,
    /// Bytes already searched for start codes.
    scanned: usize,
    /// The current unit has a slice; `key`: it has one of a key frame.
    slice: bool,
    key: bool,
}

/// The stream has no access units.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no access unit ends within {MAX_UNIT_BYTES} bytes: the stream is not H.264 in Annex B format")]
pub struct NotAnnexB;

impl Splitter {
    /// Appends received bytes and returns the complete units.
    ///
    /// # Errors
    /// [`NotAnnexB`] if no unit ends within the maximum size.
    pub fn push(&mut self, bytes: &[u8]) -> Result<Vec<Unit>, NotAnnexB> {
        self.bytes.extend_from_slice(bytes);
        let mut units = Vec::new();
        // the byte after the NAL unit header tells whether a slice is the first of its picture
        while let Some(at) = (self.scanned..self.bytes.len().saturating_sub(4)).find(|&i| self.bytes[i..i + 3] == [0, 0, 1]) {
            let (kind, first) = (self.bytes[at + 3] & 31, self.bytes[at + 4] & 0x80 != 0);
            let slice = matches!(kind, SLICE..=KEY);
            let begins = self.slice && ((slice && first) || matches!(kind, SEI..=DELIMITER));
            let mut next = at + 3;
            if begins {
                // the zero belongs to a start code of four bytes
                let end = if at > 0 && self.bytes[at - 1] == 0 { at - 1 } else { at };
                let rest = self.bytes.split_off(end);
                next -= end;
                units.push(Unit { data: std::mem::replace(&mut self.bytes, rest), key: self.key });
                (self.slice, self.key) = (false, false);
            }
            self.slice |= slice;
            self.key |= kind == KEY;
            self.scanned = next;
        }
        self.scanned = self.scanned.max(self.bytes.len().saturating_sub(4));
        if self.bytes.len() > MAX_UNIT_BYTES { Err(NotAnnexB) } else { Ok(units) }
    }

    /// Ends the stream and returns the last unit.
    pub fn finish(self) -> Option<Unit> {
        self.slice.then_some(Unit { data: self.bytes, key: self.key })
    }
}

/// `WebCodecs` codec string of a stream that begins with this unit; `None` if the unit has no sequence parameter set.
pub fn codec(unit: &[u8]) -> Option<String> {
    let at = unit.windows(4).position(|w| w[..3] == [0, 0, 1] && w[3] & 31 == PARAMETERS)?;
    let [profile, constraints, level] = *unit.get(at + 4..)?.first_chunk::<3>()?;
    Some(format!("avc1.{profile:02x}{constraints:02x}{level:02x}"))
}

/// Whether a unit has a B slice, which may refer to later pictures: decoding and display order then differ.
pub fn is_bidirectional(unit: &[u8]) -> bool {
    nals(unit, |kind| matches!(kind, SLICE | KEY)).any(|slice| matches!(slice_type(slice), Some(1 | 6)))
}

/// Whether a display orientation SEI message asks to rotate or mirror the unit's picture.
pub fn is_turned(unit: &[u8]) -> bool {
    nals(unit, |kind| kind == SEI).any(|nal| {
        let end = nal.windows(3).position(|w| w[..2] == [0, 0] && w[2] <= 1).unwrap_or(nal.len());
        has_rotation(&without_stuffing(&nal[..end])).unwrap_or(false)
    })
}

/// Payloads of the NAL units of some types, each up to the end of the access unit.
fn nals(unit: &[u8], wanted: impl Fn(u8) -> bool) -> impl Iterator<Item = &[u8]> {
    let heads = unit.windows(4).enumerate().filter(move |(_, w)| w[..3] == [0, 0, 1] && wanted(w[3] & 31));
    heads.filter_map(|(at, _)| unit.get(at + 4..))
}

/// Removes emulation prevention bytes (ITU-T H.264, 7.4.1).
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

/// Whether a message of an SEI NAL unit rotates or mirrors the picture; `None` if they are truncated (ITU-T H.264, 7.3.2.3.1 and D.1.27).
fn has_rotation(mut messages: &[u8]) -> Option<bool> {
    loop {
        let [kind, size] = [number(&mut messages)?, number(&mut messages)?];
        let (message, rest) = messages.split_at_checked(size)?;
        if kind == ORIENTATION {
            // flags: cancel, horizontal flip, vertical flip; then the rotation angle
            let &[flags, angle, last] = message.first_chunk()?;
            return Some(flags & 0x80 == 0 && (flags & 0x7F, angle, last & 0xE0) != (0, 0, 0));
        }
        messages = rest;
    }
}

/// A number in an SEI message: the sum of the bytes up to the first that is not 255.
fn number(bytes: &mut &[u8]) -> Option<usize> {
    let end = bytes.iter().position(|&byte| byte != 0xFF)?;
    let number = end * 0xFF + usize::from(bytes[end]);
    *bytes = &bytes[end + 1..];
    Some(number)
}

/// Slice type from a slice header (ITU-T H.264, 7.3.3).
fn slice_type(slice: &[u8]) -> Option<u32> {
    // enough for two numbers of up to 33 bits and emulation prevention bytes
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

    /// NAL units of three pictures. The first is a key frame with parameter sets, the second has two slices.
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
        #[test]
        fn units_do_not_depend_on_chunk_sizes(sizes in prop::collection::vec(1usize..20, 1..40)) {
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
    fn codecs_are_read_and_other_data_is_refused() {
        let mut splitter = Splitter::default();
        assert!(splitter.push(&vec![7; MAX_UNIT_BYTES]).is_ok());
        assert_eq!(splitter.push(&[7]), Err(NotAnnexB));
        assert_eq!(codec(&pictures()[0]).unwrap(), "avc1.420707");
        assert_eq!(codec(&pictures()[1]), None);
    }

    #[test]
    fn b_slices_are_detected_anywhere_in_a_unit() {
        assert!(pictures().iter().all(|unit| !is_bidirectional(unit)));
        let unit = |slices: &[&[u8]]| slices.iter().flat_map(|s| [&[0, 0, 1, 0x41][..], s].concat()).collect::<Vec<u8>>();
        // first block 0; types 1 and 6 are B, 0 and 5 P, 2 and 7 I
        for (head, is) in [(0xA0, true), (0x9E, true), (0xC0, false), (0x9A, false), (0xB0, false), (0x88, false)] {
            assert_eq!(is_bidirectional(&unit(&[&[head, 7, 7]])), is, "{head:#x}");
        }
        assert!(is_bidirectional(&unit(&[&[0x9A, 7], &[0x49, 0x7F, 7]])), "first block 1, type 1, in the second slice");
        // first block 65 535: sixteen zeros, a one, sixteen zeros, with a byte 3 after each two zero bytes; then type 1
        assert!(is_bidirectional(&unit(&[&[0, 0, 3, 0x80, 0, 0x28]])));
        assert!(!is_bidirectional(&unit(&[&[0, 0, 3, 0x80, 0, 0x4C]])));
        for cut in [&[][..], &[0], &[0; 16], &[0, 0, 3, 0, 0, 3]] {
            assert!(!is_bidirectional(&unit(&[cut])));
        }
    }

    #[test]
    fn display_orientation_is_detected_after_other_messages() {
        assert!(pictures().iter().all(|unit| !is_turned(unit)));
        let unit = |messages: &[u8]| [&[0, 0, 0, 1, 6][..], messages, &[0x80, 0, 0, 1, 0x65, 0x88, 0x84]].concat();
        // flags, 16 bits of angle, repetition period, extension flag, and padding
        for (message, is) in [
            // a quarter turn, a mirrored quarter turn, upside down, two mirrored
            ([0b0000_1000, 0, 0b0000_1010], true),
            ([0b0100_1000, 0, 0b0000_1010], true),
            ([0b0001_0000, 0, 0b0000_1010], true),
            ([0b0100_0000, 0, 0b0000_1010], true),
            ([0b0010_0000, 0, 0b0000_1010], true),
            // upright, cancelled
            ([0, 0, 0b0000_1010], false),
            ([0b1000_0000, 0, 0b0000_1010], false),
        ] {
            let own = [&[47, 3][..], &message].concat();
            assert_eq!(is_turned(&unit(&own)), is, "{message:?}");
            // after 300 bytes of user data; after an emulation prevention byte
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
