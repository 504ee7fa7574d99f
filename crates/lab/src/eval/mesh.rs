//! Draws the photo as a mesh with one vertex per pixel, torn where it would stretch, as viewers of photo and depth map do. This is a fair
//! baseline for comparison, and shows what a scene should look like wherever no hidden surface is uncovered.

use tmpi_core::{Camera, DisparityMap, Intrinsics, Photo, mat3_vec};

/// The mesh is torn where an edge would be longer than this, in pixels of the view.
pub const LONGEST: f64 = 2.5;
/// Tolerance at edges, in pixels.
const EDGE: f64 = 1e-9;

pub struct Warp {
    width: usize,
    height: usize,
    /// Colours; black where the mesh is torn.
    pub rgb: Vec<[u8; 3]>,
    /// Disparity of the surface that covers each pixel's centre, negative infinity where there is none.
    pub depth: Vec<f64>,
}

/// A vertex in the view: position in pixels, and disparity.
#[derive(Clone, Copy)]
struct Vertex {
    x: f64,
    y: f64,
    d: f64,
}

/// Draws `photo` with `map` from `camera`, in `f64`, with a depth buffer and with colours bilinear between vertices.
///
/// The mesh is torn where an edge would be longer than `longest` pixels of the view. There, each of its pixels still covers its own square:
/// a surface ends at the border of its last pixel, not at its centre.
pub fn warp(photo: &Photo, map: &DisparityMap, reference: &Intrinsics, camera: &Camera, longest: f64) -> Warp {
    let (w, h) = (photo.width as usize, photo.height as usize);
    let (r, t) = camera.pose.extrinsics();
    let k = &camera.intrinsics;
    let vertex = |x: f64, y: f64, d: f64| {
        let ray = mat3_vec(&r, [(x - reference.cx) / reference.fx, (y - reference.cy) / reference.fy, 1.0]);
        let p = [ray[0] + t[0] * d, ray[1] + t[1] * d, ray[2] + t[2] * d];
        (p[2] > 1e-9).then(|| Vertex { x: k.fx * p[0] / p[2] + k.cx, y: k.fy * p[1] / p[2] + k.cy, d: d / p[2] })
    };
    let centre = |i: usize| ((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
    let vertices: Vec<Option<Vertex>> = (0..w * h).map(|i| vertex(centre(i).0, centre(i).1, map.delta[i].into())).collect();
    let mut out = Warp::new(camera.width as usize, camera.height as usize);
    for y in 0..h.saturating_sub(1) {
        for x in 0..w.saturating_sub(1) {
            let at = [y * w + x, y * w + x + 1, (y + 1) * w + x, (y + 1) * w + x + 1];
            let [Some(a), Some(b), Some(c), Some(d)] = at.map(|i| vertices[i]) else { continue };
            let length = |p: Vertex, q: Vertex| (p.x - q.x).hypot(p.y - q.y);
            let whole = [length(a, b), length(c, d), length(a, c), length(b, d)].iter().all(|&l| l <= longest);
            if whole {
                out.quad([a, b, c, d], at.map(|i| photo.rgb[i]));
                continue;
            }
            for i in at {
                // the quarter of the pixel inside the torn quad
                let ((px, py), delta) = (centre(i), f64::from(map.delta[i]));
                let (mx, my) = (x as f64 + 1.0, y as f64 + 1.0);
                let corners = [(px, py), (mx, py), (px, my), (mx, my)].map(|(x, y)| vertex(x, y, delta));
                if let [Some(a), Some(b), Some(c), Some(d)] = corners {
                    out.quad([a, b, c, d], [photo.rgb[i]; 4]);
                }
            }
        }
    }
    out
}

impl Warp {
    fn new(width: usize, height: usize) -> Self {
        Self { width, height, rgb: vec![[0; 3]; width * height], depth: vec![f64::NEG_INFINITY; width * height] }
    }

    /// Whether the mesh covers the centre of a pixel.
    pub fn covers(&self, pixel: usize) -> bool {
        self.depth[pixel] > f64::NEG_INFINITY
    }

    /// Draws two triangles; corners and colours are given by rows.
    fn quad(&mut self, [a, b, c, d]: [Vertex; 4], colours: [[u8; 3]; 4]) {
        let [p, q, r, s] = colours.map(|c| c.map(f64::from));
        self.triangle([a, b, c], [p, q, r]);
        self.triangle([d, c, b], [s, r, q]);
    }

    /// Draws both faces of a triangle: a folded triangle is the edge of something near, and is drawn like the rest.
    fn triangle(&mut self, v: [Vertex; 3], colours: [[f64; 3]; 3]) {
        let area = (v[1].x - v[0].x) * (v[2].y - v[0].y) - (v[2].x - v[0].x) * (v[1].y - v[0].y);
        if area.abs() < 1e-12 {
            return;
        }
        let least = |f: fn(&Vertex) -> f64| v.iter().map(f).fold(f64::INFINITY, f64::min);
        let most = |f: fn(&Vertex) -> f64| v.iter().map(f).fold(f64::NEG_INFINITY, f64::max);
        // pixels whose centres may be inside, or on the edge up to rounding; `as` saturates
        let range = |lo: f64, hi: f64, n: usize| {
            (lo - 0.5 - EDGE).ceil().max(0.0) as usize..((hi - 0.5 + EDGE).floor() + 1.0).clamp(0.0, n as f64) as usize
        };
        for y in range(least(|v| v.y), most(|v| v.y), self.height) {
            for x in range(least(|v| v.x), most(|v| v.x), self.width) {
                let (px, py) = (x as f64 + 0.5, y as f64 + 0.5);
                let side = |a: Vertex, b: Vertex| ((b.x - a.x) * (py - a.y) - (px - a.x) * (b.y - a.y)) / area;
                let s = [side(v[1], v[2]), side(v[2], v[0]), side(v[0], v[1])];
                if s.iter().any(|&s| s < -EDGE) {
                    continue;
                }
                let depth = s[0] * v[0].d + s[1] * v[1].d + s[2] * v[2].d;
                let at = y * self.width + x;
                if depth > self.depth[at] {
                    self.depth[at] = depth;
                    let mix = |i: usize| s[0] * colours[0][i] + s[1] * colours[1][i] + s[2] * colours[2][i];
                    self.rgb[at] = [mix(0), mix(1), mix(2)].map(|c| c.round().clamp(0.0, 255.0) as u8);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_core::Pose;

    fn photo() -> Photo {
        Photo::from_fn(40, 30, |x, y| [(x * 6) as u8, (y * 8) as u8, 90])
    }

    fn view(pose: Pose, delta: impl Fn(usize) -> f32) -> Warp {
        let k = Intrinsics::centred(40, 30, 50.0);
        let map = DisparityMap { width: 40, height: 30, delta: (0..1200).map(delta).collect() };
        warp(&photo(), &map, &k, &Camera { pose, intrinsics: k, width: 40, height: 30 }, LONGEST)
    }

    #[test]
    fn without_motion_it_is_the_photo() {
        let v = view(Pose::default(), |i| (i % 7) as f32 / 7.0);
        assert!((0..1200).all(|i| v.covers(i)));
        assert_eq!(v.rgb, photo().rgb);
    }

    #[test]
    fn a_plane_moves_as_a_whole_and_a_step_tears() {
        // two pixels to the left: 0.08 · 50 · 0.5
        let v = view(Pose::at(0.08, 0.0, 0.0), |_| 0.5);
        assert_eq!(v.rgb[15 * 40 + 10], photo().rgb[15 * 40 + 12]);
        let torn = view(Pose::at(-0.08, 0.0, 0.0), |i| if i % 40 < 20 { 1.0 } else { 0.1 });
        assert!(torn.covers(15 * 40 + 22) && torn.rgb[15 * 40 + 22] == photo().rgb[15 * 40 + 18], "the near side hides the far one");
        let gap = view(Pose::at(0.08, 0.0, 0.0), |i| if i % 40 < 20 { 1.0 } else { 0.1 });
        assert!(!gap.covers(15 * 40 + 17), "what is uncovered is not drawn");
    }
}
