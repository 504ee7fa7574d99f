//! Converts a layer's rectangle to polygons in space: the photo's space, or that of a relief.
//!
//! Texture coordinates are linear in space, but a layer's texels are linear in the photo, and on a slanted plane the two differ. In a
//! triangle with δ between δ₀ and δ₁, the corner weights differ by at most q = (√δ₁ − √δ₀) / (√δ₁ + √δ₀), so texels are displaced by at
//! most q times the triangle's size. The rectangle is cut along lines of equal δ into strips in which that is at most [`MAX_DISPLACEMENT`].

use std::collections::HashMap;

use tmpi_core::{Intrinsics, Layer, Scene};

/// In metric space, points beyond this distance are moved to it, in units of the photo's nearest distance.
///
/// A point at infinity then moves by `f·t / FAR` pixels instead of none: 0.7 at a focal length of 600 and the border of the
/// default view box (`Options::VIEW_BOX`).
pub(super) const FAR: f64 = 100.0;

/// Angle of view, in degrees, of a relief's longer side from the photo's camera. Viewers that frame a model choose a similar distance.
const RELIEF_VIEW: f64 = 30.0;
/// Depth of a relief from δ = 0 to δ = 1, in units of its longer side.
const RELIEF_DEPTH: f64 = 0.25;

/// Mapping from the photo's space to that of a file. Disparity becomes `gain · δ + offset`, and the focal length changes. Planes stay
/// planes, and the photo's camera still sees the photo. An offset confines depth between two distances; a camera that moves sideways
/// then sees the same as before, except for a shift of the whole picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Space {
    /// Focal lengths and principal point, in pixels of the photo.
    pub intrinsics: Intrinsics,
    pub gain: f64,
    pub offset: f64,
    /// Minimum disparity in the file; farther points are moved to it.
    pub least: f64,
    /// Distance from the camera to the middle of the depth range; `None` in metric space.
    pub middle: Option<f64>,
}

impl Space {
    /// The photo's space. The unit is the distance to its nearest surface.
    pub fn metric(intrinsics: &Intrinsics) -> Self {
        Self { intrinsics: *intrinsics, gain: 1.0, offset: 0.0, least: 1.0 / FAR, middle: None }
    }

    /// A relief of the photo. The unit is its longer side.
    pub fn relief(intrinsics: &Intrinsics, width: u32, height: u32) -> Self {
        let longer = f64::from(width.max(height));
        let middle = 0.5 / (RELIEF_VIEW.to_radians() / 2.0).tan();
        let (near, far) = (1.0 / (middle - RELIEF_DEPTH / 2.0), 1.0 / (middle + RELIEF_DEPTH / 2.0));
        // keeps the pixels' aspect ratio
        let scale = longer * middle / intrinsics.fx;
        let intrinsics = Intrinsics { fx: intrinsics.fx * scale, fy: intrinsics.fy * scale, ..*intrinsics };
        Self { intrinsics, gain: near - far, offset: far, least: far, middle: Some(middle) }
    }

    /// δ of a layer in this space.
    pub fn of(&self, delta: &Disparity) -> Disparity {
        let slope = delta.slope.map(|s| s * self.gain);
        Disparity { at: delta.at * self.gain + self.offset, slope, ..*delta }
    }

    /// Position of a pixel with a disparity of this space.
    pub fn position(&self, [x, y]: [f64; 2], delta: f64) -> [f32; 3] {
        let k = &self.intrinsics;
        [(x - k.cx) / k.fx / delta, -(y - k.cy) / k.fy / delta, -1.0 / delta].map(|v| v as f32)
    }
}

/// Maximum displacement of texels in a strip, in pixels of the photo.
pub(super) const MAX_DISPLACEMENT: f64 = 0.2;

/// Points closer than this are merged, in pixels.
const MERGE_DISTANCE: f64 = 1e-6;

#[derive(Clone, Copy, Debug, PartialEq)]
struct Corner {
    /// Position in space: x right, y up, z backward, as in glTF.
    pub position: [f32; 3],
    /// Position in the photo in pixels.
    pub pixel: [f64; 2],
}

/// δ over the photo: `at + slope · (pixel − origin)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Disparity {
    pub origin: [f64; 2],
    pub at: f64,
    pub slope: [f64; 2],
}

impl Disparity {
    pub fn of(&self, [x, y]: [f64; 2]) -> f64 {
        self.at + self.slope[0] * (x - self.origin[0]) + self.slope[1] * (y - self.origin[1])
    }
}

/// δ of a layer in the photo's space.
pub(super) fn disparity(scene: &Scene, layer: &Layer) -> Disparity {
    let (centre, half, p) = (scene.grid.centre(layer.tile), scene.grid.half(), layer.plane);
    Disparity { origin: [centre.0, centre.1], at: p.a, slope: [p.b / half, p.c / half] }
}

/// Converts the photo's rectangle between two corners to convex polygons that face the camera. `delta` is in the photo's space.
fn polygons([x0, y0]: [f64; 2], [x1, y1]: [f64; 2], delta: &Disparity, space: &Space) -> Vec<Vec<Corner>> {
    let delta = space.of(delta);
    // anticlockwise for a camera with y up
    let corners = [[x0, y0], [x0, y1], [x1, y1], [x1, y0]];
    let all = corners.map(|c| delta.of(c));
    let (least, most) = all.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), &d| (a.min(d), b.max(d)));
    let far = space.least;
    let mut out = Vec::new();
    let mut add = |polygon: &[[f64; 2]], delta_at: &dyn Fn([f64; 2]) -> f64| {
        if polygon.len() >= 3 {
            out.push(polygon.iter().map(|&p| Corner { position: space.position(p, delta_at(p)), pixel: p }).collect());
        }
    };
    // part or all of it may be beyond the farthest plane
    if least < far || most <= far {
        add(&cut(&corners, |p| far - delta.of(p)), &|_| far);
    }
    if most > far {
        let low = least.max(far);
        // a rectangle smaller than the error needs no cuts
        let q = (MAX_DISPLACEMENT / (x1 - x0).hypot(y1 - y0)).min(0.5);
        let ratio = ((1.0 + q) / (1.0 - q)).powi(2);
        let strips = ((most / low).ln() / ratio.ln()).ceil().max(1.0) as u32;
        let level = |i: u32| low * (most / low).powf(f64::from(i) / f64::from(strips));
        let mut rest = if least < far { cut(&corners, |p| delta.of(p) - far) } else { corners.to_vec() };
        for i in 1..strips {
            let l = level(i);
            add(&cut(&rest, |p| l - delta.of(p)), &|p| delta.of(p).max(far));
            rest = cut(&rest, |p| delta.of(p) - l);
        }
        add(&rest, &|p| delta.of(p).max(far));
    }
    out
}

/// The part of a convex polygon on which the linear function `inside` is not negative.
fn cut(polygon: &[[f64; 2]], inside: impl Fn([f64; 2]) -> f64) -> Vec<[f64; 2]> {
    let mut out: Vec<[f64; 2]> = Vec::with_capacity(polygon.len() + 2);
    let near = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).abs() < MERGE_DISTANCE && (a[1] - b[1]).abs() < MERGE_DISTANCE;
    for (i, &a) in polygon.iter().enumerate() {
        let b = polygon[(i + 1) % polygon.len()];
        let (fa, fb) = (inside(a), inside(b));
        if fa >= 0.0 {
            out.push(a);
        }
        if (fa >= 0.0) != (fb >= 0.0) {
            let t = fa / (fa - fb);
            out.push([a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t]);
        }
    }
    out.dedup_by(|a, b| near(*a, *b));
    if out.len() > 1 && near(out[0], out[out.len() - 1]) {
        out.pop();
    }
    out
}

#[derive(Default)]
pub(super) struct Mesh {
    pub positions: Vec<[f32; 3]>,
    /// Of the texture.
    pub coordinates: Vec<[f32; 2]>,
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Adds a layer and returns its range of triangles. `texture` maps pixels of the photo to texture coordinates.
    pub fn add(&mut self, scene: &Scene, index: usize, space: &Space, texture: impl Fn([f64; 2]) -> [f64; 2]) -> std::ops::Range<usize> {
        let layer = &scene.layers[index];
        let start = self.triangles.len();
        // adjacent strips share corners
        let mut indices = HashMap::new();
        let [[left, right], [upper, lower]] = scene.grid.drawn(layer.tile, layer.rect);
        if left >= right || upper >= lower {
            return start..start;
        }
        let (x, y) = (f64::from(layer.rect.x), f64::from(layer.rect.y));
        for polygon in polygons([x + left, y + upper], [x + right, y + lower], &disparity(scene, layer), space) {
            let mut vertex = |corner: &Corner| {
                *indices.entry(corner.position.map(f32::to_bits)).or_insert_with(|| {
                    self.positions.push(corner.position);
                    self.coordinates.push(texture(corner.pixel).map(|v| v as f32));
                    self.positions.len() as u32 - 1
                })
            };
            let corners: Vec<u32> = polygon.iter().map(&mut vertex).collect();
            self.triangles.extend(corners[1..].windows(2).map(|pair| [corners[0], pair[0], pair[1]]));
        }
        start..self.triangles.len()
    }

    /// The triangles in these ranges.
    pub fn pick(&self, parts: Vec<std::ops::Range<usize>>) -> Vec<[u32; 3]> {
        parts.into_iter().flat_map(|part| &self.triangles[part]).copied().collect()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn area(p: &[Corner]) -> f64 {
        let cross = |a: [f64; 2], b: [f64; 2]| a[0] * b[1] - a[1] * b[0];
        (0..p.len()).map(|i| cross(p[i].pixel, p[(i + 1) % p.len()].pixel)).sum::<f64>() / 2.0
    }

    /// The photo's point that the texture shows at the screen-space weights `w` of a triangle.
    fn textured(t: [&Corner; 3], w: [f64; 3]) -> [f64; 2] {
        // 1/z is linear on the screen, and so is u/z
        let inverse = t.map(|c| -1.0 / f64::from(c.position[2]));
        let sum: f64 = (0..3).map(|i| w[i] * inverse[i]).sum();
        std::array::from_fn(|axis| (0..3).map(|i| w[i] * inverse[i] * t[i].pixel[axis]).sum::<f64>() / sum)
    }

    proptest! {
        #[test]
        fn polygons_cover_the_rectangle_and_keep_texels_in_place(
            x in 0u32..600, y in 0u32..300, w in 1u32..65, h in 1u32..65, a in -0.5f64..2.0, b in -2.0f64..2.0, c in -2.0f64..2.0, flat in 0u8..4,
            relief in any::<bool>(),
        ) {
            let (b, c) = if flat == 0 { (0.0, 0.0) } else { (b, c) };
            let k = Intrinsics { fx: 380.0, fy: 370.0, cx: 310.0, cy: 170.0 };
            let delta = Disparity { origin: [f64::from(x) + 20.0, f64::from(y) + 30.0], at: a, slope: [b / 32.0, c / 32.0] };
            let space = if relief { Space::relief(&k, 620, 340) } else { Space::metric(&k) };
            let all = polygons([x, y].map(f64::from), [x + w, y + h].map(f64::from), &delta, &space);
            let k = space.intrinsics;
            let total: f64 = all.iter().map(|p| area(p)).sum();
            // anticlockwise with y up is a negative area with y down
            prop_assert!((total + f64::from(w * h)).abs() < 1e-3 * f64::from(w * h), "{total}");
            for p in &all {
                for corner in p {
                    let d = space.of(&delta).of(corner.pixel).max(space.least);
                    let at = corner.position.map(f64::from);
                    prop_assert!((-1.0 / at[2] - d).abs() < 1e-4 * d.max(0.01), "{at:?} {d}");
                    let seen = [k.cx - k.fx * at[0] / at[2], k.cy + k.fy * at[1] / at[2]];
                    prop_assert!((seen[0] - corner.pixel[0]).abs() < 1e-2 && (seen[1] - corner.pixel[1]).abs() < 1e-2);
                }
                for i in 1..p.len() - 1 {
                    let t = [&p[0], &p[i], &p[i + 1]];
                    for weights in [[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.3, 0.3, 0.4], [0.6, 0.3, 0.1]] {
                        let truth: [f64; 2] = std::array::from_fn(|axis| (0..3).map(|j| weights[j] * t[j].pixel[axis]).sum());
                        let got = textured(t, weights);
                        let off = (got[0] - truth[0]).hypot(got[1] - truth[1]);
                        prop_assert!(off <= MAX_DISPLACEMENT + 1e-3, "{off} {delta:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_fronto_parallel_plane_is_one_rectangle() {
        let k = Intrinsics::centred(100, 80, 60.0);
        let flat = |at| Disparity { origin: [0.0, 0.0], at, slope: [0.0, 0.0] };
        for (at, distance) in [(0.5, 2.0), (0.0, FAR), (-1.0, FAR)] {
            let all = polygons([8.0, 4.0], [28.0, 14.0], &flat(at), &Space::metric(&k));
            assert_eq!((all.len(), all[0].len()), (1, 4), "{at}");
            assert!(all[0].iter().all(|c| (f64::from(c.position[2]) + distance).abs() < 1e-6));
        }
    }

    #[test]
    fn a_relief_is_flat_and_needs_few_cuts() {
        let k = Intrinsics::centred(1200, 800, 81.5);
        let space = Space::relief(&k, 1200, 800);
        let middle = space.middle.unwrap();
        let at = |pixel, delta: f64| space.position(pixel, space.gain * delta + space.offset).map(f64::from);
        let (near, far) = (at([600.0, 400.0], 1.0)[2] + middle, at([600.0, 400.0], 0.0)[2] + middle);
        assert!((near - RELIEF_DEPTH / 2.0).abs() < 1e-6 && (far + RELIEF_DEPTH / 2.0).abs() < 1e-6, "{near} {far}");
        // in the middle of the depth range, the longer side is the unit
        let halfway = (1.0 / middle - space.offset) / space.gain;
        assert!((at([1200.0, 400.0], halfway)[0] - at([0.0, 400.0], halfway)[0] - 1.0).abs() < 1e-6);
        // a camera that moves sideways sees the same parallax, except for a shift of the whole picture
        let seen = |delta: f64, step: f64| space.intrinsics.fx * step * (space.gain * delta + space.offset);
        let step = 0.05 * k.fx / (space.intrinsics.fx * space.gain);
        assert!((seen(0.9, step) - seen(0.2, step) - 0.05 * k.fx * 0.7).abs() < 1e-9);
        let slope = Disparity { origin: [620.0, 420.0], at: 0.4, slope: [0.3 / 32.0, 0.1 / 32.0] };
        let count = |space: &Space| polygons([600.0, 400.0], [664.0, 464.0], &slope, space).len();
        assert!(count(&space) * 4 <= count(&Space::metric(&k)), "{} {}", count(&space), count(&Space::metric(&k)));
    }
}
