//! The reference for the other backends: in `f64`, gathers, sorts and composites all samples of a pixel.

use std::sync::Arc;

use rayon::prelude::*;

use super::border::{Expander, border_colours, pieces};
use super::layer_footprint::Footprint;
use super::{RenderError, Renderer, View, check};
use tmpi_core::{Camera, Scene};

/// The paper's algorithm 1 without shortcuts.
///
/// Composites the samples of a pixel by target disparity, nearest first; of equal ones, the layer with the higher index is nearer.
/// Interpolates colours bilinearly on premultiplied texels, clamped to the layer's rectangle.
#[derive(Clone, Copy, Debug, Default)]
pub struct Reference;

struct ProjectedPiece {
    footprint: Footprint,
    index: usize,
    size: [usize; 2],
    texels: Vec<[u8; 4]>,
}

struct Sample {
    delta: f64,
    piece: usize,
    /// Premultiplied, 0 to 1.
    rgba: [f64; 4],
}

impl Renderer for Reference {
    fn name(&self) -> &'static str {
        "reference"
    }

    fn render(&self, scene: &Arc<Scene>, camera: &Camera) -> Result<View, RenderError> {
        check(camera)?;
        scene.validate()?;
        let pieces = pieces(scene);
        let colours = border_colours(scene, &pieces);
        let mut expander = Expander::new(scene, colours.as_ref());
        let projected: Vec<ProjectedPiece> = (pieces.iter().enumerate())
            .filter_map(|(index, piece)| {
                let footprint = Footprint::new(scene, piece, camera)?;
                let mut texels = Vec::new();
                expander.append(piece, &mut texels);
                Some(ProjectedPiece { footprint, index, size: piece.size.map(|v| v as usize), texels })
            })
            .collect();
        let mut view = View::transparent(camera);
        view.rgba.par_chunks_mut(camera.width as usize).enumerate().for_each(|(y, row)| {
            for (out, sum) in row.iter_mut().zip(row_of(&projected, y as u32, camera.width)) {
                *out = sum.map(|v| (v * 255.0).round() as u8);
            }
        });
        Ok(view)
    }
}

fn row_of(projected: &[ProjectedPiece], y: u32, width: u32) -> Vec<[f64; 4]> {
    let mut samples: Vec<Vec<Sample>> = (0..width).map(|_| Vec::new()).collect();
    for s in projected.iter().filter(|s| (s.footprint.y0..s.footprint.y1).contains(&y)) {
        for x in s.footprint.x0..s.footprint.x1 {
            if let Some(at) = s.footprint.hit(f64::from(x) + 0.5, f64::from(y) + 0.5) {
                let rgba = bilinear(&s.texels, s.size[0], s.size[1], at.x, at.y);
                if rgba[3] > 0.0 {
                    samples[x as usize].push(Sample { delta: at.delta, piece: s.index, rgba });
                }
            }
        }
    }
    samples.into_iter().map(composite).collect()
}

fn composite(mut samples: Vec<Sample>) -> [f64; 4] {
    samples.sort_by(|a, b| b.delta.total_cmp(&a.delta).then(b.piece.cmp(&a.piece)));
    let mut sum = [0.0; 4];
    for s in &samples {
        let transmittance = 1.0 - sum[3];
        for (c, v) in sum.iter_mut().zip(s.rgba) {
            *c += transmittance * v;
        }
    }
    sum
}

/// Premultiplied colour at `(x, y)`, in texels from the upper left corner of a `w × h` rectangle.
fn bilinear(texels: &[[u8; 4]], w: usize, h: usize, x: f64, y: f64) -> [f64; 4] {
    let (x, y) = ((x - 0.5).max(0.0).min((w - 1) as f64), (y - 0.5).max(0.0).min((h - 1) as f64));
    let (x0, y0) = (x as usize, y as usize);
    let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
    let (fx, fy) = (x - x0 as f64, y - y0 as f64);
    let mut sum = [0.0; 4];
    for (x, y, weight) in [(x0, y0, (1.0 - fx) * (1.0 - fy)), (x1, y0, fx * (1.0 - fy)), (x0, y1, (1.0 - fx) * fy), (x1, y1, fx * fy)] {
        let [r, g, b, a] = texels[y * w + x].map(|v| f64::from(v) / 255.0);
        for (s, v) in sum.iter_mut().zip([r * a, g * a, b * a, a]) {
            *s += weight * v;
        }
    }
    sum
}
