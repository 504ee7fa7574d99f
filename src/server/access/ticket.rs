//! How another browser of an owner's comes to be that owner: by a ticket that soon ends, for which it is given a cookie of its own. The secret
//! stays where it is. Both name the owner, signed by the server.

use super::secret::Secret;
use super::{Guard, Owner, same};

/// What a ticket begins with.
const TICKET: &str = "tmpi_t_";
/// What the cookie of a browser that came by one begins with.
const BROWSER: &str = "tmpi_b_";
/// Hexadecimal digits of an owner, and of a signature.
const DIGITS: usize = 64;
/// Seconds that a ticket is good for.
pub const SECONDS: u64 = 900;

impl Guard {
    /// A ticket of an owner that is good until `expires`, in seconds since 1970.
    #[must_use]
    pub fn ticket(&self, owner: &Owner, expires: u64) -> String {
        ticket(&self.secret, owner, expires)
    }

    /// Whose a ticket is; none where it is none, or its time is over.
    pub(super) fn of_ticket(&self, text: &str, now: u64) -> Option<Owner> {
        let (expires, rest) = text.strip_prefix(TICKET)?.split_once('_')?;
        let (owner, expires) = (Owner(rest.get(..DIGITS)?.to_owned()), expires.parse().ok()?);
        (now < expires && same(ticket(&self.secret, &owner, expires).as_bytes(), text.as_bytes())).then_some(owner)
    }

    /// What a browser keeps that came by a ticket.
    #[must_use]
    pub fn of_browser(&self, owner: &Owner) -> String {
        browser(&self.secret, owner)
    }

    /// Whose what a browser keeps is that came by a ticket.
    pub(super) fn is_browser(&self, text: &str) -> bool {
        named(text).is_some_and(|owner| same(browser(&self.secret, &owner).as_bytes(), text.as_bytes()))
    }
}

/// The owner that a browser's cookie names, whether or not it is signed.
pub(super) fn named(text: &str) -> Option<Owner> {
    Some(Owner(text.strip_prefix(BROWSER)?.get(..DIGITS)?.to_owned()))
}

fn ticket(secret: &Secret, owner: &Owner, expires: u64) -> String {
    format!("{TICKET}{expires}_{}{}", owner.0, secret.owner("tmpi ticket 1", owner, expires))
}

fn browser(secret: &Secret, owner: &Owner) -> String {
    format!("{BROWSER}{}{}", owner.0, secret.owner("tmpi browser 1", owner, 0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::access::keys::Keys;

    #[test]
    fn tickets_end_and_are_of_their_owner_and_server_alone() {
        let dir = tempfile::tempdir().unwrap();
        let guard = || Guard { secret: Secret::fresh().unwrap(), keys: Keys::open(dir.path()).unwrap() };
        let (one, other) = (guard(), guard());
        let (ann, bob) = (Owner::of_secret("a"), Owner::of_secret("b"));
        let ticket = one.ticket(&ann, 1000);
        assert_eq!(one.of_ticket(&ticket, 999), Some(ann.clone()));
        assert_eq!((one.of_ticket(&ticket, 1000), other.of_ticket(&ticket, 999)), (None, None));
        let kept = one.of_browser(&ann);
        assert!(one.is_browser(&kept) && named(&kept) == Some(ann.clone()) && !other.is_browser(&kept));
        // none is the other, or another owner's, or good for longer
        for wrong in
            [ticket.replace("_1000_", "_1001_"), ticket.replace(&ann.0, &bob.0), ticket[..ticket.len() - 1].to_owned(), kept.clone()]
        {
            assert_eq!(one.of_ticket(&wrong, 999), None, "{wrong}");
        }
        for wrong in [
            kept.replace(&ann.0, &bob.0),
            kept[..kept.len() - 1].to_owned(),
            ticket,
            BROWSER.to_owned(),
            format!("{BROWSER}{}", "ü".repeat(64)),
        ] {
            assert!(!one.is_browser(&wrong), "{wrong}");
        }
    }
}
