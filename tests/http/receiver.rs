//! A receiver of webhooks in the test's process.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::Sha256;
use tmpi_testing::{Answer, Request, StandIn};

use crate::prelude::*;

/// A delivery.
pub trait Delivery {
    fn json(&self) -> Value;
    fn is_signed_by(&self, secret: &str) -> bool;
}

impl Delivery for Request {
    fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap()
    }

    /// Checks the signature as a receiver does.
    fn is_signed_by(&self, secret: &str) -> bool {
        let key = STANDARD.decode(secret.strip_prefix("whsec_").unwrap()).unwrap();
        let mut mac = Hmac::<Sha256>::new_from_slice(&key).unwrap();
        mac.update(format!("{}.{}.", self.header("webhook-id"), self.header("webhook-timestamp")).as_bytes());
        mac.update(&self.body);
        let is_fresh = self.header("webhook-timestamp").parse::<u64>().unwrap().abs_diff(seconds_now()) < 300;
        is_fresh && self.header("webhook-signature") == format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes()))
    }
}

/// A receiver of webhooks.
pub struct Receiver {
    pub url: String,
    server: StandIn,
}

impl Receiver {
    /// Starts one; `answer` gets the number of requests before.
    pub fn start(answer: impl Fn(usize) -> Answer + Send + Sync + 'static) -> Self {
        let server = StandIn::start(move |request| answer(request.number));
        Self { url: server.url("/hook"), server }
    }

    /// Deliveries that were answered, in order.
    pub fn got(&self) -> Vec<Request> {
        self.server.answered()
    }

    /// Number of deliveries that have come.
    pub fn begun(&self) -> usize {
        self.server.begun()
    }

    /// Waits for this many deliveries of a type.
    #[track_caller]
    pub fn wait(&self, kind: &str, count: usize) -> Vec<Request> {
        let of_kind = || self.got().into_iter().filter(|got| got.json()["type"] == kind).collect::<Vec<_>>();
        wait_until(&format!("{count} times {kind}"), || of_kind().len() >= count);
        of_kind()
    }
}
