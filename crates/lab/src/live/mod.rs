//! `tmpi-lab live-bench`: rendered sequences, encoded, through the driver of a room to a reader, with error against time and bytes.

pub mod baseline;
pub mod budget;
pub mod damaged;
pub mod encode;
mod measure;
mod reader;
mod scale;
mod seams;
pub mod sequence;
pub mod sweep;
mod totals;

use std::fmt::Write;
use std::path::PathBuf;
use std::time::Duration;

use serde::Serialize;

use tmpi_core::live::chunk::Area;
use tmpi_core::live::prior::Learning;
use tmpi_live::{Geometry, GeometryError, Settings as Room, video};
use tmpi_pipeline::{Models, Options};

use encode::Encoder;
use sequence::{Kind, Sequence};

/// Short names of the sequences.
pub const NAMES: [&str; 4] = [Kind::ALL[0].slug(), Kind::ALL[1].slug(), Kind::ALL[2].slug(), Kind::ALL[3].slug()];
/// Seed of the first scene of the benchmark where nothing is said, far from those that anything was learnt from.
pub const SEED: u64 = 900_100;
/// Seeds of the scenes that the coders of chunks learn from.
const LEARNT: u64 = 700_000;
/// Scenes that they learn from, and frames of each.
const LESSONS: (u64, u32) = (12, 40);

/// Why nothing could be measured.
#[derive(Debug, thiserror::Error)]
pub enum LiveBenchError {
    /// A frame could not be encoded.
    #[error("encoding a frame: {0}")]
    Encode(String),
    /// A frame could not be decoded.
    #[error(transparent)]
    Video(#[from] video::VideoError),
    /// A frame has no geometry.
    #[error(transparent)]
    Geometry(#[from] GeometryError),
    /// A reader could not take what was sent.
    #[error(transparent)]
    Live(#[from] tmpi_core::live::LiveError),
    /// A view could not be drawn.
    #[error(transparent)]
    Render(#[from] tmpi_render::RenderError),
    /// A file could not be written.
    #[error("{0}")]
    Write(PathBuf, #[source] std::io::Error),
}

/// What is measured.
#[derive(Clone)]
pub struct Settings {
    /// Size of the frames.
    pub size: (u32, u32),
    /// Seed of the first scene; the next two are used, too.
    pub seed: u64,
    /// Frames of each sequence.
    pub frames: u32,
    /// Of the sequence every so many frames are sent, of 30 a second.
    pub every: u32,
    /// Bits a second of H.264; none: JPEG frames.
    pub bitrate: Option<u32>,
    /// Milliseconds that the geometry of a frame may take; 0: as long as it takes.
    pub frame_ms: f64,
    /// Every so many frames the view from beside is drawn, and that of the frame after it.
    pub views: u32,
    /// The networks; without the depth network only depth that is measured can be used.
    pub models: Models,
    /// Depth can be estimated.
    pub depth: bool,
    /// Estimated disparity is brought to the truth's scale before it is used.
    pub true_scale: bool,
    /// Parallax error that planes may leave, in pixels.
    pub max_error: f64,
    /// Pixels of parallax by which what readers hold of a tile may be off.
    pub parallax: f64,
    /// For how long frames rest after one of which tiles were sent.
    pub rest: Duration,
    /// Frames by which readers get tiles after theirs.
    pub late: u32,
    /// Frames after those that tiles are of up to which readers' labels follow what moves.
    pub follow: u32,
    /// When estimated depth beside what moved is looked at once more.
    pub settles: tmpi_live::Settling,
    /// Of the sequences the one of this name alone.
    pub only: Option<String>,
    /// Where the streams and some of the pictures are written.
    pub files: Option<PathBuf>,
}

/// Means over the frames of a sequence; bytes and milliseconds are a frame's.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Figures {
    /// Name of the sequence.
    pub sequence: &'static str,
    /// `h264` or `jpeg`.
    pub codec: &'static str,
    /// Bytes of video, messages and all.
    pub video_bytes: f64,
    /// Bytes of geometry, as well.
    pub geometry_bytes: f64,
    /// Bytes of sound, as well: Opus at the rate of the publishing page.
    pub sound_bytes: f64,
    /// Of these, bytes of planes.
    pub plane_bytes: f64,
    /// Of these, bytes of labels; what is left are heads.
    pub label_bytes: f64,
    /// Chunks of a frame of which any was sent.
    pub chunks: f64,
    /// Bytes of all tiles of a frame as one chunk.
    pub snapshot_bytes: f64,
    /// Video, geometry and sound, in kbit/s.
    pub kbit_s: f64,
    /// Share of geometry in these.
    pub geometry_share: f64,
    /// Bytes of a frame, noise and all, as JPEG (4:4:4) of the PSNR that the video has of it: of the frames of which views are drawn.
    pub jpeg_bytes: f64,
    /// All bytes as a share of these.
    pub jpeg_share: f64,
    /// PSNR of decoded frames against those without noise, in dB.
    pub video_psnr: f64,
    /// The same of the JPEG files, as far as they reach it.
    pub jpeg_psnr: f64,
    /// Their quality.
    pub jpeg_quality: f64,
    /// Share of the tiles that nothing was sent of.
    pub left_out: f64,
    /// Share of the truly unchanged tiles that were found to be; 0 where no tile is.
    pub unchanged_found: f64,
    /// Share of the truly unchanged tiles that nothing was sent of; 0 where no tile is.
    pub unchanged_left_out: f64,
    /// Share of the tiles that were placed anew and not sent, as they moved by no more than the tolerance.
    pub kept: f64,
    /// Pixels by which these are off at the most, from any camera of the view box.
    pub kept_off: f64,
    /// Share of the tiles that wait for a later frame, as there was no time for them.
    pub waiting: f64,
    /// Share of the tiles that have fewer planes than they may need, for the same reason.
    pub coarse: f64,
    /// Pixels that the depth network ran on, where it did; 0 where it has no choice.
    pub depth_pixels: f64,
    /// Largest difference, in levels, of a pixel from that of which its depth was told.
    pub left_out_off: u8,
    /// Pixels that the view from the camera's own place has otherwise than the frame, of all views.
    pub own_view_off: u64,
    /// PSNR where the camera itself sees nothing, from the fifth second on: what was seen before shown, in dB; 0 before.
    pub uncovered_psnr: f64,
    /// The same with all of it made up from what is beside it.
    pub uncovered_psnr_made_up: f64,
    /// The same with the true colours on the hidden texels of what the thing stands before: what is missing then is the planes', not the colours';
    /// 0 where the camera moves.
    pub uncovered_psnr_most: f64,
    /// Share of these pixels that the camera saw at an earlier frame; the others it never sees, and nothing but making them up is left.
    pub seen_before: f64,
    /// PSNR of these, what was seen before shown.
    pub seen_before_psnr: f64,
    /// The same with all of it made up.
    pub seen_before_psnr_made_up: f64,
    /// PSNR of what hidden texels show of what the thing stands before, what was seen before shown, against the same layers with the true colours
    /// on these texels: the truth by the depth that the reader has.
    pub own_depth_psnr: f64,
    /// The same with all of it made up.
    pub own_depth_psnr_made_up: f64,
    /// Pixels by which what is shown of the thing falls short of its edge, at the left and at the right; 0 where there is no thing.
    pub torn: f64,
    /// The same of the frame that is worse than 95 of 100.
    pub torn_p95: f64,
    /// Pixels by which it goes beyond it.
    pub fringe: f64,
    /// A reader's time to bring its layers up to a frame, and to keep what it sees.
    pub layers_ms: f64,
    /// 95 of 100 take no longer.
    pub layers_ms_p95: f64,
    /// PSNR of the view from beside, in dB, and of one whose every frame was made by itself.
    pub psnr: f64,
    /// The same, made frame by frame.
    pub psnr_separate: f64,
    /// SSIM of the view from beside.
    pub ssim: f64,
    /// The same, made frame by frame.
    pub ssim_separate: f64,
    /// Pixels by which neighbouring tiles show a point that both have apart from each other, from the border of the view box.
    pub seam: f64,
    /// The same, made frame by frame.
    pub seam_separate: f64,
    /// Share of these points that they show more than a pixel apart.
    pub seam_wide: f64,
    /// The same, made frame by frame.
    pub seam_wide_separate: f64,
    /// Mean change of the view from beside, in levels, where the truth does not change, from the tiles of the frame before to its own: of one
    /// and the same picture, so that the noise of the video is not in it.
    pub flicker: f64,
    /// The same, made frame by frame.
    pub flicker_separate: f64,
    /// The same where nothing was sent of any tile near.
    pub flicker_left_out: f64,
    /// Decoding on the server.
    pub decode_ms: f64,
    /// Each stage of the server: milliseconds, and those of processor time.
    pub stages_ms: Vec<(String, f64, f64)>,
    /// Processor time of everything on the server.
    pub server_cpu_ms: f64,
    /// Everything on the server.
    pub server_ms: f64,
    /// The longest of these.
    pub server_ms_most: f64,
    /// 95 of 100 take no longer.
    pub server_ms_p95: f64,
    /// A reader's decoding of chunks.
    pub read_ms: f64,
    /// A reader's masks of all layers, and their hidden colours: not only of what changed.
    pub masks_ms: f64,
    /// Colours of hidden texels.
    pub fill_ms: f64,
}

/// Figures of all sequences.
#[derive(Clone, Debug, Serialize)]
pub struct Results {
    /// Width and height.
    pub size: (u32, u32),
    /// Frames of each sequence.
    pub frames: u32,
    /// A row each.
    pub rows: Vec<Figures>,
    /// What was left out, and why.
    pub skipped: Vec<String>,
}

/// Measures all sequences; `told` is told of each.
///
/// # Errors
/// [`LiveBenchError`].
pub fn run(settings: &Settings, told: &dyn Fn(&str)) -> Result<Results, LiveBenchError> {
    let (mut rows, mut skipped) = (Vec::new(), Vec::new());
    for kind in Kind::ALL {
        if settings.only.as_ref().is_some_and(|name| name != kind.slug()) {
            continue;
        }
        if !settings.depth && kind != Kind::Measured {
            skipped.push(format!("{}: there is no depth network", kind.name()));
            continue;
        }
        told(kind.name());
        let sequence = Sequence::new(kind, settings.seed, settings.size, settings.frames * settings.every, measure::ASIDE);
        rows.push(measure::run(settings, kind, &sequence)?);
    }
    Ok(Results { size: settings.size, frames: settings.frames, rows, skipped })
}

/// What is made of a sequence.
fn room(settings: &Settings, sequence: &Sequence, frame_ms: f64, separate: bool) -> Room {
    let (k, width) = (sequence.intrinsics(), 2.0 * sequence.intrinsics().cx);
    // frame by frame it is the photo's pipeline, with the error that a photo's planes may leave
    let max_error = if separate { Options::default().max_error } else { settings.max_error };
    let options = Options { fov_x: Some(k.fov_x(width as u32)), max_error, ..Options::default() };
    Room { options, parallax: settings.parallax, rest: settings.rest, settles: settings.settles, frame_ms, separate, ..Room::default() }
}

/// The encoder that is wanted.
fn encoder(size: (u32, u32), bitrate: Option<u32>) -> Result<Box<dyn Encoder>, LiveBenchError> {
    Ok(match bitrate {
        Some(bitrate) => Box::new(encode::H264::new(size, bitrate)?),
        None => Box::new(encode::Jpeg { quality: encode::QUALITY }),
    })
}

/// Learns what the coders of chunks begin with (`crates/core/src/live/prior.in`): from chunks of sequences whose depth is measured.
///
/// # Errors
/// [`LiveBenchError`].
pub fn learn(settings: &Settings, told: &dyn Fn(&str)) -> Result<String, LiveBenchError> {
    let mut learning = Learning::default();
    for lesson in 0..LESSONS.0 {
        told(&format!("lesson {} of {}", lesson + 1, LESSONS.0));
        let kind = if lesson % 3 == 2 { Kind::Moving } else { Kind::Still };
        let sequence = Sequence::new(kind, LEARNT + 3 * lesson, settings.size, LESSONS.1, measure::ASIDE);
        let (mut encoder, mut geometry) =
            (encoder(settings.size, settings.bitrate)?, Geometry::new(settings.models.clone(), room(settings, &sequence, 0.0, false)));
        let mut decoder = video::decoder(encoder.codec(), settings.size)?;
        for n in 0..LESSONS.1 {
            let shot = sequence.shot(n);
            let Some(photo) = decoder.decode(&encoder.encode(&shot.noisy)?.0)? else { continue };
            let depth = (!settings.depth || lesson % 2 == 0).then_some(shot.delta);
            let update = geometry.next(&tmpi_live::Frame { number: n.into(), at: measure::at(n), photo, depth })?;
            let Some(g) = geometry.geometry() else { continue };
            for area in Area::covering(&g.grid, |t| update.sent.contains(&t)) {
                learning.take(&g.grid, area, &g.tiles)?;
            }
        }
    }
    Ok(learning.finish())
}

impl Results {
    /// The figures as a table, a sequence in each column.
    #[must_use]
    pub fn table(&self) -> String {
        let mut out = format!("{}×{}, {} frames\n", self.size.0, self.size.1, self.frames);
        let mut line = |name: &str, of: &dyn Fn(&Figures) -> String| {
            let _ = write!(out, "{name:<34}");
            for row in &self.rows {
                let _ = write!(out, "{:>22}", of(row));
            }
            out.push('\n');
        };
        line("", &|f| f.sequence.into());
        line("video, bytes a frame", &|f| format!("{} {:.0}", f.codec, f.video_bytes));
        line("geometry, bytes (planes, labels)", &|f| format!("{:.0} ({:.0}, {:.0})", f.geometry_bytes, f.plane_bytes, f.label_bytes));
        line("chunks of a frame that has any", &|f| format!("{:.1}", f.chunks));
        line("all tiles at once, bytes", &|f| format!("{:.0}", f.snapshot_bytes));
        line("sound, bytes", &|f| format!("{:.0}", f.sound_bytes));
        line("all, kbit/s", &|f| format!("{:.0}", f.kbit_s));
        line("of these geometry", &|f| format!("{:.1} %", 100.0 * f.geometry_share));
        line("JPEG of every frame (quality)", &|f| format!("{:.0} ({:.1})", f.jpeg_bytes, f.jpeg_quality));
        line("all as a share of JPEG", &|f| format!("{:.1} %", 100.0 * f.jpeg_share));
        line("PSNR of video / JPEG, dB", &|f| format!("{:.1} / {:.1}", f.video_psnr, f.jpeg_psnr));
        line("tiles left out", &|f| format!("{:.1} %", 100.0 * f.left_out));
        line("placed anew and left out", &|f| format!("{:.1} %", 100.0 * f.kept));
        line("of these the most off, px", &|f| format!("{:.3}", f.kept_off));
        line("tiles late: wait, with few planes", &|f| format!("{:.1} / {:.1} %", 100.0 * f.waiting, 100.0 * f.coarse));
        line("depth network, pixels", &|f| format!("{:.0}", f.depth_pixels));
        line("unchanged tiles: found, left out", &|f| format!("{:.1} / {:.1} %", 100.0 * f.unchanged_found, 100.0 * f.unchanged_left_out));
        line("left out: most off, levels", &|f| f.left_out_off.to_string());
        line("own view: pixels off", &|f| f.own_view_off.to_string());
        let uncovered = |f: &Figures| format!("{:.2} / {:.2} / {:.2}", f.uncovered_psnr, f.uncovered_psnr_made_up, f.uncovered_psnr_most);
        line("uncovered: seen / made up / true, dB", &uncovered);
        line("of these seen earlier", &|f| format!("{:.1} %", 100.0 * f.seen_before));
        line("seen earlier: seen / made up, dB", &|f| format!("{:.2} / {:.2}", f.seen_before_psnr, f.seen_before_psnr_made_up));
        line("the same by the depth there is, dB", &|f| format!("{:.2} / {:.2}", f.own_depth_psnr, f.own_depth_psnr_made_up));
        let torn = |f: &Figures| format!("{:.2} ({:.2}) / {:.2}", f.torn, f.torn_p95, f.fringe);
        line("edge short (p95) / beyond, px", &torn);
        line("PSNR beside / frame by frame", &|f| format!("{:.2} / {:.2}", f.psnr, f.psnr_separate));
        line("SSIM beside / frame by frame", &|f| format!("{:.3} / {:.3}", f.ssim, f.ssim_separate));
        line("seams / frame by frame, px", &|f| format!("{:.3} / {:.3}", f.seam, f.seam_separate));
        line("more than a pixel / by frame, %", &|f| format!("{:.2} / {:.2}", 100.0 * f.seam_wide, 100.0 * f.seam_wide_separate));
        line("flicker / frame by frame, levels", &|f| format!("{:.3} / {:.3}", f.flicker, f.flicker_separate));
        line("flicker in left out tiles", &|f| format!("{:.3}", f.flicker_left_out));
        line("server: decode, ms", &|f| format!("{:.2}", f.decode_ms));
        for name in self.rows.first().map(|r| r.stages_ms.clone()).unwrap_or_default().iter().map(|(n, ..)| n) {
            let of = |f: &Figures| f.stages_ms.iter().find(|(n, ..)| n == name).map_or((0.0, 0.0), |(_, ms, cpu)| (*ms, *cpu));
            line(&format!("server: {name}, ms (CPU)"), &|f| format!("{:.2} ({:.2})", of(f).0, of(f).1));
        }
        line("server: all, CPU ms", &|f| format!("{:.1}", f.server_cpu_ms));
        line("server: all, ms (p95, most)", &|f| format!("{:.1} ({:.1}, {:.1})", f.server_ms, f.server_ms_p95, f.server_ms_most));
        line("reader: chunks, ms", &|f| format!("{:.2}", f.read_ms));
        line("reader: layers, ms (p95)", &|f| format!("{:.1} ({:.1})", f.layers_ms, f.layers_ms_p95));
        line("reader: all masks / fill, ms", &|f| format!("{:.1} / {:.1}", f.masks_ms, f.fill_ms));
        out
    }
}
