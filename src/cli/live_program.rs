//! Runs the program whose H.264 `tmpi live publish` passes on.

use std::collections::VecDeque;
use std::io::{BufRead as _, BufReader, Read as _};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use anyhow::{Context as _, bail};
use tokio::sync::Notify;

use tmpi_live::access_units::{Splitter, Unit};

/// Most units that wait to be sent; a live source then drops the older ones.
const WAITING: usize = 4;
/// Prefixes of live sources, which run on even if unread, and whether ffmpeg reads them at their own pace.
const LIVE: [(&str, bool); 10] = [
    ("rtsp://", true),
    ("rtsps://", true),
    ("rtmp://", true),
    ("rtmps://", true),
    ("srt://", true),
    ("rtp://", true),
    ("udp://", true),
    ("/dev/", true),
    // may be a file
    ("http://", false),
    ("https://", false),
];

/// Whether a source runs on even if unread.
pub(super) fn is_live(source: &str) -> bool {
    LIVE.iter().any(|(start, _)| source.starts_with(start))
}

/// Whether a source sets its own pace.
pub(super) fn is_paced(source: &str) -> bool {
    LIVE.iter().any(|&(start, paced)| paced && source.starts_with(start))
}

/// A running program.
pub(super) struct Program {
    child: Child,
    name: String,
    units: Arc<Units>,
    /// Returns the last line of standard error.
    complaints: Option<JoinHandle<String>>,
}

/// The queue between the thread that reads units and the task that sends them.
#[derive(Default)]
struct Units {
    queue: Mutex<Queue>,
    /// Wakes the sender.
    filled: Notify,
    /// Wakes the reader if the source is not live.
    emptied: Condvar,
}

#[derive(Default)]
struct Queue {
    units: VecDeque<Unit>,
    /// A unit was dropped to which the next units may refer.
    waits_for_key: bool,
    left_out: u64,
    /// The program's output has ended, or the receiver has gone.
    end: Option<anyhow::Result<()>>,
}

impl Queue {
    /// Queues a unit of a live source. When the queue is full, it drops all units, and new ones up to the next key frame.
    fn push_newest(&mut self, unit: Unit) {
        if self.units.len() >= WAITING {
            self.left_out += self.units.len() as u64;
            self.units.clear();
            self.waits_for_key = true;
        }
        self.waits_for_key &= !unit.key;
        if self.waits_for_key {
            self.left_out += 1;
        } else {
            self.units.push_back(unit);
        }
    }
}

impl Units {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Queues a unit; false if the receiver has gone.
    fn push(&self, unit: Unit, live: bool) -> bool {
        let mut queue = self.lock();
        if live {
            queue.push_newest(unit);
        } else {
            let full = |q: &mut Queue| q.units.len() >= WAITING && q.end.is_none();
            queue = self.emptied.wait_while(queue, full).unwrap_or_else(PoisonError::into_inner);
            queue.units.push_back(unit);
        }
        self.filled.notify_one();
        queue.end.is_none()
    }

    fn end(&self, end: anyhow::Result<()>) {
        self.lock().end.get_or_insert(end);
        self.filled.notify_one();
        self.emptied.notify_one();
    }

    /// The next unit; `None` at the end.
    async fn next(&self) -> anyhow::Result<Option<Unit>> {
        loop {
            {
                let mut queue = self.lock();
                if let Some(unit) = queue.units.pop_front() {
                    self.emptied.notify_one();
                    return Ok(Some(unit));
                }
                if let Some(end) = &mut queue.end {
                    return std::mem::replace(end, Ok(())).map(|()| None);
                }
            }
            self.filled.notified().await;
        }
    }
}

impl Program {
    /// Starts a program; if it is `live`, units that are not taken in time are dropped.
    ///
    /// # Errors
    /// The program cannot be started.
    pub(super) fn start(command: &mut Command, live: bool) -> anyhow::Result<Self> {
        let name = command.get_program().to_string_lossy().into_owned();
        let piped = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = piped.spawn().with_context(|| format!("starting {name}"))?;
        let out = child.stdout.take().context("a program without output")?;
        let complaints = child.stderr.take().map(|lines| {
            std::thread::spawn(move || {
                let mut last = String::new();
                // read on past invalid UTF-8: a full pipe would block the program
                for line in BufReader::new(lines).split(b'\n').map_while(Result::ok) {
                    let line = String::from_utf8_lossy(&line).trim().to_owned();
                    eprintln!("{line}");
                    last = if line.is_empty() { last } else { line };
                }
                last
            })
        });
        let units = Arc::new(Units::default());
        let to = Arc::clone(&units);
        std::thread::spawn(move || to.end(read(out, &to, live)));
        Ok(Self { child, name, units, complaints })
    }

    /// The next unit; `None` at the end.
    ///
    /// # Errors
    /// The program failed, or its output is not H.264.
    pub(super) async fn next(&mut self) -> anyhow::Result<Option<Unit>> {
        let unit = self.units.next().await?;
        if unit.is_none() {
            // its output has ended, so the program ends
            let status = self.child.wait()?;
            let last = self.complaints.take().and_then(|lines| lines.join().ok()).unwrap_or_default();
            if !status.success() {
                bail!("{} has failed ({status}): {last}", self.name);
            }
        }
        Ok(unit)
    }

    /// Units that were dropped in favour of newer ones.
    pub(super) fn left_out(&self) -> u64 {
        self.units.lock().left_out
    }
}

/// Reads units until the output ends or the receiver has gone.
fn read(mut out: ChildStdout, to: &Units, live: bool) -> anyhow::Result<()> {
    let (mut splitter, mut buffer) = (Splitter::default(), vec![0; 1 << 16]);
    loop {
        let n = out.read(&mut buffer)?;
        if n == 0 {
            break;
        }
        for unit in splitter.push(&buffer[..n])? {
            if !to.push(unit, live) {
                return Ok(());
            }
        }
    }
    if let Some(unit) = splitter.finish() {
        to.push(unit, live);
    }
    Ok(())
}

impl Drop for Program {
    fn drop(&mut self) {
        self.units.end(Ok(()));
        // it may have ended already
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unit(n: u8, key: bool) -> Unit {
        Unit { data: vec![n], key }
    }

    #[test]
    fn a_live_source_drops_frames_up_to_the_next_key_frame() {
        let mut queue = Queue::default();
        let waiting = |queue: &Queue| queue.units.iter().map(|u| u.data[0]).collect::<Vec<_>>();
        (0..4).for_each(|n| queue.push_newest(unit(n, n == 0)));
        assert_eq!((waiting(&queue), queue.left_out), (vec![0, 1, 2, 3], 0), "so many may wait");
        queue.push_newest(unit(4, false));
        queue.push_newest(unit(5, false));
        assert_eq!((waiting(&queue), queue.left_out), (vec![], 6));
        (6..10).for_each(|n| queue.push_newest(unit(n, n == 6)));
        assert_eq!((waiting(&queue), queue.left_out), (vec![6, 7, 8, 9], 6));
        queue.push_newest(unit(10, true));
        assert_eq!((waiting(&queue), queue.left_out), (vec![10], 10));
    }

    #[test]
    fn live_sources_and_their_pace_are_recognised() {
        assert!(is_live("rtsp://camera/1") && is_paced("rtsp://camera/1"));
        assert!(is_live("http://camera/1") && !is_paced("http://camera/1"));
        assert!(!is_live("film.mp4") && !is_paced("film.mp4"));
    }

    #[cfg(unix)]
    #[tokio::test]
    async fn a_failed_program_is_an_error_with_its_last_output_after_its_last_frame() {
        let run = |script: &str| Program::start(Command::new("sh").args(["-c", script]), false).unwrap();
        let key = r"printf '\000\000\001\145\210\007\007'";
        let mut failing = run(&format!("{key}; echo first >&2; echo no route to the camera >&2; exit 3"));
        assert!(failing.next().await.unwrap().is_some_and(|u| u.key));
        let error = failing.next().await.unwrap_err().to_string();
        assert!(error.contains("no route to the camera") && error.contains('3'), "{error}");
        let mut good = run(key);
        assert!(good.next().await.unwrap().is_some());
        assert!(good.next().await.unwrap().is_none());
    }
}
