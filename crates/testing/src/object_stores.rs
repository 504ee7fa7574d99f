//! An S3 server (moto) that tests start and stop. Tests are skipped if it is not installed.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

use crate::Need;

/// A process on a free port, which ends when this is dropped.
#[derive(Debug)]
pub struct Engine {
    child: Child,
    /// Where it listens.
    pub addr: SocketAddr,
}

/// The address in a line that says where a program listens.
fn address(line: &str) -> Option<SocketAddr> {
    let rest = line.split_once("http://")?.1;
    let end = rest.find(|c: char| !(c.is_ascii_digit() || matches!(c, '.' | ':'))).unwrap_or(rest.len());
    rest[..end].parse().ok()
}

impl Engine {
    /// Starts a program on port 0, and reads the actual port from its output.
    fn start(mut command: Command) -> Self {
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("the engine starts");
        let (stdout, stderr) = (child.stdout.take().expect("a pipe"), child.stderr.take().expect("a pipe"));
        let (tell, told) = std::sync::mpsc::channel();
        let streams: [Box<dyn Read + Send>; 2] = [Box::new(stdout), Box::new(stderr)];
        for stream in streams {
            let tell = tell.clone();
            // read to the end: a full pipe would block the program
            std::thread::spawn(move || {
                let lines = BufReader::new(stream).lines().map_while(Result::ok);
                for addr in lines.filter_map(|line| address(&line)) {
                    let _ = tell.send(addr);
                }
            });
        }
        drop(tell);
        let addr = told.recv_timeout(Duration::from_mins(1)).unwrap_or_else(|e| panic!("{command:?} named no address: {e}"));
        Self { child, addr }
    }

    /// An in-memory S3 server with an empty bucket `photos`; `None` without moto.
    pub fn s3() -> Option<Self> {
        let import = Command::new("python3").args(["-c", "import moto.server"]).stdout(Stdio::null()).stderr(Stdio::null()).status();
        Need::S3.or_skip(import.ok().filter(ExitStatus::success).ok_or("pip install 'moto[server]'"))?;
        let mut command = Command::new("python3");
        // start the program itself, not a wrapper script, which would be killed instead
        command.args(["-m", "moto.server", "-H", "127.0.0.1", "-p", "0"]);
        let engine = Self::start(command);
        let mut stream = TcpStream::connect(engine.addr).expect("the engine listens");
        let request = format!("PUT /photos HTTP/1.1\r\nhost: {}\r\ncontent-length: 0\r\nconnection: close\r\n\r\n", engine.addr);
        stream.write_all(request.as_bytes()).expect("a request");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("an answer");
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
        Some(engine)
    }

    /// Variables by which programs find an S3 server at `addr`.
    pub fn s3_variables(addr: SocketAddr) -> [(&'static str, String); 4] {
        [
            ("AWS_ENDPOINT_URL", format!("http://{addr}")),
            ("AWS_ACCESS_KEY_ID", "test".into()),
            ("AWS_SECRET_ACCESS_KEY", "test".into()),
            ("AWS_REGION", "us-east-1".into()),
        ]
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_is_read_from_what_a_program_says() {
        let read = |line: &str| address(line).map(|a| a.to_string());
        assert_eq!(read(" * Running on http://127.0.0.1:46079").as_deref(), Some("127.0.0.1:46079"));
        assert_eq!(read("service is listening at http://127.0.0.1:10000/a").as_deref(), Some("127.0.0.1:10000"));
        assert_eq!(read("Starting service"), None);
        assert_eq!(read("see http://example.org"), None);
    }

    #[test]
    #[should_panic(expected = "named no address: channel is empty and sending half is closed")]
    fn a_program_that_ends_at_once_fails_the_test() {
        Engine::start(Command::new("true"));
    }
}
