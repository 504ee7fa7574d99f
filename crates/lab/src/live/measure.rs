//! One sequence from the camera to a reader.

use std::sync::Arc;
use std::time::Instant;

use tmpi_core::live::{Model, wire};
use tmpi_core::{Camera, Geometry, Inpainter, Photo, TexturedLayer, compose};
use tmpi_live::{Frame, Geometry as Driver, video};
use tmpi_render::difference::psnr;
use tmpi_render::{Cpu, Renderer};

use super::encode::{Encoder as _, Jpeg};
use super::sequence::{Kind, Sequence, Shot};
use super::{Figures, LiveBenchError, Settings, encoder, room};
use crate::metrics::ssim_map;

/// How far beside the camera views are drawn: the border of the default view box.
pub const ASIDE: f64 = 0.03;
/// Quality of the JPEG files that video is compared with.
pub const QUALITY: u8 = 90;
/// Share of a view that is left out on each side, as in the paper.
const CROP: f64 = 0.15;

/// A reader, and what it shows.
struct Reader {
    model: Option<Model>,
    renderer: Cpu,
    /// The last view drawn, and the truth of it.
    last: Option<(Photo, Photo)>,
    psnr: Mean,
    ssim: Mean,
    flicker: Mean,
    flicker_left_out: Mean,
}

#[derive(Clone, Copy, Default)]
struct Mean(f64, f64);

impl Mean {
    fn add(&mut self, value: f64) {
        self.0 += value;
        self.1 += 1.0;
    }

    fn get(self) -> f64 {
        if self.1 > 0.0 { self.0 / self.1 } else { 0.0 }
    }
}

fn ms(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

/// Runs a sequence through a room that carries its geometry on, and through one that does not.
pub(super) fn run(settings: &Settings, kind: Kind, sequence: &Sequence) -> Result<Figures, LiveBenchError> {
    let mut f = Figures { sequence: kind.name(), codec: if settings.bitrate.is_some() { "h264" } else { "jpeg" }, ..Figures::default() };
    let mut encoder = encoder(settings)?;
    let mut decoder = video::decoder(encoder.codec(), settings.size)?;
    let mut carried = Driver::new(settings.models.clone(), room(sequence, settings.frame_ms, false));
    let mut separate = Driver::new(settings.models.clone(), room(sequence, 0.0, true));
    let (mut reader, mut other) = (Reader::new(), Reader::new());
    let mut last: Option<Photo> = None;
    let (mut tiles, mut still, mut found) = (0usize, 0usize, 0usize);
    let (mut snapshots, mut video_psnr, mut jpeg_psnr, mut masks, mut fill) =
        (Mean::default(), Mean::default(), Mean::default(), Mean::default(), Mean::default());
    for n in 0..settings.frames {
        let shot = sequence.shot(n);
        let (data, _) = encoder.encode(&shot.noisy)?;
        f.video_bytes += data.len() as f64;
        let before = Instant::now();
        let Some(photo) = decoder.decode(&data)? else { continue };
        let decode_ms = ms(before);
        f.decode_ms += decode_ms;
        let (jpeg, _) = Jpeg { quality: QUALITY }.encode(&shot.noisy)?;
        f.jpeg_bytes += jpeg.len() as f64;
        if n % settings.views == 0 {
            video_psnr.add(psnr(photo.rgb.as_flattened(), shot.clean.rgb.as_flattened()));
            if let Ok(Some(jpeg)) = video::decoder(video::JPEG, settings.size).and_then(|mut d| d.decode(&jpeg)) {
                jpeg_psnr.add(psnr(jpeg.rgb.as_flattened(), shot.clean.rgb.as_flattened()));
            }
        }
        let depth = (kind == Kind::Measured).then(|| shot.delta.clone());
        let frame = Frame { number: n.into(), photo, depth };
        let before = Instant::now();
        let update = carried.next(&frame)?;
        let server_ms = ms(before) + decode_ms;
        f.server_ms += server_ms;
        f.server_ms_most = f.server_ms_most.max(server_ms);
        for s in &update.stages {
            add(&mut f.stages_ms, &s.name, s.ms);
        }
        add(&mut f.stages_ms, "chunks", update.coding_ms);
        let message = wire::Geometry { frame: n.into(), chunks: update.chunks.clone() };
        if !message.chunks.is_empty() {
            f.plane_bytes += message.chunks.iter().map(|c| c.plane_data.len() as f64).sum::<f64>();
            f.geometry_bytes += tmpi_core::live::write(wire::message::Kind::Geometry(message.clone())).len() as f64;
        }
        if let Some(g) = carried.geometry() {
            tiles += g.tiles.len();
            for t in 0..g.grid.tiles() {
                let truly = last.as_ref().is_some_and(|l| same(l, &shot.clean, g.grid.rect(t)));
                still += usize::from(truly);
                found += usize::from(truly && !update.changed.contains(&t));
            }
            f.left_out += (g.tiles.len() - update.sent.len()) as f64;
            let before = Instant::now();
            let model = reader.model.get_or_insert(Model::new(&Model::hello(g))?);
            model.take(&message)?;
            f.read_ms += ms(before);
        }
        if n % settings.views <= 1 {
            if let Some(snapshot) = carried.snapshot(n.into())? {
                let geometry = wire::Geometry { frame: n.into(), chunks: vec![snapshot] };
                snapshots.add(tmpi_core::live::write(wire::message::Kind::Snapshot(geometry)).len() as f64);
            }
            let known = reader.model.as_ref().and_then(Model::geometry).cloned();
            if let Some(g) = known {
                let (mask_ms, fill_ms) = reader.show(&g, &frame.photo, sequence, &shot, n % settings.views == 1, &update.changed)?;
                masks.add(mask_ms);
                fill.add(fill_ms);
            }
            separate.next(&frame)?;
            if let Some(g) = separate.geometry().cloned() {
                other.show(&g, &frame.photo, sequence, &shot, n % settings.views == 1, &[])?;
            }
        }
        last = Some(shot.clean);
    }
    let frames = f64::from(settings.frames.max(1));
    for sum in [
        &mut f.video_bytes,
        &mut f.geometry_bytes,
        &mut f.plane_bytes,
        &mut f.jpeg_bytes,
        &mut f.decode_ms,
        &mut f.server_ms,
        &mut f.read_ms,
    ] {
        *sum /= frames;
    }
    f.stages_ms.iter_mut().for_each(|(_, ms)| *ms /= frames);
    f.kbit_s = (f.video_bytes + f.geometry_bytes) * 30.0 * 8.0 / 1e3;
    f.left_out /= tiles.max(1) as f64;
    f.unchanged_found = found as f64 / still.max(1) as f64;
    (f.snapshot_bytes, f.video_psnr, f.jpeg_psnr) = (snapshots.get(), video_psnr.get(), jpeg_psnr.get());
    (f.masks_ms, f.fill_ms) = (masks.get(), fill.get());
    (f.psnr, f.ssim, f.flicker, f.flicker_left_out) =
        (reader.psnr.get(), reader.ssim.get(), reader.flicker.get(), reader.flicker_left_out.get());
    (f.psnr_separate, f.ssim_separate, f.flicker_separate) = (other.psnr.get(), other.ssim.get(), other.flicker.get());
    Ok(f)
}

fn add(sums: &mut Vec<(String, f64)>, name: &str, value: f64) {
    match sums.iter_mut().find(|(n, _)| n == name) {
        Some((_, sum)) => *sum += value,
        None => sums.push((name.to_owned(), value)),
    }
}

/// True where two pictures are the same within a rectangle.
fn same(a: &Photo, b: &Photo, r: tmpi_core::Rect) -> bool {
    (r.y..r.y + r.h).all(|y| {
        let row = y as usize * a.width as usize + r.x as usize;
        a.rgb[row..row + r.w as usize] == b.rgb[row..row + r.w as usize]
    })
}

impl Reader {
    fn new() -> Self {
        let none = Mean::default;
        Self { model: None, renderer: Cpu::default(), last: None, psnr: none(), ssim: none(), flicker: none(), flicker_left_out: none() }
    }

    /// Draws the view from beside the camera and compares it with the truth, and with the frame before where it `follows` one. Gives the
    /// milliseconds that masks and hidden colours took.
    fn show(
        &mut self,
        g: &Geometry,
        photo: &Photo,
        sequence: &Sequence,
        shot: &Shot,
        follows: bool,
        changed: &[u32],
    ) -> Result<(f64, f64), LiveBenchError> {
        let before = Instant::now();
        let shapes = g.masks();
        let masks_ms = ms(before);
        let before = Instant::now();
        let colours = Inpainter::new(photo, g).fill_all(&shapes);
        let fill_ms = ms(before);
        let tiles = shapes.into_iter().zip(colours);
        let tiles = tiles.map(|(s, c)| s.layers.into_iter().zip(c).map(|(shape, hidden)| TexturedLayer { shape, hidden }).collect());
        let scene = Arc::new(compose(photo.clone(), g, tiles.collect()));
        let camera = Camera { pose: sequence.beside(), intrinsics: g.intrinsics, width: photo.width, height: photo.height };
        let view = self.renderer.render(&scene, &camera)?;
        let view = Photo { width: view.width, height: view.height, rgb: view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect() };
        self.psnr.add(psnr(cropped(&view).as_flattened(), cropped(&shot.beside).as_flattened()));
        let ssim = ssim_map(&cropped(&view), &cropped(&shot.beside), inner(view.width).len());
        self.ssim.add(ssim.iter().map(|v| f64::from(*v)).sum::<f64>() / ssim.len().max(1) as f64);
        if follows && let Some((last, truth)) = &self.last {
            // where nothing that changed is near: tiles and what parallax brings to them
            let calm: Vec<bool> = calm(g, changed);
            let (mut all, mut left) = (Mean::default(), Mean::default());
            let pixels = view.rgb.iter().zip(&last.rgb).zip(shot.beside.rgb.iter().zip(&truth.rgb)).zip(&calm);
            for (((now, was), (true_now, true_was)), calm) in pixels {
                if true_now == true_was {
                    let change = now.iter().zip(was).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / 3.0;
                    all.add(change);
                    if *calm {
                        left.add(change);
                    }
                }
            }
            self.flicker.add(all.get());
            if left.1 > 0.0 {
                self.flicker_left_out.add(left.get());
            }
        }
        self.last = Some((view, shot.beside.clone()));
        Ok((masks_ms, fill_ms))
    }
}

/// Pixels that no changed tile, nor one beside it, has.
fn calm(g: &Geometry, changed: &[u32]) -> Vec<bool> {
    let mut calm = vec![true; g.grid.width as usize * g.grid.height as usize];
    for t in changed {
        let r = tmpi_core::grown(g.grid.rect(*t), g.grid.size, g.grid.size, &g.grid);
        for y in r.y..r.y + r.h {
            let row = y as usize * g.grid.width as usize + r.x as usize;
            calm[row..row + r.w as usize].fill(false);
        }
    }
    calm
}

fn inner(side: u32) -> std::ops::Range<u32> {
    let crop = (f64::from(side) * CROP) as u32;
    crop..side - crop
}

fn cropped(p: &Photo) -> Vec<[u8; 3]> {
    inner(p.height).flat_map(|y| inner(p.width).map(move |x| p.at(x, y))).collect()
}
