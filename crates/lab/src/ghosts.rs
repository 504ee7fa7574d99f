//! Measures ghosts: outlines of objects that stay on the background when the view moves, in the object's colour or in any other.
//!
//! A camera that moves sideways uncovers the background beside an object. The pixels next to the object's silhouette in the photo then lie
//! in the open, and their colours are mixed with the object's. The measurement uses only silhouettes in front of a plain background, where
//! such a colour has no other cause.

use std::path::Path;
use std::sync::Arc;

use serde::Serialize;

use crate::LabError;
use tmpi_core::{Camera, Geometry, MATTE_BAND, Photo, Pose, Scene, compose, container, texture};
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::usage::Clock;
use tmpi_pipeline::{Models, Options, Silent, Switch};
use tmpi_render::{Cpu, Renderer};

/// Distance that the camera moves to either side, in units of the nearest distance.
pub const MOVE: f64 = 0.06;
/// Minimum number of pixels of background that the view uncovers beside an object, so that the object itself is out of the way.
const UNCOVERED: f64 = 6.0;
/// Number of pixels beside a silhouette that may have a ghost.
const BAND: usize = 3;
/// Distances from the silhouette, in pixels, at which background and object have their own colours.
const BACKGROUND: std::ops::Range<usize> = 5..11;
const THING: std::ops::Range<usize> = 2..6;
/// Maximum deviation of a plain background's colours, in levels, as the length of the colour difference.
const PLAIN: f64 = 8.0;
/// Minimum distance between the colours of object and background, in levels.
const CONTRAST: f64 = 48.0;
/// A visible ghost has more than this many levels of the object's colour, in at least [`ROWS`] adjacent rows.
const SEEN: f64 = 16.0;
const ROWS: usize = 3;

/// Number and strength of ghosts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Ghosts {
    /// Silhouettes in front of a plain background, counted once per row.
    pub places: usize,
    /// Silhouettes with a visible ghost.
    pub seen: usize,
    /// Levels of the object's colour on the background, at the worst pixel of each silhouette; the sum over all silhouettes.
    pub residue: f64,
    /// Silhouettes with a visible outline of any colour, for example the bright rim that sharpening leaves: there, the view shows a colour
    /// more than `SEEN` levels from the background's mean, in at least `ROWS` adjacent rows.
    pub outlines: usize,
}

impl Ghosts {
    pub fn add(&mut self, other: Self) {
        self.places += other.places;
        self.seen += other.seen;
        self.residue += other.residue;
        self.outlines += other.outlines;
    }

    /// Share of silhouettes with a visible ghost, 0 to 1.
    pub fn share(&self) -> f64 {
        self.seen as f64 / self.places.max(1) as f64
    }

    /// Share of silhouettes with a visible outline of any colour, 0 to 1.
    pub fn outline_share(&self) -> f64 {
        self.outlines as f64 / self.places.max(1) as f64
    }

    /// Mean residue per silhouette, in levels.
    pub fn mean(&self) -> f64 {
        self.residue / self.places.max(1) as f64
    }
}

/// A photo, the δ of each of its pixels, and the focal length.
pub struct Subject<'a> {
    pub photo: &'a Photo,
    /// δ of each pixel, row-major.
    pub delta: &'a [f32],
    /// Horizontal focal length in pixels.
    pub focal: f64,
}

/// A silhouette in a row, and what a view shows beside it, in levels at the worst pixel.
#[derive(Clone, Copy)]
struct Silhouette {
    /// Column of the first background pixel.
    column: usize,
    /// The object's colour on the background.
    residue: f64,
    /// Difference from the background's colour.
    outline: f64,
}

impl Subject<'_> {
    /// Measures ghosts in a view of the photo's size, whose camera moved sideways by `tx`, in units of the nearest distance.
    pub fn ghosts(&self, view: &[[u8; 3]], tx: f64) -> Ghosts {
        let width = self.photo.width as usize;
        let rows: Vec<Vec<Silhouette>> =
            (0..self.photo.height as usize).map(|y| (0..width).filter_map(|x| self.silhouette(view, tx, (x, y))).collect()).collect();
        let mut out = Ghosts::default();
        for (y, row) in rows.iter().enumerate() {
            for silhouette in row {
                out.places += 1;
                out.residue += silhouette.residue;
                let is_seen = |levels: fn(&Silhouette) -> f64| {
                    let above = chain(rows[..y].iter().rev(), silhouette.column, levels);
                    let below = chain(rows[y + 1..].iter(), silhouette.column, levels);
                    levels(silhouette) > SEEN && above + 1 + below >= ROWS
                };
                out.seen += usize::from(is_seen(|s| s.residue));
                out.outlines += usize::from(is_seen(|s| s.outline));
            }
        }
        out
    }

    /// The silhouette of an object before the background that starts at pixel `(x, y)`. `None` if there is none in front of a plain
    /// background, or if the view does not show that background in the open.
    fn silhouette(&self, view: &[[u8; 3]], tx: f64, (x, y): (usize, usize)) -> Option<Silhouette> {
        let width = self.photo.width as usize;
        let row = y * width..(y + 1) * width;
        let (delta, rgb, view) = (&self.delta[row.clone()], &self.photo.rgb[row.clone()], &view[row]);
        // if the camera moves right, the scene moves left and uncovers what is right of an object
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
        let mut found = Silhouette { column: x, residue: 0.0, outline: 0.0 };
        for by in 0..BAND {
            let at = away(by).filter(|&x| delta[x] < middle)?;
            let place = |x: usize| x as f64 + 0.5 - f64::from(delta[x]) * self.focal * tx;
            let to = place(at);
            // something else covers this position, or nearly does
            if (0..width).any(|u| delta[u] > middle && (place(u) - to).abs() < 2.5) {
                return None;
            }
            let shown = sample(view, to - 0.5)?;
            let off: [f64; 3] = std::array::from_fn(|c| shown[c] - background.mean[c]);
            let dot: f64 = off.iter().zip(along).map(|(off, along)| off * along).sum();
            found.residue = found.residue.max(dot / apart);
            found.outline = found.outline.max(off.iter().map(|v| v * v).sum::<f64>().sqrt());
        }
        Some(found)
    }
}

/// Number of consecutive rows with visible levels near a column, at most [`ROWS`].
fn chain<'a>(rows: impl Iterator<Item = &'a Vec<Silhouette>>, mut column: usize, levels: fn(&Silhouette) -> f64) -> usize {
    let mut count = 0;
    for row in rows.take(ROWS) {
        let Some(next) = row.iter().find(|p| p.column.abs_diff(column) <= 2 && levels(p) > SEEN) else { break };
        column = next.column;
        count += 1;
    }
    count
}

/// Colour between two pixels of a row, by linear interpolation; `None` outside the row.
fn sample(row: &[[u8; 3]], at: f64) -> Option<[f64; 3]> {
    let first = at.floor();
    if first < 0.0 || first + 1.0 >= row.len() as f64 {
        return None;
    }
    let (first, share) = (first as usize, at - first);
    Some(std::array::from_fn(|c| f64::from(row[first][c]) * (1.0 - share) + f64::from(row[first + 1][c]) * share))
}

/// Mean of some colours, and their root mean square distance from it.
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

/// Widths of the band of mattes that are compared, in pixels; 0 is without matting: all mixed colours are on the far side.
pub const BANDS: [usize; 5] = [0, 1, MATTE_BAND, 3, 4];

/// Ghosts of a photo, and time that its layers take, with one width of the band.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct OfBand {
    #[serde(flatten)]
    pub ghosts: Ghosts,
    /// Time to make layers with colours, in ms: the shortest of three.
    pub ms: f64,
}

/// The scene of a container with another width of the band of mattes, and the time that its layers take, in ms.
pub fn with_band(bytes: &[u8], band: usize) -> Result<(Scene, f64), container::ContainerError> {
    let (photo, geometry) = container::read(bytes)?;
    let geometry = Geometry { matte_band: band, ..geometry };
    let clock = Clock::start();
    let tiles = texture(&photo, &geometry, geometry.masks());
    let ms = clock.ms();
    Ok((compose(photo, &geometry, tiles), ms))
}

/// Ghosts of a photo.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct OfPhoto {
    /// For each of [`BANDS`].
    pub bands: [OfBand; BANDS.len()],
    /// With [`MATTE_BAND`], but without widening what the depth network draws too small.
    pub not_widened: Ghosts,
}

/// Makes the named photo and measures ghosts at [`MOVE`] to both sides.
pub fn of_photo(models: &Models, name: &str, file: &[u8]) -> Result<OfPhoto, LabError> {
    let made = |snap: Switch| {
        let mut options = Options { snap, photo_depth: Switch::Off, ..Options::default() };
        options.view_box.x = MOVE;
        tmpi_pipeline::make(models, &Limits::default(), file, None, &options, &Silent)
            .map_err(|source| LabError::Make { subject: name.into(), source })
    };
    // `On` snaps without widening
    let snapped = made(Switch::On)?.container;
    let not_widened = of_scene(&Arc::new(container::decode(&snapped)?), container::read_geometry(&snapped)?.surface().all())?;
    let made = made(Switch::Auto)?;
    let surface = container::read_geometry(&made.container)?.surface();
    let mut found = [OfBand { ms: f64::INFINITY, ..OfBand::default() }; BANDS.len()];
    for round in 0..3 {
        for (found, band) in found.iter_mut().zip(BANDS) {
            let (scene, ms) = with_band(&made.container, band)?;
            found.ms = found.ms.min(ms);
            if round == 0 {
                found.ghosts = of_scene(&Arc::new(scene), surface.all())?;
            }
        }
    }
    Ok(OfPhoto { bands: found, not_widened })
}

/// Ghosts at [`MOVE`] to both sides.
fn of_scene(scene: &Arc<Scene>, delta: &[f32]) -> Result<Ghosts, LabError> {
    let (width, height) = (scene.photo.width, scene.photo.height);
    let subject = Subject { photo: &scene.photo, delta, focal: scene.intrinsics.fx };
    let (cpu, mut all) = (Cpu::default(), Ghosts::default());
    for tx in [MOVE, -MOVE] {
        let view = cpu.render(scene, &Camera { pose: Pose::at(tx, 0.0, 0.0), intrinsics: scene.intrinsics, width, height })?;
        all.add(subject.ghosts(&view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect::<Vec<_>>(), tx));
    }
    Ok(all)
}

/// Reads a list of photos to measure: paths below the data folder, one per line. Skips blank lines and lines that start with `#`.
pub fn listed(text: &str) -> impl Iterator<Item = &Path> {
    text.lines().map(str::trim).filter(|l| !l.is_empty() && !l.starts_with('#')).map(Path::new)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: u32 = 120;
    const WALL: [u8; 3] = [200, 190, 180];
    const THING: [u8; 3] = [30, 60, 90];

    /// A dark square at δ 0.75 before a light wall at δ 0.25, and the view from the right: it moves by 12 pixels, the wall by 4. The wall
    /// has a rim of `rim` pixels, brighter by `by` levels.
    fn view(rim: usize, by: i8) -> (Photo, Vec<f32>, Vec<[u8; 3]>) {
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
                WALL.map(|c| c.saturating_add_signed(by))
            } else {
                WALL
            }
        });
        let seen = seen.collect();
        (Photo { width: SIDE, height: SIDE, rgb }, delta, seen)
    }

    fn found(rim: usize, by: i8) -> Ghosts {
        let (photo, delta, seen) = view(rim, by);
        Subject { photo: &photo, delta: &delta, focal: 160.0 }.ghosts(&seen, 0.1)
    }

    #[test]
    fn a_planted_ghost_is_seen_and_none_is_seen_without() {
        let clean = found(0, 0);
        assert!(clean.places == 60 && clean.seen == 0 && clean.outlines == 0 && clean.mean() < 1.0, "{clean:?}");
        let ghost = found(1, -40);
        assert!(ghost.seen == 60 && ghost.outlines == 60 && ghost.mean() > 40.0, "{ghost:?}");
    }

    #[test]
    fn a_rim_unlike_the_object_is_an_outline_but_no_ghost() {
        let rim = found(1, 40);
        assert!(rim.seen == 0 && rim.outlines == 60 && rim.mean() < 1.0, "{rim:?}");
    }

    /// The residue is the distance between both colours times the thing's share of the rim, on either side.
    #[test]
    fn the_residue_is_the_things_share_of_the_colour() {
        let apart = WALL.iter().zip(THING).map(|(w, t)| (f64::from(*w) - f64::from(t)).powi(2)).sum::<f64>().sqrt();
        for (share, left) in [0.0, 0.05, 0.1, 0.5, 1.0].into_iter().flat_map(|share| [(share, false), (share, true)]) {
            let (mut photo, mut delta, mut seen) = view(0, 0);
            let rim: [u8; 3] = std::array::from_fn(|c| (f64::from(WALL[c]) * (1.0 - share) + f64::from(THING[c]) * share).round() as u8);
            (30..90).for_each(|y| seen[y * SIDE as usize + 76] = rim);
            if left {
                let side = SIDE as usize;
                photo.rgb.chunks_exact_mut(side).for_each(<[_]>::reverse);
                delta.chunks_exact_mut(side).for_each(<[_]>::reverse);
                seen.chunks_exact_mut(side).for_each(<[_]>::reverse);
            }
            let found = Subject { photo: &photo, delta: &delta, focal: 160.0 }.ghosts(&seen, if left { -0.1 } else { 0.1 });
            assert!((found.mean() - share * apart).abs() < 1.0, "{share} {left}: {found:?}");
            assert_eq!((found.places, found.seen), (60, if share * apart > SEEN { 60 } else { 0 }), "{share} {left}");
        }
    }

    #[test]
    fn nothing_is_found_without_depth_or_room() {
        let (photo, _, seen) = view(1, -40);
        for delta in [f32::NAN, f32::INFINITY, 0.5] {
            let delta = vec![delta; seen.len()];
            assert_eq!(Subject { photo: &photo, delta: &delta, focal: 160.0 }.ghosts(&seen, 0.1), Ghosts::default());
        }
        let one = Photo { width: 1, height: 1, rgb: vec![WALL] };
        assert_eq!(Subject { photo: &one, delta: &[0.5], focal: f64::INFINITY }.ghosts(&[WALL], 0.1), Ghosts::default());
        assert!(Ghosts::default().share().abs() < 1e-12 && Ghosts::default().mean().abs() < 1e-12);
    }

    #[test]
    fn spots_that_are_no_outline_are_not_seen() {
        let (photo, delta, mut seen) = view(0, 0);
        for y in (30..90).step_by(4) {
            seen[y * SIDE as usize + 77] = THING;
        }
        let found = Subject { photo: &photo, delta: &delta, focal: 160.0 }.ghosts(&seen, 0.1);
        assert!(found.seen == 0 && found.outlines == 0 && found.mean() > 10.0, "{found:?}");
    }
}
