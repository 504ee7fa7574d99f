//! A photo's own token: whoever has it may see and change that one photo, until its owner takes it back. What its owner gives away with it is
//! this photo, and nothing else that is theirs. It is a link to edit that has no end.

use tmpi_library::{Grant, Link, Millis, Photo, Subject};

use super::{Caller, Guard};

/// What a token begins with.
const PREFIX: &str = "tmpi_m_";
/// Hexadecimal digits after that.
const DIGITS: usize = 64;

/// True for a text that may be a photo's token.
#[must_use]
pub fn is_token(text: &str) -> bool {
    let digit = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
    text.strip_prefix(PREFIX).is_some_and(|rest| rest.len() == DIGITS && rest.bytes().all(digit))
}

/// The link that a token is; none where it is none.
fn link_of(token: &str) -> Option<Link> {
    format!("{}.{}", u64::MAX, token.strip_prefix(PREFIX)?).parse().ok()
}

impl Guard {
    /// The photo's page with its token behind the `#`, by which somebody else may see and change it.
    #[must_use]
    pub fn manage_link(&self, photo: &Photo) -> String {
        let link = self.library.secret().sign(Grant::Edit, Subject::Photo(photo), u64::MAX);
        format!("/view/{}#manage={PREFIX}{}", photo.id, link.signature())
    }

    /// Whether a caller came with a photo's token.
    pub(super) fn is_managed(&self, caller: &Caller, photo: &Photo, at: Millis) -> bool {
        let link = caller.token.as_deref().and_then(link_of);
        link.is_some_and(|link| self.library.secret().allows(Grant::Edit, Subject::Photo(photo), &link, at))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_told_from_secrets_and_keys() {
        let fine = format!("{PREFIX}{}", "0f".repeat(32));
        assert!(is_token(&fine) && link_of(&fine).is_some() && !super::super::who::is_secret(&fine));
        for wrong in
            [&fine[1..], &fine[..fine.len() - 1], &format!("{fine}0"), &fine.replace('f', "F"), &fine.replace('f', "g"), PREFIX, ""]
        {
            assert!(!is_token(wrong), "{wrong}");
        }
    }
}
