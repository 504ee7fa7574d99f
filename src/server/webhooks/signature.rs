//! Signatures of webhooks: HMAC-SHA-256 over id, time and body.

use std::ops::RangeInclusive;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::Sha256;

use crate::server::problem::Problem;

/// Prefix of a secret.
const PREFIX: &str = "whsec_";
/// Allowed bytes of a secret, and bytes of one that the server makes.
const BYTES: RangeInclusive<usize> = 24..=64;
const USUAL: usize = 32;

/// A secret that signs a webhook's requests: `whsec_` and the base64 of 24 to 64 bytes.
pub struct SigningSecret(Vec<u8>);

impl SigningSecret {
    /// Reads a secret.
    ///
    /// # Errors
    /// What is wrong with it, without the secret.
    pub fn parse(text: &str) -> Result<Self, &'static str> {
        let read = |text: &str| STANDARD.decode(text.strip_prefix(PREFIX)?).ok().filter(|bytes| BYTES.contains(&bytes.len()));
        read(text).map(Self).ok_or("must be whsec_ and the base64 of 24 to 64 bytes")
    }

    /// The text of a new secret.
    ///
    /// # Errors
    /// 500 if the system has no random bytes.
    pub fn new_text() -> Result<String, Problem> {
        let mut bytes = [0; USUAL];
        getrandom::fill(&mut bytes).map_err(|e| Problem::internal("a new secret", &e))?;
        Ok(format!("{PREFIX}{}", STANDARD.encode(bytes)))
    }

    /// The header `webhook-signature` of a request at `seconds` since 1970.
    pub fn sign(&self, id: &str, seconds: u64, body: &str) -> String {
        // RFC 2104 pads a key to a block with zeros
        let mut block = [0; 64];
        block[..self.0.len()].copy_from_slice(&self.0);
        let mut mac = Hmac::<Sha256>::new(&block.into());
        mac.update(format!("{id}.{seconds}.{body}").as_bytes());
        format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_signature_is_that_of_the_reference_libraries() {
        // from the tests of github.com/standard-webhooks/standard-webhooks, libraries/*
        let secret = SigningSecret::parse("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw").unwrap();
        let signature = secret.sign("msg_p5jXN8AQM9LWM0D4loKWxJek", 1_614_265_330, r#"{"test": 2432232314}"#);
        assert_eq!(signature, "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=");
    }

    #[test]
    fn a_secret_has_24_to_64_bytes() {
        let of = |bytes: usize| SigningSecret::parse(&format!("{PREFIX}{}", STANDARD.encode(vec![7; bytes]))).is_ok();
        assert_eq!([23, 24, 64, 65].map(of), [false, true, true, false]);
        assert!(SigningSecret::parse(&SigningSecret::new_text().unwrap()).is_ok());
        for wrong in [
            "",
            PREFIX,
            "MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw",
            "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaS",
            "whsec_äääääääääääääääääääääääääääääääää",
        ] {
            assert!(SigningSecret::parse(wrong).is_err(), "{wrong}");
        }
    }
}
