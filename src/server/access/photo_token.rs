//! A photo's own token. Its holder can see and change that one photo, and nothing else of its owner's, until the owner revokes it.
//! Technically it is an edit link that never expires.

use tmpi_library::{Grant, Link, Millis, Photo, Subject};

use super::{Caller, Guard};

/// Prefix of a token.
const PREFIX: &str = "tmpi_m_";
/// Hexadecimal digits after the prefix.
const DIGITS: usize = 64;

/// Whether a text has the form of a photo's token.
#[must_use]
pub fn is_token(text: &str) -> bool {
    let digit = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
    text.strip_prefix(PREFIX).is_some_and(|rest| rest.len() == DIGITS && rest.bytes().all(digit))
}

/// The link that a token encodes.
fn link_of(token: &str) -> Option<Link> {
    format!("{}.{}", u64::MAX, token.strip_prefix(PREFIX)?).parse().ok()
}

impl Guard {
    /// The photo's page with its token after the `#`; anyone with this link can see and change the photo.
    #[must_use]
    pub fn manage_link(&self, photo: &Photo) -> String {
        let link = self.library.secret().sign(Grant::Edit, Subject::Photo(photo), u64::MAX);
        format!("/view/{}#manage={PREFIX}{}", photo.id, link.signature())
    }

    /// Whether the caller sent a valid token of this photo.
    pub(super) fn is_managed(&self, caller: &Caller, photo: &Photo, at: Millis) -> bool {
        let link = caller.token.as_deref().and_then(link_of);
        link.is_some_and(|link| self.library.secret().allows(Grant::Edit, Subject::Photo(photo), &link, at))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_secrets_and_keys_are_distinguishable() {
        let fine = format!("{PREFIX}{}", "0f".repeat(32));
        assert!(is_token(&fine) && link_of(&fine).is_some() && !super::super::callers::is_secret(&fine));
        for wrong in
            [&fine[1..], &fine[..fine.len() - 1], &format!("{fine}0"), &fine.replace('f', "F"), &fine.replace('f', "g"), PREFIX, ""]
        {
            assert!(!is_token(wrong), "{wrong}");
        }
    }
}
