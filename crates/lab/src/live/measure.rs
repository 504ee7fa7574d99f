//! One sequence from the camera to a reader.

use std::path::Path;
use std::time::Instant;

use tmpi_core::live::{Model, wire};
use tmpi_core::{Geometry, Memory, Photo};
use tmpi_live::{Frame, Geometry as Driver, video};
use tmpi_pipeline::clock::Clock;
use tmpi_render::difference::psnr;
use tmpi_render::{PictureFormat, View};

use super::encode::{Encoder as _, Jpeg};
use super::reader::{Mean, Moment, Reader, ms};
use super::sequence::{Kind, Sequence};
use super::{Figures, LiveBenchError, Settings, encoder, room};

/// How far beside the camera views are drawn: the border of the default view box.
pub const ASIDE: f64 = 0.03;
/// Quality of the JPEG files that video is compared with.
pub const QUALITY: u8 = 90;
/// Seconds after which what a reader has seen counts.
const SETTLED: f64 = 5.0;

/// Runs a sequence through a room that carries its geometry on, and through one that does not.
pub(super) fn run(settings: &Settings, kind: Kind, sequence: &Sequence) -> Result<Figures, LiveBenchError> {
    let mut f = Figures { sequence: kind.name(), codec: if settings.bitrate.is_some() { "h264" } else { "jpeg" }, ..Figures::default() };
    let mut encoder = encoder(settings)?;
    let mut decoder = video::decoder(encoder.codec(), settings.size)?;
    let mut carried = Driver::new(settings.models.clone(), room(sequence, settings.frame_ms, false));
    let mut separate = Driver::new(settings.models.clone(), room(sequence, 0.0, true));
    let (mut reader, mut other) = (Reader::default(), Reader::default());
    // the truth of the frame before
    let mut last: Option<Photo> = None;
    let mut stream = Vec::new();
    let mut sums = Sums::default();
    for n in 0..settings.frames {
        let shot = sequence.shot(n);
        let (data, _) = encoder.encode(&shot.noisy)?;
        f.video_bytes += data.len() as f64;
        stream.extend_from_slice(&data);
        let clock = Clock::start();
        let Some(photo) = decoder.decode(&data)? else { continue };
        let decode_ms = clock.ms();
        f.decode_ms += decode_ms;
        f.server_cpu_ms += clock.cpu_ms();
        let (jpeg, _) = Jpeg { quality: QUALITY }.encode(&shot.noisy)?;
        f.jpeg_bytes += jpeg.len() as f64;
        if n % settings.views == 0 {
            sums.video_psnr.add(psnr(photo.rgb.as_flattened(), shot.clean.rgb.as_flattened()));
            if let Ok(Some(jpeg)) = video::decoder(video::JPEG, settings.size).and_then(|mut d| d.decode(&jpeg)) {
                sums.jpeg_psnr.add(psnr(jpeg.rgb.as_flattened(), shot.clean.rgb.as_flattened()));
            }
        }
        let depth = (kind == Kind::Measured).then(|| shot.delta.clone());
        let frame = Frame { number: n.into(), photo, depth };
        let clock = Clock::start();
        let update = carried.next(&frame)?;
        let server_ms = clock.ms() + decode_ms;
        f.server_cpu_ms += clock.cpu_ms();
        f.server_ms += server_ms;
        sums.clocks.push(server_ms);
        update.stages.iter().for_each(|s| add(&mut f.stages_ms, &s.name, (s.ms, s.cpu_ms)));
        add(&mut f.stages_ms, "chunks", (update.coding_ms, update.coding_ms));
        let message = wire::Geometry { frame: n.into(), chunks: update.chunks.clone() };
        add_bytes(&mut f, &message);
        if let Some(g) = carried.geometry() {
            sums.count(g, &update.changed, last.as_ref().map(|l| (l, &shot.clean)));
            let of = carried.reference().map_or(&[][..], |p| p.rgb.as_flattened());
            let off = of.iter().zip(frame.photo.rgb.as_flattened()).map(|(a, b)| a.abs_diff(*b)).max();
            f.left_out_off = f.left_out_off.max(off.unwrap_or_default());
            f.left_out += (g.tiles.len() - update.sent.len()) as f64;
            let before = Instant::now();
            let model = reader.model.get_or_insert(Model::new(&Model::hello(g))?);
            model.take(&message)?;
            f.read_ms += ms(before);
            let memory = reader.memory.get_or_insert_with(|| Memory::new(g.grid));
            if update.cut {
                memory.forget();
            }
        }
        let known = reader.model.as_ref().and_then(Model::geometry).cloned();
        if let Some(g) = &known {
            let before = Instant::now();
            reader.see(g, &frame.photo);
            f.memory_ms += ms(before);
        }
        if n % settings.views <= 1 {
            if let Some(snapshot) = carried.snapshot(n.into())? {
                let geometry = wire::Geometry { frame: n.into(), chunks: vec![snapshot] };
                sums.snapshots.add(tmpi_core::live::write(wire::message::Kind::Snapshot(geometry)).len() as f64);
            }
            let moment = |geometry, changed| Moment {
                geometry,
                photo: &frame.photo,
                shot: &shot,
                beside: sequence.beside(),
                follows: n % settings.views == 1,
                changed,
                settled: f64::from(n) >= SETTLED * 30.0,
            };
            let view = known.as_ref().map(|g| reader.show(moment(g, &update.changed))).transpose()?;
            separate.next(&frame)?;
            let by_itself = separate.geometry().map(|g| other.show(moment(g, &[]))).transpose()?;
            if let Some(folder) = settings.files.as_deref().filter(|_| n % settings.views == 0) {
                let pictures = [("frame", Some(&frame.photo)), ("beside", view.as_ref()), ("separate", by_itself.as_ref())];
                for (what, picture) in pictures.into_iter().chain([("truth", Some(&shot.beside))]) {
                    let name = format!("{}-{n:04}-{what}.png", kind.slug());
                    picture.map(|picture| write(folder, &name, &png(picture)?)).transpose()?;
                }
            }
        }
        last = Some(shot.clean);
    }
    if let Some(folder) = &settings.files {
        write(folder, &format!("{}.{}", kind.slug(), if settings.bitrate.is_some() { "h264" } else { "mjpeg" }), &stream)?;
    }
    sums.finish(&mut f, settings.frames);
    (f.masks_ms, f.fill_ms) = (reader.masks.get(), reader.fill.get());
    let decibels = |square: Mean| if square.get() > 0.0 { 10.0 * (255f64.powi(2) / square.get()).log10() } else { 0.0 };
    (f.uncovered_psnr, f.uncovered_psnr_made_up) = (decibels(reader.remembered), decibels(reader.made_up));
    f.own_view_off = reader.off;
    (f.psnr, f.ssim, f.flicker, f.flicker_left_out) =
        (reader.psnr.get(), reader.ssim.get(), reader.flicker.get(), reader.flicker_left_out.get());
    (f.psnr_separate, f.ssim_separate, f.flicker_separate) = (other.psnr.get(), other.ssim.get(), other.flicker.get());
    Ok(f)
}

/// What is counted over the frames.
#[derive(Default)]
struct Sums {
    /// All tiles, those that are truly unchanged, and those of them that were found to be.
    tiles: usize,
    still: usize,
    found: usize,
    snapshots: Mean,
    video_psnr: Mean,
    jpeg_psnr: Mean,
    /// What each frame took on the server, in milliseconds.
    clocks: Vec<f64>,
}

impl Sums {
    /// Counts the tiles of a frame; `truth` is that of the frame before and its own.
    fn count(&mut self, g: &Geometry, changed: &[u32], truth: Option<(&Photo, &Photo)>) {
        self.tiles += g.tiles.len();
        for t in 0..g.grid.tiles() {
            let truly = truth.is_some_and(|(before, now)| same(before, now, g.grid.rect(t)));
            self.still += usize::from(truly);
            self.found += usize::from(truly && !changed.contains(&t));
        }
    }

    /// Makes means of the sums over the frames.
    fn finish(mut self, f: &mut Figures, frames: u32) {
        self.clocks.sort_by(f64::total_cmp);
        f.server_ms_most = self.clocks.last().copied().unwrap_or_default();
        f.server_ms_p95 = self.clocks.get(self.clocks.len() * 95 / 100).copied().unwrap_or_default();
        let frames = f64::from(frames.max(1));
        for sum in [
            &mut f.video_bytes,
            &mut f.geometry_bytes,
            &mut f.plane_bytes,
            &mut f.jpeg_bytes,
            &mut f.decode_ms,
            &mut f.server_ms,
            &mut f.server_cpu_ms,
            &mut f.read_ms,
            &mut f.memory_ms,
        ] {
            *sum /= frames;
        }
        f.stages_ms.iter_mut().for_each(|(_, ms, cpu)| (*ms, *cpu) = (*ms / frames, *cpu / frames));
        f.kbit_s = (f.video_bytes + f.geometry_bytes) * 30.0 * 8.0 / 1e3;
        f.left_out /= self.tiles.max(1) as f64;
        f.unchanged_found = self.found as f64 / self.still.max(1) as f64;
        (f.snapshot_bytes, f.video_psnr, f.jpeg_psnr) = (self.snapshots.get(), self.video_psnr.get(), self.jpeg_psnr.get());
    }
}

fn add_bytes(f: &mut Figures, message: &wire::Geometry) {
    if !message.chunks.is_empty() {
        f.plane_bytes += message.chunks.iter().map(|c| c.plane_data.len() as f64).sum::<f64>();
        f.geometry_bytes += tmpi_core::live::write(wire::message::Kind::Geometry(message.clone())).len() as f64;
    }
}

fn add(sums: &mut Vec<(String, f64, f64)>, name: &str, (ms, cpu): (f64, f64)) {
    match sums.iter_mut().find(|(n, ..)| n == name) {
        Some((_, sum, cpus)) => (*sum, *cpus) = (*sum + ms, *cpus + cpu),
        None => sums.push((name.to_owned(), ms, cpu)),
    }
}

/// True where two pictures are the same within a rectangle.
fn same(a: &Photo, b: &Photo, r: tmpi_core::Rect) -> bool {
    (r.y..r.y + r.h).all(|y| {
        let row = y as usize * a.width as usize + r.x as usize;
        a.rgb[row..row + r.w as usize] == b.rgb[row..row + r.w as usize]
    })
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
