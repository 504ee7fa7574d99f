//! The socket of a publisher: checks its messages, passes them on to viewers, and gives frames to the threads of the room.

use std::error::Error as _;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::ws::{Message, WebSocket};
use bytes::Bytes;
use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until, timeout_at};
use tokio_tungstenite::tungstenite::{self, error::CapacityError};

use tmpi_core::live::schema::bye::Cause;
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::schema::{Bye, Credit, Depth, Hello, Video};
use tmpi_core::live::{MAX_PIXELS, TileState, VERSION, read, write};
use tmpi_live::video::{Decoder, VideoError};
use tmpi_live::{FramePipeline, Settings, access_units, video};
use tmpi_pipeline::Models;

use super::frame_threads::{DecodeOutcome, EncodedFrame, FrameThreads};
use super::origin_lease::{Lease, lost};
use super::request_access::{ENDED, RoomsContext, ended};
use super::ring::MessageKind;
use super::room::Room;
use super::token_bucket::Bucket;
use super::viewer::gone;
use super::{BROKEN, BROKEN_FIRST, CREDIT, FASTEST, HEARTBEAT, PANICS, RoomHandle, SILENCE, disconnect};
use crate::server::since_1970;

/// Allowed sides of a frame, in pixels.
const SIDES: std::ops::RangeInclusive<u32> = 16..=4096;
/// Longest codec string, in bytes.
const CODEC: usize = 64;
/// Changes of the pictures' size a second, and at once: each starts a decoder and two threads.
const RESIZES: (f64, f64) = (1.0, 8.0);
/// Packets of sound a second: four times those of Opus with its usual 20 ms packets.
const PACKETS: f64 = 200.0;
/// Bytes of sound a second, which go to every viewer: the highest bit rate of Opus.
const SOUND: f64 = 65_536.0;
/// Seconds of sound at once: a connection that stalled delivers its packets together.
const BURST: f64 = 3.0;

/// Serves a publisher until it leaves, the server disconnects it, or its token ends at `ends`; then waits for it to come back.
pub async fn serve(mut socket: WebSocket, entry: RoomHandle, here: &RoomsContext, ends: Option<Instant>) {
    let mut seat = None;
    let ended = session(&mut socket, &entry, here, ends, &mut seat).await;
    let held = seat.map(Seat::leave);
    let told = async move {
        if let Err(Refused { reason, again, cause }) = ended {
            tracing::info!(reason, "disconnecting a publisher");
            disconnect(socket, Bye { reason, again, cause: cause.into() }).await;
        }
    };
    let lingers = async move {
        if let Some(lease) = held {
            entry.wait_for_publisher(lease, &here.stop).await;
        }
    };
    // a dead connection must not delay viewers
    tokio::join!(told, lingers);
}

/// Why the server disconnects a publisher.
struct Refused {
    reason: String,
    /// The publisher may come back.
    again: bool,
    cause: Cause,
}

impl Refused {
    fn for_now(reason: impl Into<String>) -> Self {
        Self { reason: reason.into(), again: true, cause: Cause::Other }
    }
}

impl From<String> for Refused {
    fn from(reason: String) -> Self {
        Self { reason, again: false, cause: Cause::Other }
    }
}

impl From<&str> for Refused {
    fn from(reason: &str) -> Self {
        reason.to_owned().into()
    }
}

const BIDIRECTIONAL: &str =
    "the stream has B-frames, which do not come in display order; encode it without: ffmpeg -bf 0, or baseline profile";
const TURNED: &str = "the stream carries a rotation (display orientation); encode it upright: ffmpeg -c:v libx264 -bf 0";

/// Takes `seat` and publishes; `Ok` if the publisher has left.
async fn session<'a>(
    socket: &mut WebSocket,
    entry: &'a RoomHandle,
    here: &RoomsContext,
    ends: Option<Instant>,
    seat: &mut Option<Seat<'a>>,
) -> Result<(), Refused> {
    let (room, rooms) = (&entry.room, &here.rooms);
    let Some(first) = next(socket, Instant::now() + SILENCE).await? else { return Ok(()) };
    let Kind::Hello(hello) = first else { return Err("the first message must be HELLO".into()) };
    // check before taking the room: viewers need not know of a refused publisher
    checked(hello.clone(), room.bounds.budget_ms)?;
    decoder(&hello)?;
    if !room.claim_seat() {
        return Err(Refused { cause: Cause::Taken, .."someone publishes in this room".into() });
    }
    let Seat { lease, .. } = seat.insert(Seat { room, lease: None });
    if let Some(nodes) = rooms.nodes.get() {
        let claimed = nodes.claim(&entry.name).await;
        *lease = Some(claimed.map_err(|error| {
            tracing::warn!(%error, room = entry.name, "cannot claim a room");
            Refused::for_now("the database of rooms cannot be reached")
        })?);
    } else {
        rooms.announce(&entry.name, true).await;
    }
    match published(socket, room, hello, here, Until { lease: lease.as_ref(), ends }).await {
        Ok(Gone::Said) => room.end(gone(Cause::Left)),
        Ok(Gone::Lost) => {}
        // viewers follow the publisher to where it is now
        Ok(Gone::Moved) => return Err("the room's publisher has come to another server".into()),
        Err(refused) => {
            if !refused.again {
                room.end(Bye { reason: refused.reason.clone(), again: true, cause: Cause::Rejected.into() });
            }
            return Err(refused);
        }
    }
    Ok(())
}

fn decoder(hello: &Hello) -> Result<Box<dyn Decoder>, Refused> {
    let decoder = video::decoder(&hello.codec, (hello.width, hello.height));
    decoder.map_err(|error| Refused { cause: Cause::Codec, ..error.to_string().into() })
}

/// Limits of a publisher's right to the room.
struct Until<'a> {
    lease: Option<&'a Lease>,
    ends: Option<Instant>,
}

/// How a publisher has left.
enum Gone {
    Said,
    /// Its connection broke: it may come back.
    Lost,
    /// It, or another publisher, has connected to another node.
    Moved,
}

/// A publisher's epoch: from one change of the pictures' size to the next.
struct Show {
    epoch: u64,
    hello: Hello,
    threads: FrameThreads,
}

impl Show {
    /// Begins an epoch of the room, at least `least`, with the pictures of `hello`. `done` receives the outcome of each frame.
    fn begin(room: &Arc<Room>, hello: Hello, least: u64, models: &Models, done: mpsc::Sender<DecodeOutcome>) -> Result<Self, Refused> {
        let (settings, hello) = checked(hello, room.bounds.budget_ms)?;
        let decoder = decoder(&hello)?;
        let epoch = room.publish(hello.clone(), since_1970().as_micros() as u64, least);
        let models = models.clone();
        let geometry = move || FramePipeline::new(models.clone(), settings.clone());
        let threads =
            FrameThreads::start((Arc::clone(room), epoch), decoder, geometry, done).map_err(|e| format!("starting a thread: {e}"))?;
        Ok(Self { epoch, hello, threads })
    }

    /// The new HELLO if a key frame changes the pictures' size.
    ///
    /// # Errors
    /// The server cannot decode the frame.
    fn resized(&self, data: &[u8]) -> Result<Option<Hello>, String> {
        let Hello { codec, width, height, fov_x, .. } = &self.hello;
        let size = match video::size(codec, data) {
            Ok(Some(size)) if size != (*width, *height) => size,
            Err(VideoError::Unsupported(why)) => return Err(why),
            // the decoder reports unreadable frames
            Ok(_) | Err(_) => return Ok(None),
        };
        let codec = access_units::codec(data).filter(|_| codec.starts_with("avc1.")).unwrap_or_else(|| codec.clone());
        let fov_x = turned(*fov_x, (*width, *height), size);
        Ok(Some(Hello { codec, width: size.0, height: size.1, fov_x, ..self.hello.clone() }))
    }
}

/// Horizontal field of view, in degrees, after a change of the pictures' size: along the longer side it stays the same.
fn turned(fov_x: f64, before: (u32, u32), now: (u32, u32)) -> f64 {
    let [before, now] = [before, now].map(|(width, height)| f64::from(width) / f64::from(width.max(height)));
    if fov_x == 0.0 { fov_x } else { 2.0 * ((fov_x.to_radians() / 2.0).tan() * now / before).atan().to_degrees() }
}

/// Refuses H.264 that browsers' decoders accept but show wrongly.
fn in_order_and_upright(unit: &[u8]) -> Result<(), &'static str> {
    if access_units::is_bidirectional(unit) {
        Err(BIDIRECTIONAL)
    } else if access_units::is_turned(unit) {
        Err(TURNED)
    } else {
        Ok(())
    }
}

/// Handles the messages of a publisher that has the room.
async fn published(socket: &mut WebSocket, room: &Arc<Room>, hello: Hello, here: &RoomsContext, until: Until<'_>) -> Result<Gone, Refused> {
    let RoomsContext { rooms, stop, .. } = here;
    let (done, mut decoded) = mpsc::channel(16);
    // without a lease the clock, so that URLs of groups are not reused after a restart
    let least = until.lease.map_or_else(|| since_1970().as_millis() as u64, Lease::epoch);
    let mut show = Show::begin(room, hello, least, &rooms.models, done.clone())?;
    let mut frames = Frames { most: rooms.bounds.frame, next: None, allowed: 0, due: Instant::now(), broken: 0, seen: false };
    let (mut depth, mut resizes) = (None, Bucket::new(RESIZES.0, RESIZES.1));
    let mut sounds = [PACKETS, SOUND].map(|rate| Bucket::new(rate, BURST * rate));
    let mut heartbeat = interval(HEARTBEAT);
    heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    frames.credit(socket, CREDIT, false).await?;
    let mut silent = Instant::now() + SILENCE;
    loop {
        let message = tokio::select! {
            message = next(socket, silent) => message?,
            Some(outcome) = decoded.recv() => {
                frames.decoded(socket, outcome).await?;
                continue;
            }
            () = room.keys.notified() => {
                frames.credit(socket, 0, true).await?;
                continue;
            }
            // lets the publisher notice a dead connection
            _ = heartbeat.tick() => {
                frames.credit(socket, 0, false).await?;
                continue;
            }
            () = lost(until.lease) => return Ok(Gone::Moved),
            () = ended(until.ends) => return Err(ENDED.into()),
            () = stop.cancelled() => return Err(Refused::for_now("the server stops")),
        };
        let came = Instant::now();
        silent = came + SILENCE;
        match message {
            None => return Ok(Gone::Lost),
            Some(Kind::Bye(_)) => return Ok(Gone::Said),
            Some(Kind::Video(video)) => {
                frames.check(&video)?;
                if video.key
                    && let Some(hello) = show.resized(&video.data)?
                {
                    if !resizes.take(1.0, came) {
                        return Err("pictures change their size more than once a second".into());
                    }
                    // the old threads finish their frames and report them
                    show = Show::begin(room, hello, 0, &rooms.models, done.clone())?;
                }
                if show.hello.codec.starts_with("avc1.") {
                    in_order_and_upright(&video.data)?;
                }
                let (frame, data) = (video.frame, video.data.clone());
                let what = if video.key { MessageKind::Key } else { MessageKind::Frame { layer: video.layer } };
                room.push(show.epoch, what, write(Kind::Video(video)));
                room.count(|s| s.forward_ms = came.elapsed().as_secs_f64() * 1e3);
                if !show.threads.take(EncodedFrame { frame, data, depth: depth.take(), at: std::time::Instant::now() }) {
                    return Err("the server cannot decode the frames fast enough".into());
                }
            }
            Some(Kind::Depth(measured)) => {
                frames.check_depth(&measured, depth.is_some())?;
                depth = Some(measured.data);
            }
            Some(Kind::Sound(sound)) if sound.data.len() <= rooms.bounds.sound => {
                let [packets, bytes] = &mut sounds;
                if !packets.take(1.0, came) || !bytes.take(sound.data.len() as f64, came) {
                    return Err(format!("more than {PACKETS} packets or {SOUND} bytes of sound a second").into());
                }
                room.push(show.epoch, MessageKind::Sound, write(Kind::Sound(sound)));
            }
            Some(_) => return Err("a message that publishers do not send".into()),
        }
    }
}

/// The publisher's seat in the room, freed on drop, and the lease of the room if nodes share it.
struct Seat<'a> {
    room: &'a Room,
    lease: Option<Lease>,
}

impl Seat<'_> {
    /// Frees the seat but keeps the lease.
    fn leave(mut self) -> Option<Lease> {
        self.lease.take()
    }
}

impl Drop for Seat<'_> {
    fn drop(&mut self) {
        self.room.unpublish();
    }
}

/// The next message; `None` if the publisher has gone. Pings do not count as messages.
async fn next(socket: &mut WebSocket, until: Instant) -> Result<Option<Kind>, Refused> {
    loop {
        let silent = |_| Refused::for_now(format!("nothing came for {} s", SILENCE.as_secs()));
        return match timeout_at(until, socket.recv()).await.map_err(silent)? {
            Some(Ok(Message::Binary(bytes))) => read(bytes).map(Some).map_err(|e| e.to_string().into()),
            Some(Ok(Message::Ping(_) | Message::Pong(_))) => continue,
            Some(Ok(Message::Text(_))) => Err("messages are binary".into()),
            Some(Ok(Message::Close(_))) | None => Ok(None),
            Some(Err(error)) => Err(broke(&error)),
        };
    }
}

/// Why reading from a publisher failed.
fn broke(error: &axum::Error) -> Refused {
    match error.source().and_then(|source| source.downcast_ref::<tungstenite::Error>()) {
        Some(tungstenite::Error::Capacity(CapacityError::MessageTooLong { max_size, .. })) => {
            format!("a message over {max_size} bytes").into()
        }
        _ => Refused::for_now(format!("the connection broke: {error}")),
    }
}

/// Checks HELLO. Returns the settings for the geometry, and the HELLO for viewers.
fn checked(hello: Hello, frame_ms: f64) -> Result<(Settings, Hello), String> {
    let Hello { version, codec, width, height, fov_x, sound, sound_rate, sound_channels, .. } = hello;
    if version != VERSION {
        return Err(format!("messages of version {version}; this server's are of version {VERSION}"));
    }
    if !SIDES.contains(&width) || !SIDES.contains(&height) || u64::from(width) * u64::from(height) > MAX_PIXELS {
        return Err(format!(
            "frames of {width}×{height}; sides are {} to {} pixels, all together {MAX_PIXELS} at most",
            SIDES.start(),
            SIDES.end()
        ));
    }
    if codec.len() > CODEC || sound.len() > CODEC {
        return Err("invalid codec string".into());
    }
    let mut settings = Settings { frame_ms, ..Settings::default() };
    if fov_x != 0.0 {
        settings.options.fov_x = Some(fov_x);
        settings.options.validate().map_err(|e| e.to_string())?;
    }
    let told = TileState::hello(&settings.empty(width, height));
    Ok((settings, Hello { codec, fov_x, sound, sound_rate, sound_channels, ..told }))
}

/// Checks a publisher's frames.
struct Frames {
    /// Largest frame, in bytes.
    most: usize,
    /// Number of the next frame; `None` before the first.
    next: Option<u64>,
    allowed: u32,
    /// When the next credit is due, which limits the frame rate.
    due: Instant,
    /// Frames in a row that could not be decoded.
    broken: u32,
    /// Whether any frame was decoded.
    seen: bool,
}

impl Frames {
    fn check(&mut self, video: &Video) -> Result<(), String> {
        if video.data.len() > self.most {
            return Err(format!("a frame of {} bytes, over {}", video.data.len(), self.most));
        }
        if self.allowed == 0 {
            return Err("more frames than there was credit for".into());
        }
        if self.next.is_some_and(|next| next != video.frame) {
            return Err(format!("frame {} where {} was due", video.frame, self.next.unwrap_or_default()));
        }
        if self.next.is_none() && !video.key {
            return Err("the first frame is not a key frame".into());
        }
        self.allowed -= 1;
        self.next = Some(video.frame.checked_add(1).ok_or("the frame number is too large")?);
        Ok(())
    }

    fn check_depth(&self, depth: &Depth, again: bool) -> Result<(), String> {
        if depth.data.len() > self.most {
            return Err(format!("depth of {} bytes, over {}", depth.data.len(), self.most));
        }
        if again || self.next.is_some_and(|next| next != depth.frame) {
            return Err(format!("depth of frame {} where that of another one was due", depth.frame));
        }
        Ok(())
    }

    async fn decoded(&mut self, socket: &mut WebSocket, outcome: DecodeOutcome) -> Result<(), Refused> {
        self.broken = if outcome == DecodeOutcome::Picture { 0 } else { self.broken + 1 };
        self.seen |= outcome == DecodeOutcome::Picture;
        match outcome {
            DecodeOutcome::Panics => return Err(format!("geometry failed {PANICS} times in a row").into()),
            // damage can look like an unsupported stream, but not in the first frame
            DecodeOutcome::Unsupported(why) if !self.seen || self.broken >= BROKEN => return Err(why.into()),
            DecodeOutcome::Broken(why) if self.broken >= BROKEN || (!self.seen && self.broken >= BROKEN_FIRST) => {
                return Err(format!("{} frames in a row cannot be decoded: {why}", self.broken).into());
            }
            _ => {}
        }
        // allows short bursts
        self.due = (self.due + FASTEST).max(Instant::now().checked_sub(Duration::from_millis(100)).unwrap_or(self.due));
        if self.due > Instant::now() {
            sleep_until(self.due).await;
        }
        self.credit(socket, 1, self.broken > 0).await
    }

    async fn credit(&mut self, socket: &mut WebSocket, frames: u32, key: bool) -> Result<(), Refused> {
        self.allowed += frames;
        let bytes: Bytes = write(Kind::Credit(Credit { frames, key, viewers: 0 }));
        socket.send(Message::Binary(bytes)).await.map_err(|e| broke(&e))
    }
}
