//! Who asks, and what they came with.

use axum::http::HeaderValue;

use tmpi_library::{Key, Owner, Scope, hex};

use super::manage;
use crate::server::problem::Problem;

/// What an owner's secret begins with.
const OWNER: &str = "tmpi_o_";
/// Characters of an owner's secret after that: 128 bits at least where they are chosen at random.
const CHARACTERS: std::ops::RangeInclusive<usize> = 32..=128;

/// A fresh secret of an owner.
///
/// # Errors
/// 500 where the system has no random bytes.
pub fn fresh() -> Result<String, Problem> {
    let mut bytes = [0; 32];
    getrandom::fill(&mut bytes).map_err(|e| Problem::internal("a fresh secret", &e))?;
    Ok(format!("{OWNER}{}", hex(&bytes)))
}

/// What a bearer brings (RFC 6750); none for other schemes, and nothing where it cannot be read.
pub fn bearer(value: &HeaderValue) -> Option<&str> {
    let text = value.to_str().unwrap_or("bearer ");
    let (scheme, rest) = text.split_once(' ').unwrap_or((text, ""));
    scheme.eq_ignore_ascii_case("bearer").then(|| rest.trim())
}

/// True for a text that may be an owner's secret.
pub fn is_secret(text: &str) -> bool {
    let fits = |rest: &str| CHARACTERS.contains(&rest.len()) && rest.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_".contains(&b));
    text.strip_prefix(OWNER).is_some_and(fits)
}

/// Who asks.
#[derive(Clone)]
pub enum Who {
    /// This machine's own user.
    Own,
    /// Whoever has a key.
    Key(Key),
    /// Whoever has a secret of their own, or a session by a ticket; with what the browser keeps for it.
    Owner(Owner, String),
    /// Whoever has a ticket, by which another browser becomes this owner, and which is good for nothing else.
    Ticket(Owner),
    /// Whoever sends one photo's own token, and is nobody else.
    Manager,
    /// Anybody else.
    Stranger,
}

impl Who {
    /// By a secret or a photo's token that was sent; none where it is neither.
    pub fn of_bearer(text: &str) -> Option<Self> {
        if manage::is_token(text) {
            return Some(Self::Manager);
        }
        is_secret(text).then(|| Self::Owner(Owner::of_secret(text), text.to_owned()))
    }

    pub fn is_admin(&self) -> bool {
        self.is_told(Scope::Admin)
    }

    /// Whether it was said to them that they may what is nobody's by itself.
    pub fn is_told(&self, scope: Scope) -> bool {
        matches!(self, Self::Own) || matches!(self, Self::Key(key) if key.may(scope))
    }

    pub fn owner(&self) -> Option<Owner> {
        match self {
            Self::Own => Some(Owner::local_user()),
            Self::Key(key) => Some(key.owner.clone()),
            Self::Owner(owner, _) => Some(owner.clone()),
            Self::Ticket(_) | Self::Manager | Self::Stranger => None,
        }
    }

    /// Only keys are for less than everything with one's own.
    pub fn may(&self, scope: Scope) -> bool {
        self.is_admin() || !matches!(self, Self::Key(key) if !key.may(scope))
    }

    /// Refuses what is of no one photo where they may not have it.
    ///
    /// # Errors
    /// 403.
    pub fn has_leave(&self, scope: Scope, name: &str) -> Result<(), Problem> {
        let refuse = |detail| Err(Problem::new(axum::http::StatusCode::FORBIDDEN, "scope", detail));
        match self {
            // a photo's token makes nobody an owner: what it uploaded would be nobody's
            Self::Manager => refuse("a photo's own token is for that photo alone".to_owned()),
            who if !who.may(scope) => refuse(format!("the key has not the scope {name}")),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn secrets_are_long_and_plain() {
        assert!(is_secret(&fresh().unwrap()) && is_secret(&format!("{OWNER}{}", "aZ0-_678".repeat(4))));
        for wrong in [OWNER.to_owned(), format!("{OWNER}short"), "a".repeat(40), format!("{OWNER}{}", "ä;= ".repeat(10))] {
            assert!(!is_secret(&wrong), "{wrong}");
        }
        assert_ne!(Owner::of_secret("a"), Owner::of_keys("a"));
    }
}
