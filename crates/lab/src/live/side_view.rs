//! A reader of a room: compares its side view with the truth.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use tmpi_core::live::{FrameTiming, Layers, LiveError, TileState, schema};
use tmpi_core::{Camera, Class, Geometry, Inpainter, LayerMasks, Photo, Pose, Scene, TexturedLayer, TileFrame, compose};
use tmpi_render::difference::psnr;
use tmpi_render::{Cpu, RenderError, Renderer};

use super::seams::seams;
use super::sequence::{BEHIND, Shot};
use crate::metrics::ssim_map;
use crate::scenes::Picture;

/// Fraction of a view that is cropped on each side, as in the paper.
const CROP: f64 = 0.15;

/// A layer is behind the visible surface if it is farther by this δ.
const APART: f64 = 0.05;

/// Colours of the hidden texels of each layer of each tile.
type Colours = Vec<Vec<Vec<[u8; 3]>>>;

/// A reader, with the errors of what it shows.
#[derive(Default)]
pub(super) struct Reader {
    pub model: Option<TileState>,
    /// Layers with memory, as on a page; `None`: inpaints every frame separately.
    pub layers: Option<Layers>,
    /// Sent tiles that have not arrived yet.
    in_flight: VecDeque<schema::Geometry>,
    /// Tiles whose layers changed since the previous frame.
    changed: Vec<u32>,
    renderer: Cpu,
    /// The tiles shown last, and the true view of that frame.
    last: Option<(Geometry, Photo)>,
    pub psnr: Mean,
    pub ssim: Mean,
    /// Disagreement of neighbouring tiles: mean in pixels, and the fraction above one pixel.
    pub seams: [Mean; 2],
    pub flicker: Mean,
    pub flicker_left_out: Mean,
    /// Squared error of a channel in uncovered pixels: with all hidden texels inpainted, and with remembered colours.
    pub inpainted: Mean,
    pub remembered: Mean,
    /// The same with true colours on the hidden texels behind the object: the least error that these planes allow.
    pub least: Mean,
    /// Squared error in uncovered pixels that the camera saw in an earlier frame.
    pub seen_inpainted: Mean,
    pub seen_remembered: Mean,
    /// Squared error against the same layers with true hidden colours behind the object, which excludes errors of depth.
    pub own_inpainted: Mean,
    pub own_remembered: Mean,
    /// Number of pixels that differ between the identity view and the frame.
    pub off: u64,
    pub masks: Mean,
    pub fill: Mean,
}

/// A running mean: sum and count.
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

/// What a view shows and is compared with.
#[derive(Clone, Copy)]
pub(super) struct Moment<'a> {
    pub geometry: &'a Geometry,
    /// The decoded frame.
    pub photo: &'a Photo,
    pub shot: &'a Shot,
    /// Pixels of the side view that the camera does not see now, but has seen before.
    pub seen_before: &'a [bool],
    /// The frame without the object, if known.
    pub plate: Option<&'a Picture>,
    /// Pose of the side view.
    pub side_pose: Pose,
    /// Whether the previous frame was shown too.
    pub follows: bool,
    /// Tiles that were sent.
    pub sent: &'a [u32],
    /// Whether the reader's memory is measured by now.
    pub settled: bool,
}

impl Reader {
    /// A reader that remembers colours, like a page, and whose labels follow motion for up to `follow` frames.
    pub fn with_memory(follow: u32) -> Self {
        Self { layers: Some(Layers::with_memory().with_motion_frames(follow)), ..Self::default() }
    }

    /// Queues sent tiles, and decodes those sent `late` frames ago. Returns the indices of new tiles and their frame.
    ///
    /// # Errors
    /// [`LiveError`] if they cannot be decoded.
    pub fn receive(&mut self, message: schema::Geometry, late: u32) -> Result<(Vec<u32>, Option<u64>), LiveError> {
        self.in_flight.push_back(message);
        let due = if self.in_flight.len() > late as usize { self.in_flight.pop_front() } else { None };
        let Some((message, model)) = due.zip(self.model.as_mut()) else { return Ok((Vec::new(), None)) };
        Ok((model.take(&message)?, Some(message.frame)))
    }

    /// Updates the layers for a frame and its new tiles.
    pub fn update(&mut self, geometry: &Geometry, changed: &[u32], photo: &Photo, when: FrameTiming) {
        if let Some(layers) = &mut self.layers {
            self.changed = layers.update(geometry, |t| changed.contains(&t), photo.clone(), when).layers;
        }
    }

    /// The tiles as shown, with labels that have followed motion.
    pub fn shown<'a>(&'a self, geometry: &'a Geometry) -> &'a Geometry {
        self.layers.as_ref().and_then(Layers::moved_geometry).unwrap_or(geometry)
    }

    /// Renders the side view, and compares it with the truth and with the previous frame if that was shown. Returns the view.
    ///
    /// # Errors
    /// [`RenderError`] from the renderer.
    pub fn show(&mut self, m: Moment) -> Result<Photo, RenderError> {
        let shown = self.layers.as_ref().and_then(Layers::moved_geometry).cloned();
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
            let inpainted = self.draw(m, &composed(m, g, shapes.clone(), colours.clone()), m.side_pose)?;
            add_squares(&mut self.inpainted, &inpainted, m.shot, &m.shot.uncovered);
            add_squares(&mut self.seen_inpainted, &inpainted, m.shot, m.seen_before);
            let truth = m.plate.map(|plate| self.truth_by_own_depth(m, plate, &shapes, &colours)).transpose()?;
            compared = truth.map(|truth| (inpainted, truth));
        }
        let scene = match &self.layers {
            Some(layers) => Arc::new(layers.scene(g)),
            None => composed(m, g, shapes, colours),
        };
        let view = self.draw(m, &scene, m.side_pose)?;
        let own = self.draw(m, &scene, Pose::default())?;
        self.off += own.rgb.iter().zip(&m.photo.rgb).filter(|(a, b)| a != b).count() as u64;
        if m.settled {
            add_squares(&mut self.remembered, &view, m.shot, &m.shot.uncovered);
            add_squares(&mut self.seen_remembered, &view, m.shot, m.seen_before);
        }
        if let Some((inpainted, (truth, shown))) = compared {
            add_squares(&mut self.least, &truth, m.shot, &m.shot.uncovered);
            add_squares_of(&mut self.own_inpainted, &inpainted, &truth, &shown);
            add_squares_of(&mut self.own_remembered, &view, &truth, &shown);
        }
        self.compare(m, &view)?;
        self.last = Some((g.clone(), m.shot.side_view.clone()));
        Ok(view)
    }

    /// Renders the frame shown last from another pose.
    ///
    /// # Errors
    /// [`RenderError`] from the renderer.
    pub fn view(&self, m: Moment, pose: Pose) -> Result<Option<Photo>, RenderError> {
        let Some(layers) = &self.layers else { return Ok(None) };
        self.draw(m, &Arc::new(layers.scene(self.shown(m.geometry))), pose).map(Some)
    }

    /// The scene of a frame with these tiles, and with remembered hidden colours.
    fn scene(&self, m: Moment, g: &Geometry, shapes: Vec<LayerMasks>, mut colours: Colours) -> Arc<Scene> {
        if let Some(memory) = self.layers.as_ref().and_then(Layers::memory) {
            memory.recall(0, &shapes, &mut colours);
        }
        composed(m, g, shapes, colours)
    }

    /// The side view with true colours on the hidden texels behind the object, and the pixels that mostly show these texels.
    fn truth_by_own_depth(
        &self,
        m: Moment,
        plate: &Picture,
        shapes: &[LayerMasks],
        colours: &Colours,
    ) -> Result<(Photo, Vec<bool>), RenderError> {
        let grid = m.geometry.grid;
        let shown: Vec<Vec<f32>> = (0..).zip(&m.geometry.tiles).map(|(t, tile)| tile.disparities(&grid, t)).collect();
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
                    // the object itself may have several planes, one behind the other
                    let is_behind = f64::from(shown - place.disparity(&layer.plane, x, y)) > APART;
                    if is_behind && m.shot.delta.delta[at] - plate.disparity.delta[at] > BEHIND {
                        *colour = paint(at);
                    }
                }
            }
            self.draw(m, &composed(m, m.geometry, shapes.to_vec(), colours), m.side_pose)
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
        self.psnr.add(psnr(cropped(view).as_flattened(), cropped(&shot.side_view).as_flattened()));
        let ssim = ssim_map(&cropped(view), &cropped(&shot.side_view), inner(view.width).len());
        self.ssim.add(ssim.iter().map(|v| f64::from(*v)).sum::<f64>() / ssim.len().max(1) as f64);
        let Some((last, truth)) = self.last.take().filter(|_| m.follows) else { return Ok(()) };
        // this frame with the previous tiles, so that the video's noise causes no difference
        let drawn = |g: &Geometry| {
            let shapes = g.masks();
            let colours = Inpainter::new(m.photo, g).fill_all(&shapes);
            self.draw(m, &self.scene(m, g, shapes, colours), m.side_pose)
        };
        let (view, last) = (drawn(m.geometry)?, drawn(&last)?);
        // pixels far from tiles that were sent or followed motion, including the range of parallax
        let calm = calm(m.geometry, m.sent.iter().chain(&self.changed));
        let (mut all, mut left) = (Mean::default(), Mean::default());
        let pixels = view.rgb.iter().zip(&last.rgb).zip(shot.side_view.rgb.iter().zip(&truth.rgb)).zip(&calm);
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

/// Adds the squared errors of all channels of the `counted` pixels.
fn add_squares(mean: &mut Mean, view: &Photo, shot: &Shot, counted: &[bool]) {
    add_squares_of(mean, view, &shot.side_view, counted);
}

fn add_squares_of(mean: &mut Mean, view: &Photo, truth: &Photo, counted: &[bool]) {
    let pixels = view.rgb.iter().zip(&truth.rgb).zip(counted).filter(|(_, counted)| **counted);
    for ((is, should), _) in pixels {
        is.iter().zip(should).for_each(|(a, b)| mean.add(f64::from(a.abs_diff(*b)).powi(2)));
    }
}

/// Pixels outside of these tiles and their neighbours.
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
