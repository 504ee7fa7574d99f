//! `tmpi live watch`.

use std::io::Write as _;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use bytes::Bytes;
use futures_util::StreamExt as _;
use tokio::time::{sleep_until, timeout};
use tokio_tungstenite::tungstenite::Message;

use tmpi_core::live::schema::bye::Cause;
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::schema::{self, Hello, Video};
use tmpi_core::live::{FrameTiming, Layers, TileState, read};
use tmpi_core::{Camera, Photo, Pose};
use tmpi_live::video::{self, Decoder};
use tmpi_render::{Cpu, PictureFormat, Renderer as _, encode};

use super::live_client::{Addresses, Socket, micros};
use super::render::pose;
use super::{files, result};

/// Silence after which the server counts as lost: it sends something every second.
const SILENCE: Duration = Duration::from_secs(3);

/// Watch a room: print statistics, and optionally record or render it
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
    /// Render the view from --pose into this folder, as numbered PNG files
    #[arg(long, value_name = "DIR")]
    render: Option<PathBuf>,
    /// Position and direction of the camera, as for `render`
    #[arg(long, requires = "render", value_parser = pose, allow_hyphen_values = true, default_value = "0,0,0", value_name = "TX,TY,TZ[,YAW,PITCH,ROLL]")]
    pose: Pose,
    /// Render every Nth frame
    #[arg(long, requires = "render", value_parser = clap::value_parser!(u64).range(1..), default_value_t = 30, value_name = "N")]
    every: u64,
    /// Print a line of JSON each second
    #[arg(long)]
    json: bool,
}

/// Statistics of one second.
#[derive(Clone, Debug, Default, serde::Serialize)]
struct Second {
    frames: u64,
    video_bytes: u64,
    geometry_bytes: u64,
    tiles: u64,
    /// Rendered views.
    drawn: u64,
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
    let record = args.record.as_ref().map(|file| std::fs::File::create(file).with_context(|| file.display().to_string())).transpose()?;
    let end = args.seconds.map(|s| Instant::now() + Duration::from_secs_f64(s.clamp(0.0, 1e9)));
    let (begun, second) = (Instant::now(), Second::default());
    let mut watcher = Watcher { args, end: end.map(Into::into), record, begun, second, frames: 0, told: String::new() };
    let mut addresses = Addresses::new(&args.room, args.token.as_deref());
    // set once a connection has succeeded: since when no frame has come, and why
    let mut lost: Option<(Instant, End)> = None;
    loop {
        watcher.begun = Instant::now();
        let (before, ended) = match (addresses.connect("subscribe").await, &lost) {
            (Ok(socket), _) => (watcher.frames, watcher.watch(socket).await?),
            // an error on the first attempt is final
            (Err(unreached), None) => return Err(unreached.error),
            (Err(unreached), Some((since, end))) => {
                // the publisher may come back at another node
                let over = matches!(end, End::Gone(_)) && !addresses.are_several() || since.elapsed() > COME_BACK;
                if unreached.nobody && over {
                    return Ok(());
                }
                if since.elapsed() > PATIENCE {
                    return Err(unreached.error);
                }
                if watcher.waits(AGAIN).await {
                    continue;
                }
                return Ok(());
            }
        };
        if ended == End::Over {
            return Ok(());
        }
        lost = Some((lost.filter(|_| watcher.frames == before).map_or_else(Instant::now, |(since, _)| since), ended));
        addresses.go_on();
        if !watcher.waits(ended.pause()).await {
            return Ok(());
        }
    }
}

/// Pause before it connects again: after the connection broke, after the publisher has gone, and after the room was full.
const AGAIN: Duration = Duration::from_millis(100);
const AFTER_PUBLISHER: Duration = Duration::from_secs(1);
const AFTER_FULL: Duration = Duration::from_secs(5);
/// How long it waits for a publisher, and for a server that does not answer.
const COME_BACK: Duration = Duration::from_secs(10);
const PATIENCE: Duration = Duration::from_secs(30);

/// How watching at one URL ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    /// For good.
    Over,
    /// The server gave a cause and allows coming back.
    Gone(Cause),
    /// The connection broke.
    Lost,
}

impl End {
    /// Pause before the next connection.
    const fn pause(self) -> Duration {
        match self {
            Self::Gone(Cause::Left | Cause::Rejected) => AFTER_PUBLISHER,
            Self::Gone(Cause::Full) => AFTER_FULL,
            _ => AGAIN,
        }
    }
}

struct Watcher<'a> {
    args: &'a WatchArgs,
    end: Option<tokio::time::Instant>,
    record: Option<std::fs::File>,
    begun: Instant,
    second: Second,
    /// Frames in total.
    frames: u64,
    /// The last reason that the server gave for ending, so that it is printed once.
    told: String,
}

impl Watcher<'_> {
    /// Completes when `--seconds` are over.
    async fn over(&self) {
        match self.end {
            Some(end) => sleep_until(end).await,
            None => std::future::pending().await,
        }
    }

    /// Waits for `pause`; false if `--seconds` are over first.
    async fn waits(&self, pause: Duration) -> bool {
        timeout(pause, self.over()).await.is_err()
    }

    async fn watch(&mut self, mut socket: Socket) -> anyhow::Result<End> {
        let (mut shown, mut waits): (Option<Shown>, bool) = (None, true);
        loop {
            let came = tokio::select! {
                came = timeout(SILENCE, socket.next()) => came,
                () = self.over() => return Ok(End::Over),
            };
            let bytes = match came {
                Ok(Some(Ok(Message::Binary(bytes)))) => bytes,
                Ok(Some(Ok(Message::Ping(_) | Message::Pong(_)))) => continue,
                Ok(Some(Err(error))) => {
                    eprintln!("tmpi live watch: the connection broke: {error}");
                    return Ok(End::Lost);
                }
                Ok(_) => return Ok(End::Lost),
                Err(_) => {
                    eprintln!("tmpi live watch: nothing came for {} s", SILENCE.as_secs());
                    return Ok(End::Lost);
                }
            };
            if let Some(file) = &mut self.record {
                file.write_all(&(bytes.len() as u32).to_le_bytes()).and_then(|()| file.write_all(&bytes))?;
            }
            if let Some(end) = self.take(bytes, &mut shown, &mut waits)? {
                return Ok(end);
            }
        }
    }

    /// Handles a message; returns how watching ends if it does.
    fn take(&mut self, bytes: Bytes, shown: &mut Option<Shown>, waits: &mut bool) -> anyhow::Result<Option<End>> {
        let (length, second, args) = (bytes.len() as u64, &mut self.second, self.args);
        match read(bytes)? {
            Kind::Hello(hello) => {
                eprintln!("tmpi live watch: {}×{}, {}, epoch {}", hello.width, hello.height, hello.codec, hello.epoch);
                *shown = Some(Shown::new(&hello, args.render.is_some())?);
                self.told.clear();
            }
            Kind::Video(video) => {
                self.frames += 1;
                second.frames += 1;
                second.video_bytes += length;
                let shown = shown.as_mut().context("a frame before HELLO")?;
                let drawn = shown.frame(&video, args)?;
                second.drawn += u64::from(drawn);
                second.latency_ms = second.latency_ms.max((micros() as f64 - video.time as f64) / 1e3);
            }
            Kind::Geometry(g) | Kind::Snapshot(g) => {
                second.geometry_bytes += length;
                let shown = shown.as_mut().context("tiles before HELLO")?;
                let (count, drawn) = shown.tiles(&g, args)?;
                second.tiles += count as u64;
                second.drawn += u64::from(drawn);
                if *waits && shown.model.geometry().is_some() {
                    *waits = false;
                    eprintln!("tmpi live watch: the first tiles after {:.0} ms", self.begun.elapsed().as_secs_f64() * 1e3);
                }
            }
            Kind::Statistics(s) => {
                (second.viewers, second.skipped, second.geometry_ms) = (s.viewers, s.skipped, s.geometry_ms);
                second.tiles_left_out = s.tiles_left_out as f64 / s.tiles.max(1) as f64;
                result(&if args.json { serde_json::to_string(&second)? } else { second.line() })?;
                *second = Second::default();
            }
            Kind::Bye(bye) => {
                if self.told != bye.reason {
                    eprintln!("tmpi live watch: the server says: {}", bye.reason);
                }
                let end = if bye.again { End::Gone(bye.cause()) } else { End::Over };
                self.told = bye.reason;
                return Ok(Some(end));
            }
            _ => {}
        }
        Ok(None)
    }
}

/// The state of a room, and its pictures with `--render`.
struct Shown {
    model: TileState,
    /// With `--render`.
    pictures: Option<Pictures>,
}

struct Pictures {
    decoder: Box<dyn Decoder>,
    layers: Layers,
    renderer: Cpu,
    /// The newest frame, with its number and timestamp, until its tiles or the next frame come.
    waits: Option<(u64, Duration, Photo)>,
    /// Timestamp of the shown frame.
    shown: Duration,
    /// Tiles that came since the shown frame.
    changed: Vec<u32>,
    /// The newest frame of these tiles.
    tiles_of: Option<u64>,
}

impl Shown {
    fn new(hello: &Hello, draws: bool) -> anyhow::Result<Self> {
        let decoder = || video::decoder(&hello.codec, (hello.width, hello.height));
        let (layers, renderer) = (Layers::with_memory(), Cpu::default());
        let of = |decoder| Pictures { decoder, layers, renderer, waits: None, shown: Duration::ZERO, changed: Vec::new(), tiles_of: None };
        Ok(Self { model: TileState::new(hello)?, pictures: draws.then(decoder).transpose()?.map(of) })
    }

    /// Takes a frame. Shows the previous frame without its tiles if they have not come; true if that frame was rendered.
    fn frame(&mut self, video: &Video, args: &WatchArgs) -> anyhow::Result<bool> {
        let drawn = self.settle(args)?;
        if let Some(pictures) = &mut self.pictures {
            // the next key frame repairs a damaged one
            let decoded = pictures.decoder.decode(&video.data).ok().flatten();
            pictures.waits = decoded.map(|photo| (video.frame, Duration::from_micros(video.time), photo));
        }
        Ok(drawn)
    }

    /// Takes tiles; returns how many changed, and whether their frame was rendered.
    fn tiles(&mut self, tiles: &schema::Geometry, args: &WatchArgs) -> anyhow::Result<(usize, bool)> {
        let changed = self.model.take(tiles)?;
        let count = changed.len();
        let Some(pictures) = &mut self.pictures else { return Ok((count, false)) };
        pictures.changed.extend(changed);
        pictures.tiles_of = pictures.tiles_of.max(Some(tiles.frame));
        let of_it = pictures.waits.as_ref().is_some_and(|(frame, ..)| tiles.frame >= *frame);
        Ok((count, of_it && self.settle(args)?))
    }

    /// Shows the waiting frame, as the page does, and renders it if `--every` selects it; true if it was rendered.
    fn settle(&mut self, args: &WatchArgs) -> anyhow::Result<bool> {
        let (Some(pictures), Some(folder)) = (&mut self.pictures, &args.render) else { return Ok(false) };
        let Some(geometry) = self.model.geometry() else { return Ok(false) };
        let Some((frame, at, photo)) = pictures.waits.take() else { return Ok(false) };
        let Photo { width, height, .. } = photo;
        let changed = std::mem::take(&mut pictures.changed);
        let elapsed = Some(at.saturating_sub(std::mem::replace(&mut pictures.shown, at)));
        let when = FrameTiming { frame, tiles: pictures.tiles_of.take(), elapsed };
        pictures.layers.update(geometry, |t| changed.contains(&t), photo, when);
        if !frame.is_multiple_of(args.every) {
            return Ok(false);
        }
        let scene = pictures.layers.scene(geometry);
        let camera = Camera { pose: args.pose, intrinsics: geometry.intrinsics, width, height };
        let view = pictures.renderer.render(&Arc::new(scene), &camera)?;
        files::write(&folder.join(format!("{frame:06}.png")), &encode(&view, PictureFormat::Png, 0)?)?;
        Ok(true)
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
