//! A reader of a room: what it shows from beside the camera, against the truth.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use tmpi_core::live::{Layers, LiveError, Model, When, wire};
use tmpi_core::{Camera, Class, Geometry, Inpainter, LayerMasks, Photo, Pose, Scene, TexturedLayer, TileFrame, compose};
use tmpi_render::difference::psnr;
use tmpi_render::{Cpu, RenderError, Renderer};

use super::seams::seams;
use super::sequence::{BEHIND, Shot};
use crate::metrics::ssim_map;
use crate::scenes::Picture;

/// Share of a view that is left out on each side, as in the paper.
const CROP: f64 = 0.15;

/// δ by which a layer lies behind what is shown.
const APART: f64 = 0.05;

/// Colours of the hidden texels of each layer of each tile.
type Colours = Vec<Vec<Vec<[u8; 3]>>>;

/// A reader, and how good what it shows is.
#[derive(Default)]
pub(super) struct Reader {
    pub model: Option<Model>,
    /// What it shows, as a page does; none: it makes every frame up anew.
    pub layers: Option<Layers>,
    /// Tiles that were sent and are not read yet.
    under_way: VecDeque<wire::Geometry>,
    /// Tiles whose layers are others than in the frame before.
    other: Vec<u32>,
    renderer: Cpu,
    /// The tiles that were shown last, and the true view of them.
    last: Option<(Geometry, Photo)>,
    pub psnr: Mean,
    pub ssim: Mean,
    /// Disagreement of neighbouring tiles: pixels, and the share of more than one.
    pub seams: [Mean; 2],
    pub flicker: Mean,
    pub flicker_left_out: Mean,
    /// Squared error of a channel where the camera itself sees nothing: all hidden texels made up, and those that were seen before shown.
    pub made_up: Mean,
    pub remembered: Mean,
    /// With the truth on the hidden texels of what the thing stands before: the least that layers of these planes can leave.
    pub least: Mean,
    /// The same of what the camera saw at an earlier frame.
    pub seen_made_up: Mean,
    pub seen_remembered: Mean,
    /// Against the same layers with the truth on their hidden texels, where these show what the thing stands before: the error of depth is in neither.
    pub own_made_up: Mean,
    pub own_remembered: Mean,
    /// Pixels of the view from the camera's own place that differ from the frame.
    pub off: u64,
    pub masks: Mean,
    pub fill: Mean,
}

/// A mean of values as they come.
#[derive(Clone, Copy, Default)]
pub(super) struct Mean(f64, f64);

impl Mean {
    pub const fn count(self) -> f64 {
        self.1
    }

    pub fn add(&mut self, value: f64) {
        self.0 += value;
        self.1 += 1.0;
    }

    pub fn get(self) -> f64 {
        if self.1 > 0.0 { self.0 / self.1 } else { 0.0 }
    }
}

/// What a view is drawn of and compared with.
#[derive(Clone, Copy)]
pub(super) struct Moment<'a> {
    pub geometry: &'a Geometry,
    /// The frame as it was decoded.
    pub photo: &'a Photo,
    pub shot: &'a Shot,
    /// Pixels of the view from beside that the camera does not see, and saw before.
    pub seen_before: &'a [bool],
    /// The frame without the thing, where that is known.
    pub plate: Option<&'a Picture>,
    /// The pose of the view.
    pub beside: Pose,
    /// The frame before was shown, too.
    pub follows: bool,
    /// Tiles that were sent.
    pub sent: &'a [u32],
    /// What was seen before counts by now.
    pub settled: bool,
}

impl Reader {
    /// One that shows what was seen before, as a page does, and whose labels follow what moves in so many frames.
    pub fn remembering(follow: u32) -> Self {
        Self { layers: Some(Layers::remembering().following(follow)), ..Self::default() }
    }

    /// Takes tiles as they are sent, and reads those that were sent so many frames before; gives the numbers of those that it has anew, and their frame.
    ///
    /// # Errors
    /// Where they cannot be read.
    pub fn hear(&mut self, message: wire::Geometry, late: u32) -> Result<(Vec<u32>, Option<u64>), LiveError> {
        self.under_way.push_back(message);
        let due = if self.under_way.len() > late as usize { self.under_way.pop_front() } else { None };
        let Some((message, model)) = due.zip(self.model.as_mut()) else { return Ok((Vec::new(), None)) };
        Ok((model.take(&message)?, Some(message.frame)))
    }

    /// Takes a frame, and the numbers of the tiles that came with it.
    pub fn take(&mut self, geometry: &Geometry, changed: &[u32], photo: &Photo, when: When) {
        if let Some(layers) = &mut self.layers {
            self.other = layers.update(geometry, |t| changed.contains(&t), photo.clone(), when).layers;
        }
    }

    /// Tiles as they are shown: with labels that have followed what moved.
    pub fn shown<'a>(&'a self, geometry: &'a Geometry) -> &'a Geometry {
        self.layers.as_ref().and_then(Layers::with_moved).unwrap_or(geometry)
    }

    /// Draws the view from beside the camera and compares it with the truth, and with the frame before where that was shown. Gives it.
    ///
    /// # Errors
    /// As the renderer gives them.
    pub fn show(&mut self, m: Moment) -> Result<Photo, RenderError> {
        let shown = self.layers.as_ref().and_then(Layers::with_moved).cloned();
        let m = Moment { geometry: shown.as_ref().unwrap_or(m.geometry), ..m };
        let g = m.geometry;
        let (mean, wide) = seams(g);
        self.seams.iter_mut().zip([mean, wide]).for_each(|(sum, value)| sum.add(value));
        let before = Instant::now();
        let shapes = g.masks();
        self.masks.add(ms(before));
        let before = Instant::now();
        let colours = Inpainter::new(m.photo, g).fill_all(&shapes);
        self.fill.add(ms(before));
        let mut compared = None;
        if m.settled && self.layers.is_some() {
            let made_up = self.draw(m, &composed(m, g, shapes.clone(), colours.clone()), m.beside)?;
            add_squares(&mut self.made_up, &made_up, m.shot, &m.shot.uncovered);
            add_squares(&mut self.seen_made_up, &made_up, m.shot, m.seen_before);
            let truth = m.plate.map(|plate| self.truth_by_own_depth(m, plate, &shapes, &colours)).transpose()?;
            compared = truth.map(|truth| (made_up, truth));
        }
        let scene = match &self.layers {
            Some(layers) => Arc::new(layers.scene(g)),
            None => composed(m, g, shapes, colours),
        };
        let view = self.draw(m, &scene, m.beside)?;
        let own = self.draw(m, &scene, Pose::default())?;
        self.off += own.rgb.iter().zip(&m.photo.rgb).filter(|(a, b)| a != b).count() as u64;
        if m.settled {
            add_squares(&mut self.remembered, &view, m.shot, &m.shot.uncovered);
            add_squares(&mut self.seen_remembered, &view, m.shot, m.seen_before);
        }
        if let Some((made_up, (truth, shown))) = compared {
            add_squares(&mut self.least, &truth, m.shot, &m.shot.uncovered);
            add_squares_of(&mut self.own_made_up, &made_up, &truth, &shown);
            add_squares_of(&mut self.own_remembered, &view, &truth, &shown);
        }
        self.compare(m, &view)?;
        self.last = Some((g.clone(), m.shot.beside.clone()));
        Ok(view)
    }

    /// What it shows of the frame that was shown last, from another place.
    ///
    /// # Errors
    /// As the renderer gives them.
    pub fn view(&self, m: Moment, pose: Pose) -> Result<Option<Photo>, RenderError> {
        let Some(layers) = &self.layers else { return Ok(None) };
        self.draw(m, &Arc::new(layers.scene(self.shown(m.geometry))), pose).map(Some)
    }

    /// The scene of a frame with some tiles, hidden texels as far as they were seen before.
    fn scene(&self, m: Moment, g: &Geometry, shapes: Vec<LayerMasks>, mut colours: Colours) -> Arc<Scene> {
        if let Some(memory) = self.layers.as_ref().and_then(Layers::memory) {
            memory.recall(0, &shapes, &mut colours);
        }
        composed(m, g, shapes, colours)
    }

    /// The view from beside with the truth on the hidden texels that lie behind the thing, and the pixels that mostly show those.
    fn truth_by_own_depth(
        &self,
        m: Moment,
        plate: &Picture,
        shapes: &[LayerMasks],
        colours: &Colours,
    ) -> Result<(Photo, Vec<bool>), RenderError> {
        let grid = m.geometry.grid;
        let shown: Vec<Vec<f32>> = (0..).zip(&m.geometry.tiles).map(|(t, tile)| tile.shown(&grid, t)).collect();
        let painted = |paint: &dyn Fn(usize) -> [u8; 3]| {
            let mut colours = colours.clone();
            let layers =
                (0u32..).zip(shapes.iter().zip(&mut colours)).flat_map(|(t, (s, c))| s.layers.iter().zip(c).map(move |(l, c)| (t, l, c)));
            for (tile, layer, colours) in layers {
                let (all, place) = (grid.rect(tile), TileFrame::of(&grid, tile));
                let hidden = (0u32..).zip(&layer.class).filter(|(_, c)| **c == Class::Hidden as u8).map(|(i, _)| i);
                for (i, colour) in hidden.zip(colours) {
                    let r = layer.rect;
                    let (x, y) = (r.x + i % r.w, r.y + i / r.w);
                    let at = (y * m.photo.width + x) as usize;
                    let shown = shown[tile as usize][((y - all.y) * all.w + x - all.x) as usize];
                    // of the thing itself there may be several planes, one behind the other
                    let is_behind = f64::from(shown - place.disparity(&layer.plane, x, y)) > APART;
                    if is_behind && m.shot.delta.delta[at] - plate.disparity.delta[at] > BEHIND {
                        *colour = paint(at);
                    }
                }
            }
            self.draw(m, &composed(m, m.geometry, shapes.to_vec(), colours), m.beside)
        };
        let (truth, dark, light) = (painted(&|at| plate.photo.rgb[at])?, painted(&|_| [0; 3])?, painted(&|_| [255; 3])?);
        let shown = dark.rgb.iter().zip(&light.rgb).map(|(dark, light)| light[1].abs_diff(dark[1]) > 127).collect();
        Ok((truth, shown))
    }

    fn draw(&self, m: Moment, scene: &Arc<Scene>, pose: Pose) -> Result<Photo, RenderError> {
        let (width, height) = (m.photo.width, m.photo.height);
        let camera = Camera { pose, intrinsics: m.geometry.intrinsics, width, height };
        let view = self.renderer.render(scene, &camera)?;
        Ok(Photo { width, height, rgb: view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect() })
    }

    fn compare(&mut self, m: Moment, view: &Photo) -> Result<(), RenderError> {
        let shot = m.shot;
        self.psnr.add(psnr(cropped(view).as_flattened(), cropped(&shot.beside).as_flattened()));
        let ssim = ssim_map(&cropped(view), &cropped(&shot.beside), inner(view.width).len());
        self.ssim.add(ssim.iter().map(|v| f64::from(*v)).sum::<f64>() / ssim.len().max(1) as f64);
        let Some((last, truth)) = self.last.take().filter(|_| m.follows) else { return Ok(()) };
        // this frame with the last one's tiles: what differs then is not the video's noise
        let drawn = |g: &Geometry| {
            let shapes = g.masks();
            let colours = Inpainter::new(m.photo, g).fill_all(&shapes);
            self.draw(m, &self.scene(m, g, shapes, colours), m.beside)
        };
        let (view, last) = (drawn(m.geometry)?, drawn(&last)?);
        // where nothing is near that was sent, or followed what moved: tiles and what parallax brings to them
        let calm = calm(m.geometry, m.sent.iter().chain(&self.other));
        let (mut all, mut left) = (Mean::default(), Mean::default());
        let pixels = view.rgb.iter().zip(&last.rgb).zip(shot.beside.rgb.iter().zip(&truth.rgb)).zip(&calm);
        for (((now, was), (true_now, true_was)), calm) in pixels {
            if true_now == true_was {
                let change = now.iter().zip(was).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / 3.0;
                all.add(change);
                if *calm {
                    left.add(change);
                }
            }
        }
        self.flicker.add(all.get());
        if left.1 > 0.0 {
            self.flicker_left_out.add(left.get());
        }
        Ok(())
    }
}

pub(super) fn ms(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

fn composed(m: Moment, g: &Geometry, shapes: Vec<LayerMasks>, colours: Colours) -> Arc<Scene> {
    let tiles = shapes.into_iter().zip(colours);
    let tiles = tiles.map(|(s, c)| s.layers.into_iter().zip(c).map(|(shape, hidden)| TexturedLayer { shape, hidden }).collect());
    Arc::new(compose(m.photo.clone(), g, tiles.collect()))
}

/// Adds the squared error of the channels of the pixels that are `counted`.
fn add_squares(mean: &mut Mean, view: &Photo, shot: &Shot, counted: &[bool]) {
    add_squares_of(mean, view, &shot.beside, counted);
}

fn add_squares_of(mean: &mut Mean, view: &Photo, truth: &Photo, counted: &[bool]) {
    let pixels = view.rgb.iter().zip(&truth.rgb).zip(counted).filter(|(_, counted)| **counted);
    for ((is, should), _) in pixels {
        is.iter().zip(should).for_each(|(a, b)| mean.add(f64::from(a.abs_diff(*b)).powi(2)));
    }
}

/// Pixels that none of some tiles, nor one beside them, has.
fn calm<'a>(g: &Geometry, tiles: impl Iterator<Item = &'a u32>) -> Vec<bool> {
    let mut calm = vec![true; g.grid.width as usize * g.grid.height as usize];
    for t in tiles {
        let r = tmpi_core::grown(g.grid.rect(*t), g.grid.size, g.grid.size, &g.grid);
        for y in r.y..r.y + r.h {
            let row = y as usize * g.grid.width as usize + r.x as usize;
            calm[row..row + r.w as usize].fill(false);
        }
    }
    calm
}

fn inner(side: u32) -> std::ops::Range<u32> {
    let crop = (f64::from(side) * CROP) as u32;
    crop..side - crop
}

fn cropped(p: &Photo) -> Vec<[u8; 3]> {
    inner(p.height).flat_map(|y| inner(p.width).map(move |x| p.at(x, y))).collect()
}
