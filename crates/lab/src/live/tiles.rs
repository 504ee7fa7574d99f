//! Counts tiles, their bytes, and how well the edges of an object are met.

use tmpi_core::live::schema;
use tmpi_core::{DisparityMap, Geometry, Photo};
use tmpi_live::Update;

use super::sequence::BEHIND;
use crate::bench::Figures;

/// Pixels on both sides of the object's edge in which its shown edge may be.
const EDGE: isize = 14;

/// Counts the tiles of a frame; `truth` is the true previous frame and the true current one.
pub(super) fn count(f: &mut Figures, g: &Geometry, update: &Update, truth: Option<(&Photo, &Photo)>) {
    let percent = |tiles: usize| 100.0 * tiles as f64 / g.tiles.len().max(1) as f64;
    f.add("tiles not sent, %", percent(g.tiles.len() - update.sent.len()));
    f.add("new planes within tolerance, %", percent(update.kept.len()));
    f.most("their largest error, px", update.kept_error);
    f.add("tiles late: waiting, %", percent(update.waiting));
    f.add("tiles late: coarse, %", percent(update.coarse));
    if let Some((w, h)) = update.depth_size {
        f.add("depth network, pixels", f64::from(w) * f64::from(h));
    }
    let Some((before, now)) = truth else { return };
    for t in (0..g.grid.tiles()).filter(|&t| same(before, now, g.grid.rect(t))) {
        let percent = |is: bool| if is { 100.0 } else { 0.0 };
        f.add("unchanged tiles: detected, %", percent(!update.changed.contains(&t)));
        f.add("unchanged tiles: not sent, %", percent(!update.sent.contains(&t)));
    }
}

/// Counts the pixels that `g` shows on the wrong side of the object's left and right edges, in each row that crosses the object: inside,
/// shown as background, and outside, shown as object. `truth` and `plate` are the disparity with and without the object. The levels on
/// both sides come from the shown surface, so only the position of the edge counts.
pub(super) fn edges(f: &mut Figures, g: &Geometry, (truth, plate): (&DisparityMap, &DisparityMap)) {
    let (surface, width) = (g.surface(), truth.width as usize);
    let (mut count, mut short, mut beyond) = (0.0, 0.0, 0.0);
    for ((shown, truth), plate) in surface.all().chunks(width).zip(truth.delta.chunks(width)).zip(plate.delta.chunks(width)) {
        let is_object = |x: &usize| truth[*x] - plate[*x] > BEHIND;
        let (Some(first), Some(last)) = ((0..width).find(is_object), (0..width).rev().find(is_object)) else { continue };
        for (edge, step) in [(first as isize, 1), (last as isize, -1)] {
            let at = |steps: isize| usize::try_from(edge + step * steps).ok().filter(|x| *x < width).map(|x| shown[x]);
            let Some((inside, outside)) = at(EDGE - 1).zip(at(-EDGE)).filter(|(i, o)| i - o > BEHIND) else { continue };
            let middle = f32::midpoint(inside, outside);
            let share =
                |steps: std::ops::Range<isize>, wrong: &dyn Fn(f32) -> bool| steps.filter_map(at).filter(|d| wrong(*d)).count() as f64;
            count += 1.0;
            short += share(0..EDGE, &|d| d < middle);
            beyond += share(-EDGE..0, &|d| d > middle);
        }
    }
    if count > 0.0 {
        f.add("edge short, px", short / count);
        f.add("edge beyond, px", beyond / count);
    }
}

/// Adds the bytes and chunks of a geometry message; `encoded` is its length.
pub(super) fn bytes(f: &mut Figures, message: &schema::Geometry, encoded: f64) {
    let sum = |of: fn(&schema::Chunk) -> usize| message.chunks.iter().map(of).sum::<usize>() as f64;
    f.add("geometry, bytes", if message.chunks.is_empty() { 0.0 } else { encoded });
    f.add("planes, bytes", sum(|c| c.plane_data.len()));
    f.add("labels, bytes", sum(|c| c.label_data.len()));
    if !message.chunks.is_empty() {
        f.add("chunks in frames with any", message.chunks.len() as f64);
    }
}

/// Whether two pictures are equal in a rectangle.
fn same(a: &Photo, b: &Photo, r: tmpi_core::Rect) -> bool {
    (r.y..r.y + r.h).all(|y| {
        let row = y as usize * a.width as usize + r.x as usize;
        a.rgb[row..row + r.w as usize] == b.rgb[row..row + r.w as usize]
    })
}
