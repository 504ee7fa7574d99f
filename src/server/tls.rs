//! TLS without a proxy: certificates from files, read again while the server runs, and ALPN.

use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use rustls::ServerConfig;
use rustls::pki_types::pem::{self, PemObject as _};
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;

/// Interval at which files are read again.
const LOOK: Duration = Duration::from_secs(30);
/// HTTP/2 in ALPN.
pub(super) const HTTP_2: &[u8] = b"h2";

/// Why TLS is not available.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read, or has the wrong content.
    #[error("{file}: cannot read {what}")]
    File {
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

/// A certificate chain and its key, from files in PEM.
#[derive(Clone)]
pub struct Tls {
    cert: PathBuf,
    key: PathBuf,
    chain: Vec<CertificateDer<'static>>,
    now: Arc<RwLock<TlsAcceptor>>,
}

impl Tls {
    /// Reads certificate and key.
    ///
    /// # Errors
    /// [`TlsError`].
    pub fn open(cert: PathBuf, key: PathBuf) -> Result<Self, TlsError> {
        let chain = read_chain(&cert)?;
        let now = Arc::new(RwLock::new(acceptor(&chain, &cert, &key)?));
        Ok(Self { cert, key, chain, now })
    }

    pub(super) fn acceptor(&self) -> TlsAcceptor {
        self.now.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Uses a new certificate from its file, until `stop`. Keeps the old one if the files are unreadable or only half of a new pair.
    pub(super) async fn follow(self, stop: CancellationToken) {
        let mut files = self;
        while stop.run_until_cancelled(tokio::time::sleep(LOOK)).await.is_some() {
            let renewal = tokio::task::spawn_blocking(move || {
                let outcome = files.renew();
                (files, outcome)
            });
            let Ok((same, outcome)) = renewal.await else {
                tracing::error!("renewals of the certificate are no longer followed");
                return;
            };
            files = same;
            match outcome {
                Ok(false) => {}
                Ok(true) => tracing::info!("using the new certificate"),
                Err(error) => tracing::warn!(error = &error as &dyn std::error::Error, "keeping the old certificate"),
            }
        }
    }

    /// Reads the files once; true if there is a new certificate.
    fn renew(&mut self) -> Result<bool, TlsError> {
        let chain = read_chain(&self.cert)?;
        if chain == self.chain {
            return Ok(false);
        }
        let acceptor = acceptor(&chain, &self.cert, &self.key)?;
        self.chain = chain;
        *self.now.write().unwrap_or_else(PoisonError::into_inner) = acceptor;
        Ok(true)
    }
}

fn read_chain(file: &Path) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let wrong = |source| TlsError::File { file: file.to_owned(), what: "certificates", source };
    let chain: Vec<_> = CertificateDer::pem_file_iter(file).and_then(Iterator::collect).map_err(wrong)?;
    if chain.is_empty() { Err(wrong(pem::Error::NoItemsFound)) } else { Ok(chain) }
}

fn acceptor(chain: &[CertificateDer<'static>], cert: &Path, key: &Path) -> Result<TlsAcceptor, TlsError> {
    let private = PrivateKeyDer::from_pem_file(key);
    let private = private.map_err(|source| TlsError::File { file: key.to_owned(), what: "a private key", source })?;
    let pair = |source| TlsError::Pair { cert: cert.to_owned(), key: key.to_owned(), source };
    let mut config = ServerConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()))
        .with_safe_default_protocol_versions()
        .map_err(pair)?
        .with_no_client_auth()
        .with_single_cert(chain.to_vec(), private)
        .map_err(pair)?;
    config.alpn_protocols = vec![HTTP_2.to_vec(), b"http/1.1".to_vec()];
    Ok(TlsAcceptor::from(Arc::new(config)))
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
        let put = |from: &str, to: &Path| std::fs::copy(example(from), to).unwrap();
        put("one.pem", &cert);
        put("one.key", &key);
        let mut tls = Tls::open(cert.clone(), key.clone()).unwrap();
        let before = tls.acceptor();
        assert!(!tls.renew().unwrap(), "nothing has changed");
        put("two.pem", &cert);
        assert!(tls.renew().unwrap_err().to_string().contains("key.pem"), "the key is the old one");
        assert!(Arc::ptr_eq(tls.acceptor().config(), before.config()));
        put("two.key", &key);
        assert!(tls.renew().unwrap());
        assert!(!Arc::ptr_eq(tls.acceptor().config(), before.config()));
        std::fs::remove_file(&cert).unwrap();
        assert!(tls.renew().is_err());
    }

    #[test]
    fn errors_name_their_file() {
        let missing = PathBuf::from("/nowhere/cert.pem");
        let said = |cert: PathBuf, key: PathBuf| Tls::open(cert, key).map(drop).unwrap_err().to_string();
        assert!(said(missing.clone(), example("one.key")).contains("/nowhere/cert.pem"));
        assert!(said(example("one.key"), example("one.key")).contains("one.key: cannot read certificates"));
        assert!(said(example("one.pem"), example("one.pem")).contains("one.pem: cannot read a private key"));
        assert!(said(example("one.pem"), example("two.key")).contains("two.key"));
    }
}
