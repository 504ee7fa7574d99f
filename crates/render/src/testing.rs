//! Small scenes for this crate's unit tests.

use tmpi_core::{Class, Grid, Intrinsics, Layer, Photo, Plane, Scene, Texels, ViewBox};

/// One tile with one fronto-parallel layer of disparity `delta` that shows the photo.
pub(super) fn flat(width: u32, height: u32, delta: f64) -> Scene {
    let photo = Photo::from_fn(width, height, |x, y| [((y * width + x) * 7 % 256) as u8, y as u8, 90]);
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
        view_box: ViewBox::cube(0.03),
        photo,
        layers: vec![layer(grid.rect(0))],
        texels,
    }
}
