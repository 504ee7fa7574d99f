//! Runs the program whose H.264 `tmpi live publish` passes on.

use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::{Context as _, bail};
use tokio::io::{AsyncRead, AsyncReadExt as _};
use tokio::process::{Child, Command};
use tokio::sync::mpsc;

use tmpi_live::access_units::{Splitter, Unit};

/// Most units that wait to be sent.
const WAITING: usize = 4;

type Units = mpsc::Receiver<anyhow::Result<Unit>>;

/// A running program, which ends when this is dropped.
pub(super) struct Program {
    command: Command,
    /// The source runs on even if unread: units for which there is no room are dropped.
    live: bool,
    child: Child,
    units: Units,
    left_out: Arc<AtomicU64>,
}

impl Program {
    /// Starts a program; if it is `live`, units that are not taken in time are dropped.
    pub(super) fn start(mut command: Command, live: bool) -> anyhow::Result<Self> {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).kill_on_drop(true);
        let left_out = Arc::default();
        let (child, units) = spawn(&mut command, live, &left_out)?;
        Ok(Self { command, live, child, units, left_out })
    }

    pub(super) fn begin_again(&mut self) -> anyhow::Result<()> {
        (self.child, self.units) = spawn(&mut self.command, self.live, &self.left_out)?;
        Ok(())
    }

    /// The next unit; `None` at the end. Cancel safe.
    ///
    /// # Errors
    /// The program failed, or its output is not H.264.
    pub(super) async fn next(&mut self) -> anyhow::Result<Option<Unit>> {
        if let Some(unit) = self.units.recv().await {
            return unit.map(Some);
        }
        // its output has ended, so the program ends
        let status = self.child.wait().await?;
        if !status.success() {
            bail!("{} has failed ({status})", self.command.as_std().get_program().display());
        }
        Ok(None)
    }

    /// Units for which there was no room, and those that may refer to them.
    pub(super) fn left_out(&self) -> u64 {
        self.left_out.load(Ordering::Relaxed)
    }
}

fn spawn(command: &mut Command, live: bool, left_out: &Arc<AtomicU64>) -> anyhow::Result<(Child, Units)> {
    let mut child = command.spawn().with_context(|| format!("starting {}", command.as_std().get_program().display()))?;
    let out = child.stdout.take().context("a program without output")?;
    let ((to, units), left_out) = (mpsc::channel(WAITING), Arc::clone(left_out));
    tokio::spawn(async move {
        if let Err(error) = read(out, &to, live.then_some(&*left_out)).await {
            // the receiver may have gone
            let _ = to.send(Err(error)).await;
        }
    });
    Ok((child, units))
}

/// Reads units until the output ends or the receiver has gone. With `left_out` it does not wait for room but drops units, and then those up to
/// the next key frame, which may refer to them; it counts them there.
async fn read(
    mut out: impl AsyncRead + Unpin,
    to: &mpsc::Sender<anyhow::Result<Unit>>,
    left_out: Option<&AtomicU64>,
) -> anyhow::Result<()> {
    let (mut splitter, mut buffer, mut waits_for_key) = (Splitter::default(), vec![0; 1 << 16], false);
    loop {
        let n = out.read(&mut buffer).await?;
        let units = if n > 0 { splitter.push(&buffer[..n])? } else { std::mem::take(&mut splitter).finish().into_iter().collect() };
        for unit in units {
            if let Some(left_out) = left_out {
                waits_for_key = (waits_for_key && !unit.key) || to.try_send(Ok(unit)).is_err();
                left_out.fetch_add(u64::from(waits_for_key), Ordering::Relaxed);
            } else if to.send(Ok(unit)).await.is_err() {
                return Ok(());
            }
        }
        if n == 0 {
            return Ok(());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::io::AsyncWriteExt as _;
    use tokio::time::sleep;

    use super::*;

    #[tokio::test]
    async fn a_live_source_drops_frames_up_to_the_next_key_frame() {
        let (mut program, out) = tokio::io::duplex(1 << 16);
        let ((to, mut units), left_out) = (mpsc::channel(WAITING), Arc::new(AtomicU64::new(0)));
        let counted = Arc::clone(&left_out);
        let reader = tokio::spawn(async move { read(out, &to, Some(&*counted)).await });
        let mut write = async |numbers: std::ops::Range<u8>, keys: &[u8]| {
            let unit = |n: u8| [0, 0, 1, if keys.contains(&n) { 0x65 } else { 0x41 }, 0x88, n];
            program.write_all(&numbers.flat_map(unit).collect::<Vec<u8>>()).await.unwrap();
            sleep(Duration::from_millis(50)).await;
        };
        write(1..8, &[1]).await;
        let mut got = Vec::new();
        while let Ok(unit) = units.try_recv() {
            got.extend(unit.unwrap().data.last().copied());
        }
        assert_eq!(got, [1, 2, 3, 4], "so many may wait");
        write(8..11, &[9]).await;
        drop(program);
        reader.await.unwrap().unwrap();
        while let Some(unit) = units.recv().await {
            got.extend(unit.unwrap().data.last().copied());
        }
        assert_eq!((&got[4..], left_out.load(Ordering::Relaxed)), (&[9, 10][..], 4));
    }

    #[cfg(unix)]
    #[tokio::test]
    async fn a_failed_program_is_an_error_after_its_last_frame_and_one_that_ended_can_begin_again() {
        let run = |script: &str| {
            let mut command = Command::new("sh");
            command.args(["-c", script]);
            Program::start(command, false).unwrap()
        };
        let key = r"printf '\000\000\001\145\210\007\007'";
        let mut failing = run(&format!("{key}; exit 3"));
        assert!(failing.next().await.unwrap().is_some_and(|u| u.key));
        let error = failing.next().await.unwrap_err().to_string();
        assert!(error.contains("sh has failed") && error.contains('3'), "{error}");
        let mut good = run(key);
        for _ in 0..2 {
            assert!(good.next().await.unwrap().is_some() && good.next().await.unwrap().is_none());
            good.begin_again().unwrap();
        }
    }
}
