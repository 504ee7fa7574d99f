//! A photo's own token. Its holder can see and change that one photo, and nothing else of its owner's, until the owner revokes it.
//! Technically it is an edit link that never expires.

use tmpi_library::Link;

const PREFIX: &str = "tmpi_m_";

/// The link that a token encodes; `None` if the text has not the form of a token.
pub fn link_of(token: &str) -> Option<Link> {
    Link::of_signature(u64::MAX, token.strip_prefix(PREFIX)?)
}

pub fn token_of(link: &Link) -> String {
    format!("{PREFIX}{}", link.signature())
}

#[cfg(test)]
mod tests {
    use super::super::callers::owner_of_secret;
    use super::*;

    #[test]
    fn tokens_secrets_and_keys_are_distinguishable() {
        let fine = format!("{PREFIX}{}", "0f".repeat(32));
        assert!(link_of(&fine).map(|link| token_of(&link)).as_deref() == Some(&*fine) && owner_of_secret(&fine).is_none());
        for wrong in
            [&fine[1..], &fine[..fine.len() - 1], &format!("{fine}0"), &fine.replace('f', "F"), &fine.replace('f', "g"), PREFIX, ""]
        {
            assert_eq!(link_of(wrong), None, "{wrong}");
        }
    }
}
