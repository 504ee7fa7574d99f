//! The server's secret, what is derived of it, and how secrets are made and compared.

use std::io::{self, ErrorKind};
use std::path::Path;

use hmac::{Hmac, KeyInit, Mac};
use sha2::Sha256;

use super::Owner;
use crate::server::files::{Disk, Files};
use crate::server::id::{PhotoId, hex};

/// File of the secret within the data directory.
const FILE: &str = "access.secret";
/// Bytes of a secret: as many as HMAC-SHA-256 makes use of.
const BYTES: usize = 32;
/// Bytes of a block of SHA-256, to which HMAC fills its key up (RFC 2104).
const BLOCK: usize = 64;

/// What ids and signatures of this server are made with; whoever has it can make them.
#[derive(Clone)]
pub struct Secret([u8; BYTES]);

impl Secret {
    /// That of a data directory; made where there is none.
    ///
    /// # Errors
    /// It cannot be read or written, or is not whole.
    pub fn of(dir: &Path) -> io::Result<Self> {
        if let Some(there) = Self::of_existing(dir)? {
            return Ok(there);
        }
        let new = Self::fresh()?;
        replace(&dir.join(FILE), &new.0)?;
        Ok(new)
    }

    /// That of a data directory, where there is one.
    ///
    /// # Errors
    /// It cannot be read, or is not whole.
    pub fn of_existing(dir: &Path) -> io::Result<Option<Self>> {
        match std::fs::read(dir.join(FILE)) {
            Ok(bytes) => {
                let wrong = || io::Error::new(ErrorKind::InvalidData, format!("{FILE} must have {BYTES} bytes"));
                bytes.try_into().map(|bytes| Some(Self(bytes))).map_err(|_| wrong())
            }
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(None),
            Err(e) => Err(e),
        }
    }

    /// A fresh one.
    ///
    /// # Errors
    /// The system has no random bytes.
    pub fn fresh() -> io::Result<Self> {
        random().map(Self)
    }

    /// As hexadecimal digits, as [`Secret::read`] reads them.
    #[must_use]
    pub fn text(&self) -> String {
        hex(&self.0)
    }

    /// From hexadecimal digits; none where they are not those of a secret.
    #[must_use]
    pub fn read(text: &str) -> Option<Self> {
        let digits: Vec<u8> = text.chars().map(|c| c.to_digit(16).map(|d| d as u8)).collect::<Option<_>>()?;
        if digits.len() != 2 * BYTES {
            return None;
        }
        let mut bytes = [0; BYTES];
        for (byte, pair) in bytes.iter_mut().zip(digits.chunks_exact(2)) {
            *byte = pair[0] << 4 | pair[1];
        }
        Some(Self(bytes))
    }

    /// HMAC-SHA-256 over `parts`, each with its length before it, for one purpose alone.
    fn sign(&self, purpose: &str, parts: &[&[u8]]) -> [u8; 32] {
        let mut block = [0; BLOCK];
        block[..BYTES].copy_from_slice(&self.0);
        let mut mac = <Hmac<Sha256> as KeyInit>::new(&block.into());
        for part in [purpose.as_bytes()].iter().chain(parts) {
            mac.update(&(part.len() as u64).to_le_bytes());
            mac.update(part);
        }
        mac.finalize().into_bytes().into()
    }

    /// Id of an owner's photo, where `content` names what it is made of: nobody else can tell from the content what its id would be.
    #[must_use]
    pub fn id(&self, owner: &Owner, content: PhotoId) -> PhotoId {
        let mut id = [0; 16];
        id.copy_from_slice(&self.sign("tmpi id 1", &[owner.text().as_bytes(), content.to_string().as_bytes()])[..16]);
        PhotoId::from_bytes(id)
    }

    /// Signature of a link by which a photo of this seal can be read until `expires`, in seconds since 1970; 64 hex digits.
    #[must_use]
    pub fn link(&self, seal: &str, expires: u64) -> String {
        hex(&self.sign("tmpi link 2", &[seal.as_bytes(), &expires.to_le_bytes()]))
    }

    /// Whether a link's signature is that of a photo of this seal, and its time is not over.
    #[must_use]
    pub fn is_good(&self, seal: &str, expires: u64, signature: &str, now: u64) -> bool {
        now < expires && same(self.link(seal, expires).as_bytes(), signature.as_bytes())
    }

    /// Signature of an owner for one purpose alone, and until a time where it ends; 64 hex digits.
    #[must_use]
    pub fn owner(&self, purpose: &str, owner: &Owner, expires: u64) -> String {
        hex(&self.sign(purpose, &[owner.text().as_bytes(), &expires.to_le_bytes()]))
    }

    /// What the token of a photo of this seal ends with; 64 hex digits.
    #[must_use]
    pub fn manage(&self, seal: &str) -> String {
        hex(&self.sign("tmpi manage 1", &[seal.as_bytes()]))
    }
}

/// Whether two texts are equal, in a time that depends on their lengths alone.
#[must_use]
pub fn same(a: &[u8], b: &[u8]) -> bool {
    a.len() == b.len() && std::hint::black_box(a.iter().zip(b).fold(0, |all, (x, y)| all | (x ^ y))) == 0
}

/// Fresh bytes that nobody can guess.
///
/// # Errors
/// The system has none.
pub fn random() -> io::Result<[u8; BYTES]> {
    let mut bytes = [0; BYTES];
    getrandom::fill(&mut bytes).map_err(|e| io::Error::other(e.to_string()))?;
    Ok(bytes)
}

/// Writes a file whole or not at all, for its owner alone to read; it is durable when this returns.
///
/// # Errors
/// The directory cannot be written.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    replace_in(&Disk, path, bytes)
}

/// The same on other files than the disk's.
fn replace_in(files: &dyn Files, path: &Path, bytes: &[u8]) -> io::Result<()> {
    let part = path.with_extension(format!("{}.tmp", std::process::id()));
    let written = files.write(&part, bytes).and_then(|()| files.rename(&part, path));
    if written.is_err() {
        // what could not be finished is of no use
        let _ = files.remove(&part);
    }
    written?;
    // a key that was taken back must not be good again once the power returns
    path.parent().map_or(Ok(()), |dir| files.sync_dir(dir))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::forgetful::Forgetful;

    #[test]
    fn a_secret_stays_and_is_its_owners_alone() {
        let dir = tempfile::tempdir().unwrap();
        let content = PhotoId::of(&[1; 32], None, "", "");
        let owner = Owner::of_secret(&"a".repeat(40));
        let id = |dir: &Path| Secret::of(dir).unwrap().id(&owner, content);
        assert_eq!(id(dir.path()), id(dir.path()));
        assert_ne!(id(dir.path()), id(tempfile::tempdir().unwrap().path()), "another server");
        assert_ne!(id(dir.path()), Secret::of(dir.path()).unwrap().id(&Owner::of_secret(&"b".repeat(40)), content), "another owner");
        #[cfg(unix)]
        {
            let mode = std::fs::metadata(dir.path().join(FILE)).unwrap();
            assert_eq!(std::os::unix::fs::PermissionsExt::mode(&mode.permissions()) & 0o777, 0o600);
        }
        let secret = Secret::of(dir.path()).unwrap();
        assert_eq!(Secret::read(&secret.text()).map(|read| read.0), Some(secret.0));
        for wrong in ["", &secret.text()[1..], &secret.text().replace(&secret.text()[..1], "x"), &format!("{}00", secret.text())] {
            assert!(Secret::read(wrong).is_none(), "{wrong}");
        }
        std::fs::write(dir.path().join(FILE), b"short").unwrap();
        assert!(Secret::of(dir.path()).is_err_and(|e| e.to_string().contains("32 bytes")));
    }

    #[test]
    fn what_was_replaced_stays_so_when_the_power_goes_and_is_whole_wherever_it_goes() {
        let (files, path) = (Forgetful::new(), Path::new("/keys.json"));
        replace_in(&files, path, b"a key").unwrap();
        files.crash();
        assert_eq!(files.read(path).unwrap(), b"a key");
        for changes in 0.. {
            files.end_after(changes);
            let done = replace_in(&files, path, b"none").is_ok();
            files.crash();
            let there = files.read(path).unwrap();
            assert!(if done { there == b"none" } else { there == b"none" || there == b"a key" }, "{changes}: {there:?}");
            if done {
                break;
            }
        }
    }

    #[test]
    fn a_link_is_good_for_its_photo_and_time_alone() {
        let secret = Secret([7; BYTES]);
        let (one, other) = ("a photo", "another");
        let signature = secret.link(one, 1000);
        assert!(secret.is_good(one, 1000, &signature, 999));
        assert!(!secret.is_good(one, 1000, &signature, 1000), "its time is over");
        assert!(!secret.is_good(one, 1001, &signature, 999), "a later time");
        assert!(!secret.is_good(other, 1000, &signature, 999), "another photo's");
        assert!(!Secret([8; BYTES]).is_good(one, 1000, &signature, 999), "another server's");
        assert_ne!(secret.manage(one), secret.manage(other));
        assert!(!secret.is_good(one, 1000, &secret.manage(one), 999), "a token is no link");
        for wrong in ["", &signature[1..], &signature.to_uppercase(), &signature.replace(&signature[..1], "x")] {
            assert!(!secret.is_good(one, 1000, wrong, 999), "{wrong}");
        }
    }

    #[test]
    fn comparing_looks_at_everything() {
        assert!(same(b"", b"") && same(b"abc", b"abc"));
        for (a, b) in [("abc", "abx"), ("abc", "xbc"), ("abc", "ab"), ("", "a"), ("\u{1}\u{1}", "\u{2}\u{2}")] {
            assert!(!same(a.as_bytes(), b.as_bytes()), "{a} {b}");
        }
    }
}
