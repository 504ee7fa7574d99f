//! Families of close-range scenes: heap, close-up, drape, foliage.

use std::sync::Arc;

use super::cutout::CutoutShape;
use super::families::look;
use super::indoor::{body, indoor_light, ring_or_stick};
use super::math::{AHEAD, DOWN, Frame, RIGHT, V3, fbm, v3};
use super::objects::Build;
use super::outdoor::daylight;
use super::shape::{Field, Shape};
use super::texture::{Pattern, Texture, colour, hsv};

/// A slightly rotated wall across the view at distance `d`, with a quiet or strong pattern.
fn backdrop(b: &mut Build, d: f64) {
    let pattern = if b.rng.chance(0.6) { b.rng.pick(&Pattern::STRONG) } else { b.rng.pick(&Pattern::QUIET) };
    let (g, t) = (b.w.group(), Texture::new(b.rng, pattern, d * b.rng.log_range(0.05, 0.5)));
    let turn: f64 = b.rng.range(-0.5, 0.5);
    b.w.card(g, v3(0.0, 0.0, d), v3(turn.cos(), 0.0, turn.sin()), DOWN, (d * 5.0, d * 5.0), CutoutShape::Full, t);
}

/// Toys, cushions, books and cones heaped on steps in front of a wall: busy everywhere, with small depth differences between neighbours.
pub(super) fn heap(b: &mut Build) {
    let d = b.rng.range(0.8, 2.5);
    backdrop(b, d);
    let steps = b.rng.int(1, 4);
    let low = b.rng.range(0.2, 0.5) * d;
    let rise = b.rng.range(0.1, 0.3) * d;
    for s in 0..steps {
        let s = f64::from(s);
        let (y, near) = (low - rise * s, d * (0.45 + 0.5 * s / f64::from(steps)));
        b.put(Texture::any(b.rng, 0.15 * d), Frame::at(v3(0.0, y + d, near + d)), Shape::Cuboid(v3(d * 3.0, d, d)));
        for _ in 0..b.rng.int(3, 11) {
            let z = near + d * b.rng.range(0.02, 0.2);
            let at = v3(b.rng.range(-0.75, 0.75) * z, y, z);
            toy(b, at, d * b.rng.range(0.12, 0.4));
        }
    }
    if b.rng.chance(0.4) {
        // a lattice or rings on the wall
        for _ in 0..b.rng.int(2, 9) {
            let at = v3(b.rng.range(-0.7, 0.7) * d, b.rng.range(-0.6, 0.2) * d, d * b.rng.range(0.75, 0.97));
            ring_or_stick(b, at, d * b.rng.range(0.1, 0.3));
        }
    }
    look(b, v3(b.rng.range(-0.2, 0.2) * d, 0.0, 0.0), b.rng.range(-15.0, 15.0), b.rng.range(-14.0, 14.0), b.rng.range(-5.0, 5.0));
    indoor_light(b, v3(b.rng.range(-1.5, 1.5), -1.5, -0.5) * d);
}

/// A toy, a book, a cone, a cushion or a figure of size `s` standing at `at`.
fn toy(b: &mut Build, at: V3, s: f64) {
    match b.rng.int(0, 9) {
        0..=2 => body(b, at - DOWN * (0.4 * s), s * 0.5),
        3 => b.person(at, s * 1.6, std::f64::consts::PI + b.rng.range(-0.8, 0.8)),
        4 => {
            let t = Texture::any(b.rng, s * 0.3);
            b.put(t, Frame::at(at - DOWN * (0.5 * s)), Shape::Cylinder(0.5 * s, 0.01 * s, s * b.rng.range(0.15, 0.35)));
        }
        5 | 6 => {
            // a book, upright or leaning
            let t = Texture::new(b.rng, Pattern::Print, s * b.rng.range(0.3, 1.5));
            let half = v3(s * b.rng.range(0.25, 0.5), s * 0.5, s * b.rng.log_range(0.02, 0.15));
            b.block(t, at, half, b.rng.range(-1.2, 1.2));
        }
        7 => {
            let (t, half) = (Texture::any(b.rng, s * 0.3), v3(s * 0.6, s * 0.45, s * 0.25));
            b.put(t, Frame::yaw(at - DOWN * (s * 0.4), b.rng.range(-0.6, 0.6)), Shape::Ellipsoid(half));
        }
        8 => b.vessel(at, s * 4.0),
        _ => b.cutout(at, s * 1.2, -AHEAD, CutoutShape::subject(b.rng), 0.9),
    }
}

/// One or more dishes with food that fill the frame, with objects behind them.
pub(super) fn closeup(b: &mut Build) {
    let h = b.rng.log_range(0.2, 0.8);
    let (g, top) = (b.w.group(), Texture::any(b.rng, h * b.rng.log_range(0.1, 0.8)));
    b.w.add(g, Frame::yaw(v3(0.0, 0.03, 0.0), b.rng.range(-0.8, 0.8)), Shape::Cuboid(v3(h * 3.0, 0.03, h * b.rng.range(1.2, 4.0))), top);
    b.put(Texture::any(b.rng, 0.4), Frame::at(v3(0.0, 0.8, 0.0)), Shape::Plane);
    let pitch = b.rng.range(-80.0, -14.0);
    let back = (h / (-pitch).to_radians().tan()).min(2.2 * h);
    look(b, v3(b.rng.range(-0.2, 0.2) * h, -h, -back), b.rng.range(-12.0, 12.0), pitch, b.rng.range(-12.0, 12.0));
    let wide = h * b.rng.range(0.25, 0.75);
    for i in 0..b.rng.int(1, 6) {
        let r = wide * b.rng.range(0.7, 1.2);
        let away = if i == 0 { 0.3 } else { 2.2 };
        let at = v3(b.rng.range(-away, away) * wide, 0.0, b.rng.range(-0.5, 1.0) * away * wide);
        dish(b, at, r);
    }
    for _ in 0..b.rng.int(0, 6) {
        let at = v3(b.rng.range(-1.6, 1.6) * h, 0.0, h * b.rng.range(0.5, 1.6));
        b.vessel(at, h * b.rng.range(1.0, 3.0));
    }
    if b.rng.chance(0.35) {
        // a hand at work
        let (g, t) = (b.w.group(), Texture::plain(b.rng, colour(b.rng)));
        let hand = v3(b.rng.range(-0.5, 0.5) * h, -h * b.rng.range(0.1, 0.35), b.rng.range(-0.3, 0.5) * h);
        let out = v3(b.rng.sign() * b.rng.range(0.6, 1.2), -0.4, b.rng.range(-0.3, 0.6)) * h;
        b.w.bar(g, hand, hand + out, (0.09 * h, 0.14 * h), t.clone());
        b.w.add(g, Frame::at(hand), Shape::Ellipsoid(v3(0.14, 0.1, 0.14) * h), t);
    }
    if b.rng.chance(0.6) {
        let (g, t) = (b.w.group(), Texture::any(b.rng, h * b.rng.log_range(0.3, 2.0)));
        let z = h * b.rng.log_range(1.8, 9.0);
        b.w.card(g, v3(0.0, 0.0, z), RIGHT, DOWN, (z * 4.0, z * 3.0), CutoutShape::Full, t);
    }
    indoor_light(b, v3(b.rng.range(-2.0, 2.0), -2.0, b.rng.range(-1.0, 1.5)) * h);
}

/// A plate, a tray or a bowl of radius `r` with food.
fn dish(b: &mut Build, at: V3, r: f64) {
    let (g, t) = (b.w.group(), Texture::any(b.rng, r * 0.5));
    let tall = r * b.rng.log_range(0.03, 0.5);
    b.w.add(g, Frame::at(at - DOWN * (0.04 * r)), Shape::Cylinder(0.04 * r, r, r * 0.8), t.clone());
    if tall > 0.12 * r {
        // the wall of an open bowl
        for i in 0..3 {
            let y = tall * (f64::from(i) + 1.0) / 3.0;
            let f = Frame::along(at - DOWN * y, AHEAD);
            let flat = Frame { origin: f.origin, axes: [RIGHT, AHEAD, -DOWN] };
            b.w.add(g, flat, Shape::Torus(r * (0.9 + 0.06 * f64::from(i)), tall * 0.25), t.clone());
        }
    }
    let base = at - DOWN * (0.08 * r + if tall > 0.12 * r { tall * 0.5 } else { 0.0 });
    let food = Texture::any(b.rng, r * 0.3);
    let whole = b.rng.chance(0.45);
    if whole {
        b.put(food.clone(), Frame::at(base), Shape::Cylinder(0.05 * r, 0.8 * r, 0.85 * r));
    }
    for _ in 0..b.rng.int(4, 24) {
        let s = r * b.rng.log_range(0.05, 0.35);
        let (a, far) = (b.rng.range(-3.1, 3.1), r * 0.7 * b.rng.unit().sqrt());
        let p = base + v3(a.sin() * far, 0.0, a.cos() * far) - DOWN * if whole { 0.06 * r } else { 0.0 };
        let t = if b.rng.chance(0.4) { food.clone() } else { Texture::any(b.rng, s) };
        let m = b.rng.rotation();
        let shape = match b.rng.int(0, 3) {
            0 => Shape::Cuboid(v3(s * 0.6, s * 0.25, s * 0.4)),
            _ => Shape::Ellipsoid(v3(s * 0.6, s * b.rng.range(0.2, 0.6), s * 0.5)),
        };
        b.put(t, Frame::turned(p - DOWN * (0.3 * s), &m), shape);
    }
}

/// Cloth over steps, tilted boards and large curved bodies: no ground, no upright objects, slopes in all directions.
pub(super) fn drape(b: &mut Build) {
    let half = b.rng.range(0.8, 2.5);
    let (seed, folds, angle) = (b.rng.next() as u32, b.rng.range(2.0, 9.0), b.rng.range(-3.1, 3.1));
    let (step, swing) = (half * b.rng.range(0.0, 0.35), half * b.rng.range(0.02, 0.12));
    let (sin, cos) = angle.sin_cos();
    let field = Field::new(half, 161, |x, z| {
        let p = v3(x / half, 0.0, z / half);
        let along = p.x * cos + p.z * sin + 0.6 * fbm(p * 1.3, 2, 0.0, seed);
        let ledge = (fbm(p * 1.5, 2, 0.0, seed ^ 5) * 6.0).floor() / 6.0;
        let lump = fbm(p * 2.0, 3, 0.0, seed ^ 9);
        step * (0.6 * ledge + 0.8 * lump) + swing * (along * folds).sin() * fbm(p * 2.0, 2, 0.0, seed ^ 7)
    });
    // from lying flat to hanging
    let tilt: f64 = b.rng.range(0.0, 1.7);
    let d = half * b.rng.range(0.7, 1.3);
    let axes = [RIGHT, v3(0.0, tilt.cos(), tilt.sin()), v3(0.0, -tilt.sin(), tilt.cos())];
    let pattern = if b.rng.chance(0.7) { b.rng.pick(&Pattern::STRONG) } else { b.rng.pick(&Pattern::QUIET) };
    let (g, t) = (b.w.group(), Texture::new(b.rng, pattern, half * b.rng.log_range(0.05, 0.4)));
    b.w.add(g, Frame { origin: v3(0.0, 0.35 * half * tilt.cos(), d), axes }, Shape::Field(Arc::new(field)), t);
    backdrop(b, d + half * 1.2);
    for _ in 0..b.rng.int(1, 7) {
        let z = d * b.rng.range(0.45, 0.95);
        let at = v3(b.rng.range(-0.6, 0.6) * z, b.rng.range(-0.5, 0.5) * z, z);
        let (g, t, m) = (b.w.group(), Texture::any(b.rng, half * 0.15), b.rng.rotation());
        let s = half * b.rng.log_range(0.06, 0.4);
        match b.rng.int(0, 3) {
            0 => b.w.add(g, Frame::turned(at, &m), Shape::Cuboid(v3(s, s * b.rng.range(0.3, 1.0), s * 0.06)), t),
            1 => b.w.add(g, Frame::turned(at, &m), Shape::Cylinder(s * 1.5, s * 0.5, s * 0.5), t),
            2 => b.w.add(g, Frame::turned(at, &m), Shape::Ellipsoid(v3(s, s * 0.7, s * 0.8)), t),
            _ => body(b, at, s),
        }
    }
    look(b, V3::default(), b.rng.range(-12.0, 12.0), b.rng.range(-12.0, 8.0), b.rng.range(-10.0, 10.0));
    indoor_light(b, v3(b.rng.range(-1.5, 1.5), -1.5, -0.3) * half);
}

/// Nearby leaves, flowers and twigs, a subject among them, and bushes or sky behind.
pub(super) fn foliage(b: &mut Build) {
    daylight(b);
    let d = b.rng.log_range(0.4, 4.0);
    let far = d * b.rng.range(1.8, 8.0);
    if b.rng.chance(0.7) {
        let (g, t) = (b.w.group(), Texture::new(b.rng, Pattern::Foliage, far * b.rng.log_range(0.04, 0.3)));
        b.w.card(g, v3(0.0, 0.0, far), RIGHT, DOWN, (far * 4.0, far * b.rng.range(0.3, 3.0)), CutoutShape::Full, t);
    }
    let ground = b.rng.chance(0.6).then(|| d * b.rng.range(0.3, 0.9));
    if let Some(y) = ground {
        b.put(Texture::new(b.rng, Pattern::Foliage, d * 0.2), Frame::at(v3(0.0, y, 0.0)), Shape::Plane);
    }
    for _ in 0..b.rng.int(1, 6) {
        let z = d * b.rng.log_range(0.7, 1.8);
        let root = v3(b.rng.range(-0.7, 0.7) * z, ground.unwrap_or(z * b.rng.range(-0.2, 0.9)), z);
        plant(b, root, d * b.rng.range(0.4, 1.1));
    }
    if b.rng.chance(0.6) {
        let z = d * b.rng.range(0.8, 1.6);
        let at = v3(b.rng.range(-0.4, 0.4) * z, ground.unwrap_or(z * 0.4), z);
        let o = if b.rng.chance(0.6) { CutoutShape::animal(b.rng) } else { CutoutShape::subject(b.rng) };
        b.cutout(at, d * b.rng.range(0.4, 1.2), -AHEAD, o, 1.2);
    }
    look(b, V3::default(), b.rng.range(-15.0, 15.0), b.rng.range(-25.0, 20.0), b.rng.range(-8.0, 8.0));
}

/// A plant of size `s` at `root`: stems with flat leaves in all directions, and flowers at some tips.
fn plant(b: &mut Build, root: V3, s: f64) {
    let g = b.w.group();
    let green = |b: &Build| hsv(b.rng.range(0.17, 0.38), b.rng.range(0.3, 0.85), b.rng.range(0.2, 0.75));
    let leaf = green(b);
    let stem = Texture::plain(b.rng, leaf * 0.6);
    let bloom = b.rng.chance(0.35).then(|| colour(b.rng));
    let (long, slim) = (s * b.rng.log_range(0.08, 0.35), b.rng.range(0.15, 0.6));
    for _ in 0..b.rng.int(3, 9) {
        let tip = root + v3(b.rng.range(-0.5, 0.5), -b.rng.range(0.3, 1.0), b.rng.range(-0.4, 0.4)) * s;
        b.w.bar(g, root, tip, (s * 0.012, s * 0.006), stem.clone());
        for _ in 0..b.rng.int(4, 14) {
            let m = b.rng.rotation();
            let f = Frame::turned(root.lerp(tip, b.rng.range(0.25, 1.0)), &m);
            let size = long * b.rng.range(0.6, 1.2);
            let t = Texture::of(b.rng, Pattern::Noise, size * 0.5, [leaf, leaf * b.rng.range(0.5, 1.1), leaf]);
            b.w.add(g, Frame { origin: f.origin + f.axes[1] * size, ..f }, Shape::Card(size * slim, size, CutoutShape::Disc), t);
        }
        if let Some(c) = bloom {
            let t = Texture::plain(b.rng, c);
            b.w.add(g, Frame::at(tip), Shape::Ellipsoid(v3(1.0, 0.7, 1.0) * (long * 0.5)), t);
        }
    }
}
