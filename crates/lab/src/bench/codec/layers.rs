//! A scene as the RGBA layers that other viewers load, and their picture.

use std::sync::Arc;

use tmpi_core::{Class, Layer, Scene};

/// Pictures are cut into blocks of so many pixels by their codecs: no block mixes two layers.
const BLOCK: u32 = 8;
/// Widest picture that WebP holds.
const WIDEST: u32 = 16_376;
/// What the picture's codec sees where there is no layer.
const GREY: [u8; 3] = [128; 3];

/// Straight RGBA of every texel, layer after layer; 0 where there is nothing.
pub fn texels(scene: &Scene) -> Vec<[u8; 4]> {
    let mut out = Vec::with_capacity(scene.texels.class.len());
    (0..scene.layers.len()).for_each(|i| scene.expand_layer(i, &mut out));
    out
}

/// The scene with the colours of these texels.
pub fn with_texels(scene: &Scene, rgba: &[[u8; 4]]) -> Arc<Scene> {
    let mut out = scene.clone();
    let mut hidden = 0;
    for l in &mut out.layers {
        l.first_hidden = hidden;
        let own = &scene.texels.class[l.first_texel..l.first_texel + l.rect.area()];
        hidden += own.iter().filter(|c| **c != Class::Empty as u8).count();
    }
    // no texel takes the photo's colour: each has its own
    out.texels.class.iter_mut().filter(|c| **c != Class::Empty as u8).for_each(|c| *c = Class::Hidden as u8);
    let held = scene.texels.class.iter().zip(rgba).filter(|(c, _)| **c != Class::Empty as u8);
    out.texels.hidden = held.map(|(_, t)| [t[0], t[1], t[2]]).collect();
    Arc::new(out)
}

/// Where each layer lies in one picture of all.
pub struct Packing {
    pub width: u32,
    pub height: u32,
    /// Upper left corner of each layer, in multiples of a block.
    at: Vec<(u32, u32)>,
}

impl Packing {
    /// Shelves, the highest layers first.
    pub fn new(layers: &[Layer]) -> Self {
        let slot = |l: &Layer| (l.rect.w.next_multiple_of(BLOCK), l.rect.h.next_multiple_of(BLOCK));
        let area: f64 = layers.iter().map(slot).map(|(w, h)| f64::from(w) * f64::from(h)).sum();
        let widest = layers.iter().map(|l| slot(l).0).max().unwrap_or(BLOCK);
        let width = (area.sqrt().ceil() as u32).next_multiple_of(BLOCK).max(widest).min(WIDEST);
        let mut order: Vec<usize> = (0..layers.len()).collect();
        order.sort_by_key(|&i| std::cmp::Reverse(slot(&layers[i]).1));
        let mut at = vec![(0, 0); layers.len()];
        let (mut x, mut y, mut height) = (0, 0, 0);
        for i in order {
            let (w, h) = slot(&layers[i]);
            if x + w > width {
                (x, y, height) = (0, y + height, 0);
            }
            at[i] = (x, y);
            (x, height) = (x + w, height.max(h));
        }
        Self { width, height: (y + height).max(BLOCK), at }
    }

    /// Calls `texel(index among all texels, place in the picture)`.
    fn each(&self, layers: &[Layer], mut texel: impl FnMut(usize, usize)) {
        for (l, (x0, y0)) in layers.iter().zip(&self.at) {
            for i in 0..l.rect.area() {
                let (x, y) = (x0 + i as u32 % l.rect.w, y0 + i as u32 / l.rect.w);
                texel(l.first_texel + i, y as usize * self.width as usize + x as usize);
            }
        }
    }

    /// The picture; nothing between the layers.
    pub fn picture(&self, layers: &[Layer], rgba: &[[u8; 4]]) -> Vec<[u8; 4]> {
        let mut out = vec![[0; 4]; self.width as usize * self.height as usize];
        self.each(layers, |texel, place| out[place] = rgba[texel]);
        out
    }

    /// The colours alone, continued so that they cost a lossy codec little: a texel without alpha takes the photo's pixel at its
    /// place, and what is left of the last blocks of a layer its border.
    pub fn colours(&self, scene: &Scene, rgba: &[[u8; 4]]) -> Vec<[u8; 3]> {
        let mut out = vec![GREY; self.width as usize * self.height as usize];
        for (l, (x0, y0)) in scene.layers.iter().zip(&self.at) {
            let (w, h) = (l.rect.w, l.rect.h);
            for y in 0..h.next_multiple_of(BLOCK) {
                for x in 0..w.next_multiple_of(BLOCK) {
                    let (u, v) = (x.min(w - 1), y.min(h - 1));
                    let t = rgba[l.first_texel + (v * w + u) as usize];
                    let colour = if t[3] == 0 { scene.photo.at(l.rect.x + u, l.rect.y + v) } else { [t[0], t[1], t[2]] };
                    out[(y0 + y) as usize * self.width as usize + (x0 + x) as usize] = colour;
                }
            }
        }
        out
    }

    /// The texels of a picture.
    pub fn unpack<const N: usize>(&self, layers: &[Layer], picture: &[[u8; N]], count: usize) -> Vec<[u8; N]> {
        let mut out = vec![[0; N]; count];
        self.each(layers, |texel, place| out[texel] = picture[place]);
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_core::{Camera, Pose};
    use tmpi_render::{Cpu, Renderer};

    fn golden() -> Scene {
        tmpi_core::container::decode(include_bytes!("../../../../../tests/golden/v1_1.tmpi")).unwrap()
    }

    #[test]
    fn layers_lie_apart_and_come_back() {
        let scene = golden();
        let rgba = texels(&scene);
        let packing = Packing::new(&scene.layers);
        let picture = packing.picture(&scene.layers, &rgba);
        assert_eq!(packing.unpack(&scene.layers, &picture, rgba.len()), rgba);
        let held = |t: &[[u8; 4]]| t.iter().filter(|t| t[3] > 0).count();
        assert_eq!(held(&picture), held(&rgba), "layers lie on each other");
        let colours = packing.colours(&scene, &rgba);
        let back = packing.unpack(&scene.layers, &colours, rgba.len());
        assert!(back.iter().zip(&rgba).all(|(c, t)| t[3] == 0 || *c == [t[0], t[1], t[2]]));
    }

    #[test]
    fn a_scene_of_its_own_texels_is_drawn_alike() {
        let scene = Arc::new(golden());
        let other = with_texels(&scene, &texels(&scene));
        assert_eq!(other.validate(), Ok(()));
        let camera = Camera { pose: Pose::at(0.03, -0.01, 0.02), intrinsics: scene.intrinsics, width: 150, height: 100 };
        let draw = |s: &Arc<Scene>| Cpu::default().render(s, &camera).unwrap().rgba;
        assert_eq!(draw(&other), draw(&scene));
    }
}
