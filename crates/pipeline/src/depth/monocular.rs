//! A depth network and everything before and after it.

use std::sync::Arc;

use super::onnx_io::{OnnxIo, Values};
use super::smooth::smooth;
use super::{Adapter, DepthError, Estimate, Estimator, Kind, Sampling, SizeRule, upsample};
use crate::networks::{Config, ExternalData, Network, OnnxError, Session};
use crate::photo::{Filter, Taps, resample, resample_by, resample_bytes, resize_opencv};
use crate::usage::Clock;
use tmpi_core::{DisparityMap, Photo};

/// Percentiles, as shares of pixels, at which the normalised map saturates.
const PERCENTILES: (f64, f64) = (0.01, 0.99);
/// Normalised disparity of a map without relief, which carries no information: halfway, so that the scene moves and stays in range.
const FLAT: f32 = 0.5;
/// Range of a smoothed map up to which it is not normalised again.
const NOISE: f64 = 0.25;

/// Monocular depth by one network of [`super::ADAPTERS`].
pub struct Monocular {
    adapter: Adapter,
    /// Size rule before a file's fixed dimensions overrode it.
    rule: SizeRule,
    network: Arc<dyn Network>,
    io: OnnxIo,
}

impl Monocular {
    /// Depth by `network`, which takes one picture and returns, as its first output, what `adapter` describes.
    pub fn new(adapter: &Adapter, network: Arc<dyn Network>) -> Self {
        Self { adapter: *adapter, rule: adapter.size, network, io: OnnxIo::PLAIN }
    }

    /// Loads the network from the bytes of an ONNX file and of the files of weights that it names. Fixed dimensions in the file override
    /// the adapter's size rule.
    ///
    /// # Errors
    /// [`OnnxError`] if there is no library, or if the file does not fit the adapter.
    pub fn load(adapter: &Adapter, model: &[u8], external_data: &[ExternalData], config: &Config) -> Result<Self, OnnxError> {
        let session = Session::load(adapter.name, model, external_data, config)?;
        let bad = |reason: String| OnnxError::Model { name: adapter.name.to_owned(), reason };
        let (io, rows, columns) = OnnxIo::of(adapter, session.inputs(), session.outputs()).map_err(bad)?;
        let (rule, mut adapter) = (adapter.size, *adapter);
        if let (Ok(w @ 1..), Ok(h @ 1..)) = (u32::try_from(columns), u32::try_from(rows)) {
            adapter.size = SizeRule::Fixed(w, h);
        }
        Ok(Self { adapter, rule, network: Arc::new(session), io })
    }

    /// Runs the network once. Returns disparity at the network's size; every value is finite.
    fn run(&self, photo: &Photo, (w, h): (u32, u32), mirrored: bool) -> Result<DisparityMap, DepthError> {
        let planar = self.input(photo, (w, h), mirrored);
        let (w, h) = (w as usize, h as usize);
        let out = self.network.run(self.io.inputs(&self.adapter, planar, w, h))?;
        let fail = |reason: String| OnnxError::Run { name: self.adapter.name.to_owned(), reason };
        let Values { data, sky } = self.io.values(&self.adapter, out, w, h).map_err(fail)?;
        if !data.iter().any(|v| v.is_finite()) {
            return Err(fail("it returned no finite value".into()).into());
        }
        let mut delta: Vec<f32> = data.into_iter().map(|v| self.to_disparity(v)).collect();
        // sky is infinitely far
        delta.iter_mut().zip(sky).filter(|(_, sky)| *sky).for_each(|(v, _)| *v = 0.0);
        // values that are not finite count as far away
        let far = delta.iter().copied().filter(|v| v.is_finite()).fold(f32::INFINITY, f32::min);
        if far == f32::INFINITY {
            return Err(fail("it returned no positive distance".into()).into());
        }
        for v in &mut delta {
            if !v.is_finite() {
                *v = far;
            }
        }
        if mirrored {
            delta.chunks_exact_mut(w).for_each(<[f32]>::reverse);
        }
        Ok(DisparityMap { width: w as u32, height: h as u32, delta })
    }

    /// The network's output at a size, averaged with that of the mirrored photo if the adapter says so, and with the adapter's ramp.
    fn raw_at(&self, photo: &Photo, size: (u32, u32)) -> Result<DisparityMap, DepthError> {
        let mut map = self.run(photo, size, false)?;
        if self.adapter.flip {
            let mut mirrored = self.run(photo, size, true)?;
            align(&mut mirrored.delta, &map.delta);
            map.delta.iter_mut().zip(&mirrored.delta).for_each(|(d, m)| *d = f32::midpoint(*d, *m));
        }
        add_ramp(&mut map, self.adapter.ramp);
        Ok(map)
    }

    /// The photo at the network's size, normalised: channel, row, column.
    fn input(&self, photo: &Photo, size: (u32, u32), mirrored: bool) -> Vec<f32> {
        let Adapter { mean, deviation, sampling, .. } = self.adapter;
        let normal = |p: [f32; 3]| std::array::from_fn(|c| (p[c] - mean[c]) / deviation[c]);
        let load = |p: [u8; 3]| p.map(|v| f32::from(v) / 255.0);
        let from = (photo.width, photo.height);
        let (from_w, from_h, to_w, to_h) = (from.0 as usize, from.1 as usize, size.0 as usize, size.1 as usize);
        let mut small: Vec<[f32; 3]> = match sampling {
            Sampling::Unrounded(filter) => resample(&photo.rgb, from, size, filter, load, |p| normal(p.map(|v| v.clamp(0.0, 1.0)))),
            Sampling::Bytes(filter) => resample_bytes(&photo.rgb, from, size, filter).into_iter().map(|p| normal(load(p))).collect(),
            Sampling::OpenCv => {
                // by way of the size in whole pixels if the rule leads to this size, rounded to bytes in between, as the publishers do
                let ruled = Adapter { size: self.rule, ..self.adapter };
                let first = ruled.intermediate_size(from.0, from.1).filter(|_| ruled.network_size(from.0, from.1) == size);
                let between = first.map(|between| resize_opencv(&photo.rgb, from, between));
                let (source, from) = (between.as_ref().unwrap_or(&photo.rgb), first.unwrap_or(from));
                resize_opencv(source, from, size).into_iter().map(|p| normal(load(p))).collect()
            }
            Sampling::Four => resample_by(&photo.rgb, from_w, &Taps::four(from_w, to_w), &Taps::four(from_h, to_h), load, normal),
        };
        if mirrored {
            small.chunks_exact_mut(to_w).for_each(<[[f32; 3]]>::reverse);
        }
        (0..3).flat_map(|c| small.iter().map(move |p| p[c])).collect()
    }

    fn to_disparity(&self, v: f32) -> f32 {
        match self.adapter.output {
            Kind::Disparity => v,
            // a distance that is not positive is unknown
            Kind::Metric | Kind::Points if v > 0.0 => 1.0 / v,
            Kind::Metric | Kind::Points => f32::NAN,
        }
    }
}

impl Estimator for Monocular {
    fn name(&self) -> &str {
        self.adapter.name
    }

    fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        self.estimate_at(photo, self.adapter.network_size(photo.width, photo.height)).map(|estimate| estimate.map)
    }

    fn sizes(&self, width: u32, height: u32) -> Vec<(u32, u32)> {
        self.adapter.sizes(width, height)
    }

    fn estimate_at(&self, photo: &Photo, size: (u32, u32)) -> Result<Estimate, DepthError> {
        let clock = Clock::start();
        let mut map = self.raw_at(photo, size)?;
        let network_ms = clock.ms();
        if normalise(&mut map.delta, 0.0) && self.adapter.smoothing > 0.0 {
            let load = |p: [u8; 3]| p.map(|v| f32::from(v) / 255.0);
            let guide = resample(&photo.rgb, (photo.width, photo.height), (map.width, map.height), Filter::Triangle, load, |p| p);
            map.delta = smooth(&guide, &map.delta, map.width as usize, self.adapter.smoothing);
            // smoothing narrows the range; if little is left, it was noise and stays little
            normalise(&mut map.delta, NOISE);
        }
        Ok(Estimate { map: upsample(photo, &map), small: Some(map), network_ms })
    }

    fn raw(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        self.raw_at(photo, self.adapter.network_size(photo.width, photo.height))
    }
}

/// Adds a ramp that rises towards the lower border, with mean 0 and `share` times the deviation of `map`; a few outliers do not decide
/// how large that is. A map of one row or without relief stays unchanged.
fn add_ramp(map: &mut DisparityMap, share: f64) {
    let rows = map.delta.len() / (map.width as usize).max(1);
    if share == 0.0 || rows < 2 {
        return;
    }
    // the deviation of 0, 1, …, rows − 1
    let of_rows = ((rows * rows - 1) as f64 / 12.0).sqrt();
    let (low, high) = spread(&map.delta);
    let step = share * deviation(&map.delta).min(high - low) / of_rows;
    let middle = (rows - 1) as f64 / 2.0;
    for (y, row) in map.delta.chunks_exact_mut(map.width as usize).enumerate() {
        let up = step * (y as f64 - middle);
        for v in row {
            *v = (f64::from(*v) + up).clamp(f64::from(f32::MIN), f64::from(f32::MAX)) as f32;
        }
    }
}

fn deviation(values: &[f32]) -> f64 {
    let of = |f: &dyn Fn(f64) -> f64| values.iter().map(|v| f(f64::from(*v))).sum::<f64>() / values.len() as f64;
    let mean = of(&|v| v);
    of(&|v| (v - mean).powi(2)).sqrt()
}

/// Scales and shifts `values` so that their tenth and ninetieth percentiles are those of `target`: two runs of a network agree only up to
/// scale and shift, and a few outliers must not decide.
fn align(values: &mut [f32], target: &[f32]) {
    let (from, to) = (spread(values), spread(target));
    let scale = if relief(from.0, from.1) { (to.1 - to.0) / (from.1 - from.0) } else { 0.0 };
    for v in values {
        *v = (to.0 + scale * (f64::from(*v) - from.0)) as f32;
    }
}

/// The value below which this share of the values lies.
fn quantiles(values: &[f32]) -> impl FnMut(f64) -> f64 + use<> {
    let mut sorted = values.to_vec();
    move |share| {
        let k = ((sorted.len() - 1) as f64 * share).round() as usize;
        f64::from(*sorted.select_nth_unstable_by(k, f32::total_cmp).1)
    }
}

/// Tenth and ninetieth percentiles.
fn spread(values: &[f32]) -> (f64, f64) {
    let mut at = quantiles(values);
    (at(0.1), at(0.9))
}

/// Maps the range between [`PERCENTILES`] to 0..=1 and clamps the rest, if that range is larger than `least`. A map without relief
/// becomes [`FLAT`]. Returns whether there is relief. `values` must be finite.
fn normalise(values: &mut [f32], least: f64) -> bool {
    let mut at = quantiles(values);
    let (mut lo, mut hi) = (at(PERCENTILES.0), at(PERCENTILES.1));
    // a few pixels may hold all the relief
    if !relief(lo, hi) {
        (lo, hi) = (at(0.0), at(1.0));
    }
    if !relief(lo, hi) {
        values.fill(FLAT);
        return false;
    }
    if hi - lo <= least {
        return true;
    }
    for v in values {
        *v = (((f64::from(*v) - lo) / (hi - lo)).clamp(0.0, 1.0)) as f32;
    }
    true
}

/// Whether the range is more than rounding.
fn relief(lo: f64, hi: f64) -> bool {
    hi - lo > 1e-6 * lo.abs().max(hi.abs()).max(1e-30)
}

#[cfg(test)]
mod tests;
