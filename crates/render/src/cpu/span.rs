//! Finds the pixels of a row that a layer covers.

use crate::border::Piece;
use crate::layer_footprint::{Footprint, Form};
use tmpi_core::{Camera, Scene};

/// A condition `a·x + b·y + c ≥ 0`, with the reciprocal of `a`.
#[derive(Clone, Copy, Debug)]
struct Edge {
    form: Form,
    reciprocal: f64,
}

/// A piece of a layer, ready to be walked row by row.
#[derive(Clone, Debug)]
pub(super) struct Draw {
    pub footprint: Footprint,
    edges: [Edge; 6],
    /// Index of its first texel in the expanded texels.
    pub first_texel: usize,
    /// Width in texels.
    pub w: usize,
    /// Height in texels.
    pub h: usize,
}

/// Covered columns `start..end` of a row, and the footprint's linear functions along them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Span {
    pub start: usize,
    pub end: usize,
    /// Value at the centre of pixel `start`, and change per pixel.
    pub lambda: [f32; 2],
    pub x: [f32; 2],
    pub y: [f32; 2],
    pub delta: [f32; 2],
}

impl Draw {
    /// Prepares `piece`, whose expanded texels start at `first_texel`.
    pub fn new(scene: &Scene, piece: &Piece, first_texel: usize, camera: &Camera) -> Option<Self> {
        let footprint = Footprint::new(scene, piece, camera)?;
        let edges = footprint.conditions().map(|form| Edge { form, reciprocal: 1.0 / form[0] });
        Some(Self { footprint, edges, first_texel, w: piece.size[0] as usize, h: piece.size[1] as usize })
    }

    /// The span of row `y`; `None` if it is empty.
    #[inline(always)]
    pub fn span(&self, y: u32) -> Option<Span> {
        let centre = f64::from(y) + 0.5;
        let f = &self.footprint;
        let (mut least, mut most) = (f64::from(f.x0), f64::from(f.x1) - 1.0);
        for Edge { form, reciprocal } in &self.edges {
            let rest = form[1] * centre + form[2];
            let root = -rest * reciprocal - 0.5;
            // `max` and `min` ignore NaN, which a slope of 0 gives
            if form[0] > 0.0 {
                least = least.max(root);
            } else if form[0] < 0.0 {
                most = most.min(root);
            } else if rest < 0.0 {
                return None;
            }
        }
        let (least, most) = (least.ceil(), most.floor());
        if least > most {
            return None;
        }
        let at = |form: &Form| {
            let start = form[0] * (least + 0.5) + form[1] * centre + form[2];
            [start as f32, form[0] as f32]
        };
        Some(Span { start: least as usize, end: most as usize + 1, lambda: at(&f.lambda), x: at(&f.x), y: at(&f.y), delta: at(&f.delta) })
    }
}
