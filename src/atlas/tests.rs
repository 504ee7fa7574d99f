use proptest::prelude::*;

use super::*;
use crate::tmpi::{Class, Grid, Intrinsics, Layer, Photo, Plane, Rect, Scene, Texels, ViewBox};

/// A scene of every kind of texel, with hidden colours that JPEG keeps well.
fn scene(width: u32, height: u32) -> Scene {
    let grid = Grid::new(width, height, 64);
    let photo = Photo {
        width,
        height,
        rgb: (0..width * height).map(|i| [(i % width * 255 / width) as u8, (i / width * 255 / height) as u8, 90]).collect(),
    };
    let (mut layers, mut texels) = (Vec::new(), Texels::default());
    for tile in 0..grid.tiles() {
        let r = grid.rect(tile);
        for (j, plane) in [Plane { a: 0.25, b: 0.125, c: -0.0625 }, Plane::fronto_parallel(0.75)].into_iter().enumerate() {
            let rect = Rect { x: r.x + r.w / 4 * j as u32, y: r.y, w: r.w - r.w / 4 * j as u32, h: r.h };
            layers.push(Layer { tile, plane, rect, first_texel: texels.class.len(), first_hidden: texels.hidden.len() });
            for i in 0..rect.area() {
                let (c, a) = match (i + tile as usize) % 7 {
                    0 => (Class::Empty, 0),
                    1 => (Class::Hidden, 255),
                    2 => (Class::Hidden, 17),
                    3 => (Class::Photo, 200),
                    _ => (Class::Photo, 255),
                };
                texels.class.push(c as u8);
                texels.alpha.push(a);
                if c == Class::Hidden {
                    texels.hidden.push([120, 130, 140]);
                }
            }
        }
    }
    let scene = Scene { grid, intrinsics: Intrinsics::centred(width, height, 300.0), view_box: ViewBox::default(), photo, layers, texels };
    assert_eq!(scene.validate(), Ok(()));
    scene
}

fn container(s: &Scene) -> Vec<u8> {
    let photo = Carried::from_photo(&s.photo, 90).unwrap();
    let (bytes, parts) = encode(s, &photo, 90).unwrap();
    assert_eq!(parts.total, bytes.len());
    assert_eq!(parts.index + parts.photo + parts.alpha + parts.hidden, bytes.len());
    bytes
}

#[test]
fn all_but_the_pictures_comes_back_exactly() {
    for (w, h) in [(150, 100), (64, 64), (1, 1), (65, 63), (1, 200)] {
        let s = scene(w, h);
        let d = decode(&container(&s)).unwrap();
        assert_eq!((&d.grid, &d.intrinsics, &d.view_box, &d.layers), (&s.grid, &s.intrinsics, &s.view_box, &s.layers));
        assert_eq!((&d.texels.class, &d.texels.alpha), (&s.texels.class, &s.texels.alpha));
        assert!(d.texels.hidden.iter().zip(&s.texels.hidden).all(|(a, b)| a.iter().zip(b).all(|(a, b)| a.abs_diff(*b) <= 3)));
    }
}

#[test]
fn a_newer_major_version_is_refused_by_number() {
    let mut b = container(&scene(70, 70));
    b[4] = 2;
    assert!(matches!(decode(&b), Err(AtlasError::Newer { found: 2, known: 1 })));
}

#[test]
fn every_truncation_is_an_error() {
    let b = container(&scene(70, 40));
    for cut in (0..b.len()).step_by(7) {
        assert!(decode(&b[..cut]).is_err(), "cut at {cut}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn damage_never_panics(at in prop::collection::vec((0usize..4000, any::<u8>()), 1..6)) {
        use std::sync::OnceLock;
        static CLEAN: OnceLock<Vec<u8>> = OnceLock::new();
        let clean = CLEAN.get_or_init(|| container(&scene(70, 40)));
        let mut b = clean.clone();
        for (i, v) in at { let n = b.len(); b[i % n] = v; }
        if let Ok(s) = decode(&b) { prop_assert_eq!(s.validate(), Ok(())); }
    }
}
