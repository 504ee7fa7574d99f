//! The two facts that are read from EXIF: orientation and focal length.
//!
//! By hand, and only these: readers of everything take memory for each of its entries, and directories that name one another
//! thousands of times make millions of them from 64 KiB.

/// What EXIF says about a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Facts {
    /// EXIF orientation, 1 to 8.
    pub orientation: u8,
    /// Focal length in millimetres on 35 mm film, where it is sane.
    pub focal_35: Option<f64>,
}

const ORIENTATION: u16 = 0x0112;
/// Where the directory of EXIF's own entries begins.
const EXIF: u16 = 0x8769;
const FOCAL_35: u16 = 0xA405;

impl Facts {
    pub(super) const NONE: Self = Self { orientation: 1, focal_35: None };
    /// Focal lengths on 35 mm film that a camera can have; beyond them lies a faulty writer.
    pub(super) const FOCAL_35: std::ops::RangeInclusive<f64> = 8.0..=600.0;

    /// Reads a TIFF structure without taking memory; what cannot be read is as if it were not there.
    pub(super) fn read(tiff: Option<&[u8]>) -> Self {
        let Some(tiff) = tiff.and_then(Tiff::new) else { return Self::NONE };
        let Some(first) = tiff.long(4) else { return Self::NONE };
        let orientation = tiff.number(first, ORIENTATION).filter(|o| (1.0..=8.0).contains(o) && o.fract() == 0.0);
        let focal = tiff.number(first, EXIF).and_then(|at| tiff.number(at as u32, FOCAL_35));
        Self { orientation: orientation.map_or(1, |o| o as u8), focal_35: focal.filter(|f| Self::FOCAL_35.contains(f)) }
    }
}

/// A TIFF structure.
pub(crate) struct Tiff<'a> {
    bytes: &'a [u8],
    little: bool,
}

impl<'a> Tiff<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Option<Self> {
        match bytes.first_chunk()? {
            b"II*\0" => Some(Self { bytes, little: true }),
            b"MM\0*" => Some(Self { bytes, little: false }),
            _ => None,
        }
    }

    fn raw<const N: usize>(&self, at: usize) -> Option<[u8; N]> {
        let mut raw: [u8; N] = *self.bytes.get(at..)?.first_chunk()?;
        if self.little {
            raw.reverse();
        }
        Some(raw)
    }

    pub(crate) fn short(&self, at: usize) -> Option<u16> {
        self.raw(at).map(u16::from_be_bytes)
    }

    pub(crate) fn long(&self, at: usize) -> Option<u32> {
        self.raw(at).map(u32::from_be_bytes)
    }

    /// Place of the entry `tag` in the directory at `directory`.
    fn entry(&self, directory: u32, tag: u16) -> Option<usize> {
        let start = directory as usize;
        let count = usize::from(self.short(start)?);
        (0..count).map(|i| start + 2 + 12 * i).find(|&at| self.short(at) == Some(tag))
    }

    /// Place and length of the bytes of the entry `tag` of kind UNDEFINED, where they are more than four.
    pub(crate) fn bytes(&self, directory: u32, tag: u16) -> Option<(usize, usize)> {
        let entry = self.entry(directory, tag)?;
        let length = self.long(entry + 4)? as usize;
        (self.short(entry + 2) == Some(7) && length > 4).then_some((self.long(entry + 8)? as usize, length))
    }

    /// First number of the entry `tag` in the directory at `directory`. The standard says SHORT for both facts, writers also use
    /// other types; text is no number.
    pub(crate) fn number(&self, directory: u32, tag: u16) -> Option<f64> {
        let entry = self.entry(directory, tag)?;
        let (kind, values) = (self.short(entry + 2)?, self.long(entry + 4)?);
        let bytes = match kind {
            1 | 6 => 1,
            3 | 8 => 2,
            4 | 9 | 11 => 4,
            5 | 10 | 12 => 8,
            _ => return None,
        };
        if values == 0 {
            return None;
        }
        let within = bytes * u64::from(values) <= 4;
        let at = if within { entry + 8 } else { self.long(entry + 8)? as usize };
        Some(match kind {
            1 => f64::from(*self.bytes.get(at)?),
            6 => f64::from(*self.bytes.get(at)? as i8),
            3 => f64::from(self.short(at)?),
            8 => f64::from(self.short(at)? as i16),
            4 => f64::from(self.long(at)?),
            9 => f64::from(self.long(at)? as i32),
            5 => f64::from(self.long(at)?) / f64::from(self.long(at + 4)?),
            10 => f64::from(self.long(at)? as i32) / f64::from(self.long(at + 4)? as i32),
            11 => f64::from(f32::from_bits(self.long(at)?)),
            _ => f64::from_bits(self.raw(at).map(u64::from_be_bytes)?),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A directory of `entries` that each say `tag`, `kind`, one value, `value`; little-endian.
    fn directory(entries: u16, tag: u16, kind: u16, value: u32) -> Vec<u8> {
        let mut out = b"II*\0\x08\0\0\0".to_vec();
        out.extend_from_slice(&entries.to_le_bytes());
        for _ in 0..entries {
            out.extend_from_slice(&[tag.to_le_bytes(), kind.to_le_bytes()].concat());
            out.extend_from_slice(&[1u32.to_le_bytes(), value.to_le_bytes()].concat());
        }
        out
    }

    #[test]
    fn directories_that_name_one_another_and_cut_ones_take_nothing() {
        let of = |t: &[u8]| Facts::read(Some(t)).orientation;
        assert_eq!(of(&directory(1, ORIENTATION, 3, 6)), 6);
        // each entry names the directory that it stands in: a reader that followed them all would never end
        assert_eq!(of(&directory(u16::MAX, EXIF, 4, 8)), 1);
        let whole = directory(3, ORIENTATION, 3, 6);
        for end in 0..20 {
            assert_eq!(of(&whole[..end]), 1, "cut to {end}");
        }
        // a directory at the end of all addresses
        assert_eq!(of(b"II*\0\xff\xff\xff\xff"), 1);
    }

    #[test]
    fn both_byte_orders_and_text_is_no_number() {
        let big = [b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x08\0\0".as_slice()].concat();
        assert_eq!(Facts::read(Some(&big)).orientation, 8);
        assert_eq!(Facts::read(Some(&directory(1, ORIENTATION, 2, 6))).orientation, 1);
        assert_eq!(Facts::read(Some(&directory(1, ORIENTATION, 3, 9))).orientation, 1);
    }
}
