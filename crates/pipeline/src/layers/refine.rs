//! Ψ: hidden colour and soft alpha of layers, batched over tiles; only where a layer has hidden texels (paper, section 3.2).

use rayon::prelude::*;

use crate::StageError;
use crate::networks::{Network, Tensor};
use tmpi_core::{Class, Geometry, Grid, Photo, TexturedLayer, Tile, TileFrame};

/// Channels of Ψ's input.
pub const CHANNELS: usize = 9;
/// Layers a call: one call for many is much faster than one each, and memory stays bounded.
const BATCH: usize = 32;
/// Largest tile that Ψ runs on; a regular MPI (one tile) is left as it is.
const MAX_TILE: u32 = 128;
/// Scale of the disparity channel.
const DISPARITY_SCALE: f32 = 8.0;

/// What refinement did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Refined {
    /// Tiles that had nothing to refine or were left out.
    pub skipped: usize,
    /// Whether any hidden colour is another now.
    pub colours: bool,
}

/// Refines all layers that have hidden texels. A Ψ with one output gives hidden colours alone, one with two alpha before them.
///
/// # Errors
/// [`StageError::Onnx`], [`StageError::Shape`].
pub fn run(psi: &dyn Network, photo: &Photo, geometry: &Geometry, tiles: &mut [Vec<TexturedLayer>]) -> Result<Refined, StageError> {
    let grid = &geometry.grid;
    if grid.size > MAX_TILE {
        return Ok(Refined { skipped: tiles.len(), colours: false });
    }
    let side = side(grid);
    let mut todo: Vec<(usize, usize)> = Vec::new();
    let (mut skipped, mut colours) = (0, false);
    for (t, tile) in tiles.iter().enumerate() {
        let before = todo.len();
        todo.extend(tile.iter().enumerate().filter(|(_, l)| needs(l)).map(|(j, _)| (t, j)));
        skipped += usize::from(todo.len() == before);
    }
    for batch in todo.chunks(BATCH) {
        let mut data = vec![0f32; batch.len() * CHANNELS * side * side];
        batch.par_iter().zip(data.par_chunks_mut(CHANNELS * side * side)).for_each(|(&(t, j), to)| {
            input(photo, grid, t as u32, &geometry.tiles[t], &tiles[t][j], side, to);
        });
        let out = psi.run(vec![Tensor { shape: vec![batch.len(), CHANNELS, side, side], data }])?;
        let area = side * side;
        let (alpha, background) = match out.as_slice() {
            [background] => (None, background),
            [alpha, background] => (Some(alpha), background),
            _ => return Err(shape(&out)),
        };
        if alpha.is_some_and(|a| a.data.len() != batch.len() * area) || background.data.len() != batch.len() * 3 * area {
            return Err(shape(&out));
        }
        for (i, &(t, j)) in batch.iter().enumerate() {
            let origin = grid.rect(t as u32);
            colours |= take(
                &mut tiles[t][j],
                (origin.x, origin.y),
                side,
                alpha.map(|a| &a.data[i * area..(i + 1) * area]),
                &background.data[i * 3 * area..(i + 1) * 3 * area],
            );
        }
    }
    Ok(Refined { skipped, colours })
}

/// Side of Ψ's input for the tiles of a grid: the tile's, up to a multiple of 16.
#[must_use]
pub fn side(grid: &Grid) -> usize {
    (grid.size as usize).div_ceil(16) * 16
}

fn shape(out: &[Tensor]) -> StageError {
    let got = out.iter().map(|t| format!("{:?}", t.shape)).collect::<Vec<_>>().join(" ");
    StageError::Shape { network: "psi", got, want: "background [N,3,h,w], or alpha [N,1,h,w] and it".into() }
}

/// True where a layer has hidden texels.
#[must_use]
pub fn needs(l: &TexturedLayer) -> bool {
    !l.hidden.is_empty()
}

/// Fills the nine channels of one layer, `side²` values each (see the model card); a clipped tile repeats its last row and column.
pub fn input(photo: &Photo, grid: &Grid, tile: u32, planes: &Tile, l: &TexturedLayer, side: usize, to: &mut [f32]) {
    let r = grid.rect(tile);
    let place = TileFrame::of(grid, tile);
    let shape = &l.shape;
    let area = side * side;
    let mut hidden = l.hidden.iter();
    let mut colours = vec![None; r.area()];
    for (i, &c) in shape.class.iter().enumerate() {
        if c == Class::Hidden as u8 {
            let (x, y) = (shape.rect.x - r.x + i as u32 % shape.rect.w, shape.rect.y - r.y + i as u32 / shape.rect.w);
            colours[(y * r.w + x) as usize] = hidden.next();
        }
    }
    for y in 0..side {
        for x in 0..side {
            let (px, py) = ((x as u32).min(r.w - 1), (y as u32).min(r.h - 1));
            let at = (py * r.w + px) as usize;
            let rgb = photo.at(r.x + px, r.y + py);
            let visible_plane = planes.planes[planes.labels[at] as usize];
            let own = Some(planes.labels[at]) == shape.label;
            let colour = colours[at].copied().unwrap_or(rgb);
            let behind = place.disparity(&visible_plane, r.x + px, r.y + py) - place.disparity(&shape.plane, r.x + px, r.y + py);
            let o = y * side + x;
            for i in 0..3 {
                to[i * area + o] = f32::from(colour[i]) / 255.0;
                to[(3 + i) * area + o] = f32::from(rgb[i]) / 255.0;
            }
            to[6 * area + o] = f32::from(u8::from(own));
            to[7 * area + o] = (behind * DISPARITY_SCALE).clamp(-1.0, 1.0);
            to[8 * area + o] = f32::from(u8::from(!own && behind > 0.0));
        }
    }
}

/// Takes the network's colours at hidden texels and its alpha at soft ones; visible texels stay, so the identity view does.
/// True where a colour changed.
fn take(
    TexturedLayer { shape: l, hidden }: &mut TexturedLayer,
    origin: (u32, u32),
    side: usize,
    alpha: Option<&[f32]>,
    background: &[f32],
) -> bool {
    let area = side * side;
    let (mut next, mut changed) = (0, false);
    for i in 0..l.class.len() {
        let (x, y) = (l.rect.x - origin.0 + i as u32 % l.rect.w, l.rect.y - origin.1 + i as u32 / l.rect.w);
        let o = y as usize * side + x as usize;
        if l.class[i] == Class::Hidden as u8 {
            for c in 0..3 {
                let v = background[c * area + o];
                if v.is_finite() {
                    let v = (v * 255.0).round().clamp(0.0, 255.0) as u8;
                    changed |= v != hidden[next][c];
                    hidden[next][c] = v;
                }
            }
            next += 1;
        } else if let Some(a) = alpha.map(|a| a[o])
            && l.class[i] == Class::Photo as u8
            && l.alpha[i] < 255
            && a.is_finite()
        {
            // a soft texel stays soft and there: the passes of the renderers are told apart by it
            l.alpha[i] = (a * 255.0).round().clamp(1.0, 254.0) as u8;
        }
    }
    changed
}
