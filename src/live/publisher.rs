//! The socket of a publisher: what it sends is checked, handed on, and given to the worker.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use axum::extract::ws::{Message, WebSocket};
use bytes::Bytes;
use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until, timeout_at};

use tmpi_core::live::wire::bye::Cause;
use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::wire::{Bye, Credit, Depth, Hello, Video};
use tmpi_core::live::{MAX_PIXELS, Model, VERSION, read, write};
use tmpi_live::video::VideoError;
use tmpi_live::{Geometry, Settings, units, video};

use super::origin::{Lease, lost};
use super::ring::What;
use super::room::Room;
use super::routes::{ENDED, Here, ended};
use super::sound::Allowance;
use super::viewer::gone;
use super::worker::{Coded, Decoded, Worker};
use super::{BROKEN, BROKEN_FIRST, CREDIT, Config, Entry, FASTEST, HEARTBEAT, PANICS, SILENCE, send_away};

/// Sides of a frame.
const SIDES: std::ops::RangeInclusive<u32> = 16..=4096;
/// Bytes of a codec string.
const CODEC: usize = 64;

/// Serves a publisher until it goes or has to, or the token `ends` that it came by. Gives the lease of the room, where other nodes have to know of it.
pub async fn serve(mut socket: WebSocket, entry: &Entry, here: &Here, ends: Option<Instant>) -> Option<Lease> {
    let mut lease = None;
    let Err(reason) = session(&mut socket, entry, here, ends, &mut lease).await else { return lease };
    tracing::info!(reason, "a publisher is sent away");
    send_away(socket, Bye { again: may_come_back(&reason), cause: cause(&reason).into(), reason }).await;
    lease
}

/// Whether a publisher that is sent away for that reason may try again: a camera that paused may go on.
fn may_come_back(reason: &str) -> bool {
    reason == STOPS || reason == UNREACHABLE || reason.starts_with(SILENT) || reason.starts_with(BROKE)
}

/// What the publisher's program can act on.
fn cause(reason: &str) -> Cause {
    match reason {
        TAKEN => Cause::Taken,
        _ if reason.starts_with(NO_DECODER) => Cause::Codec,
        _ => Cause::Other,
    }
}

const STOPS: &str = "the server stops";
/// Why a second publisher is sent away.
const TAKEN: &str = "someone publishes in this room";
const NO_DECODER: &str = "no decoder for the codec";
const SILENT: &str = "nothing came for";
const BROKE: &str = "the connection broke";
const BIDIRECTIONAL: &str =
    "the stream has B-frames, which are shown in another order than they come in; encode it without: ffmpeg -bf 0, or baseline profile";
const UNREACHABLE: &str = "the database of rooms cannot be reached";
const MOVED: &str = "the room's publisher has come to another server";

/// Publishes; ends without a reason where the publisher has gone by itself.
async fn session(
    socket: &mut WebSocket,
    entry: &Entry,
    here: &Here,
    ends: Option<Instant>,
    lease: &mut Option<Lease>,
) -> Result<(), String> {
    let (room, rooms) = (&entry.room, &here.rooms);
    let Some(first) = next(socket, Instant::now() + SILENCE).await? else { return Ok(()) };
    let Kind::Hello(hello) = first else { return Err("the first message is HELLO".into()) };
    // before the room is taken: nobody watches who would have to be told
    checked(hello.clone(), &rooms.config)?;
    video::decoder(&hello.codec, (hello.width, hello.height)).map_err(|e| e.to_string())?;
    if !room.take() {
        return Err(TAKEN.into());
    }
    // given back however this ends
    let _seat = Seat(room);
    if let Some(nodes) = rooms.nodes.get() {
        let claimed = nodes.claim(&entry.name).await;
        *lease = Some(claimed.map_err(|error| {
            tracing::warn!(%error, room = entry.name, "a room is not taken");
            UNREACHABLE
        })?);
    }
    let ended = published(socket, room, hello, here, Until { lease: lease.as_ref(), ends }).await;
    match &ended {
        Ok(Gone::Said) => room.end(gone(Cause::Left)),
        // viewers follow the publisher to where it is now
        Err(reason) if reason != MOVED && !may_come_back(reason) => {
            room.end(Bye { reason: reason.clone(), again: true, cause: Cause::Rejected.into() });
        }
        Ok(Gone::Lost) | Err(_) => {}
    }
    ended.map(drop)
}

/// What ends a publisher's right to the room.
struct Until<'a> {
    lease: Option<&'a Lease>,
    ends: Option<Instant>,
}

/// Microseconds since 1970.
fn micros() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_micros() as u64)
}

/// How a publisher has gone by itself.
enum Gone {
    /// It said so.
    Said,
    /// Its connection has broken: it may come back.
    Lost,
}

/// What a publisher shows from one size of its pictures to the next.
struct Show {
    epoch: u64,
    hello: Hello,
    worker: Worker,
}

impl Show {
    /// Begins a room's epoch, `least` or more, with pictures as `hello` says; `done` is told of each frame.
    fn begin(room: &Arc<Room>, hello: Hello, least: u64, config: &Config, done: mpsc::Sender<Decoded>) -> Result<Self, String> {
        let (settings, hello) = checked(hello, config)?;
        let decoder = video::decoder(&hello.codec, (hello.width, hello.height)).map_err(|e| e.to_string())?;
        let clock = micros();
        let epoch = room.publish(hello.clone(), clock, least);
        let models = config.models.clone();
        let geometry = move || Geometry::new(models.clone(), settings.clone());
        let worker = Worker::start((Arc::clone(room), epoch), decoder, geometry, done).map_err(|e| format!("starting a thread: {e}"))?;
        Ok(Self { epoch, hello, worker })
    }

    /// What the publisher says from a key frame on whose pictures have another size; none where they have not.
    ///
    /// # Errors
    /// The server cannot decode them.
    fn resized(&self, data: &[u8]) -> Result<Option<Hello>, String> {
        let Hello { codec, width, height, fov_x, .. } = &self.hello;
        let size = match video::size(codec, data) {
            Ok(Some(size)) if size != (*width, *height) => size,
            Err(VideoError::Unsupported(why)) => return Err(why),
            // what cannot be read is told by the decoder
            Ok(_) | Err(_) => return Ok(None),
        };
        let codec = units::codec(data).filter(|_| codec.starts_with("avc1.")).unwrap_or_else(|| codec.clone());
        let fov_x = turned(*fov_x, (*width, *height), size);
        Ok(Some(Hello { codec, width: size.0, height: size.1, fov_x, ..self.hello.clone() }))
    }
}

/// Horizontal field of view of a camera, degrees, whose pictures have another size: along their longer side it stays what it was.
fn turned(fov_x: f64, before: (u32, u32), now: (u32, u32)) -> f64 {
    let [before, now] = [before, now].map(|(width, height)| f64::from(width) / f64::from(width.max(height)));
    if fov_x == 0.0 { fov_x } else { 2.0 * ((fov_x.to_radians() / 2.0).tan() * now / before).atan().to_degrees() }
}

/// Hands on what a publisher sends, which has the room.
async fn published(socket: &mut WebSocket, room: &Arc<Room>, hello: Hello, here: &Here, until: Until<'_>) -> Result<Gone, String> {
    let Here { rooms, stop, .. } = here;
    let (done, mut decoded) = mpsc::channel(16);
    // by the clock: addresses of groups of pictures are no others' after a restart
    let least = until.lease.map_or(micros() / 1000, Lease::epoch);
    let mut show = Show::begin(room, hello, least, &rooms.config, done.clone())?;
    let mut frames = Frames { most: rooms.bounds.frame, next: None, allowed: 0, due: Instant::now(), broken: 0, seen: false };
    let (mut depth, mut sounds) = (None, Allowance::new(Instant::now()));
    let mut heartbeat = interval(HEARTBEAT);
    heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    frames.credit(socket, CREDIT, false).await?;
    let mut silent = Instant::now() + SILENCE;
    loop {
        let message = tokio::select! {
            message = next(socket, silent) => message?,
            outcome = decoded.recv() => {
                frames.decoded(socket, outcome.ok_or("decoding has ended")?).await?;
                continue;
            }
            () = room.keys.notified() => {
                frames.credit(socket, 0, true).await?;
                continue;
            }
            // a publisher that hears nothing knows that its link is dead
            _ = heartbeat.tick() => {
                frames.credit(socket, 0, false).await?;
                continue;
            }
            () = lost(until.lease) => return Err(MOVED.into()),
            () = ended(until.ends) => return Err(ENDED.into()),
            () = stop.cancelled() => return Err(STOPS.into()),
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
                    // the threads of before end with what they have, and tell of it
                    show = Show::begin(room, hello, 0, &rooms.config, done.clone())?;
                }
                if show.hello.codec.starts_with("avc1.") && units::is_bidirectional(&video.data) {
                    return Err(BIDIRECTIONAL.into());
                }
                let (frame, data) = (video.frame, video.data.clone());
                let what = if video.key { What::Key } else { What::Frame { layer: video.layer } };
                room.push(show.epoch, what, write(Kind::Video(video)));
                room.count(|s| s.forward_ms = came.elapsed().as_secs_f64() * 1e3);
                if !show.worker.take(Coded { frame, data, depth: depth.take(), at: std::time::Instant::now() }) {
                    return Err("more frames came than can be decoded".into());
                }
            }
            Some(Kind::Depth(measured)) => {
                frames.check_depth(&measured, depth.is_some())?;
                depth = Some(measured.data);
            }
            Some(Kind::Sound(sound)) if sound.data.len() <= rooms.bounds.sound => {
                sounds.take(sound.data.len(), came)?;
                room.push(show.epoch, What::Sound, write(Kind::Sound(sound)));
            }
            Some(_) => return Err("a message that publishers do not send".into()),
        }
    }
}

/// The room's place for a publisher.
struct Seat<'a>(&'a Room);

impl Drop for Seat<'_> {
    fn drop(&mut self) {
        self.0.unpublish();
    }
}

/// The next message; none where the publisher has gone. Pings are none: who sends nothing else publishes nothing.
async fn next(socket: &mut WebSocket, until: Instant) -> Result<Option<Kind>, String> {
    loop {
        let came = timeout_at(until, socket.recv()).await.map_err(|_| format!("{SILENT} {} s", SILENCE.as_secs()))?;
        return match came {
            Some(Ok(Message::Binary(bytes))) => read(bytes).map(Some).map_err(|e| e.to_string()),
            Some(Ok(Message::Ping(_) | Message::Pong(_))) => continue,
            Some(Ok(Message::Text(_))) => Err("messages are binary".into()),
            Some(Ok(Message::Close(_))) | None => Ok(None),
            Some(Err(error)) => Err(format!("{BROKE}: {error}")),
        };
    }
}

/// What is made of a publisher's frames, and what viewers are told of them.
fn checked(hello: Hello, config: &Config) -> Result<(Settings, Hello), String> {
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
        return Err("a codec string that is none".into());
    }
    let mut settings = Settings { frame_ms: config.frame_ms, ..Settings::default() };
    if fov_x != 0.0 {
        settings.options.fov_x = Some(fov_x);
        settings.options.validate().map_err(|e| e.to_string())?;
    }
    let told = Model::hello(&settings.empty(width, height));
    Ok((settings, Hello { codec, fov_x, sound, sound_rate, sound_channels, ..told }))
}

/// What a publisher may send.
struct Frames {
    /// Bytes of a frame.
    most: usize,
    /// Number of the next frame; none before the first.
    next: Option<u64>,
    /// Frames that may still come.
    allowed: u32,
    /// When the next credit is due, so that frames come no faster than they may.
    due: Instant,
    /// Frames in a row that could not be decoded.
    broken: u32,
    /// A frame was decoded.
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
            return Err("the first frame is no key frame".into());
        }
        self.allowed -= 1;
        self.next = Some(video.frame.checked_add(1).ok_or("a frame number that none follows")?);
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

    async fn decoded(&mut self, socket: &mut WebSocket, outcome: Decoded) -> Result<(), String> {
        self.broken = if outcome == Decoded::Picture { 0 } else { self.broken + 1 };
        self.seen |= outcome == Decoded::Picture;
        match outcome {
            Decoded::Panics => return Err(format!("geometry failed {PANICS} times in a row")),
            // damage can look like it, but not in the first frame
            Decoded::Unsupported(why) if !self.seen || self.broken >= BROKEN => return Err(why),
            Decoded::Broken(why) if self.broken >= BROKEN || (!self.seen && self.broken >= BROKEN_FIRST) => {
                return Err(format!("{} frames in a row cannot be decoded: {why}", self.broken));
            }
            _ => {}
        }
        // a few may come together, but not for long
        self.due = (self.due + FASTEST).max(Instant::now().checked_sub(Duration::from_millis(100)).unwrap_or(self.due));
        if self.due > Instant::now() {
            sleep_until(self.due).await;
        }
        self.credit(socket, 1, self.broken > 0).await
    }

    async fn credit(&mut self, socket: &mut WebSocket, frames: u32, key: bool) -> Result<(), String> {
        self.allowed += frames;
        let bytes: Bytes = write(Kind::Credit(Credit { frames, key, viewers: 0 }));
        socket.send(Message::Binary(bytes)).await.map_err(|e| format!("{BROKE}: {e}"))
    }
}
