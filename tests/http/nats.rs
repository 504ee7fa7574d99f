//! Real `nats-server`s. Without that program tests that need one say so and pass.

use std::io::{BufRead, BufReader, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use tempfile::{TempDir, tempdir};
use tmpi_testing::Need;

use super::client::get;
use super::fixture::wait_until;

/// A NATS server of its own.
pub struct Nats {
    pub port: u16,
    folder: TempDir,
    child: Option<Child>,
}

fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

impl Nats {
    /// One that takes payloads of `most` bytes and stores nothing; none, said aloud, where there is no such program.
    pub fn start(most: usize) -> Option<Self> {
        Self::with(&format!("max_payload: {most}\n"))
    }

    fn with(config: &str) -> Option<Self> {
        let found = Command::new(Self::program()).arg("--version").output().map(drop);
        Need::Nats.or_skip(found)?;
        let folder = tempdir().unwrap();
        let store = folder.path().join("store");
        std::fs::write(folder.path().join("nats.conf"), config.replace("STORE", &format!("\"{}\"", store.display()))).unwrap();
        let mut nats = Self { port: free_port(), folder, child: None };
        nats.restart();
        Some(nats)
    }

    /// Debian keeps it where only root looks.
    fn program() -> &'static str {
        if Path::new("/usr/sbin/nats-server").exists() { "/usr/sbin/nats-server" } else { "nats-server" }
    }

    pub fn restart(&mut self) {
        let (config, port) = (self.folder.path().join("nats.conf"), self.port.to_string());
        let mut command = Command::new(Self::program());
        command.args(["-a", "127.0.0.1", "-p", &port, "-c"]).arg(config).stdout(Stdio::null()).stderr(Stdio::null());
        self.child = Some(command.spawn().unwrap());
        wait_until("NATS listens", || TcpStream::connect(("127.0.0.1", self.port)).is_ok());
    }

    /// No chance to put anything right.
    pub fn kill(&mut self) {
        if let Some(mut child) = self.child.take() {
            child.kill().unwrap();
            child.wait().unwrap();
        }
    }

    pub fn url(&self) -> String {
        format!("nats://127.0.0.1:{}", self.port)
    }

    /// Says something on a subject, as anybody may who is let in.
    pub fn say(&self, subject: &str, payload: &[u8]) {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        let mut lines = BufReader::new(stream.try_clone().unwrap()).lines();
        assert!(lines.next().unwrap().unwrap().starts_with("INFO"));
        write!(stream, "CONNECT {{\"verbose\":false}}\r\nPUB {subject} {}\r\n", payload.len()).unwrap();
        stream.write_all(&[payload, b"\r\nPING\r\n"].concat()).unwrap();
        assert!(lines.any(|line| line.unwrap() == "PONG"));
    }
}

impl Drop for Nats {
    fn drop(&mut self) {
        self.kill();
    }
}

/// A figure of a server's metrics; none where it has no such one.
pub fn figure(addr: SocketAddr, name: &str) -> Option<u64> {
    let text = String::from_utf8(get(addr, "/metrics").body).unwrap();
    let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ').map(str::to_owned))?;
    Some(line.parse::<f64>().unwrap() as u64)
}
