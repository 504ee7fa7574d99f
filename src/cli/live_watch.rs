//! `tmpi live watch`.

use std::io::Write as _;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use bytes::Bytes;
use futures_util::StreamExt as _;
use tokio::time::timeout;

use tmpi_core::live::schema::Bye;
use tmpi_core::live::schema::bye::Cause;
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::{TileState, read};

use super::live_client::{AGAIN, Addresses, SessionEnd, Socket, Unreached, micros, received};
use super::result;

/// Silence after which the server counts as lost: it sends something every second.
const SILENCE: Duration = Duration::from_secs(3);
/// Pause before connecting again after the publisher has gone, and after the room was full.
const AFTER_PUBLISHER: Duration = Duration::from_secs(1);
const AFTER_FULL: Duration = Duration::from_secs(5);

/// Watch a room: print statistics, and optionally record it
#[derive(Clone, Debug, clap::Args)]
pub(super) struct WatchArgs {
    /// URL of the room; several, separated by commas, if nodes share it: when one fails, the client goes on to the next
    #[arg(value_delimiter = ',', default_value = "http://127.0.0.1:8080/live/room", value_name = "URL[,URL…]")]
    room: Vec<String>,
    /// Token for the room
    #[arg(long, value_name = "TOKEN")]
    token: Option<String>,
    /// Stop after this many seconds
    #[arg(long, value_name = "S")]
    seconds: Option<f64>,
    /// Write every message to this file, each preceded by its length in four bytes, little endian
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Print a line of JSON each second
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Debug, Default, serde::Serialize)]
struct Second {
    frames: u64,
    video_bytes: u64,
    geometry_bytes: u64,
    tiles: u64,
    /// Longest time from a frame's timestamp, by the publisher's clock, to its arrival.
    latency_ms: f64,
    /// From here on: reported by the server.
    viewers: u32,
    skipped: u64,
    geometry_ms: f64,
    tiles_left_out: f64,
}

/// Watches until the room ends or `--seconds` are over.
pub(super) fn watch(args: &WatchArgs) -> anyhow::Result<()> {
    tokio::runtime::Builder::new_current_thread().enable_all().build()?.block_on(watching(args))
}

async fn watching(args: &WatchArgs) -> anyhow::Result<()> {
    let mut watcher = Watcher { args, record: None, second: Second::default(), frames: 0 };
    let mut addresses = Addresses::new(&args.room, args.token.as_deref());
    let sessions = addresses.sessions("subscribe", async |socket| watcher.watch(socket).await);
    let ended = match args.seconds {
        Some(seconds) => timeout(Duration::from_secs_f64(seconds.clamp(0.0, 1e9)), sessions).await.unwrap_or(Ok(())),
        None => sessions.await,
    };
    match ended {
        // the publisher has gone
        Err(Unreached { no_publisher: true, .. }) if watcher.frames > 0 => Ok(()),
        ended => ended.map_err(|unreached| unreached.error),
    }
}

struct Watcher<'a> {
    args: &'a WatchArgs,
    /// The recording, created by the first message: a room without a publisher must not empty an earlier one.
    record: Option<std::fs::File>,
    second: Second,
    frames: u64,
}

impl Watcher<'_> {
    async fn watch(&mut self, mut socket: Socket) -> anyhow::Result<Option<SessionEnd>> {
        let (mut model, mut begun, before) = (None, Some(Instant::now()), self.frames);
        let (error, again) = loop {
            let Ok(came) = timeout(SILENCE, socket.next()).await else {
                break (anyhow::anyhow!("nothing came for {} s", SILENCE.as_secs()), Some(AGAIN));
            };
            let bytes = match received(came) {
                Ok(Some(bytes)) => bytes,
                Ok(None) => continue,
                Err(error) => break (error, Some(AGAIN)),
            };
            if let Some(path) = self.args.record.as_ref().filter(|_| self.record.is_none()) {
                self.record = Some(std::fs::File::create(path).with_context(|| path.display().to_string())?);
            }
            if let Some(file) = &mut self.record {
                file.write_all(&(bytes.len() as u32).to_le_bytes()).and_then(|()| file.write_all(&bytes))?;
            }
            if let Some(bye) = self.take(bytes, &mut model, &mut begun)? {
                let pause = match bye.cause() {
                    Cause::Left | Cause::Rejected => AFTER_PUBLISHER,
                    Cause::Full => AFTER_FULL,
                    _ => AGAIN,
                };
                break (anyhow::anyhow!("the server says: {}", bye.reason), bye.again.then_some(pause));
            }
        };
        Ok(Some(SessionEnd { error, again, progress: self.frames > before }))
    }

    /// Handles a message; returns the server's farewell. `begun` is the start of the session until the first tiles come.
    fn take(&mut self, bytes: Bytes, model: &mut Option<TileState>, begun: &mut Option<Instant>) -> anyhow::Result<Option<Bye>> {
        let (length, second, args) = (bytes.len() as u64, &mut self.second, self.args);
        match read(bytes)? {
            Kind::Hello(hello) => {
                eprintln!("tmpi live watch: {}×{}, {}, epoch {}", hello.width, hello.height, hello.codec, hello.epoch);
                *model = Some(TileState::new(&hello)?);
            }
            Kind::Video(video) => {
                self.frames += 1;
                second.frames += 1;
                second.video_bytes += length;
                second.latency_ms = second.latency_ms.max((micros() as f64 - video.time as f64) / 1e3);
            }
            Kind::Geometry(g) | Kind::Snapshot(g) => {
                second.geometry_bytes += length;
                let model = model.as_mut().context("tiles before HELLO")?;
                second.tiles += model.take(&g)?.len() as u64;
                if let Some(begun) = begun.take_if(|_| model.geometry().is_some()) {
                    eprintln!("tmpi live watch: the first tiles after {:.0} ms", begun.elapsed().as_secs_f64() * 1e3);
                }
            }
            Kind::Statistics(s) => {
                (second.viewers, second.skipped, second.geometry_ms) = (s.viewers, s.skipped, s.geometry_ms);
                second.tiles_left_out = s.tiles_left_out as f64 / s.tiles.max(1) as f64;
                result(&if args.json { serde_json::to_string(&second)? } else { second.line() })?;
                *second = Second::default();
            }
            Kind::Bye(bye) => return Ok(Some(bye)),
            _ => {}
        }
        Ok(None)
    }
}

impl Second {
    fn line(&self) -> String {
        format!(
            "{} frames, {:.0} kbit/s of video, {:.0} of geometry, {} tiles, {:.0} % of all left out, latency {:.0} ms, geometry {:.0} ms, {} watch, {} skipped",
            self.frames,
            self.video_bytes as f64 * 8e-3,
            self.geometry_bytes as f64 * 8e-3,
            self.tiles,
            100.0 * self.tiles_left_out,
            self.latency_ms,
            self.geometry_ms,
            self.viewers,
            self.skipped
        )
    }
}
