//! TLS without a proxy: certificates from files, reloaded when they change, and ALPN.

use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, SystemTime};

use rustls::ServerConfig;
use rustls::pki_types::pem::{self, PemObject as _};
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;

/// Interval of the checks for changed files.
const LOOK: Duration = Duration::from_secs(30);
/// Protocols for ALPN, best first.
pub(super) const HTTP_2: &[u8] = b"h2";
const PROTOCOLS: [&[u8]; 2] = [HTTP_2, b"http/1.1"];

/// Why TLS is not available.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read.
    #[error("{file}")]
    File {
        /// The file.
        file: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// A file has the wrong content.
    #[error("{file}: not PEM with {what}")]
    Pem {
        /// The file.
        file: PathBuf,
        /// What it should have.
        what: &'static str,
        /// What is wrong.
        source: pem::Error,
    },
    /// Certificate and key do not match, or are of an unsupported kind.
    #[error("{cert} and {key}")]
    Pair {
        /// File of the certificates.
        cert: PathBuf,
        /// File of the key.
        key: PathBuf,
        /// What is wrong.
        source: rustls::Error,
    },
}

/// Files of a certificate chain and its key, in PEM.
#[derive(Clone, Debug)]
struct Files {
    cert: PathBuf,
    key: PathBuf,
}

/// When both were last written.
type Written = [SystemTime; 2];

impl Files {
    fn written(&self) -> Result<Written, TlsError> {
        let of = |file: &Path| {
            let written = std::fs::metadata(file).and_then(|m| m.modified());
            written.map_err(|source| TlsError::File { file: file.to_owned(), source })
        };
        Ok([of(&self.cert)?, of(&self.key)?])
    }

    fn read(&self) -> Result<TlsAcceptor, TlsError> {
        let (cert, key) = (self.cert.clone(), self.key.clone());
        let wrong = |file: &Path, what| {
            let file = file.to_owned();
            move |error| match error {
                pem::Error::Io(source) => TlsError::File { file: file.clone(), source },
                source => TlsError::Pem { file: file.clone(), what, source },
            }
        };
        let of_cert = wrong(&cert, "certificates");
        let chain: Vec<CertificateDer<'static>> =
            CertificateDer::pem_file_iter(&cert).map_err(&of_cert)?.collect::<Result<_, _>>().map_err(&of_cert)?;
        if chain.is_empty() {
            return Err(of_cert(pem::Error::NoItemsFound));
        }
        let private = PrivateKeyDer::from_pem_file(&key).map_err(wrong(&key, "a private key"))?;
        let pair = |source| TlsError::Pair { cert: cert.clone(), key: key.clone(), source };
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let mut config = ServerConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(pair)?
            .with_no_client_auth()
            .with_single_cert(chain, private)
            .map_err(pair)?;
        config.alpn_protocols = PROTOCOLS.map(<[u8]>::to_vec).to_vec();
        Ok(TlsAcceptor::from(Arc::new(config)))
    }
}

/// The current certificate.
#[derive(Clone)]
pub struct Tls {
    files: Files,
    written: Written,
    now: Arc<RwLock<TlsAcceptor>>,
}

impl Tls {
    /// Reads certificate and key.
    ///
    /// # Errors
    /// [`TlsError`].
    pub fn open(cert: PathBuf, key: PathBuf) -> Result<Self, TlsError> {
        let files = Files { cert, key };
        // before reading, so that changes during it trigger a reload
        let written = files.written()?;
        Ok(Self { now: Arc::new(RwLock::new(files.read()?)), files, written })
    }

    /// The acceptor for the next connection.
    pub(super) fn acceptor(&self) -> TlsAcceptor {
        self.now.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Reloads the files when they change, until `stop`. Keeps the old ones if they are unreadable or only half of a new pair.
    pub(super) async fn follow(mut self, stop: CancellationToken) {
        while stop.run_until_cancelled(tokio::time::sleep(LOOK)).await.is_some() {
            self.renew();
        }
    }

    /// Checks the files once.
    fn renew(&mut self) {
        let read = self.files.written().and_then(|written| {
            if written == self.written {
                return Ok(None);
            }
            self.files.read().map(|acceptor| Some((written, acceptor)))
        });
        match read {
            Ok(None) => {}
            Ok(Some((written, acceptor))) => {
                self.written = written;
                *self.now.write().unwrap_or_else(PoisonError::into_inner) = acceptor;
                tracing::info!("using the new certificate");
            }
            Err(error) => tracing::warn!(error = &error as &dyn std::error::Error, "keeping the old certificate"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn example(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/http/certificates").join(name)
    }

    #[test]
    fn a_new_certificate_is_used_once_its_key_matches() {
        let dir = tempfile::tempdir().unwrap();
        let (cert, key) = (dir.path().join("cert.pem"), dir.path().join("key.pem"));
        let put = |from: &str, to: &Path, age: u64| {
            std::fs::copy(example(from), to).unwrap();
            let file = std::fs::File::options().write(true).open(to).unwrap();
            file.set_modified(SystemTime::now() - Duration::from_secs(age)).unwrap();
        };
        put("one.pem", &cert, 60);
        put("one.key", &key, 60);
        let mut tls = Tls::open(cert.clone(), key.clone()).unwrap();
        let same = |tls: &Tls, before: &TlsAcceptor| Arc::ptr_eq(tls.acceptor().config(), before.config());
        let before = tls.acceptor();
        tls.renew();
        assert!(same(&tls, &before), "nothing has changed");
        put("two.pem", &cert, 40);
        tls.renew();
        assert!(same(&tls, &before), "the key is the old one");
        put("two.key", &key, 20);
        tls.renew();
        assert!(!same(&tls, &before));
        let before = tls.acceptor();
        std::fs::remove_file(&key).unwrap();
        tls.renew();
        assert!(same(&tls, &before));
    }

    #[test]
    fn errors_name_their_file() {
        let missing = PathBuf::from("/nowhere/cert.pem");
        let said = |cert: PathBuf, key: PathBuf| Tls::open(cert, key).map(drop).unwrap_err().to_string();
        assert!(said(missing.clone(), example("one.key")).contains("/nowhere/cert.pem"));
        assert!(said(example("one.key"), example("one.key")).contains("one.key: not PEM with certificates"));
        assert!(said(example("one.pem"), example("one.pem")).contains("one.pem: not PEM with a private key"));
        assert!(said(example("one.pem"), example("two.key")).contains("two.key"));
    }
}
