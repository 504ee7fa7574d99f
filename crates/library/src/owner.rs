//! Owners of photos, known by hashes.

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::digest::hex;

/// The owner of a photo: a one-way hash of a secret or a name, as 64 hex digits.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Owner(String);

impl Owner {
    fn of(kind: &str, text: &str) -> Self {
        Self(hex(&Sha256::digest(format!("tmpi owner 1\0{kind}\0{text}"))))
    }

    /// The holder of this secret.
    pub fn of_secret(secret: &str) -> Self {
        Self::of("secret", secret)
    }

    /// The holders of keys with this name. Keys of one name share an owner, so that one can replace another.
    pub fn of_keys(name: &str) -> Self {
        Self::of("keys", name)
    }

    /// The user with this name, whom a trusted proxy has logged in.
    pub fn of_login(name: &str) -> Self {
        Self::of("login", name)
    }

    /// The user of this machine, who has no quotas.
    pub fn local_user() -> Self {
        Self::of("local", "")
    }

    /// As text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    pub(crate) const fn from_column(text: String) -> Self {
        Self(text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn owners_of_different_kinds_differ() {
        assert_ne!(Owner::of_secret("a"), Owner::of_keys("a"));
        assert_ne!(Owner::of_login("a"), Owner::of_keys("a"));
        assert_ne!(Owner::of_secret(""), Owner::local_user());
    }
}
