//! Refines hidden colours and soft alphas of layers with the network Ψ, batched over tiles. Only layers with hidden texels are refined
//! (paper, section 3.2).

use rayon::prelude::*;

use crate::StageError;
use crate::networks::{Network, Tensor};
use tmpi_core::{Class, Geometry, Grid, Photo, TexturedLayer, Tile, TileFrame};

/// Channels of Ψ's input.
pub const CHANNELS: usize = 9;
/// Layers per call: one call for many is much faster than one each, and memory stays bounded.
const BATCH: usize = 32;
/// Largest tile, in pixels, that Ψ runs on; a regular MPI (one tile) is not refined.
const MAX_TILE: u32 = 128;
/// Scale of the disparity channel.
const DISPARITY_SCALE: f32 = 8.0;

/// Result of a refinement.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Refined {
    /// Number of tiles that had nothing to refine or were left out.
    pub skipped: usize,
    /// Whether any hidden colour changed.
    pub colours: bool,
}

/// Refines all layers that have hidden texels. A Ψ with one output returns hidden colours only; one with two outputs returns alpha first.
///
/// # Errors
/// [`StageError::Onnx`] if the network fails, [`StageError::Shape`] if its outputs have other shapes.
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

/// Side of Ψ's input for the tiles of a grid, in pixels: the tile's side, rounded up to a multiple of 16.
pub fn side(grid: &Grid) -> usize {
    (grid.size as usize).div_ceil(16) * 16
}

fn shape(out: &[Tensor]) -> StageError {
    let got = out.iter().map(|t| format!("{:?}", t.shape)).collect::<Vec<_>>().join(" ");
    StageError::Shape { network: "psi", got, want: "background [N,3,h,w], or alpha [N,1,h,w] and background".into() }
}

/// Whether a layer has hidden texels.
pub fn needs(l: &TexturedLayer) -> bool {
    !l.hidden.is_empty()
}

/// Fills the nine channels of one layer, with `side²` values each (see the model card). A clipped tile repeats its last row and column.
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

/// Takes the network's colours at hidden texels and its alpha at soft ones. Visible texels stay, and so does the reference view. Returns
/// whether a colour changed.
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
            // a soft texel stays soft and visible, because renderers choose its pass by that
            l.alpha[i] = (a * 255.0).round().clamp(1.0, 254.0) as u8;
        }
    }
    changed
}

#[cfg(test)]
mod tests {
    use tmpi_core::{Intrinsics, Plane, ViewBox, texture};

    use super::*;

    /// The first three channels of each layer, which are its own colours.
    fn own_colours(t: &Tensor) -> Tensor {
        let area = t.shape[2] * t.shape[3];
        let data = t.data.chunks(CHANNELS * area).flat_map(|layer| layer[..3 * area].to_vec()).collect();
        Tensor { shape: vec![t.shape[0], 3, t.shape[2], t.shape[3]], data }
    }

    /// One value everywhere, in this many channels.
    fn constant(t: &Tensor, channels: usize, value: f32) -> Tensor {
        let shape = vec![t.shape[0], channels, t.shape[2], t.shape[3]];
        Tensor { data: vec![value; shape.iter().product()], shape }
    }

    /// A near box in front of a slanted wall, and its layers, in tiles of 20 pixels of which the last are clipped.
    fn scene() -> (Photo, Geometry, Vec<Vec<TexturedLayer>>) {
        let (width, height) = (50, 34);
        let grid = Grid::new(width, height, 20);
        let near = |x: u32, y: u32| (14..30).contains(&x) && (8..26).contains(&y);
        let photo = Photo::from_fn(width, height, |x, y| if near(x, y) { [200, 30, 10] } else { [10, (x * 5) as u8, (y * 7) as u8] });
        let tile = |t: u32| {
            let r = grid.rect(t);
            let labels = (0..r.area() as u32).map(|i| near(r.x + i % r.w, r.y + i / r.w).into()).collect();
            Tile { planes: vec![Plane { a: 0.25, b: 0.0625, c: 0.0 }, Plane::fronto_parallel(0.75)], labels, background: None }
        };
        let geometry = Geometry {
            grid,
            intrinsics: Intrinsics::centred(width, height, 60.0),
            view_box: ViewBox { x: 0.1, y: 0.1, z: 0.0 },
            tiles: (0..grid.tiles()).map(tile).collect(),
            matte_band: 0,
        };
        let tiles = texture(&photo, &geometry, geometry.masks());
        (photo, geometry, tiles)
    }

    fn shapes(tiles: &[Vec<TexturedLayer>]) -> Vec<&tmpi_core::LayerMask> {
        tiles.iter().flatten().map(|l| &l.shape).collect()
    }

    fn hidden(tiles: &[Vec<TexturedLayer>]) -> Vec<[u8; 3]> {
        tiles.iter().flatten().flat_map(|l| l.hidden.clone()).collect()
    }

    #[test]
    fn channels_match_the_model_card() {
        let (photo, geometry, tiles) = scene();
        let (grid, side) = (geometry.grid, side(&geometry.grid));
        assert_eq!(side, 32);
        let mut looked_at = 0;
        for (t, layers) in (0..).zip(&tiles) {
            let (r, place) = (grid.rect(t), TileFrame::of(&grid, t));
            for layer in layers {
                let mut data = vec![f32::NAN; CHANNELS * side * side];
                input(&photo, &grid, t, &geometry.tiles[t as usize], layer, side, &mut data);
                let mut fills = layer.hidden.iter();
                for i in 0..layer.shape.class.len() as u32 {
                    let (x, y) = (layer.shape.rect.x + i % layer.shape.rect.w, layer.shape.rect.y + i / layer.shape.rect.w);
                    let at = |channel: usize| data[channel * side * side + ((y - r.y) as usize * side) + (x - r.x) as usize];
                    let tile = &geometry.tiles[t as usize];
                    let label = tile.labels[((y - r.y) * r.w + x - r.x) as usize];
                    let is_hidden = layer.shape.class[i as usize] == Class::Hidden as u8;
                    let colour = if is_hidden { *fills.next().unwrap() } else { photo.at(x, y) };
                    let behind = place.disparity(&tile.planes[usize::from(label)], x, y) - place.disparity(&layer.shape.plane, x, y);
                    let own = layer.shape.label == Some(label);
                    for c in 0..3 {
                        assert!(
                            (at(c) - f32::from(colour[c]) / 255.0).abs() < 1e-6
                                && (at(3 + c) - f32::from(photo.at(x, y)[c]) / 255.0).abs() < 1e-6
                        );
                    }
                    assert_eq!((at(6) > 0.5, at(8) > 0.5), (own, !own && behind > 0.0));
                    assert!((at(7) - (behind * 8.0).clamp(-1.0, 1.0)).abs() < 1e-6);
                    looked_at += usize::from(is_hidden);
                }
                assert!(data.iter().all(|v| v.is_finite()), "a clipped tile repeats its border");
            }
        }
        assert!(looked_at > 100, "{looked_at}");
    }

    #[test]
    fn a_network_that_returns_its_input_changes_nothing() {
        let (photo, geometry, before) = scene();
        let mut after = before.clone();
        let refined = run(&|t: &Tensor| vec![own_colours(t)], &photo, &geometry, &mut after).unwrap();
        let bare = before.iter().filter(|layers| !layers.iter().any(needs)).count();
        assert_eq!(refined, Refined { skipped: bare, colours: false });
        assert_eq!((shapes(&after), hidden(&after)), (shapes(&before), hidden(&before)));
    }

    #[test]
    fn only_hidden_texels_take_the_networks_colour() {
        let (photo, geometry, before) = scene();
        let mut after = before.clone();
        assert!(run(&|t: &Tensor| vec![constant(t, 3, 0.2)], &photo, &geometry, &mut after).unwrap().colours);
        assert_eq!(shapes(&after), shapes(&before));
        assert!(hidden(&after).len() > 100 && hidden(&after).iter().all(|c| *c == [51; 3]));
    }

    #[test]
    fn soft_texels_take_the_networks_alpha_and_stay_soft() {
        let (photo, geometry, mut before) = scene();
        // every third visible texel of layers with hidden ones
        for layer in before.iter_mut().flatten().filter(|l| needs(l)) {
            let is_shown = |(class, _): &(&u8, &mut u8)| **class == Class::Photo as u8;
            layer.shape.class.iter().zip(&mut layer.shape.alpha).filter(is_shown).step_by(3).for_each(|(_, alpha)| *alpha = 100);
        }
        for (value, want) in [(0.0, 1), (0.5, 128), (1.0, 254), (-9.0, 1), (9.0, 254)] {
            let mut after = before.clone();
            let network = move |t: &Tensor| vec![constant(t, 1, value), own_colours(t)];
            run(&network, &photo, &geometry, &mut after).unwrap();
            let mut soft = 0;
            for (was, is) in before.iter().flatten().zip(after.iter().flatten()) {
                assert_eq!(is.shape.class, was.shape.class);
                for i in 0..was.shape.class.len() {
                    let takes = needs(was) && was.shape.class[i] == Class::Photo as u8 && was.shape.alpha[i] < 255;
                    assert_eq!(is.shape.alpha[i], if takes { want } else { was.shape.alpha[i] });
                    soft += usize::from(takes);
                }
            }
            assert!(soft > 0);
        }
    }

    #[test]
    fn non_finite_outputs_leave_layers_unchanged() {
        let (photo, geometry, before) = scene();
        for wild in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let mut after = before.clone();
            let network = move |t: &Tensor| vec![constant(t, 1, wild), constant(t, 3, wild)];
            assert!(!run(&network, &photo, &geometry, &mut after).unwrap().colours);
            assert_eq!((shapes(&after), hidden(&after)), (shapes(&before), hidden(&before)), "{wild}");
        }
    }

    #[test]
    fn outputs_of_another_shape_are_errors() {
        let (photo, geometry, tiles) = scene();
        let wrong: [fn(&Tensor) -> Vec<Tensor>; 4] = [
            |_| vec![],
            |t| vec![constant(t, 2, 0.5)],
            |t| vec![constant(t, 3, 0.5), constant(t, 3, 0.5)],
            |t| vec![constant(t, 1, 0.5), constant(t, 3, 0.5), constant(t, 3, 0.5)],
        ];
        for network in wrong {
            assert!(matches!(run(&network, &photo, &geometry, &mut tiles.clone()), Err(StageError::Shape { .. })));
        }
    }

    #[test]
    fn a_large_tile_is_not_refined() {
        let (photo, mut geometry, mut tiles) = scene();
        geometry.grid.size = MAX_TILE + 1;
        let untouched = |_: &Tensor| -> Vec<Tensor> { panic!("the network must not run") };
        let refined = run(&untouched, &photo, &geometry, &mut tiles).unwrap();
        assert_eq!(refined, Refined { skipped: tiles.len(), colours: false });
    }
}
