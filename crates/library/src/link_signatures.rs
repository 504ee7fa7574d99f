//! Signed grants: who holds one has a right on a subject until it expires. None is stored. All have one format, a [`Link`], and are made by
//! [`Secret::sign`] and checked by [`Secret::allows`]. A photo's grants are signed over its link generation; raising it revokes them. An
//! application that has a key signs addresses itself, with the key's own [`Secret`]; [`Secret::has_signed`] checks them.

use std::fmt;
use std::str::FromStr;

use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::{Digest as _, Sha256};

use crate::Millis;
use crate::database::{Database, Lock};
use crate::digest::{hex, unhex};
use crate::error::{LibraryError, Result};
use crate::ids::{PhotoId, random};
use crate::owner::Owner;
use crate::photo::Photo;
use crate::string_enum::string_enum;

/// Bytes of the secret and of a signature.
const BYTES: usize = 32;

string_enum! {
    /// What a link allows.
    pub enum Grant {
        /// See a photo.
        View = "view",
        /// See and change a photo.
        Edit = "edit",
        /// Relay a room to the viewers of another node.
        Relay = "relay",
        /// Publish in a room, and watch it.
        Publish = "publish",
        /// Watch a room.
        Watch = "watch",
        /// Be an owner.
        Session = "session",
        /// Get a session of an owner.
        Ticket = "ticket",
    }
}

/// The target of a link.
#[derive(Clone, Copy, Debug)]
pub enum Subject<'a> {
    /// This upload of a photo, until its links are revoked.
    Photo(&'a Photo),
    /// A room of this name.
    Room(&'a str),
    /// An owner.
    Owner(&'a Owner),
}

impl Subject<'_> {
    fn seal(&self) -> String {
        match self {
            Self::Photo(photo) => {
                let owner = photo.owner.as_ref().map_or("-", Owner::as_str);
                format!("photo {} {owner} {} {}", photo.id, photo.accepted_at, photo.link_generation)
            }
            Self::Room(name) => format!("room {name}"),
            Self::Owner(owner) => format!("owner {}", owner.as_str()),
        }
    }
}

/// A link: its expiry and signature. As text, `EXPIRES-SIGNATURE`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Link {
    /// Seconds since 1970.
    pub expires: u64,
    signature: [u8; BYTES],
}

impl Link {
    /// A link with these 64 hex digits as its signature; `None` if they are not.
    pub fn of_signature(expires: u64, signature: &str) -> Option<Self> {
        Some(Self { expires, signature: unhex(signature)? })
    }

    /// The signature as 64 hex digits.
    pub fn signature(&self) -> String {
        hex(&self.signature)
    }

    /// Whether it has this signature and is valid at `now`. Compares in constant time.
    fn is_signed(&self, mac: Hmac<Sha256>, now: Millis) -> bool {
        let in_time = (now.max(0) as u64) / 1000 < self.expires;
        mac.verify_slice(&self.signature).is_ok() && in_time
    }
}

impl fmt::Display for Link {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-{}", self.expires, self.signature())
    }
}

impl FromStr for Link {
    type Err = LibraryError;

    fn from_str(text: &str) -> Result<Self> {
        let parts = text.split_once('-').and_then(|(expires, signature)| Self::of_signature(expires.parse().ok()?, signature));
        parts.ok_or_else(|| LibraryError::Invalid("the link is malformed".into()))
    }
}

/// The secret of ids and links: its holder can forge them.
#[derive(Clone)]
pub struct Secret(pub(crate) [u8; BYTES]);

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret")
    }
}

impl Secret {
    /// A secret from the bytes of a key.
    pub fn of_key(key: &[u8]) -> Self {
        Self(Sha256::digest(key).into())
    }

    /// An HMAC-SHA-256 over nothing yet.
    fn hmac(&self) -> Hmac<Sha256> {
        // RFC 2104 pads a key to a block with zeros
        let mut block = [0; 64];
        block[..BYTES].copy_from_slice(&self.0);
        Hmac::<Sha256>::new(&block.into())
    }

    /// An HMAC-SHA-256 over `purpose` and `parts`, each preceded by its length.
    fn mac(&self, purpose: &str, parts: &[&[u8]]) -> Hmac<Sha256> {
        let mut mac = self.hmac();
        for part in [purpose.as_bytes()].iter().chain(parts) {
            mac.update(&(part.len() as u64).to_le_bytes());
            mac.update(part);
        }
        mac
    }

    /// Id of an owner's photo with this content. Others cannot derive it from the content. Without an owner it is `content`.
    pub fn photo_id(&self, owner: Option<&Owner>, content: PhotoId) -> PhotoId {
        let Some(owner) = owner else { return content };
        let mac = self.mac("tmpi id 2", &[owner.as_str().as_bytes(), content.to_string().as_bytes()]).finalize().into_bytes();
        let mut id = [0; 16];
        id.copy_from_slice(&mac[..16]);
        PhotoId::from_bytes(id)
    }

    fn of_link(&self, grant: Grant, subject: Subject<'_>, expires: u64) -> Hmac<Sha256> {
        self.mac("tmpi link 3", &[grant.name().as_bytes(), subject.seal().as_bytes(), &expires.to_le_bytes()])
    }

    /// A link that is valid until `expires`, in seconds since 1970; for ever with [`u64::MAX`].
    pub fn sign(&self, grant: Grant, subject: Subject<'_>, expires: u64) -> Link {
        Link { expires, signature: self.of_link(grant, subject, expires).finalize().into_bytes().into() }
    }

    /// Whether a link grants access at `now`.
    pub fn allows(&self, grant: Grant, subject: Subject<'_>, link: &Link, now: Millis) -> bool {
        link.is_signed(self.of_link(grant, subject, link.expires), now)
    }

    /// Whether a link signs exactly `text`, which holds the link's expiry, and is valid at `now`.
    pub fn has_signed(&self, text: &str, link: &Link, now: Millis) -> bool {
        link.is_signed(self.hmac().chain_update(text), now)
    }

    /// A grant that names its owner: `OWNER-EXPIRES-SIGNATURE`.
    pub fn sign_for(&self, grant: Grant, owner: &Owner, expires: u64) -> String {
        format!("{}-{}", owner.as_str(), self.sign(grant, Subject::Owner(owner), expires))
    }

    /// The owner whom such a grant names; `None` unless it is valid at `now`.
    pub fn owner_of(&self, grant: Grant, text: &str, now: Millis) -> Option<Owner> {
        let (owner, link) = text.split_once('-')?;
        let owner = Owner::from_column(owner.to_owned());
        self.allows(grant, Subject::Owner(&owner), &link.parse().ok()?, now).then_some(owner)
    }
}

/// The secret that all nodes of a database share; created if missing.
pub(crate) async fn secret(database: &Database) -> Result<Secret> {
    let text = stored_secret(database, "links").await?;
    unhex(&text).map(Secret).ok_or_else(|| LibraryError::Internal("the secret of links is malformed".into()))
}

/// Random hex digits that all nodes of a database share under this name; created if missing.
pub(crate) async fn stored_secret(database: &Database, name: &'static str) -> Result<String> {
    let mut tx = database.write().await?;
    tx.lock(Lock::Secret).await?;
    let insert = sqlx::query("INSERT INTO secrets (name, value) VALUES ($1, $2) ON CONFLICT (name) DO NOTHING");
    insert.bind(name).bind(hex(&random::<BYTES>()?)).execute(tx.connection()).await?;
    let value = sqlx::query_scalar("SELECT value FROM secrets WHERE name = $1").bind(name).fetch_one(tx.connection()).await?;
    tx.commit().await?;
    Ok(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_is_valid_for_its_grant_subject_and_time_only() {
        let secret = Secret([7; BYTES]);
        let attic = Subject::Room("attic");
        let link = secret.sign(Grant::Relay, attic, 1000);
        assert!(secret.allows(Grant::Relay, attic, &link, 999_999));
        assert!(!secret.allows(Grant::Relay, attic, &link, 1_000_000), "too late");
        assert!(!secret.allows(Grant::View, attic, &link, 0), "another grant");
        assert!(!secret.allows(Grant::Relay, Subject::Room("cellar"), &link, 0), "another room");
        assert!(!secret.allows(Grant::Relay, attic, &Link { expires: 1001, ..link.clone() }, 0), "a later end");
        assert!(!Secret([8; BYTES]).allows(Grant::Relay, attic, &link, 0), "another library");
        assert_eq!(link.to_string().parse::<Link>().unwrap(), link);
        for wrong in ["", "-", "1000", "1000-", "x-00", &format!("{link}0"), &link.to_string()[..link.to_string().len() - 1]] {
            assert!(wrong.parse::<Link>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_text_is_signed_as_others_sign_it() {
        // RFC 4231, test case 2, with the key padded as for any HMAC
        let mut key = [0; BYTES];
        key[..4].copy_from_slice(b"Jefe");
        let (secret, text) = (Secret(key), "what do ya want for nothing?");
        let link = Link::of_signature(1000, "5bdcc146bf60754e6a042426089575c75a003f089d2739839dec58b964ec3843").unwrap();
        assert!(secret.has_signed(text, &link, 999_999));
        assert!(!secret.has_signed(text, &link, 1_000_000), "too late");
        assert!(!secret.has_signed(&text[1..], &link, 0), "another text");
        assert!(!Secret([7; BYTES]).has_signed(text, &link, 0), "another secret");
    }

    #[test]
    fn a_grant_names_its_owner_until_it_expires() {
        let (secret, ann) = (Secret([7; BYTES]), Owner::of_secret("ann"));
        let ticket = secret.sign_for(Grant::Ticket, &ann, 1000);
        assert_eq!(secret.owner_of(Grant::Ticket, &ticket, 999_999), Some(ann.clone()));
        assert_eq!(secret.owner_of(Grant::Ticket, &ticket, 1_000_000), None, "too late");
        assert_eq!(secret.owner_of(Grant::Session, &ticket, 0), None, "a ticket is no session");
        let of_bob = ticket.replace(ann.as_str(), Owner::of_secret("bob").as_str());
        for wrong in ["", "-", ann.as_str(), &of_bob, &format!("{ticket}0"), &ticket[..ticket.len() - 1], &ticket.to_uppercase()] {
            assert_eq!(secret.owner_of(Grant::Ticket, wrong, 0), None, "{wrong}");
        }
    }

    #[test]
    fn ids_differ_by_owner_and_library() {
        let content = PhotoId::from_bytes([1; 16]);
        let (one, other) = (Secret([7; BYTES]), Secret([8; BYTES]));
        let (a, b) = (Owner::of_secret("a"), Owner::of_secret("b"));
        let ids = [one.photo_id(Some(&a), content), one.photo_id(Some(&b), content), other.photo_id(Some(&a), content), content];
        assert!(ids.iter().enumerate().all(|(i, x)| !ids[..i].contains(x)), "{ids:?}");
        assert_eq!(one.photo_id(None, content), content);
    }
}
