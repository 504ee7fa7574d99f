//! `tmpi live publish` and `tmpi live watch`: the program as a client of a room.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, bail};
use futures_util::{SinkExt as _, StreamExt as _};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{self, Message};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async_with_config};

use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::wire::{Hello, Video};
use tmpi_core::live::{MAX_MESSAGE, Model, VERSION, read, write};
use tmpi_live::units::{Splitter, Unit, codec};
use tmpi_live::video::{self, JPEG};

use super::result;

/// Send frames into a room: a folder of JPEG files, a file of H.264, or whatever ffmpeg reads H.264 from
#[derive(Clone, Debug, clap::Args)]
pub(super) struct PublishArgs {
    /// Folder of JPEG files, which are sent in the order of their names; a stream of H.264 (.h264); or what `ffmpeg -i` takes, of which the
    /// video is passed on as it is
    #[arg(value_name = "FOLDER|FILE|URL")]
    source: String,
    /// The room's address
    #[arg(long, default_value = "http://127.0.0.1:8080/live/room", value_name = "URL")]
    room: String,
    /// Token for the room
    #[arg(long, value_name = "TOKEN")]
    token: Option<String>,
    /// Frames a second of files
    #[arg(long, default_value_t = 30.0, value_name = "N")]
    rate: f64,
    /// Begin again at the end, so many times
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..), value_name = "N")]
    times: u32,
    /// Horizontal field of view of the camera in degrees
    #[arg(long, value_name = "DEG")]
    fov_x: Option<f64>,
}

/// Watch a room: print what comes, and keep it
#[derive(Clone, Debug, clap::Args)]
pub(super) struct WatchArgs {
    /// The room's address
    #[arg(default_value = "http://127.0.0.1:8080/live/room", value_name = "URL")]
    room: String,
    /// Token for the room
    #[arg(long, value_name = "TOKEN")]
    token: Option<String>,
    /// End after so many seconds
    #[arg(long, value_name = "S")]
    seconds: Option<f64>,
    /// Write every message to this file, each after its length in four bytes, little endian
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// A line of JSON each second
    #[arg(long)]
    json: bool,
}

type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

/// Connects to a room by the address of its page or of the room itself.
async fn connect(room: &str, what: &str, token: Option<&str>) -> anyhow::Result<Socket> {
    let (host, path) = room.strip_prefix("http://").and_then(|r| r.split_once('/')).context("a room's address is http://HOST/live/ROOM")?;
    let name = path.trim_end_matches('/').rsplit('/').next().unwrap_or_default();
    let token = token.map_or(String::new(), |t| format!("?token={t}"));
    let mut config = WebSocketConfig::default();
    config.max_message_size = Some(MAX_MESSAGE);
    config.max_frame_size = Some(MAX_MESSAGE);
    match connect_async_with_config(format!("ws://{host}/v1/live/{name}/{what}{token}"), Some(config), true).await {
        Ok((socket, _)) => Ok(socket),
        Err(tungstenite::Error::Http(answer)) => {
            let body = answer.body().as_deref().map(String::from_utf8_lossy).unwrap_or_default().into_owned();
            bail!("the server answers {}: {body}", answer.status())
        }
        Err(error) => Err(error).context("connecting to the room"),
    }
}

fn micros() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_micros() as u64)
}

/// Frames of a file, a folder or a program.
enum Source {
    /// Files of a folder, and the next of them.
    Folder(Vec<PathBuf>, usize),
    /// Units that were read, and the next of them.
    Units(Vec<Unit>, usize),
    /// Units that come when they come.
    Program(tokio::sync::mpsc::Receiver<anyhow::Result<Unit>>, Child),
}

impl Source {
    fn open(source: &str) -> anyhow::Result<Self> {
        let path = Path::new(source);
        if path.is_dir() {
            let mut files: Vec<PathBuf> = std::fs::read_dir(path)?.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>()?;
            files.retain(|f| f.extension().is_some_and(|e| e.eq_ignore_ascii_case("jpg") || e.eq_ignore_ascii_case("jpeg")));
            files.sort();
            if files.is_empty() {
                bail!("{source} holds no JPEG file");
            }
            return Ok(Self::Folder(files, 0));
        }
        if path.extension().is_some_and(|e| e == "h264" || e == "264") {
            let mut splitter = Splitter::default();
            let mut units = Vec::new();
            for piece in std::fs::read(path).with_context(|| source.to_owned())?.chunks(1 << 16) {
                units.extend(splitter.push(piece)?);
            }
            units.extend(splitter.finish());
            return Ok(Self::Units(units, 0));
        }
        let mut command = Command::new("ffmpeg");
        command.args(["-loglevel", "error", "-re", "-i", source, "-an", "-c:v", "copy", "-bsf:v", "h264_mp4toannexb", "-f", "h264", "-"]);
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().context("starting ffmpeg")?;
        let mut out = child.stdout.take().context("ffmpeg has no output")?;
        let (give, units) = tokio::sync::mpsc::channel(2);
        std::thread::spawn(move || {
            let (mut splitter, mut buffer) = (Splitter::default(), vec![0; 1 << 16]);
            loop {
                let read = std::io::Read::read(&mut out, &mut buffer);
                let split = match read {
                    Ok(0) => break,
                    Ok(n) => splitter.push(&buffer[..n]).map_err(anyhow::Error::from),
                    Err(error) => Err(error.into()),
                };
                let (units, failed) = match split {
                    Ok(units) => (units, None),
                    Err(error) => (Vec::new(), Some(error)),
                };
                for unit in units.into_iter().map(Ok).chain(failed.map(Err)) {
                    let ends = unit.is_err();
                    if give.blocking_send(unit).is_err() || ends {
                        return;
                    }
                }
            }
            if let Some(unit) = splitter.finish() {
                // nobody may want it any more
                let _ = give.blocking_send(Ok(unit));
            }
        });
        Ok(Self::Program(units, child))
    }

    /// The next frame; none at the end.
    async fn next(&mut self) -> anyhow::Result<Option<Unit>> {
        match self {
            Self::Folder(files, at) => {
                let Some(file) = files.get(*at) else { return Ok(None) };
                *at += 1;
                let data = tokio::fs::read(file).await.with_context(|| file.display().to_string())?;
                Ok(Some(Unit { data, key: true }))
            }
            Self::Units(units, at) => {
                *at += 1;
                Ok(units.get(*at - 1).cloned())
            }
            Self::Program(units, _) => units.recv().await.transpose(),
        }
    }

    fn begin_again(&mut self) {
        if let Self::Folder(_, at) | Self::Units(_, at) = self {
            *at = 0;
        }
    }
}

impl Drop for Source {
    fn drop(&mut self) {
        if let Self::Program(_, child) = self {
            // it may have ended by itself
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// What is said of a source, by its first frame.
fn hello(source: &Source, first: &Unit, fov_x: Option<f64>) -> anyhow::Result<Hello> {
    let codec = match source {
        Source::Folder(..) => JPEG.to_owned(),
        _ => codec(&first.data).context("the stream does not begin with a key frame")?,
    };
    let (width, height) = video::size(&codec, &first.data)?;
    Ok(Hello { version: VERSION, codec, width, height, fov_x: fov_x.unwrap_or(0.0), ..Hello::default() })
}

/// Publishes until the source ends.
pub(super) fn publish(args: &PublishArgs) -> anyhow::Result<()> {
    if !(args.rate > 0.0 && args.rate <= 1000.0) {
        return Err(super::Usage("--rate: more than 0 and up to 1000 frames a second".into()).into());
    }
    tokio::runtime::Builder::new_current_thread().enable_all().build()?.block_on(publishing(args))
}

async fn publishing(args: &PublishArgs) -> anyhow::Result<()> {
    let mut source = Source::open(&args.source)?;
    let mut next = source.next().await?;
    let first = next.as_ref().context("there is no frame")?;
    let hello = hello(&source, first, args.fov_x)?;
    let live = matches!(source, Source::Program(..));
    let mut socket = connect(&args.room, "publish", args.token.as_deref()).await?;
    socket.send(Message::Binary(write(Kind::Hello(hello)))).await?;
    let pause = Duration::from_secs_f64(1.0 / args.rate);
    let (start, mut due) = (Instant::now(), tokio::time::Instant::now());
    let (mut number, mut bytes, mut credit, mut left_out, mut times, mut waits_for_key) = (0u64, 0u64, 0u32, 0u64, args.times, false);
    while let Some(unit) = next {
        tokio::select! {
            biased;
            came = socket.next() => {
                match came {
                    Some(Ok(Message::Binary(message))) => match read(message)? {
                        Kind::Credit(c) => credit += c.frames,
                        Kind::Bye(bye) => bail!("the server says: {}", bye.reason),
                        _ => {}
                    },
                    Some(Ok(Message::Ping(_) | Message::Pong(_))) => {}
                    Some(Err(error)) => return Err(error).context("the connection broke"),
                    _ => bail!("the server has closed the room"),
                }
                next = Some(unit);
                continue;
            }
            () = tokio::time::sleep_until(due), if !live => {}
            () = std::future::ready(()), if live => {}
        }
        due += pause;
        // the newest wins: what there is no credit for is left out, and what refers to it
        waits_for_key |= credit == 0;
        if credit > 0 && (!waits_for_key || unit.key) {
            (credit, waits_for_key) = (credit - 1, false);
            bytes += unit.data.len() as u64;
            let video = Video { frame: number, time: micros(), key: unit.key, layer: 0, data: unit.data.into() };
            socket.send(Message::Binary(write(Kind::Video(video)))).await?;
            number += 1;
        } else {
            left_out += 1;
        }
        next = source.next().await?;
        if next.is_none() && times > 1 {
            times -= 1;
            source.begin_again();
            next = source.next().await?;
        }
    }
    // what is under way comes back as credit
    let _ = tokio::time::timeout(Duration::from_secs(2), socket.next()).await;
    socket.close(None).await?;
    let seconds = start.elapsed().as_secs_f64();
    result(&format!("{number} frames in {seconds:.1} s, {left_out} left out, {:.0} kbit/s", bytes as f64 * 8e-3 / seconds))
}

/// What came within a second.
#[derive(Clone, Debug, Default, serde::Serialize)]
struct Second {
    frames: u64,
    video_bytes: u64,
    geometry_bytes: u64,
    tiles: u64,
    /// Milliseconds from a frame's time until it was here, the longest; it is the publisher's clock.
    latency_ms: f64,
    /// Of the server.
    viewers: u32,
    skipped: u64,
    geometry_ms: f64,
    tiles_left_out: f64,
}

/// Watches until the room ends, or the time is over.
pub(super) fn watch(args: &WatchArgs) -> anyhow::Result<()> {
    tokio::runtime::Builder::new_current_thread().enable_all().build()?.block_on(watching(args))
}

async fn watching(args: &WatchArgs) -> anyhow::Result<()> {
    let mut record =
        args.record.as_ref().map(|file| std::fs::File::create(file).with_context(|| file.display().to_string())).transpose()?;
    let mut socket = connect(&args.room, "subscribe", args.token.as_deref()).await?;
    let end = args.seconds.map(|s| tokio::time::Instant::now() + Duration::from_secs_f64(s.clamp(0.0, 1e9)));
    let mut second = Second::default();
    let mut model: Option<Model> = None;
    loop {
        let over = async {
            match end {
                Some(end) => tokio::time::sleep_until(end).await,
                None => std::future::pending().await,
            }
        };
        let came = tokio::select! {
            came = socket.next() => came,
            () = over => return Ok(()),
        };
        let bytes = match came {
            Some(Ok(Message::Binary(bytes))) => bytes,
            Some(Ok(Message::Ping(_) | Message::Pong(_))) => continue,
            Some(Err(error)) => return Err(error).context("the connection broke"),
            _ => return Ok(()),
        };
        if let Some(file) = &mut record {
            file.write_all(&(bytes.len() as u32).to_le_bytes()).and_then(|()| file.write_all(&bytes))?;
        }
        let length = bytes.len() as u64;
        match read(bytes)? {
            Kind::Hello(hello) => {
                eprintln!("tmpi live watch: {}×{}, {}, epoch {}", hello.width, hello.height, hello.codec, hello.epoch);
                model = Some(Model::new(&hello)?);
            }
            Kind::Video(video) => {
                second.frames += 1;
                second.video_bytes += length;
                second.latency_ms = second.latency_ms.max((micros() as f64 - video.time as f64) / 1e3);
            }
            Kind::Geometry(g) | Kind::Snapshot(g) => {
                second.geometry_bytes += length;
                second.tiles += model.as_mut().context("tiles before HELLO")?.take(&g)?.len() as u64;
            }
            Kind::Statistics(s) => {
                (second.viewers, second.skipped, second.geometry_ms) = (s.viewers, s.skipped, s.geometry_ms);
                second.tiles_left_out = s.tiles_left_out as f64 / s.tiles.max(1) as f64;
                result(&if args.json { serde_json::to_string(&second)? } else { second.line() })?;
                second = Second::default();
            }
            Kind::Bye(bye) => {
                eprintln!("tmpi live watch: the server says: {}", bye.reason);
                return Ok(());
            }
            _ => {}
        }
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
