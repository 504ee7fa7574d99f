//! Ids of photos, and random bytes for other ids and for secrets.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::LibraryError;
use crate::digest::{Digest, hex, unhex};

/// Id of a photo: 128 bits as 32 lower-case hex digits.
///
/// Two uploads of one photo with the same options by the same owner have the same id and share all work, until the program or the network
/// changes.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PhotoId([u8; 16]);

impl PhotoId {
    /// From its bytes.
    pub const fn from_bytes(bytes: [u8; 16]) -> Self {
        Self(bytes)
    }

    /// The id of a content: the digests of photo and depth map, the options in their canonical text, and the identity of the pipeline.
    /// See [`Secret::photo_id`](crate::Secret::photo_id) for an id that others cannot derive from the content.
    pub fn of_content(photo: &Digest, depth: Option<&Digest>, options: &str, pipeline: &str) -> Self {
        let mut hash = Sha256::new();
        for part in ["tmpi photo 3", photo.as_str(), depth.map_or("", Digest::as_str), options, pipeline] {
            hash.update((part.len() as u64).to_le_bytes());
            hash.update(part.as_bytes());
        }
        let mut id = [0; 16];
        for (to, from) in id.iter_mut().zip(hash.finalize()) {
            *to = from;
        }
        Self(id)
    }
}

impl FromStr for PhotoId {
    type Err = LibraryError;

    fn from_str(text: &str) -> crate::Result<Self> {
        unhex(text).map(Self).ok_or_else(|| LibraryError::Invalid("a photo id has 32 lower-case hex digits".into()))
    }
}

impl fmt::Display for PhotoId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&hex(&self.0))
    }
}

impl fmt::Debug for PhotoId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl Serialize for PhotoId {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for PhotoId {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

/// `N` cryptographically random bytes.
pub(crate) fn random<const N: usize>() -> crate::Result<[u8; N]> {
    let mut bytes = [0; N];
    getrandom::fill(&mut bytes).map_err(|e| LibraryError::Internal(format!("no random bytes: {e}")))?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn every_part_of_the_content_changes_the_id() {
        let (a, b) = (Digest::of(b"a"), Digest::of(b"b"));
        let ids = [
            PhotoId::of_content(&a, None, "", ""),
            PhotoId::of_content(&a, None, "", "another network"),
            PhotoId::of_content(&b, None, "", ""),
            PhotoId::of_content(&a, Some(&b), "", ""),
            PhotoId::of_content(&a, None, "quality=80", ""),
            PhotoId::of_content(&a, None, "", "quality=80"),
        ];
        assert!(ids.iter().enumerate().all(|(i, x)| !ids[..i].contains(x)));
        assert_eq!(ids[0], PhotoId::of_content(&a, None, "", ""));
    }

    proptest! {
        #[test]
        fn an_id_survives_text(bytes in any::<[u8; 16]>()) {
            let id = PhotoId(bytes);
            prop_assert_eq!(id.to_string().parse().ok(), Some(id));
        }

        #[test]
        fn only_canonical_text_is_an_id(text in "\\PC{0,40}|[0-9a-fA-F]{32}") {
            if let Ok(id) = text.parse::<PhotoId>() { prop_assert_eq!(id.to_string(), text); }
        }
    }
}
