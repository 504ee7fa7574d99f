//! Measures one sequence from the camera to a reader.

use std::path::Path;
use std::time::{Duration, Instant};

use tmpi_core::live::{FrameTiming, TileState, schema};
use tmpi_core::{Photo, Pose};
use tmpi_live::{Frame, Geometry as Driver, video as codecs};
use tmpi_pipeline::usage::Clock;
use tmpi_render::difference::psnr;
use tmpi_render::{PictureFormat, View};

use super::aligned_depth::Truth;
use super::baseline::as_jpeg;
use super::sequence::{Kind, SeenSurfaces, Sequence, Shot};
use super::side_view::{Mean, Moment, Reader, ms};
use super::totals::{Totals, add, add_bytes};
use super::{Figures, LiveBenchError, Settings, encoder, room};

/// Sideways offset of the side view: the border of the default view box.
pub const SIDE_OFFSET: f64 = 0.03;
/// Corners of the view box for which pictures are written.
const CORNERS: [(&str, (f64, f64)); 4] =
    [("upper-left", (-1.0, -1.0)), ("upper-right", (1.0, -1.0)), ("lower-left", (-1.0, 1.0)), ("lower-right", (1.0, 1.0))];
/// Seconds after which the reader's memory is measured.
const SETTLED: f64 = 5.0;

/// Runs a sequence through a room that keeps its geometry between frames, and through one that does not.
pub(super) fn run(settings: &Settings, kind: Kind, sequence: &Sequence) -> Result<Figures, LiveBenchError> {
    let mut f = Figures { sequence: kind.name(), codec: if settings.bitrate.is_some() { "h264" } else { "jpeg" }, ..Figures::default() };
    let mut encoder = encoder(settings.size, settings.bitrate)?;
    let mut decoder = codecs::decoder(encoder.codec(), settings.size)?;
    let truth = Truth::default();
    let models = if settings.true_scale { truth.scaled(&settings.models) } else { settings.models.clone() };
    let mut carried = Driver::new(models.clone(), room(settings, sequence, settings.frame_ms, false));
    let mut separate = Driver::new(models, room(settings, sequence, 0.0, true));
    let (mut reader, mut other) = (Reader::with_memory(settings.follow), Reader::default());
    // the true previous frame, and everything that the camera has seen
    let (mut last, mut seen) = (None::<Photo>, SeenSurfaces::default());
    let (mut stream, mut messages) = (Vec::new(), Vec::new());
    let empty = room(settings, sequence, settings.frame_ms, false).empty(settings.size.0, settings.size.1);
    record(&mut messages, schema::message::Kind::Hello(schema::Hello { codec: encoder.codec().into(), ..TileState::hello(&empty) }));
    let mut sums = Totals::default();
    // an odd interval: if every second frame is in the cooldown, views alternate between both kinds
    let views = settings.views | 1;
    for n in 0..settings.frames {
        let taken = n * settings.every;
        let shot = sequence.shot(taken);
        truth.set(&shot.delta);
        let seen_before = seen.add(sequence, taken, &shot);
        let (data, key) = encoder.encode(&shot.noisy)?;
        f.video_bytes += record(&mut messages, video((n, taken), key, &data));
        stream.extend_from_slice(&data);
        let clock = Clock::start();
        let Some(photo) = decoder.decode(&data)? else { continue };
        let decode_ms = clock.ms();
        f.decode_ms += decode_ms;
        f.server_cpu_ms += clock.cpu_ms();
        if n % views == 0 {
            compare_video(&mut sums, &photo, &shot)?;
        }
        let depth = (kind == Kind::Measured).then(|| shot.delta.clone());
        let frame = Frame { number: n.into(), at: at(taken), photo, depth };
        let clock = Clock::start();
        let update = carried.next(&frame)?;
        let server_ms = clock.ms() + decode_ms;
        f.server_cpu_ms += clock.cpu_ms();
        f.server_ms += server_ms;
        sums.clocks.push(server_ms);
        update.stages.iter().for_each(|s| add(&mut f.stages_ms, &s.name, (s.ms, s.cpu_ms)));
        add(&mut f.stages_ms, "chunks", (update.coding_ms, update.coding_ms));
        let message = schema::Geometry { frame: n.into(), chunks: update.chunks.clone() };
        add_bytes(&mut f, &mut sums.chunks, &message);
        record(&mut messages, schema::message::Kind::Geometry(message.clone()));
        if let Some(g) = carried.geometry() {
            sums.count(g, &update, last.as_ref().map(|l| (l, &shot.clean)));
            f.left_out_off = f.left_out_off.max(carried.reference().map_or(0, |of| most_off(of, &frame.photo)));
            f.kept_off = f.kept_off.max(update.kept_error);
            reader.model.get_or_insert(TileState::new(&TileState::hello(g))?);
        }
        let before = Instant::now();
        let (came, tiles) = reader.receive(message, settings.late)?;
        f.read_ms += ms(before);
        let known = reader.model.as_ref().and_then(TileState::geometry).cloned();
        if let Some(g) = &known {
            let before = Instant::now();
            reader.update(g, &came, &frame.photo, FrameTiming { frame: n.into(), tiles, elapsed: Some(at(settings.every)) });
            sums.layers.push(ms(before));
            if let Some(plate) = sequence.plate(taken) {
                sums.edges(reader.shown(g), (&shot.delta, &plate.disparity));
            }
        }
        if n % views <= 1 {
            if let Some(bytes) = snapshot(&carried, n)? {
                sums.snapshots.add(bytes);
            }
            let moment = |geometry, sent| Moment {
                geometry,
                photo: &frame.photo,
                shot: &shot,
                seen_before: &seen_before,
                plate: sequence.plate(taken),
                side_pose: sequence.side_pose(),
                follows: n % views == 1,
                sent,
                settled: f64::from(taken) >= SETTLED * 30.0,
            };
            let view = known.as_ref().map(|g| reader.show(moment(g, &came))).transpose()?;
            separate.next(&frame)?;
            let by_itself = separate.geometry().map(|g| other.show(moment(g, &[]))).transpose()?;
            if let Some(folder) = settings.files.as_deref().filter(|_| n % views == 0) {
                let ours = [("frame", Some(&frame.photo)), ("beside", view.as_ref()), ("separate", by_itself.as_ref())];
                for (what, picture) in ours.into_iter().chain([("truth", Some(&shot.side_view))]) {
                    keep(folder, kind, n, what, picture)?;
                }
                for (corner, (tx, ty)) in CORNERS {
                    let at = (tx * SIDE_OFFSET, ty * SIDE_OFFSET);
                    let view = known.as_ref().map(|g| reader.view(moment(g, &[]), Pose::at(at.0, at.1, 0.0))).transpose()?.flatten();
                    keep(folder, kind, n, corner, view.as_ref())?;
                    keep(folder, kind, n, &format!("{corner}-truth"), Some(&sequence.view(taken, at)))?;
                }
            }
        }
        last = Some(shot.clean);
    }
    if let Some(folder) = &settings.files {
        keep_streams(settings, folder, kind, (&stream, &messages))?;
    }
    sums.finish(&mut f, settings.frames, settings.every);
    compare(&mut f, &reader, &other);
    Ok(f)
}

/// Largest difference of any channel between two pictures, in levels.
fn most_off(a: &Photo, b: &Photo) -> u8 {
    a.rgb.as_flattened().iter().zip(b.rgb.as_flattened()).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or_default()
}

/// Collects the readers' results for both rooms.
fn compare(f: &mut Figures, reader: &Reader, other: &Reader) {
    (f.masks_ms, f.fill_ms) = (reader.masks.get(), reader.fill.get());
    let decibels = |square: Mean| if square.get() > 0.0 { 10.0 * (255f64.powi(2) / square.get()).log10() } else { 0.0 };
    (f.uncovered_psnr, f.uncovered_psnr_made_up) = (decibels(reader.remembered), decibels(reader.inpainted));
    f.uncovered_psnr_most = decibels(reader.least);
    (f.seen_before_psnr, f.seen_before_psnr_made_up) = (decibels(reader.seen_remembered), decibels(reader.seen_inpainted));
    (f.own_depth_psnr, f.own_depth_psnr_made_up) = (decibels(reader.own_remembered), decibels(reader.own_inpainted));
    ([f.seam, f.seam_wide], [f.seam_separate, f.seam_wide_separate]) = (reader.seams.map(Mean::get), other.seams.map(Mean::get));
    f.seen_before = reader.seen_remembered.count() / reader.remembered.count().max(1.0);
    f.own_view_off = reader.off;
    (f.psnr, f.ssim, f.flicker, f.flicker_left_out) =
        (reader.psnr.get(), reader.ssim.get(), reader.flicker.get(), reader.flicker_left_out.get());
    (f.psnr_separate, f.ssim_separate, f.flicker_separate) = (other.psnr.get(), other.ssim.get(), other.flicker.get());
}

/// Adds the PSNR of the video, and the JPEG with the same PSNR.
fn compare_video(sums: &mut Totals, photo: &Photo, shot: &Shot) -> Result<(), LiveBenchError> {
    let off = psnr(photo.rgb.as_flattened(), shot.clean.rgb.as_flattened());
    sums.video_psnr.add(off);
    sums.jpeg(as_jpeg(&shot.noisy, &shot.clean, off)?);
    Ok(())
}

/// Size of a room's snapshot at a frame in bytes; `None` if the room is empty.
fn snapshot(room: &Driver, n: u32) -> Result<Option<f64>, LiveBenchError> {
    let message = |chunk| schema::message::Kind::Snapshot(schema::Geometry { frame: n.into(), chunks: vec![chunk] });
    Ok(room.snapshot(n.into())?.map(|chunk| tmpi_core::live::write(message(chunk)).len() as f64))
}

/// Writes the video and all messages of the room.
fn keep_streams(settings: &Settings, folder: &Path, kind: Kind, (video, messages): (&[u8], &[u8])) -> Result<(), LiveBenchError> {
    write(folder, &format!("{}.{}", kind.slug(), if settings.bitrate.is_some() { "h264" } else { "mjpeg" }), video)?;
    write(folder, &format!("{}.room", kind.slug()), messages)
}

/// Writes a picture for a frame, if there is one.
fn keep(folder: &Path, kind: Kind, n: u32, what: &str, picture: Option<&Photo>) -> Result<(), LiveBenchError> {
    picture.map_or(Ok(()), |picture| write(folder, &format!("{}-{n:04}-{what}.png", kind.slug()), &png(picture)?))
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

/// Appends a length-prefixed message, as `tmpi live watch --record` does; returns its size in bytes.
fn record(messages: &mut Vec<u8>, kind: schema::message::Kind) -> f64 {
    let bytes = tmpi_core::live::write(kind);
    messages.extend((bytes.len() as u32).to_le_bytes());
    messages.extend_from_slice(&bytes);
    bytes.len() as f64
}

fn png(photo: &Photo) -> Result<Vec<u8>, LiveBenchError> {
    let rgba = photo.rgb.iter().map(|[r, g, b]| [*r, *g, *b, 255]).collect();
    let view = View { width: photo.width, height: photo.height, rgba };
    tmpi_render::encode(&view, PictureFormat::Png, 0).map_err(|e| LiveBenchError::Encode(e.to_string()))
}

fn write(folder: &Path, name: &str, bytes: &[u8]) -> Result<(), LiveBenchError> {
    let path = folder.join(name);
    std::fs::create_dir_all(folder).and_then(|()| std::fs::write(&path, bytes)).map_err(|e| LiveBenchError::Write(path, e))
}
