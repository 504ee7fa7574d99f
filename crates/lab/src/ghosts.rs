//! Ghosts: outlines of things that stay on the background when the view moves.
//!
//! Where a camera that moves sideways uncovers the background beside a thing, the background's pixels next to the thing's silhouette in the
//! photo come into the open. Their colours are mixed with the thing's. Looked at before plain backgrounds alone, where nothing else can be
//! meant by such a colour.

use std::path::Path;
use std::sync::Arc;

use serde::Serialize;
use tmpi_core::{Camera, Geometry, Photo, Pose, Scene, compose, container, texture};
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::{MakeError, Models, Options, Silent};
use tmpi_render::{Cpu, RenderError, Renderer};

/// The camera moves by so much to either side, in units of the nearest distance.
pub const MOVE: f64 = 0.06;
/// The background beside a thing is uncovered over at least so many pixels, so that the thing itself is out of the way.
const UNCOVERED: f64 = 6.0;
/// Pixels beside a silhouette that may have a ghost.
const BAND: usize = 3;
/// Pixels from the silhouette between which background and thing have their own colours.
const BACKGROUND: std::ops::Range<usize> = 5..11;
const THING: std::ops::Range<usize> = 2..6;
/// The background is plain where its colours deviate by so many levels at most, as the length of their difference.
const PLAIN: f64 = 8.0;
/// Thing and background are at least so many levels apart.
const CONTRAST: f64 = 48.0;
/// A ghost has at least so many levels of the thing's colour, in so many rows one below the other.
const SEEN: f64 = 16.0;
const ROWS: usize = 3;

/// What was found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Ghosts {
    /// Silhouettes before plain background, counted once a row.
    pub places: usize,
    /// Those with a ghost that can be seen.
    pub seen: usize,
    /// Levels of the thing's colour on the background, of the worst pixel of each place, summed over all.
    pub residue: f64,
}

impl Ghosts {
    /// Adds what was found elsewhere.
    pub fn add(&mut self, other: Self) {
        self.places += other.places;
        self.seen += other.seen;
        self.residue += other.residue;
    }

    /// Share of the places with a ghost that can be seen, 0 to 1.
    #[must_use]
    pub fn share(&self) -> f64 {
        self.seen as f64 / self.places.max(1) as f64
    }

    /// Mean residue in levels.
    #[must_use]
    pub fn mean(&self) -> f64 {
        self.residue / self.places.max(1) as f64
    }
}

/// A photo, δ of what each of its pixels shows, and the focal length in pixels.
pub struct Subject<'a> {
    /// The photo.
    pub photo: &'a Photo,
    /// δ of each pixel, row by row.
    pub delta: &'a [f32],
    /// Horizontal focal length in pixels.
    pub focal: f64,
}

/// A silhouette in a row: the column of its first background pixel, and levels of residue.
#[derive(Clone, Copy)]
struct Place {
    column: usize,
    residue: f64,
}

impl Subject<'_> {
    /// Looks for ghosts in a view of the photo's size, whose camera moved by `tx` to the side.
    #[must_use]
    pub fn ghosts(&self, view: &[[u8; 3]], tx: f64) -> Ghosts {
        let width = self.photo.width as usize;
        let rows: Vec<Vec<Place>> = (0..self.photo.height as usize)
            .map(|y| (0..width).filter_map(|x| Some(Place { column: x, residue: self.residue(view, tx, (x, y))? })).collect())
            .collect();
        let mut out = Ghosts::default();
        for (y, row) in rows.iter().enumerate() {
            for place in row {
                out.places += 1;
                out.residue += place.residue;
                let above = chain(rows[..y].iter().rev(), place.column);
                let below = chain(rows[y + 1..].iter(), place.column);
                out.seen += usize::from(place.residue > SEEN && above + 1 + below >= ROWS);
            }
        }
        out
    }

    /// Levels of a thing's colour on the background whose first pixel is `(x, y)`; none where that is no silhouette before plain background which
    /// the view has in the open.
    fn residue(&self, view: &[[u8; 3]], tx: f64, (x, y): (usize, usize)) -> Option<f64> {
        let width = self.photo.width as usize;
        let row = y * width..(y + 1) * width;
        let (delta, rgb, view) = (&self.delta[row.clone()], &self.photo.rgb[row.clone()], &view[row]);
        // the camera goes right: the scene goes left, and what is right of a thing is uncovered
        let away = |by: usize| if tx > 0.0 { x.checked_add(by) } else { x.checked_sub(by) }.filter(|&x| x < width);
        let back = |by: usize| if tx > 0.0 { x.checked_sub(by) } else { x.checked_add(by) }.filter(|&x| x < width);
        let moved = |d: f32| f64::from(d) * self.focal * tx.abs();
        let (near, far) = (delta[back(1)?], delta[x]);
        if moved(near) - moved(far) < UNCOVERED {
            return None;
        }
        let middle = f32::midpoint(near, far);
        let colours = |places: std::ops::Range<usize>, at: &dyn Fn(usize) -> Option<usize>, is: &dyn Fn(f32) -> bool| {
            let places: Option<Vec<usize>> = places.map(|by| at(by).filter(|&x| is(delta[x]))).collect();
            places.map(|p| Spread::of(&p.into_iter().map(|x| rgb[x].map(f64::from)).collect::<Vec<_>>()))
        };
        let background = colours(BACKGROUND, &away, &|d| d < middle)?;
        let thing = colours(THING, &back, &|d| d >= middle)?;
        let along: [f64; 3] = std::array::from_fn(|c| thing.mean[c] - background.mean[c]);
        let apart = along.iter().map(|v| v * v).sum::<f64>().sqrt();
        if background.deviation > PLAIN || apart < CONTRAST {
            return None;
        }
        let mut most = 0.0_f64;
        for by in 0..BAND {
            let at = away(by).filter(|&x| delta[x] < middle)?;
            let place = |x: usize| x as f64 + 0.5 - f64::from(delta[x]) * self.focal * tx;
            let to = place(at);
            // something else is in the way, or almost
            if (0..width).any(|u| delta[u] > middle && (place(u) - to).abs() < 2.5) {
                return None;
            }
            let shown = sample(view, to - 0.5)?;
            let dot: f64 = (0..3).map(|c| (shown[c] - background.mean[c]) * along[c]).sum();
            most = most.max(dot / apart);
        }
        Some(most)
    }
}

/// Rows one after the other that have a ghost near a column, [`ROWS`] at most.
fn chain<'a>(rows: impl Iterator<Item = &'a Vec<Place>>, mut column: usize) -> usize {
    let mut count = 0;
    for row in rows.take(ROWS) {
        let Some(next) = row.iter().find(|p| p.column.abs_diff(column) <= 2 && p.residue > SEEN) else { break };
        column = next.column;
        count += 1;
    }
    count
}

/// Colour between two pixels of a row.
fn sample(row: &[[u8; 3]], at: f64) -> Option<[f64; 3]> {
    let first = at.floor();
    if first < 0.0 || first + 1.0 >= row.len() as f64 {
        return None;
    }
    let (first, share) = (first as usize, at - first);
    Some(std::array::from_fn(|c| f64::from(row[first][c]) * (1.0 - share) + f64::from(row[first + 1][c]) * share))
}

/// Mean of some colours, and how far they are off it.
struct Spread {
    mean: [f64; 3],
    deviation: f64,
}

impl Spread {
    fn of(colours: &[[f64; 3]]) -> Self {
        let n = colours.len() as f64;
        let mean: [f64; 3] = std::array::from_fn(|c| colours.iter().map(|p| p[c]).sum::<f64>() / n);
        let square: f64 = colours.iter().map(|p| (0..3).map(|c| (p[c] - mean[c]).powi(2)).sum::<f64>()).sum();
        Self { mean, deviation: (square / n).sqrt() }
    }
}

/// Why ghosts could not be looked for.
#[derive(Debug, thiserror::Error)]
pub enum GhostError {
    /// A photo cannot be made.
    #[error(transparent)]
    Make(#[from] MakeError),
    /// Its container cannot be read.
    #[error(transparent)]
    Container(#[from] container::ContainerError),
    /// A view cannot be drawn.
    #[error(transparent)]
    Render(#[from] RenderError),
}

/// Ghosts of a photo without matting, and as it is made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Pair {
    /// With all mixed colours on the far side.
    pub unmatted: Ghosts,
    /// As it is made.
    pub made: Ghosts,
}

/// The scene of a container as it would be without matting.
///
/// # Errors
/// [`container::ContainerError`].
pub fn unmatted(bytes: &[u8]) -> Result<Scene, container::ContainerError> {
    let (photo, geometry) = container::read(bytes)?;
    let geometry = Geometry { matted: false, ..geometry };
    let tiles = texture(&photo, &geometry, geometry.masks());
    Ok(compose(photo, &geometry, tiles))
}

/// Makes a photo and looks for ghosts at [`MOVE`] to both sides.
///
/// # Errors
/// [`GhostError`].
pub fn of_photo(models: &Models, file: &[u8]) -> Result<Pair, GhostError> {
    let mut options = Options::default();
    options.view_box.x = MOVE;
    let made = tmpi_pipeline::make(models, &Limits::default(), file, None, &options, &Silent)?;
    let geometry = container::read_geometry(&made.container)?;
    let surface = geometry.surface();
    let scenes = [Arc::new(unmatted(&made.container)?), Arc::new(container::decode(&made.container)?)];
    let found = scenes.map(|scene| -> Result<Ghosts, GhostError> {
        let (width, height) = (scene.photo.width, scene.photo.height);
        let subject = Subject { photo: &scene.photo, delta: surface.all(), focal: scene.intrinsics.fx };
        let (cpu, mut all) = (Cpu::default(), Ghosts::default());
        for tx in [MOVE, -MOVE] {
            let view = cpu.render(&scene, &Camera { pose: Pose::at(tx, 0.0, 0.0), intrinsics: scene.intrinsics, width, height })?;
            all.add(subject.ghosts(&view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect::<Vec<_>>(), tx));
        }
        Ok(all)
    });
    let [without, with] = found;
    Ok(Pair { unmatted: without?, made: with? })
}

/// Names of the photos that ghosts are looked for in, below the folder of data.
pub fn listed(text: &str) -> impl Iterator<Item = &Path> {
    text.lines().map(str::trim).filter(|l| !l.is_empty() && !l.starts_with('#')).map(Path::new)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: u32 = 120;
    const WALL: [u8; 3] = [200, 190, 180];
    const THING: [u8; 3] = [30, 60, 90];

    /// A dark square at δ 0.75 before a light wall at δ 0.25, and the view from the right: it moves by 12 pixels, the wall by 4.
    fn view(rim: usize) -> (Photo, Vec<f32>, Vec<[u8; 3]>) {
        let near = |x: u32, y: u32| (40..80).contains(&x) && (30..90).contains(&y);
        let at = |i: u32| (i % SIDE, i / SIDE);
        let all = SIDE * SIDE;
        let rgb = (0..all).map(|i| if near(at(i).0, at(i).1) { THING } else { WALL }).collect();
        let delta = (0..all).map(|i| if near(at(i).0, at(i).1) { 0.75 } else { 0.25 }).collect();
        let seen = (0..all).map(|i| {
            let (x, y) = at(i);
            let ghost = (76..76 + rim as u32).contains(&x) && (30..90).contains(&y);
            if near(x + 12, y) {
                THING
            } else if ghost {
                WALL.map(|c| c - 40)
            } else {
                WALL
            }
        });
        let seen = seen.collect();
        (Photo { width: SIDE, height: SIDE, rgb }, delta, seen)
    }

    fn found(rim: usize) -> Ghosts {
        let (photo, delta, seen) = view(rim);
        Subject { photo: &photo, delta: &delta, focal: 160.0 }.ghosts(&seen, 0.1)
    }

    #[test]
    fn a_planted_ghost_is_seen_and_none_is_seen_without() {
        let clean = found(0);
        assert!(clean.places == 60 && clean.seen == 0 && clean.mean() < 1.0, "{clean:?}");
        let ghost = found(1);
        assert!(ghost.seen == 60 && ghost.mean() > 40.0, "{ghost:?}");
    }

    #[test]
    fn spots_that_are_no_outline_are_not_seen() {
        let (photo, delta, mut seen) = view(0);
        for y in (30..90).step_by(4) {
            seen[y * SIDE as usize + 77] = THING;
        }
        let found = Subject { photo: &photo, delta: &delta, focal: 160.0 }.ghosts(&seen, 0.1);
        assert!(found.seen == 0 && found.mean() > 10.0, "{found:?}");
    }
}
