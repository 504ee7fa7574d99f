//! Small scenes for this crate's unit tests.

use tmpi_core::{Class, Grid, Intrinsics, Layer, Photo, Plane, Scene, Texels, ViewBox};

/// One tile with one fronto-parallel layer of disparity `delta` that shows the photo.
pub(super) fn flat(width: u32, height: u32, delta: f64) -> Scene {
    let rgb = (0..width * height).map(|i| [(i * 7 % 256) as u8, (i / width) as u8, 90]).collect();
    let layer = |rect| Layer { tile: 0, plane: Plane::fronto_parallel(delta), rect, first_texel: 0, first_hidden: 0 };
    let grid = Grid::full(width, height);
    let texels = Texels {
        class: vec![Class::Photo as u8; (width * height) as usize],
        alpha: vec![255; (width * height) as usize],
        hidden: Vec::new(),
    };
    Scene {
        grid,
        intrinsics: Intrinsics::centred(width, height, f64::from(width)),
        view_box: ViewBox::default(),
        photo: Photo { width, height, rgb },
        layers: vec![layer(grid.rect(0))],
        texels,
    }
}

/// One tile; layer `i` has the straight-alpha colour `colours[i]` everywhere, and disparity `delta[i]`.
pub(super) fn stack(width: u32, height: u32, colours: &[[u8; 4]], delta: &[f64]) -> Scene {
    let mut scene = flat(width, height, 0.0);
    scene.layers.clear();
    scene.texels = Texels::default();
    let rect = scene.grid.rect(0);
    for (c, &d) in colours.iter().zip(delta) {
        scene.layers.push(Layer {
            tile: 0,
            plane: Plane::fronto_parallel(d),
            rect,
            first_texel: scene.texels.class.len(),
            first_hidden: scene.texels.hidden.len(),
        });
        scene.texels.class.extend(vec![Class::Hidden as u8; rect.area()]);
        scene.texels.alpha.extend(vec![c[3]; rect.area()]);
        scene.texels.hidden.extend(vec![[c[0], c[1], c[2]]; rect.area()]);
    }
    scene
}
