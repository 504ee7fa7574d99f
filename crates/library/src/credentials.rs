//! API keys, stored as hashes: a secret has 256 random bits, so one SHA-256 is enough.

use std::time::Duration;

use sqlx::any::AnyRow;
use sqlx::{FromRow, Row as _};

use crate::change_notifications::Event;
use crate::digest::{Digest, hex, unhex};
use crate::error::{LibraryError, Result};
use crate::ids::random;
use crate::link_signatures::Secret;
use crate::owner::Owner;
use crate::photo::of_names;
use crate::string_enum::string_enum;
use crate::{Library, Millis, millis};

/// Prefix of a key.
pub const KEY_PREFIX: &str = "tmpi_k_";
/// Longest name of a key.
const MAX_NAME: usize = 64;
/// Hex digits of a key's id, from its hash.
const ID_DIGITS: usize = 8;

string_enum! {
    /// What a key allows.
    pub enum Scope {
        /// Upload photos; change and delete the owner's.
        Upload = "upload",
        /// List and read the owner's photos.
        Read = "read",
        /// Sign links to the owner's photos.
        Sign = "sign",
        /// Read the server's metrics.
        Metrics = "metrics",
        /// Everything, on all photos.
        Admin = "admin",
    }
}

impl Scope {
    /// All scopes.
    pub const ALL: [Self; 5] = [Self::Upload, Self::Read, Self::Sign, Self::Metrics, Self::Admin];
}

/// A key, without its secret.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Key {
    /// Id among the keys of its name: eight hex digits.
    pub id: String,
    /// Its name.
    pub name: String,
    /// The owner, which keys of one name share.
    pub owner: Owner,
    /// Its scopes.
    pub scopes: Vec<Scope>,
    /// When it was created.
    pub created_at: Millis,
    /// When it expires; `None` for never.
    pub expires_at: Option<Millis>,
    hash: String,
}

impl Key {
    /// Whether it has a scope; `Admin` has all.
    pub fn may(&self, scope: Scope) -> bool {
        self.scopes.contains(&scope) || self.scopes.contains(&Scope::Admin)
    }

    /// The secret that signs its links: the SHA-256 of the key. Its id, which links show, reveals 32 of the 256 bits. `None` without the
    /// scope [`Scope::Sign`].
    pub fn link_secret(&self) -> Option<Secret> {
        unhex(&self.hash).filter(|_| self.may(Scope::Sign)).map(Secret)
    }
}

impl FromRow<'_, AnyRow> for Key {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        let hash: String = row.try_get("hash")?;
        Ok(Self {
            id: hash.get(..ID_DIGITS).unwrap_or_default().to_owned(),
            name: row.try_get("name")?,
            owner: Owner::from_column(row.try_get("owner")?),
            scopes: of_names(row.try_get("scopes")?)?,
            created_at: row.try_get("created_at")?,
            expires_at: row.try_get("expires_at")?,
            hash,
        })
    }
}

/// A new key.
#[derive(Clone, Debug)]
pub struct NewKey {
    /// The key.
    pub key: Key,
    /// Its secret, which is not stored.
    pub secret: String,
}

fn hash(secret: &str) -> String {
    Digest::of(secret.as_bytes()).as_str().to_owned()
}

fn is_name(name: &str) -> bool {
    !name.is_empty() && name.len() <= MAX_NAME && name.bytes().all(|b| b.is_ascii_alphanumeric() || b".-_".contains(&b))
}

impl Library {
    /// Creates a key.
    ///
    /// # Errors
    /// [`LibraryError::Invalid`] for an invalid name.
    pub async fn add_key(&self, name: &str, scopes: &[Scope], lasts: Option<Duration>) -> Result<NewKey> {
        if !is_name(name) {
            return Err(LibraryError::Invalid("a name has 1 to 64 letters, digits, dots, - and _".into()));
        }
        let secret = format!("{KEY_PREFIX}{}", hex(&random::<32>()?));
        let mut scopes = scopes.to_vec();
        scopes.sort_unstable();
        scopes.dedup();
        let owner = Owner::of_keys(name);
        let mut tx = self.database().write().await?;
        tx.lock_owner(owner.as_str()).await?;
        let insert = "INSERT INTO keys (hash, name, owner, scopes, created_at, expires_at) VALUES ($1, $2, $3, $4, $5, $6) RETURNING *";
        let names: Vec<&str> = scopes.iter().map(|scope| scope.name()).collect();
        let insert = sqlx::query_as(insert).bind(hash(&secret)).bind(name).bind(owner.as_str()).bind(names.join(","));
        let insert = insert.bind(tx.now).bind(lasts.map(|lasts| tx.now + millis(lasts)));
        let key = insert.fetch_one(tx.connection()).await?;
        tx.commit().await?;
        Ok(NewKey { key, secret })
    }

    /// The unexpired key of a secret.
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`]: the caller must refuse access.
    pub async fn find_key(&self, secret: &str) -> Result<Option<Key>> {
        self.key_of_hash(&hash(secret)).await
    }

    /// Whether a key still exists and has not expired.
    pub async fn is_valid(&self, key: &Key) -> Result<bool> {
        Ok(self.key_of_hash(&key.hash).await?.is_some())
    }

    async fn key_of_hash(&self, hash: &str) -> Result<Option<Key>> {
        let now = self.now().await?;
        let select = sqlx::query_as("SELECT * FROM keys WHERE hash = $1 AND (expires_at IS NULL OR expires_at > $2)");
        Ok(select.bind(hash).bind(now).fetch_optional(self.database().reader()).await?)
    }

    /// The unexpired keys with an id; nearly always one at most.
    pub async fn keys_of_id(&self, id: &str) -> Result<Vec<Key>> {
        let now = self.now().await?;
        let select = sqlx::query_as("SELECT * FROM keys WHERE SUBSTR(hash, 1, 8) = $1 AND (expires_at IS NULL OR expires_at > $2)");
        Ok(select.bind(id).bind(now).fetch_all(self.database().reader()).await?)
    }

    /// All keys, by name and age.
    pub async fn keys(&self) -> Result<Vec<Key>> {
        Ok(sqlx::query_as("SELECT * FROM keys ORDER BY name, created_at").fetch_all(self.database().reader()).await?)
    }

    /// Removes all keys of a name, or the one with an id; returns the number of keys.
    pub async fn remove_keys(&self, name: &str, id: Option<&str>) -> Result<u64> {
        let mut tx = self.database().write().await?;
        let delete = sqlx::query("DELETE FROM keys WHERE name = $1 AND ($2 = '' OR SUBSTR(hash, 1, 8) = $2)");
        let removed = delete.bind(name).bind(id.unwrap_or_default()).execute(tx.connection()).await?.rows_affected();
        if removed == 0 {
            return Err(LibraryError::NotFound("key"));
        }
        tx.notify(Event::Revoked);
        tx.commit().await?;
        Ok(removed)
    }
}
