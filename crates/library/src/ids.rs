//! Names of photos, owners and contents, which are all digests.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::LibraryError;

/// Milliseconds since 1970 by the database's clock. Never compare it with a node's clock.
pub type Millis = i64;

/// SHA-256 of a content, as 64 lower-case hex digits.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Digest(String);

impl Digest {
    /// The digest of `bytes`.
    #[must_use]
    pub fn of(bytes: &[u8]) -> Self {
        Self(hex(&Sha256::digest(bytes)))
    }

    /// From the 32 bytes of a SHA-256.
    #[must_use]
    pub fn from_bytes(bytes: &[u8; 32]) -> Self {
        Self(hex(bytes))
    }

    /// 64 hex digits.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// Id of a photo: 128 bits as 32 lower-case hex digits.
///
/// Two uploads of one photo with the same options by the same owner have the same id and share all work, until the program or the network
/// changes.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PhotoId([u8; 16]);

impl PhotoId {
    /// From its bytes.
    #[must_use]
    pub const fn from_bytes(bytes: [u8; 16]) -> Self {
        Self(bytes)
    }

    /// The id of a content: the digests of photo and depth map, the options in their canonical text, and the identity of the pipeline.
    /// See [`Secret::photo_id`](crate::Secret::photo_id) for an id that others cannot derive from the content.
    #[must_use]
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
        let id = if text.bytes().any(|b| b.is_ascii_uppercase()) { None } else { unhex(text).map(Self) };
        id.ok_or_else(|| LibraryError::Invalid("a photo id has 32 lower-case hex digits".into()))
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

/// The owner of a photo: a one-way hash of a secret or a name, as 64 hex digits.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Owner(String);

impl Owner {
    fn of(kind: &str, text: &str) -> Self {
        Self(hex(&Sha256::digest(format!("tmpi owner 1\0{kind}\0{text}"))))
    }

    /// The holder of this secret.
    #[must_use]
    pub fn of_secret(secret: &str) -> Self {
        Self::of("secret", secret)
    }

    /// The holders of keys with this name. Keys of one name share an owner, so that one can replace another.
    #[must_use]
    pub fn of_keys(name: &str) -> Self {
        Self::of("keys", name)
    }

    /// The user of this machine, who has no quotas.
    #[must_use]
    pub fn local_user() -> Self {
        Self::of("local", "")
    }

    /// As text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }

    pub(crate) const fn from_column(text: String) -> Self {
        Self(text)
    }
}

/// Lower-case hex of `bytes`.
#[must_use]
pub fn hex(bytes: &[u8]) -> String {
    let digit = |v: u8| char::from(if v < 10 { b'0' + v } else { b'a' + v - 10 });
    bytes.iter().flat_map(|b| [digit(b >> 4), digit(b & 15)]).collect()
}

/// Decodes exactly `N` bytes from hex digits.
pub(crate) fn unhex<const N: usize>(text: &str) -> Option<[u8; N]> {
    let digits: Vec<u8> = text.chars().map(|c| c.to_digit(16).map(|d| d as u8)).collect::<Option<_>>()?;
    let mut bytes = [0; N];
    if digits.len() != 2 * N {
        return None;
    }
    for (byte, pair) in bytes.iter_mut().zip(digits.chunks_exact(2)) {
        *byte = pair[0] << 4 | pair[1];
    }
    Some(bytes)
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

    #[test]
    fn owners_of_different_kinds_differ() {
        assert_ne!(Owner::of_secret("a"), Owner::of_keys("a"));
        assert_ne!(Owner::of_secret(""), Owner::local_user());
    }
}
