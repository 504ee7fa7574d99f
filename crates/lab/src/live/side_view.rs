//! A reader of a room: compares its side view with the truth.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use tmpi_core::live::{FrameTiming, Layers, LiveError, TileState, schema};
use tmpi_core::{Camera, Geometry, Inpainter, LayerMasks, Photo, Pose, Scene, TexturedLayer, compose};
use tmpi_render::difference::psnr_of;
use tmpi_render::{Cpu, RenderError, Renderer};

use super::seams::seams;
use super::sequence::Shot;
use crate::bench::{Figures, compared};

/// Colours of the hidden texels of each layer of each tile.
type Colours = Vec<Vec<Vec<[u8; 3]>>>;

/// A reader that remembers colours, like a page.
#[derive(Default)]
pub(super) struct Reader {
    pub model: Option<TileState>,
    layers: Layers,
    /// Sent tiles that have not arrived yet.
    in_flight: VecDeque<schema::Geometry>,
    /// Tiles whose layers changed since the previous frame.
    changed: Vec<u32>,
    renderer: Cpu,
    /// The tiles shown last, and the true view of that frame.
    last: Option<(Geometry, Photo)>,
    /// Squared error of a channel in uncovered pixels: with all hidden texels inpainted, and with remembered colours.
    inpainted: Mean,
    remembered: Mean,
}

/// A running mean: sum and count.
#[derive(Clone, Copy, Default)]
struct Mean(f64, f64);

impl Mean {
    fn add(&mut self, value: f64) {
        self.0 += value;
        self.1 += 1.0;
    }

    /// `None` without values.
    fn get(self) -> Option<f64> {
        (self.1 > 0.0).then(|| self.0 / self.1)
    }
}

/// What a view shows and is compared with.
#[derive(Clone, Copy)]
pub(super) struct Moment<'a> {
    pub geometry: &'a Geometry,
    /// The decoded frame.
    pub photo: &'a Photo,
    pub shot: &'a Shot,
    pub side_pose: Pose,
    /// Whether the previous frame was shown too.
    pub follows: bool,
    pub sent: &'a [u32],
    /// Whether the reader's memory is measured by now.
    pub settled: bool,
}

impl Reader {
    /// A reader whose labels follow motion for up to `follow` frames.
    pub fn new(follow: u32) -> Self {
        Self { layers: Layers::with_memory().with_motion_frames(follow), ..Self::default() }
    }

    /// Queues sent tiles, and decodes those sent `late` frames ago. Returns the indices of new tiles and their frame.
    pub fn receive(&mut self, message: schema::Geometry, late: u32) -> Result<(Vec<u32>, Option<u64>), LiveError> {
        self.in_flight.push_back(message);
        let due = if self.in_flight.len() > late as usize { self.in_flight.pop_front() } else { None };
        let Some((message, model)) = due.zip(self.model.as_mut()) else { return Ok((Vec::new(), None)) };
        Ok((model.take(&message)?, Some(message.frame)))
    }

    /// Updates the layers for a frame and its new tiles.
    pub fn update(&mut self, geometry: &Geometry, changed: &[u32], photo: &Photo, when: FrameTiming) {
        self.changed = self.layers.update(geometry, |t| changed.contains(&t), photo.clone(), when).layers;
    }

    /// The tiles as shown, with labels that have followed motion.
    pub fn shown<'a>(&'a self, geometry: &'a Geometry) -> &'a Geometry {
        self.layers.moved_geometry().unwrap_or(geometry)
    }

    /// Renders the side view, and compares it with the truth and with the previous frame if that was shown. Returns the view.
    pub fn show(&mut self, m: Moment, f: &mut Figures) -> Result<Photo, RenderError> {
        let shown = self.shown(m.geometry).clone();
        let (g, m) = (&shown, Moment { geometry: &shown, ..m });
        let (mean, wide) = seams(g);
        f.add("seams, px", mean);
        f.add("seams over 1 px, %", 100.0 * wide);
        let before = Instant::now();
        let shapes = g.masks();
        f.add("reader: all masks, ms", ms(before));
        let before = Instant::now();
        let colours = Inpainter::new(m.photo, g).fill_all(&shapes);
        f.add("reader: all inpainting, ms", ms(before));
        let scene = Arc::new(self.layers.scene(g));
        let view = self.draw(m, &scene, m.side_pose)?;
        let own = self.draw(m, &scene, Pose::default())?;
        f.most("identity view: pixels off", own.rgb.iter().zip(&m.photo.rgb).filter(|(a, b)| a != b).count() as f64);
        if m.settled {
            let inpainted = self.draw(m, &composed(m, g, shapes, colours), m.side_pose)?;
            add_squares(&mut self.inpainted, &inpainted, m.shot);
            add_squares(&mut self.remembered, &view, m.shot);
        }
        let [psnr, ssim, _] = compared(&view.rgb, &m.shot.side_view);
        f.add("side view, dB", psnr);
        f.add("side view, SSIM", ssim);
        if let Some((last, truth)) = self.last.take().filter(|_| m.follows) {
            self.flicker(m, (&last, &truth), f)?;
        }
        let truth = m.shot.side_view.clone();
        self.last = Some((shown, truth));
        Ok(view)
    }

    /// Adds what was measured over the whole sequence.
    pub fn finish(&self, f: &mut Figures) {
        for (name, square) in [("uncovered, with memory, dB", self.remembered), ("uncovered, inpainted, dB", self.inpainted)] {
            if let Some(square) = square.get() {
                f.add(name, psnr_of(square));
            }
        }
    }

    /// Renders the frame shown last from another pose.
    pub fn view(&self, m: Moment, pose: Pose) -> Result<Photo, RenderError> {
        self.draw(m, &Arc::new(self.layers.scene(self.shown(m.geometry))), pose)
    }

    fn draw(&self, m: Moment, scene: &Arc<Scene>, pose: Pose) -> Result<Photo, RenderError> {
        let (width, height) = (m.photo.width, m.photo.height);
        let camera = Camera { pose, intrinsics: m.geometry.intrinsics, width, height };
        let view = self.renderer.render(scene, &camera)?;
        Ok(Photo { width, height, rgb: view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect() })
    }

    /// Mean change of the side view between the previous frame's tiles and the new ones, where the truth does not change. Both views show
    /// this frame, which excludes the video's noise.
    fn flicker(&self, m: Moment, (last, truth): (&Geometry, &Photo), f: &mut Figures) -> Result<(), RenderError> {
        let drawn = |g: &Geometry| {
            let shapes = g.masks();
            let mut colours = Inpainter::new(m.photo, g).fill_all(&shapes);
            if let Some(memory) = self.layers.memory() {
                memory.recall(0, &shapes, &mut colours);
            }
            self.draw(m, &composed(m, g, shapes, colours), m.side_pose)
        };
        let (view, last) = (drawn(m.geometry)?, drawn(last)?);
        // pixels far from tiles that were sent or followed motion, including the range of parallax
        let calm = calm(m.geometry, m.sent.iter().chain(&self.changed));
        let (mut all, mut unsent) = (Mean::default(), Mean::default());
        let pixels = view.rgb.iter().zip(&last.rgb).zip(m.shot.side_view.rgb.iter().zip(&truth.rgb)).zip(&calm);
        for (((now, was), (true_now, true_was)), calm) in pixels {
            if true_now == true_was {
                let change = now.iter().zip(was).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / 3.0;
                all.add(change);
                if *calm {
                    unsent.add(change);
                }
            }
        }
        f.add("flicker, levels", all.get().unwrap_or_default());
        if let Some(unsent) = unsent.get() {
            f.add("flicker in unsent tiles, levels", unsent);
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

/// Adds the squared errors of all channels of the uncovered pixels.
fn add_squares(mean: &mut Mean, view: &Photo, shot: &Shot) {
    let pixels = view.rgb.iter().zip(&shot.side_view.rgb).zip(&shot.uncovered).filter(|(_, uncovered)| **uncovered);
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
