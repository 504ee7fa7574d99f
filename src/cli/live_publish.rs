//! `tmpi live publish`.

use std::time::Duration;

use anyhow::Context as _;
use bytes::Bytes;
use futures_util::{SinkExt as _, StreamExt as _};
use tokio::time::{Instant, timeout, timeout_at};
use tokio_tungstenite::tungstenite::Message;

use tmpi_core::live::schema::bye::Cause;
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::schema::{self as message, Depth, Hello, Video};
use tmpi_core::live::{VERSION, read, write};
use tmpi_live::access_units::codec;
use tmpi_live::video::{self, JPEG, VideoError};
use tmpi_pipeline::depth::DepthKind;

use super::live_client::{AGAIN, Addresses, SessionEnd, Socket, micros, received};
use super::live_input::{InputOptions, Origin, SOUND};
use super::live_rtp::Sound;
use super::live_source::{Frame, Source};
use super::{note, result};

/// How long a frame waits for credit before it is dropped.
const PATIENCE: Duration = Duration::from_millis(250);
/// How far frames of files may be late and still be sent faster than their rate, to catch up.
const CATCH_UP: Duration = Duration::from_millis(100);
/// Silence after which the connection counts as lost: the server sends something every second.
const SILENCE: Duration = Duration::from_secs(4);
const STUCK: Duration = Duration::from_secs(10);

/// Publish frames in a room: a folder of JPEG files, a camera, or anything that ffmpeg reads
#[derive(Clone, Debug, clap::Args)]
pub(super) struct PublishArgs {
    /// Folder of JPEG files, sent in the order of their names, each with the depth of a PNG of the same name if there is one; or any input
    /// of `ffmpeg -i`: H.264 without B-frames is passed on unchanged, other video is re-encoded, sound is sent as Opus
    #[arg(value_name = "FOLDER|FILE|URL", required_unless_present = "camera")]
    source: Option<String>,
    /// A camera of this machine, without sound: a v4l2 device on Linux (default /dev/video0), a number or name of avfoundation on macOS
    /// (default 0), a dshow name on Windows
    #[arg(long, conflicts_with = "source", num_args = 0..=1, default_missing_value = "", value_name = "NAME")]
    camera: Option<String>,
    /// Always re-encode the video
    #[arg(long)]
    transcode: bool,
    /// Leave the sound out
    #[arg(long)]
    no_sound: bool,
    /// URL of the room; several, separated by commas, if nodes share it: when one fails, the client goes on to the next
    #[arg(long, visible_alias = "to", value_delimiter = ',', default_value = "http://127.0.0.1:8080/live/room", value_name = "URL[,URL…]")]
    room: Vec<String>,
    /// Token for the room
    #[arg(long, value_name = "TOKEN")]
    token: Option<String>,
    /// Frame rate of folders and raw H.264 files (.h264)
    #[arg(long, default_value_t = 30.0, value_name = "N")]
    rate: f64,
    /// Play the source this many times
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..), value_name = "N")]
    times: u32,
    /// Meaning of the values in PNG depth maps beside the frames
    #[arg(long, value_enum, default_value_t, value_name = "KIND")]
    depth_kind: DepthKind,
    /// Horizontal field of view of the camera in degrees
    #[arg(long, value_name = "DEG")]
    fov_x: Option<f64>,
}

/// The HELLO message of a source, from its first frame.
fn hello(source: &Source, first: &Frame, fov_x: Option<f64>, sound: bool) -> anyhow::Result<Hello> {
    let codec = match source {
        Source::Folder(..) => JPEG.to_owned(),
        Source::Program(_) => codec(&first.data).context("the stream does not begin with a key frame")?,
    };
    let (width, height) = video::size(&codec, &first.data)?.context("the stream does not state the size of its pictures")?;
    let hello = Hello { version: VERSION, codec, width, height, fov_x: fov_x.unwrap_or(0.0), ..Hello::default() };
    Ok(if sound { Hello { sound: "opus".into(), sound_rate: SOUND.0, sound_channels: SOUND.1, ..hello } } else { hello })
}

pub(super) fn publish(args: &PublishArgs) -> anyhow::Result<()> {
    if !(args.rate > 0.0 && args.rate <= 1000.0) {
        return Err(super::Usage("--rate: more than 0 and up to 1000 frames a second".into()).into());
    }
    tokio::runtime::Builder::new_current_thread().enable_all().build()?.block_on(publishing(args))
}

async fn publishing(args: &PublishArgs) -> anyhow::Result<()> {
    let origin = match (&args.camera, &args.source) {
        (Some(name), _) => Origin::Camera(Some(name.as_str()).filter(|name| !name.is_empty())),
        (None, Some(source)) => Origin::of(source, args.rate),
        (None, None) => return Err(super::Usage("a folder, a file, an address or --camera".into()).into()),
    };
    let mut options = InputOptions { transcode: args.transcode, sound: !args.no_sound };
    let (source, sound, first, hello) = loop {
        let (mut source, sound) = Source::open(origin, args.depth_kind, options).await?;
        let first = source.next().await?.context("the source has no frame")?;
        match hello(&source, &first, args.fov_x, sound.is_some()) {
            // the probe may miss that rooms cannot take the video
            Err(error) if !options.transcode && matches!(error.downcast_ref(), Some(VideoError::Unsupported(_))) => {
                note(&format!("tmpi live publish: re-encoding the video: {error}"));
                options.transcode = true;
            }
            hello => break (source, sound, first, hello?),
        }
    };
    let start = Instant::now();
    let mut sender = Sender {
        source,
        sound,
        next: Some(first),
        times: args.times,
        due: start,
        pause: Duration::from_secs_f64(1.0 / args.rate),
        silence: SILENCE,
        sent: Sent::default(),
    };
    sender.publish(&mut Addresses::new(&args.room, args.token.as_deref()), &hello).await?;
    sender.sent.left_out += sender.source.left_out();
    let (seconds, Sent { frames, bytes, left_out, sounds }) = (start.elapsed().as_secs_f64(), sender.sent);
    let sounds = if sender.sound.is_some() { format!(", {sounds} packets of sound") } else { String::new() };
    result(&format!("{frames} frames in {seconds:.1} s, {left_out} left out, {:.0} kbit/s{sounds}", bytes as f64 * 8e-3 / seconds))
}

/// Why publishing on a connection ended.
enum Failure {
    /// The server does not allow coming back, or the source failed.
    Refused(anyhow::Error),
    /// The connection broke, the server is stopping, or it has not noticed yet that the connection before broke.
    Lost(anyhow::Error),
}

#[derive(Clone, Copy, Default)]
struct Sent {
    frames: u64,
    bytes: u64,
    left_out: u64,
    sounds: u64,
}

struct Sender {
    source: Source,
    sound: Option<Sound>,
    next: Option<Frame>,
    times: u32,
    due: Instant,
    pause: Duration,
    silence: Duration,
    sent: Sent,
}

impl Sender {
    /// Sends frames to the end of the source; reconnects when a connection breaks.
    async fn publish(&mut self, addresses: &mut Addresses<'_>, hello: &Hello) -> anyhow::Result<()> {
        let published = addresses.sessions("publish", async |socket| {
            let before = self.sent.frames;
            match self.send(socket, hello).await {
                Ok(()) => Ok(None),
                Err(Failure::Lost(error)) => Ok(Some(SessionEnd { error, again: Some(AGAIN), progress: self.sent.frames > before })),
                Err(Failure::Refused(error)) => Err(error),
            }
        });
        published.await.map_err(|unreached| unreached.error)
    }

    /// Sends frames to the end of the source over one connection.
    async fn send(&mut self, mut socket: Socket, hello: &Hello) -> Result<(), Failure> {
        send(&mut socket, Kind::Hello(hello.clone())).await?;
        let live = matches!(self.source, Source::Program(_));
        let (mut number, mut waits_for_key) = (0u64, true);
        let mut heard = Heard { credit: 0, at: Instant::now(), silence: self.silence, may_wait: self.sent.frames > 0 };
        if let Some(sound) = &mut self.sound {
            sound.skip();
        }
        while let Some(frame) = self.next.clone() {
            if !live {
                heard.listen(&mut socket, self.due, false).await?;
                self.due = (self.due + self.pause).max(Instant::now().checked_sub(CATCH_UP).unwrap_or(self.due));
            }
            if heard.credit == 0 && (frame.key || !waits_for_key) {
                heard.listen(&mut socket, Instant::now() + PATIENCE, true).await?;
            }
            // without credit, drop the frame and those that refer to it
            waits_for_key |= heard.credit == 0;
            if heard.credit > 0 && (!waits_for_key || frame.key) {
                (heard.credit, waits_for_key) = (heard.credit - 1, false);
                self.sent.bytes += frame.data.len() as u64;
                let depth = frame.depth.map(|data| Kind::Depth(Depth { frame: number, data }));
                let video = Kind::Video(Video { frame: number, time: micros(), key: frame.key, layer: 0, data: frame.data });
                for kind in depth.into_iter().chain([video]) {
                    send(&mut socket, kind).await?;
                }
                number += 1;
                self.sent.frames += 1;
            } else {
                self.sent.left_out += 1;
            }
            self.wait(&mut socket, &mut heard).await?;
        }
        // let frames in flight arrive; errors no longer matter
        let _ = heard.listen(&mut socket, Instant::now() + PATIENCE, false).await;
        // tells viewers not to wait
        let bye = message::Bye { reason: "the source has ended".into(), ..message::Bye::default() };
        let _ = send(&mut socket, Kind::Bye(bye)).await;
        let _ = socket.close(None).await;
        Ok(())
    }

    /// Waits for the next frame. Meanwhile it handles the server's messages and passes on sound.
    async fn wait(&mut self, socket: &mut Socket, heard: &mut Heard) -> Result<(), Failure> {
        loop {
            let Self { source, sound, next, times, .. } = self;
            let (time, data) = tokio::select! {
                biased;
                packet = packet(sound.as_mut()) => packet,
                advanced = advance(source, next, times) => return advanced.map_err(Failure::Refused),
                Err(end) = heard.until_lost(socket) => return Err(end),
            };
            send(socket, Kind::Sound(message::Sound { time, data })).await?;
            self.sent.sounds += 1;
        }
    }
}

/// The next packet of sound; pending for ever without sound.
async fn packet(sound: Option<&mut Sound>) -> (u64, Bytes) {
    match sound {
        Some(sound) => sound.next().await,
        None => std::future::pending().await,
    }
}

/// Advances to the next frame. Cancel safe for sources with sound.
async fn advance(source: &mut Source, next: &mut Option<Frame>, times: &mut u32) -> anyhow::Result<()> {
    *next = source.next().await?;
    if next.is_none() && *times > 1 {
        *times -= 1;
        source.begin_again()?;
        *next = source.next().await?;
    }
    Ok(())
}

async fn send(socket: &mut Socket, kind: Kind) -> Result<(), Failure> {
    match timeout(STUCK, socket.send(Message::Binary(write(kind)))).await {
        Ok(sent) => sent.map_err(|e| Failure::Lost(anyhow::Error::from(e).context("the connection broke"))),
        Err(_) => Err(Failure::Lost(anyhow::anyhow!("nothing could be sent for {} s", STUCK.as_secs()))),
    }
}

struct Heard {
    credit: u32,
    at: Instant,
    silence: Duration,
    /// A taken room may be so by this program's last connection.
    may_wait: bool,
}

impl Heard {
    /// Handles messages until `until`, or, with `or_credit`, until there is credit.
    async fn listen(&mut self, socket: &mut Socket, until: Instant, or_credit: bool) -> Result<(), Failure> {
        loop {
            let Ok(came) = timeout_at(until.min(self.at + self.silence), socket.next()).await else {
                if self.at.elapsed() < self.silence {
                    return Ok(());
                }
                return Err(Failure::Lost(anyhow::anyhow!("the server sent nothing for {:.1} s", self.silence.as_secs_f64())));
            };
            self.at = Instant::now();
            let Some(message) = received(came).map_err(Failure::Lost)? else { continue };
            match read(message).map_err(|e| Failure::Refused(e.into()))? {
                Kind::Credit(c) => self.credit = self.credit.saturating_add(c.frames),
                Kind::Bye(bye) => {
                    let error = anyhow::anyhow!("the server says: {}", bye.reason);
                    let is_lost = bye.again || (self.may_wait && bye.cause() == Cause::Taken);
                    return Err(if is_lost { Failure::Lost(error) } else { Failure::Refused(error) });
                }
                _ => {}
            }
            if or_credit && self.credit > 0 {
                return Ok(());
            }
        }
    }

    async fn until_lost(&mut self, socket: &mut Socket) -> Result<(), Failure> {
        loop {
            self.listen(socket, Instant::now() + self.silence, false).await?;
        }
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::net::Ipv4Addr;
    use std::sync::atomic::{AtomicU32, Ordering};

    use tmpi_core::live::schema::Credit;
    use tokio::net::TcpListener;
    use tokio::process::Command;
    use tokio_tungstenite::accept_async;

    use super::*;
    use crate::cli::live_program::Program;

    /// A server that gives credit and then stays silent on the first connection, says on the next that the room is taken, and on later ones
    /// behaves. `heard` counts the connections, and the key frames of later ones.
    async fn forgetful(listener: TcpListener, heard: &[AtomicU32; 2]) -> anyhow::Result<()> {
        loop {
            let mut socket = accept_async(listener.accept().await?.0).await?;
            let count = heard[0].fetch_add(1, Ordering::Relaxed);
            let silent = count == 0;
            if count == 1 {
                // HELLO
                drop(socket.next().await);
                let bye = message::Bye { reason: "taken".into(), again: false, cause: Cause::Taken.into() };
                socket.send(Message::Binary(write(Kind::Bye(bye)))).await?;
                continue;
            }
            let credit = |frames| Message::Binary(write(Kind::Credit(Credit { frames, ..Credit::default() })));
            socket.send(credit(100_000)).await?;
            loop {
                let message = match timeout(Duration::from_millis(20), socket.next()).await {
                    Ok(Some(Ok(message))) => message,
                    Ok(_) => break,
                    // the client may have gone
                    Err(_) if !silent && socket.send(credit(0)).await.is_err() => break,
                    Err(_) => continue,
                };
                if let Message::Binary(bytes) = message
                    && matches!(read(bytes)?, Kind::Video(video) if video.key && !silent)
                {
                    heard[1].fetch_add(1, Ordering::Relaxed);
                    if socket.send(credit(0)).await.is_err() {
                        break;
                    }
                }
            }
        }
    }

    #[tokio::test]
    async fn a_silent_server_is_reconnected_with_a_key_frame() {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let rooms = [format!("http://{}/live/attic", listener.local_addr().unwrap())];
        // five frames, of which the first is a key frame, about every 25 ms
        let frame = |kind: &str| format!(r"\000\000\001\{kind}\210\007");
        let group = ["145", "101", "101", "101", "101"].map(frame).concat();
        let mut command = Command::new("sh");
        let folder = tempfile::tempdir().unwrap();
        let end = folder.path().join("end");
        let play = format!("printf '{group}'; sleep 0.025");
        command.args(["-c", &format!("{play}; until [ -e '{}' ]; do {play}; done", end.display())]);
        let mut source = Source::Program(Program::start(command, false).unwrap().into());
        let next = source.next().await.unwrap();
        let silence = Duration::from_millis(300);
        let mut sender =
            Sender { source, sound: None, next, times: 10, due: Instant::now(), pause: silence, silence, sent: Sent::default() };
        let heard = [AtomicU32::new(0), AtomicU32::new(0)];
        let (mut addresses, hello) = (Addresses::new(&rooms, None), Hello::default());
        let sent = timeout(Duration::from_mins(1), sender.publish(&mut addresses, &hello));
        let finish = async {
            while heard[1].load(Ordering::Relaxed) == 0 {
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
            std::fs::write(&end, []).unwrap();
            std::future::pending::<()>().await;
        };
        tokio::select! {
            sent = sent => sent.expect("it is left soon").unwrap(),
            () = finish => {}
            failed = forgetful(listener, &heard) => panic!("{failed:?}"),
        }
        let [connections, keys] = heard.map(AtomicU32::into_inner);
        assert!(connections >= 3 && keys > 0, "{connections} connections, {keys} key frames after the first");
        assert!(sender.sent.frames > 0 && sender.times == 1);
        // where it has not published yet, a taken room is final
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let rooms = [format!("http://{}/live/attic", listener.local_addr().unwrap())];
        sender.sent.frames = 0;
        sender.next = Some(Frame { data: Bytes::from_static(&[0, 0, 1, 0x65]), key: true, depth: None });
        let (mut addresses, heard) = (Addresses::new(&rooms, None), [AtomicU32::new(1), AtomicU32::new(0)]);
        tokio::select! {
            sent = sender.publish(&mut addresses, &hello) => assert!(sent.is_err_and(|e| e.to_string().contains("taken"))),
            failed = forgetful(listener, &heard) => panic!("{failed:?}"),
        }
    }
}
