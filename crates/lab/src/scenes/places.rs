//! Families of places: corridor, lounge, kitchen, water, crowd.

use std::sync::Arc;

use super::families::look;
use super::indoor::indoor_light;
use super::math::{AHEAD, DOWN, Frame, RIGHT, V3, v3};
use super::objects::Build;
use super::outdoor::daylight;
use super::outline::Outline;
use super::shape::{Field, Shape};
use super::texture::{Pattern, Texture, colour};
use super::world::Light;

/// Floor, ceiling and four walls around the origin, with half extents `hx` and `hz` and height `h`. Walls may have large patterns.
fn shell(b: &mut Build, hx: f64, hz: f64, h: f64) {
    let g = b.w.group();
    let (floor, pale) = (Texture::any(b.rng, b.rng.log_range(0.1, 0.8)), v3(0.75, 0.75, 0.72) * b.rng.range(0.3, 1.1));
    let ceiling = Texture::plain(b.rng, pale);
    b.w.card(g, V3::default(), RIGHT, AHEAD, (hx, hz), Outline::Full, floor);
    b.w.card(g, v3(0.0, -h, 0.0), RIGHT, AHEAD, (hx, hz), Outline::Full, ceiling);
    let plain = b.rng.chance(0.6).then(|| colour(b.rng).lerp(pale, b.rng.unit()));
    for (mid, right, half) in
        [(v3(0.0, 0.0, hz), RIGHT, hx), (v3(0.0, 0.0, -hz), -RIGHT, hx), (v3(hx, 0.0, 0.0), -AHEAD, hz), (v3(-hx, 0.0, 0.0), AHEAD, hz)]
    {
        let wall = match plain {
            Some(c) => Texture::plain(b.rng, c),
            None => Texture::any(b.rng, b.rng.log_range(0.2, 3.0)),
        };
        b.w.card(g, mid - DOWN * (h * 0.5), right, DOWN, (half, h * 0.5), Outline::Full, wall);
    }
}

/// A corridor with doors, lamps and objects along its walls.
pub(super) fn corridor(b: &mut Build) {
    let (hx, hz, h) = (b.rng.range(0.6, 2.2), b.rng.range(4.0, 20.0), b.rng.range(2.1, 3.6));
    shell(b, hx, hz, h);
    let z0 = -hz * b.rng.range(0.5, 0.97);
    let (door, frame) = (Texture::any(b.rng, 0.4), Texture::any(b.rng, 0.2));
    let gap = b.rng.range(1.2, 4.0);
    let mut z = z0 + b.rng.range(0.5, 2.0);
    while z < hz {
        for side in [-1.0, 1.0] {
            if b.rng.chance(0.6) {
                let (g, x) = (b.w.group(), side * (hx - 0.02));
                b.w.card(g, v3(x, -1.0, z), AHEAD, DOWN, (0.45, 1.0), Outline::Full, door.clone());
                b.w.card(g, v3(x * 0.995, -1.03, z), AHEAD, DOWN, (0.52, 1.03), Outline::Window(0.1), frame.clone());
            } else if b.rng.chance(0.5) {
                let t = Texture::any(b.rng, 0.3);
                let half = v3(b.rng.range(0.1, 0.4) * hx, b.rng.range(0.2, 1.0), b.rng.range(0.15, 0.6));
                b.block(t, v3(side * (hx - half.x), 0.0, z), half, 0.0);
            }
        }
        let lamp = Texture::of(b.rng, Pattern::Plain, 1.0, [v3(1.0, 0.97, 0.9); 3]).glowing(2.0);
        b.block(lamp, v3(0.0, -h + 0.06, z), v3(0.25 * hx, 0.03, 0.3), 0.0);
        z += gap;
    }
    for _ in 0..b.rng.int(0, 4) {
        let p = v3(b.rng.range(-0.7, 0.7) * hx, 0.0, z0 + b.rng.log_range(1.5, hz));
        if b.rng.chance(0.6) { b.person(p, b.rng.range(1.4, 1.9), b.rng.range(-3.1, 3.1)) } else { b.chair(p, b.rng.range(-3.1, 3.1)) }
    }
    let pitch = if b.rng.chance(0.25) { b.rng.range(10.0, 35.0) } else { b.rng.range(-25.0, 12.0) };
    look(b, v3(b.rng.range(-0.5, 0.5) * hx, -b.rng.range(0.8, 2.0), z0), b.rng.range(-35.0, 35.0), pitch, b.rng.range(-6.0, 6.0));
    for k in 0..3 {
        let at = v3(0.0, -h + 0.3, z0 + hz * (0.2 + 0.5 * f64::from(k)));
        b.w.lights.push(Light::Lamp(at, v3(1.0, 0.95, 0.85) * b.rng.range(0.5, 2.5)));
    }
    b.w.ambient = v3(1.0, 0.97, 0.9) * b.rng.range(0.15, 0.6);
}

/// A small room with low seats along its walls and large bright or dark panels, seen at close range at any yaw.
pub(super) fn lounge(b: &mut Build) {
    let (hx, hz, h) = (b.rng.range(1.3, 3.2), b.rng.range(1.3, 3.2), b.rng.range(2.2, 3.0));
    shell(b, hx, hz, h);
    let seat = Texture::any(b.rng, 0.3);
    for side in 0..4u32 {
        let turn = f64::from(side) * std::f64::consts::FRAC_PI_2;
        let (s, c) = turn.sin_cos();
        let (reach, span) = if side % 2 == 0 { (hz, hx) } else { (hx, hz) };
        // outward and along the wall
        let (out, along) = (v3(s, 0.0, c), v3(c, 0.0, -s));
        if b.rng.chance(0.55) {
            let (deep, n) = (b.rng.range(0.35, 0.55), b.rng.int(1, 4));
            let w = span * b.rng.range(0.5, 0.95) / f64::from(n);
            let low = b.rng.range(0.17, 0.24);
            for i in 0..n {
                let x = (f64::from(i) * 2.0 + 1.0 - f64::from(n)) * w;
                let base = out * (reach - deep) + along * x;
                b.block(seat.clone(), base, v3(w * 0.98, low, deep), turn);
                if b.rng.chance(0.85) {
                    let back = base + out * (deep - 0.12) - DOWN * (2.0 * low);
                    b.block(seat.clone(), back, v3(w * 0.97, b.rng.range(0.15, 0.25), 0.12), turn);
                }
                if b.rng.chance(0.3) {
                    let frame = Frame::yaw(base - DOWN * (2.0 * low + 0.17), turn);
                    b.put(Texture::any(b.rng, 0.1), frame, Shape::Ellipsoid(v3(0.2, 0.18, 0.1)));
                }
            }
        }
        for _ in 0..b.rng.int(0, 2) {
            // a screen, a board, a picture or a door
            let (w, t) = (span * b.rng.range(0.15, 0.75), b.rng.range(0.25, 0.75));
            let tone = if b.rng.chance(0.5) { v3(0.75, 0.73, 0.8) } else { v3(0.05, 0.08, 0.3) };
            let face =
                if b.rng.chance(0.5) { Texture::plain(b.rng, tone).glowing(b.rng.range(0.0, 0.8)) } else { Texture::any(b.rng, 0.6) };
            let at = out * (reach - b.rng.range(0.02, 0.3)) + along * (b.rng.range(-0.4, 0.4) * span) - DOWN * b.rng.range(0.8, 1.6);
            let g = b.w.group();
            b.w.card(g, at, along, DOWN, (w, t), Outline::Full, face);
            let rim = Texture::plain(b.rng, v3(0.3, 0.3, 0.3));
            b.w.card(g, at - out * 0.01, along, DOWN, (w + 0.03, t + 0.03), Outline::Window(0.06), rim);
        }
    }
    let yaw = b.rng.range(-180.0, 180.0);
    let (s, c) = f64::to_radians(yaw).sin_cos();
    let back = b.rng.range(-0.2, 0.8);
    let eye = v3(-s * back * hx, -b.rng.range(0.7, 1.9), -c * back * hz);
    for _ in 0..b.rng.int(1, 6) {
        let far = b.rng.range(0.7, 2.5);
        let a = f64::to_radians(yaw) + b.rng.range(-0.8, 0.8);
        let p = v3((eye.x + a.sin() * far).clamp(-hx * 0.8, hx * 0.8), 0.0, (eye.z + a.cos() * far).clamp(-hz * 0.8, hz * 0.8));
        if (p.x - eye.x).hypot(p.z - eye.z) < 0.6 {
            continue;
        }
        match b.rng.int(0, 4) {
            0 | 1 => b.table(p, b.rng.range(-3.1, 3.1)),
            2 => b.chair(p, b.rng.range(-3.1, 3.1)),
            3 => {
                let t = Texture::any(b.rng, 0.3);
                let half = v3(b.rng.range(0.15, 0.6), b.rng.range(0.1, 0.4), b.rng.range(0.15, 0.5));
                b.block(t, p, half, b.rng.range(-3.1, 3.1));
                b.vessel(p - DOWN * (2.0 * half.y), 1.2);
            }
            _ => b.vessel(p, b.rng.range(2.5, 4.5)),
        }
    }
    let pitch = if b.rng.chance(0.35) { b.rng.range(5.0, 45.0) } else { b.rng.range(-45.0, 8.0) };
    look(b, eye, yaw, pitch, b.rng.range(-12.0, 12.0));
    indoor_light(b, v3(b.rng.range(-0.5, 0.5) * hx, -h + 0.3, b.rng.range(-0.5, 0.5) * hz));
}

/// A kitchen or an office: a nearby table that the frame cuts, seats around it, cupboards along the walls.
pub(super) fn kitchen(b: &mut Build) {
    let (hx, hz, h) = (b.rng.range(1.8, 4.0), b.rng.range(2.0, 4.0), b.rng.range(2.3, 3.0));
    shell(b, hx, hz, h);
    let (front, top) = (Texture::any(b.rng, 0.6), Texture::any(b.rng, 0.4));
    for (at, half) in [
        (v3(0.0, 0.0, hz - 0.3), v3(hx, 0.43, 0.3)),
        (v3(hx - 0.3, 0.0, 0.0), v3(0.3, 0.43, hz)),
        (v3(0.3 - hx, 0.0, 0.0), v3(0.3, 0.43, hz)),
    ] {
        if b.rng.chance(0.35) {
            continue;
        }
        b.block(front.clone(), at, half, 0.0);
        b.block(top.clone(), at - DOWN * 0.86, half.mul(v3(1.02, 0.04, 1.06)), 0.0);
        let along = if half.x > half.z { RIGHT * (hx * 0.9) } else { AHEAD * (hz * 0.9) };
        for _ in 0..b.rng.int(2, 12) {
            let p = at - DOWN * 0.89 + along * b.rng.range(-1.0, 1.0);
            if b.rng.chance(0.6) {
                b.vessel(p, b.rng.range(1.0, 2.2));
            } else {
                let t = Texture::any(b.rng, 0.15);
                let half = v3(b.rng.range(0.05, 0.25), b.rng.range(0.05, 0.25), b.rng.range(0.05, 0.2));
                b.block(t, p, half, b.rng.range(-0.3, 0.3));
            }
        }
        if b.rng.chance(0.6) {
            // a board or cupboards above
            let tall = b.rng.log_range(0.02, 0.35);
            let at = at - DOWN * b.rng.range(1.3, 1.6) + v3(at.x, 0.0, at.z).unit() * 0.1;
            b.block(front.clone(), at, v3(half.x, tall, half.z).mul(v3(0.95, 1.0, 0.95)), 0.0);
        }
    }
    let tall = b.rng.range(0.65, 0.8);
    let place = v3(b.rng.range(-0.3, 0.3) * hx, 0.0, b.rng.range(-0.5, 0.1) * hz);
    let (x, z, yaw) = (b.rng.range(0.4, 1.0), b.rng.range(0.35, 0.7), b.rng.range(-0.8, 0.8));
    let wood = Texture::any(b.rng, 0.3);
    b.block(wood.clone(), place - DOWN * tall, v3(x, 0.02, z), yaw);
    for (i, k) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        let leg = Frame::yaw(place, yaw).point_out(v3(i * (x - 0.06), 0.0, k * (z - 0.06)));
        b.block(wood.clone(), leg, v3(0.035, tall * 0.5, 0.035), yaw);
    }
    for _ in 0..b.rng.int(1, 8) {
        let p = Frame::yaw(place, yaw).point_out(v3(b.rng.range(-0.85, 0.85) * x, -tall - 0.04, b.rng.range(-0.85, 0.85) * z));
        if b.rng.chance(0.5) {
            b.vessel(p, 1.0);
        } else {
            // paper or a magazine
            let t = Texture::new(b.rng, if b.rng.chance(0.5) { Pattern::Text } else { Pattern::Print }, 0.15);
            b.block(t, p, v3(0.105, 0.002, 0.15), b.rng.range(-3.1, 3.1));
        }
    }
    for k in 0..b.rng.int(1, 5) {
        let a = yaw + f64::from(k) * std::f64::consts::FRAC_PI_2 + b.rng.range(-0.4, 0.4);
        let p = place + v3(a.sin(), 0.0, a.cos()) * (x.max(z) + b.rng.range(0.0, 0.4));
        b.chair(p, a + b.rng.range(-0.4, 0.4));
    }
    let away = b.rng.range(0.5, 1.5) + z;
    let eye = v3(place.x + b.rng.range(-0.8, 0.8), -b.rng.range(1.0, 1.8), (place.z - away).max(-hz + 0.1));
    look(b, eye, b.rng.range(-40.0, 40.0), b.rng.range(-48.0, -4.0), b.rng.range(-10.0, 10.0));
    indoor_light(b, v3(b.rng.range(-0.5, 0.5) * hx, -h + 0.3, 0.0));
}

/// Waves or still water up to the horizon, with a shore, boats, swimmers and mist.
pub(super) fn water(b: &mut Build) {
    daylight(b);
    let half = b.rng.log_range(15.0, 120.0);
    let swell = b.rng.log_range(0.02, 1.2);
    let (long, angle): (f64, f64) = (b.rng.range(2.0, 9.0) * swell.sqrt().max(0.4), b.rng.range(-1.2, 1.2));
    let (s, c) = angle.sin_cos();
    let phase = b.rng.range(0.0, 6.0);
    let field = Field::new(half, 201, |x, z| {
        let u = (x * s + z * c) * std::f64::consts::TAU / long;
        let v = (x * c - z * s) * std::f64::consts::TAU / (long * 2.3);
        // crests are narrower than troughs
        swell * ((u + phase + 0.5 * v.sin()).sin() * 0.5 + 0.5).powi(2) * (0.7 + 0.3 * v.cos())
    });
    let deep = colour(b.rng).lerp(v3(0.08, 0.22, 0.3), b.rng.range(0.5, 1.0));
    let foam = v3(0.8, 0.85, 0.85);
    let mut t = Texture::of(b.rng, Pattern::Noise, long * b.rng.range(0.1, 0.6), [deep, deep.lerp(foam, b.rng.range(0.1, 0.9)), foam]);
    t.gloss = b.rng.range(0.1, 0.8);
    let g = b.w.group();
    b.w.add(g, Frame::at(v3(0.0, 0.0, half * 0.9)), Shape::Field(Arc::new(field)), t.clone());
    b.w.add(g, Frame::at(v3(0.0, 0.01, 0.0)), Shape::Plane, t);
    let h = b.rng.log_range(0.6, 8.0) + swell;
    let shore = b.rng.chance(0.5);
    let edge = b.rng.log_range(1.5, 10.0) * h.max(1.0);
    if shore {
        let (g, sand) =
            (b.w.group(), Texture::of(b.rng, Pattern::Speckle, 0.5, [v3(0.6, 0.5, 0.35), v3(0.45, 0.38, 0.28), v3(0.3, 0.3, 0.3)]));
        let (turn, thick) = (b.rng.range(-0.5, 0.5), swell + 0.15);
        b.w.add(g, Frame::yaw(v3(0.0, 0.0, edge - 50.0), turn), Shape::Cuboid(v3(200.0, thick, 50.0)), sand);
    }
    let ground = if shore { -(swell + 0.15) } else { -swell * 0.3 };
    for _ in 0..b.rng.int(1, 7) {
        let z = b.rng.log_range(1.5, 14.0) * h.max(1.0);
        let p = v3(b.rng.range(-0.6, 0.6) * z, ground, z);
        match b.rng.int(0, 4) {
            0 | 1 => b.person(p, b.rng.range(1.4, 1.9), b.rng.range(-3.1, 3.1)),
            2 => {
                let o = if b.rng.chance(0.5) { Outline::animal(b.rng) } else { Outline::subject(b.rng) };
                let lift = if b.rng.chance(0.4) { b.rng.range(0.1, 0.5) * z } else { 0.0 };
                b.cutout(p - DOWN * lift, b.rng.range(0.5, 1.7), -AHEAD, o, 1.1);
            }
            _ => boat(b, v3(p.x, -swell * 0.4, z * 2.0), b.rng.range(1.0, 5.0)),
        }
    }
    if b.rng.chance(0.5) {
        let (g, hill) = (b.w.group(), Texture::new(b.rng, Pattern::Foliage, half * 0.1));
        let at = v3(b.rng.range(-1.0, 1.0) * half, 0.0, half * b.rng.range(1.5, 3.0));
        b.w.add(g, Frame::at(at), Shape::Ellipsoid(v3(half * b.rng.range(0.5, 2.0), half * b.rng.range(0.1, 0.5), half * 0.4)), hill);
    }
    if b.rng.chance(0.35) {
        b.w.fog = Some((b.w.sky.horizon, b.rng.log_range(0.01, 0.08)));
    }
    look(b, v3(0.0, -h - if shore { swell } else { 0.0 }, 0.0), b.rng.range(-15.0, 15.0), b.rng.range(-28.0, 6.0), b.rng.range(-4.0, 4.0));
}

/// A boat with a cabin or a mast and a hull of half length `s` metres.
fn boat(b: &mut Build, at: V3, s: f64) {
    let (g, yaw) = (b.w.group(), b.rng.range(-3.1, 3.1));
    let (f, t) = (Frame::yaw(at, yaw), Texture::any(b.rng, s * 0.5));
    b.w.add(g, Frame { origin: f.point_out(v3(0.0, -0.05 * s, 0.0)), ..f }, Shape::Ellipsoid(v3(s, 0.22 * s, 0.35 * s)), t.clone());
    if b.rng.chance(0.5) {
        b.w.bar(g, at, at - DOWN * (2.2 * s), (0.03 * s, 0.02 * s), t);
        let sail = Texture::plain(b.rng, v3(0.85, 0.83, 0.8));
        b.w.card(g, f.point_out(v3(0.4 * s, -1.2 * s, 0.0)), f.axes[0], DOWN, (0.4 * s, 0.9 * s), Outline::Full, sail);
    } else {
        let half = v3(0.4, 0.2, 0.25) * s;
        b.w.add(g, Frame { origin: f.point_out(v3(0.0, -0.4 * s, 0.0)), ..f }, Shape::Cuboid(half), t);
    }
}

/// Rows of people, on level ground or on stands; the frame cuts the nearest ones.
pub(super) fn crowd(b: &mut Build) {
    let inside = b.rng.chance(0.45);
    let deep = b.rng.range(4.0, 16.0);
    if inside {
        let h = b.rng.range(2.6, 5.0);
        shell(b, deep * 0.9, deep, h);
        indoor_light(b, v3(b.rng.range(-2.0, 2.0), -h + 0.4, deep * 0.3));
    } else {
        daylight(b);
        b.put(Texture::any(b.rng, b.rng.log_range(0.3, 3.0)), Frame::at(V3::default()), Shape::Plane);
    }
    let rise = if b.rng.chance(0.4) { b.rng.range(0.15, 0.6) } else { 0.0 };
    let near = b.rng.range(1.2, 3.0);
    let rows = b.rng.int(2, 5);
    let step = ((deep * 0.9 - near) / f64::from(rows)).max(0.8);
    let (stand, towards) = (Texture::any(b.rng, 0.5), if b.rng.chance(0.5) { std::f64::consts::PI } else { 0.0 });
    for r in 0..rows {
        let z = near + step * f64::from(r);
        let y = -rise * f64::from(r);
        if rise > 0.0 {
            b.block(stand.clone(), v3(0.0, 0.0, z + step * 0.5 - 0.3), v3(deep, (-y * 0.5).max(0.01), step * 0.5), 0.0);
        }
        let gap = b.rng.range(0.6, 1.6);
        let n = ((1.4 * z / gap) as u32).clamp(1, 9);
        for i in 0..n {
            if b.rng.chance(0.3) {
                continue;
            }
            let x = (f64::from(i) + 0.5 - 0.5 * f64::from(n)) * gap + b.rng.range(-0.2, 0.2);
            b.person(v3(x, y, z + b.rng.range(-0.3, 0.3)), b.rng.range(1.2, 1.9), towards + b.rng.range(-0.8, 0.8));
        }
        if inside && b.rng.chance(0.4) {
            b.table(v3(b.rng.range(-1.0, 1.0), 0.0, z + 0.5 * step), 0.0);
        }
    }
    let pitch = b.rng.range(-20.0, 8.0);
    look(b, v3(b.rng.range(-0.6, 0.6), -b.rng.range(1.0, 2.2), 0.0), b.rng.range(-15.0, 15.0), pitch, b.rng.range(-5.0, 5.0));
}
