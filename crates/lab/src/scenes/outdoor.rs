//! Families of outdoor scenes: street, field, thin structures, terrain.

use std::sync::Arc;

use super::cutout::CutoutShape;
use super::families::look;
use super::indoor::ring_or_stick;
use super::math::{AHEAD, DOWN, Frame, RIGHT, Rng, V3, fbm, v3};
use super::objects::Build;
use super::shape::{Field, Shape};
use super::texture::{Pattern, Texture, colour, hsv};
use super::world::Light;

/// Sets sun, sky and haze for a random time of day.
pub(super) fn daylight(b: &mut Build) {
    let low = b.rng.chance(0.25);
    let up = if low { b.rng.range(0.05, 0.35) } else { b.rng.range(0.4, 1.5) };
    let dir = v3(b.rng.range(-1.0, 1.0), -up, b.rng.range(-1.0, 1.0)).unit();
    let overcast = b.rng.chance(0.35);
    let warm = if low { v3(1.0, 0.65, 0.35) } else { v3(1.0, 0.95, 0.88) };
    let s = &mut b.w.sky;
    let blue = b.rng.range(0.4, 1.0);
    if overcast {
        s.zenith = v3(0.55, 0.58, 0.62);
        s.horizon = v3(0.75, 0.76, 0.78);
        s.cover = b.rng.range(0.0, 0.8);
        s.cloud = v3(0.5, 0.52, 0.56);
    } else {
        s.zenith = v3(0.1, 0.22, 0.6).lerp(v3(0.3, 0.45, 0.75), blue);
        s.horizon = if low { v3(0.95, 0.6, 0.35) } else { v3(0.6, 0.72, 0.85) };
        s.cover = b.rng.range(0.0, 0.7);
        s.cloud = warm * 0.95;
        b.w.lights.push(Light::Sun(dir, warm * b.rng.range(0.9, 2.2)));
    }
    b.w.ambient = s.zenith.lerp(v3(0.5, 0.5, 0.5), 0.5) * b.rng.range(0.4, 1.0);
    if b.rng.chance(0.6) {
        b.w.fog = Some((s.horizon, b.rng.log_range(0.0006, 0.015)));
    }
}

fn ground_texture(rng: &Rng) -> Texture {
    let c = match rng.int(0, 4) {
        0 | 1 => hsv(rng.range(0.18, 0.33), rng.range(0.3, 0.75), rng.range(0.2, 0.6)),
        2 => hsv(rng.range(0.05, 0.12), rng.range(0.15, 0.5), rng.range(0.35, 0.85)),
        3 => hsv(0.6, rng.range(0.0, 0.12), rng.range(0.2, 0.95)),
        _ => hsv(rng.range(0.5, 0.62), rng.range(0.3, 0.7), rng.range(0.3, 0.7)),
    };
    let pattern = rng.pick(&Pattern::GROUNDS);
    let other = if rng.chance(0.3) { colour(rng) } else { c * rng.range(0.5, 0.9) };
    Texture::of(rng, pattern, rng.log_range(0.2, 3.0), [c, other, c * 0.6])
}

/// A street between facades.
pub(super) fn street(b: &mut Build) {
    daylight(b);
    let half = b.rng.range(3.0, 10.0);
    let (g, asphalt) =
        (b.w.group(), Texture::of(b.rng, Pattern::Speckle, 0.6, [v3(0.12, 0.12, 0.13), v3(0.22, 0.22, 0.22), v3(0.1, 0.1, 0.1)]));
    b.w.add(g, Frame::at(V3::default()), Shape::Plane, asphalt);
    let paint = Texture::plain(b.rng, v3(0.7, 0.7, 0.65));
    for i in 0..14 {
        let at = v3(0.0, -0.003, f64::from(i) * 5.0 - 10.0);
        b.w.card(g, at, RIGHT, AHEAD, (0.08, 1.2), CutoutShape::Full, paint.clone());
    }
    let walk = b.rng.range(1.0, 3.0);
    for side in [-1.0, 1.0] {
        if b.rng.chance(0.12) {
            continue; // an open side
        }
        let (g, t) = (b.w.group(), Texture::new(b.rng, Pattern::Tiles, 0.6));
        b.w.add(g, Frame::at(v3(side * (half + walk * 0.5), -0.06, 40.0)), Shape::Cuboid(v3(walk * 0.5, 0.08, 70.0)), t);
        let mut z = -12.0;
        while z < 90.0 {
            let (long, tall, deep) = (b.rng.range(4.0, 20.0), b.rng.log_range(4.0, 30.0), b.rng.range(-0.5, 1.5));
            if b.rng.chance(0.12) {
                b.tree(v3(side * (half + walk + 4.0), 0.0, z + 3.0), 8.0);
                z += 6.0;
                continue;
            }
            let house = v3(side * (half + walk + 8.0 + deep), 0.0, z + long * 0.5);
            if b.place_model(house, long.max(tall), 0.0) {
                z += long + 4.0;
                continue;
            }
            let pattern =
                b.rng.pick(&[Pattern::Windows, Pattern::Windows, Pattern::Windows, Pattern::Bricks, Pattern::Noise, Pattern::Print]);
            let t = Texture::new(b.rng, pattern, b.rng.range(1.8, 3.8));
            let at = v3(side * (half + walk + 6.0 + deep), -tall * 0.5, z + long * 0.5);
            b.put(t, Frame::at(at), Shape::Cuboid(v3(6.0, tall * 0.5, long * 0.5)));
            if b.rng.chance(0.4) {
                let (g, awning) = (b.w.group(), Texture::new(b.rng, Pattern::Stripes, 0.4));
                let at = v3(side * (half + walk + deep - 0.4), -b.rng.range(2.4, 3.4), z + long * 0.5);
                b.w.add(g, Frame::at(at), Shape::Cuboid(v3(0.6, 0.1, long * 0.35)), awning);
            }
            z += long + if b.rng.chance(0.3) { b.rng.range(0.5, 5.0) } else { 0.0 };
        }
    }
    if b.rng.chance(0.4) {
        // a building at the end of the street
        let (g, t) = (b.w.group(), Texture::new(b.rng, Pattern::Windows, 3.0));
        let tall = b.rng.range(6.0, 20.0);
        b.w.add(g, Frame::at(v3(0.0, -tall * 0.5, b.rng.range(30.0, 80.0))), Shape::Cuboid(v3(20.0, tall * 0.5, 4.0)), t);
    }
    let side = v3(b.rng.range(-0.8, 0.8) * half, -b.rng.range(1.0, 3.0), 0.0);
    let yaw = if b.rng.chance(0.3) { b.rng.range(-75.0, 75.0) } else { b.rng.range(-25.0, 25.0) };
    let pitch = if b.rng.chance(0.2) { b.rng.range(10.0, 35.0) } else { b.rng.range(-15.0, 8.0) };
    look(b, side, yaw, pitch, b.rng.range(-3.0, 3.0));
    for _ in 0..b.rng.int(0, 14) {
        let z = b.rng.log_range(2.5, 40.0);
        let edge = half * b.rng.range(0.6, 1.0) * b.rng.sign();
        match b.rng.int(0, 5) {
            0 | 1 => b.car(v3(edge * 0.8, 0.0, z + 2.0), b.rng.range(-0.1, 0.1)),
            2 | 3 => b.person(v3(edge * b.rng.range(0.2, 1.3), 0.0, z), b.rng.range(1.5, 1.9), b.rng.range(-3.1, 3.1)),
            4 => {
                let (g, t, h) = (b.w.group(), Texture::plain(b.rng, v3(0.08, 0.09, 0.08)), b.rng.range(3.0, 7.0));
                let p = v3(edge.signum() * half, 0.0, z);
                b.w.bar(g, p, p - DOWN * h, (0.05, 0.08), t.clone());
                b.w.bar(g, p - DOWN * h, p - DOWN * h - v3(edge.signum(), 0.0, 0.0), (0.05, 0.05), t);
            }
            _ => b.tree(v3(edge.signum() * (half + 0.5), 0.0, z), b.rng.range(3.0, 8.0)),
        }
    }
}

/// Trees, hills, a wall, buildings or nothing at the end of a field.
fn horizon(b: &mut Build, far: f64) {
    match b.rng.int(0, 4) {
        0 => {}
        1 => {
            for _ in 0..b.rng.int(8, 22) {
                let at = v3(b.rng.range(-1.2, 1.2) * far, 0.0, far * b.rng.range(0.8, 1.3));
                b.tree(at, far * b.rng.range(0.08, 0.25));
            }
        }
        2 => {
            for _ in 0..b.rng.int(2, 7) {
                let (g, t) = (b.w.group(), ground_texture(b.rng));
                let at = v3(b.rng.range(-2.0, 2.0) * far, 0.0, far * b.rng.range(1.2, 3.0));
                b.w.add(g, Frame::at(at), Shape::Ellipsoid(v3(far, far * b.rng.range(0.1, 0.35), far * 0.4)), t);
            }
        }
        3 => {
            let pattern =
                b.rng.pick(&[Pattern::Foliage, Pattern::Foliage, Pattern::Bricks, Pattern::Planks, Pattern::Windows, Pattern::Text]);
            let (g, t) = (b.w.group(), Texture::new(b.rng, pattern, far * b.rng.log_range(0.02, 0.2)));
            let tall = far * b.rng.range(0.06, 0.5);
            let turn: f64 = b.rng.range(-0.5, 0.5);
            b.w.card(g, v3(0.0, -tall, far), v3(turn.cos(), 0.0, turn.sin()), DOWN, (far * 6.0, tall), CutoutShape::Full, t);
        }
        _ => {
            for _ in 0..b.rng.int(1, 8) {
                let (g, t) = (b.w.group(), Texture::new(b.rng, Pattern::Windows, 3.0));
                let half = v3(b.rng.range(3.0, 12.0), b.rng.range(2.0, 12.0), 5.0) * (far / 40.0);
                let at = v3(b.rng.range(-1.2, 1.2) * far, -half.y, far * b.rng.range(0.7, 1.6));
                b.w.add(g, Frame::yaw(at, b.rng.range(-0.6, 0.6)), Shape::Cuboid(half), t);
            }
        }
    }
}

/// Ground with people, animals and objects.
pub(super) fn field(b: &mut Build) {
    daylight(b);
    b.put(ground_texture(b.rng), Frame::at(V3::default()), Shape::Plane);
    let far = b.rng.log_range(8.0, 80.0);
    horizon(b, far);
    let h = b.rng.log_range(0.4, 7.0);
    let pitch = if h > 3.0 { b.rng.range(-35.0, -5.0) } else { b.rng.range(-16.0, 8.0) };
    look(b, v3(0.0, -h, 0.0), 0.0, pitch, b.rng.range(-4.0, 4.0));
    let crowd = b.rng.chance(0.15);
    let herd = b.rng.chance(0.25).then(|| CutoutShape::animal(b.rng));
    let middle = b.rng.log_range(1.6, (0.5 * far).min(12.0));
    for _ in 0..if crowd { b.rng.int(15, 45) } else { b.rng.int(2, 11) } {
        let z = if crowd || b.rng.chance(0.5) { middle * b.rng.log_range(0.6, 2.5) } else { b.rng.log_range(1.3, (far * 0.5).min(14.0)) }
            + h * 0.3;
        let at = v3(b.rng.range(-0.7, 0.7) * z, 0.0, z);
        if let Some(o) = &herd {
            let s = b.rng.range(0.6, 1.6);
            b.cutout(at, s, -AHEAD, o.clone(), 1.3);
            continue;
        }
        match if crowd { 0 } else { b.rng.int(0, 9) } {
            0..=2 => b.person(at, b.rng.range(1.2, 1.9), b.rng.range(-3.1, 3.1)),
            3 | 4 => {
                let (o, s) = (CutoutShape::subject(b.rng), b.rng.log_range(0.4, 2.2));
                // kites and balls fly
                let lift = if b.rng.chance(0.25) { b.rng.range(0.0, 0.4) * z } else { 0.0 };
                b.cutout(at - DOWN * lift, s, -AHEAD, o, 0.8);
            }
            5 => {
                let (g, t, r) = (b.w.group(), Texture::any(b.rng, 0.2), b.rng.log_range(0.1, 0.7));
                b.w.add(g, Frame::at(at - DOWN * r), Shape::Ellipsoid(v3(r, r, r)), t);
            }
            6 => {
                let t = Texture::any(b.rng, 0.4);
                let half = v3(b.rng.log_range(0.15, 1.5), b.rng.log_range(0.02, 0.8), b.rng.log_range(0.15, 1.5));
                b.block(t, at, half, b.rng.range(-3.0, 3.0));
            }
            7 => b.car(at + AHEAD * 2.0, b.rng.range(-3.1, 3.1)),
            8 => b.tree(at, b.rng.log_range(1.5, 7.0)),
            _ => {
                let a: f64 = b.rng.range(-0.8, 0.8);
                let d = v3(a.cos(), 0.0, a.sin()) * b.rng.range(2.0, 8.0);
                b.fence(at - d, at + d, b.rng.range(0.6, 1.4));
            }
        }
    }
}

/// Wires, fences, sticks, rings and branches in front of other objects.
pub(super) fn thin(b: &mut Build) {
    daylight(b);
    let d = b.rng.log_range(1.0, 4.0);
    let far = d * b.rng.range(2.5, 15.0);
    let ground = b.rng.chance(0.5);
    if ground {
        b.put(ground_texture(b.rng), Frame::at(v3(0.0, 1.4, 0.0)), Shape::Plane);
    }
    if b.rng.chance(0.7) {
        let (g, t) = (b.w.group(), Texture::any(b.rng, far * b.rng.log_range(0.05, 0.5)));
        let turn: f64 = b.rng.range(-0.8, 0.8);
        b.w.card(g, v3(0.0, 0.0, far), v3(turn.cos(), 0.0, turn.sin()), DOWN, (far * 4.0, far * 3.0), CutoutShape::Full, t);
    }
    look(b, V3::default(), b.rng.range(-20.0, 20.0), b.rng.range(-12.0, 30.0), b.rng.range(-6.0, 6.0));
    for _ in 0..b.rng.int(0, 4) {
        let z = far * b.rng.range(0.4, 0.85);
        let at = v3(b.rng.range(-0.6, 0.6) * z, if ground { 1.4 } else { b.rng.range(-0.3, 0.6) * z }, z);
        if b.rng.chance(0.5) { b.person(at, z * 0.35, 2.0) } else { b.tree(at, z * 0.5) }
    }
    match b.rng.int(0, 4) {
        0 => {
            let a: f64 = b.rng.range(-0.7, 0.7);
            let along = v3(a.cos(), 0.0, a.sin()) * (d * 4.0);
            let at = v3(0.0, d * b.rng.range(0.2, 0.9), d);
            b.fence(at - along, at + along, d * b.rng.range(0.6, 2.0));
        }
        1 => {
            let (g, t) = (b.w.group(), Texture::plain(b.rng, v3(0.04, 0.04, 0.04)));
            for _ in 0..b.rng.int(1, 8) {
                let z = d * b.rng.range(1.0, 2.0);
                let (y0, y1) = (b.rng.range(-0.8, 0.6) * z, b.rng.range(-0.8, 0.6) * z);
                let r = z * b.rng.log_range(0.002, 0.012);
                b.w.bar(g, v3(-3.0 * z, y0, z), v3(3.0 * z, y1, z * b.rng.range(0.8, 1.6)), (r, r), t.clone());
            }
        }
        2 => {
            let c = hsv(b.rng.range(0.04, 0.1), 0.4, b.rng.range(0.1, 0.5));
            for _ in 0..b.rng.int(1, 3) {
                let bark = Texture::of(b.rng, Pattern::Noise, 0.05, [c, c * 0.5, c]);
                let g = b.w.group();
                let from = v3(b.rng.range(-1.2, 1.2), b.rng.range(-1.0, 1.0), 1.0) * d;
                let along =
                    (v3(-from.x, -from.y, 0.0) + v3(b.rng.range(-0.5, 0.5), b.rng.range(-0.8, 0.2), b.rng.range(-0.3, 0.3)) * d).unit();
                b.twigs(g, from, along * (d * 0.8), d * b.rng.range(0.015, 0.06), 4, &bark);
            }
        }
        _ => {
            for _ in 0..b.rng.int(3, 20) {
                let z = d * b.rng.range(0.8, 2.2);
                let at = v3(b.rng.range(-0.7, 0.7) * z, b.rng.range(-0.6, 0.6) * z, z);
                ring_or_stick(b, at, z * b.rng.range(0.15, 0.6));
            }
        }
    }
}

/// Hills and water under a sky, or a close-up of draped cloth.
pub(super) fn terrain(b: &mut Build) {
    daylight(b);
    let cloth = b.rng.chance(0.25);
    let half = if cloth { b.rng.range(1.0, 3.0) } else { b.rng.log_range(30.0, 200.0) };
    let relief = half * if cloth { b.rng.range(0.05, 0.2) } else { b.rng.log_range(0.05, 0.5) };
    let (seed, coarse) = (b.rng.next() as u32, b.rng.range(1.5, 5.0));
    let ridge = b.rng.chance(0.4);
    let field = Field::new(half, 161, |x, z| {
        let f = fbm(v3(x / half * coarse, 0.0, z / half * coarse), if cloth { 2 } else { 5 }, 0.0, seed);
        let f = if ridge { 1.0 - (2.0 * f - 1.0).abs() } else { f };
        // a valley around the camera
        let calm = if cloth { 1.0 } else { (x.hypot(z + half * 0.9) / half).min(1.0) };
        relief * (f - 0.35) * (0.15 + 0.85 * calm)
    });
    let z0 = -half * if cloth { 0.5 } else { 0.85 };
    let level = field.at(0.0, z0);
    let field = Arc::new(field);
    let (g, mut t) = (b.w.group(), if cloth { Texture::any(b.rng, half * 0.1) } else { ground_texture(b.rng) });
    if !cloth {
        t.scale *= half * 0.03;
    }
    b.w.add(g, Frame::at(V3::default()), Shape::Field(Arc::clone(&field)), t);
    if !cloth && b.rng.chance(0.5) {
        let (g, mut water) = (b.w.group(), Texture::new(b.rng, Pattern::Noise, 1.5));
        water.colours = [v3(0.05, 0.15, 0.25), v3(0.12, 0.28, 0.4), v3(0.3, 0.4, 0.5)];
        water.gloss = 0.7;
        b.w.add(g, Frame::at(v3(0.0, relief * b.rng.range(-0.05, 0.15), 0.0)), Shape::Plane, water);
    }
    let h = if cloth { b.rng.range(0.4, 1.2) + relief } else { b.rng.log_range(1.2, 12.0) };
    let pitch = if cloth { b.rng.range(-60.0, -15.0) } else { b.rng.range(-18.0, 8.0) };
    look(b, v3(0.0, -level - h, z0), b.rng.range(-20.0, 20.0), pitch, b.rng.range(-3.0, 3.0));
    for _ in 0..b.rng.int(0, if cloth { 5 } else { 25 }) {
        let z = if cloth { b.rng.range(0.3, 1.0) * half } else { b.rng.log_range(2.5, half) };
        let x = b.rng.range(-0.6, 0.6) * z;
        let at = v3(x, -field.at(x, z0 + z), z0 + z);
        if cloth {
            b.vessel(at, 2.0);
        } else if b.rng.chance(0.7) {
            b.tree(at, b.rng.range(2.0, 9.0));
        } else {
            b.person(at, 1.7, b.rng.range(-3.0, 3.0));
        }
    }
}
