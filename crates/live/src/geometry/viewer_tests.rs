//! What a viewer notices of frames that are hard: how far what is shown is from where it should be, and how much of it trembles, in pixels
//! at the border of the view box.
#![allow(clippy::unwrap_used, reason = "test")]

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};

use tmpi_core::live::{Model, wire};
use tmpi_pipeline::depth::{DepthError, Estimator};

use super::*;

const WIDTH: u32 = 240;
const HEIGHT: u32 = 136;
/// How near the wall is at its left and at its right, and the thing before it.
const WALL: (f32, f32) = (0.2, 0.35);
const THING: f32 = 0.75;
/// What a network's depth trembles by from run to run, in δ.
const TREMBLE: f32 = 0.01;
/// Pixels by which what is shown may be off: a quarter for what is not sent, as much again for a network that trembles.
const ERROR: f64 = 2.0 * PARALLAX;
/// Mean of the pixels by which what stands still may move from one frame to the next.
const FLICKER: f64 = 0.02;

/// Depth as it is, by another scale and shift each time and trembling, as networks tell it.
#[derive(Default)]
struct Knowing {
    truth: Mutex<Vec<f32>>,
    runs: AtomicU32,
    /// By how much scale and shift differ from run to run.
    free: f32,
}

impl Estimator for Knowing {
    fn name(&self) -> &'static str {
        "knowing"
    }

    fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        let run = self.runs.fetch_add(1, Ordering::Relaxed);
        let (scale, shift) = (1.0 - self.free * (run % 4) as f32, 0.5 * self.free * (run % 3) as f32);
        let truth = self.truth.lock().unwrap();
        let delta = (0..).zip(truth.iter()).map(|(i, d)| scale * (d + TREMBLE * noise(i, run)) + shift).collect();
        Ok(DisparityMap { width: photo.width, height: photo.height, delta })
    }
}

/// −1 to 1, the same each time.
fn noise(i: u32, seed: u32) -> f32 {
    let mixed = (i.wrapping_mul(0x9E37_79B1) ^ seed.wrapping_mul(0x85EB_CA77)).wrapping_mul(0xC2B2_AE3D);
    ((mixed ^ (mixed >> 15)).wrapping_mul(0x2C1B_3C6D) >> 8) as f32 / (1u32 << 23) as f32 - 1.0
}

/// What a camera sees: a thing at a place before a wall, both with a pattern of their own.
#[derive(Clone, Copy)]
struct Sight {
    /// Columns by which the camera has moved to the right.
    pan: u32,
    /// The thing's left column.
    thing: u32,
    /// Times the light.
    exposure: f32,
    /// Deviation of the sensor's noise, in levels.
    grain: f32,
}

const STILL: Sight = Sight { pan: 0, thing: 90, exposure: 1.0, grain: 0.0 };

impl Sight {
    fn is_thing(&self, x: u32, y: u32) -> bool {
        (self.thing..self.thing + 44).contains(&x) && (40..100).contains(&y)
    }

    fn delta(&self, x: u32, y: u32) -> f32 {
        if self.is_thing(x, y) { THING } else { WALL.0 + (WALL.1 - WALL.0) * x as f32 / WIDTH as f32 }
    }

    /// The wall has patches of 11 pixels, the thing of 7: brighter, of other colours.
    fn photo(&self, number: u64) -> Photo {
        let pattern = |x: u32, y: u32, size: u32| 40.0 * noise(x / size + 97 * (y / size), size);
        let light = |x: u32, y: u32| {
            if self.is_thing(x, y) { 150.0 + pattern(x - self.thing, y, 7) } else { 80.0 + pattern(x + self.pan, y, 11) }
        };
        let pixel = |i: u32| {
            let (x, y) = (i % WIDTH, i / WIDTH);
            // the sum of three even values of −1 to 1 has the deviation 1
            let grain = |c: u32| {
                if self.grain > 0.0 { (0..3).map(|k| noise(3 * (3 * i + c) + k, number as u32 + 1)).sum::<f32>() } else { 0.0 }
            };
            [0, 1, 2].map(|c| (self.exposure * light(x, y) * [1.0, 0.9, 0.8][c as usize] + self.grain * grain(c)).clamp(0.0, 255.0) as u8)
        };
        Photo { width: WIDTH, height: HEIGHT, rgb: (0..WIDTH * HEIGHT).map(pixel).collect() }
    }
}

/// A room, and one of its viewers, who holds what it was sent.
struct Watched {
    depth: Arc<Knowing>,
    room: Geometry,
    viewer: Option<Model>,
    number: u64,
    shown: Vec<f32>,
}

/// What one more frame came to.
struct Seen {
    update: Update,
    /// Pixels by which what is shown is off, at each pixel that is not beside the thing.
    off: Vec<f64>,
    /// Pixels by which it moved since the frame before, there.
    trembled: Vec<f64>,
}

impl Watched {
    fn new(free: f32, settings: Settings) -> Self {
        let depth = Arc::new(Knowing { free, ..Knowing::default() });
        let models = Models { depth: Arc::<Knowing>::clone(&depth), theta: None, psi: None };
        Self { depth, room: Geometry::new(models, settings), viewer: None, number: 0, shown: Vec::new() }
    }

    fn next(&mut self, sight: Sight) -> Seen {
        let pixels = || (0..WIDTH * HEIGHT).map(|i| (i % WIDTH, i / WIDTH));
        *self.depth.truth.lock().unwrap() = pixels().map(|(x, y)| sight.delta(x, y)).collect();
        let at = Duration::from_millis(33 * self.number);
        let update = self.room.next(&Frame { number: self.number, at, photo: sight.photo(self.number), depth: None }).unwrap();
        let room = self.room.geometry().unwrap();
        let viewer = self.viewer.get_or_insert_with(|| Model::new(&Model::hello(room)).unwrap());
        viewer.take(&wire::Geometry { frame: self.number, chunks: update.chunks.clone() }).unwrap();
        self.number += 1;
        let held = viewer.geometry().unwrap();
        let now = held.surface().all().to_vec();
        let all = Rect { x: 0, y: 0, w: WIDTH, h: HEIGHT };
        let (x, y) = held.view_box.parallax(&held.intrinsics, all);
        let parallax = x.max(y);
        // beside an edge smoothing has its say
        let beside = |x: u32, y: u32| {
            let about = [(x.saturating_sub(4), y), (x + 4, y), (x, y.saturating_sub(4)), (x, y + 4)];
            about.iter().any(|(u, v)| sight.is_thing(*u, *v) != sight.is_thing(x, y))
        };
        let inner: Vec<usize> = (0..).zip(pixels()).filter(|(_, (x, y))| !beside(*x, *y)).map(|(i, _)| i).collect();
        let truth = self.depth.truth.lock().unwrap().clone();
        let pixels_of = |a: &[f32], b: &[f32]| inner.iter().map(|i| f64::from((a[*i] - b[*i]).abs()) * parallax).collect();
        let trembled = if self.shown.is_empty() { Vec::new() } else { pixels_of(&now, &self.shown) };
        let off = pixels_of(&now, &truth);
        self.shown = now;
        Seen { update, off, trembled }
    }
}

/// The value that 95 in 100 do not exceed.
fn most(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() * 95 / 100]
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

#[test]
fn light_that_fades_moves_nothing() {
    let mut room = Watched::new(0.2, Settings::default());
    room.next(STILL);
    let mut flicker = Vec::new();
    for n in 1..60 {
        // two levels a frame for the brightest, and then it stays
        let exposure = 1.0 - 0.01 * f32::min(n as f32, 30.0);
        let seen = room.next(Sight { exposure, ..STILL });
        assert!(!seen.update.cut, "frame {n}");
        assert!(most(&seen.off) < ERROR, "frame {n}: {} px", most(&seen.off));
        flicker.push(mean(&seen.trembled));
        if n >= 50 {
            assert!(seen.update.sent.is_empty(), "frame {n}: what stands still is not sent");
        }
    }
    assert!(mean(&flicker) < FLICKER, "{} px a frame", mean(&flicker));
}

#[test]
fn a_switched_light_begins_a_scene_at_the_same_place() {
    // a network that goes by what it sees tells a scene by the same scale in any light
    let mut room = Watched::new(0.0, Settings::default());
    (0..4).for_each(|_| drop(room.next(STILL)));
    let seen = room.next(Sight { exposure: 0.6, ..STILL });
    assert!(seen.update.cut && seen.update.sent.len() == room.room.geometry().unwrap().tiles.len());
    assert!(most(&seen.off) < ERROR && most(&seen.trembled) < ERROR, "{} px off, moved by {} px", most(&seen.off), most(&seen.trembled));
    for n in 0..20 {
        let seen = room.next(Sight { exposure: 0.6, ..STILL });
        assert!(seen.update.sent.is_empty(), "frame {n} after it");
    }
}

#[test]
fn noise_beyond_the_tolerance_moves_little() {
    for grain in [4.0, 8.0] {
        let mut room = Watched::new(0.2, Settings::default());
        room.next(Sight { grain, ..STILL });
        let (mut flicker, mut changed) = (Vec::new(), 0);
        for n in 1..25 {
            let seen = room.next(Sight { grain, ..STILL });
            assert!(!seen.update.cut, "frame {n}");
            changed += seen.update.changed.len();
            assert!(most(&seen.off) < ERROR, "frame {n}: {} px", most(&seen.off));
            flicker.push(mean(&seen.trembled));
        }
        assert!(changed > 100, "the noise is not taken for change: {changed} tiles");
        assert!(mean(&flicker) < FLICKER, "{} px a frame", mean(&flicker));
    }
}

#[test]
fn a_camera_and_a_thing_that_both_move_are_followed() {
    let mut room = Watched::new(0.2, Settings { rest: Duration::ZERO, ..Settings::default() });
    room.next(STILL);
    for n in 1..24 {
        let sight = Sight { pan: 3 * n, thing: 90 - 2 * n, ..STILL };
        let seen = room.next(sight);
        assert!(!seen.update.cut, "frame {n}");
        // what is shown near is the thing, wherever it is by now
        let (mut both, mut either) = (0, 0);
        for (i, d) in (0..).zip(&room.shown) {
            let (near, thing) = (*d > 0.5 * (THING + WALL.1), sight.is_thing(i % WIDTH, i / WIDTH));
            both += u32::from(near && thing);
            either += u32::from(near || thing);
        }
        assert!(most(&seen.off) < ERROR, "frame {n}: {} px", most(&seen.off));
        assert!(f64::from(both) > 0.9 * f64::from(either), "frame {n}: {both} of {either}");
        assert!(!seen.update.sent.is_empty(), "frame {n}");
    }
}
