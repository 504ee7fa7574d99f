//! Views by casting rays, in `f64`: a second way to the same pictures that shares no formula with the renderers.
//!
//! The renderers send planes through homographies and their inverses. Here a ray from the camera meets `mᵀX = 1`: with the ray
//! written as `d + λ C` (direction of depth 1, position, and λ the target disparity) the condition is linear in λ.

use rayon::prelude::*;

use super::border_colours_reference::Continued;
use tmpi_core::{Border, Camera, Class, Pose, Rect, Scene};
use tmpi_render::{NEAR, OPAQUE, border_margin};

/// A layer, unpacked, at its own place or mirrored beyond the photo's borders: there the ray is mirrored instead.
struct Sheet {
    /// `δ = n·(x, y, 1)` in reference pixels.
    n: [f64; 3],
    rect: Rect,
    texels: Vec<[u8; 4]>,
    /// Left, upper, right and lower end of what its tile draws, in pixels.
    limits: [f64; 4],
    /// Twice the place of the mirrors in x and y, where there are any.
    mirrors: [Option<f64>; 2],
}

/// What a ray meets of a layer.
struct Hit {
    /// Target disparity.
    delta: f64,
    /// Of the sheet.
    index: usize,
    /// Disparity at the middle of the sheet's rectangle.
    mean: f64,
    /// Premultiplied colour, 0 to 255.
    rgba: [f64; 4],
}

/// The view, premultiplied, 0 to 255 a channel: all that a ray meets, the nearest first.
pub fn cast(scene: &Scene, camera: &Camera) -> Vec<[f64; 4]> {
    cast_in(scene, camera, |hits| hits.sort_by(|a, b| b.delta.total_cmp(&a.delta).then(b.index.cmp(&a.index))))
}

/// The view as `tmpi.wgsl` defines it, which a GPU draws: the nearest opaque sample, and before it the soft ones in the order of their layers' mean
/// disparities. It differs from [`cast`] where soft layers cross each other.
pub fn cast_in_layer_order(scene: &Scene, camera: &Camera) -> Vec<[f64; 4]> {
    let forward = if turned(&camera.pose, [0.0, 0.0, 1.0])[2] < 0.0 { -1.0 } else { 1.0 };
    let is_opaque = |hit: &Hit| hit.rgba[3] >= f64::from(OPAQUE) * 255.0;
    cast_in(scene, camera, |hits| {
        hits.sort_by(|a, b| b.delta.total_cmp(&a.delta).then(b.index.cmp(&a.index)));
        if let Some(nearest) = hits.iter().position(is_opaque) {
            hits.truncate(nearest + 1);
            let rgba = &mut hits[nearest].rgba;
            *rgba = rgba.map(|v| v * 255.0 / rgba[3]);
        }
        let soft = hits.len() - usize::from(hits.last().is_some_and(is_opaque));
        hits[..soft].sort_by(|a, b| (forward * b.mean).total_cmp(&(forward * a.mean)).then(b.index.cmp(&a.index)));
    })
}

/// What each pixel's ray meets, brought into order from front to back, and blended.
fn cast_in(scene: &Scene, camera: &Camera, order: impl Fn(&mut Vec<Hit>) + Sync) -> Vec<[f64; 4]> {
    let margin = border_margin(scene);
    let continued = Continued::new(&scene.photo);
    let sheets: Vec<Sheet> = (0..scene.layers.len()).flat_map(|i| sheets(scene, i, margin, &continued)).collect();
    let (k, out) = (&scene.intrinsics, &camera.intrinsics);
    let pixel = |p: [f64; 3]| [k.fx * p[0] + k.cx * p[2], k.fy * p[1] + k.cy * p[2], p[2]];
    let place = pixel([camera.pose.tx, camera.pose.ty, camera.pose.tz]);
    let width = camera.width as usize;
    (0..width * camera.height as usize)
        .into_par_iter()
        .map_init(Vec::new, |hits, i| {
            let (x, y) = ((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
            let ray = pixel(turned(&camera.pose, [(x - out.cx) / out.fx, (y - out.cy) / out.fy, 1.0]));
            hits.clear();
            for (index, s) in sheets.iter().enumerate() {
                hits.extend(s.meet(ray, place).map(|(delta, rgba)| Hit { delta, index, mean: s.mean(), rgba }));
            }
            order(hits);
            let (mut sum, mut through) = ([0.0; 4], 1.0);
            for Hit { rgba, .. } in hits.iter() {
                for (s, v) in sum.iter_mut().zip(rgba) {
                    *s += through * v;
                }
                through *= 1.0 - rgba[3] / 255.0;
            }
            sum
        })
        .collect()
}

/// A direction of the camera in the reference frame: rolled clockwise, pitched up, turned right, one after the other.
fn turned(pose: &Pose, [x, y, z]: [f64; 3]) -> [f64; 3] {
    let (sin, cos) = pose.roll.to_radians().sin_cos();
    let (x, y) = (x * cos - y * sin, x * sin + y * cos);
    let (sin, cos) = pose.pitch.to_radians().sin_cos();
    let (y, z) = (y * cos - z * sin, y * sin + z * cos);
    let (sin, cos) = pose.yaw.to_radians().sin_cos();
    [x * cos + z * sin, y, z * cos - x * sin]
}

fn dot(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// A layer and its mirror images within `margin` of the photo's borders.
fn sheets(scene: &Scene, index: usize, margin: [u32; 2], continued: &Continued) -> Vec<Sheet> {
    let (l, grid) = (&scene.layers[index], &scene.grid);
    // first pixel, the one after the last, and the mirror
    let parts = |from: u32, size: u32, length: u32, margin: u32| {
        let low = (from, (from + size).min(margin), Some(0.0));
        let high = (from.max(length - margin.min(length)), from + size, Some(2.0 * f64::from(length)));
        [(from, from + size, None), low, high].into_iter().filter(|(a, b, _)| a < b).collect::<Vec<_>>()
    };
    let columns = parts(l.rect.x, l.rect.w, grid.width, margin[0]);
    let rows = parts(l.rect.y, l.rect.h, grid.height, margin[1]);
    let whole = sheet(scene, index);
    let cut = |&(y0, y1, my): &(u32, u32, Option<f64>), &(x0, x1, mx): &(u32, u32, Option<f64>)| {
        let texel = |(y, x): (u32, u32)| {
            let at = ((y - l.rect.y) * l.rect.w + x - l.rect.x) as usize;
            let own = whole.texels[at];
            let class = scene.texels.class[l.first_texel + at];
            if mx.or(my).is_none() || class == Class::Empty as u8 {
                return own;
            }
            let border = |mirror: Option<f64>| mirror.map(|twice| if twice > 0.0 { Border::High } else { Border::Low });
            let hidden = (class == Class::Hidden as u8).then_some([own[0], own[1], own[2]]);
            let [r, g, b] = continued.texel([x, y], [border(mx), border(my)], hidden);
            [r, g, b, own[3]]
        };
        let texels = (y0..y1).flat_map(|y| (x0..x1).map(move |x| (y, x))).map(texel).collect();
        let rect = Rect { x: x0, y: y0, w: x1 - x0, h: y1 - y0 };
        Sheet { n: whole.n, rect, texels, limits: whole.limits, mirrors: [mx, my] }
    };
    rows.iter().flat_map(|y| columns.iter().map(move |x| (y, x))).map(|(y, x)| cut(y, x)).collect()
}

fn sheet(scene: &Scene, index: usize) -> Sheet {
    let l = &scene.layers[index];
    let (half, centre) = (scene.grid.half(), scene.grid.centre(l.tile));
    let (b, c) = (l.plane.b / half, l.plane.c / half);
    let mut texels = Vec::new();
    scene.expand_layer(index, &mut texels);
    let (tile, by) = (scene.grid.rect(l.tile), scene.grid.inset());
    let (right, lower) = (tile.x + tile.w, tile.y + tile.h);
    // at the photo's own borders nothing is left out
    let inner = [tile.x > 0, tile.y > 0, right < scene.grid.width, lower < scene.grid.height].map(|inner| if inner { by } else { 0.0 });
    let [x0, y0, x1, y1] = [tile.x, tile.y, right, lower].map(f64::from);
    let limits = [x0 + inner[0], y0 + inner[1], x1 - inner[2], y1 - inner[3]];
    Sheet { n: [b, c, l.plane.a - b * centre.0 - c * centre.1], rect: l.rect, texels, limits, mirrors: [None; 2] }
}

impl Sheet {
    /// Left, upper, width and height of its rectangle.
    fn place(&self) -> [f64; 4] {
        [self.rect.x, self.rect.y, self.rect.w, self.rect.h].map(f64::from)
    }

    /// Disparity at the middle of its rectangle.
    fn mean(&self) -> f64 {
        let [x, y, w, h] = self.place();
        dot(&self.n, &[x + w / 2.0, y + h / 2.0, 1.0])
    }

    /// Target disparity and premultiplied colour where the ray meets the layer, if it does.
    fn meet(&self, ray: [f64; 3], place: [f64; 3]) -> Option<(f64, [f64; 4])> {
        let [ray, place] = [ray, place].map(|mut v| {
            for (axis, mirror) in self.mirrors.iter().enumerate() {
                v[axis] = mirror.map_or(v[axis], |twice| twice * v[2] - v[axis]);
            }
            v
        });
        let lambda = dot(&self.n, &ray) / (1.0 - dot(&self.n, &place));
        let q: [f64; 3] = std::array::from_fn(|i| ray[i] + lambda * place[i]);
        let (x, y) = (q[0] / q[2], q[1] / q[2]);
        let [left, upper, right, lower] = self.limits;
        let drawn = x >= left && y >= upper && x <= right && y <= lower;
        let [x0, y0, w, h] = self.place();
        let (x, y) = (x - x0, y - y0);
        let inside = drawn && x >= 0.0 && y >= 0.0 && x <= w && y <= h;
        if !(lambda.is_finite() && q[2] > 0.0 && lambda * NEAR <= 1.0 && inside) {
            return None;
        }
        let rgba = self.sample(x, y);
        (rgba[3] > 0.0).then_some((lambda.max(0.0), rgba))
    }

    /// Bilinear between texel centres, the border's colour beyond them.
    fn sample(&self, x: f64, y: f64) -> [f64; 4] {
        let split = |v: f64, n: usize| {
            let v = (v - 0.5).clamp(0.0, (n - 1) as f64);
            (v.floor() as usize, (v.floor() as usize + 1).min(n - 1), v.fract())
        };
        let (width, height) = (self.rect.w as usize, self.rect.h as usize);
        let ((x0, x1, fx), (y0, y1, fy)) = (split(x, width), split(y, height));
        let at = |x: usize, y: usize, c: usize| {
            let t = self.texels[y * width + x];
            f64::from(t[c]) * if c < 3 { f64::from(t[3]) / 255.0 } else { 1.0 }
        };
        let mix = |a: f64, b: f64, t: f64| a * (1.0 - t) + b * t;
        std::array::from_fn(|c| mix(mix(at(x0, y0, c), at(x1, y0, c), fx), mix(at(x0, y1, c), at(x1, y1, c), fx), fy))
    }
}
