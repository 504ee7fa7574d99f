//! Rendered sequences with exact disparity and exact side views.

use clap::ValueEnum;
use tmpi_core::{Camera, DisparityMap, Photo, Pose};

use crate::scenes::{Picture, Scene};

/// Kind of a sequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Kind {
    /// A still camera, and a person-sized object that moves to and fro.
    Still,
    /// The same, with depth measured by the camera.
    Measured,
    /// A moving camera and a still scene.
    Moving,
    /// Like `Still`, with another scene from the middle on.
    Cut,
}

impl Kind {
    /// Name in results.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Still => "still camera",
            Self::Measured => "still camera, RGB-D",
            Self::Moving => "moving camera",
            Self::Cut => "cut",
        }
    }

    /// Name in file names and on the command line.
    pub fn slug(self) -> String {
        self.to_possible_value().map_or(String::new(), |value| value.get_name().to_owned())
    }
}

/// Standard deviation of the sensor's noise, in levels.
pub const NOISE: f64 = 2.0;
/// Disparity of the object.
const OBJECT: f64 = 0.9;
/// The object's width and height, as fractions of the picture's.
const SIZE: (f64, f64) = (0.26, 0.75);
/// Frames per period of the object's motion.
const PERIOD: f64 = 150.0;
/// A surface is behind another if its disparity is smaller by this.
pub const BEHIND: f32 = 0.05;
/// Samples per pixel along each axis, for the object's coverage.
const SAMPLES: u32 = 4;

/// A frame with its ground truth.
#[derive(Clone, Debug)]
pub struct Shot {
    /// The camera's picture.
    pub noisy: Photo,
    /// The picture without noise.
    pub clean: Photo,
    /// Exact disparity.
    pub delta: DisparityMap,
    /// Exact side view, without noise.
    pub side_view: Photo,
    /// Pixels of the side view that the camera itself does not see.
    pub uncovered: Vec<bool>,
}

#[derive(Debug)]
pub struct Sequence {
    kind: Kind,
    frames: u32,
    scenes: [Scene; 2],
    /// Each scene without the object, from the camera and from the side.
    still: Vec<[Picture; 2]>,
    paint: Photo,
    pub camera: Camera,
    /// Offset of the side view to the right, in units of the nearest distance.
    side_offset: f64,
}

impl Sequence {
    /// A sequence of `frames` frames of this size, with scenes from `seed` on.
    pub fn new(kind: Kind, seed: u64, (width, height): (u32, u32), frames: u32, side_offset: f64) -> Self {
        let scenes = [Scene::framed(seed, width, height), Scene::framed(seed + 1, width, height)];
        let camera = scenes[0].camera();
        let paint = Scene::framed(seed + 2, width, height);
        let paint = paint.render(&paint.camera(), 2).photo;
        let mut sequence = Self { kind, frames, scenes, still: Vec::new(), paint, camera, side_offset };
        if kind != Kind::Moving {
            sequence.still = (0..2).map(|i| sequence.seen(i, 0.0)).collect();
        }
        sequence
    }

    /// View of frame `n` without noise, from a camera offset from that frame's camera.
    pub fn view(&self, n: u32, (tx, ty): (f64, f64)) -> Photo {
        let mut picture = self.picture_from(self.scene(n), (self.camera_at(n) + tx, ty));
        if self.kind != Kind::Moving {
            self.paint_object(n, (tx, ty), &mut picture);
        }
        picture.photo
    }

    /// Pose of the side view, relative to the frame's camera.
    pub fn side_pose(&self) -> Pose {
        Pose::at(self.side_offset, 0.0, 0.0)
    }

    /// Renders a scene from a camera `at` to the right, and its side view. Each scene has its own unit of length; both use that of the
    /// first, so that the same camera sees the second scene.
    fn seen(&self, scene: usize, at: f64) -> [Picture; 2] {
        [at, at + self.side_offset].map(|tx| self.picture_from(scene, (tx, 0.0)))
    }

    fn picture_from(&self, scene: usize, (tx, ty): (f64, f64)) -> Picture {
        self.scenes[scene].render(&Camera { pose: Pose::at(tx, ty, 0.0), ..self.camera }, 2)
    }

    /// Position of the camera in frame `n`, to the right.
    fn camera_at(&self, n: u32) -> f64 {
        if self.kind == Kind::Moving { 0.15 * (f64::from(n) / PERIOD * std::f64::consts::TAU).sin() } else { 0.0 }
    }

    pub fn shot(&self, n: u32) -> Shot {
        let moved;
        let [here, side] = if self.kind == Kind::Moving {
            moved = self.seen(0, self.camera_at(n));
            &moved
        } else {
            &self.still[self.scene(n)]
        };
        let (mut clean, mut view) = (here.clone(), side.clone());
        if self.kind != Kind::Moving {
            self.paint_object(n, (0.0, 0.0), &mut clean);
            self.paint_object(n, (self.side_offset, 0.0), &mut view);
        }
        let mut noise = Noise::new(n);
        let rgb =
            clean.photo.rgb.iter().map(|p| p.map(|v| (f64::from(v) + NOISE * noise.next()).round().clamp(0.0, 255.0) as u8)).collect();
        let uncovered = self.uncovered(&clean.disparity, &view.disparity);
        let (clean, delta, side_view) = (clean.photo, clean.disparity, view.photo);
        Shot { noisy: Photo { rgb, ..clean }, clean, delta, side_view, uncovered }
    }

    /// Frame `n` without the object; `None` if the camera moves.
    pub fn plate(&self, n: u32) -> Option<&Picture> {
        (self.kind != Kind::Moving).then(|| &self.still[self.scene(n)][0])
    }

    fn scene(&self, n: u32) -> usize {
        usize::from(self.kind == Kind::Cut && n >= self.frames / 2)
    }

    /// Pixels of the side view that are hidden from the camera, whose disparity is `here`.
    fn uncovered(&self, here: &DisparityMap, side: &DisparityMap) -> Vec<bool> {
        let (w, shift) = (side.width as usize, self.camera.intrinsics.fx * self.side_offset);
        let hidden = |(i, delta): (usize, &f32)| {
            // position of the same point in the frame; check both neighbours, because it lies between two pixels
            let x = (i % w) as f64 + shift * f64::from(*delta);
            let row = &here.delta[i / w * w..][..w];
            let seen = |x: f64| row.get(x as usize).is_none_or(|d| d - delta < BEHIND);
            !seen(x.floor()) && !seen(x.ceil())
        };
        side.delta.iter().enumerate().map(hidden).collect()
    }

    /// Paints the object over a picture, as seen by a camera with this offset.
    fn paint_object(&self, n: u32, (tx, ty): (f64, f64), picture: &mut Picture) {
        let (w, h) = (f64::from(self.camera.width), f64::from(self.camera.height));
        let turn = f64::from(n) / PERIOD * std::f64::consts::TAU;
        // the object sways as it moves
        let left = w * (0.5 + 0.22 * turn.sin() + 0.01 * (5.0 * turn).sin()) - w * SIZE.0 / 2.0 - self.camera.intrinsics.fx * tx * OBJECT;
        let top = h * (1.0 - SIZE.1) - self.camera.intrinsics.fy * ty * OBJECT;
        for y in 0..self.camera.height {
            for x in 0..self.camera.width {
                let i = (y * self.camera.width + x) as usize;
                let place = |sx: u32, sy: u32| {
                    let step = |s: u32| (f64::from(s) + 0.5) / f64::from(SAMPLES);
                    ((f64::from(x) + step(sx) - left) / (w * SIZE.0), (f64::from(y) + step(sy) - top) / (h * SIZE.1))
                };
                let inside = (0..SAMPLES * SAMPLES).filter(|s| outline(place(s % SAMPLES, s / SAMPLES))).count();
                if inside == 0 || f64::from(picture.disparity.delta[i]) > OBJECT {
                    continue;
                }
                let share = inside as f64 / f64::from(SAMPLES * SAMPLES);
                // the texture moves with the object at subpixel accuracy
                let paint = self.painted(f64::from(x) + 0.5 - left, f64::from(y) + 0.5 - top);
                for (to, from) in picture.photo.rgb[i].iter_mut().zip(paint) {
                    *to = (f64::from(*to) * (1.0 - share) + from * share).round() as u8;
                }
                if share >= 0.5 {
                    picture.disparity.delta[i] = OBJECT as f32;
                }
            }
        }
    }

    /// Samples the object's texture bilinearly.
    fn painted(&self, x: f64, y: f64) -> [f64; 3] {
        let p = &self.paint;
        let (x, y) = ((x - 0.5).clamp(0.0, f64::from(p.width - 1)), (y - 0.5).clamp(0.0, f64::from(p.height - 1)));
        let (x0, y0) = (x as u32, y as u32);
        let (fx, fy) = (x.fract(), y.fract());
        let at = |dx: u32, dy: u32| p.at((x0 + dx).min(p.width - 1), (y0 + dy).min(p.height - 1)).map(f64::from);
        let (a, b, c, d) = (at(0, 0), at(1, 0), at(0, 1), at(1, 1));
        std::array::from_fn(|i| (a[i] * (1.0 - fx) + b[i] * fx) * (1.0 - fy) + (c[i] * (1.0 - fx) + d[i] * fx) * fy)
    }
}

/// Whether a point is inside the outline of a head and shoulders, in the unit square.
fn outline((x, y): (f64, f64)) -> bool {
    let ellipse = |cx: f64, cy: f64, rx: f64, ry: f64| ((x - cx) / rx).powi(2) + ((y - cy) / ry).powi(2) <= 1.0;
    ellipse(0.5, 0.2, 0.24, 0.2) || ellipse(0.5, 0.95, 0.5, 0.58)
}

/// Gaussian noise, reproducible for each frame.
struct Noise {
    state: u64,
    /// Second value of a pair (Box and Muller 1958).
    spare: Option<f64>,
}

impl Noise {
    const fn new(frame: u32) -> Self {
        Self { state: 0x9E37_79B9_7F4A_7C15 ^ (frame as u64) << 17, spare: None }
    }

    fn unit(&mut self) -> f64 {
        self.state = self.state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.state >> 33) as f64 + 0.5) / f64::from(1u32 << 31)
    }

    fn next(&mut self) -> f64 {
        if let Some(spare) = self.spare.take() {
            return spare;
        }
        let (r, turn) = ((-2.0 * self.unit().ln()).sqrt(), std::f64::consts::TAU * self.unit());
        self.spare = Some(r * turn.sin());
        r * turn.cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_has_unit_variance() {
        let mut noise = Noise::new(3);
        let values: Vec<f64> = (0..20_000).map(|_| noise.next()).collect();
        let mean = values.iter().sum::<f64>() / 2e4;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 2e4;
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "{mean} {variance}");
    }

    #[test]
    fn the_object_moves_in_front_of_a_still_scene() {
        let s = Sequence::new(Kind::Still, 900_101, (160, 120), 60, 0.05);
        let (a, b) = (s.shot(0), s.shot(20));
        let same = a.clean.rgb.iter().zip(&b.clean.rgb).filter(|(a, b)| a == b).count();
        assert!(same > 160 * 120 / 3 && same < 160 * 120, "{same}");
        let first = |p: &Photo, q: &Photo| (0..160 * 120).find(|i| p.rgb[*i] != q.rgb[*i]);
        assert!(first(&a.clean, &b.clean).is_some());
        let near = a.delta.delta.iter().filter(|d| (**d - OBJECT as f32).abs() < 1e-6).count() as f64 / (160.0 * 120.0);
        assert!((0.08..0.2).contains(&near), "{near}");
        assert_ne!(a.clean, a.side_view);
    }

    #[test]
    fn the_cut_is_in_the_middle() {
        let s = Sequence::new(Kind::Cut, 900_101, (64, 48), 10, 0.05);
        let far = |a: &Photo, b: &Photo| a.rgb.iter().zip(&b.rgb).filter(|(a, b)| a != b).count();
        let clean = |n| s.shot(n).clean;
        assert!(far(&clean(4), &clean(5)) > 2 * far(&clean(3), &clean(4)));
    }
}
