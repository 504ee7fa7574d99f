//! A small blocking HTTP client that shows everything it receives.

use std::fmt::Write as _;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use serde_json::Value;

/// The header of a body in JSON.
pub const JSON: (&str, &str) = ("content-type", "application/json");

/// A response.
#[derive(Debug)]
pub struct Response {
    pub status: u16,
    headers: Vec<(String, String)>,
    pub body: Vec<u8>,
}

impl Response {
    pub fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(n, _)| n.eq_ignore_ascii_case(name)).map(|(_, v)| v.as_str())
    }

    /// All values of a header, joined.
    pub fn all(&self, name: &str) -> String {
        let values: Vec<&str> = self.headers.iter().filter(|(n, _)| n.eq_ignore_ascii_case(name)).map(|(_, v)| v.as_str()).collect();
        values.join(", ")
    }

    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|e| panic!("{e} in {:?}", String::from_utf8_lossy(&self.body)))
    }

    pub fn text(&self) -> String {
        String::from_utf8(self.body.clone()).unwrap()
    }

    /// The response, which must have this status.
    #[track_caller]
    pub fn is(self, status: u16) -> Self {
        assert_eq!(self.status, status, "{}", String::from_utf8_lossy(&self.body));
        self
    }

    /// The response, which must have one of these statuses.
    #[track_caller]
    pub fn any_of(self, statuses: &[u16]) -> Self {
        assert!(statuses.contains(&self.status), "{}: {}", self.status, String::from_utf8_lossy(&self.body));
        self
    }

    /// The body as a problem of `status`.
    #[track_caller]
    pub fn problem(&self, status: u16) -> Value {
        assert_eq!(self.status, status, "{}", String::from_utf8_lossy(&self.body));
        assert_eq!(self.header("content-type"), Some("application/problem+json"));
        let problem = self.json();
        assert_eq!(problem["status"], status);
        for field in ["type", "title", "detail", "request_id"] {
            assert!(problem[field].as_str().is_some_and(|s| !s.is_empty()), "{field} is missing in {problem}");
        }
        problem
    }
}

/// A connection.
pub struct Connection {
    stream: BufReader<TcpStream>,
    host: String,
}

impl Connection {
    pub fn open(addr: SocketAddr) -> Self {
        let stream = TcpStream::connect(addr).expect("the server listens");
        stream.set_read_timeout(Some(Duration::from_mins(1))).unwrap();
        stream.set_nodelay(true).unwrap();
        Self { stream: BufReader::new(stream), host: addr.to_string() }
    }

    /// A connection on which a file was asked for.
    pub fn asking(addr: SocketAddr, path: &str) -> Self {
        let mut connection = Self::open(addr);
        connection.send("GET", path, &[], &[]);
        connection
    }

    pub fn raw(&mut self) -> &mut TcpStream {
        self.stream.get_mut()
    }

    /// Sends a request; the server may answer and close before it has read the whole body.
    pub fn send(&mut self, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) {
        let mut head = format!("{method} {path} HTTP/1.1\r\n");
        if !headers.iter().any(|(name, _)| name.eq_ignore_ascii_case("host")) {
            _ = write!(head, "host: {}\r\n", self.host);
        }
        for (name, value) in headers {
            _ = write!(head, "{name}: {value}\r\n");
        }
        if !body.is_empty() || method == "POST" {
            _ = write!(head, "content-length: {}\r\n", body.len());
        }
        let stream = self.stream.get_mut();
        stream.write_all((head + "\r\n").as_bytes()).expect("the header goes out");
        let _ = stream.write_all(body);
    }

    /// Reads status line and headers.
    pub fn head(&mut self) -> std::io::Result<Response> {
        let mut line = String::new();
        self.stream.read_line(&mut line)?;
        let status = line.split(' ').nth(1).and_then(|s| s.parse().ok());
        let status = status.ok_or_else(|| std::io::Error::other(format!("status line {line:?}")))?;
        let mut headers = Vec::new();
        loop {
            let mut line = String::new();
            self.stream.read_line(&mut line)?;
            let line = line.trim_end();
            if line.is_empty() {
                break;
            }
            let (name, value) = line.split_once(':').expect("a header");
            headers.push((name.to_owned(), value.trim().to_owned()));
        }
        Ok(Response { status, headers, body: Vec::new() })
    }

    /// The next line of a chunked body, or the rest of the body; `None` at the end.
    pub fn chunk(&mut self) -> Option<Vec<u8>> {
        let mut line = String::new();
        self.stream.read_line(&mut line).ok()?;
        let length = usize::from_str_radix(line.trim(), 16).ok()?;
        let mut chunk = vec![0; length + 2];
        self.stream.read_exact(&mut chunk).ok()?;
        chunk.truncate(length);
        (length > 0).then_some(chunk)
    }

    /// Reads a response to a request of `method`.
    pub fn receive(&mut self, method: &str) -> std::io::Result<Response> {
        let mut response = self.head()?;
        let length = response.header("content-length").and_then(|l| l.parse().ok());
        if method == "HEAD" || matches!(response.status, 204 | 304) {
            return Ok(response);
        }
        if let Some(length) = length {
            response.body = vec![0; length];
            self.stream.read_exact(&mut response.body)?;
        } else {
            while let Some(chunk) = self.chunk() {
                response.body.extend(chunk);
            }
        }
        Ok(response)
    }

    pub fn request(&mut self, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Response {
        self.send(method, path, headers, body);
        self.receive(method).unwrap_or_else(|e| panic!("{method} {path}: {e}"))
    }
}

pub fn request(addr: SocketAddr, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Response {
    Connection::open(addr).request(method, path, headers, body)
}

pub fn get(addr: SocketAddr, path: &str) -> Response {
    request(addr, "GET", path, &[], &[])
}

/// Sends bytes as they are on a connection of their own, and reads the answer.
pub fn send_raw(addr: SocketAddr, bytes: &[u8]) -> Response {
    let mut connection = Connection::open(addr);
    connection.raw().write_all(bytes).unwrap();
    connection.receive("POST").unwrap()
}

/// A multipart form of named parts.
pub fn form(parts: &[(&str, &[u8])]) -> (String, Vec<u8>) {
    let boundary = "a-boundary-that-is-in-no-part";
    let mut body = Vec::new();
    for (name, bytes) in parts {
        body.extend(format!("--{boundary}\r\ncontent-disposition: form-data; name=\"{name}\"; filename=\"f\"\r\n\r\n").bytes());
        body.extend(*bytes);
        body.extend(b"\r\n");
    }
    body.extend(format!("--{boundary}--\r\n").bytes());
    (format!("multipart/form-data; boundary={boundary}"), body)
}

pub fn post_form(addr: SocketAddr, headers: &[(&str, &str)], parts: &[(&str, &[u8])]) -> Response {
    let (content_type, body) = form(parts);
    let mut all = vec![("content-type", content_type.as_str())];
    all.extend(headers);
    request(addr, "POST", "/v1/photos", &all, &body)
}
