use super::math::{Frame, hash3, v3};
use super::photo_texture::Patch;
use super::shape::Shape;
use super::texture::Texture;
use super::*;
use tmpi_core::mat3_vec;

fn camera(width: u32, height: u32) -> Camera {
    Camera { pose: Pose::default(), intrinsics: Intrinsics::from_fov_x(width, height, 60.0), width, height }
}

/// A scene with a single object, in metres (`unit` 1).
fn single(shape: Shape, frame: Frame) -> Scene {
    let rng = Rng::new(1);
    let mut world = World::new(&rng);
    let g = world.group();
    world.add(g, frame, shape, texture::Texture::any(&rng, 0.3));
    world.finish();
    Scene { family: "test", world, unit: 1.0, size: (64, 48) }
}

#[test]
fn seeds_determine_scenes() {
    let draw = |seed| {
        let s = Scene::framed(seed, 48, 32);
        s.render(&s.camera(), 2)
    };
    for seed in [0, 7, u64::MAX] {
        assert_eq!(draw(seed), draw(seed));
    }
    assert_ne!(draw(1), draw(2));
}

#[test]
fn disparity_of_a_ground_plane_is_exact() {
    let s = single(Shape::Plane, Frame::at(v3(0.0, 1.5, 0.0)));
    let cam = camera(64, 48);
    let map = s.render(&cam, 1).disparity;
    for y in 0..48u32 {
        for x in 0..64u32 {
            let want = ((f64::from(y) + 0.5 - cam.intrinsics.cy) / cam.intrinsics.fy / 1.5).max(0.0);
            let have = f64::from(map.delta[(y * 64 + x) as usize]);
            assert!((have - want).abs() < 1e-6, "({x}, {y}): {have}, {want}");
        }
    }
}

#[test]
fn disparity_of_a_sphere_and_a_card_is_exact() {
    let cam = camera(65, 49);
    let s = single(Shape::Ellipsoid(v3(1.0, 1.0, 1.0)), Frame::at(v3(0.0, 0.0, 4.0)));
    let map = s.render(&cam, 1).disparity;
    assert!((map.delta[24 * 65 + 32] - 1.0 / 3.0).abs() < 1e-6, "the centre pixel shows the pole");
    let k = cam.intrinsics;
    for (i, &have) in map.delta.iter().enumerate() {
        let (dx, dy) = (((i % 65) as f64 + 0.5 - k.cx) / k.fx, ((i / 65) as f64 + 0.5 - k.cy) / k.fy);
        let (a, b, c) = (dx * dx + dy * dy + 1.0, -8.0, 15.0);
        let disc = b * b - 4.0 * a * c;
        let want = if disc < 0.0 { 0.0 } else { 2.0 * a / (-b - disc.sqrt()) };
        assert!((f64::from(have) - want).abs() < 1e-6);
    }
    let m = Pose { yaw: 30.0, ..Pose::default() }.orientation();
    let card = single(Shape::Card(1e3, 1e3, outline::Outline::Full), Frame::turned(v3(0.0, 0.0, 2.0), &m));
    let map = card.render(&cam, 1).disparity;
    // the plane (sin 30°, 0, cos 30°) · (X − (0, 0, 2)) = 0: δ is affine in the picture
    let (sin, cos) = 30f64.to_radians().sin_cos();
    for (i, &have) in map.delta.iter().enumerate() {
        let dx = ((i % 65) as f64 + 0.5 - k.cx) / k.fx;
        assert!((f64::from(have) - (sin * dx + cos) / (2.0 * cos)).abs() < 1e-6);
    }
}

#[test]
fn hits_satisfy_the_primitives_equations() {
    let rng = Rng::new(3);
    let on_surface = |shape: &Shape, p: V3| match shape {
        Shape::Cuboid(h) => (p.x.abs() / h.x).max(p.y.abs() / h.y).max(p.z.abs() / h.z) - 1.0,
        Shape::Ellipsoid(r) => (p.x / r.x).hypot(p.y / r.y).hypot(p.z / r.z) - 1.0,
        Shape::Torus(ring, tube) => ((p.x.hypot(p.y) - ring).hypot(p.z) - tube) / tube,
        Shape::Cylinder(h, a, b) => {
            let r = 0.5 * (a + b) + 0.5 * (b - a) / h * p.y;
            (p.x.hypot(p.z) - r).max(p.y.abs() - h)
        }
        Shape::Field(f) => -p.y - f.at(p.x, p.z),
        Shape::Plane | Shape::Mesh(..) => p.y,
        Shape::Card(..) => p.z,
    };
    let field = shape::Field::new(3.0, 33, |x, z| 0.3 * (x * 2.0).sin() * (z * 1.5).cos());
    let shapes = [
        Shape::Plane,
        Shape::Card(2.0, 1.0, outline::Outline::Disc),
        Shape::Cuboid(v3(1.0, 2.0, 0.5)),
        Shape::Ellipsoid(v3(1.0, 2.0, 0.5)),
        Shape::Cylinder(1.0, 0.3, 0.8),
        Shape::Torus(1.0, 0.2),
        Shape::Field(field.into()),
    ];
    for shape in &shapes {
        let mut hits = 0;
        for _ in 0..2000 {
            let o = v3(rng.range(-6.0, 6.0), -rng.range(2.0, 6.0), rng.range(-6.0, 6.0));
            let aim = v3(rng.range(-1.0, 1.0), rng.range(-1.0, 1.0), rng.range(-1.0, 1.0));
            let d = aim - o;
            if let Some((t, n)) = shape.hit(o, d, 1e-9, f64::INFINITY) {
                hits += 1;
                assert!(on_surface(shape, o + d * t).abs() < 1e-6, "{shape:?}");
                assert!((n.norm() - 1.0).abs() < 1e-9);
            }
        }
        assert!(hits > 50, "{shape:?}: {hits}");
    }
}

#[test]
fn disparities_are_finite_with_maximum_one() {
    let mut families = std::collections::BTreeMap::<&str, u32>::new();
    for seed in 0..200 {
        let s = Scene::framed(seed, 48, 32);
        let p = s.render(&s.camera(), 1);
        let max = p.disparity.delta.iter().copied().fold(0.0, f32::max);
        assert!((max - 1.0).abs() < 1e-6, "seed {seed}: {max}");
        assert!(p.disparity.delta.iter().all(|d| d.is_finite() && *d >= 0.0), "seed {seed}");
        let hidden = s.hidden(&s.camera(), 1);
        assert!(hidden.disparity.delta.iter().all(|d| d.is_finite() && *d >= 0.0), "seed {seed}");
        assert!(hidden.disparity.delta.iter().zip(&p.disparity.delta).all(|(h, d)| h <= d), "seed {seed}: hidden is behind");
        let (low, high) = p.photo.rgb.iter().flatten().fold((255, 0), |(a, b), &c| (a.min(c), b.max(c)));
        assert!(high > low, "seed {seed}: a blank picture");
        *families.entry(s.family()).or_default() += 1;
    }
    assert_eq!(families.len(), 18, "{families:?}");
}

#[test]
fn a_quarter_of_scenes_lacks_the_usual_vertical_trend() {
    let odd = (0..120)
        .filter(|&seed| {
            let s = Scene::framed(seed, 48, 32);
            let d = s.render(&s.camera(), 1).disparity.delta;
            let mean = |rows: std::ops::Range<usize>| d[rows.start * 48..rows.end * 48].iter().sum::<f32>() / (rows.len() * 48) as f32;
            mean(16..32) - mean(0..16) < 0.05
        })
        .count();
    assert!(odd >= 30, "{odd} of 120");
}

/// Every pixel of the first view that is visible in the second must appear there with its disparity.
#[test]
fn second_views_agree_with_the_disparity() {
    let (mut seen, mut found) = (0, 0);
    for seed in 0..24 {
        let s = Scene::framed(seed, 96, 64);
        let cam = s.camera();
        let second = Camera { pose: Pose { tx: 0.03, ty: -0.02, tz: 0.04, yaw: 1.0, pitch: -0.5, roll: 0.7 }, ..cam };
        let (a, b) = (s.render(&cam, 1), s.render(&second, 1));
        let (r, t) = second.pose.extrinsics();
        for (i, &d) in a.disparity.delta.iter().enumerate().filter(|(_, d)| **d > 0.05) {
            let k = cam.intrinsics;
            let z = 1.0 / f64::from(d);
            let p = [((i % 96) as f64 + 0.5 - k.cx) / k.fx * z, ((i / 96) as f64 + 0.5 - k.cy) / k.fy * z, z];
            let q = mat3_vec(&r, p);
            let q: [f64; 3] = std::array::from_fn(|j| q[j] + t[j]);
            let (u, v) = (k.fx * q[0] / q[2] + k.cx, k.fy * q[1] / q[2] + k.cy);
            if q[2] <= 0.0 || !(1.0..95.0).contains(&u) || !(1.0..63.0).contains(&v) {
                continue;
            }
            let there = b.disparity.delta[v as usize * 96 + u as usize];
            let want = (1.0 / q[2]) as f32;
            if there > want + 0.05 {
                continue; // hidden in the second view
            }
            seen += 1;
            found += u32::from((there - want).abs() < 0.02 + 0.03 * want);
        }
    }
    assert!(seen > 10_000);
    assert!(f64::from(found) / f64::from(seen) > 0.97, "{found} of {seen}; the rest are edge pixels");
}

#[test]
fn noise_is_uniform_and_bounded() {
    let mean = (0..4000).map(|i| hash3(i, i * 7, -i, 5)).sum::<f64>() / 4000.0;
    assert!((mean - 0.5).abs() < 0.02);
    for i in 0..500 {
        let p = v3(f64::from(i) * 0.37, f64::from(i) * -0.73, 0.2);
        assert!((0.0..=1.0).contains(&math::fbm(p, 5, 0.01, 9)));
    }
}

#[test]
fn whole_pictures_can_be_backdrops() {
    // four quarters in four colours, twice as wide as high
    let colours = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]];
    let rgb = (0..64 * 32).map(|i| colours[i % 64 / 32 + 2 * (i / 64 / 16)]).collect();
    let pictures = Pictures::new(&[Photo { width: 64, height: 32, rgb }]);
    let rng = Rng::with(1, &Assets { pictures: pictures.clone(), ..Assets::default() });
    let texture = Texture::picture(&rng, Patch::whole(&pictures.0[0]), 10.0);
    let at = |x: f64, y: f64| texture.at(v3(x, y, 0.0), v3(0.0, 0.0, 1.0), 1e-3).map(|v| (v * 255.0).round()).array().map(|v| v as u8);
    // it spans 10 by 5 around the centre
    let corners = [(-4.9, -2.4), (4.9, -2.4), (-4.9, 2.4), (4.9, 2.4)];
    assert_eq!(corners.map(|(x, y)| at(x, y)), colours);
    let inner = [(-0.2, -0.2), (0.2, -0.2), (-0.2, 0.2), (0.2, 0.2)];
    assert_eq!(inner.map(|(x, y)| at(x, y)), colours);
    // and repeats with mirroring
    assert_eq!([at(5.2, 0.3), at(14.0, 0.3), at(0.3, -2.7), at(0.3, -6.0)], [colours[3], colours[2], colours[1], colours[3]]);
    // sometimes there is a backdrop; without pictures, the generator does not advance
    assert!((0..40).any(|seed| Rng::with(seed, &Assets { pictures: pictures.clone(), ..Assets::default() }).backdrop().is_some()));
    let (with, without) = (Rng::new(3), Rng::new(3));
    assert!(with.backdrop().is_none());
    assert_eq!(with.next(), without.next());
}

#[test]
fn pictures_become_textures() {
    let ramp = |w, h| Photo::from_fn(w, h, |x, _| [(x * 255 / w) as u8, 40, 200]);
    let pictures = Pictures::new(&[ramp(97, 61), ramp(1, 1), Photo { width: 0, height: 0, rgb: Vec::new() }]);
    let draw = |seed, p: &Pictures| {
        let s = Scene::of(seed, 48, 32, &Assets { pictures: p.clone(), ..Assets::default() });
        s.render(&s.camera(), 1)
    };
    for seed in 0..12 {
        let picture = draw(seed, &pictures);
        assert_eq!(picture, draw(seed, &pictures), "seed {seed}");
        assert!(picture.disparity.delta.iter().all(|d| d.is_finite()));
    }
    assert!((0..12).any(|seed| draw(seed, &pictures).photo != draw(seed, &Pictures::default()).photo));
}
