//! An HTTP server in the test's process that records requests: a receiver of webhooks.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, KeyInit as _, Mac as _};
use serde_json::Value;
use sha2::Sha256;

use crate::fixture::wait_until;

/// A request, and how it was answered.
#[derive(Clone, Debug)]
pub struct Got {
    headers: Vec<(String, String)>,
    pub body: String,
    pub status: u16,
}

impl Got {
    pub fn header(&self, name: &str) -> &str {
        self.headers.iter().find(|(n, _)| n == name).map_or("", |(_, v)| v)
    }

    pub fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap()
    }

    /// Checks the signature as a receiver does.
    pub fn is_signed_by(&self, secret: &str) -> bool {
        let key = STANDARD.decode(secret.strip_prefix("whsec_").unwrap()).unwrap();
        let mut mac = Hmac::<Sha256>::new_from_slice(&key).unwrap();
        mac.update(format!("{}.{}.{}", self.header("webhook-id"), self.header("webhook-timestamp"), self.body).as_bytes());
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_secs();
        let is_fresh = self.header("webhook-timestamp").parse::<u64>().unwrap().abs_diff(now) < 300;
        is_fresh && self.header("webhook-signature") == format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes()))
    }
}

/// An answer.
pub struct Answer {
    pub status: u16,
    /// Lines that end with `\r\n`.
    pub headers: String,
}

impl Answer {
    pub fn of(status: u16) -> Self {
        Self { status, headers: String::new() }
    }
}

/// A receiver of webhooks.
pub struct Receiver {
    pub url: String,
    state: Arc<State>,
}

struct State {
    got: Mutex<Vec<Got>>,
    begun: AtomicUsize,
    answer: Box<dyn Fn(usize) -> Answer + Send + Sync>,
}

impl Receiver {
    /// Starts one; `answer` gets the number of requests before.
    pub fn start(answer: impl Fn(usize) -> Answer + Send + Sync + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}/hook", listener.local_addr().unwrap());
        let state = Arc::new(State { got: Mutex::default(), begun: AtomicUsize::new(0), answer: Box::new(answer) });
        let of = Arc::clone(&state);
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let of = Arc::clone(&of);
                std::thread::spawn(move || {
                    let mut stream = BufReader::new(stream.unwrap());
                    while of.take(&mut stream).is_some() {}
                });
            }
        });
        Self { url, state }
    }

    /// Requests that were answered, in order.
    pub fn got(&self) -> Vec<Got> {
        self.state.got.lock().unwrap().clone()
    }

    /// Number of requests that have come.
    pub fn begun(&self) -> usize {
        self.state.begun.load(Ordering::SeqCst)
    }

    /// Waits for this many requests of a type.
    #[track_caller]
    pub fn wait(&self, kind: &str, count: usize) -> Vec<Got> {
        let of_kind = || self.got().into_iter().filter(|got| got.json()["type"] == kind).collect::<Vec<_>>();
        wait_until(&format!("{count} times {kind}"), || of_kind().len() >= count);
        of_kind()
    }
}

impl State {
    /// Reads and answers one request; `None` at the end of the connection.
    fn take(&self, stream: &mut BufReader<TcpStream>) -> Option<()> {
        let mut line = String::new();
        if stream.read_line(&mut line).ok()? == 0 {
            return None;
        }
        let mut headers = Vec::new();
        loop {
            let mut line = String::new();
            stream.read_line(&mut line).ok()?;
            let Some((name, value)) = line.trim_end().split_once(':') else { break };
            headers.push((name.to_ascii_lowercase(), value.trim().to_owned()));
        }
        let length = headers.iter().find(|(n, _)| n == "content-length").and_then(|(_, v)| v.parse().ok()).unwrap_or(0);
        let mut body = vec![0; length];
        stream.read_exact(&mut body).ok()?;
        let Answer { status, headers: more } = (self.answer)(self.begun.fetch_add(1, Ordering::SeqCst));
        self.got.lock().unwrap().push(Got { headers, body: String::from_utf8(body).unwrap(), status });
        let answer = format!("HTTP/1.1 {status} X\r\n{more}content-length: 0\r\n\r\n");
        stream.get_mut().write_all(answer.as_bytes()).ok()
    }
}
