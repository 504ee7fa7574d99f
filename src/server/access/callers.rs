//! The caller's identity and credentials.

use axum::http::{HeaderValue, StatusCode};

use tmpi_library::{Key, Owner, Scope, hex};

use crate::server::problem::Problem;

/// Prefix of an owner's secret.
const OWNER: &str = "tmpi_o_";
/// Length of an owner's secret after the prefix: at least 128 bits if chosen at random.
const CHARACTERS: std::ops::RangeInclusive<usize> = 32..=128;

/// A fresh secret of an owner.
pub fn new_secret() -> Result<String, Problem> {
    let mut bytes = [0; 32];
    getrandom::fill(&mut bytes).map_err(|e| Problem::internal("a new secret", &e))?;
    Ok(format!("{OWNER}{}", hex(&bytes)))
}

/// The token of an `Authorization: Bearer` header (RFC 6750); empty if it is not text, `None` for other schemes.
pub fn bearer(value: &HeaderValue) -> Option<&str> {
    let text = value.to_str().unwrap_or("bearer ");
    let (scheme, rest) = text.split_once(' ').unwrap_or((text, ""));
    scheme.eq_ignore_ascii_case("bearer").then(|| rest.trim())
}

/// The owner of a secret; `None` if the text has not the form of one.
pub fn owner_of_secret(text: &str) -> Option<Owner> {
    let rest = text.strip_prefix(OWNER)?;
    let fits = CHARACTERS.contains(&rest.len()) && rest.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_".contains(&b));
    fits.then(|| Owner::of_secret(text))
}

pub enum Caller {
    /// This machine's own user.
    LocalUser,
    /// Holder of an API key.
    Key(Key),
    /// Holder of an owner's secret or session, with the value of the browser's cookie.
    Owner(Owner, String),
    /// A user whom a trusted proxy has logged in.
    User(Owner),
    /// Holder of a ticket, which can only be exchanged for a session of this owner.
    Ticket(Owner),
    /// Sends only a photo's own token.
    Manager,
    /// Sends no credentials.
    Anonymous,
}

impl Caller {
    pub fn is_admin(&self) -> bool {
        self.has_scope(Scope::Admin)
    }

    /// Whether the caller is the local user or has a key with this scope: what being an owner does not include.
    pub fn has_scope(&self, scope: Scope) -> bool {
        matches!(self, Self::LocalUser) || matches!(self, Self::Key(key) if key.may(scope))
    }

    pub fn owner(&self) -> Option<Owner> {
        match self {
            Self::LocalUser => Some(Owner::local_user()),
            Self::Key(key) => Some(key.owner.clone()),
            Self::Owner(owner, _) | Self::User(owner) => Some(owner.clone()),
            Self::Ticket(_) | Self::Manager | Self::Anonymous => None,
        }
    }

    /// Whether the caller may do this with its own photos. Only keys can lack the right.
    pub fn may(&self, scope: Scope) -> bool {
        !matches!(self, Self::Key(key) if !key.may(scope))
    }

    /// Checks the right to a route that is not about one photo.
    pub fn require_scope(&self, scope: Scope) -> Result<(), Problem> {
        let detail = match self {
            // a photo's token names no owner for an upload
            Self::Manager => "a photo's own token is valid for that photo only".to_owned(),
            who if !who.may(scope) => format!("the key does not have the scope {}", scope.name()),
            _ => return Ok(()),
        };
        Err(Problem::new(StatusCode::FORBIDDEN, "scope", detail))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn secrets_are_long_and_plain() {
        let is_secret = |text: &str| owner_of_secret(text) == Some(Owner::of_secret(text));
        assert!(is_secret(&new_secret().unwrap()) && is_secret(&format!("{OWNER}{}", "aZ0-_678".repeat(4))));
        for wrong in [OWNER.to_owned(), format!("{OWNER}short"), "a".repeat(40), format!("{OWNER}{}", "ä;= ".repeat(10))] {
            assert_eq!(owner_of_secret(&wrong), None, "{wrong}");
        }
    }
}
