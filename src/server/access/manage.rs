//! A photo's own token: whoever has it may see and change that one photo, until its owner takes it back. What its owner gives away with it is
//! this photo, and nothing else that is theirs.

use super::{Caller, Guard};
use crate::server::entry::Entry;

/// What a token begins with.
const PREFIX: &str = "tmpi_m_";
/// Hexadecimal digits after that: an HMAC-SHA-256.
const DIGITS: usize = 64;

/// True for a text that may be a photo's token.
#[must_use]
pub fn is_token(text: &str) -> bool {
    let digit = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
    text.strip_prefix(PREFIX).is_some_and(|rest| rest.len() == DIGITS && rest.bytes().all(digit))
}

/// What a photo's links and token are signed over besides what they say themselves: whose it is, when it came, and how often links were taken
/// back. A photo that was deleted and uploaded again has none of those of before.
#[must_use]
pub fn seal(entry: &Entry) -> String {
    let owner = entry.accepted.owner.as_ref().map_or("-", |owner| owner.text());
    format!("{} {owner} {} {}", entry.id, entry.accepted.at_ms, entry.settings().generation)
}

impl Guard {
    /// The photo's page with its token behind the `#`, by which somebody else may see and change it.
    #[must_use]
    pub fn manage_link(&self, entry: &Entry) -> String {
        format!("/view/{}#manage={}", entry.id, self.token_of(entry))
    }

    fn token_of(&self, entry: &Entry) -> String {
        format!("{PREFIX}{}", self.secret.manage(&seal(entry)))
    }

    /// Whether a caller came with a photo's token.
    pub(super) fn is_managed(&self, caller: &Caller, entry: &Entry) -> bool {
        let is_its = |token: &String| super::same(token.as_bytes(), self.token_of(entry).as_bytes());
        caller.token.as_ref().is_some_and(is_its)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_told_from_secrets_and_keys() {
        let fine = format!("{PREFIX}{}", "0f".repeat(32));
        assert!(is_token(&fine) && !super::super::who::is_secret(&fine));
        for wrong in
            [&fine[1..], &fine[..fine.len() - 1], &format!("{fine}0"), &fine.replace('f', "F"), &fine.replace('f', "g"), PREFIX, ""]
        {
            assert!(!is_token(wrong), "{wrong}");
        }
    }
}
