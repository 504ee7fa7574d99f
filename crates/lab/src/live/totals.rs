//! Accumulates results over the frames of a sequence.

use tmpi_core::live::schema;
use tmpi_core::{DisparityMap, Geometry, Photo};
use tmpi_live::Update;

use super::Figures;
use super::baseline::{AsJpeg, sound_bytes};
use super::sequence::BEHIND;
use super::side_view::Mean;

/// Pixels on both sides of the object's edge in which its shown edge may be.
const EDGE: isize = 14;

/// Sums and means over the frames.
#[derive(Default)]
pub(super) struct Totals {
    /// All tiles; truly unchanged ones; unchanged ones that were detected; unchanged ones that were not sent.
    tiles: usize,
    still: usize,
    found: usize,
    still_left_out: usize,
    left_out: usize,
    kept: usize,
    waiting: usize,
    coarse: usize,
    depth_pixels: Mean,
    pub snapshots: Mean,
    /// Number of chunks in frames with any.
    pub chunks: Mean,
    pub video_psnr: Mean,
    jpeg: [Mean; 3],
    /// Milliseconds of each frame on the server.
    pub clocks: Vec<f64>,
    /// Milliseconds of each frame in the reader's layers.
    pub layers: Vec<f64>,
    /// For each frame, the pixels inside the object's edge that are shown as background, and those outside that are shown as object.
    torn: Vec<f64>,
    fringe: Mean,
}

impl Totals {
    /// Counts the tiles of a frame; `truth` is the true previous frame and the true current one.
    pub fn count(&mut self, g: &Geometry, update: &Update, truth: Option<(&Photo, &Photo)>) {
        self.tiles += g.tiles.len();
        self.left_out += g.tiles.len() - update.sent.len();
        self.kept += update.kept.len();
        (self.waiting, self.coarse) = (self.waiting + update.waiting, self.coarse + update.coarse);
        if let Some((w, h)) = update.depth_size {
            self.depth_pixels.add(f64::from(w) * f64::from(h));
        }
        for t in 0..g.grid.tiles() {
            let truly = truth.is_some_and(|(before, now)| same(before, now, g.grid.rect(t)));
            self.still += usize::from(truly);
            self.found += usize::from(truly && !update.changed.contains(&t));
            self.still_left_out += usize::from(truly && !update.sent.contains(&t));
        }
    }

    /// Counts the pixels that `g` shows on the wrong side of the object's left and right edges, in each row that crosses the object.
    /// `truth` and `plate` are the disparity with and without the object. The levels on both sides come from the shown surface, so only the
    /// position of the edge counts.
    pub fn edges(&mut self, g: &Geometry, (truth, plate): (&DisparityMap, &DisparityMap)) {
        let (surface, width) = (g.surface(), truth.width as usize);
        let (mut count, mut torn, mut fringe) = (0.0, 0.0, 0.0);
        for ((shown, truth), plate) in surface.all().chunks(width).zip(truth.delta.chunks(width)).zip(plate.delta.chunks(width)) {
            let is_object = |x: &usize| truth[*x] - plate[*x] > BEHIND;
            let (Some(first), Some(last)) = ((0..width).find(is_object), (0..width).rev().find(is_object)) else { continue };
            for (edge, step) in [(first as isize, 1), (last as isize, -1)] {
                let at = |steps: isize| usize::try_from(edge + step * steps).ok().filter(|x| *x < width).map(|x| shown[x]);
                let Some((inside, outside)) = at(EDGE - 1).zip(at(-EDGE)).filter(|(i, o)| i - o > BEHIND) else { continue };
                let middle = f32::midpoint(inside, outside);
                let share =
                    |steps: std::ops::Range<isize>, wrong: &dyn Fn(f32) -> bool| steps.filter_map(at).filter(|d| wrong(*d)).count() as f64;
                count += 1.0;
                torn += share(0..EDGE, &|d| d < middle);
                fringe += share(-EDGE..0, &|d| d > middle);
            }
        }
        if count > 0.0 {
            self.torn.push(torn / count);
            self.fringe.add(fringe / count);
        }
    }

    /// Adds a frame encoded as JPEG.
    pub fn jpeg(&mut self, jpeg: AsJpeg) {
        let AsJpeg { quality, psnr, bytes } = jpeg;
        self.jpeg.iter_mut().zip([quality, psnr, bytes]).for_each(|(mean, value)| mean.add(value));
    }

    /// Computes the means over all frames. Each frame stands for `every` frames at 30 frames a second.
    pub fn finish(mut self, f: &mut Figures, frames: u32, every: u32) {
        self.clocks.sort_by(f64::total_cmp);
        f.server_ms_most = self.clocks.last().copied().unwrap_or_default();
        f.server_ms_p95 = self.clocks.get(self.clocks.len() * 95 / 100).copied().unwrap_or_default();
        self.layers.sort_by(f64::total_cmp);
        f.layers_ms = self.layers.iter().sum::<f64>() / self.layers.len().max(1) as f64;
        f.layers_ms_p95 = self.layers.get(self.layers.len() * 95 / 100).copied().unwrap_or_default();
        let (frames, every) = (f64::from(frames.max(1)), f64::from(every));
        for sum in [
            &mut f.video_bytes,
            &mut f.geometry_bytes,
            &mut f.plane_bytes,
            &mut f.label_bytes,
            &mut f.decode_ms,
            &mut f.server_ms,
            &mut f.server_cpu_ms,
            &mut f.read_ms,
        ] {
            *sum /= frames;
        }
        f.stages_ms.iter_mut().for_each(|(_, ms, cpu)| (*ms, *cpu) = (*ms / frames, *cpu / frames));
        self.torn.sort_by(f64::total_cmp);
        f.torn = self.torn.iter().fold(0.0, |sum, torn| sum + torn) / self.torn.len().max(1) as f64;
        f.torn_p95 = self.torn.get(self.torn.len() * 95 / 100).copied().unwrap_or_default();
        f.fringe = self.fringe.get();
        let share = |part: usize, of: usize| part as f64 / of.max(1) as f64;
        (f.left_out, f.kept) = (share(self.left_out, self.tiles), share(self.kept, self.tiles));
        (f.waiting, f.coarse, f.depth_pixels) = (share(self.waiting, self.tiles), share(self.coarse, self.tiles), self.depth_pixels.get());
        (f.unchanged_found, f.unchanged_left_out) = (share(self.found, self.still), share(self.still_left_out, self.still));
        [f.jpeg_quality, f.jpeg_psnr, f.jpeg_bytes] = self.jpeg.map(Mean::get);
        f.chunks = self.chunks.get();
        (f.snapshot_bytes, f.video_psnr, f.sound_bytes) = (self.snapshots.get(), self.video_psnr.get(), every * sound_bytes());
        let all = f.video_bytes + f.geometry_bytes + f.sound_bytes;
        f.kbit_s = all * 30.0 / every * 8.0 / 1e3;
        (f.geometry_share, f.jpeg_share) = (f.geometry_bytes / all, all / f.jpeg_bytes.max(1.0));
    }
}

/// Adds the bytes and chunks of a geometry message.
pub(super) fn add_bytes(f: &mut Figures, chunks: &mut Mean, message: &schema::Geometry) {
    if !message.chunks.is_empty() {
        chunks.add(message.chunks.len() as f64);
        f.label_bytes += message.chunks.iter().map(|c| c.label_data.len() as f64).sum::<f64>();
        f.plane_bytes += message.chunks.iter().map(|c| c.plane_data.len() as f64).sum::<f64>();
        f.geometry_bytes += tmpi_core::live::write(schema::message::Kind::Geometry(message.clone())).len() as f64;
    }
}

/// Adds the times of a stage.
pub(super) fn add(sums: &mut Vec<(String, f64, f64)>, name: &str, (ms, cpu): (f64, f64)) {
    match sums.iter_mut().find(|(n, ..)| n == name) {
        Some((_, sum, cpus)) => (*sum, *cpus) = (*sum + ms, *cpus + cpu),
        None => sums.push((name.to_owned(), ms, cpu)),
    }
}

/// Whether two pictures are equal in a rectangle.
fn same(a: &Photo, b: &Photo, r: tmpi_core::Rect) -> bool {
    (r.y..r.y + r.h).all(|y| {
        let row = y as usize * a.width as usize + r.x as usize;
        a.rgb[row..row + r.w as usize] == b.rgb[row..row + r.w as usize]
    })
}
