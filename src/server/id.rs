//! Content id of a photo.

use std::fmt;
use std::str::FromStr;

use sha2::{Digest, Sha256};

/// Id of a photo: the first 128 bits of a SHA-256 over photo, depth map, options and the identity of what makes it, as 32 lower-case hex digits.
///
/// Two uploads of one photo with the same options have the same id and share all work, until a better program or network makes it.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PhotoId([u8; 16]);

impl PhotoId {
    /// From its bytes.
    #[must_use]
    pub const fn from_bytes(bytes: [u8; 16]) -> Self {
        Self(bytes)
    }

    /// From the SHA-256 of the photo's bytes, of the depth map's bytes, the options in their canonical text, and the identity of the
    /// pipeline.
    #[must_use]
    pub fn of(photo: &[u8; 32], depth: Option<&[u8; 32]>, options: &str, pipeline: &str) -> Self {
        let mut hash = Sha256::new();
        hash.update(b"tmpi photo 2\0");
        hash.update(photo);
        hash.update([u8::from(depth.is_some())]);
        hash.update(depth.unwrap_or(&[0; 32]));
        hash.update(options.as_bytes());
        hash.update([0]);
        hash.update(pipeline.as_bytes());
        let mut id = [0; 16];
        for (to, from) in id.iter_mut().zip(hash.finalize()) {
            *to = from;
        }
        Self(id)
    }
}

/// Text that is no photo id.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error("a photo id has 32 lower-case hex digits")]
pub struct IdError;

impl FromStr for PhotoId {
    type Err = IdError;

    fn from_str(s: &str) -> Result<Self, IdError> {
        let digits = s.as_bytes();
        if digits.len() != 32 {
            return Err(IdError);
        }
        let nibble = |c: u8| match c {
            b'0'..=b'9' => Ok(c - b'0'),
            b'a'..=b'f' => Ok(c - b'a' + 10),
            _ => Err(IdError),
        };
        let mut id = [0; 16];
        for (to, pair) in id.iter_mut().zip(digits.chunks_exact(2)) {
            *to = nibble(pair[0])? << 4 | nibble(pair[1])?;
        }
        Ok(Self(id))
    }
}

impl fmt::Display for PhotoId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|b| write!(f, "{b:02x}"))
    }
}

impl fmt::Debug for PhotoId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// Lower-case hex of `bytes`.
#[must_use]
pub fn hex(bytes: &[u8]) -> String {
    let digit = |v: u8| char::from(if v < 10 { b'0' + v } else { b'a' + v - 10 });
    bytes.iter().flat_map(|b| [digit(b >> 4), digit(b & 15)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn every_part_counts() {
        let (a, b) = ([1; 32], [2; 32]);
        let ids = [
            PhotoId::of(&a, None, "", ""),
            PhotoId::of(&a, None, "", "another network"),
            PhotoId::of(&b, None, "", ""),
            PhotoId::of(&a, Some(&[0; 32]), "", ""),
            PhotoId::of(&a, Some(&b), "", ""),
            PhotoId::of(&a, None, "quality=80", ""),
        ];
        for (i, x) in ids.iter().enumerate() {
            assert!(ids.iter().skip(i + 1).all(|y| x != y));
        }
        assert_eq!(ids[0], PhotoId::of(&a, None, "", ""));
    }

    proptest! {
        #[test]
        fn text_and_back(bytes in any::<[u8; 16]>()) {
            let id = PhotoId(bytes);
            prop_assert_eq!(id.to_string().parse(), Ok(id));
        }

        #[test]
        fn nothing_else_is_an_id(s in "\\PC{0,40}") {
            if let Ok(id) = s.parse::<PhotoId>() { prop_assert_eq!(id.to_string(), s); }
        }
    }

    #[test]
    fn no_path_gets_through() {
        for bad in ["", "..", "../../../../../../../../etc/passwd", "0123456789ABCDEF0123456789ABCDEF", "0123456789abcdef0123456789abcde/"]
        {
            assert_eq!(bad.parse::<PhotoId>(), Err(IdError), "{bad}");
        }
    }
}
