//! `tmpi serve` as a process, and the processes that make its photos.

use std::io::Write;
use std::process::{Child, Command, Stdio};

#[cfg(unix)]
use rustix::process::{Pid, Signal, kill_process};
use tmpi_testing::program::Killed;

use crate::prelude::*;

pub struct Process {
    pub child: Killed,
    pub addr: SocketAddr,
    pub log: tempfile::NamedTempFile,
}

impl Process {
    pub fn start(data: &Path) -> Self {
        Self::start_with(data, &["--set", "limits.drain=5"])
    }

    pub fn start_with(data: &Path, arguments: &[&str]) -> Self {
        Self::start_at(0, data, arguments, &[])
    }

    /// At a given port, with these environment variables.
    pub fn start_at(port: u16, data: &Path, arguments: &[&str], environment: &[(&str, &str)]) -> Self {
        // a file, because a full pipe would block the server
        let log = tempfile::NamedTempFile::new().unwrap();
        let child = Command::new(env!("CARGO_BIN_EXE_tmpi"))
            .args(["serve", "--addr", &format!("127.0.0.1:{port}"), "--depth-model", "tmpi"])
            .args(arguments)
            .arg("--data")
            .arg(data)
            .envs(environment.iter().copied())
            .stdout(Stdio::piped())
            .stderr(log.reopen().unwrap())
            .spawn()
            .unwrap();
        Self::listening(child, log)
    }

    /// A process that writes its address and then its log.
    pub fn listening(child: Child, log: tempfile::NamedTempFile) -> Self {
        let mut child = Killed(child);
        let line = child.first_line();
        let addr = line.strip_prefix("http://").and_then(|a| a.parse().ok());
        let addr = addr.unwrap_or_else(|| panic!("the first line of standard output is the address: {line:?}"));
        Self { child, addr, log }
    }

    /// Kills the server without a chance to clean up.
    pub fn crash(&mut self) {
        self.child.0.kill().unwrap();
        self.child.0.wait().unwrap();
    }

    /// Its process that makes photos.
    #[cfg(target_os = "linux")]
    pub fn maker(&self) -> Option<i32> {
        self.child_process(false)
    }

    /// Stops its process that writes files until the guard is dropped.
    #[cfg(target_os = "linux")]
    pub fn hold_writer(&self) -> Held {
        self.held(true)
    }

    #[cfg(target_os = "linux")]
    fn held(&self, gives_way: bool) -> Held {
        wait_until("there is such a process", || self.child_process(gives_way).is_some());
        let held = Held(self.child_process(gives_way).unwrap());
        held.signal(Signal::STOP);
        held
    }

    /// A child process of the server: one that runs at low priority and writes files, or one that makes photos.
    #[cfg(target_os = "linux")]
    fn child_process(&self, gives_way: bool) -> Option<i32> {
        let ours = |pid: &str| {
            let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
            let mut rest = stat.rsplit_once(')')?.1.split_whitespace().skip(1);
            (rest.next()?.parse::<u32>().ok()? == self.child.0.id()).then(|| pid.parse().ok())?
        };
        let way = |pid: &i32| {
            let variables = std::fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
            String::from_utf8_lossy(&variables).contains("TMPI_MAKES_PHOTOS=gives-way") == gives_way
        };
        std::fs::read_dir("/proc").unwrap().find_map(|e| ours(e.ok()?.file_name().to_str()?).filter(way))
    }

    /// Its log so far.
    pub fn logged(&self) -> String {
        std::fs::read_to_string(self.log.path()).unwrap()
    }

    /// Stops the process that makes photos until the guard is dropped, so that no photo is made meanwhile.
    #[cfg(target_os = "linux")]
    pub fn hold(&self) -> Held {
        self.held(false)
    }

    /// Waits until the server is sending a photo larger than a pipe to the stopped process.
    #[cfg(target_os = "linux")]
    pub fn wait_for_photo(&self) {
        let tasks = format!("/proc/{}/task", self.child.0.id());
        let sends =
            |task: std::fs::DirEntry| std::fs::read_to_string(task.path().join("comm")).is_ok_and(|name| name.trim() == "tmpi-sends");
        wait_until("the photo is being sent", || std::fs::read_dir(&tasks).unwrap().flatten().any(sends));
    }

    #[cfg(unix)]
    pub fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child.0), signal).unwrap();
    }

    #[cfg(unix)]
    pub fn terminate(mut self) -> (std::process::ExitStatus, String) {
        self.signal(Signal::TERM);
        let status = self.child.0.wait().unwrap();
        (status, self.logged())
    }
}

/// A stopped process that makes photos.
#[cfg(target_os = "linux")]
pub struct Held(pub i32);

#[cfg(target_os = "linux")]
impl Held {
    pub fn signal(&self, signal: Signal) {
        // an error if the process has ended
        let _ = kill_process(Pid::from_raw(self.0).unwrap(), signal);
    }

    /// A value of `/proc` in bytes: the first word after `name` times `unit`.
    pub fn figure(&self, file: &str, name: &str, unit: u64) -> Option<u64> {
        let text = std::fs::read_to_string(format!("/proc/{}/{file}", self.0)).ok()?;
        let line = text.lines().find_map(|l| l.strip_prefix(name))?;
        Some(line.split_whitespace().next()?.parse::<u64>().ok()? * unit)
    }

    /// Bounds its memory from now on, in bytes.
    pub fn bound_data(&self, bytes: u64) {
        let limit = rustix::process::Rlimit { current: Some(bytes), maximum: Some(bytes) };
        rustix::process::prlimit(Pid::from_raw(self.0), rustix::process::Resource::Data, limit).unwrap();
    }

    pub fn has_ended(&self) -> bool {
        !Path::new(&format!("/proc/{}", self.0)).exists()
    }
}

#[cfg(target_os = "linux")]
impl Drop for Held {
    fn drop(&mut self) {
        self.signal(Signal::CONT);
    }
}

/// A picture that takes a while to make.
pub fn large(seed: u32) -> Vec<u8> {
    sized(seed, 480, 360)
}

/// Uploads a photo with its own depth map, so that no network is needed; `None` if the server has gone.
pub fn upload(addr: SocketAddr, photo: &[u8]) -> Option<String> {
    let (content_type, body) = form(&[("photo", photo), ("depth", &depth_map())]);
    std::net::TcpStream::connect(addr).ok()?;
    let mut connection = std::panic::catch_unwind(|| Connection::open(addr)).ok()?;
    let head =
        format!("POST /v1/photos HTTP/1.1\r\nhost: localhost\r\ncontent-type: {content_type}\r\ncontent-length: {}\r\n\r\n", body.len());
    connection.raw().write_all(head.as_bytes()).ok()?;
    connection.raw().write_all(&body).ok()?;
    Some(id(&connection.receive("POST").ok()?.is(202).json()))
}

/// A picture that takes a while to make and does not fit into a pipe.
pub fn slow(seed: u32) -> Vec<u8> {
    sized(seed, 1200, 900)
}

/// A picture whose files are not written by the process that serves.
pub fn heavy(seed: u32) -> Vec<u8> {
    sized(seed, 2000, 1500)
}

pub fn sized(seed: u32, width: u32, height: u32) -> Vec<u8> {
    let at = |x: u32, y: u32| [(x * 7 + seed) as u8, (y * 5) as u8, ((x / 32) * (y / 32) * 9 + seed) as u8, 255];
    let rgba = (0..height).flat_map(|y| (0..width).map(move |x| at(x, y))).collect();
    encode(&View { width, height, rgba }, PictureFormat::Jpeg, 90).unwrap()
}

pub fn upload_with(addr: SocketAddr, photo: &[u8], options: &[(&str, &[u8])]) -> String {
    let depth = depth_map();
    let (content_type, body) = form(&[&[("photo", photo), ("depth", &depth)], options].concat());
    id(&request(addr, "POST", "/v1/photos", &[("content-type", &content_type)], &body).is(202).json())
}
