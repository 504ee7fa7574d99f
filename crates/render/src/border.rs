//! Mirrors a scene at the photo's borders, so that no camera of the view box sees past them.
//!
//! This mirrors the shape of the scene: mirrored planes tilt the other way, and hidden texels stay behind what hides them. The
//! continuation therefore moves like the photo. Its colours are not mirrored: [`BorderColours`] continues those at the border, blurred more
//! with growing distance from it. Backends derive the continuation when they draw; no container holds it.

use tmpi_core::{Border, BorderColours, Camera, Mat3, Plane, Pose, Scene, ViewBox, homography, mat3_vec};

/// Maximum margin, as a share of the photo's longer side. If a view box needs more, its corners see past the margin.
const WIDEST: f64 = 1.0 / 4.0;

/// A part of a layer, at its own position or mirrored beyond a border.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Piece {
    /// Index of the layer that the texels come from.
    pub layer: usize,
    /// Plane, in `(u, v)` relative to `centre`.
    pub plane: Plane,
    /// Origin of `(u, v)`, in reference pixels.
    pub centre: (f64, f64),
    /// Upper left corner, in reference pixels; outside the photo for a mirrored piece.
    pub corner: [i64; 2],
    /// Width and height, in texels.
    pub size: [u32; 2],
    /// Start and end of the drawn range, across and down, in texels from the upper left corner.
    pub drawn: [[f64; 2]; 2],
    /// First column and row of the piece in the layer's rectangle.
    first: [u32; 2],
    /// The borders at which the piece is mirrored in x, in y.
    pub mirrored: [Option<Border>; 2],
}

/// One axis of a piece.
#[derive(Clone, Copy)]
struct Side {
    corner: i64,
    size: u32,
    first: u32,
    /// Start and end of the drawn range.
    drawn: [f64; 2],
    /// The border that is the mirror, and twice its position; `None` for a piece that is not mirrored.
    mirror: Option<(Border, i64)>,
}

impl Piece {
    fn new(scene: &Scene, layer: usize, x: Side, y: Side) -> Self {
        let own = &scene.layers[layer];
        let (mut plane, mut centre) = (own.plane, scene.grid.centre(own.tile));
        if let Some((_, twice)) = x.mirror {
            (plane.b, centre.0) = (-plane.b, twice as f64 - centre.0);
        }
        if let Some((_, twice)) = y.mirror {
            (plane.c, centre.1) = (-plane.c, twice as f64 - centre.1);
        }
        Self {
            layer,
            plane,
            centre,
            corner: [x.corner, y.corner],
            size: [x.size, y.size],
            drawn: [x.drawn, y.drawn],
            first: [x.first, y.first],
            mirrored: [x, y].map(|side| side.mirror.map(|(border, _)| border)),
        }
    }

    /// δ at the centre of the piece, which is also its mean δ.
    pub fn mean_delta(&self, half: f64) -> f64 {
        let middle = |axis: usize| self.corner[axis] as f64 + f64::from(self.size[axis]) / 2.0;
        self.plane.disparity((middle(0) - self.centre.0) / half, (middle(1) - self.centre.1) / half)
    }

    /// Minimum δ of the piece, which is at one of its corners.
    pub fn least_delta(&self, half: f64) -> f64 {
        let ends = |axis: usize, centre: f64| {
            let from = self.corner[axis] as f64 - centre;
            [from / half, (from + f64::from(self.size[axis])) / half]
        };
        let (us, vs) = (ends(0, self.centre.0), ends(1, self.centre.1));
        us.into_iter().flat_map(|u| vs.map(|v| self.plane.disparity(u, v))).fold(f64::INFINITY, f64::min)
    }

    /// Rows of the piece in `all`, which has one value per texel of the layer; not mirrored.
    fn rows<'a, T>(&self, scene: &Scene, all: &'a [T]) -> impl DoubleEndedIterator<Item = &'a [T]> {
        let (x, w) = (self.first[0] as usize, self.size[0] as usize);
        let (y, h) = (self.first[1] as usize, self.size[1] as usize);
        all.chunks(scene.layers[self.layer].rect.w as usize).skip(y).take(h).map(move |row| &row[x..x + w])
    }

    /// Rows of the alphas of its texels, in any order.
    pub fn alphas<'a>(&self, scene: &'a Scene) -> impl Iterator<Item = &'a [u8]> {
        let layer = &scene.layers[self.layer];
        self.rows(scene, &scene.texels.alpha[layer.first_texel..layer.first_texel + layer.rect.area()])
    }

    /// Whether the piece lies beyond a border.
    pub fn is_mirrored(&self) -> bool {
        self.mirrored != [None; 2]
    }
}

/// Expands the texels of a scene's pieces.
pub(super) struct Expander<'a> {
    scene: &'a Scene,
    colours: Option<&'a BorderColours>,
    /// All texels of the current layer. If it is mirrored, those of its piece have continued colours.
    layer: Vec<[u8; 4]>,
}

impl<'a> Expander<'a> {
    /// Creates an expander for pieces of `scene`; `colours` come from [`border_colours`]. Without them, mirrored pieces keep their own.
    pub const fn new(scene: &'a Scene, colours: Option<&'a BorderColours>) -> Self {
        Self { scene, colours, layer: Vec::new() }
    }

    /// Rows of a piece's texels, from the top. Each row runs from left to right of the layer: backward if the piece is mirrored in x.
    pub fn rows(&mut self, piece: &Piece) -> impl Iterator<Item = &[[u8; 4]]> {
        let Self { scene, colours, layer } = self;
        layer.clear();
        scene.expand_layer(piece.layer, layer);
        if let Some(colours) = colours.filter(|_| piece.is_mirrored()) {
            let own = &scene.layers[piece.layer];
            let ([first, above], [count, height]) = (piece.first.map(|v| v as usize), piece.size.map(|v| v as usize));
            let (x, y, width) = (own.rect.x as usize + first, own.rect.y as usize, own.rect.w as usize);
            let rows = layer.chunks_mut(width).zip(scene.texels.class[own.first_texel..].chunks(width)).zip(y..);
            for ((row, class), y) in rows.skip(above).take(height) {
                let (row, class) = (&mut row[first..first + count], &class[first..first + count]);
                colours.recolour((x, y), piece.mirrored, class, row);
            }
        }
        let mut rows = piece.rows(scene, layer);
        let upwards = piece.mirrored[1].is_some();
        std::iter::from_fn(move || if upwards { rows.next_back() } else { rows.next() })
    }

    /// Appends a piece's texels to `out`, row-major.
    pub fn append(&mut self, piece: &Piece, out: &mut Vec<[u8; 4]>) {
        for row in self.rows(piece) {
            if piece.mirrored[0].is_some() { out.extend(row.iter().rev()) } else { out.extend_from_slice(row) }
        }
    }
}

/// The colours of a scene's mirrored pieces; `None` if the scene has no such pieces.
pub(super) fn border_colours(scene: &Scene, pieces: &[Piece]) -> Option<BorderColours> {
    let size = [scene.photo.width, scene.photo.height];
    pieces.iter().any(Piece::is_mirrored).then(|| BorderColours::new(&scene.photo.rgb, size, 0))
}

/// All pieces of a scene, in layer order; each layer's own piece comes first.
pub(super) fn pieces(scene: &Scene) -> Vec<Piece> {
    let (grid, margin) = (&scene.grid, margin(scene));
    let mut out = Vec::with_capacity(scene.layers.len() * 3 / 2);
    for (index, layer) in scene.layers.iter().enumerate() {
        let [x, y] = grid.drawn(layer.tile, layer.rect);
        let columns = sides(layer.rect.x, layer.rect.w, x, grid.width, margin[0]);
        let rows = sides(layer.rect.y, layer.rect.h, y, grid.height, margin[1]);
        for y in rows.into_iter().flatten() {
            out.extend(columns.into_iter().flatten().map(|x| Piece::new(scene, index, x, y)));
        }
    }
    out
}

/// The pieces of the range `from..from + size` on an axis of `length` pixels, of which `drawn` is drawn: the range itself, and its parts
/// within `margin` of either end, mirrored there. `None` for each piece of which nothing is drawn.
fn sides(from: u32, size: u32, drawn: [f64; 2], length: u32, margin: u32) -> [Option<Side>; 3] {
    let end = from + size;
    let own = Side { corner: i64::from(from), size, first: 0, drawn, mirror: None };
    // the drawn range of the `size` texels from `first` on, measured from the other end
    let back = |first: u32, size: u32| {
        let [from, to] = drawn.map(|v| (v - f64::from(first)).clamp(0.0, f64::from(size)));
        [f64::from(size) - to, f64::from(size) - from]
    };
    let low = end.min(margin).checked_sub(from).filter(|&n| n > 0);
    let low =
        low.map(|size| Side { corner: -i64::from(from + size), size, first: 0, drawn: back(0, size), mirror: Some((Border::Low, 0)) });
    let start = from.max(length.saturating_sub(margin));
    let high = end.checked_sub(start).filter(|&n| n > 0);
    let twice = 2 * i64::from(length);
    let high = high.map(|size| Side {
        corner: twice - i64::from(end),
        size,
        first: start - from,
        drawn: back(start - from, size),
        mirror: Some((Border::High, twice)),
    });
    [Some(own), low, high].map(|side| side.filter(|s| s.drawn[0] < s.drawn[1]))
}

/// How far the corners of the view box see past the photo's borders, in pixels, to the sides and up and down. This is the maximum over
/// cameras that look straight ahead and cameras that turn to keep the nearest surface in place, at δ = 0 and δ = 1.
pub fn margin(scene: &Scene) -> [u32; 2] {
    let (w, h) = (f64::from(scene.grid.width), f64::from(scene.grid.height));
    let mut past = [0.0_f64; 2];
    for pivot in [0.0, 1.0] {
        for pose in corners(&scene.view_box, pivot) {
            let camera = Camera { pose, intrinsics: scene.intrinsics, width: scene.grid.width, height: scene.grid.height };
            for delta in [0.0, 1.0] {
                let seen = super::layer_footprint::inverted(&homography([0.0, 0.0, delta], &scene.intrinsics, &camera));
                for place in [[0.0, 0.0, 1.0], [w, 0.0, 1.0], [0.0, h, 1.0], [w, h, 1.0]] {
                    let [x, y] = seen.as_ref().map_or([f64::INFINITY; 2], |m| divided(m, place));
                    past = [past[0].max(-x).max(x - w), past[1].max(-y).max(y - h)];
                }
            }
        }
    }
    let widest = w.max(h) * WIDEST;
    // one pixel for rounding, and one because a piece ends at its last texel; `as` saturates
    [(past[0], w), (past[1], h)].map(|(past, length)| if past > 0.0 { (past.min(widest) + 2.0).min(length) as u32 } else { 0 })
}

/// Poses at the corners of a view box. Each turns so that a point straight ahead at disparity `pivot` stays in place; with 0, cameras look
/// straight ahead.
pub fn corners(v: &ViewBox, pivot: f64) -> impl Iterator<Item = Pose> + use<> {
    let v = *v;
    (0..8).map(move |corner: u32| {
        let side = |bit: u32, extent: f64| if corner >> bit & 1 == 0 { extent } else { -extent };
        looking_at(pivot, side(0, v.x), side(1, v.y), side(2, v.z))
    })
}

/// Whether a camera is inside the view box, up to rounding. Views from outside may have holes.
pub fn contains_pose(v: &ViewBox, pose: &Pose) -> bool {
    let within = |at: f64, extent: f64| at.abs() <= extent + 1e-9;
    within(pose.tx, v.x) && within(pose.ty, v.y) && within(pose.tz, v.z)
}

/// `m · place` as a pixel; infinite if it lies behind the camera.
fn divided(m: &Mat3, place: [f64; 3]) -> [f64; 2] {
    let [x, y, z] = mat3_vec(m, place);
    if z > 0.0 { [x / z, y / z] } else { [f64::INFINITY; 2] }
}

/// A camera at an offset that turns back, so that a point straight ahead at disparity `pivot` stays in place.
pub fn looking_at(pivot: f64, tx: f64, ty: f64, tz: f64) -> Pose {
    let depth = 1.0 - tz * pivot;
    let yaw = -(tx * pivot).atan2(depth).to_degrees();
    let pitch = (ty * pivot).atan2(depth.hypot(tx * pivot)).to_degrees();
    Pose { tx, ty, tz, yaw, pitch, roll: 0.0 }
}

#[cfg(test)]
mod tests {
    use super::super::testing;
    use super::*;
    use tmpi_core::Class;

    #[test]
    fn a_layer_is_mirrored_at_each_border_that_it_is_near() {
        let mut scene = testing::flat(100, 60, 0.5);
        scene.layers[0].plane = Plane { a: 0.5, b: 0.2, c: -0.1 };
        let [x, y] = margin(&scene);
        assert!((3..20).contains(&x) && (3..20).contains(&y), "{x} {y}");
        let all = pieces(&scene);
        assert_eq!(all.len(), 9);
        assert_eq!((all[0].corner, all[0].size), ([0, 0], [100, 60]));
        // the four borders and four corners, without overlap
        let area = |p: &Piece| p.size[0] as usize * p.size[1] as usize;
        let outside: usize = all[1..].iter().map(area).sum();
        assert_eq!(outside, (100 + 2 * x as usize) * (60 + 2 * y as usize) - 6000);
        // mirrored: the disparity is continuous across the border, and colours continue
        let colours = border_colours(&scene, &all).unwrap();
        let half = scene.grid.half();
        for p in &all {
            let own = &all[0];
            let reflected = |v: f64, length: f64| if v < 0.0 { -v } else { v.min(2.0 * length - v) };
            let at = [p.corner[0] as f64 + 0.5, p.corner[1] as f64 + 0.5];
            let delta = |p: &Piece, x: f64, y: f64| p.plane.disparity((x - p.centre.0) / half, (y - p.centre.1) / half);
            let want = delta(own, reflected(at[0], 100.0), reflected(at[1], 60.0));
            assert!((delta(p, at[0], at[1]) - want).abs() < 1e-12, "{p:?}");
            let mut texels = Vec::new();
            Expander::new(&scene, Some(&colours)).append(p, &mut texels);
            let (x, y) = (reflected(at[0], 100.0) as usize, reflected(at[1], 60.0) as usize);
            let [r, g, b] = scene.photo.at(x as u32, y as u32);
            let mut want = [[r, g, b, 255]];
            if p.is_mirrored() {
                colours.recolour((x, y), p.mirrored, &[Class::Photo as u8], &mut want);
            }
            assert_eq!((texels.len(), texels[0]), (area(p), want[0]));
        }
    }

    #[test]
    fn the_margin_follows_the_view_box_up_to_a_bound() {
        let mut scene = testing::flat(100, 60, 0.5);
        for (extent, want) in [(0.0, [0, 0]), (1e9, [27, 27]), (f64::NAN, [27, 27]), (f64::INFINITY, [27, 27])] {
            scene.view_box = ViewBox { x: extent, y: extent, z: extent };
            assert_eq!((margin(&scene), pieces(&scene).len()), (want, if want == [0, 0] { 1 } else { 9 }), "{extent}");
        }
    }
}
