//! Families of close-range and indoor scenes: room, shelf, table, figures, floating objects.

use super::cutout::CutoutShape;
use super::families::look;
use super::math::{AHEAD, DOWN, Frame, RIGHT, V3, v3};
use super::objects::Build;
use super::shape::Shape;
use super::texture::{Pattern, Texture, colour};
use super::world::Light;

/// A room, seen from a random position inside at any yaw.
pub(super) fn room(b: &mut Build) {
    let (hx, hz) = (b.rng.log_range(1.5, 6.0), b.rng.log_range(1.5, 6.0));
    let h = b.rng.log_range(2.2, 3.4) * if b.rng.chance(0.1) { 2.0 } else { 1.0 };
    let g = b.w.group();
    let wall_colour = colour(b.rng).lerp(v3(0.7, 0.68, 0.62), b.rng.range(0.3, 1.0));
    let wall_pattern = b.rng.pick(&[Pattern::Plain, Pattern::Plain, Pattern::Noise, Pattern::Stripes, Pattern::Bricks, Pattern::Tiles]);
    let walls = Texture::of(b.rng, wall_pattern, 0.35, [wall_colour, wall_colour * 0.85, wall_colour * 0.6]);
    let floor_pattern = b.rng.pick(&[Pattern::Planks, Pattern::Planks, Pattern::Tiles, Pattern::Speckle, Pattern::Checks, Pattern::Plain]);
    let floor = Texture::new(b.rng, floor_pattern, b.rng.range(0.12, 0.6));
    let pale = v3(0.75, 0.75, 0.72) * b.rng.range(0.6, 1.1);
    let ceiling_pattern = b.rng.pick(&[Pattern::Plain, Pattern::Plain, Pattern::Tiles, Pattern::Planks]);
    let ceiling = Texture::of(b.rng, ceiling_pattern, 0.6, [pale, pale * 0.7, pale * 0.5]);
    b.w.card(g, v3(0.0, 0.0, 0.0), RIGHT, AHEAD, (hx, hz), CutoutShape::Full, floor);
    b.w.card(g, v3(0.0, -h, 0.0), RIGHT, AHEAD, (hx, hz), CutoutShape::Full, ceiling);
    let sides =
        [(v3(0.0, 0.0, hz), RIGHT, hx), (v3(0.0, 0.0, -hz), -RIGHT, hx), (v3(hx, 0.0, 0.0), -AHEAD, hz), (v3(-hx, 0.0, 0.0), AHEAD, hz)];
    for (middle, right, half) in sides {
        let middle = middle - DOWN * (h * 0.5);
        b.w.card(g, middle, right, DOWN, (half, h * 0.5), CutoutShape::Full, walls.clone());
        let outward = middle.mul(v3(1.0, 0.0, 1.0)).unit();
        for _ in 0..b.rng.int(0, 4) {
            decorate(b, middle, right, outward, half, h);
        }
    }
    let mut eye = v3(b.rng.range(-0.8, 0.8) * hx, -b.rng.range(0.5, 2.1).min(h - 0.2), b.rng.range(-0.8, 0.8) * hz);
    let yaw = b.rng.range(-180.0, 180.0);
    if b.rng.chance(0.7) {
        // photographers step back
        let (s, c) = yaw.to_radians().sin_cos();
        (eye.x, eye.z) = (eye.x * 0.4 - s * 0.55 * hx, eye.z * 0.4 - c * 0.55 * hz);
    }
    let pitch = match b.rng.int(0, 9) {
        0 | 1 => b.rng.range(8.0, 40.0),
        2..=4 => b.rng.range(-50.0, -15.0),
        _ => b.rng.range(-15.0, 8.0),
    };
    look(b, eye, yaw, pitch, b.rng.range(-4.0, 4.0));
    for _ in 0..b.rng.int(5, 18) {
        let along = if b.rng.chance(0.7) { b.rng.range(-0.7, 0.7) + yaw.to_radians() } else { b.rng.range(-3.1, 3.1) };
        let far = b.rng.log_range(1.1, 7.0);
        let p = v3(eye.x + along.sin() * far, 0.0, eye.z + along.cos() * far);
        let p = v3(p.x.clamp(-hx * 0.88, hx * 0.88), 0.0, p.z.clamp(-hz * 0.88, hz * 0.88));
        if v3(p.x - eye.x, 0.0, p.z - eye.z).norm() < 0.75 {
            continue;
        }
        furnish(b, p, h, hx, hz);
    }
    let lamp = v3(b.rng.range(-0.6, 0.6) * hx, -h + b.rng.range(0.1, 0.6), b.rng.range(-0.6, 0.6) * hz);
    let warm = v3(1.0, b.rng.range(0.75, 1.0), b.rng.range(0.5, 1.0));
    b.w.lights.push(Light::Lamp(lamp + v3(0.0, 0.25, 0.0), warm * b.rng.range(0.8, 3.0) * (hx * hz).sqrt()));
    let bulb = Texture::of(b.rng, Pattern::Plain, 1.0, [v3(1.0, 0.95, 0.8); 3]).glowing(2.0);
    let g = b.w.group();
    b.w.add(g, Frame::at(lamp), Shape::Ellipsoid(v3(0.15, 0.1, 0.15)), bulb);
    let wire = Texture::plain(b.rng, v3(0.05, 0.05, 0.05));
    b.w.bar(g, lamp, v3(lamp.x, -h, lamp.z), (0.01, 0.01), wire);
    b.w.ambient = warm * b.rng.range(0.15, 0.6);
}

/// A picture, a window, a door or a cupboard on a wall; `outward` points out of the room.
fn decorate(b: &mut Build, middle: V3, right: V3, outward: V3, half: f64, h: f64) {
    let x = b.rng.range(-0.8, 0.8) * half;
    let g = b.w.group();
    let at = |y: f64, off: f64| middle.mul(v3(1.0, 0.0, 1.0)) + right * x - DOWN * y - outward * off;
    match b.rng.int(0, 5) {
        0..=2 => {
            let (w, t) = (b.rng.log_range(0.15, 0.7), b.rng.log_range(0.15, 0.6));
            let scale = b.rng.log_range(0.15, 1.2);
            let pattern = b.rng.pick(&[Pattern::Print, Pattern::Print, Pattern::Marble, Pattern::Noise, Pattern::Gradient, Pattern::Text]);
            let picture = Texture::new(b.rng, pattern, scale);
            let y = b.rng.range(1.1, 1.9);
            b.w.card(g, at(y, 0.02), right, DOWN, (w, t), CutoutShape::Full, picture);
            let rim = Texture::any(b.rng, 0.2);
            b.w.card(g, at(y, 0.03), right, DOWN, (w + 0.04, t + 0.04), CutoutShape::Window(0.08), rim);
        }
        3 => {
            let sky = Texture::of(b.rng, Pattern::Noise, b.rng.range(0.5, 2.0), [v3(0.8, 0.9, 1.0), v3(0.5, 0.7, 0.6), v3(0.3, 0.4, 0.3)])
                .glowing(b.rng.range(0.4, 2.5));
            let (w, t) = (b.rng.range(0.3, 0.9), b.rng.range(0.4, 0.7));
            b.w.card(g, at(1.5, 0.01), right, DOWN, (w, t), CutoutShape::Full, sky);
            let rim = Texture::any(b.rng, 0.2);
            b.w.card(g, at(1.5, 0.04), right, DOWN, (w + 0.06, t + 0.06), CutoutShape::Window(0.12), rim.clone());
            b.w.card(g, at(1.5, 0.04), right, DOWN, (0.02, t), CutoutShape::Full, rim);
            if b.rng.chance(0.5) {
                let cloth = Texture::any(b.rng, 0.15);
                for side in [-1.0, 1.0] {
                    for i in 0..5 {
                        let p = at(1.5, 0.1) + right * (side * (w + 0.05 + 0.06 * f64::from(i)));
                        let cloth = cloth.clone();
                        b.w.bar(g, p - DOWN * (t + 0.2), p + DOWN * (t + 0.4).min(1.4), (0.05, 0.05), cloth);
                    }
                }
            }
        }
        // a door
        4 => b.w.card(g, at(1.0, 0.02), right, DOWN, (0.42, 1.0), CutoutShape::Full, Texture::any(b.rng, 0.5)),
        _ => {
            let t = Texture::any(b.rng, 0.4);
            let half = v3(b.rng.range(0.2, 0.9), b.rng.range(0.2, 0.5), b.rng.range(0.08, 0.2));
            let frame = Frame { origin: at(b.rng.range(0.4, h - 0.6), half.z), axes: [right, DOWN, right.cross(DOWN)] };
            b.w.add(g, frame, Shape::Cuboid(half), t);
        }
    }
}

fn furnish(b: &mut Build, p: V3, h: f64, hx: f64, hz: f64) {
    let yaw = if b.rng.chance(0.5) { f64::from(b.rng.int(0, 3)) * std::f64::consts::FRAC_PI_2 } else { b.rng.range(-3.1, 3.1) };
    match b.rng.int(0, 13) {
        0 | 1 => b.table(p, yaw),
        2 | 3 => b.chair(p, yaw),
        4 => b.sofa(p, yaw),
        5 => {
            let (w, t, n) = (b.rng.range(0.3, 0.8), b.rng.range(0.8, h * 0.85), b.rng.int(2, 5));
            b.shelf(p, yaw, w, t, n);
        }
        6 => b.person(p, b.rng.range(1.4, 1.9), yaw),
        7 => {
            let t = Texture::any(b.rng, 0.4);
            let half = v3(b.rng.range(0.2, 0.8), b.rng.log_range(0.1, 1.0), b.rng.range(0.15, 0.5));
            b.block(t, p, half, yaw);
            b.vessel(p - DOWN * (2.0 * half.y), 1.5);
        }
        // a bed or a low bench with a blanket's edge
        8 => b.block(Texture::any(b.rng, 0.5), p, v3(0.8, 0.28, 1.0), yaw),
        9 => {
            let (g, t) = (b.w.group(), Texture::any(b.rng, 0.3));
            let q = v3(p.x.clamp(-hx + 1.0, hx - 1.0), -0.004, p.z.clamp(-hz + 1.0, hz - 1.0));
            b.w.card(g, q, RIGHT, AHEAD, (0.9, 0.9), if b.rng.chance(0.5) { CutoutShape::Disc } else { CutoutShape::Full }, t);
        }
        10 => {
            let (g, t) = (b.w.group(), Texture::plain(b.rng, v3(0.2, 0.2, 0.2)));
            let top = p - DOWN * b.rng.range(1.2, 1.8);
            b.w.bar(g, p, top, (0.015, 0.015), t);
            let shade = Texture::of(b.rng, Pattern::Plain, 1.0, [v3(1.0, 0.9, 0.7); 3]).glowing(0.8);
            b.w.add(g, Frame::at(top), Shape::Cylinder(0.12, 0.12, 0.2), shade);
        }
        11 => {
            let r = b.rng.range(0.1, 0.4);
            b.put(Texture::any(b.rng, 0.2), Frame::at(p - DOWN * r), Shape::Ellipsoid(v3(r, r, r)));
        }
        12 => b.vessel(p, b.rng.range(2.0, 4.0)),
        _ => {
            // hangs from the ceiling
            let (g, t) = (b.w.group(), Texture::any(b.rng, 0.1));
            let low = v3(p.x, -b.rng.range(1.5, h - 0.2), p.z);
            b.w.bar(g, low, v3(p.x, -h, p.z), (0.008, 0.008), t.clone());
            let r = b.rng.range(0.1, 0.3);
            b.w.add(g, Frame::at(low), Shape::Ellipsoid(v3(r, r * 0.8, r)), t);
        }
    }
}

/// Close-up of a shelf or a wall with objects and strong patterns.
pub(super) fn shelf(b: &mut Build) {
    let d = b.rng.range(0.5, 2.0);
    let (g, wide) = (b.w.group(), d * 4.0);
    let pattern = if b.rng.chance(0.6) {
        b.rng.pick(&Pattern::STRONG)
    } else {
        b.rng.pick(&[Pattern::Noise, Pattern::Bricks, Pattern::Planks, Pattern::Plain])
    };
    let wall = Texture::new(b.rng, pattern, b.rng.log_range(0.04, 0.4));
    b.w.card(g, v3(0.0, 0.0, d), RIGHT, DOWN, (wide, wide), CutoutShape::Full, wall);
    let (yaw, pitch) = (b.rng.range(-35.0, 35.0), b.rng.range(-25.0, 25.0));
    let roll = if b.rng.chance(0.15) { b.rng.range(-90.0, 90.0) } else { b.rng.range(-6.0, 6.0) };
    look(b, v3(b.rng.range(-0.3, 0.3), 0.0, 0.0), yaw * 0.6, pitch * 0.6, roll);
    let rows = b.rng.int(1, 4);
    if b.rng.chance(0.55) {
        // a board or a floor below the objects
        let y = b.rng.range(0.25, 0.55) * d;
        b.put(Texture::any(b.rng, 0.15 * d), Frame::at(v3(0.0, y, 0.0)), Shape::Plane);
        for _ in 0..b.rng.int(4, 16) {
            let z = d * b.rng.range(0.4, 0.95);
            let at = v3(b.rng.range(-0.7, 0.7) * z, y, z);
            let s = d * b.rng.range(0.7, 2.2);
            if b.rng.chance(0.7) { b.vessel(at, s) } else { b.cutout(at, 0.25 * s, -AHEAD, CutoutShape::subject(b.rng), 0.8) }
        }
    }
    if b.rng.chance(0.5) {
        let height = d * b.rng.range(0.8, 1.6);
        b.shelf(v3(0.0, height * b.rng.range(0.3, 0.7), d), 0.0, d * b.rng.range(0.5, 1.2), height, rows);
    }
    for r in 0..rows {
        let y = (f64::from(r) + 0.5 - f64::from(rows) * 0.5) * d * 0.45 + b.rng.range(-0.1, 0.1);
        for _ in 0..b.rng.int(2, 8) {
            let deep = d * b.rng.range(0.45, 0.95);
            let at = v3(b.rng.range(-0.8, 0.8) * d, y + 0.2 * d, deep);
            match b.rng.int(0, 4) {
                0 | 1 => b.vessel(at, d * b.rng.range(0.6, 1.8)),
                2 => ring_or_stick(b, at, d * 0.3),
                3 => {
                    let t = Texture::new(b.rng, b.rng.pick(&Pattern::STRONG), 0.06 * d);
                    let half = v3(b.rng.range(0.03, 0.25), b.rng.range(0.03, 0.25), b.rng.range(0.01, 0.1)) * d;
                    let m = b.rng.rotation();
                    let f = if b.rng.chance(0.3) { Frame::turned(at, &m) } else { Frame::yaw(at, b.rng.range(-0.8, 0.8)) };
                    b.put(t, f, Shape::Cuboid(half));
                }
                _ => b.cutout(at, d * b.rng.range(0.1, 0.35), -AHEAD, CutoutShape::subject(b.rng), 0.8),
            }
        }
    }
    indoor_light(b, v3(b.rng.range(-1.5, 1.5), -1.5, -0.5) * d);
}

pub(super) fn ring_or_stick(b: &mut Build, at: V3, s: f64) {
    let (g, t) = (b.w.group(), Texture::any(b.rng, s * 0.3));
    let m = b.rng.rotation();
    if b.rng.chance(0.5) {
        b.w.add(g, Frame::turned(at, &m), Shape::Torus(s * b.rng.range(0.3, 0.8), s * b.rng.log_range(0.015, 0.15)), t);
    } else {
        let along = Frame::turned(at, &m).axes[1] * s * b.rng.range(0.5, 2.0);
        let r = s * b.rng.log_range(0.01, 0.08);
        b.w.bar(g, at - along, at + along, (r, r * b.rng.range(0.4, 1.0)), t);
    }
}

pub(super) fn indoor_light(b: &mut Build, at: V3) {
    let warm = v3(1.0, b.rng.range(0.8, 1.0), b.rng.range(0.6, 1.05));
    b.w.lights.push(Light::Lamp(at, warm * at.dot(at).max(0.1) * b.rng.range(0.5, 1.5)));
    b.w.ambient = warm * b.rng.range(0.25, 0.8);
}

/// A laid table, usually seen steeply from above.
pub(super) fn table(b: &mut Build) {
    let h = b.rng.log_range(0.3, 1.2);
    let pattern = b.rng.pick(&Pattern::TABLETOPS);
    let top = Texture::new(b.rng, pattern, b.rng.log_range(0.03, 0.3));
    let (x, z) = (b.rng.range(0.4, 1.6), b.rng.range(0.3, 1.2));
    b.put(top, Frame::yaw(v3(0.0, 0.03, 0.0), b.rng.range(-3.1, 3.1)), Shape::Cuboid(v3(x, 0.03, z)));
    b.put(Texture::any(b.rng, 0.3), Frame::at(v3(0.0, 0.78, 0.0)), Shape::Plane);
    let pitch = if b.rng.chance(0.45) { b.rng.range(-35.0, -12.0) } else { b.rng.range(-90.0, -30.0) };
    let back = h * (90.0 + pitch).to_radians().tan().min(1.6);
    look(b, v3(0.0, -h, -back), b.rng.range(-12.0, 12.0), pitch, b.rng.range(-15.0, 15.0));
    for _ in 0..b.rng.int(5, 20) {
        let at = v3((b.rng.range(-1.0, 1.0) * h).clamp(-x, x), 0.0, (b.rng.range(-0.7, 0.9) * h).clamp(-z, z));
        let s = b.rng.range(0.7, 1.5) * h.clamp(0.4, 1.0) / 0.6;
        match b.rng.int(0, 7) {
            0..=4 => b.vessel(at, s),
            5 => {
                let t = Texture::any(b.rng, 0.1);
                let half = v3(b.rng.range(0.05, 0.2), b.rng.range(0.002, 0.02), b.rng.range(0.05, 0.15)) * s;
                b.block(t, at, half, b.rng.range(-3.0, 3.0));
            }
            6 => {
                // cutlery or a pen
                let (g, t) = (b.w.group(), Texture::plain(b.rng, v3(0.6, 0.6, 0.62)));
                let a = b.rng.range(-3.1, 3.1);
                let l = v3(a.sin(), 0.0, a.cos()) * (0.1 * s);
                let m = at - DOWN * 0.006;
                b.w.bar(g, m - l, m + l, (0.006, 0.004), t);
            }
            _ => {
                // an arm that reaches in from the frame
                let (g, t) = (b.w.group(), Texture::plain(b.rng, colour(b.rng)));
                let a = b.rng.range(-3.1, 3.1);
                let out = v3(a.sin(), -0.25, a.cos() - 0.4).unit();
                let hand = at - DOWN * 0.06;
                b.w.bar(g, hand, hand + out * 0.6, (0.03, 0.05), t.clone());
                b.w.add(g, Frame::at(hand), Shape::Ellipsoid(v3(0.05, 0.035, 0.06)), t);
            }
        }
    }
    if b.rng.chance(0.4) {
        for _ in 0..b.rng.int(1, 3) {
            let p = v3(b.rng.range(-1.5, 1.5), 0.78, z + b.rng.range(0.3, 1.5));
            if b.rng.chance(0.5) { b.person(p, 1.7, b.rng.range(-3.0, 3.0)) } else { b.chair(p, 0.3) }
        }
    }
    indoor_light(b, v3(b.rng.range(-2.0, 2.0), -2.0, b.rng.range(-1.0, 2.0)));
}

/// One to four subjects in front of a background, floating or cut by the frame.
pub(super) fn figures(b: &mut Build) {
    look(b, V3::default(), b.rng.range(-10.0, 10.0), b.rng.range(-14.0, 14.0), b.rng.range(-6.0, 6.0));
    let far = b.rng.log_range(2.5, 30.0);
    let (g, wide) = (b.w.group(), far * 3.0);
    let pattern = b.rng.pick(&Pattern::BACKDROPS);
    let back = Texture::new(b.rng, pattern, far * b.rng.log_range(0.05, 1.0));
    // at least as wide as the view at that distance
    let back = b.rng.backdrop().map_or(back, |picture| {
        let view = 2.0 * far * (b.w.fov.to_radians() * 0.5).tan();
        Texture::picture(b.rng, picture, view * b.rng.range(1.0, 1.6))
    });
    let turn: f64 = b.rng.range(-0.7, 0.7);
    if b.rng.chance(0.8) {
        b.w.card(g, v3(0.0, 0.0, far), v3(turn.cos(), 0.0, turn.sin()), DOWN, (wide, wide), CutoutShape::Full, back);
    }
    let ground = b.rng.chance(0.35);
    if ground {
        b.put(Texture::any(b.rng, 0.5), Frame::at(v3(0.0, b.rng.range(1.0, 1.8), 0.0)), Shape::Plane);
    }
    for _ in 0..b.rng.int(0, 7) {
        let z = far * b.rng.range(0.45, 0.9);
        let at = v3(b.rng.range(-0.8, 0.8) * z, b.rng.range(-0.5, 0.6) * z, z);
        let (s, o) = (z * b.rng.log_range(0.08, 0.4), CutoutShape::subject(b.rng));
        b.cutout(at, s, -AHEAD, o, 0.8);
    }
    let near = far * b.rng.range(0.12, 0.4);
    for _ in 0..b.rng.int(1, 4) {
        let z = near * b.rng.range(0.8, 1.6);
        let size = z * b.rng.log_range(0.25, 1.6);
        let x = b.rng.range(-0.6, 0.6) * z;
        let y = if ground { 1.0 } else { b.rng.range(-0.2, 0.8) * z };
        match b.rng.int(0, 5) {
            0 | 1 => b.person(v3(x, y.max(size * 0.4), z), size * 1.4, std::f64::consts::PI + b.rng.range(-0.9, 0.9)),
            2 => b.cutout(v3(x, y.max(size * 0.5), z), size, -AHEAD, CutoutShape::portrait(b.rng), 0.9),
            3 => b.cutout(v3(x, y, z), size, -AHEAD, CutoutShape::subject(b.rng), 0.7),
            4 => body(b, v3(x, y - size * 0.3, z), size * 0.35),
            _ => b.cutout(v3(x, y, z), size * 0.8, -AHEAD, CutoutShape::animal(b.rng), 1.3),
        }
    }
    if b.rng.chance(0.5) {
        b.w.lights
            .push(Light::Sun(v3(b.rng.range(-1.0, 1.0), -1.0, -b.rng.range(0.1, 1.0)).unit(), v3(1.0, 0.95, 0.85) * b.rng.range(0.5, 1.4)));
    } else {
        indoor_light(b, v3(b.rng.range(-1.0, 1.0), -1.0, -0.3) * near * 2.0);
    }
    b.w.ambient = v3(1.0, 1.0, 1.0) * b.rng.range(0.3, 0.8);
}

/// A lump of a few ellipsoids: an animal, a toy, a fruit.
pub(super) fn body(b: &mut Build, at: V3, s: f64) {
    let (g, t) = (b.w.group(), Texture::any(b.rng, s * b.rng.log_range(0.1, 0.8)));
    for _ in 0..b.rng.int(2, 6) {
        let off = v3(b.rng.range(-0.7, 0.7), b.rng.range(-0.7, 0.7), b.rng.range(-0.3, 0.3)) * s;
        let r = v3(b.rng.range(0.25, 0.8), b.rng.range(0.25, 0.8), b.rng.range(0.2, 0.5)) * s;
        b.w.add(g, Frame::turned(at + off, &b.rng.rotation()), Shape::Ellipsoid(r), t.clone());
    }
}

/// Floating primitives in front of a slanted background.
pub(super) fn floating(b: &mut Build) {
    look(b, V3::default(), 0.0, 0.0, 0.0);
    let far = b.rng.log_range(2.0, 10.0);
    let m = tmpi_core::Pose { yaw: b.rng.range(-60.0, 60.0), pitch: b.rng.range(-60.0, 60.0), ..Default::default() }.orientation();
    let back = Shape::Card(far * 6.0, far * 6.0, CutoutShape::Full);
    b.put(Texture::any(b.rng, far * 0.3), Frame::turned(v3(0.0, 0.0, far), &m), back);
    for _ in 0..b.rng.int(4, 20) {
        let z = far * b.rng.range(0.25, 0.8);
        let at = v3(b.rng.range(-0.9, 0.9) * z, b.rng.range(-0.8, 0.8) * z, z);
        let s = far * b.rng.log_range(0.03, 0.25);
        let (g, t, m) = (b.w.group(), Texture::any(b.rng, s * 0.5), b.rng.rotation());
        let f = Frame::turned(at, &m);
        let v = v3(b.rng.range(0.2, 1.0), b.rng.range(0.2, 1.0), b.rng.range(0.1, 0.6)) * s;
        match b.rng.int(0, 5) {
            0 => b.w.add(g, f, Shape::Cuboid(v), t),
            1 => b.w.add(g, f, Shape::Ellipsoid(v), t),
            2 => b.w.add(g, f, Shape::Cylinder(v.x, v.y * 0.4, v.z), t),
            3 => b.w.add(g, f, Shape::Card(s, s, CutoutShape::subject(b.rng)), t),
            _ => ring_or_stick(b, at, s),
        }
    }
    indoor_light(b, v3(b.rng.range(-2.0, 2.0), b.rng.range(-2.0, 1.0), -1.0));
}
