//! Disparity samples of one tile.

use super::MAX_PLANES;
use super::kernel::{self, Columns};
use tmpi_core::{DisparityMap, Grid, Plane};

/// The pixels of one tile as columns. Reused from tile to tile.
#[derive(Clone, Debug, Default)]
pub struct Samples {
    /// Horizontal positions, in half tiles from the tile's centre.
    pub u: Vec<f32>,
    /// Vertical positions, in half tiles from the tile's centre.
    pub v: Vec<f32>,
    /// Disparities.
    pub delta: Vec<f32>,
    /// Weights.
    pub weight: Vec<f32>,
    /// Width of the tile in pixels.
    pub width: usize,
}

impl Samples {
    /// Fills the columns with the pixels of tile `tile` of `grid`. A disparity that is not finite becomes 0 with weight 0; a weight that is
    /// not finite or not positive becomes 0; if all weights are 0, all become 1.
    pub fn gather(&mut self, delta: &DisparityMap, confidence: Option<&[f32]>, grid: &Grid, tile: u32) {
        let (r, centre, half) = (grid.rect(tile), grid.centre(tile), grid.half());
        self.clear(r.w as usize);
        for y in r.y..r.y + r.h {
            let v = ((f64::from(y) + 0.5 - centre.1) / half) as f32;
            let row = y as usize * delta.width as usize + r.x as usize;
            let row = row..row + r.w as usize;
            self.u.extend((r.x..r.x + r.w).map(|x| ((f64::from(x) + 0.5 - centre.0) / half) as f32));
            self.v.resize(self.v.len() + row.len(), v);
            self.delta.extend_from_slice(&delta.delta[row.clone()]);
            match confidence {
                Some(c) => self.weight.extend(c[row].iter().map(|&w| usable_weight(w))),
                None => self.weight.resize(self.v.len(), 1.0),
            }
        }
        for (d, w) in self.delta.iter_mut().zip(&mut self.weight) {
            if !d.is_finite() {
                (*d, *w) = (0.0, 0.0);
            }
        }
        self.settle_weights();
    }

    /// Empties the columns for a tile `width` pixels wide.
    pub fn clear(&mut self, width: usize) {
        self.width = width;
        for c in [&mut self.u, &mut self.v, &mut self.delta, &mut self.weight] {
            c.clear();
        }
    }

    /// Adds one pixel. A disparity that is not finite becomes 0 with weight 0.
    pub fn push(&mut self, u: f32, v: f32, delta: f32, weight: f32) {
        let known = delta.is_finite();
        self.u.push(u);
        self.v.push(v);
        self.delta.push(if known { delta } else { 0.0 });
        self.weight.push(if known { usable_weight(weight) } else { 0.0 });
    }

    fn settle_weights(&mut self) {
        if self.weight.iter().all(|&w| w == 0.0) {
            self.weight.fill(1.0);
        }
    }

    /// Every `step`th pixel of every `step`th row, for searches; all pixels if there are at most 1024, a quarter of a 64-pixel tile.
    pub fn thinned(&self, step: usize) -> Self {
        let mut s = Self::default();
        if self.len() <= 1024 || self.width == 0 {
            s.clone_from(self);
            return s;
        }
        s.clear(self.width.div_ceil(step));
        for (i, row) in (0..self.len()).step_by(self.width * step).enumerate() {
            // alternate the phase, so that one-pixel stripes are not missed completely, neither rows nor columns
            for at in (row + i * (step / 2) % step + (i / 2) % (step / 2).max(1)..(row + self.width).min(self.len())).step_by(step) {
                s.push(self.u[at], self.v[at], self.delta[at], self.weight[at]);
            }
        }
        s.settle_weights();
        s
    }

    /// Number of pixels.
    pub fn len(&self) -> usize {
        self.delta.len()
    }

    /// Whether there are no pixels.
    pub fn is_empty(&self) -> bool {
        self.delta.is_empty()
    }

    /// The columns in the form that the kernels take.
    pub(super) fn columns(&self) -> Columns<'_> {
        Columns { u: &self.u, v: &self.v, d: &self.delta, w: &self.weight }
    }

    /// Labels every pixel with its nearest plane (the first on ties) and writes absolute errors in δ to `error`. Uses at most
    /// [`MAX_PLANES`] planes. Returns the weighted sum of squared errors.
    pub fn assign(&self, planes: &[Plane], labels: &mut Vec<u32>, error: &mut Vec<f32>) -> f64 {
        self.assign_moved(planes, labels, error, &mut Vec::new())
    }

    /// [`Samples::assign`] that also fills `moved` with the index and old label of each pixel whose label changed.
    pub(super) fn assign_moved(&self, planes: &[Plane], labels: &mut Vec<u32>, error: &mut Vec<f32>, moved: &mut Vec<(u32, u32)>) -> f64 {
        let mut some = [[0f32; 3]; MAX_PLANES as usize];
        for (to, p) in some.iter_mut().zip(planes) {
            *to = [p.a as f32, p.b as f32, p.c as f32];
        }
        labels.resize(self.len(), 0);
        error.resize(self.len(), 0.0);
        moved.clear();
        kernel::nearest(&some[..planes.len().min(some.len())], self.columns(), error, labels, moved)
    }

    /// Absolute errors in δ of labelled pixels.
    pub fn errors(&self, planes: &[Plane], labels: &[u8]) -> Vec<f32> {
        let planes: Vec<[f32; 3]> = planes.iter().map(|p| [p.a as f32, p.b as f32, p.c as f32]).collect();
        labels.iter().enumerate().map(|(i, &l)| self.error(i, planes[usize::from(l)]).abs()).collect()
    }

    /// Error in δ of pixel `i` on a plane.
    #[inline]
    pub(super) fn error(&self, i: usize, [a, b, c]: [f32; 3]) -> f32 {
        a + b * self.u[i] + c * self.v[i] - self.delta[i]
    }

    /// 99th percentile of the absolute error in δ to the nearest plane.
    pub fn error_p99(&self, planes: &[Plane]) -> f64 {
        let (mut labels, mut error) = (Vec::new(), Vec::new());
        self.assign(planes, &mut labels, &mut error);
        percentile_99(&mut error)
    }
}

/// A weight that is safe to sum: 0 if it is not finite or not positive, else at most 1e6.
fn usable_weight(weight: f32) -> f32 {
    if weight.is_finite() && weight > 0.0 { weight.min(1e6) } else { 0.0 }
}

/// 99th percentile; 0 without values.
pub(crate) fn percentile_99(values: &mut [f32]) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let at = (values.len() * 99 / 100).min(values.len() - 1);
    f64::from(*values.select_nth_unstable_by(at, f32::total_cmp).1)
}
