//! The families of scenes and their frequencies.

use super::math::{Frame, Rng, V3};
use super::objects::Build;
use super::world::World;
use super::{close, furnished, indoor, outdoor, places};
use tmpi_core::Pose;

type Make = fn(&mut Build);

/// Name, frequency and builder. A quarter of all scenes has no vertical depth trend, or a reversed one: most shelves, heaps, drapes,
/// figures and floating objects, and rooms and streets seen upwards.
const FAMILIES: [(&str, f64, Make); 18] = [
    ("room", 0.13, indoor::room),
    ("corridor", 0.03, places::corridor),
    ("lounge", 0.06, places::lounge),
    ("kitchen", 0.04, places::kitchen),
    ("street", 0.08, outdoor::street),
    ("field", 0.10, outdoor::field),
    ("water", 0.04, places::water),
    ("terrain", 0.04, outdoor::terrain),
    ("crowd", 0.04, places::crowd),
    ("thin", 0.06, outdoor::thin),
    ("foliage", 0.05, close::foliage),
    ("shelf", 0.12, indoor::shelf),
    ("heap", 0.07, close::heap),
    ("table", 0.05, indoor::table),
    ("closeup", 0.04, close::closeup),
    ("drape", 0.07, close::drape),
    ("figures", 0.10, indoor::figures),
    ("floating", 0.04, indoor::floating),
];

/// Builds a scene of a random family, with a field of view of 30 to 100 degrees.
pub(super) fn compose(rng: &Rng) -> (&'static str, World) {
    let mut u = rng.unit() * FAMILIES.iter().map(|f| f.1).sum::<f64>();
    let mut chosen = FAMILIES[0];
    for f in FAMILIES {
        chosen = f;
        u -= f.1;
        if u < 0.0 {
            break;
        }
    }
    let mut w = World::new(rng);
    w.fov = rng.range(30.0, 85.0) + if rng.chance(0.15) { 15.0 } else { 0.0 };
    let mut build = Build { w: &mut w, rng };
    let name = if furnished::inside(&mut build) {
        furnished::NAME
    } else {
        chosen.2(&mut build);
        chosen.0
    };
    w.finish();
    (name, w)
}

/// Places the reference camera; angles in degrees as in [`Pose`].
pub(super) fn look(b: &mut Build, at: V3, yaw: f64, pitch: f64, roll: f64) {
    let orientation = Pose { yaw, pitch, roll, ..Pose::default() }.orientation();
    b.w.eye = Frame::turned(at, &orientation);
}
