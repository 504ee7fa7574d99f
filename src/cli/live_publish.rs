//! `tmpi live publish`.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::{Context as _, bail};
use bytes::Bytes;
use futures_util::{SinkExt as _, StreamExt as _};
use tokio::time::{Instant, sleep, timeout_at};
use tokio_tungstenite::tungstenite::Message;

use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::wire::{Depth, Hello, Video};
use tmpi_core::live::{VERSION, read, write};
use tmpi_live::depth;
use tmpi_live::units::{Splitter, Unit, codec};
use tmpi_live::video::{self, JPEG};
use tmpi_pipeline::depth::{self as maps, DepthKind};

use super::live_client::{Addresses, Socket, Unreached, micros};
use super::result;

/// Time for which a frame waits for the server's leave to send it, before it is left out.
const PATIENCE: Duration = Duration::from_millis(250);
/// Time by which frames of files may follow each other too fast, to catch up.
const CATCH_UP: Duration = Duration::from_millis(100);
/// Pause before a lost connection is tried again, and how often.
const AGAIN: Duration = Duration::from_millis(500);
const TRIES: u32 = 60;

/// Send frames into a room: a folder of JPEG files, a file of H.264, or whatever ffmpeg reads H.264 from
#[derive(Clone, Debug, clap::Args)]
pub(super) struct PublishArgs {
    /// Folder of JPEG files, which are sent in the order of their names, with the depth of a PNG of the same name if there is one; a stream of H.264 (.h264); or what `ffmpeg -i` takes, of which the
    /// video is passed on as it is
    #[arg(value_name = "FOLDER|FILE|URL")]
    source: String,
    /// The room's address; several, separated by commas, where nodes share it: a lost one is left for the next
    #[arg(long, visible_alias = "to", value_delimiter = ',', default_value = "http://127.0.0.1:8080/live/room", value_name = "URL[,URL…]")]
    room: Vec<String>,
    /// Token for the room
    #[arg(long, value_name = "TOKEN")]
    token: Option<String>,
    /// Frames a second of files
    #[arg(long, default_value_t = 30.0, value_name = "N")]
    rate: f64,
    /// Begin again at the end, so many times
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..), value_name = "N")]
    times: u32,
    /// What 16-bit PNG files beside the frames hold, whose depth is then taken from them
    #[arg(long, value_enum, default_value_t, value_name = "KIND")]
    depth_kind: DepthKind,
    /// Horizontal field of view of the camera in degrees
    #[arg(long, value_name = "DEG")]
    fov_x: Option<f64>,
}

/// What is sent of a frame.
#[derive(Clone)]
struct Frame {
    data: Bytes,
    key: bool,
    depth: Option<Bytes>,
}

/// Frames of a file, a folder or a program.
enum Source {
    /// Files of a folder, the next of them, and what depth maps beside them hold.
    Folder(Vec<PathBuf>, usize, DepthKind),
    /// Units that were read, and the next of them.
    Units(Vec<Unit>, usize),
    /// Units that come when they come.
    Program(tokio::sync::mpsc::Receiver<anyhow::Result<Unit>>, Child),
}

impl Source {
    /// # Errors
    /// There is no such file, or no frame in it.
    fn open(source: &str, depth: DepthKind) -> anyhow::Result<Self> {
        let path = Path::new(source);
        if path.is_dir() {
            let mut files: Vec<PathBuf> = std::fs::read_dir(path)?.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>()?;
            files.retain(|f| f.extension().is_some_and(|e| e.eq_ignore_ascii_case("jpg") || e.eq_ignore_ascii_case("jpeg")));
            files.sort();
            if files.is_empty() {
                bail!("{source} holds no JPEG file");
            }
            return Ok(Self::Folder(files, 0, depth));
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
    async fn next(&mut self) -> anyhow::Result<Option<Frame>> {
        let unit = match self {
            Self::Folder(files, at, kind) => {
                let Some(file) = files.get(*at) else { return Ok(None) };
                *at += 1;
                let data = tokio::fs::read(file).await.with_context(|| file.display().to_string())?;
                let map = file.with_extension("png");
                let depth = map.is_file().then(|| measured(&map, *kind, &data)).transpose()?;
                return Ok(Some(Frame { data: data.into(), key: true, depth }));
            }
            Self::Units(units, at) => {
                *at += 1;
                units.get(*at - 1).cloned()
            }
            Self::Program(units, _) => units.recv().await.transpose()?,
        };
        Ok(unit.map(|unit| Frame { data: unit.data.into(), key: unit.key, depth: None }))
    }

    fn begin_again(&mut self) {
        if let Self::Folder(_, at, _) | Self::Units(_, at) = self {
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

/// Packs the depth map that lies beside a frame.
fn measured(file: &Path, kind: DepthKind, frame: &[u8]) -> anyhow::Result<Bytes> {
    let name = || file.display().to_string();
    let (width, height) = video::size(JPEG, frame)?;
    let limits = tmpi_pipeline::photo::Limits::default();
    let (map, _) = maps::from_map(&std::fs::read(file).with_context(name)?, kind, &limits, width, height).with_context(name)?;
    Ok(depth::pack(&map)?.into())
}

/// What is said of a source, by its first frame.
fn hello(source: &Source, first: &Frame, fov_x: Option<f64>) -> anyhow::Result<Hello> {
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
    let mut source = Source::open(&args.source, args.depth_kind)?;
    let first = source.next().await?.context("there is no frame")?;
    let hello = hello(&source, &first, args.fov_x)?;
    let start = Instant::now();
    let mut sender = Sender {
        source,
        next: Some(first),
        times: args.times,
        due: start,
        pause: Duration::from_secs_f64(1.0 / args.rate),
        sent: Sent::default(),
    };
    let (mut tries, mut addresses) = (0, Addresses::new(&args.room, args.token.as_deref()));
    loop {
        let before = sender.sent.frames;
        let ended = match addresses.connect("publish").await {
            Ok(socket) => sender.send(socket, &hello).await,
            // what was wrong from the start is no lost connection
            Err(Unreached { error, .. }) if before == 0 => return Err(error),
            Err(Unreached { error, .. }) => Err(End::Lost(error)),
        };
        match ended {
            Ok(()) => break,
            Err(End::Refused(error)) => return Err(error),
            Err(End::Lost(error)) => {
                tries = if sender.sent.frames > before { 1 } else { tries + 1 };
                if tries > TRIES {
                    return Err(error);
                }
                eprintln!("tmpi live publish: {error:#}; again");
                addresses.go_on();
                // another node may be asked at once, but not all of them in turn without end
                if !addresses.are_several() || tries > 1 {
                    sleep(AGAIN).await;
                }
            }
        }
    }
    let (seconds, Sent { frames, bytes, left_out }) = (start.elapsed().as_secs_f64(), sender.sent);
    result(&format!("{frames} frames in {seconds:.1} s, {left_out} left out, {:.0} kbit/s", bytes as f64 * 8e-3 / seconds))
}

/// Why a room is no longer published in.
enum End {
    /// The server says that there is no use in coming back, or the source failed.
    Refused(anyhow::Error),
    /// The connection has broken, or the server stops.
    Lost(anyhow::Error),
}

#[derive(Clone, Copy, Default)]
struct Sent {
    frames: u64,
    bytes: u64,
    left_out: u64,
}

struct Sender {
    source: Source,
    next: Option<Frame>,
    times: u32,
    due: Instant,
    pause: Duration,
    sent: Sent,
}

impl Sender {
    /// Sends frames until there is none left.
    async fn send(&mut self, mut socket: Socket, hello: &Hello) -> Result<(), End> {
        let lost = |e: tokio_tungstenite::tungstenite::Error| End::Lost(anyhow::Error::from(e).context("the connection broke"));
        socket.send(Message::Binary(write(Kind::Hello(hello.clone())))).await.map_err(lost)?;
        let live = matches!(self.source, Source::Program(..));
        let (mut number, mut credit, mut waits_for_key) = (0u64, 0u32, true);
        while let Some(frame) = self.next.clone() {
            if !live {
                listen(&mut socket, &mut credit, self.due, false).await?;
                self.due = (self.due + self.pause).max(Instant::now().checked_sub(CATCH_UP).unwrap_or(self.due));
            }
            if credit == 0 && (frame.key || !waits_for_key) {
                listen(&mut socket, &mut credit, Instant::now() + PATIENCE, true).await?;
            }
            // the newest wins: what there is no leave for is left out, and what refers to it
            waits_for_key |= credit == 0;
            if credit > 0 && (!waits_for_key || frame.key) {
                (credit, waits_for_key) = (credit - 1, false);
                self.sent.bytes += frame.data.len() as u64;
                let depth = frame.depth.map(|data| Kind::Depth(Depth { frame: number, data }));
                let video = Kind::Video(Video { frame: number, time: micros(), key: frame.key, layer: 0, data: frame.data });
                for kind in depth.into_iter().chain([video]) {
                    socket.send(Message::Binary(write(kind))).await.map_err(lost)?;
                }
                number += 1;
                self.sent.frames += 1;
            } else {
                self.sent.left_out += 1;
            }
            self.advance().await.map_err(End::Refused)?;
        }
        // what is under way comes back as credit; the source is at its end whatever becomes of the rest
        let _ = listen(&mut socket, &mut credit, Instant::now() + PATIENCE, false).await;
        let _ = socket.close(None).await;
        Ok(())
    }

    async fn advance(&mut self) -> anyhow::Result<()> {
        self.next = self.source.next().await?;
        if self.next.is_none() && self.times > 1 {
            self.times -= 1;
            self.source.begin_again();
            self.next = self.source.next().await?;
        }
        Ok(())
    }
}

/// Takes what the server says until then, or `or_credit` until it lets a frame be sent.
async fn listen(socket: &mut Socket, credit: &mut u32, until: Instant, or_credit: bool) -> Result<(), End> {
    loop {
        let Ok(came) = timeout_at(until, socket.next()).await else { return Ok(()) };
        let message = match came {
            Some(Ok(Message::Binary(message))) => message,
            Some(Ok(Message::Ping(_) | Message::Pong(_))) => continue,
            Some(Err(error)) => return Err(End::Lost(anyhow::Error::from(error).context("the connection broke"))),
            _ => return Err(End::Lost(anyhow::anyhow!("the server has closed the connection"))),
        };
        match read(message).map_err(|e| End::Refused(e.into()))? {
            Kind::Credit(c) => *credit = credit.saturating_add(c.frames),
            Kind::Bye(bye) => {
                let error = anyhow::anyhow!("the server says: {}", bye.reason);
                return Err(if bye.again { End::Lost(error) } else { End::Refused(error) });
            }
            _ => {}
        }
        if or_credit && *credit > 0 {
            return Ok(());
        }
    }
}
