//! `tmpi-lab live-bench`: runs rendered sequences through encoder, room and reader, and measures error against time and bytes.

mod aligned_depth;
pub mod baseline;
pub mod budget;
pub mod damaged;
pub mod encode;
mod measure;
mod seams;
pub mod sequence;
mod side_view;
pub mod sweep;
mod totals;

use std::fmt::Write;
use std::path::PathBuf;
use std::time::Duration;

use serde::Serialize;

use tmpi_core::live::chunk::Area;
use tmpi_core::live::coder_prior::Learning;
use tmpi_live::{Geometry, GeometryError, Settings as Room, video};
use tmpi_pipeline::{Models, Options};

use encode::Encoder;
use sequence::{Kind, Sequence};

/// Short names of the sequences.
pub const NAMES: [&str; 4] = [Kind::ALL[0].slug(), Kind::ALL[1].slug(), Kind::ALL[2].slug(), Kind::ALL[3].slug()];
/// Default seed of the first scene, far from the seeds used for training.
pub const SEED: u64 = 900_100;
/// First seed of the training scenes of the chunk coders.
const TRAINING_SEED: u64 = 700_000;
/// Number of training scenes, and frames of each.
const LESSONS: (u64, u32) = (12, 40);

/// Why a measurement failed.
#[derive(Debug, thiserror::Error)]
pub enum LiveBenchError {
    /// A frame could not be encoded.
    #[error("cannot encode a frame: {0}")]
    Encode(String),
    /// A frame could not be decoded.
    #[error(transparent)]
    Video(#[from] video::VideoError),
    /// The geometry of a frame could not be computed.
    #[error(transparent)]
    Geometry(#[from] GeometryError),
    /// A reader could not decode a message.
    #[error(transparent)]
    Live(#[from] tmpi_core::live::LiveError),
    /// A view could not be rendered.
    #[error(transparent)]
    Render(#[from] tmpi_render::RenderError),
    /// A file could not be written.
    #[error("{0}")]
    Write(PathBuf, #[source] std::io::Error),
}

/// Settings of a measurement.
#[derive(Clone)]
pub struct Settings {
    /// Size of the frames.
    pub size: (u32, u32),
    /// Seed of the first scene; the next two seeds are used too.
    pub seed: u64,
    /// Frames per sequence.
    pub frames: u32,
    /// Sends only every Nth frame; the camera takes 30 per second.
    pub every: u32,
    /// H.264 bits per second; `None`: JPEG frames.
    pub bitrate: Option<u32>,
    /// Milliseconds that the geometry of a frame may take; 0: no limit.
    pub frame_ms: f64,
    /// Renders the side view every Nth frame, and for the frame after it.
    pub views: u32,
    /// The networks. Without a depth network, only measured depth can be used.
    pub models: Models,
    /// Whether depth can be estimated.
    pub depth: bool,
    /// Aligns estimated disparity with the true scale before it is used.
    pub true_scale: bool,
    /// Allowed parallax error of planes, in pixels.
    pub max_error: f64,
    /// Reprojection error, in pixels, below which a tile is not sent again.
    pub parallax: f64,
    /// Time after sending tiles during which no others are sent.
    pub cooldown: Duration,
    /// Number of frames by which tiles reach readers late.
    pub late: u32,
    /// Maximum number of frames for which readers' labels follow motion.
    pub follow: u32,
    /// When to estimate depth again near past motion.
    pub recheck: tmpi_live::RecheckSettings,
    /// Measures only the sequence of this name.
    pub only: Option<String>,
    /// Folder for the streams and some pictures.
    pub files: Option<PathBuf>,
}

/// Means over the frames of a sequence. Bytes and milliseconds are per frame.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Figures {
    /// Name of the sequence.
    pub sequence: &'static str,
    /// `h264` or `jpeg`.
    pub codec: &'static str,
    /// Bytes of video, including messages.
    pub video_bytes: f64,
    /// Bytes of geometry, including messages.
    pub geometry_bytes: f64,
    /// Bytes of sound, including messages: Opus at the rate of the publishing page.
    pub sound_bytes: f64,
    /// Bytes of planes in the geometry.
    pub plane_bytes: f64,
    /// Bytes of labels in the geometry; the rest is headers.
    pub label_bytes: f64,
    /// Number of chunks in frames with any.
    pub chunks: f64,
    /// Bytes of a snapshot: all tiles of a frame as one chunk.
    pub snapshot_bytes: f64,
    /// Video, geometry and sound, in kbit/s.
    pub kbit_s: f64,
    /// Fraction of geometry in these bytes.
    pub geometry_share: f64,
    /// Bytes of a noisy frame as JPEG (4:4:4) with the PSNR of the video, over the frames for which views are rendered.
    pub jpeg_bytes: f64,
    /// Total bytes as a fraction of these.
    pub jpeg_share: f64,
    /// PSNR of decoded frames against frames without noise, in dB.
    pub video_psnr: f64,
    /// PSNR of the JPEG files, which may not reach that of the video.
    pub jpeg_psnr: f64,
    /// Quality of the JPEG files.
    pub jpeg_quality: f64,
    /// Fraction of tiles that were not sent.
    pub left_out: f64,
    /// Fraction of truly unchanged tiles that were detected; 0 if there are none.
    pub unchanged_found: f64,
    /// Fraction of truly unchanged tiles that were not sent; 0 if there are none.
    pub unchanged_left_out: f64,
    /// Fraction of tiles that got new planes within the tolerance, and were not sent.
    pub kept: f64,
    /// Largest reprojection error of these in pixels, for any camera in the view box.
    pub kept_off: f64,
    /// Fraction of tiles that wait for a later frame, for lack of time.
    pub waiting: f64,
    /// Fraction of tiles that may need more planes, for lack of time.
    pub coarse: f64,
    /// Input pixels of the depth network in frames where it ran; 0 if it has no choice.
    pub depth_pixels: f64,
    /// Largest difference between a pixel and the one that its depth belongs to, in levels.
    pub left_out_off: u8,
    /// Number of pixels that differ between the identity view and the frame, over all views.
    pub own_view_off: u64,
    /// PSNR, in dB, of uncovered pixels with remembered colours, from the fifth second on; 0 before. The camera itself does not see them.
    pub uncovered_psnr: f64,
    /// The same with all colours inpainted.
    pub uncovered_psnr_made_up: f64,
    /// The same with true colours on the hidden texels behind the object, so that only errors of the planes remain; 0 if the camera moves.
    pub uncovered_psnr_most: f64,
    /// Fraction of these pixels that the camera saw in an earlier frame. The others can only be inpainted.
    pub seen_before: f64,
    /// PSNR of the pixels seen before, with remembered colours.
    pub seen_before_psnr: f64,
    /// The same with all colours inpainted.
    pub seen_before_psnr_made_up: f64,
    /// PSNR of hidden texels behind the object, with remembered colours, against the same layers with true colours: independent of errors
    /// in the reader's depth.
    pub own_depth_psnr: f64,
    /// The same with all colours inpainted.
    pub own_depth_psnr_made_up: f64,
    /// Pixels by which the shown object falls short of its left and right edges; 0 without an object.
    pub torn: f64,
    /// 95th percentile of that over the frames.
    pub torn_p95: f64,
    /// Pixels by which the shown object extends beyond its edges.
    pub fringe: f64,
    /// A reader's time to update its layers and its memory.
    pub layers_ms: f64,
    /// 95th percentile of that.
    pub layers_ms_p95: f64,
    /// PSNR of the side view, in dB.
    pub psnr: f64,
    /// The same, if each frame is processed separately.
    pub psnr_separate: f64,
    /// SSIM of the side view.
    pub ssim: f64,
    /// The same, if each frame is processed separately.
    pub ssim_separate: f64,
    /// Distance, in pixels, between the positions at which neighbouring tiles show a common point, seen from the border of the view box.
    pub seam: f64,
    /// The same, if each frame is processed separately.
    pub seam_separate: f64,
    /// Fraction of these points with a distance of more than a pixel.
    pub seam_wide: f64,
    /// The same, if each frame is processed separately.
    pub seam_wide_separate: f64,
    /// Mean change of the side view, in levels, between the previous frame's tiles and the new ones, where the truth does not change. Both
    /// views show the same frame, which excludes the video's noise.
    pub flicker: f64,
    /// The same, if each frame is processed separately.
    pub flicker_separate: f64,
    /// The same, where no nearby tile was sent.
    pub flicker_left_out: f64,
    /// Decoding on the server.
    pub decode_ms: f64,
    /// Name, milliseconds and CPU milliseconds of each stage on the server.
    pub stages_ms: Vec<(String, f64, f64)>,
    /// Total CPU time on the server.
    pub server_cpu_ms: f64,
    /// Total time on the server.
    pub server_ms: f64,
    /// Longest time of a frame on the server.
    pub server_ms_most: f64,
    /// 95th percentile of the time on the server.
    pub server_ms_p95: f64,
    /// A reader's time to decode chunks.
    pub read_ms: f64,
    /// Time for the masks of all layers, not only changed ones.
    pub masks_ms: f64,
    /// Time to inpaint all hidden texels.
    pub fill_ms: f64,
}

/// Figures of all sequences.
#[derive(Clone, Debug, Serialize)]
pub struct Results {
    /// Width and height.
    pub size: (u32, u32),
    /// Frames per sequence.
    pub frames: u32,
    /// One row per sequence.
    pub rows: Vec<Figures>,
    /// Skipped sequences, each with the reason.
    pub skipped: Vec<String>,
}

/// Measures all sequences; calls `progress` with the name of each.
///
/// # Errors
/// [`LiveBenchError`].
pub fn run(settings: &Settings, progress: &dyn Fn(&str)) -> Result<Results, LiveBenchError> {
    let (mut rows, mut skipped) = (Vec::new(), Vec::new());
    for kind in Kind::ALL {
        if settings.only.as_ref().is_some_and(|name| name != kind.slug()) {
            continue;
        }
        if !settings.depth && kind != Kind::Measured {
            skipped.push(format!("{}: there is no depth network", kind.name()));
            continue;
        }
        progress(kind.name());
        let sequence = Sequence::new(kind, settings.seed, settings.size, settings.frames * settings.every, measure::SIDE_OFFSET);
        rows.push(measure::run(settings, kind, &sequence)?);
    }
    Ok(Results { size: settings.size, frames: settings.frames, rows, skipped })
}

/// Settings of the room for a sequence.
fn room(settings: &Settings, sequence: &Sequence, frame_ms: f64, separate: bool) -> Room {
    let (k, width) = (sequence.intrinsics(), 2.0 * sequence.intrinsics().cx);
    // processing frames separately is the photo pipeline, with a photo's parallax error
    let max_error = if separate { Options::default().max_error } else { settings.max_error };
    let options = Options { fov_x: Some(k.fov_x(width as u32)), max_error, ..Options::default() };
    Room {
        options,
        parallax: settings.parallax,
        cooldown: settings.cooldown,
        recheck: settings.recheck,
        frame_ms,
        separate,
        ..Room::default()
    }
}

/// Creates the encoder: H.264, or JPEG without a bit rate.
fn encoder(size: (u32, u32), bitrate: Option<u32>) -> Result<Box<dyn Encoder>, LiveBenchError> {
    Ok(match bitrate {
        Some(bitrate) => Box::new(encode::H264::new(size, bitrate)?),
        None => Box::new(encode::Jpeg { quality: encode::QUALITY }),
    })
}

/// Learns the initial state of the chunk coders (`crates/core/src/live/coder_prior.in`) from the chunks of rendered sequences.
///
/// # Errors
/// [`LiveBenchError`].
pub fn learn(settings: &Settings, progress: &dyn Fn(&str)) -> Result<String, LiveBenchError> {
    let mut learning = Learning::default();
    for lesson in 0..LESSONS.0 {
        progress(&format!("lesson {} of {}", lesson + 1, LESSONS.0));
        let kind = if lesson % 3 == 2 { Kind::Moving } else { Kind::Still };
        let sequence = Sequence::new(kind, TRAINING_SEED + 3 * lesson, settings.size, LESSONS.1, measure::SIDE_OFFSET);
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
    /// The figures as a text table with one column per sequence.
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
        line("video, bytes per frame", &|f| format!("{} {:.0}", f.codec, f.video_bytes));
        line("geometry, bytes (planes, labels)", &|f| format!("{:.0} ({:.0}, {:.0})", f.geometry_bytes, f.plane_bytes, f.label_bytes));
        line("chunks in frames with any", &|f| format!("{:.1}", f.chunks));
        line("snapshot, bytes", &|f| format!("{:.0}", f.snapshot_bytes));
        line("sound, bytes", &|f| format!("{:.0}", f.sound_bytes));
        line("total, kbit/s", &|f| format!("{:.0}", f.kbit_s));
        line("geometry, % of total", &|f| format!("{:.1} %", 100.0 * f.geometry_share));
        line("JPEG of every frame (quality)", &|f| format!("{:.0} ({:.1})", f.jpeg_bytes, f.jpeg_quality));
        line("total, % of JPEG", &|f| format!("{:.1} %", 100.0 * f.jpeg_share));
        line("PSNR of video / JPEG, dB", &|f| format!("{:.1} / {:.1}", f.video_psnr, f.jpeg_psnr));
        line("tiles not sent", &|f| format!("{:.1} %", 100.0 * f.left_out));
        line("new planes within tolerance", &|f| format!("{:.1} %", 100.0 * f.kept));
        line("their largest error, px", &|f| format!("{:.3}", f.kept_off));
        line("tiles late: waiting / coarse", &|f| format!("{:.1} / {:.1} %", 100.0 * f.waiting, 100.0 * f.coarse));
        line("depth network, pixels", &|f| format!("{:.0}", f.depth_pixels));
        line("unchanged: detected / not sent", &|f| format!("{:.1} / {:.1} %", 100.0 * f.unchanged_found, 100.0 * f.unchanged_left_out));
        line("unsent pixels: max off, levels", &|f| f.left_out_off.to_string());
        line("identity view: pixels off", &|f| f.own_view_off.to_string());
        let uncovered = |f: &Figures| format!("{:.2} / {:.2} / {:.2}", f.uncovered_psnr, f.uncovered_psnr_made_up, f.uncovered_psnr_most);
        line("uncovered: memory/inpaint/true, dB", &uncovered);
        line("uncovered pixels seen earlier", &|f| format!("{:.1} %", 100.0 * f.seen_before));
        line("seen earlier: memory/inpaint, dB", &|f| format!("{:.2} / {:.2}", f.seen_before_psnr, f.seen_before_psnr_made_up));
        line("same, by the reader's depth, dB", &|f| format!("{:.2} / {:.2}", f.own_depth_psnr, f.own_depth_psnr_made_up));
        let torn = |f: &Figures| format!("{:.2} ({:.2}) / {:.2}", f.torn, f.torn_p95, f.fringe);
        line("edge short (p95) / beyond, px", &torn);
        line("PSNR side view / separate", &|f| format!("{:.2} / {:.2}", f.psnr, f.psnr_separate));
        line("SSIM side view / separate", &|f| format!("{:.3} / {:.3}", f.ssim, f.ssim_separate));
        line("seams / separate, px", &|f| format!("{:.3} / {:.3}", f.seam, f.seam_separate));
        line("seams over 1 px / separate, %", &|f| format!("{:.2} / {:.2}", 100.0 * f.seam_wide, 100.0 * f.seam_wide_separate));
        line("flicker / separate, levels", &|f| format!("{:.3} / {:.3}", f.flicker, f.flicker_separate));
        line("flicker in unsent tiles", &|f| format!("{:.3}", f.flicker_left_out));
        line("server: decode, ms", &|f| format!("{:.2}", f.decode_ms));
        for name in self.rows.first().map(|r| r.stages_ms.clone()).unwrap_or_default().iter().map(|(n, ..)| n) {
            let of = |f: &Figures| f.stages_ms.iter().find(|(n, ..)| n == name).map_or((0.0, 0.0), |(_, ms, cpu)| (*ms, *cpu));
            line(&format!("server: {name}, ms (CPU)"), &|f| format!("{:.2} ({:.2})", of(f).0, of(f).1));
        }
        line("server: total, CPU ms", &|f| format!("{:.1}", f.server_cpu_ms));
        line("server: total, ms (p95, max)", &|f| format!("{:.1} ({:.1}, {:.1})", f.server_ms, f.server_ms_p95, f.server_ms_most));
        line("reader: chunks, ms", &|f| format!("{:.2}", f.read_ms));
        line("reader: layers, ms (p95)", &|f| format!("{:.1} ({:.1})", f.layers_ms, f.layers_ms_p95));
        line("reader: all masks / inpaint, ms", &|f| format!("{:.1} / {:.1}", f.masks_ms, f.fill_ms));
        out
    }
}
