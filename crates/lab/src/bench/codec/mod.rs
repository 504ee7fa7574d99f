//! What a scene costs on the wire: bytes and time of several ways to send it, at equal quality of the views drawn from it.
//!
//! The scene before any coding takes its texels from the photo's pixels as they were uploaded. Views of it from four corners of the
//! view box are the original that SSIMULACRA2 and PSNR compare with. A way that has a quality gets the lowest at which its views
//! score no less than the container's.

mod avif;
mod bands;
mod candidates;
mod dictionary;
mod judge;
mod layers;
mod table;

use std::path::PathBuf;
use std::sync::Arc;

use serde::Serialize;

use super::measure::median;
use super::subject::{self, Subject};
use super::{BenchError, Machine};
use crate::metrics::{Ssimulacra2, psnr};
pub use bands::BandRow;
use candidates::{Source, Way};
use dictionary::Plain;
pub use dictionary::SharedRow;
use judge::{Judge, Score};
use tmpi_core::container::PhotoFormat;
use tmpi_core::container::{self, Carried, SectionInfo, encode_lossless};
use tmpi_core::{compose, texture};
use tmpi_pipeline::Silent;
use tmpi_pipeline::clock::Clock;
use tmpi_pipeline::photo::{self, Limits};
use tmpi_pipeline::{self, Models, Options};

/// Highest quality of a picture codec.
const BEST: u8 = 100;

/// The highest of zstd's ordinary levels.
const ZSTD_MOST: i32 = 19;

/// What has taken so long in all is not run again.
const ENOUGH_MS: f64 = 3000.0;

/// What is measured.
pub struct Settings {
    /// Folders of photos.
    pub photos: Vec<PathBuf>,
    /// Photos are cut and reduced to this size before they are uploaded, as PNG.
    pub size: Option<(u32, u32)>,
    /// How scenes are made.
    pub options: Options,
    /// The networks.
    pub models: Models,
    /// Runs a figure of time is the median of.
    pub repeats: usize,
    /// A few photos of each folder.
    pub quick: bool,
    /// The container alone.
    pub ours: bool,
    /// The container alone, with labels in bands of several sizes.
    pub bands: bool,
}

/// A way to send one scene.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// Its name.
    pub way: String,
    /// The quality chosen, where it has one.
    pub quality: Option<u8>,
    /// True where even the highest quality scores less than the container.
    pub below: bool,
    /// All that is sent.
    pub bytes: usize,
    /// Processor milliseconds of all threads.
    pub encode_cpu_ms: f64,
    /// Wall milliseconds.
    pub encode_ms: f64,
    /// Processor milliseconds; none where nothing is decoded.
    pub decode_cpu_ms: Option<f64>,
    /// Wall milliseconds.
    pub decode_ms: Option<f64>,
    /// How alike the views are to those of the scene before coding; none where there are no views.
    pub score: Option<Score>,
}

/// One scene.
#[derive(Clone, Debug, Serialize)]
pub struct Scene {
    /// File name of its photo.
    pub name: String,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Bytes of the file that was uploaded.
    pub uploaded: usize,
    /// True where the container carries that very file.
    pub kept: bool,
    /// Planes of all tiles, and texels of all layers.
    pub planes: u32,
    /// Texels of all layers.
    pub texels: usize,
    /// Sections of the container.
    pub sections: Vec<SectionInfo>,
    /// Bytes of the container for each byte of its photo.
    pub over_photo: f64,
    /// PSNR of the carried photo against the uploaded pixels, 99 where they are equal.
    pub photo_psnr: f64,
    /// SSIMULACRA2 of the same.
    pub photo_ssimulacra2: Option<f64>,
    /// All ways.
    pub rows: Vec<Row>,
    /// Index and planes with a dictionary.
    pub shared: Option<SharedRow>,
    /// Sizes of bands of labels, where they were asked for.
    pub bands: Vec<BandRow>,
}

/// Everything that was measured.
#[derive(Clone, Debug, Serialize)]
pub struct CodecResults {
    /// Version of the program.
    pub version: &'static str,
    /// Where.
    pub machine: Machine,
    /// Runs a figure of time is the median of.
    pub repeats: usize,
    /// All scenes.
    pub scenes: Vec<Scene>,
    /// What could not be measured, and why.
    pub skipped: Vec<String>,
}

/// Files that were made on the way: scene, name, bytes.
pub type Keep<'a> = &'a dyn Fn(&str, &str, &[u8]) -> Result<(), BenchError>;

/// Measures all photos; `progress` is told of each, `keep` is given every file.
///
/// # Errors
/// [`BenchError`].
pub fn run(settings: &Settings, progress: &dyn Fn(&str), keep: Keep) -> Result<CodecResults, BenchError> {
    let photos = subject::photos(&settings.photos, settings.quick)?;
    let (mut scenes, mut plain) = (Vec::new(), Vec::new());
    for s in &photos {
        progress(&s.name);
        let (scene, container) = scene(settings, s, keep)?;
        scenes.push(scene);
        plain.push(Plain::of(&container)?);
    }
    for (scene, row) in scenes.iter_mut().zip(dictionary::compare(&plain)?) {
        scene.shared = Some(row);
    }
    let skipped = avif::available().err().map(|why| format!("AVIF: {why}")).into_iter().collect();
    Ok(CodecResults { version: env!("CARGO_PKG_VERSION"), machine: Machine::this(), repeats: settings.repeats, scenes, skipped })
}

/// The photo cut to the aspect of `size` about its middle, reduced, and written without loss.
fn cut(file: &[u8], size: (u32, u32)) -> Result<Vec<u8>, BenchError> {
    let broken = |e: photo::PhotoError| BenchError::Picture(e.to_string());
    let p = photo::decode(file, &Limits::default(), None).map_err(broken)?.photo;
    let scale = (f64::from(p.width) / f64::from(size.0)).min(f64::from(p.height) / f64::from(size.1));
    let side = |s: u32, most: u32| ((f64::from(s) * scale).round() as u32).clamp(1, most);
    let (w, h) = (side(size.0, p.width), side(size.1, p.height));
    let (x0, y0) = ((p.width - w) / 2, (p.height - h) / 2);
    let rgb = (y0..y0 + h).flat_map(|y| (x0..x0 + w).map(move |x| (x, y))).map(|(x, y)| p.at(x, y)).collect();
    let p = photo::resize(&tmpi_core::Photo { width: w, height: h, rgb }, size.0, size.1);
    Ok(encode_lossless(image::ImageFormat::Png, p.width, p.height, p.rgb.as_flattened())?)
}

/// Measures one photo; gives its container too.
fn scene(settings: &Settings, s: &Subject, keep: Keep) -> Result<(Scene, Vec<u8>), BenchError> {
    let cut = settings.size.map(|size| cut(&s.file, size)).transpose()?;
    let file = cut.as_ref().unwrap_or(&s.file);
    let failed = |source| BenchError::Make { subject: s.name.clone(), source };
    let made = tmpi_pipeline::make(&settings.models, &Limits::default(), file, None, &settings.options, &Silent).map_err(failed)?;
    let uploaded = photo::decode(file, &Limits::default(), settings.options.max_size).map_err(|e| BenchError::Picture(e.to_string()))?;
    let (decoded, geometry) = container::read(&made.container)?;
    let photo = uploaded.photo;
    let sections = container::sections(&made.container)?;
    let of = |kind: &str| sections.iter().find(|s| s.kind == kind);
    let carried = of("photo").map_or(&[][..], |s| &made.container[s.offset as usize..(s.offset + s.length) as usize]);
    let kept = uploaded.carried.filter(|k| k == carried);
    let kept = kept.map(|bytes| Carried { format: PhotoFormat::sniff(&bytes).unwrap_or(PhotoFormat::Jpeg), bytes });
    let mut out = Scene {
        name: s.name.clone(),
        width: photo.width,
        height: photo.height,
        uploaded: file.len(),
        kept: kept.is_some(),
        planes: geometry.planes() as u32,
        texels: 0,
        over_photo: made.container.len() as f64 / carried.len().max(1) as f64,
        photo_psnr: psnr(photo.rgb.as_flattened(), decoded.rgb.as_flattened()),
        photo_ssimulacra2: Ssimulacra2::of(&photo.rgb, photo.width as usize).and_then(|s| s.score(&decoded.rgb)),
        rows: Vec::new(),
        shared: None,
        bands: Vec::new(),
        sections,
    };
    let before = compose(photo.clone(), &geometry, texture(&photo, &geometry, geometry.masks()));
    out.texels = before.texels.class.len();
    let source = Source::new(geometry, Arc::new(before), kept, settings.options.quality, made.disparity);
    if settings.bands {
        out.bands = bands::compare(&source, settings.repeats)?;
        return Ok((out, made.container));
    }
    let judge = Judge::of(&source.scene)?;
    let mut target = f64::NEG_INFINITY;
    let ways = if settings.ours { vec![Way::Ours] } else { Way::all(avif::available().is_ok()) };
    for way in ways {
        let row = row(settings, way, &source, &judge, target)?;
        keep(
            &s.name,
            &format!("{}.{}", row.0.way.replace([',', '+'], "").split_whitespace().collect::<Vec<_>>().join("-"), way.extension()),
            &row.1,
        )?;
        if way == Way::Ours {
            target = row.0.score.map_or(target, |s| s.ssimulacra2);
        }
        out.rows.push(row.0);
    }
    Ok((out, made.container))
}

/// Measures one way, at the lowest quality that scores `target` where it has one; gives its bytes too.
fn row(settings: &Settings, way: Way, source: &Source, judge: &Judge, target: f64) -> Result<(Row, Vec<u8>), BenchError> {
    let score = |quality: u8| -> Result<Option<Score>, BenchError> {
        way.decode(source, &way.encode(source, quality)?)?.map(|s| judge.score(&s)).transpose()
    };
    let reaches = |quality: u8| Ok::<_, BenchError>(score(quality)?.is_some_and(|s| s.ssimulacra2 >= target));
    let mut quality = BEST;
    if way.lossy() {
        let mut lowest = 1;
        // the score grows with the quality
        while lowest < quality {
            let middle = u8::midpoint(lowest, quality);
            if reaches(middle)? { quality = middle } else { lowest = middle + 1 }
        }
    }
    let (encode, bytes) = timed(settings.repeats, || way.encode(source, quality))?;
    let (decode, scene) = timed(settings.repeats, || way.decode(source, &bytes))?;
    let score = scene.as_ref().map(|s| judge.score(s)).transpose()?;
    let row = Row {
        way: way.name(),
        quality: way.lossy().then_some(quality),
        below: score.is_some_and(|s| s.ssimulacra2 < target),
        bytes: bytes.len(),
        encode_ms: encode.0,
        encode_cpu_ms: encode.1,
        decode_ms: scene.is_some().then_some(decode.0),
        decode_cpu_ms: scene.is_some().then_some(decode.1),
        score,
    };
    Ok((row, bytes))
}

/// Median wall and processor milliseconds, and what the last run gave.
fn timed<T>(repeats: usize, mut run: impl FnMut() -> Result<T, BenchError>) -> Result<((f64, f64), T), BenchError> {
    let (mut wall, mut cpu) = (Vec::new(), Vec::new());
    loop {
        let clock = Clock::start();
        let done = run()?;
        wall.push(clock.ms());
        cpu.push(clock.cpu_ms());
        if wall.len() >= repeats || wall.iter().sum::<f64>() > ENOUGH_MS {
            return Ok(((median(wall), median(cpu)), done));
        }
    }
}
