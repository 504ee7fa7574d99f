//! `tmpi make DIR --watch` as a program: started, stopped and started again.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{ChildStdout, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tmpi_testing::program::Killed;

use crate::fixture::Folder;

/// The longest wait for a line.
const PATIENCE: Duration = Duration::from_mins(2);

/// A program that follows the folder `in`.
struct Follower {
    child: Killed,
    lines: Receiver<String>,
}

impl Follower {
    fn start(folder: &Folder) -> Self {
        let mut command = folder.command();
        command.args(["make", "in", "-o", "out", "--watch", "--json"]).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = Killed(command.spawn().unwrap());
        let (send, lines) = channel();
        let read = move |out: ChildStdout| BufReader::new(out).lines().map_while(Result::ok).try_for_each(|line| send.send(line));
        let out = child.0.stdout.take().unwrap();
        std::thread::spawn(move || read(out));
        Self { child, lines }
    }

    /// The next photo that is made, and its depth map.
    fn made(&self) -> [String; 2] {
        let line: Value = serde_json::from_str(&self.lines.recv_timeout(PATIENCE).unwrap()).unwrap();
        ["photo", "depth"].map(|name| line[name].as_str().unwrap_or_default().to_owned())
    }

    /// Sends SIGTERM; the exit code, the photos made since the last call of `made`, and standard error.
    fn stop(mut self) -> (Option<i32>, usize, String) {
        kill_process(Pid::from_child(&self.child.0), Signal::TERM).unwrap();
        let err = std::io::read_to_string(self.child.0.stderr.take().unwrap()).unwrap();
        (self.child.0.wait().unwrap().code(), self.lines.iter().count(), err)
    }
}

fn pair(folder: &Folder, name: &str) -> [String; 2] {
    let [photo, map] = [format!("in/{name}.png"), format!("in/{name}_depth.png")];
    std::fs::copy(folder.path("box.png"), folder.path(&photo)).unwrap();
    std::fs::copy(folder.path("depth.png"), folder.path(&map)).unwrap();
    [photo, map]
}

fn bytes(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap()
}

#[test]
fn a_followed_folder_is_made_as_it_fills_and_no_photo_twice_after_a_restart() {
    let f = Folder::new();
    std::fs::create_dir(f.path("in")).unwrap();
    f.write("in/broken.jpg", b"no JPEG");
    f.write("in/x.heic", b"unread");
    let there = pair(&f, "a");
    let first = Follower::start(&f);
    assert_eq!(first.made(), there);
    let appeared = pair(&f, "sub");
    assert_eq!(first.made(), appeared);
    let (code, more, err) = first.stop();
    assert_eq!((code, more), (Some(0), 0), "{err}");
    assert!(err.contains("in/broken.jpg") && err.contains("1 .heic left out"), "{err}");
    let before = bytes(&f.path("out/a.tmpi"));
    assert!(!f.path("out/broken.tmpi").exists());

    let second = Follower::start(&f);
    let later = pair(&f, "b");
    assert_eq!(second.made(), later, "what was made before is left");
    let (code, more, err) = second.stop();
    assert_eq!((code, more), (Some(0), 0), "{err}");
    assert!(bytes(&f.path("out/a.tmpi")) == before);
}

#[test]
fn following_needs_one_folder_and_no_flag_about_one_photo() {
    let f = Folder::new();
    std::fs::create_dir(f.path("in")).unwrap();
    let watch = |args: &[&str]| f.run(&[&["make", "-o", "out", "--watch"], args].concat());
    watch(&["in", "in"]).fails(2, &["one folder"]);
    watch(&["box.png"]).fails(2, &["box.png", "folder"]);
    for more in [&["--depth", "depth.png"][..], &["--second", "box.png"], &["--report", "r.json"], &["--force"]] {
        watch(&[&["in"], more].concat()).fails(2, &["--watch", more[0]]);
    }
    f.run(&["make", "in", "-o", "box.png", "--watch"]).fails(2, &["--output box.png", "file"]);
}
