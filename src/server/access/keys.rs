//! API keys: a file of their hashes in the data directory, which `tmpi key` writes and a running server reads again when it changes.
//!
//! A key is 256 random bits, so one SHA-256 of it is enough: there is nothing to guess that a slower hash would protect.

use std::fs::Metadata;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::Owner;
use super::secret::{random, replace, same};
use crate::server::files;
use crate::server::id::hex;
use crate::server::time::{now_ms, rfc3339};

/// File of the hashes within the data directory.
const FILE: &str = "keys.json";
/// Held by whoever changes it.
const LOCK: &str = "keys.lock";
/// What a key begins with.
pub const PREFIX: &str = "tmpi_k_";
/// Version of the file.
const VERSION: u32 = 1;
/// Longest name.
const MOST_NAME: usize = 64;

/// What a key is good for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Scope {
    /// Upload photos, change and delete one's own
    Upload,
    /// List and read one's own photos
    Read,
    /// Read the server's metrics
    Metrics,
    /// Everything, with everybody's photos
    Admin,
}

/// A key, without itself.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Key {
    /// Whose it is: keys of one name have the same photos, so that one can replace another.
    pub name: String,
    /// What it is good for.
    pub scopes: Vec<Scope>,
    /// SHA-256 of the key, 64 hex digits.
    hash: String,
    /// When it was made, milliseconds since 1970.
    pub created_ms: u64,
    /// When it ends, milliseconds since 1970; never where there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expires_ms: Option<u64>,
}

impl Key {
    /// By what it is told from others of its name: eight hex digits.
    #[must_use]
    pub fn id(&self) -> &str {
        self.hash.get(..8).unwrap_or_default()
    }

    /// What there is to know of it, as a line of a list.
    #[must_use]
    pub fn line(&self) -> String {
        let scopes: Vec<String> = self.scopes.iter().map(|scope| format!("{scope:?}").to_lowercase()).collect();
        let end = self.expires_ms.map_or_else(String::new, |ms| format!(", until {}", rfc3339(ms)));
        format!("{} {} {}, since {}{end}", self.id(), self.name, scopes.join(","), rfc3339(self.created_ms))
    }

    /// Whose photos it is for.
    #[must_use]
    pub fn owner(&self) -> Owner {
        Owner::of_keys(&self.name)
    }

    /// Whether it has a scope.
    #[must_use]
    pub fn may(&self, scope: Scope) -> bool {
        self.scopes.contains(&scope)
    }
}

#[derive(Serialize, Deserialize)]
struct File {
    version: u32,
    keys: Vec<Key>,
}

/// Why keys cannot be read or changed.
#[derive(Debug, thiserror::Error)]
pub enum KeysError {
    /// The file is not there, or cannot be read or written.
    #[error("keys.json")]
    Disk(#[from] io::Error),
    /// It is not what was written.
    #[error("keys.json is damaged: {0}; put it right, or remove it with all keys")]
    Damaged(String),
    /// A name that is none.
    #[error("a name has 1 to 64 letters, digits, dots, - and _")]
    Name,
    /// There is no such key.
    #[error("there is no such key")]
    Unknown,
}

/// Reads the keys of a data directory; none where there is no file.
///
/// # Errors
/// [`KeysError`].
pub fn read(dir: &Path) -> Result<Vec<Key>, KeysError> {
    let bytes = match std::fs::read(dir.join(FILE)) {
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        read => read?,
    };
    let file: File = serde_json::from_slice(&bytes).map_err(|e| KeysError::Damaged(e.to_string()))?;
    if file.version != VERSION {
        return Err(KeysError::Damaged(format!("version {} is not {VERSION}", file.version)));
    }
    if let Some(key) = file.keys.iter().find(|k| k.hash.len() != 64 || !is_name(&k.name)) {
        return Err(KeysError::Damaged(format!("the key of {:?}", key.name)));
    }
    Ok(file.keys)
}

/// True where a server has kept photos in a directory, or where there are keys.
#[must_use]
pub fn is_of_a_server(dir: &Path) -> bool {
    // its own photos, or copies of those of a store
    [FILE, "photos", "copies"].iter().any(|name| dir.join(name).exists())
}

fn is_name(name: &str) -> bool {
    !name.is_empty() && name.len() <= MOST_NAME && name.bytes().all(|b| b.is_ascii_alphanumeric() || b".-_".contains(&b))
}

fn hash(key: &str) -> String {
    hex(&Sha256::digest(key.as_bytes()))
}

/// Changes the keys of a data directory, one process after the other.
fn change<T>(dir: &Path, work: impl FnOnce(&mut Vec<Key>) -> Result<T, KeysError>) -> Result<T, KeysError> {
    std::fs::create_dir_all(dir)?;
    let lock = files::private().create(true).truncate(false).write(true).open(dir.join(LOCK))?;
    lock.lock()?;
    let mut keys = read(dir)?;
    let done = work(&mut keys)?;
    let text = serde_json::to_vec_pretty(&File { version: VERSION, keys }).map_err(io::Error::from)?;
    replace(&dir.join(FILE), &text)?;
    Ok(done)
}

/// Adds a key for `name`, good for `days` or for ever; gives the key, which is kept nowhere.
///
/// # Errors
/// [`KeysError`].
pub fn add(dir: &Path, name: &str, scopes: &[Scope], days: Option<u32>) -> Result<String, KeysError> {
    if !is_name(name) {
        return Err(KeysError::Name);
    }
    let key = format!("{PREFIX}{}", hex(&random()?));
    let created_ms = now_ms();
    let expires_ms = days.map(|days| created_ms + u64::from(days) * 86_400_000);
    let mut scopes = scopes.to_vec();
    scopes.sort_unstable();
    scopes.dedup();
    let new = Key { name: name.to_owned(), scopes, hash: hash(&key), created_ms, expires_ms };
    change(dir, |keys| {
        keys.push(new);
        Ok(())
    })?;
    Ok(key)
}

/// Removes all keys of a name, or the one with an id; tells how many.
///
/// # Errors
/// [`KeysError`]; there may be none.
pub fn remove(dir: &Path, name: &str, id: Option<&str>) -> Result<usize, KeysError> {
    change(dir, |keys| {
        let before = keys.len();
        keys.retain(|key| key.name != name || id.is_some_and(|id| key.id() != id));
        if keys.len() == before { Err(KeysError::Unknown) } else { Ok(before - keys.len()) }
    })
}

/// By what a file is known to be the same: it is only ever replaced.
type Stamp = Option<(u64, std::time::SystemTime, u64)>;

fn stamp(of: &Metadata) -> Stamp {
    #[cfg(unix)]
    let inode = std::os::unix::fs::MetadataExt::ino(of);
    #[cfg(not(unix))]
    let inode = 0;
    of.modified().ok().map(|at| (inode, at, of.len()))
}

/// The keys as a running server sees them.
#[derive(Debug)]
pub struct Keys {
    dir: PathBuf,
    seen: Mutex<(Stamp, Vec<Key>)>,
}

impl Keys {
    /// Those of a data directory.
    ///
    /// # Errors
    /// [`KeysError`].
    pub fn open(dir: &Path) -> Result<Self, KeysError> {
        let keys = Self { dir: dir.to_owned(), seen: Mutex::default() };
        keys.find("")?;
        Ok(keys)
    }

    /// A key that is in the file now and whose time is not over. A look at the file's date, and no more while it is the same.
    ///
    /// # Errors
    /// [`KeysError`]: no key counts then.
    pub fn find(&self, key: &str) -> Result<Option<Key>, KeysError> {
        self.find_hash(&hash(key))
    }

    /// True where a key that was found before would be found again, as it was.
    ///
    /// # Errors
    /// As [`Keys::find`].
    pub fn is_still(&self, key: &Key) -> Result<bool, KeysError> {
        Ok(self.find_hash(&key.hash)?.is_some_and(|now| now == *key))
    }

    fn find_hash(&self, hash: &str) -> Result<Option<Key>, KeysError> {
        let now = match std::fs::metadata(self.dir.join(FILE)) {
            Ok(of) => stamp(&of),
            Err(e) if e.kind() == ErrorKind::NotFound => None,
            Err(e) => return Err(e.into()),
        };
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        if now.is_none() || seen.0 != now {
            // where it cannot be read, the next who asks tries again
            *seen = (None, Vec::new());
            *seen = (now, read(&self.dir)?);
        }
        let at = now_ms();
        // all are looked at, whichever it is
        let found = seen.1.iter().fold(None, |found, known| if same(known.hash.as_bytes(), hash.as_bytes()) { Some(known) } else { found });
        Ok(found.filter(|key| key.expires_ms.is_none_or(|end| at < end)).cloned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_come_and_go_while_the_server_runs() {
        let dir = tempfile::tempdir().unwrap();
        let keys = Keys::open(dir.path()).unwrap();
        let one = add(dir.path(), "site", &[Scope::Upload, Scope::Read], None).unwrap();
        let two = add(dir.path(), "site", &[Scope::Read, Scope::Read], Some(1)).unwrap();
        let (a, b) = (keys.find(&one).unwrap().unwrap(), keys.find(&two).unwrap().unwrap());
        assert_eq!(a.owner(), b.owner());
        assert!(a.may(Scope::Upload) && !b.may(Scope::Upload) && b.scopes.len() == 1);
        assert!(keys.find(&one[..one.len() - 1]).unwrap().is_none() && keys.find("").unwrap().is_none());
        let text = std::fs::read_to_string(dir.path().join(FILE)).unwrap();
        assert!(!text.contains(&one[PREFIX.len()..]) && !text.contains(&two[PREFIX.len()..]), "hashes alone");
        assert!(keys.is_still(&a).unwrap() && keys.is_still(&b).unwrap());
        assert_eq!(remove(dir.path(), "site", Some(a.id())).unwrap(), 1);
        assert!(!keys.is_still(&a).unwrap() && keys.is_still(&b).unwrap());
        assert!(keys.find(&one).unwrap().is_none() && keys.find(&two).unwrap().is_some());
        assert!(matches!(remove(dir.path(), "sites", None), Err(KeysError::Unknown)));
        assert_eq!(remove(dir.path(), "site", None).unwrap(), 1);
        assert!(keys.find(&two).unwrap().is_none());
        assert!(matches!(add(dir.path(), "a b", &[], None), Err(KeysError::Name)));
    }

    #[test]
    fn a_key_ends_and_a_damaged_file_opens_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let key = add(dir.path(), "a", &[Scope::Admin], Some(0)).unwrap();
        let keys = Keys::open(dir.path()).unwrap();
        assert!(keys.find(&key).unwrap().is_none(), "no days");
        let good = add(dir.path(), "b", &[Scope::Admin], None).unwrap();
        assert!(keys.find(&good).unwrap().is_some());
        let path = dir.path().join(FILE);
        let text = std::fs::read_to_string(&path).unwrap();
        for wrong in ["", "{", &text[..text.len() / 2], &text.replace("\"version\": 1", "\"version\": 2"), &text.replace("\"b\"", "\"\"")] {
            std::fs::write(&path, wrong).unwrap();
            assert!(matches!(keys.find(&good), Err(KeysError::Damaged(_))), "{wrong}");
            assert!(keys.find(&good).is_err() && Keys::open(dir.path()).is_err(), "and again");
            assert!(add(dir.path(), "c", &[], None).is_err(), "nothing is written over it");
        }
        std::fs::write(&path, text).unwrap();
        assert!(keys.find(&good).unwrap().is_some());
    }
}
