//! What a viewer sees of difficult frames: how far pixels are from where they should be, and how much they flicker, in pixels at the border
//! of the view box.
#![allow(clippy::unwrap_used, reason = "test")]

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};

use tmpi_core::live::{TileState, schema};
use tmpi_pipeline::depth::{DepthError, Estimator};

use super::*;

const WIDTH: u32 = 240;
const HEIGHT: u32 = 136;
/// Disparity of the wall at its left and right end, and of the object in front of it.
const WALL: (f32, f32) = (0.2, 0.35);
const OBJECT: f32 = 0.75;
/// Amplitude of the network's noise from run to run, in δ.
const NOISE: f32 = 0.01;
/// Allowed error in pixels: a quarter for unsent changes, and a quarter for the network's noise.
const ERROR: f64 = 2.0 * PARALLAX;
/// Allowed mean movement of still areas from frame to frame, in pixels.
const FLICKER: f64 = 0.02;

/// Returns the true depth with noise, and with another scale and shift in each run, like networks.
#[derive(Default)]
struct NoisyTruth {
    truth: Mutex<Vec<f32>>,
    runs: AtomicU32,
    /// How much scale and shift differ between runs.
    spread: f32,
}

impl Estimator for NoisyTruth {
    fn name(&self) -> &'static str {
        "noisy-truth"
    }

    fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        let run = self.runs.fetch_add(1, Ordering::Relaxed);
        let (scale, shift) = (1.0 - self.spread * (run % 4) as f32, 0.5 * self.spread * (run % 3) as f32);
        let truth = self.truth.lock().unwrap();
        let delta = (0..).zip(truth.iter()).map(|(i, d)| scale * (d + NOISE * noise(i, run)) + shift).collect();
        Ok(DisparityMap { width: photo.width, height: photo.height, delta })
    }
}

/// Reproducible noise from −1 to 1.
fn noise(i: u32, seed: u32) -> f32 {
    let mixed = (i.wrapping_mul(0x9E37_79B1) ^ seed.wrapping_mul(0x85EB_CA77)).wrapping_mul(0xC2B2_AE3D);
    ((mixed ^ (mixed >> 15)).wrapping_mul(0x2C1B_3C6D) >> 8) as f32 / (1u32 << 23) as f32 - 1.0
}

/// What the camera sees: an object in front of a wall, each with its own pattern.
#[derive(Clone, Copy)]
struct CameraView {
    /// Columns by which the camera has moved to the right.
    pan: u32,
    /// The object's left column.
    object: u32,
    /// Factor on brightness.
    exposure: f32,
    /// Standard deviation of the sensor's noise, in levels.
    grain: f32,
}

const STILL: CameraView = CameraView { pan: 0, object: 90, exposure: 1.0, grain: 0.0 };

impl CameraView {
    fn is_object(&self, x: u32, y: u32) -> bool {
        (self.object..self.object + 44).contains(&x) && (40..100).contains(&y)
    }

    fn delta(&self, x: u32, y: u32) -> f32 {
        if self.is_object(x, y) { OBJECT } else { WALL.0 + (WALL.1 - WALL.0) * x as f32 / WIDTH as f32 }
    }

    /// The wall has patches of 11 pixels; the object has brighter patches of 7 pixels.
    fn photo(&self, number: u64) -> Photo {
        let pattern = |x: u32, y: u32, size: u32| 40.0 * noise(x / size + 97 * (y / size), size);
        let light = |x: u32, y: u32| {
            if self.is_object(x, y) { 150.0 + pattern(x - self.object, y, 7) } else { 80.0 + pattern(x + self.pan, y, 11) }
        };
        let pixel = |i: u32| {
            let (x, y) = (i % WIDTH, i / WIDTH);
            // the sum of three uniform values from −1 to 1 has a standard deviation of 1
            let grain = |c: u32| {
                if self.grain > 0.0 { (0..3).map(|k| noise(3 * (3 * i + c) + k, number as u32 + 1)).sum::<f32>() } else { 0.0 }
            };
            [0, 1, 2].map(|c| (self.exposure * light(x, y) * [1.0, 0.9, 0.8][c as usize] + self.grain * grain(c)).clamp(0.0, 255.0) as u8)
        };
        Photo { width: WIDTH, height: HEIGHT, rgb: (0..WIDTH * HEIGHT).map(pixel).collect() }
    }
}

/// A room with one viewer that receives all chunks.
struct ViewedRoom {
    depth: Arc<NoisyTruth>,
    room: FramePipeline,
    viewer: Option<TileState>,
    number: u64,
    shown: Vec<f32>,
}

/// Result of one frame.
struct Observation {
    update: Update,
    /// Error in pixels, at each pixel away from the object's edges.
    error: Vec<f64>,
    /// Movement in pixels since the previous frame, at the same pixels.
    moved: Vec<f64>,
}

impl ViewedRoom {
    fn new(spread: f32, settings: Settings) -> Self {
        let depth = Arc::new(NoisyTruth { spread, ..NoisyTruth::default() });
        let models = Models { depth: Arc::<NoisyTruth>::clone(&depth), theta: None, psi: None };
        Self { depth, room: FramePipeline::new(models, settings), viewer: None, number: 0, shown: Vec::new() }
    }

    fn next(&mut self, view: CameraView) -> Observation {
        let pixels = || (0..WIDTH * HEIGHT).map(|i| (i % WIDTH, i / WIDTH));
        *self.depth.truth.lock().unwrap() = pixels().map(|(x, y)| view.delta(x, y)).collect();
        let at = Duration::from_millis(33 * self.number);
        let update = self.room.next(&Frame { number: self.number, at, photo: view.photo(self.number), depth: None }).unwrap();
        let room = self.room.geometry().unwrap();
        let viewer = self.viewer.get_or_insert_with(|| TileState::new(&TileState::hello(room)).unwrap());
        viewer.take(&schema::Geometry { frame: self.number, chunks: update.chunks.clone() }).unwrap();
        self.number += 1;
        let sent = viewer.geometry().unwrap();
        let now = sent.surface().all().to_vec();
        let all = Rect { x: 0, y: 0, w: WIDTH, h: HEIGHT };
        let (x, y) = sent.view_box.parallax(&sent.intrinsics, all);
        let parallax = x.max(y);
        // skip edges, where labels are smoothed
        let beside = |x: u32, y: u32| {
            let about = [(x.saturating_sub(4), y), (x + 4, y), (x, y.saturating_sub(4)), (x, y + 4)];
            about.iter().any(|(u, v)| view.is_object(*u, *v) != view.is_object(x, y))
        };
        let inner: Vec<usize> = (0..).zip(pixels()).filter(|(_, (x, y))| !beside(*x, *y)).map(|(i, _)| i).collect();
        let truth = self.depth.truth.lock().unwrap().clone();
        let pixels_of = |a: &[f32], b: &[f32]| inner.iter().map(|i| f64::from((a[*i] - b[*i]).abs()) * parallax).collect();
        let moved = if self.shown.is_empty() { Vec::new() } else { pixels_of(&now, &self.shown) };
        let error = pixels_of(&now, &truth);
        self.shown = now;
        Observation { update, error, moved }
    }
}

/// The 95th percentile.
fn percentile_95(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() * 95 / 100]
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

#[test]
fn fading_light_moves_nothing() {
    let mut room = ViewedRoom::new(0.2, Settings::default());
    room.next(STILL);
    let mut flicker = Vec::new();
    for n in 1..60 {
        // the brightest pixels fade by two levels a frame, then stay
        let exposure = 1.0 - 0.01 * f32::min(n as f32, 30.0);
        let observed = room.next(CameraView { exposure, ..STILL });
        assert!(!observed.update.cut, "frame {n}");
        assert!(percentile_95(&observed.error) < ERROR, "frame {n}: {} px", percentile_95(&observed.error));
        flicker.push(mean(&observed.moved));
        if n >= 50 {
            assert!(observed.update.sent.is_empty(), "frame {n}: a still scene is not sent");
        }
    }
    assert!(mean(&flicker) < FLICKER, "{} px a frame", mean(&flicker));
}

#[test]
fn switching_the_light_is_a_cut_without_movement() {
    // this network has the same scale in any light
    let mut room = ViewedRoom::new(0.0, Settings::default());
    (0..4).for_each(|_| drop(room.next(STILL)));
    let observed = room.next(CameraView { exposure: 0.6, ..STILL });
    assert!(observed.update.cut && observed.update.sent.len() == room.room.geometry().unwrap().tiles.len());
    assert!(
        percentile_95(&observed.error) < ERROR && percentile_95(&observed.moved) < ERROR,
        "error {} px, moved by {} px",
        percentile_95(&observed.error),
        percentile_95(&observed.moved)
    );
    for n in 0..20 {
        let observed = room.next(CameraView { exposure: 0.6, ..STILL });
        assert!(observed.update.sent.is_empty(), "frame {n} after it");
    }
}

#[test]
fn noise_beyond_the_tolerance_moves_little() {
    for grain in [4.0, 8.0] {
        let mut room = ViewedRoom::new(0.2, Settings::default());
        room.next(CameraView { grain, ..STILL });
        let (mut flicker, mut changed) = (Vec::new(), 0);
        for n in 1..25 {
            let observed = room.next(CameraView { grain, ..STILL });
            assert!(!observed.update.cut, "frame {n}");
            changed += observed.update.changed.len();
            assert!(percentile_95(&observed.error) < ERROR, "frame {n}: {} px", percentile_95(&observed.error));
            flicker.push(mean(&observed.moved));
        }
        assert!(changed > 100, "noise should exceed the tolerance: only {changed} tiles changed");
        assert!(mean(&flicker) < FLICKER, "{} px a frame", mean(&flicker));
    }
}

#[test]
fn a_moving_camera_and_object_are_followed() {
    let mut room = ViewedRoom::new(0.2, Settings { cooldown: Duration::ZERO, ..Settings::default() });
    room.next(STILL);
    for n in 1..24 {
        let view = CameraView { pan: 3 * n, object: 90 - 2 * n, ..STILL };
        let observed = room.next(view);
        assert!(!observed.update.cut, "frame {n}");
        // near pixels are where the object is now
        let (mut both, mut either) = (0, 0);
        for (i, d) in (0..).zip(&room.shown) {
            let (near, object) = (*d > 0.5 * (OBJECT + WALL.1), view.is_object(i % WIDTH, i / WIDTH));
            both += u32::from(near && object);
            either += u32::from(near || object);
        }
        assert!(percentile_95(&observed.error) < ERROR, "frame {n}: {} px", percentile_95(&observed.error));
        assert!(f64::from(both) > 0.9 * f64::from(either), "frame {n}: {both} of {either}");
        assert!(!observed.update.sent.is_empty(), "frame {n}");
    }
}
