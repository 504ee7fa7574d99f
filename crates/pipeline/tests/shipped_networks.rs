//! Tests of the shipped networks in the pipeline's own stages, on synthetic scenes with known disparity and colours.
#![allow(clippy::unwrap_used, clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "test")]

use std::path::{Path, PathBuf};

use tmpi_core::{Class, DisparityMap, Intrinsics, LayerMask, Photo, compose};
use tmpi_pipeline::networks::models::{Settings, load};
use tmpi_pipeline::networks::{Config, Network as _, Session, Tensor, available};
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::run::stages::{self, Layered, Prepared, WeightedDisparity};
use tmpi_pipeline::run::{Context, Denoise, Switch};
use tmpi_pipeline::{Models, Options, Silent};
use tmpi_render::draw_reference_view;

const SIZE: (u32, u32) = (256, 192);
/// Largest difference of a network's output between two evaluators, as a share of its range: sums in another order.
const GOLDEN: f32 = 1e-4;
/// Standard deviation of the noise that Θ is meant to remove: a variance of 1e-3.
const NOISE: f32 = 0.0316;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models")
}

/// The networks in the workspace's `models` folder; `None` without ONNX Runtime.
fn models() -> Option<Models> {
    tmpi_testing::Need::Onnx.or_skip(available())?;
    let folder = folder();
    let models = load(&Settings { folder, ..Settings::default() }).unwrap();
    assert!(models.theta.is_some() && models.psi.is_some(), "the workspace ships both files");
    Some(models)
}

/// Some outputs of a network for a fixed input by ONNX's own evaluator, which `tests/onnx/goldens.py` writes.
#[derive(serde::Deserialize)]
struct Golden {
    network: String,
    shape: [usize; 4],
    low: f32,
    high: f32,
    outputs: Vec<Vec<f32>>,
}

impl Golden {
    /// Largest difference of an output from the golden one, as a share of that one's range; `swapped` reverses the order of the channels.
    fn difference(&self, session: &Session, swapped: bool) -> f32 {
        let [n, channels, h, w] = self.shape;
        let value = |i: usize| {
            let (x, y, c) = (i % w, i / w % h, i / (w * h));
            let c = if swapped { n * channels - 1 - c } else { c };
            self.low + (self.high - self.low) * ((3 * x + 5 * y + 7 * c) % 32) as f32 / 32.0
        };
        let input = Tensor { shape: self.shape.to_vec(), data: (0..n * channels * h * w).map(value).collect() };
        let outputs = session.run(vec![input]).unwrap();
        assert_eq!(outputs.len(), self.outputs.len());
        let of = |(got, want): (&Tensor, &Vec<f32>)| {
            let range = want.iter().copied().fold(f32::MIN, f32::max) - want.iter().copied().fold(f32::MAX, f32::min);
            let got = got.data.iter().step_by(got.data.len() / want.len());
            got.zip(want)
                .map(|(g, w)| (g - w).abs() / range)
                .fold(0.0, |most: f32, off| if off.is_nan() { f32::INFINITY } else { most.max(off) })
        };
        outputs.iter().zip(&self.outputs).map(of).fold(0.0, f32::max)
    }
}

#[test]
fn networks_agree_with_another_evaluator() {
    let Some(()) = tmpi_testing::Need::Onnx.or_skip(available()) else { return };
    let goldens: Vec<Golden> = serde_json::from_str(include_str!("../../../tests/onnx/goldens.json")).unwrap();
    for golden in goldens {
        let file = std::fs::read(folder().join(&golden.network)).unwrap();
        let session = Session::load(&golden.network, &file, &[], &Config::default()).unwrap();
        let (off, swapped) = (golden.difference(&session, false), golden.difference(&session, true));
        assert!(off < GOLDEN && swapped > 10.0 * GOLDEN, "{}: off by {off}, with swapped channels by {swapped}", golden.network);
    }
}

/// A uniform number in [0, 1), the same on every machine (`SplitMix64`).
fn uniform(seed: u64) -> f32 {
    let z = seed.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 40) as f32 / 16_777_216.0
}

/// A normal deviate, as the sum of twelve uniform numbers.
fn normal(i: usize) -> f32 {
    (0..12).map(|k| uniform(i as u64 * 12 + k)).sum::<f32>() - 6.0
}

/// A wall that recedes to the right, and two boxes in front of it.
struct Scene {
    photo: Photo,
    delta: DisparityMap,
    /// The wall without the boxes.
    wall: Vec<[u8; 3]>,
}

fn scene(seed: u64) -> Scene {
    let (width, height) = SIZE;
    let boxes = [(60..120, 50..130, 0.6), (150..200, 80..160, 0.85)];
    let pick = |k: u64, from: f32, to: f32| from + uniform(seed * 1000 + k) * (to - from);
    let (angle, period) = (pick(1, 0.0, 3.0), pick(2, 12.0, 40.0));
    let colours = [0, 1].map(|c| [3, 4, 5].map(|k| pick(10 * c + k, 40.0, 210.0)));
    // stripes of two colours in soft light
    let wall = |x: u32, y: u32| {
        let along = (x as f32 * angle.cos() + y as f32 * angle.sin()) / period;
        let light = 0.8 + 0.2 * (x as f32 / 60.0).sin();
        colours[usize::from(along.rem_euclid(2.0) < 1.0)].map(|c| (c * light) as u8)
    };
    let inside = |x: u32, y: u32| boxes.iter().rev().find(|(xs, ys, _)| xs.contains(&x) && ys.contains(&y));
    let pixel =
        |x: u32, y: u32| inside(x, y).map_or_else(|| wall(x, y), |(.., d)| [(d * 250.0) as u8, (x * 3 % 256) as u8, (y * 2 % 256) as u8]);
    let delta = |x: u32, y: u32| inside(x, y).map_or_else(|| 0.35 - 0.1 * x as f32 / width as f32, |(.., d)| *d as f32);
    Scene {
        photo: Photo::from_fn(width, height, pixel),
        delta: DisparityMap::from_fn(width, height, delta),
        wall: Photo::from_fn(width, height, wall).rgb,
    }
}

fn errors(a: &DisparityMap, b: &DisparityMap) -> Vec<f32> {
    a.delta.iter().zip(&b.delta).map(|(a, b)| (a - b).abs()).collect()
}

fn mean(values: &[f32]) -> f32 {
    values.iter().sum::<f32>() / values.len() as f32
}

/// Runs the denoising stage with Θ.
fn denoised(models: &Models, photo: &Photo, map: &DisparityMap) -> WeightedDisparity {
    let (limits, options) = (Limits::default(), Options { denoise: Denoise::Theta, ..Options::default() });
    let mut job = Context::new(models, &limits, &options, &Silent);
    stages::remove_noise(&mut job, photo, WeightedDisparity { delta: map.clone(), confidence: None, given: true }).unwrap()
}

#[test]
fn theta_removes_noise_and_its_confidence_predicts_errors() {
    let Some(models) = models() else { return };
    let Scene { photo, delta: clean, .. } = scene(1);
    let noisy =
        DisparityMap { delta: clean.delta.iter().enumerate().map(|(i, d)| (d + NOISE * normal(i)).clamp(0.0, 1.0)).collect(), ..clean };
    let got = denoised(&models, &photo, &noisy);
    let (before, after) = (errors(&noisy, &clean), errors(&got.delta, &clean));
    assert!(mean(&after) < 0.25 * mean(&before), "{} of {}", mean(&after), mean(&before));
    // a box stays a box
    let row = &got.delta.delta[90 * SIZE.0 as usize..][..SIZE.0 as usize];
    assert!(row[62] - row[57] > 0.2, "{} {}", row[57], row[62]);
    // the least confident tenth of the pixels has larger errors than the most confident half
    let confidence = got.confidence.unwrap();
    assert!(confidence.iter().all(|c| *c > 0.0 && *c <= 1.0));
    let mut order: Vec<usize> = (0..confidence.len()).collect();
    order.sort_by(|a, b| confidence[*a].total_cmp(&confidence[*b]));
    let of = |pixels: &[usize]| mean(&pixels.iter().map(|i| after[*i]).collect::<Vec<_>>());
    let (least, most) = (of(&order[..order.len() / 10]), of(&order[order.len() / 2..]));
    assert!(least > 1.5 * most, "{least} at low confidence, {most} at high confidence");
}

#[test]
fn theta_leaves_a_clean_map_unchanged() {
    let Some(models) = models() else { return };
    let Scene { photo, delta: clean, .. } = scene(1);
    let got = denoised(&models, &photo, &clean);
    assert_eq!((got.delta, got.confidence), (clean, None));
}

/// The layers of a scene before and after refinement.
fn refined(models: &Models, scene: &Scene, refine: Switch) -> [Layered; 2] {
    let (limits, options) = (Limits::default(), Options { refine, ..Options::default() });
    let mut job = Context::new(models, &limits, &options, &Silent);
    let intrinsics = Intrinsics::centred(SIZE.0, SIZE.1, Intrinsics::DEFAULT_FOCAL_PER_WIDTH * f64::from(SIZE.0));
    let format = tmpi_core::container::PhotoFormat::Png;
    let mut prepared = Prepared { photo: scene.photo.clone(), intrinsics, format, uploaded: None, reduced: None, second_half: None };
    let map = WeightedDisparity { delta: scene.delta.clone(), confidence: None, given: true };
    let placed = stages::place_planes(&mut job, &prepared, &map).unwrap();
    let layered = stages::make_layers(&mut job, &mut prepared, placed, &map.delta).unwrap();
    let before = layered.clone();
    [before, stages::refine_layers(&mut job, layered).unwrap()]
}

fn shapes(layered: &Layered) -> Vec<&LayerMask> {
    layered.tiles.iter().flatten().map(|l| &l.shape).collect()
}

/// Mean difference, in levels, between the colours of hidden texels on the wall and the true wall behind the boxes.
fn wall_error(layered: &Layered, scene: &Scene) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for layer in layered.tiles.iter().flatten() {
        let shape = &layer.shape;
        let hidden = (0..shape.class.len() as u32).filter(|i| shape.class[*i as usize] == Class::Hidden as u8);
        // δ of the wall is below 0.36 everywhere, that of the boxes above
        let on_wall = shape.plane.a < 0.45;
        for (i, colour) in hidden.zip(&layer.hidden).filter(|_| on_wall) {
            let at = (shape.rect.y + i / shape.rect.w) * SIZE.0 + shape.rect.x + i % shape.rect.w;
            let truth = scene.wall[at as usize];
            sum += colour.iter().zip(truth).map(|(a, b)| f64::from(a.abs_diff(b))).sum::<f64>() / 3.0;
            count += 1.0;
        }
    }
    assert!(count > 500.0, "{count} hidden texels");
    sum / count
}

#[test]
fn psi_changes_only_hidden_texels_and_keeps_their_quality() {
    let Some(models) = models() else { return };
    let (mut before, mut after) = (0.0, 0.0);
    for seed in 0..8 {
        let scene = scene(seed);
        let [first, then] = refined(&models, &scene, Switch::On);
        assert_eq!(shapes(&then), shapes(&first));
        let counts = |l: &Layered| l.tiles.iter().flatten().map(|l| l.hidden.len()).collect::<Vec<_>>();
        assert_eq!(counts(&then), counts(&first));
        assert!(then.optional.alpha && then.optional.hidden.is_some(), "the container stores what does not follow from the photo");
        // the reference view is the photo
        let made = compose(scene.photo.clone(), &then.geometry, then.tiles.clone());
        let view = draw_reference_view(&made).unwrap();
        assert!(view.rgba.iter().zip(&scene.photo.rgb).all(|(v, p)| v[..3] == *p));
        let (was, is) = (wall_error(&first, &scene), wall_error(&then, &scene));
        before += was / 8.0;
        after += is / 8.0;
    }
    assert!(after < before * 1.01, "{before} levels off before, {after} after");
}

#[test]
fn psi_runs_only_if_switched_on() {
    let Some(models) = models() else { return };
    let scene = scene(1);
    for refine in [Switch::Auto, Switch::Off] {
        let [first, then] = refined(&models, &scene, refine);
        let colours = |l: &Layered| l.tiles.iter().flatten().flat_map(|l| l.hidden.clone()).collect::<Vec<_>>();
        assert_eq!((shapes(&then), colours(&then), then.optional), (shapes(&first), colours(&first), first.optional));
    }
}
