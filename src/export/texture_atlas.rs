//! Packs layers into texture pages, for readers that sample with straight alpha and across the borders of rectangles.

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

use super::ExportError;
use tmpi_core::Scene;

/// Maximum side of a page, unless a single layer is larger.
const SIDE: u32 = 4096;
/// Texels around each rectangle that repeat its border, so that sampling does not blend in the neighbour.
const GUTTER: u32 = 1;

/// Position of a layer on a page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Placement {
    pub layer: usize,
    /// Its first texel, inside the gutter.
    pub x: u32,
    pub y: u32,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Page {
    pub width: u32,
    pub height: u32,
    /// In the order given to [`pack`].
    pub placements: Vec<Placement>,
}

/// Packs layers into pages. Pages split `layers` in order.
pub(super) fn pack(scene: &Scene, layers: &[usize]) -> Vec<Page> {
    if layers.is_empty() {
        return Vec::new();
    }
    if let Some(page) = shelves(scene, layers) {
        return vec![page];
    }
    let (a, b) = layers.split_at(layers.len() / 2);
    [pack(scene, a), pack(scene, b)].concat()
}

/// Packs all layers into one page, tallest first; `None` if they do not fit.
fn shelves(scene: &Scene, layers: &[usize]) -> Option<Page> {
    let size = |l: usize| (scene.layers[l].rect.w + 2 * GUTTER, scene.layers[l].rect.h + 2 * GUTTER);
    let area: u64 = layers.iter().map(|&l| u64::from(size(l).0) * u64::from(size(l).1)).sum();
    let widest = layers.iter().map(|&l| size(l).0).max().unwrap_or(1);
    let width = ((area as f64).sqrt().ceil() as u32).next_multiple_of(64).min(SIDE).max(widest);
    let mut order: Vec<usize> = (0..layers.len()).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(size(layers[i]).1), i));
    let mut placements = vec![Placement { layer: 0, x: 0, y: 0 }; layers.len()];
    let (mut x, mut y, mut lower) = (0, 0, 0);
    for i in order {
        let (w, h) = size(layers[i]);
        if x + w > width {
            (x, y) = (0, lower);
        }
        placements[i] = Placement { layer: layers[i], x: x + GUTTER, y: y + GUTTER };
        x += w;
        lower = lower.max(y + h);
    }
    // a single layer always gets a page, however large it is
    (lower <= SIDE || layers.len() == 1).then_some(Page { width, height: lower, placements })
}

/// RGBA of a page with straight alpha. Transparent texels have the colour of their neighbours.
pub(super) fn paint(scene: &Scene, page: &Page) -> Vec<[u8; 4]> {
    let width = page.width as usize;
    let mut rgba = vec![[0u8; 4]; width * page.height as usize];
    let mut own = Vec::new();
    for place in &page.placements {
        let rect = scene.layers[place.layer].rect;
        let (w, h) = (rect.w as usize, rect.h as usize);
        own.clear();
        scene.expand_layer(place.layer, &mut own);
        spread(&mut own, w, h);
        for v in 0..h + 2 * GUTTER as usize {
            let row = &own[(v.saturating_sub(1)).min(h - 1) * w..][..w];
            let at = (place.y as usize - 1 + v) * width + place.x as usize - 1;
            rgba[at] = row[0];
            rgba[at + 1..=at + w].copy_from_slice(row);
            rgba[at + w + 1] = row[w - 1];
        }
    }
    rgba
}

pub(super) fn png(width: u32, height: u32, rgba: &[[u8; 4]]) -> Result<Vec<u8>, ExportError> {
    let mut out = Vec::new();
    PngEncoder::new_with_quality(&mut out, CompressionType::Default, FilterType::Adaptive).write_image(
        rgba.as_flattened(),
        width,
        height,
        ExtendedColorType::Rgba8,
    )?;
    Ok(out)
}

/// Gives each transparent texel the mean colour of its visible neighbours. Otherwise, sampling with straight alpha would darken edges.
fn spread(rgba: &mut [[u8; 4]], w: usize, h: usize) {
    let from = rgba.to_vec();
    for y in 0..h {
        for x in 0..w {
            if from[y * w + x][3] > 0 {
                continue;
            }
            let (mut sum, mut n) = ([0u32; 3], 0);
            for v in y.saturating_sub(1)..(y + 2).min(h) {
                for t in from[v * w + x.saturating_sub(1)..v * w + (x + 2).min(w)].iter().filter(|t| t[3] > 0) {
                    n += 1;
                    for (s, c) in sum.iter_mut().zip(t) {
                        *s += u32::from(*c);
                    }
                }
            }
            if n > 0 {
                let mean = sum.map(|s| ((s + n / 2) / n) as u8);
                rgba[y * w + x] = [mean[0], mean[1], mean[2], 0];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing;
    use super::*;

    #[test]
    fn layers_keep_their_texels_and_do_not_overlap() {
        let scene = &testing::sample().1;
        let layers: Vec<usize> = (0..scene.layers.len()).collect();
        let pages = pack(scene, &layers);
        let mut seen = Vec::new();
        for page in &pages {
            let picture = image::RgbaImage::from_raw(page.width, page.height, paint(scene, page).as_flattened().to_vec()).unwrap();
            assert_eq!(picture.dimensions(), (page.width, page.height));
            let mut taken = vec![false; (page.width * page.height) as usize];
            for place in &page.placements {
                let rect = scene.layers[place.layer].rect;
                let mut own = Vec::new();
                scene.expand_layer(place.layer, &mut own);
                for (i, want) in own.iter().enumerate() {
                    let (x, y) = (place.x + i as u32 % rect.w, place.y + i as u32 / rect.w);
                    assert!(!std::mem::replace(&mut taken[(y * page.width + x) as usize], true), "two layers overlap");
                    let got = picture.get_pixel(x, y).0;
                    assert!(if want[3] == 0 { got[3] == 0 } else { got == *want }, "{got:?} {want:?}");
                }
                // the gutter repeats the border
                let corner = picture.get_pixel(place.x, place.y);
                assert_eq!(picture.get_pixel(place.x - 1, place.y - 1), corner);
                seen.push(place.layer);
            }
        }
        assert_eq!(seen, layers, "in the order given");
    }

    #[test]
    fn transparent_texels_take_their_neighbours_colour() {
        let mut rgba = vec![[0; 4]; 9];
        rgba[0] = [200, 100, 50, 255];
        rgba[2] = [100, 200, 50, 9];
        spread(&mut rgba, 3, 3);
        assert_eq!(rgba[1], [150, 150, 50, 0]);
        assert_eq!((rgba[3], rgba[4], rgba[8]), ([200, 100, 50, 0], [150, 150, 50, 0], [0; 4]));
    }
}
