//! Textured triangle meshes, and their intersection with rays.

use std::sync::Arc;

use crate::scenes::bvh::{Aabb, Bvh};
use crate::scenes::math::{V3, v3};
use crate::scenes::photo_texture::Levels;

/// A vertex: position, normal (of length 1, or 0 if there is none) and texture coordinates.
#[derive(Clone, Copy, Debug)]
pub struct Vertex {
    pub at: V3,
    pub normal: V3,
    pub uv: [f64; 2],
}

/// Appearance of a surface.
#[derive(Clone, Debug, Default)]
pub struct Material {
    /// Linear RGB; with a texture, a factor on it.
    pub colour: V3,
    pub texture: Option<Arc<Levels>>,
    /// Width, height and alpha of the texture, and the minimum alpha of opaque texels.
    pub cut: Option<(usize, usize, Arc<[u8]>, u8)>,
}

#[derive(Debug)]
struct Triangle {
    corners: [Vertex; 3],
    edges: [V3; 2],
    /// Length in the texture, which spans 1, per length in space.
    density: f64,
}

/// A mesh with a single material.
#[derive(Debug)]
pub struct Mesh {
    triangles: Vec<Triangle>,
    material: Material,
    pub bounds: Aabb,
    tree: Bvh,
}

/// Intersection of a ray with a mesh.
#[derive(Clone, Copy, Debug)]
pub struct MeshHit {
    pub t: f64,
    /// Unit normal, outward or inward.
    pub normal: V3,
    pub triangle: u32,
}

impl Mesh {
    /// Creates a mesh without degenerate triangles; `None` if no triangle is left.
    pub fn new(triangles: impl Iterator<Item = [Vertex; 3]>, material: Material) -> Option<Self> {
        let triangles: Vec<Triangle> = triangles.filter_map(Triangle::new).collect();
        let corners = || triangles.iter().flat_map(|t| t.corners).map(|c| c.at);
        let bounds = Aabb { low: corners().reduce(V3::min)?, high: corners().reduce(V3::max)? };
        Some(Self { tree: Self::tree(&triangles), triangles, material, bounds })
    }

    pub fn shift(&mut self, by: V3) {
        self.triangles.iter_mut().flat_map(|t| &mut t.corners).for_each(|c| c.at = c.at + by);
        self.bounds = Aabb { low: self.bounds.low + by, high: self.bounds.high + by };
        self.tree = Self::tree(&self.triangles);
    }

    fn tree(triangles: &[Triangle]) -> Bvh {
        Bvh::new(&(0..).zip(triangles.iter().map(Triangle::bounds)).collect::<Vec<_>>())
    }

    /// First opaque hit with `near < t < far`.
    pub fn hit(&self, o: V3, d: V3, near: f64, far: f64) -> Option<MeshHit> {
        let mut best = None;
        self.tree.walk(o, d, far, |i, far| {
            let Some((t, [u, v])) = self.triangles[i as usize].hit(o, d, near, far).filter(|(_, at)| self.is_opaque(i, *at)) else {
                return far;
            };
            best = Some(MeshHit { t, normal: self.triangles[i as usize].normal([u, v]), triangle: i });
            t
        });
        best
    }

    /// Linear colour at a point of a triangle; `width` is the size of a pixel there.
    pub fn colour(&self, triangle: u32, at: V3, width: f64) -> V3 {
        let Some(texture) = &self.material.texture else { return self.material.colour };
        let t = &self.triangles[triangle as usize];
        let [u, v] = t.uv(t.weights(at));
        self.material.colour.mul(texture.repeated(u, v, width * t.density))
    }

    fn is_opaque(&self, triangle: u32, weights: [f64; 2]) -> bool {
        let Some((w, h, alpha, least)) = &self.material.cut else { return true };
        let texel = |t: f64, n: usize| ((t.rem_euclid(1.0) * n as f64) as usize).min(n - 1);
        let [u, v] = self.triangles[triangle as usize].uv(weights);
        alpha[texel(v, *h) * w + texel(u, *w)] >= *least
    }
}

impl Triangle {
    fn new(corners: [Vertex; 3]) -> Option<Self> {
        let [a, b, c] = corners;
        let edges = [b.at - a.at, c.at - a.at];
        let area = edges[0].cross(edges[1]).norm();
        let [p, q] = [b.uv, c.uv].map(|uv| [uv[0] - a.uv[0], uv[1] - a.uv[1]]);
        let density = ((p[0] * q[1] - p[1] * q[0]).abs() / area).sqrt();
        (area > 0.0).then_some(Self { corners, edges, density })
    }

    fn bounds(&self) -> Aabb {
        let [a, b, c] = self.corners.map(|c| c.at);
        // pad flat boxes, which rays could miss
        let wide = v3(1e-9, 1e-9, 1e-9);
        Aabb { low: a.min(b).min(c) - wide, high: a.max(b).max(c) + wide }
    }

    /// `t`, and the barycentric weights of the second and third corner (Möller and Trumbore 1997).
    fn hit(&self, o: V3, d: V3, near: f64, far: f64) -> Option<(f64, [f64; 2])> {
        let p = d.cross(self.edges[1]);
        let inv = 1.0 / self.edges[0].dot(p);
        let s = o - self.corners[0].at;
        let u = s.dot(p) * inv;
        let q = s.cross(self.edges[0]);
        let (v, t) = (d.dot(q) * inv, self.edges[1].dot(q) * inv);
        // false for a ray in the triangle's plane, whose values are infinite or NaN
        (u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > near && t < far).then_some((t, [u, v]))
    }

    fn normal(&self, [u, v]: [f64; 2]) -> V3 {
        let [a, b, c] = self.corners.map(|c| c.normal);
        let smooth = a * (1.0 - u - v) + b * u + c * v;
        if smooth.norm() > 1e-6 { smooth.unit() } else { self.edges[0].cross(self.edges[1]).unit() }
    }

    fn uv(&self, [u, v]: [f64; 2]) -> [f64; 2] {
        let [a, b, c] = self.corners.map(|c| c.uv);
        std::array::from_fn(|i| a[i] * (1.0 - u - v) + b[i] * u + c[i] * v)
    }

    /// Barycentric weights of the second and third corner at a point of the triangle.
    fn weights(&self, at: V3) -> [f64; 2] {
        let n = self.edges[0].cross(self.edges[1]);
        let (s, inv) = (at - self.corners[0].at, 1.0 / n.dot(n));
        [s.cross(self.edges[1]).dot(n) * inv, self.edges[0].cross(s).dot(n) * inv]
    }
}
