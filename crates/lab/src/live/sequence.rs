//! Rendered sequences with exact disparity and exact views from beside the camera.

use tmpi_core::{Camera, DisparityMap, Intrinsics, Photo, Pose};

use crate::scenes::{Picture, Scene};

/// What happens in a sequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The camera stands still, a thing of a person's size goes to and fro before it.
    Still,
    /// The same, with depth measured by the camera.
    Measured,
    /// The camera moves, the scene does not.
    Moving,
    /// As `Still`, in another scene from the middle on.
    Cut,
}

impl Kind {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Still, Self::Measured, Self::Moving, Self::Cut];

    /// Its name in results.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Still => "still camera",
            Self::Measured => "still camera, RGB-D",
            Self::Moving => "moving camera",
            Self::Cut => "cut",
        }
    }

    /// Its name in files.
    #[must_use]
    pub const fn slug(self) -> &'static str {
        match self {
            Self::Still => "still",
            Self::Measured => "measured",
            Self::Moving => "moving",
            Self::Cut => "cut",
        }
    }
}

/// Deviation of the sensor's noise, in levels.
pub const NOISE: f64 = 2.0;
/// Disparity of the thing.
const THING: f64 = 0.9;
/// Its width and height, as shares of the picture's.
const SIZE: (f64, f64) = (0.26, 0.75);
/// Frames in which it goes to and fro once.
const PERIOD: f64 = 150.0;
/// Disparity by which something lies behind something else.
pub const BEHIND: f32 = 0.05;
/// Samples a side of a pixel, for the share of it that the thing covers.
const SAMPLES: u32 = 4;

/// A frame.
#[derive(Clone, Debug)]
pub struct Shot {
    /// As the camera gives it.
    pub noisy: Photo,
    /// Without noise.
    pub clean: Photo,
    /// Exact.
    pub delta: DisparityMap,
    /// What a camera beside it sees, without noise.
    pub beside: Photo,
    /// Pixels of that which the camera itself does not see.
    pub uncovered: Vec<bool>,
    /// Exact disparity of that view.
    pub beside_delta: DisparityMap,
}

/// A sequence of frames.
#[derive(Debug)]
pub struct Sequence {
    kind: Kind,
    frames: u32,
    scenes: [Scene; 2],
    /// Of each scene, seen from the camera and from beside.
    still: Vec<[Picture; 2]>,
    /// What the thing is painted with.
    paint: Photo,
    camera: Camera,
    /// How far the camera beside is to the right, in units of the nearest distance.
    aside: f64,
}

impl Sequence {
    /// `frames` frames of `size`, of scenes by their seed.
    #[must_use]
    pub fn new(kind: Kind, seed: u64, (width, height): (u32, u32), frames: u32, aside: f64) -> Self {
        let scenes = [Scene::framed(seed, width, height), Scene::framed(seed + 1, width, height)];
        let camera = scenes[0].camera();
        let paint = Scene::framed(seed + 2, width, height);
        let paint = paint.render(&paint.camera(), 2).photo;
        let mut sequence = Self { kind, frames, scenes, still: Vec::new(), paint, camera, aside };
        if kind != Kind::Moving {
            sequence.still = (0..2).map(|i| sequence.seen(i, 0.0)).collect();
        }
        sequence
    }

    /// What a camera sees of frame `n`, without noise, from a place given against that frame's own.
    #[must_use]
    pub fn view(&self, n: u32, (tx, ty): (f64, f64)) -> Photo {
        let mut picture = self.picture_from(self.scene(n), (self.camera_at(n) + tx, ty));
        if self.kind != Kind::Moving {
            self.put_thing(n, (tx, ty), &mut picture);
        }
        picture.photo
    }

    /// The camera.
    #[must_use]
    pub const fn intrinsics(&self) -> Intrinsics {
        self.camera.intrinsics
    }

    /// The pose of the camera beside, against the frame's own.
    #[must_use]
    pub fn beside(&self) -> Pose {
        Pose::at(self.aside, 0.0, 0.0)
    }

    /// A scene from a camera `at` to the right, and from the one beside it. Each scene has its own unit of length; that of the first
    /// camera is used for both, so that the second scene is seen by the same camera.
    fn seen(&self, scene: usize, at: f64) -> [Picture; 2] {
        [at, at + self.aside].map(|tx| self.picture_from(scene, (tx, 0.0)))
    }

    fn picture_from(&self, scene: usize, (tx, ty): (f64, f64)) -> Picture {
        self.scenes[scene].render(&Camera { pose: Pose::at(tx, ty, 0.0), ..self.camera }, 2)
    }

    /// How far to the right the camera is in frame `n`.
    fn camera_at(&self, n: u32) -> f64 {
        if self.kind == Kind::Moving { 0.15 * (f64::from(n) / PERIOD * std::f64::consts::TAU).sin() } else { 0.0 }
    }

    /// Frame `n`.
    #[must_use]
    pub fn shot(&self, n: u32) -> Shot {
        let moved;
        let [here, beside] = if self.kind == Kind::Moving {
            moved = self.seen(0, self.camera_at(n));
            &moved
        } else {
            &self.still[self.scene(n)]
        };
        let (mut clean, mut view) = (here.clone(), beside.clone());
        if self.kind != Kind::Moving {
            self.put_thing(n, (0.0, 0.0), &mut clean);
            self.put_thing(n, (self.aside, 0.0), &mut view);
        }
        let mut noise = Noise::new(n);
        let rgb =
            clean.photo.rgb.iter().map(|p| p.map(|v| (f64::from(v) + NOISE * noise.next()).round().clamp(0.0, 255.0) as u8)).collect();
        let uncovered = self.uncovered(&clean.disparity, &view.disparity);
        let (clean, delta, beside, beside_delta) = (clean.photo, clean.disparity, view.photo, view.disparity);
        Shot { noisy: Photo { rgb, ..clean }, clean, delta, beside, uncovered, beside_delta }
    }

    /// What a camera that stands still would see in frame `n` were the thing not there; none where it moves.
    #[must_use]
    pub fn plate(&self, n: u32) -> Option<&Picture> {
        (self.kind != Kind::Moving).then(|| &self.still[self.scene(n)][0])
    }

    fn scene(&self, n: u32) -> usize {
        usize::from(self.kind == Kind::Cut && n >= self.frames / 2)
    }

    /// The camera stands still from frame to frame up to `n`: what it saw at a pixel it would see there again.
    #[must_use]
    pub fn stands(&self, n: u32) -> bool {
        self.kind != Kind::Moving && !(self.kind == Kind::Cut && n == self.frames / 2)
    }

    /// Pixels of the view from beside that lie behind something for the camera itself, by what it sees `here`.
    #[must_use]
    pub fn uncovered(&self, here: &DisparityMap, beside: &DisparityMap) -> Vec<bool> {
        let (w, shift) = (beside.width as usize, self.camera.intrinsics.fx * self.aside);
        let hidden = |(i, delta): (usize, &f32)| {
            // where the same point lies in the frame; both of its neighbours, as it lies between two
            let x = (i % w) as f64 + shift * f64::from(*delta);
            let row = &here.delta[i / w * w..][..w];
            let seen = |x: f64| row.get(x as usize).is_none_or(|d| d - delta < BEHIND);
            !seen(x.floor()) && !seen(x.ceil())
        };
        beside.delta.iter().enumerate().map(hidden).collect()
    }

    /// Paints the thing, as a camera so far to the right and down sees it, over what lies behind it.
    fn put_thing(&self, n: u32, (tx, ty): (f64, f64), picture: &mut Picture) {
        let (w, h) = (f64::from(self.camera.width), f64::from(self.camera.height));
        let turn = f64::from(n) / PERIOD * std::f64::consts::TAU;
        // it sways as it goes
        let left = w * (0.5 + 0.22 * turn.sin() + 0.01 * (5.0 * turn).sin()) - w * SIZE.0 / 2.0 - self.camera.intrinsics.fx * tx * THING;
        let top = h * (1.0 - SIZE.1) - self.camera.intrinsics.fy * ty * THING;
        for y in 0..self.camera.height {
            for x in 0..self.camera.width {
                let i = (y * self.camera.width + x) as usize;
                let place = |sx: u32, sy: u32| {
                    let step = |s: u32| (f64::from(s) + 0.5) / f64::from(SAMPLES);
                    ((f64::from(x) + step(sx) - left) / (w * SIZE.0), (f64::from(y) + step(sy) - top) / (h * SIZE.1))
                };
                let inside = (0..SAMPLES * SAMPLES).filter(|s| outline(place(s % SAMPLES, s / SAMPLES))).count();
                if inside == 0 || f64::from(picture.disparity.delta[i]) > THING {
                    continue;
                }
                let share = inside as f64 / f64::from(SAMPLES * SAMPLES);
                // its paint moves with it, between pixels too
                let paint = self.painted(f64::from(x) + 0.5 - left, f64::from(y) + 0.5 - top);
                for (to, from) in picture.photo.rgb[i].iter_mut().zip(paint) {
                    *to = (f64::from(*to) * (1.0 - share) + from * share).round() as u8;
                }
                if share >= 0.5 {
                    picture.disparity.delta[i] = THING as f32;
                }
            }
        }
    }

    /// Bilinear.
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

/// What the camera has seen of a sequence so far.
#[derive(Debug, Default)]
pub struct Seen {
    /// Disparity of the farthest surface that was seen at each pixel.
    farthest: Option<DisparityMap>,
}

impl Seen {
    /// Takes frame `n`; gives the pixels of the view from beside that the camera does not see in it, and has seen before.
    #[must_use]
    pub fn take(&mut self, sequence: &Sequence, n: u32, shot: &Shot) -> Vec<bool> {
        let Some(farthest) = self.farthest.as_mut().filter(|_| sequence.stands(n)) else {
            self.farthest = Some(shot.delta.clone());
            return vec![false; shot.uncovered.len()];
        };
        farthest.delta.iter_mut().zip(&shot.delta.delta).for_each(|(far, now)| *far = far.min(*now));
        let never = sequence.uncovered(farthest, &shot.beside_delta);
        shot.uncovered.iter().zip(never).map(|(uncovered, never)| *uncovered && !never).collect()
    }
}

/// A head on shoulders, in a square of side 1.
fn outline((x, y): (f64, f64)) -> bool {
    let ellipse = |cx: f64, cy: f64, rx: f64, ry: f64| ((x - cx) / rx).powi(2) + ((y - cy) / ry).powi(2) <= 1.0;
    ellipse(0.5, 0.2, 0.24, 0.2) || ellipse(0.5, 0.95, 0.5, 0.58)
}

/// Gaussian noise, the same for a frame each time.
struct Noise {
    state: u64,
    /// The second of a pair (Box and Muller 1958).
    kept: Option<f64>,
}

impl Noise {
    const fn new(frame: u32) -> Self {
        Self { state: 0x9E37_79B9_7F4A_7C15 ^ (frame as u64) << 17, kept: None }
    }

    fn unit(&mut self) -> f64 {
        self.state = self.state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.state >> 33) as f64 + 0.5) / f64::from(1u32 << 31)
    }

    fn next(&mut self) -> f64 {
        if let Some(kept) = self.kept.take() {
            return kept;
        }
        let (r, turn) = ((-2.0 * self.unit().ln()).sqrt(), std::f64::consts::TAU * self.unit());
        self.kept = Some(r * turn.sin());
        r * turn.cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_has_the_deviation_that_it_says() {
        let mut noise = Noise::new(3);
        let values: Vec<f64> = (0..20_000).map(|_| noise.next()).collect();
        let mean = values.iter().sum::<f64>() / 2e4;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 2e4;
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "{mean} {variance}");
    }

    #[test]
    fn the_thing_moves_before_a_scene_that_stands_still_and_more_from_beside() {
        let s = Sequence::new(Kind::Still, 900_101, (160, 120), 60, 0.05);
        let (a, b) = (s.shot(0), s.shot(20));
        let same = a.clean.rgb.iter().zip(&b.clean.rgb).filter(|(a, b)| a == b).count();
        assert!(same > 160 * 120 / 3 && same < 160 * 120, "{same}");
        let first = |p: &Photo, q: &Photo| (0..160 * 120).find(|i| p.rgb[*i] != q.rgb[*i]);
        assert!(first(&a.clean, &b.clean).is_some());
        let near = a.delta.delta.iter().filter(|d| (**d - THING as f32).abs() < 1e-6).count() as f64 / (160.0 * 120.0);
        assert!((0.08..0.2).contains(&near), "{near}");
        assert_ne!(a.clean, a.beside);
    }

    #[test]
    fn what_the_thing_uncovers_was_mostly_seen_before_and_what_stands_still_hides_never_was() {
        let s = Sequence::new(Kind::Still, 900_101, (160, 120), 150, 0.03);
        let mut seen = Seen::default();
        let counts: Vec<[usize; 2]> = (0..150)
            .map(|n| {
                let shot = s.shot(n);
                let again = seen.take(&s, n, &shot);
                assert!(again.iter().zip(&shot.uncovered).all(|(again, uncovered)| !again || *uncovered), "frame {n}");
                [&again, &shot.uncovered].map(|of| of.iter().filter(|p| **p).count())
            })
            .collect();
        assert_eq!(counts[0][0], 0, "nothing was seen before the first frame");
        let last: [usize; 2] = std::array::from_fn(|i| counts[75..].iter().map(|c| c[i]).sum());
        assert!(last[0] > 0 && last[0] < last[1], "{last:?}");
        let moving = Sequence::new(Kind::Moving, 900_101, (64, 48), 4, 0.03);
        let mut seen = Seen::default();
        assert!((0..4).all(|n| !seen.take(&moving, n, &moving.shot(n)).contains(&true)));
    }

    #[test]
    fn a_cut_is_in_the_middle() {
        let s = Sequence::new(Kind::Cut, 900_101, (64, 48), 10, 0.05);
        let far = |a: &Photo, b: &Photo| a.rgb.iter().zip(&b.rgb).filter(|(a, b)| a != b).count();
        let clean = |n| s.shot(n).clean;
        assert!(far(&clean(4), &clean(5)) > 2 * far(&clean(3), &clean(4)));
    }
}
