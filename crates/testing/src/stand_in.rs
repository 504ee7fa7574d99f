//! An HTTP server in the test's process: it answers as the test says, and records requests.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// A request that was answered.
#[derive(Clone, Debug)]
pub struct Request {
    /// Number of requests before it.
    pub number: usize,
    /// Method and target.
    pub line: String,
    /// Names are in lower case.
    pub headers: Vec<(String, String)>,
    /// The body, if it has a length.
    pub body: Vec<u8>,
    /// Status of its answer; 0 if the answer is none of [`Answer::Whole`].
    pub status: u16,
}

impl Request {
    /// A header; empty if it is missing.
    pub fn header(&self, name: &str) -> &str {
        self.headers.iter().find(|(n, _)| n == name).map_or("", |(_, v)| v)
    }

    /// The target.
    pub fn path(&self) -> &str {
        self.line.split(' ').nth(1).unwrap_or_default()
    }
}

/// An answer.
pub enum Answer {
    /// Status, lines of headers that end with `\r\n`, and body; further requests may follow.
    Whole(u16, String, Vec<u8>),
    /// Bytes as they are, piece by piece, and the end of the connection.
    Pieces(Box<dyn Iterator<Item = Vec<u8>>>),
    /// Bytes as they are, and then nothing until the client closes the connection.
    Stalled(Vec<u8>),
}

impl Answer {
    /// A status without a body.
    pub const fn of(status: u16) -> Self {
        Self::Whole(status, String::new(), Vec::new())
    }

    /// Bytes as they are, and the end of the connection.
    pub fn bytes(bytes: impl Into<Vec<u8>>) -> Self {
        Self::Pieces(Box::new(std::iter::once(bytes.into())))
    }
}

/// A server on a free port.
#[derive(Clone)]
pub struct StandIn {
    /// Where it listens.
    pub addr: SocketAddr,
    state: Arc<State>,
}

struct State {
    answered: Mutex<Vec<Request>>,
    begun: AtomicUsize,
    answer: Box<dyn Fn(&Request) -> Answer + Send + Sync>,
}

impl StandIn {
    /// Starts one.
    pub fn start(answer: impl Fn(&Request) -> Answer + Send + Sync + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let addr = listener.local_addr().expect("an address");
        let state = Arc::new(State { answered: Mutex::default(), begun: AtomicUsize::new(0), answer: Box::new(answer) });
        let of = Arc::clone(&state);
        std::thread::spawn(move || {
            for stream in listener.incoming().map_while(Result::ok) {
                let of = Arc::clone(&of);
                std::thread::spawn(move || {
                    let mut stream = BufReader::new(stream);
                    while of.take(&mut stream).is_some() {}
                });
            }
        });
        Self { addr, state }
    }

    /// The address of a path.
    pub fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.addr)
    }

    /// Requests that were answered, in order.
    pub fn answered(&self) -> Vec<Request> {
        self.state.answered.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Number of requests that have come.
    pub fn begun(&self) -> usize {
        self.state.begun.load(Ordering::SeqCst)
    }
}

impl State {
    /// Reads and answers one request; `None` at the end of the connection.
    fn take(&self, stream: &mut BufReader<TcpStream>) -> Option<()> {
        let mut line = String::new();
        stream.read_line(&mut line).ok().filter(|n| *n > 0)?;
        let mut headers = Vec::new();
        loop {
            let mut line = String::new();
            stream.read_line(&mut line).ok()?;
            let Some((name, value)) = line.trim_end().split_once(':') else { break };
            headers.push((name.to_ascii_lowercase(), value.trim().to_owned()));
        }
        let mut request = Request { number: 0, line: line.trim_end().to_owned(), headers, body: Vec::new(), status: 0 };
        request.body.resize(request.header("content-length").parse().unwrap_or(0), 0);
        stream.read_exact(&mut request.body).ok()?;
        request.number = self.begun.fetch_add(1, Ordering::SeqCst);
        let answer = (self.answer)(&request);
        if let Answer::Whole(status, ..) = answer {
            request.status = status;
        }
        self.answered.lock().unwrap_or_else(PoisonError::into_inner).push(request);
        match answer {
            Answer::Whole(status, headers, body) => {
                let head = format!("HTTP/1.1 {status} X\r\ncontent-length: {}\r\n{headers}\r\n", body.len());
                stream.get_mut().write_all(&[head.as_bytes(), &body].concat()).ok()
            }
            Answer::Pieces(pieces) => {
                let _ = pieces.map(|piece| stream.get_mut().write_all(&piece)).find(Result::is_err);
                None
            }
            Answer::Stalled(bytes) => {
                stream.get_mut().write_all(&bytes).ok()?;
                stream.read_to_end(&mut Vec::new()).ok().and(None)
            }
        }
    }
}
