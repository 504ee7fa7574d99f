//! Reads two facts from EXIF: orientation and focal length.
//!
//! This reader is handwritten and reads nothing else. A general reader allocates memory for every entry, and directories that refer to
//! each other thousands of times turn 64 KiB into millions of entries.

/// EXIF facts of a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Facts {
    /// EXIF orientation, 1 to 8.
    pub orientation: u8,
    /// 35 mm equivalent focal length in millimetres, if it lies in [`Facts::FOCAL_35`].
    pub focal_35: Option<f64>,
}

const ORIENTATION: u16 = 0x0112;
/// Tag of the offset of EXIF's own directory.
const EXIF: u16 = 0x8769;
const FOCAL_35: u16 = 0xA405;

impl Facts {
    pub(super) const NONE: Self = Self { orientation: 1, focal_35: None };
    /// 35 mm equivalent focal lengths, in millimetres, that a camera can have. Values outside come from faulty writers.
    pub(super) const FOCAL_35: std::ops::RangeInclusive<f64> = 8.0..=600.0;

    /// Reads a TIFF structure without allocating. Whatever it cannot read counts as absent.
    pub(super) fn read(tiff: Option<&[u8]>) -> Self {
        let Some(tiff) = tiff.and_then(Tiff::new) else { return Self::NONE };
        let Some(first) = tiff.long(4) else { return Self::NONE };
        let orientation = tiff.number(first, ORIENTATION).filter(|o| (1.0..=8.0).contains(o) && o.fract() == 0.0);
        let focal = tiff.number(first, EXIF).and_then(|at| tiff.number(at as u32, FOCAL_35));
        Self { orientation: orientation.map_or(1, |o| o as u8), focal_35: focal.filter(|f| Self::FOCAL_35.contains(f)) }
    }
}

/// Reads values from a TIFF structure in its byte order.
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

    /// Offset of the entry `tag` in the directory at `directory`.
    fn entry(&self, directory: u32, tag: u16) -> Option<usize> {
        let start = directory as usize;
        let count = usize::from(self.short(start)?);
        (0..count).map(|i| start + 2 + 12 * i).find(|&at| self.short(at) == Some(tag))
    }

    /// Offset and length of the bytes of the entry `tag` if it has type UNDEFINED and more than four bytes.
    pub(crate) fn bytes(&self, directory: u32, tag: u16) -> Option<(usize, usize)> {
        let entry = self.entry(directory, tag)?;
        let length = self.long(entry + 4)? as usize;
        (self.short(entry + 2) == Some(7) && length > 4).then_some((self.long(entry + 8)? as usize, length))
    }

    /// First number of the entry `tag` in the directory at `directory`. The standard requires SHORT for both facts, but writers use other
    /// types too. Text gives `None`.
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

    /// A little-endian directory of `entries` equal entries, each with this `tag`, `kind` and one `value`.
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
    fn cyclic_and_truncated_directories_are_harmless() {
        let of = |t: &[u8]| Facts::read(Some(t)).orientation;
        assert_eq!(of(&directory(1, ORIENTATION, 3, 6)), 6);
        // each entry points to its own directory: a reader that followed them all would never end
        assert_eq!(of(&directory(u16::MAX, EXIF, 4, 8)), 1);
        let whole = directory(3, ORIENTATION, 3, 6);
        for end in 0..20 {
            assert_eq!(of(&whole[..end]), 1, "cut to {end}");
        }
        // a directory at the largest possible offset
        assert_eq!(of(b"II*\0\xff\xff\xff\xff"), 1);
    }

    #[test]
    fn both_byte_orders_are_read_and_text_is_ignored() {
        let big = [b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x08\0\0".as_slice()].concat();
        assert_eq!(Facts::read(Some(&big)).orientation, 8);
        assert_eq!(Facts::read(Some(&directory(1, ORIENTATION, 2, 6))).orientation, 1);
        assert_eq!(Facts::read(Some(&directory(1, ORIENTATION, 3, 9))).orientation, 1);
    }
}
