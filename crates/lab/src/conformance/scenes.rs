//! Scenes and cameras made to hold the renderers against each other.

use tmpi_core::{Camera, Class, Grid, Intrinsics, Layer, Photo, Plane, Pose, Scene, Texels, ViewBox};
use tmpi_testing::pictures;

/// A texel: its class, alpha and, where hidden, colour.
pub enum Texel {
    /// Nothing there.
    Empty,
    /// The photo's pixel at that alpha.
    Photo(u8),
    /// A colour of its own and its alpha.
    Hidden([u8; 3], u8),
}

/// Builds a scene layer by layer.
pub struct Builder(pub Scene);

impl Builder {
    /// A scene without layers over a smooth, colourful photo with a sharp checkerboard in one quarter.
    pub fn new(grid: Grid) -> Self {
        let (w, h) = (grid.width, grid.height);
        let pixel = |i: u32| {
            let (x, y) = (f64::from(i % w), f64::from(i / w));
            let wave = |p: f64| (127.5 + 127.0 * p.sin()) as u8;
            let board = x < f64::from(w) / 2.0 && y < f64::from(h) / 2.0 && (i % w / 8 + i / w / 8).is_multiple_of(2);
            [wave(x / 11.0), wave(y / 7.0 + x / 40.0), if board { 250 } else { 30 }]
        };
        let intrinsics = Intrinsics::centred(w, h, f64::from(w) * Intrinsics::DEFAULT_FOCAL_PER_WIDTH);
        Self(Scene {
            grid,
            intrinsics,
            view_box: ViewBox::cube(0.03),
            photo: Photo { width: w, height: h, rgb: (0..w * h).map(pixel).collect() },
            layers: Vec::new(),
            texels: Texels::default(),
        })
    }

    /// Adds a layer over tile `tile`, cut to `share` of the tile from its upper left; `texel` is asked for each photo pixel.
    pub fn layer(&mut self, tile: u32, plane: Plane, share: (f64, f64), texel: impl Fn(u32, u32) -> Texel) {
        let s = &mut self.0;
        let mut rect = s.grid.rect(tile);
        rect.w = ((f64::from(rect.w) * share.0) as u32).max(1);
        rect.h = ((f64::from(rect.h) * share.1) as u32).max(1);
        s.layers.push(Layer { tile, plane, rect, first_texel: s.texels.class.len(), first_hidden: s.texels.hidden.len() });
        for y in rect.y..rect.y + rect.h {
            for x in rect.x..rect.x + rect.w {
                let (class, alpha) = match texel(x, y) {
                    Texel::Empty | Texel::Photo(0) | Texel::Hidden(_, 0) => (Class::Empty, 0),
                    Texel::Photo(alpha) => (Class::Photo, alpha),
                    Texel::Hidden(rgb, alpha) => {
                        s.texels.hidden.push(rgb);
                        (Class::Hidden, alpha)
                    }
                };
                s.texels.class.push(class as u8);
                s.texels.alpha.push(alpha);
            }
        }
    }

    /// The plane of tile `tile` on which `δ = at(x, y)` (affine in photo pixels).
    pub fn plane(&self, tile: u32, at: impl Fn(f64, f64) -> f64) -> Plane {
        let ((x, y), half) = (self.0.grid.centre(tile), self.0.grid.half());
        let a = at(x, y);
        Plane { a, b: at(x + half, y) - a, c: at(x, y + half) - a }
    }
}

/// One fronto-parallel layer over the whole photo.
pub fn flat(width: u32, height: u32, delta: f64) -> Scene {
    let mut b = Builder::new(Grid::full(width, height));
    b.layer(0, Plane::fronto_parallel(delta), (1.0, 1.0), |_, _| Texel::Photo(255));
    b.0
}

/// Columns that lie on planes of these disparities in turn, in tiles; hidden texels of the planes behind.
pub fn close(deltas: &[f64]) -> Scene {
    let mut b = Builder::new(Grid::new(160, 100, 64));
    for tile in 0..b.0.grid.tiles() {
        for (i, delta) in deltas.iter().enumerate() {
            b.layer(tile, Plane::fronto_parallel(*delta), (1.0, 1.0), |x, _| match (x / 20) as usize % deltas.len() {
                shown if shown == i => Texel::Photo(255),
                shown if shown > i => Texel::Hidden([90, 60 + 40 * i as u8, 30], 255),
                _ => Texel::Empty,
            });
        }
    }
    b.0
}

/// Pixels that lie on either of two disparities by chance; hidden texels behind the near ones.
fn noise([far, near]: [f64; 2]) -> Scene {
    let mut b = Builder::new(Grid::new(200, 120, 64));
    let is_near = |x, y| pictures::noise(x, y) > 0.5;
    for tile in 0..b.0.grid.tiles() {
        let behind = |x, y| if is_near(x, y) { Texel::Hidden([90, 60, 30], 255) } else { Texel::Photo(255) };
        b.layer(tile, Plane::fronto_parallel(far), (1.0, 1.0), behind);
        let before = |x, y| if is_near(x, y) { Texel::Photo(255) } else { Texel::Empty };
        b.layer(tile, Plane::fronto_parallel(near), (1.0, 1.0), before);
    }
    b.0
}

/// Layers of one colour each over the whole photo.
pub fn stack(width: u32, height: u32, colours: &[[u8; 4]], delta: &[f64]) -> Scene {
    let mut b = Builder::new(Grid::full(width, height));
    for (c, &d) in colours.iter().zip(delta) {
        b.layer(0, Plane::fronto_parallel(d), (1.0, 1.0), |_, _| Texel::Hidden([c[0], c[1], c[2]], c[3]));
    }
    b.0
}

/// A slanted ground over overlapping tiles: one plane in space, written in every tile's own coordinates.
pub fn ground(width: u32, height: u32, size: u32) -> Scene {
    let mut b = Builder::new(Grid::new(width, height, size));
    for tile in 0..b.0.grid.tiles() {
        let plane = b.plane(tile, |x, y| 0.1 + 0.8 * y / f64::from(height) + 0.1 * x / f64::from(width));
        b.layer(tile, plane, (1.0, 1.0), |_, _| Texel::Photo(255));
    }
    b.0
}

/// A disc with a soft rim at δ = .8 before a background of disparity `far` (hidden texels behind the disc), tiles of `size`.
pub fn disc(width: u32, height: u32, size: u32, far: f64) -> Scene {
    let mut b = Builder::new(Grid::new(width, height, size));
    let radius = f64::from(height) * 0.3;
    let distance = |x: u32, y: u32| {
        let (dx, dy) = (f64::from(x) + 0.5 - f64::from(width) / 2.0, f64::from(y) + 0.5 - f64::from(height) / 2.0);
        dx.hypot(dy) - radius
    };
    for tile in 0..b.0.grid.tiles() {
        b.layer(tile, Plane::fronto_parallel(far), (1.0, 1.0), |x, y| {
            if distance(x, y) < 0.0 { Texel::Hidden([40, 160, 80], 255) } else { Texel::Photo(255) }
        });
        let plane = b.plane(tile, |x, _| 0.8 + 0.2 * (x / f64::from(width) - 0.5));
        let rim = |d: f64| if d < 0.0 { 255 } else { (255.0 * (1.0 - d / 3.0)).max(0.0) as u8 };
        b.layer(tile, plane, (1.0, 1.0), |x, y| Texel::Photo(rim(distance(x, y))));
    }
    b.0
}

/// What a photo gives: tiles of 64, a slanted ground, upright figures with soft rims before it, hidden texels behind them; 3 to 4 layers a tile.
pub fn typical(width: u32, height: u32) -> Scene {
    let mut b = Builder::new(Grid::new(width, height, 64));
    let (w, h) = (f64::from(width), f64::from(height));
    // signed distance to the nearest of a row of ellipses
    let figure = |x: u32, y: u32, every: f64, size: f64| {
        let (x, y) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
        let dx = (x + every / 2.0).rem_euclid(every) - every / 2.0;
        (dx.hypot((y - h / 2.0) * 0.4) - size) * 0.8
    };
    let rows = [(0.25, h * 0.5, h * 0.1), (0.5, h * 0.8, h * 0.15), (0.8, h * 1.3, h * 0.2)];
    for tile in 0..b.0.grid.tiles() {
        let ground = b.plane(tile, |x, y| 0.02 + 0.2 * y / h + 0.02 * x / w);
        b.layer(tile, ground, (1.0, 1.0), |x, y| {
            let hidden = rows.iter().any(|&(_, every, size)| figure(x, y, every, size) < 0.0);
            if hidden { Texel::Hidden([70, 110, 60], 255) } else { Texel::Photo(255) }
        });
        for (i, &(delta, every, size)) in rows.iter().enumerate() {
            let rect = b.0.grid.rect(tile);
            let seen = (rect.y..rect.y + rect.h).any(|y| (rect.x..rect.x + rect.w).any(|x| figure(x, y, every, size) < 2.0));
            if seen {
                let plane = b.plane(tile, |x, _| delta + 0.1 * (x / w - 0.5));
                b.layer(tile, plane, (1.0, 1.0), |x, y| {
                    let d = figure(x, y, every, size);
                    let alpha = if d < 0.0 { 255 } else { (255.0 * (1.0 - d / 2.0)).max(0.0) as u8 };
                    let behind = rows[i + 1..].iter().any(|&(_, every, size)| figure(x, y, every, size) < 0.0);
                    if behind { Texel::Hidden([150, 90, 60], alpha) } else { Texel::Photo(alpha) }
                });
            }
        }
    }
    b.0
}

/// Every scene of the comparison, with its name.
pub fn all() -> Vec<(&'static str, Scene)> {
    let (w, h) = (200, 120);
    let mut out = vec![
        ("flat", flat(w, h, 0.5)),
        ("ground", ground(w, h, 64)),
        ("disc", disc(w, h, 64, 0.2)),
        ("disc before infinity", disc(w, h, 32, 0.0)),
        ("typical", typical(w, h)),
    ];

    let colours: Vec<[u8; 4]> = (0..12_u8).map(|i| [i * 20, 255 - i * 20, 128, 40 + i * 15]).collect();
    let delta: Vec<f64> = (0..12).map(|i| f64::from(i) / 12.0).collect();
    out.push(("translucent stack", stack(w, h, &colours, &delta)));
    let mut ties = colours;
    ties[11][3] = 255;
    ties.rotate_right(6);
    out.push(("ties", stack(w, h, &ties, &[0.5; 12])));

    // δ changes sign within the tile, and the layers cross
    let mut b = Builder::new(Grid::full(w, h));
    b.layer(0, Plane { a: 0.1, b: 0.5, c: -0.3 }, (1.0, 1.0), |_, _| Texel::Photo(255));
    b.layer(0, Plane { a: 0.2, b: -0.4, c: 0.2 }, (1.0, 1.0), |x, y| {
        if (x / 16 + y / 16).is_multiple_of(2) { Texel::Hidden([250, 240, 20], 255) } else { Texel::Hidden([20, 20, 250], 120) }
    });
    out.push(("crossing, beyond infinity", b.0));

    // all of it beyond infinity, where the last layer is in front whatever δ it has
    let mut b = Builder::new(Grid::full(w, h));
    let blinds = |colour: [u8; 3], every: u32| {
        move |x: u32, _: u32| if (x / every).is_multiple_of(2) { Texel::Hidden(colour, 255) } else { Texel::Photo(255) }
    };
    b.layer(0, Plane::fronto_parallel(-0.05), (1.0, 1.0), blinds([250, 30, 30], 20));
    b.layer(0, Plane { a: -0.3, b: 0.05, c: 0.1 }, (1.0, 1.0), blinds([30, 250, 30], 12));
    b.layer(0, Plane::fronto_parallel(-0.1), (0.5, 0.6), blinds([30, 30, 250], 7));
    out.push(("beyond infinity", b.0));

    // so small that what is drawn beyond the outermost texel centres is a good part of it
    let mut b = Builder::new(Grid::full(12, 10));
    b.layer(0, Plane { a: 0.4, b: 0.02, c: 0.03 }, (1.0, 1.0), |x, y| {
        if (x + y).is_multiple_of(2) { Texel::Hidden([250, 250, 250], 255) } else { Texel::Hidden([5, 5, 5], 255) }
    });
    out.push(("twelve by ten", b.0));

    // narrow remnants: tiles of one column, layers of a part of their tile
    let mut b = Builder::new(Grid::new(65, 63, 64));
    for tile in 0..b.0.grid.tiles() {
        let plane = b.plane(tile, |x, y| 0.3 + 0.004 * x - 0.002 * y);
        b.layer(tile, plane, (1.0, 1.0), |_, _| Texel::Photo(255));
        b.layer(tile, Plane { a: 0.7, b: 0.05, c: 0.0 }, (0.4, 0.01), |_, _| Texel::Photo(255));
        b.layer(tile, Plane { a: 0.9, b: 0.0, c: 0.05 }, (0.01, 0.7), |_, y| Texel::Photo((y * 4) as u8));
    }
    out.push(("remnants", b.0));

    // empty texels, alpha by texel
    let mut b = Builder::new(Grid::new(w, h, 64));
    for tile in 0..b.0.grid.tiles() {
        b.layer(tile, Plane { a: 0.3, b: 0.02, c: 0.05 }, (1.0, 1.0), |x, y| {
            if (x / 5 + y / 3) % 4 == 0 { Texel::Empty } else { Texel::Photo(255) }
        });
        b.layer(tile, Plane { a: 0.6, b: -0.05, c: 0.02 }, (1.0, 1.0), |x, y| {
            if x % 9 < 4 { Texel::Empty } else { Texel::Hidden([220, 90, 40], (y % 64 * 4) as u8) }
        });
    }
    out.push(("holes", b.0));

    // far wider than high, and sides of one pixel
    out.extend([("panorama", ground(1200, 40, 64)), ("one row", ground(300, 1, 64)), ("one column", ground(1, 300, 64))]);
    let step = 1.0 / 65_535.0;
    out.extend([
        ("two values, noise", noise([0.0, 1.0])),
        ("near the horizon, noise", noise([0.0, 2.0 * step])),
        ("a step of 16 bits, noise", noise([0.5, 0.5 + step])),
    ]);
    out
}

/// Camera of the scene's field of view at `pose`, for a view of `width × height`.
pub fn camera(scene: &Scene, pose: Pose, width: u32, height: u32) -> Camera {
    let from = (scene.photo.width, scene.photo.height);
    Camera { pose, intrinsics: scene.intrinsics.resized(from, (width, height)), width, height }
}

/// The camera of the photo at `pose`.
pub fn own_camera(scene: &Scene, pose: Pose) -> Camera {
    Camera { pose, intrinsics: scene.intrinsics, width: scene.photo.width, height: scene.photo.height }
}

/// Every camera of the comparison, with its name.
pub fn cameras(scene: &Scene) -> Vec<(&'static str, Camera)> {
    let (w, h) = (scene.photo.width, scene.photo.height);
    let own = |pose: Pose| own_camera(scene, pose);
    let fov = |degrees: f64, w: u32, h: u32| Camera {
        pose: Pose::at(0.05, 0.0, 0.0),
        intrinsics: Intrinsics::from_fov_x(w, h, degrees),
        width: w,
        height: h,
    };
    vec![
        ("identity", own(Pose::default())),
        ("shift", own(Pose::at(0.03, -0.02, 0.0))),
        ("larger", camera(scene, Pose { tx: -0.03, ty: 0.03, tz: 0.02, yaw: 2.0, ..Pose::default() }, 320, 200)),
        ("turned", own(Pose { tx: 0.1, ty: 0.05, tz: -0.2, yaw: 20.0, pitch: -10.0, roll: 15.0 })),
        ("close", own(Pose::at(0.02, 0.01, 0.5))),
        ("as close as can be", own(Pose::at(0.0, 0.0, 0.999))),
        ("in a plane", own(Pose::at(0.05, -0.02, 2.0))),
        ("half a turn", own(Pose { tx: 0.2, yaw: -179.999, pitch: 30.0, ..Pose::default() })),
        ("behind a plane", own(Pose { tz: 3.0, tx: 0.3, yaw: 5.0, ..Pose::default() })),
        ("edge-on", own(Pose { tx: -2.0, tz: 2.0, yaw: 90.0, ..Pose::default() })),
        ("nearly edge-on", own(Pose { tx: -2.0, tz: 1.9, yaw: 88.0, ..Pose::default() })),
        ("back", own(Pose { yaw: 180.0, ..Pose::default() })),
        ("back from beyond", own(Pose { tz: 6.0, yaw: -180.0, ..Pose::default() })),
        ("fov 0.1", fov(0.1, w, h)),
        ("fov 179", fov(179.0, w, h)),
        ("one pixel", fov(60.0, 1, 1)),
        ("one row", fov(150.0, 16_384, 1)),
        (
            "principal point outside",
            Camera {
                pose: Pose::at(0.1, 0.0, 0.1),
                intrinsics: Intrinsics { fx: 100.0, fy: 140.0, cx: -50.0, cy: 300.0 },
                width: w,
                height: h,
            },
        ),
    ]
}
