//! Measures one sequence from the camera to a reader.

use std::path::Path;
use std::time::{Duration, Instant};

use image::ExtendedColorType;
use tmpi_core::live::{FrameTiming, TileState, schema};
use tmpi_core::{Photo, Pose};
use tmpi_live::{Frame, FramePipeline, Update, video as codecs};
use tmpi_pipeline::usage::Clock;
use tmpi_render::difference::{max_abs, psnr};
use tmpi_testing::pictures::png;

use super::encode::{H264, sound_bytes};
use super::sequence::{Kind, Sequence, Shot};
use super::side_view::{Moment, Reader, ms};
use super::sweep::OperatingPoint;
use super::{Flags, Row, Settings, VIEW_BOX, room, tiles};
use crate::bench::Figures;
use crate::{LabError, files};

/// Corners of the view box for which pictures are written.
const CORNERS: [(&str, (f64, f64)); 4] =
    [("upper-left", (-1.0, -1.0)), ("upper-right", (1.0, -1.0)), ("lower-left", (-1.0, 1.0)), ("lower-right", (1.0, 1.0))];
/// Seconds after which the reader's memory is measured.
const SETTLED: f64 = 5.0;

/// Runs a sequence through a room.
pub(super) fn run(settings: &Settings, kind: Kind, sequence: &Sequence) -> Result<Row, LabError> {
    let (flags, OperatingPoint { size, bitrate, budget_ms }) = (&settings.flags, settings.at);
    let mut encoder = H264::new(size, bitrate)?;
    let mut decoder = codecs::decoder(H264::CODEC, size)?;
    let settings_of_room = room(settings, sequence, budget_ms);
    let empty = settings_of_room.empty(size.0, size.1);
    let mut driver = FramePipeline::new(settings.models.clone(), settings_of_room);
    let (mut f, mut stages) = (Figures::default(), Vec::new());
    let (mut reader, mut streams) = (Reader::new(flags.follow), Streams::default());
    streams.record(schema::message::Kind::Hello(schema::Hello { codec: H264::CODEC.into(), ..TileState::hello(&empty) }));
    let mut last = None::<Photo>;
    // an odd interval: if every second frame is in the cooldown, views alternate between both kinds
    let views = flags.views | 1;
    for n in 0..flags.frames {
        let taken = n * flags.every;
        let shot = sequence.shot(taken);
        let (data, key) = encoder.encode(&shot.noisy)?;
        f.add("video, bytes", streams.record(video((n, taken), key, &data)));
        streams.video.extend_from_slice(&data);
        let clock = Clock::start();
        let Some(photo) = decoder.decode(&data)? else { continue };
        let decoding = (clock.ms(), clock.cpu_ms());
        if n % views == 0 {
            f.add("video, dB", psnr(photo.rgb.as_flattened(), shot.clean.rgb.as_flattened()));
        }
        let depth = (kind == Kind::Measured).then(|| shot.delta.clone());
        let frame = Frame { number: n.into(), at: at(taken), photo, depth };
        let clock = Clock::start();
        let update = driver.next(&frame)?;
        add_times(&mut f, &mut stages, &update, [decoding, (clock.ms(), clock.cpu_ms())]);
        let message = schema::Geometry { frame: n.into(), chunks: update.chunks.clone() };
        let encoded = streams.record(schema::message::Kind::Geometry(message.clone()));
        tiles::bytes(&mut f, &message, encoded);
        if let Some(g) = driver.geometry() {
            tiles::count(&mut f, g, &update, last.as_ref().map(|l| (l, &shot.clean)));
            let off = driver.reference().map_or(0, |of| max_abs(&of.rgb, &frame.photo.rgb));
            f.most("unsent pixels: most off, levels", off.into());
            reader.model.get_or_insert(TileState::new(&TileState::hello(g))?);
        }
        let before = Instant::now();
        let (came, of_frame) = reader.receive(message, flags.late)?;
        f.add("reader: chunks, ms", ms(before));
        let known = reader.model.as_ref().and_then(TileState::geometry).cloned();
        if let Some(g) = &known {
            let before = Instant::now();
            reader.update(g, &came, &frame.photo, FrameTiming { frame: n.into(), tiles: of_frame, elapsed: Some(at(flags.every)) });
            f.add("reader: layers, ms", ms(before));
            if let Some(plate) = sequence.plate(taken) {
                tiles::edges(&mut f, reader.shown(g), (&shot.delta, &plate.disparity));
            }
            if n % views <= 1 {
                f.add("snapshot, bytes", snapshot(&driver, n)?);
                let moment = Moment {
                    geometry: g,
                    photo: &frame.photo,
                    shot: &shot,
                    side_pose: sequence.side_pose(),
                    follows: n % views == 1,
                    sent: &came,
                    settled: f64::from(taken) >= SETTLED * 30.0,
                };
                let view = reader.show(moment, &mut f)?;
                if let Some(folder) = flags.files.as_deref().filter(|_| n % views == 0) {
                    keep_pictures(folder, (kind, n), sequence, taken, (&reader, moment, &view))?;
                }
            }
        }
        last = Some(shot.clean);
    }
    if let Some(folder) = &flags.files {
        files::write(&folder.join(format!("{}.h264", kind.slug())), &streams.video)?;
        files::write(&folder.join(format!("{}.room", kind.slug())), &streams.messages)?;
    }
    reader.finish(&mut f);
    Ok(Row { sequence: kind.name(), figures: finished(f, stages, flags) })
}

/// Time and CPU time in milliseconds.
type Times = (f64, f64);

/// Adds the times of decoding and geometry, and of each stage.
fn add_times(f: &mut Figures, stages: &mut Vec<(String, Times)>, update: &Update, [decoding, geometry]: [Times; 2]) {
    f.add("server: decode, ms", decoding.0);
    f.add("server, ms", decoding.0 + geometry.0);
    f.add("server, CPU ms", decoding.1 + geometry.1);
    let coding = ("chunks", (update.coding_ms, update.coding_ms));
    for (name, (ms, cpu)) in update.stages.iter().map(|s| (s.name.as_str(), (s.ms, s.cpu_ms))).chain([coding]) {
        match stages.iter_mut().find(|(n, _)| n == name) {
            Some((_, sum)) => *sum = (sum.0 + ms, sum.1 + cpu),
            None => stages.push((name.to_owned(), (ms, cpu))),
        }
    }
}

/// The means over the frames, and what follows from them. Each frame stands for `every` frames at 30 frames a second.
fn finished(mut f: Figures, stages: Vec<(String, Times)>, flags: &Flags) -> Vec<(String, f64)> {
    for (name, (ms, cpu)) in stages {
        f.add(&format!("server: {name}, ms"), ms / f64::from(flags.frames));
        f.add(&format!("server: {name}, CPU ms"), cpu / f64::from(flags.frames));
    }
    for name in ["server, ms", "reader: layers, ms", "edge short, px"] {
        f.add(&format!("{name}, 95th percentile"), f.percentile(name, 0.95));
    }
    f.add("server, ms, longest", f.percentile("server, ms", 1.0));
    let every = f64::from(flags.every);
    f.add("sound, bytes", every * sound_bytes());
    let geometry = f.mean("geometry, bytes");
    let all = f.mean("video, bytes") + geometry + every * sound_bytes();
    f.add("total, kbit/s", all * 30.0 / every * 8.0 / 1e3);
    f.add("geometry, % of total", 100.0 * geometry / all);
    f.means()
}

/// Size of a room's snapshot at a frame in bytes; 0 if the room is empty.
fn snapshot(room: &FramePipeline, n: u32) -> Result<f64, LabError> {
    let message = |chunk| schema::message::Kind::Snapshot(schema::Geometry { frame: n.into(), chunks: vec![chunk] });
    Ok(room.snapshot(n.into())?.map_or(0.0, |chunk| tmpi_core::live::write(message(chunk)).len() as f64))
}

/// Writes the frame, the side view and views from the corners of the view box, each with the truth.
fn keep_pictures(
    folder: &Path,
    (kind, n): (Kind, u32),
    sequence: &Sequence,
    taken: u32,
    (reader, m, view): (&Reader, Moment, &Photo),
) -> Result<(), LabError> {
    let keep = |what: &str, picture: &Photo| {
        let path = folder.join(format!("{}-{n:04}-{what}.png", kind.slug()));
        files::write(&path, &png(picture.width, picture.height, picture.rgb.as_flattened(), ExtendedColorType::Rgb8))
    };
    let Shot { side_view, .. } = m.shot;
    for (what, picture) in [("frame", m.photo), ("beside", view), ("truth", side_view)] {
        keep(what, picture)?;
    }
    for (corner, (tx, ty)) in CORNERS {
        let at = (tx * VIEW_BOX.x, ty * VIEW_BOX.y);
        keep(corner, &reader.view(m, Pose::at(at.0, at.1, 0.0))?)?;
        keep(&format!("{corner}-truth"), &sequence.view(taken, at))?;
    }
    Ok(())
}

/// Capture time of a frame, at 30 frames a second.
pub(super) fn at(n: u32) -> Duration {
    Duration::from_micros(u64::from(n) * 33_333)
}

/// A frame as a message, with its number in the room and in the sequence.
fn video((n, taken): (u32, u32), key: bool, data: &[u8]) -> schema::message::Kind {
    let time = at(taken).as_micros() as u64;
    schema::message::Kind::Video(schema::Video { frame: n.into(), time, key, layer: 0, data: data.to_vec().into() })
}

/// The video, and all messages of the room.
#[derive(Default)]
struct Streams {
    video: Vec<u8>,
    messages: Vec<u8>,
}

impl Streams {
    /// Appends a length-prefixed message, as `tmpi live watch --record` does; returns its size in bytes.
    fn record(&mut self, kind: schema::message::Kind) -> f64 {
        let bytes = tmpi_core::live::write(kind);
        self.messages.extend((bytes.len() as u32).to_le_bytes());
        self.messages.extend_from_slice(&bytes);
        bytes.len() as f64
    }
}
