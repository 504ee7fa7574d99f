//! `tmpi-lab tears`: counts the pictures of a room in which a fast object is torn, seen from the side. Tiles are late by a fixed number of
//! frames, so that results repeat.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use tmpi_core::live::schema::Geometry as Tiles;
use tmpi_core::live::{FrameTiming, Layers, TileState};
use tmpi_core::{Camera, Geometry, Photo, Pose};
use tmpi_live::{COOLDOWN, Frame, FramePipeline, Settings as Room, video};
use tmpi_pipeline::{Models, Options};
use tmpi_render::{Cpu, Renderer};

use super::encode::H264;
use crate::LabError;

/// Frames of a film, in which the box swings ten times, each time in another phase.
pub const FRAMES: u32 = 593;
/// Frames of one swing.
const PERIOD: f64 = 59.3;
/// The camera's offset to either side, in units of the nearest distance.
const SIDE: f64 = 0.05;
/// Fraction of torn rows from which a picture is torn.
const TORN: f64 = 0.04;
/// Frames before the first picture: meanwhile the first tiles arrive.
const START: u32 = 30;

/// How a room and its viewer keep up with the camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Case {
    pub size: (u32, u32),
    /// Milliseconds that the geometry of a frame should take; 0: no limit.
    pub budget_ms: f64,
    /// The server makes tiles of every Nth frame.
    pub tiles: u32,
    /// Frames by which tiles arrive late.
    pub late: u32,
    /// The viewer shows every Nth frame.
    pub shown: u32,
}

/// Pictures of a case, and those of them that are torn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Count {
    pub pictures: u32,
    pub torn: u32,
}

impl Count {
    /// Percent of the pictures that are torn.
    pub fn percent(self) -> f64 {
        100.0 * f64::from(self.torn) / f64::from(self.pictures.max(1))
    }
}

/// What is the same for all cases.
pub struct Settings {
    pub models: Models,
    pub frames: u32,
    /// Frames for which labels follow motion.
    pub follow: u32,
    /// Whether the viewer remembers frames that it does not show.
    pub remember: bool,
}

/// Counts torn pictures, from both sides of each shown frame. Calls `picture` with the frame, its side, the picture and the fraction of torn
/// rows.
///
/// # Errors
/// If the frame size is not supported, or a stage fails.
pub fn count(settings: &Settings, case: &Case, picture: &mut dyn FnMut(u32, bool, &Photo, f64)) -> Result<Count, LabError> {
    let mut encoder = H264::new(case.size, H264::usual_bitrate(case.size))?;
    let mut decoder = video::decoder(H264::CODEC, case.size)?;
    let options = Options { max_error: tmpi_live::MAX_ERROR, view_box: Options::VIEW_BOX, ..Options::default() };
    let room = Room { options, parallax: tmpi_live::PARALLAX, cooldown: COOLDOWN, frame_ms: case.budget_ms };
    let mut pipeline = FramePipeline::new(settings.models.clone(), room);
    let mut viewer = Viewer::new(settings);
    let mut count = Count::default();
    for n in 0..settings.frames {
        let Some(photo) = decoder.decode(&encoder.encode(&frame(n, case.size))?.0)? else { continue };
        let mut sent = Tiles { frame: n.into(), chunks: Vec::new() };
        if n % case.tiles == 0 {
            sent.chunks = pipeline.next(&Frame { number: n.into(), at: at(n), photo: photo.clone(), depth: None })?.chunks;
        }
        if let (None, Some(g)) = (&viewer.tiles, pipeline.geometry()) {
            viewer.tiles = Some(TileState::new(&TileState::hello(g))?);
        }
        viewer.receive(sent, case.late)?;
        if !viewer.take(n, &photo, n % case.shown == 0) || n < START {
            continue;
        }
        for left in [true, false] {
            let Some(view) = viewer.view(if left { -SIDE } else { SIDE })? else { continue };
            let rows = torn_rows(&view);
            count.pictures += 1;
            count.torn += u32::from(rows > TORN);
            picture(n, left, &view, rows);
        }
    }
    Ok(count)
}

fn at(n: u32) -> Duration {
    Duration::from_secs_f64(f64::from(n) / 30.0)
}

/// A viewer of a room.
struct Viewer {
    tiles: Option<TileState>,
    layers: Layers,
    renderer: Cpu,
    remember: bool,
    /// Sent tiles that have not arrived yet.
    in_flight: VecDeque<Tiles>,
    /// Tiles that arrived since the last shown frame, and the newest frame of them.
    came: Vec<u32>,
    of_frame: Option<u64>,
    /// The last shown frame.
    shown: u32,
}

impl Viewer {
    fn new(settings: &Settings) -> Self {
        let layers = Layers::with_memory().with_motion_frames(settings.follow);
        let remember = settings.remember;
        let (in_flight, came) = (VecDeque::new(), Vec::new());
        Self { tiles: None, layers, renderer: Cpu::default(), remember, in_flight, came, of_frame: None, shown: 0 }
    }

    /// Queues sent tiles, and takes those sent `late` frames ago.
    fn receive(&mut self, sent: Tiles, late: u32) -> Result<(), LabError> {
        self.in_flight.push_back(sent);
        let due = if self.in_flight.len() > late as usize { self.in_flight.pop_front() } else { None };
        let Some((due, tiles)) = due.filter(|due| !due.chunks.is_empty()).zip(self.tiles.as_mut()) else { return Ok(()) };
        self.came.extend(tiles.take(&due)?);
        self.of_frame = Some(due.frame);
        Ok(())
    }

    /// Takes a frame, to be shown or not; returns whether it is shown.
    fn take(&mut self, n: u32, photo: &Photo, shown: bool) -> bool {
        let Some(geometry) = self.tiles.as_ref().and_then(TileState::geometry) else { return false };
        let elapsed = at(n).saturating_sub(at(self.shown));
        if !shown {
            if self.remember {
                self.layers.skip(photo, n.into(), elapsed);
            }
            return false;
        }
        self.shown = n;
        let when = FrameTiming { frame: n.into(), tiles: self.of_frame.take(), elapsed: Some(elapsed) };
        let came = std::mem::take(&mut self.came);
        self.layers.update(geometry, |t| came.contains(&t), photo.clone(), when);
        true
    }

    /// The shown frame from the side.
    fn view(&self, tx: f64) -> Result<Option<Photo>, LabError> {
        let Some(received) = self.tiles.as_ref().and_then(TileState::geometry) else { return Ok(None) };
        let geometry: &Geometry = self.layers.moved_geometry().unwrap_or(received);
        let (width, height) = (geometry.grid.width, geometry.grid.height);
        let camera = Camera { pose: Pose { tx, ..Pose::default() }, intrinsics: geometry.intrinsics, width, height };
        let view = self.renderer.render(&Arc::new(self.layers.scene(geometry)), &camera)?;
        Ok(Some(Photo { width, height, rgb: view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect() }))
    }
}

/// Frame `n` of the film: a box in front of a wall, both textured as in the film of the browser's test (`tests/browser/support/video.mjs`).
fn frame(n: u32, (width, height): (u32, u32)) -> Photo {
    let scale = f64::from(width) / 320.0;
    let left = ((110.0 + 40.0 * (std::f64::consts::TAU * f64::from(n) / PERIOD).sin()) * scale).round() / scale;
    Photo::from_fn(width, height, |x, y| {
        let (x, y) = (f64::from(x) / scale, f64::from(y) / scale);
        let inside = (70.0..230.0).contains(&y) && (left..left + 100.0).contains(&x);
        let (luma, u, v) = if inside {
            (150.0 + 50.0 * ((x - left) / 4.0).sin() * ((y - 70.0) / 6.0).cos(), 100.0, 165.0)
        } else {
            (90.0 + 40.0 * (x / 11.0).sin() + 20.0 * (y / 9.0).cos(), 140.0 + 10.0 * (x / 40.0).sin(), 118.0)
        };
        // BT.709, limited range
        let (luma, u, v) = ((luma - 16.0) / 219.0, (u - 128.0) / 224.0, (v - 128.0) / 224.0);
        [luma + 1.5748 * v, luma - 0.187_32 * u - 0.468_12 * v, luma + 1.8556 * u].map(|c| (255.0 * c).round() as u8)
    })
}

/// Difference of red and blue from which a pixel is the box's.
const RED: i32 = 25;
/// Rows of the box that count, as fractions of the picture's height.
const ROWS: (f64, f64) = (0.34, 0.9);
/// Distance from an edge's line from which a row is torn, as a fraction of the width.
const STEP: f64 = 3.0 / 320.0;

/// Fraction of rows in which an edge of the box is off its own line, for the worse edge: steps between tiles, and specks that stay behind. 1
/// if most rows do not show the box.
fn torn_rows(view: &Photo) -> f64 {
    let row_at = |share: f64| (share * f64::from(view.height)).round() as usize;
    let (top, bottom) = (row_at(ROWS.0), row_at(ROWS.1));
    let mut edges = [Vec::new(), Vec::new()];
    for y in top..bottom {
        let row = &view.rgb[y * view.width as usize..][..view.width as usize];
        let red: Vec<usize> = (0..row.len()).filter(|x| i32::from(row[*x][0]) - i32::from(row[*x][2]) > RED).collect();
        if let [first, .., last] = red[..]
            && red.len() >= row.len() / 8
        {
            edges[0].push((y as f64, first as f64));
            edges[1].push((y as f64, last as f64));
        }
    }
    if edges[0].len() < (bottom - top) / 2 {
        return 1.0;
    }
    edges.iter().map(|edge| off_line(edge, STEP * f64::from(view.width))).fold(0.0, f64::max)
}

/// Fraction of the points, as (row, column), that are more than `step` off their common line, which outliers do not move: medians of slopes
/// and of offsets.
fn off_line(points: &[(f64, f64)], step: f64) -> f64 {
    let half = points.len() / 2;
    let slope = median(points[half..].iter().zip(points).map(|(b, a)| (b.1 - a.1) / (b.0 - a.0)));
    let offset = median(points.iter().map(|p| p.1 - slope * p.0));
    let off = points.iter().filter(|p| (p.1 - slope * p.0 - offset).abs() > step).count();
    off as f64 / points.len() as f64
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_of_an_edge_is_torn_and_a_slope_is_not() {
        let film = frame(0, (320, 240));
        assert!(torn_rows(&film) < 1e-9);
        // rows shifted by a slope, and by a step
        let shifted = |by: &dyn Fn(u32) -> u32| Photo::from_fn(320, 240, |x, y| film.at(x.saturating_sub(by(y)), y));
        assert!(torn_rows(&shifted(&|y| y / 12)) < 1e-9);
        let rows = torn_rows(&shifted(&|y| if (100..120).contains(&y) { 5 } else { 0 }));
        assert!((rows - 20.0 / 134.0).abs() < 0.01, "{rows}");
        assert!(torn_rows(&shifted(&|y| if (100..120).contains(&y) { 2 } else { 0 })) < 1e-9);
        assert!(torn_rows(&Photo::from_fn(320, 240, |_, _| [90; 3])) >= 1.0);
    }
}
