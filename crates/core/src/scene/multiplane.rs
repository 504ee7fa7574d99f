//! A tiled multiplane image in memory.

use super::{Grid, Intrinsics, Plane, Rect, ViewBox};

/// A decoded photo: 8-bit sRGB, row-major, `width · height` pixels.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Photo {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Pixels from the upper left, row by row.
    pub rgb: Vec<[u8; 3]>,
}

impl Photo {
    /// A photo of the pixels that `rgb` gives for each `(x, y)`.
    pub fn from_fn(width: u32, height: u32, rgb: impl Fn(u32, u32) -> [u8; 3]) -> Self {
        Self { width, height, rgb: row_by_row(width, height, rgb) }
    }

    /// The pixel at `(x, y)`, which must be inside the photo.
    pub fn at(&self, x: u32, y: u32) -> [u8; 3] {
        self.rgb[y as usize * self.width as usize + x as usize]
    }
}

/// Disparity of each pixel of a photo, row-major; all values are finite.
#[derive(Clone, Debug, PartialEq)]
pub struct DisparityMap {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// δ from the upper left, row by row.
    pub delta: Vec<f32>,
}

impl DisparityMap {
    /// A map of the disparities that `delta` gives for each `(x, y)`.
    pub fn from_fn(width: u32, height: u32, delta: impl Fn(u32, u32) -> f32) -> Self {
        Self { width, height, delta: row_by_row(width, height, delta) }
    }
}

fn row_by_row<T>(width: u32, height: u32, at: impl Fn(u32, u32) -> T) -> Vec<T> {
    (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| at(x, y)).collect()
}

/// Class of a layer's texel. Stored as one byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Class {
    /// No surface; alpha is 0.
    Empty = 0,
    /// Visible: takes its colour from the photo's pixel at the same position.
    Photo = 1,
    /// Hidden behind something: has its own colour in [`Texels::hidden`].
    Hidden = 2,
}

/// Texels of all layers, layer by layer, row-major within each layer's rectangle.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Texels {
    /// The [`Class`] of each texel, as a byte.
    pub class: Vec<u8>,
    /// Straight alpha of each texel: 0 if the class is empty, otherwise 1 to 255.
    pub alpha: Vec<u8>,
    /// Colours of the hidden texels only, in the order of `class`.
    pub hidden: Vec<[u8; 3]>,
}

/// One RGBA layer of one tile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Layer {
    /// Index of the tile in the grid.
    pub tile: u32,
    /// The plane, in the tile's `(u, v)`.
    pub plane: Plane,
    /// Pixels of the photo that the texels cover: within the tile's rectangle, never empty.
    pub rect: Rect,
    /// Index of the first texel in [`Texels::class`] and [`Texels::alpha`].
    pub first_texel: usize,
    /// Index of the first hidden texel in [`Texels::hidden`].
    pub first_hidden: usize,
}

/// Ordered tiled multiplane image `(Γ(I), ≤)` (paper, section 3.1).
///
/// Layers are sorted by tile, and within a tile from far to near by disparity at the tile's centre. Every renderer breaks ties by this
/// index.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The grid of tiles.
    pub grid: Grid,
    /// The reference camera, at the origin looking along +z.
    pub intrinsics: Intrinsics,
    /// Camera positions that the scene is made for.
    pub view_box: ViewBox,
    /// The photo: the source of all visible texels.
    pub photo: Photo,
    /// Layers of all tiles.
    pub layers: Vec<Layer>,
    /// Texels of all layers.
    pub texels: Texels,
}

/// The parts of a scene are inconsistent.
#[derive(Clone, Copy, Debug, thiserror::Error, PartialEq, Eq)]
pub enum SceneError {
    /// Sizes, counts or ranges contradict each other; the text names them.
    #[error("scene is inconsistent: {0}")]
    Inconsistent(&'static str),
}

impl Scene {
    /// Checks that all parts are consistent: sizes, rectangles within tiles, texel counts, order, finite planes and intrinsics.
    ///
    /// # Errors
    /// [`SceneError::Inconsistent`] names the first inconsistent part.
    pub fn validate(&self) -> Result<(), SceneError> {
        let fail = |what| Err(SceneError::Inconsistent(what));
        let g = &self.grid;
        if g.width == 0 || g.height == 0 || g.size == 0 || g.stride == 0 || g.stride > g.size {
            return fail("grid");
        }
        if (self.photo.width, self.photo.height) != (g.width, g.height) || self.photo.rgb.len() != g.width as usize * g.height as usize {
            return fail("photo size");
        }
        if !self.intrinsics.is_valid() {
            return fail("intrinsics");
        }
        let (mut texel, mut hidden, mut tile) = (0usize, 0usize, 0u32);
        for l in &self.layers {
            if l.tile >= g.tiles() || l.tile < tile {
                return fail("tile order");
            }
            tile = l.tile;
            if l.rect.area() == 0 || !g.rect(l.tile).contains(&l.rect) {
                return fail("layer rectangle");
            }
            if !l.plane.is_finite() {
                return fail("plane");
            }
            if l.first_texel != texel || l.first_hidden != hidden {
                return fail("texel offsets");
            }
            let end = texel + l.rect.area();
            let Some(classes) = self.texels.class.get(texel..end) else { return fail("texel count") };
            hidden += classes.iter().filter(|&&c| c == Class::Hidden as u8).count();
            texel = end;
        }
        if self.texels.class.len() != texel || self.texels.alpha.len() != texel || self.texels.hidden.len() != hidden {
            return fail("texel count");
        }
        // without a branch, so that the loop vectorises
        let wrong = |c: u8, a: u8| u8::from(c > Class::Hidden as u8) | u8::from((c == Class::Empty as u8) != (a == 0));
        if self.texels.class.iter().zip(&self.texels.alpha).fold(0, |any, (&c, &a)| any | wrong(c, a)) != 0 {
            return fail("texel class");
        }
        Ok(())
    }

    /// Memory use of the scene, in bytes.
    pub fn memory(&self) -> usize {
        size_of::<Self>()
            + size_of_val(self.photo.rgb.as_slice())
            + size_of_val(self.layers.as_slice())
            + self.texels.class.len()
            + self.texels.alpha.len()
            + size_of_val(self.texels.hidden.as_slice())
    }

    /// Appends the RGBA texels of layer `index` with straight alpha to `out`, row-major in the layer's rectangle; empty texels are 0.
    pub fn expand_layer(&self, index: usize, out: &mut Vec<[u8; 4]>) {
        let l = &self.layers[index];
        let mut hidden = self.texels.hidden[l.first_hidden..].iter();
        let own = l.first_texel..l.first_texel + l.rect.area();
        let (class, alpha) = (&self.texels.class[own.clone()], &self.texels.alpha[own]);
        let width = l.rect.w as usize;
        for (y, (class, alpha)) in (l.rect.y as usize..).zip(class.chunks(width).zip(alpha.chunks(width))) {
            let visible = &self.photo.rgb[y * self.photo.width as usize + l.rect.x as usize..][..width];
            out.extend(visible.iter().zip(class.iter().zip(alpha)).map(|(p, (&c, &a))| {
                let [r, g, b] = match c {
                    c if c == Class::Photo as u8 => *p,
                    c if c == Class::Hidden as u8 => hidden.next().copied().unwrap_or_default(),
                    _ => [0; 3],
                };
                [r, g, b, a]
            }));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two tiles of two texels: one of the photo and a hidden one, an empty one and a hidden one.
    fn scene() -> Scene {
        let grid = Grid { width: 4, height: 1, size: 2, stride: 2 };
        let plane = Plane::fronto_parallel(0.5);
        let layer = |tile: u32, first: usize| Layer {
            tile,
            plane,
            rect: Rect { x: 2 * tile, y: 0, w: 2, h: 1 },
            first_texel: 2 * first,
            first_hidden: first,
        };
        let class = [Class::Photo, Class::Hidden, Class::Empty, Class::Hidden].map(|c| c as u8).to_vec();
        Scene {
            grid,
            intrinsics: Intrinsics::centred(4, 1, 50.0),
            view_box: ViewBox::cube(0.03),
            photo: Photo { width: 4, height: 1, rgb: vec![[9; 3]; 4] },
            layers: vec![layer(0, 0), layer(1, 1)],
            texels: Texels { class, alpha: vec![255, 1, 0, 7], hidden: vec![[1; 3], [2; 3]] },
        }
    }

    type Change = fn(&mut Scene);

    #[test]
    fn each_inconsistent_part_is_named() {
        assert_eq!(scene().validate(), Ok(()));
        let wrong = |change: Change| {
            let mut scene = scene();
            change(&mut scene);
            scene.validate().unwrap_err()
        };
        let all: [(&str, Change); 22] = [
            ("grid", |s| s.grid.width = 0),
            ("grid", |s| s.grid.height = 0),
            ("grid", |s| s.grid.size = 0),
            ("grid", |s| s.grid.stride = 0),
            ("grid", |s| s.grid.stride = 3),
            ("photo size", |s| s.photo.width = 3),
            ("photo size", |s| s.photo.height = 2),
            ("photo size", |s| s.photo.rgb.truncate(3)),
            ("intrinsics", |s| s.intrinsics.fx = f64::NAN),
            ("tile order", |s| s.layers[1].tile = 2),
            ("tile order", |s| (s.layers[0].tile, s.layers[0].rect.x, s.layers[1].tile) = (1, 2, 0)),
            ("layer rectangle", |s| s.layers[0].rect.w = 0),
            ("layer rectangle", |s| s.layers[0].rect.x = 1),
            ("plane", |s| s.layers[1].plane.c = f64::INFINITY),
            ("texel offsets", |s| s.layers[1].first_texel = 1),
            ("texel offsets", |s| s.layers[1].first_hidden = 0),
            ("texel count", |s| s.texels.class.truncate(3)),
            ("texel count", |s| s.texels.class.push(0)),
            ("texel count", |s| s.texels.alpha.push(0)),
            ("texel count", |s| s.texels.hidden.truncate(1)),
            ("texel class", |s| s.texels.alpha[2] = 1),
            ("texel class", |s| s.texels.alpha[0] = 0),
        ];
        for (i, (what, change)) in all.into_iter().enumerate() {
            assert_eq!(wrong(change), SceneError::Inconsistent(what), "case {i}");
        }
    }

    #[test]
    fn memory_counts_every_part() {
        let scene = scene();
        let parts = 4 * 3 + 2 * size_of::<Layer>() + 4 + 4 + 2 * 3;
        assert_eq!(scene.memory(), size_of::<Scene>() + parts);
    }
}
