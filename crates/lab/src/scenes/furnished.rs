//! Scenes inside a furnished model: a house, a shop, a hall.

use super::families::look;
use super::math::{AHEAD, DOWN, Frame, RIGHT, V3, v3};
use super::objects::Build;
use super::shape::Shape;
use super::texture::Texture;
use super::world::Light;

pub(super) const NAME: &str = "inside";
/// Fraction of scenes, if there are furnished models.
const SHARE: f64 = 0.12;
/// Minimum distance from the camera to the nearest surface, in metres.
const CLEARANCE: f64 = 0.5;

/// Sometimes builds such a scene; returns whether it did.
pub(super) fn inside(b: &mut Build) -> bool {
    let Some(model) = b.rng.assets.models.furnished(b.rng, SHARE) else { return false };
    let [wide, tall, deep] = model.size();
    for part in model.parts.iter() {
        let (g, surface) = (b.w.group(), Texture::plain(b.rng, v3(1.0, 1.0, 1.0)).glossy(0.05));
        b.w.add(g, Frame::at(V3::default()), Shape::Mesh(part.clone(), 1.0), surface);
    }
    let place = |b: &Build, low: f64, high: f64| {
        let within = |size: f64| b.rng.range(-0.4, 0.4) * size;
        v3(within(wide), -b.rng.range(low, high), within(deep))
    };
    let stuck = |at: V3, d: V3| model.parts.iter().any(|p| p.hit(at, d, 0.0, CLEARANCE).is_some());
    let is_free = |at: V3| [RIGHT, DOWN, AHEAD].iter().all(|d| !stuck(at, *d) && !stuck(at, -*d));
    // if no position is free, the picture shows it, and the scene is rejected
    let eye = (0..32).map(|_| place(b, 0.9, 2.0)).find(|at| is_free(*at)).unwrap_or(v3(0.0, -1.5, 0.0));
    for _ in 0..b.rng.int(2, 4) {
        let lamp = eye + v3(b.rng.range(-4.0, 4.0), -b.rng.range(0.3, 1.2).min((tall - 2.0).max(0.3)), b.rng.range(-4.0, 4.0));
        let warm = v3(1.0, b.rng.range(0.85, 1.0), b.rng.range(0.7, 1.0));
        b.w.lights.push(Light::Lamp(lamp, warm * b.rng.range(1.0, 4.0)));
    }
    b.w.ambient = v3(0.5, 0.5, 0.5) * b.rng.range(0.6, 1.4);
    let (yaw, pitch) = (b.rng.range(-180.0, 180.0), b.rng.range(-20.0, 8.0));
    look(b, eye, yaw, pitch, b.rng.range(-4.0, 4.0));
    true
}
