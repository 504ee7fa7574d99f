//! Hidden colours that a second picture shows.

use rayon::prelude::*;

use tmpi_core::{Class, DisparityMap, Geometry, Grid, Photo, TexturedLayer, TileFrame};

use crate::stereo::SecondEye;

/// Least share of the hidden texels that the second picture must show. The container carries the colours of all of them or of none.
const ENOUGH: f64 = 0.05;
/// Number of texels over which seen colours fade into inpainted ones.
const FADE: u8 = 4;

/// Hidden texels, and how many of them a second picture shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Seen {
    /// Number of hidden texels.
    pub hidden: usize,
    /// Number of those that the second picture shows.
    pub seen: usize,
    /// Whether these are enough, and the layers took their colours.
    pub used: bool,
}

/// Gives hidden texels the colours that `picture`, the second one of a pair, shows of them, if it shows enough. `delta` is the disparity map
/// of the first. The layers must not be matted.
pub fn recolour((eye, picture): (&SecondEye, &Photo), geometry: &Geometry, delta: &DisparityMap, tiles: &mut [Vec<TexturedLayer>]) -> Seen {
    let of_layer = |tile: usize, textured| Layer { grid: &geometry.grid, tile: tile as u32, textured, delta }.seen(eye, picture);
    let found: Vec<(usize, Vec<[u8; 3]>)> =
        tiles.par_iter().enumerate().flat_map_iter(|(tile, layers)| layers.iter().map(move |layer| of_layer(tile, layer))).collect();
    let hidden: usize = tiles.iter().flatten().map(|layer| layer.hidden.len()).sum();
    let seen: usize = found.iter().map(|(seen, _)| seen).sum();
    let used = seen > 0 && seen as f64 >= ENOUGH * hidden as f64;
    if used {
        for (layer, (_, colours)) in tiles.iter_mut().flatten().zip(found).filter(|(_, (seen, _))| *seen > 0) {
            layer.hidden = colours;
        }
    }
    Seen { hidden, seen, used }
}

/// A layer of a tile, and the disparity map of the photo.
struct Layer<'a> {
    grid: &'a Grid,
    tile: u32,
    textured: &'a TexturedLayer,
    delta: &'a DisparityMap,
}

impl Layer<'_> {
    /// Number of hidden texels that the second picture shows, and the colours of all; no colours if it shows none.
    fn seen(&self, eye: &SecondEye, picture: &Photo) -> (usize, Vec<[u8; 3]>) {
        let TexturedLayer { shape, hidden } = self.textured;
        if hidden.is_empty() {
            return (0, Vec::new());
        }
        let (r, frame) = (shape.rect, TileFrame::of(self.grid, self.tile));
        let mut colours = hidden.clone();
        // steps from the nearest hidden texel that is not seen
        let mut steps = vec![FADE; shape.class.len()];
        let (mut next, mut seen) = (0, 0);
        for ((i, steps), _) in (0u32..).zip(&mut steps).zip(&shape.class).filter(|(_, class)| is_hidden(**class)) {
            let (x, y) = (r.x + i % r.w, r.y + i / r.w);
            let visible = self.delta.delta[y as usize * self.delta.width as usize + x as usize];
            if let Some(colour) = eye.colour(picture, (x, y), frame.disparity(&shape.plane, x, y), visible) {
                colours[next] = colour;
                seen += 1;
            } else {
                *steps = 0;
            }
            next += 1;
        }
        if seen == 0 {
            return (0, Vec::new());
        }
        count_steps(&mut steps, r.w as usize);
        let steps = shape.class.iter().zip(&steps).filter(|(class, _)| is_hidden(**class)).map(|(_, steps)| *steps);
        for ((colour, inpainted), steps) in colours.iter_mut().zip(hidden).zip(steps) {
            *colour = std::array::from_fn(|c| fade(inpainted[c], colour[c], steps));
        }
        (seen, colours)
    }
}

fn is_hidden(class: u8) -> bool {
    class == Class::Hidden as u8
}

/// Mixes two levels: `seen` has `steps` of [`FADE`] parts.
fn fade(inpainted: u8, seen: u8, steps: u8) -> u8 {
    let [steps, all] = [steps, FADE].map(u16::from);
    ((u16::from(seen) * steps + u16::from(inpainted) * (all - steps) + all / 2) / all) as u8
}

/// For each texel of a picture `w` wide, the number of steps along rows and columns from the nearest 0, at most [`FADE`].
fn count_steps(steps: &mut [u8], w: usize) {
    let least = |steps: &mut [u8], i: usize, other: usize| steps[i] = steps[i].min(steps[other] + 1);
    for i in 0..steps.len() {
        if i % w > 0 {
            least(steps, i, i - 1);
        }
        if i >= w {
            least(steps, i, i - w);
        }
    }
    for i in (0..steps.len()).rev() {
        if i % w + 1 < w {
            least(steps, i, i + 1);
        }
        if i + w < steps.len() {
            least(steps, i, i + w);
        }
    }
}

#[cfg(test)]
mod tests;
