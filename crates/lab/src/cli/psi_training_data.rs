//! Training data for Ψ: layers of rendered scenes, with the true colours of their hidden texels.

use crate::scenes::{Picture, Scene, hidden_colours};
use tmpi_core::{Class, Geometry, Grid, Rect, TexturedLayer, TileFrame, ViewBox};
use tmpi_pipeline::layers::{self, refine};
use tmpi_pipeline::planes::place;
use tmpi_pipeline::{Options, Parallax, depth, edges};

/// Half the side of the view box, as in the bench.
const BOX: f64 = 0.06;
/// Channels after Ψ's inputs: a texel's true colour, and whether it is known.
const TRUTH: usize = 4;

/// A `NumPy` file, u8 [N, 13, side, side]. For each layer with known hidden texels, it has the channels of [`refine::input`], scaled to
/// 0..255 from −1..1 for disparity and from 0..1 for the others, then red, green, blue, and 255 where they are known.
///
/// With `degraded`, the planes come from a map of half the size, as from a network.
pub(super) fn layers(scene: &Scene, picture: &Picture, degraded: bool) -> Vec<u8> {
    let (photo, camera) = (&picture.photo, scene.camera());
    let (w, h) = (photo.width, photo.height);
    let map = if degraded {
        edges::snap(photo, &depth::halved(&picture.disparity), edges::Rim::Photo)
    } else {
        edges::median(photo, &picture.disparity)
    };
    let (grid, view_box) = (Grid::new(w, h, 64), ViewBox { x: BOX, y: BOX, z: BOX });
    let most = Parallax::new(camera.intrinsics, Options::VIEW_BOX).most(Rect { x: 0, y: 0, w, h });
    let tiles = place(&map, None, &grid, &Options::default().placement(Options::MAX_ERROR, most));
    let mut geometry = Geometry { grid, intrinsics: camera.intrinsics, view_box, tiles, matte_band: 0 };
    layers::add_backgrounds(&mut geometry, &map);
    let shapes = geometry.masks();
    let coloured = tmpi_core::texture(photo, &geometry, shapes);
    let hidden = scene.hidden(&camera, 2);
    let side = refine::side(&grid);
    let (mut data, mut count) = (Vec::new(), 0usize);
    let mut channels = vec![0f32; refine::CHANNELS * side * side];
    for (tile, t) in (0..).zip(&coloured) {
        for l in t.iter().filter(|l| refine::needs(l)) {
            let known = hidden_colours::of_layer(&l.shape, TileFrame::of(&grid, tile), &picture.disparity, &hidden);
            if known.iter().all(Option::is_none) {
                continue;
            }
            refine::input(photo, &grid, tile, &geometry.tiles[tile as usize], l, side, &mut channels);
            let byte = |(i, v): (usize, &f32)| if i / (side * side) == 7 { (v + 1.0) * 127.5 } else { v * 255.0 }.round() as u8;
            data.extend(channels.iter().enumerate().map(byte));
            data.extend(truth(l, grid.rect(tile), &known, side));
            count += 1;
        }
    }
    let mut file = header(&[count, refine::CHANNELS + TRUTH, side, side]);
    file.extend(data);
    file
}

/// Four planes of bytes: red, green, blue, known.
fn truth(l: &TexturedLayer, tile: Rect, known: &[Option<[u8; 3]>], side: usize) -> Vec<u8> {
    let (r, mut out, mut next) = (l.shape.rect, vec![0; TRUTH * side * side], known.iter());
    for (i, _) in l.shape.class.iter().enumerate().filter(|(_, c)| **c == Class::Hidden as u8) {
        let Some(Some([red, green, blue])) = next.next() else { continue };
        let (x, y) = ((r.x - tile.x) as usize + i % r.w as usize, (r.y - tile.y) as usize + i / r.w as usize);
        for (c, v) in [*red, *green, *blue, 255].into_iter().enumerate() {
            out[c * side * side + y * side + x] = v;
        }
    }
    out
}

/// Header of a `NumPy` file, version 1.0, for bytes in C order.
fn header(shape: &[usize]) -> Vec<u8> {
    let extents = shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
    let about = format!("{{'descr': '|u1', 'fortran_order': False, 'shape': ({extents},), }}");
    // the whole header is a multiple of 64 bytes
    let length = (10 + about.len() + 1).next_multiple_of(64) - 10;
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((length as u16).to_le_bytes());
    out.extend(format!("{about:<width$}\n", width = length - 1).bytes());
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_hidden_texels_have_true_colours() {
        let scene = Scene::framed(3, 160, 96);
        let picture = scene.render(&scene.camera(), 1);
        let file = layers(&scene, &picture, false);
        let head = 10 + usize::from(u16::from_le_bytes([file[8], file[9]]));
        assert_eq!(head % 64, 0);
        let text = String::from_utf8_lossy(&file[10..head]).into_owned();
        let count: usize = text.split("'shape': (").nth(1).and_then(|s| s.split(',').next()).and_then(|s| s.parse().ok()).unwrap();
        assert!(count > 0 && text.ends_with('\n'), "{text}");
        assert_eq!(file.len(), head + count * 13 * 64 * 64);
        // known texels are hidden in Ψ's mask
        for l in file[head..].chunks_exact(13 * 4096) {
            assert!((0..4096).all(|i| l[12 * 4096 + i] == 0 || l[8 * 4096 + i] == 255));
            assert!((0..4096).any(|i| l[12 * 4096 + i] == 255));
        }
    }
}
