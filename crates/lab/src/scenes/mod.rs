//! Rendered scenes with exact disparity, exact second views and the exact surface behind the visible one.
//!
//! A seed determines a scene completely. A small ray tracer renders analytic primitives, so that disparity is exact up to rounding, without
//! the error of a mesh. Training, benchmarks and the conformance checks take their ground truth from here.

mod bvh;
mod close;
mod cutout;
mod families;
mod furnished;
pub mod hidden_colours;
mod indoor;
mod math;
mod model;
mod objects;
mod outdoor;
mod photo_texture;
mod places;
mod shape;
mod texture;
mod world;

use rayon::prelude::*;

use math::{Rng, V3, v3};
use tmpi_core::{Camera, DisparityMap, Intrinsics, Photo, Pose};
use world::{Hit, World};

pub use model::{FARTHEST, MAX_TEXELS, MAX_TRIANGLES, Model, ModelError, Models, Up};
pub use photo_texture::Pictures;

/// Near plane in metres; families keep objects farther away.
const NEAR: f64 = 1e-4;

/// Optional pictures and models for scenes; none by default.
#[derive(Clone, Debug, Default)]
pub struct Assets {
    /// About half of all textures are cut from these, and half of the scenes of figures have a whole one as the backdrop.
    pub pictures: Pictures,
    /// About half of the objects of similar size are replaced by these, and some scenes take place inside one.
    pub models: Models,
}

/// A rendered scene.
///
/// Lengths of poses are in units of the nearest distance that the reference camera sees, so that the nearest surface has
/// disparity 1 and the sky has 0.
#[derive(Debug)]
pub struct Scene {
    family: &'static str,
    world: World,
    /// Metres from the reference camera to its nearest surface.
    unit: f64,
    size: (u32, u32),
}

/// A picture of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Antialiased colours.
    pub photo: Photo,
    /// Disparity at the pixel centres, in units of the reference camera's nearest distance; 0 is the sky.
    pub disparity: DisparityMap,
}

struct Rays {
    origin: V3,
    axes: [V3; 3],
    intrinsics: Intrinsics,
}

impl Rays {
    /// Direction through a point of the picture, with depth 1, so that the ray parameter is the depth.
    fn direction(&self, x: f64, y: f64) -> V3 {
        let k = &self.intrinsics;
        let [right, down, ahead] = self.axes;
        right * ((x - k.cx) / k.fx) + down * ((y - k.cy) / k.fy) + ahead
    }
}

impl Scene {
    /// The scene of a seed, scaled so that the nearest surface in the reference picture of `width × height` pixels (each at
    /// least 1) has disparity 1.
    pub fn framed(seed: u64, width: u32, height: u32) -> Self {
        Self::of(seed, width, height, &Assets::default())
    }

    /// Like [`Self::framed`], with pictures and models.
    pub fn of(seed: u64, width: u32, height: u32, assets: &Assets) -> Self {
        let size = (width.max(1), height.max(1));
        let mut last = None;
        for attempt in 0..24u64 {
            let rng = Rng::with(seed.wrapping_mul(64).wrapping_add(attempt), assets);
            let (family, world) = families::compose(&rng);
            let mut scene = Self { family, world, unit: 1.0, size };
            let good = scene.expose(&rng);
            if good {
                scene.unit = scene.nearest();
                return scene;
            }
            last = Some(scene);
        }
        // does not happen in practice: all attempts gave empty or flat pictures
        let mut scene = last.unwrap_or_else(|| Self { family: "empty", world: World::new(&Rng::with(seed, assets)), unit: 1.0, size });
        scene.unit = scene.nearest();
        scene
    }

    /// The scene's family: `room`, `corridor`, `lounge`, `kitchen`, `street`, `field`, `water`, `terrain`, `crowd`, `thin`, `foliage`,
    /// `shelf`, `heap`, `table`, `closeup`, `drape`, `figures` or `floating`; with models also `inside`.
    pub fn family(&self) -> &'static str {
        self.family
    }

    /// The reference camera, at the size that the scene is scaled for.
    pub fn camera(&self) -> Camera {
        let (width, height) = self.size;
        let half = f64::from(width.max(height)) * 0.5;
        let focal = half / (self.world.fov.to_radians() * 0.5).tan();
        Camera { pose: Pose::default(), intrinsics: Intrinsics::centred(width, height, focal), width, height }
    }

    fn rays(&self, camera: &Camera) -> Rays {
        let o = camera.pose.orientation();
        let eye = &self.world.eye;
        let column = |j: usize| eye.dir_out(v3(o[0][j], o[1][j], o[2][j]));
        let place = v3(camera.pose.tx, camera.pose.ty, camera.pose.tz) * self.unit;
        Rays { origin: eye.point_out(place), axes: [column(0), column(1), column(2)], intrinsics: camera.intrinsics }
    }

    /// Minimum depth over all pixel centres of the reference picture.
    fn nearest(&self) -> f64 {
        let camera = self.camera();
        let rays = self.rays(&camera);
        let near = (0..camera.height)
            .into_par_iter()
            .map(|y| {
                let depth = |x: u32| {
                    let d = rays.direction(f64::from(x) + 0.5, f64::from(y) + 0.5);
                    self.world.trace(rays.origin, d, NEAR, 0).map_or(f64::INFINITY, |h| h.t)
                };
                (0..camera.width).map(depth).fold(f64::INFINITY, f64::min)
            })
            .reduce(|| f64::INFINITY, f64::min);
        if near.is_finite() { near } else { 1.0 }
    }

    /// Sets the exposure from a coarse picture. Returns false if the picture is nearly flat, or if a single tip spans the range of depth.
    fn expose(&mut self, rng: &Rng) -> bool {
        const N: u32 = 36;
        let camera = self.camera();
        let rays = self.rays(&camera);
        let (mut light, mut delta, mut seen) = (Vec::new(), Vec::new(), std::collections::BTreeMap::<u32, u32>::new());
        for i in 0..N * N {
            let at = |v: u32, extent: u32| (f64::from(v) + 0.5) / f64::from(N) * f64::from(extent);
            let d = rays.direction(at(i % N, camera.width), at(i / N, camera.height));
            let hit = self.world.trace(rays.origin, d, NEAR, 0);
            let c = self.world.colour(rays.origin, d, hit.as_ref(), 0.02);
            light.push(0.2126 * c.x + 0.7152 * c.y + 0.0722 * c.z);
            delta.push(hit.map_or(0.0, |h| 1.0 / h.t));
            *seen.entry(hit.map_or(0, |h| h.group)).or_default() += 1;
        }
        light.sort_by(f64::total_cmp);
        delta.sort_by(f64::total_cmp);
        let share = |v: &[f64], q: f64| v[((v.len() - 1) as f64 * q) as usize];
        let (middle, bright) = (share(&light, 0.5), share(&light, 0.95));
        let target = rng.range(0.12, 0.32);
        self.world.exposure = (target / middle.max(1e-4)).min(3.0 / bright.max(1e-4));
        let top = share(&delta, 1.0);
        // most photographs show several objects; a bare wall or field is rare
        let objects = seen.values().filter(|&&n| n >= 5).count();
        if objects < 4 && !rng.chance(if objects < 3 { 0.02 } else { 0.3 }) {
            return false;
        }
        top > 0.0 && 1.0 / top > 0.12 && share(&delta, 0.97) > 0.45 * top && share(&delta, 0.97) - share(&delta, 0.05) > 0.12 * top
    }

    /// Renders the scene for a camera, with up to `supersampling`² colour samples per pixel at edges.
    pub fn render(&self, camera: &Camera, supersampling: u32) -> Picture {
        self.draw(camera, supersampling, false, |o, d| self.world.trace(o, d, NEAR, 0))
    }

    /// Renders the surface behind the visible one: along each ray, the first surface of another object. If the ray hits the sky, or there
    /// is nothing behind, colour and disparity are those of the sky. Only samples of the object at the pixel's centre count, because
    /// surfaces behind both sides of a silhouette are unrelated.
    pub fn hidden(&self, camera: &Camera, supersampling: u32) -> Picture {
        self.draw(camera, supersampling, true, |o, d| {
            let first = self.world.trace(o, d, NEAR, 0)?;
            self.world.trace(o, d, first.t, first.group)
        })
    }

    /// `apart`: ignores samples of objects other than the one at the pixel's centre.
    fn draw(&self, camera: &Camera, supersampling: u32, apart: bool, trace: impl Fn(V3, V3) -> Option<Hit> + Sync) -> Picture {
        let rays = self.rays(camera);
        let (w, h) = (camera.width as usize, camera.height as usize);
        let pixel = 1.0 / camera.intrinsics.fx;
        let sample = |x: f64, y: f64, pixel: f64| {
            let d = rays.direction(x, y);
            let hit = trace(rays.origin, d);
            let c = self.world.display(self.world.colour(rays.origin, d, hit.as_ref(), pixel));
            (c, hit.map_or((0, 0.0), |h| (h.object + 1, self.unit / h.t)))
        };
        let centres: Vec<_> =
            (0..w * h).into_par_iter().with_min_len(w).map(|i| sample((i % w) as f64 + 0.5, (i / w) as f64 + 0.5, pixel)).collect();
        let n = supersampling.max(1);
        let rgb = (0..w * h).into_par_iter().with_min_len(w).map(|i| {
            let (x, y) = (i % w, i / w);
            let here = &centres[i];
            let edge = |j: usize| {
                let other = &centres[j];
                let d = (here.0 - other.0).map(f64::abs);
                here.1.0 != other.1.0 || d.x.max(d.y).max(d.z) > 0.06
            };
            let busy = (x > 0 && edge(i - 1)) || (x + 1 < w && edge(i + 1)) || (y > 0 && edge(i - w)) || (y + 1 < h && edge(i + w));
            let c = if n > 1 && busy {
                let step = 1.0 / f64::from(n);
                let (sum, count) = (0..n * n).fold((V3::default(), 0.0), |(sum, count), k| {
                    let (i, j) = (f64::from(k % n) + 0.5, f64::from(k / n) + 0.5);
                    let (c, (object, _)) = sample(x as f64 + i * step, y as f64 + j * step, pixel * step);
                    if apart && object != here.1.0 { (sum, count) } else { (sum + c, count + 1.0) }
                });
                if count > 0.0 { sum * (1.0 / count) } else { here.0 }
            } else {
                here.0
            };
            c.map(|v| (v * 255.0).round()).array().map(|v| v as u8)
        });
        let rgb = rgb.collect();
        let delta = centres.iter().map(|c| c.1.1 as f32).collect();
        let (width, height) = (camera.width, camera.height);
        Picture { photo: Photo { width, height, rgb }, disparity: DisparityMap { width, height, delta } }
    }
}

#[cfg(test)]
mod tests;
