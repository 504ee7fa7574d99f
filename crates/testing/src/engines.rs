//! Engines that tests start and stop: an S3 server (moto), an Azure one (azurite). A test is skipped where its engine is not installed.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::Need;

/// The account that every such emulator has, and its key, which are no secret.
pub const AZURE_ACCOUNT: &str = "devstoreaccount1";
/// See [`AZURE_ACCOUNT`].
pub const AZURE_KEY: &str = "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw==";
/// Leave to do anything to its blobs until 2099, signed with that key.
const AZURE_LEAVE: &str =
    "sv=2019-12-12&ss=b&srt=sco&sp=rwdlac&se=2099-01-01T00%3A00%3A00Z&spr=https,http&sig=0inStVod1SiNNw%2FCJ4fRrpJIdRZAadbisT7bZCD4KQs%3D";

/// A process on a port of its own, which ends with this.
#[derive(Debug)]
pub struct Engine {
    child: Option<Child>,
    /// Where it listens.
    pub addr: SocketAddr,
}

/// A port that is free now.
fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).map(|a| a.port()).expect("a free port")
}

/// True where `program` answers to `arguments`.
fn is_there(program: &str, arguments: &[&str]) -> bool {
    Command::new(program).args(arguments).stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|s| s.success())
}

impl Engine {
    fn start(mut command: Command, port: u16) -> Self {
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("the engine starts");
        let addr = SocketAddr::from(([127, 0, 0, 1], port));
        let end = Instant::now() + Duration::from_secs(30);
        while TcpStream::connect(addr).is_err() {
            assert!(Instant::now() < end, "the engine does not listen");
            std::thread::sleep(Duration::from_millis(20));
        }
        Self { child: Some(child), addr }
    }

    /// An S3 server with an empty bucket `photos`, in memory; none where moto is not installed.
    ///
    /// # Panics
    /// It does not start.
    #[must_use]
    pub fn s3() -> Option<Self> {
        let there = is_there("python3", &["-c", "import moto.server"]).then_some(());
        Need::S3.or_skip(there.ok_or("pip install 'moto[server]'"))?;
        let port = free_port();
        let mut command = Command::new("python3");
        // the program itself: a script around it would be ended in its place
        command.args(["-m", "moto.server", "-H", "127.0.0.1", "-p", &port.to_string()]);
        let engine = Self::start(command, port);
        let mut stream = TcpStream::connect(engine.addr).expect("the engine listens");
        let request = format!("PUT /photos HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\ncontent-length: 0\r\nconnection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).expect("a request");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("an answer");
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
        Some(engine)
    }

    /// Variables by which programs find an S3 server at `addr`.
    #[must_use]
    pub fn s3_variables(addr: SocketAddr) -> [(&'static str, String); 4] {
        [
            ("AWS_ENDPOINT_URL", format!("http://{addr}")),
            ("AWS_ACCESS_KEY_ID", "test".into()),
            ("AWS_SECRET_ACCESS_KEY", "test".into()),
            ("AWS_REGION", "us-east-1".into()),
        ]
    }

    /// An Azure server with an empty container `photos`, in memory; none where azurite is not installed.
    ///
    /// # Panics
    /// It does not start.
    #[must_use]
    pub fn azure() -> Option<Self> {
        let there = is_there("azurite-blob", &["--version"]).then_some(());
        Need::Azure.or_skip(there.ok_or("npm install azurite, and its azurite-blob in the PATH"))?;
        let port = free_port();
        let mut command = Command::new("azurite-blob");
        command.args([
            "--inMemoryPersistence",
            "--silent",
            "--skipApiVersionCheck",
            "--blobHost",
            "127.0.0.1",
            "--blobPort",
            &port.to_string(),
        ]);
        let engine = Self::start(command, port);
        let mut stream = TcpStream::connect(engine.addr).expect("the engine listens");
        let target = format!("/{AZURE_ACCOUNT}/photos?restype=container&{AZURE_LEAVE}");
        let request = format!("PUT {target} HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\ncontent-length: 0\r\nconnection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).expect("a request");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("an answer");
        assert!(answer.starts_with("HTTP/1.1 201"), "{answer}");
        Some(engine)
    }

    /// Ends it without a chance to put anything right.
    pub fn kill(&mut self) {
        if let Some(mut child) = self.child.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        self.kill();
    }
}
