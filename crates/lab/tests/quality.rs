//! Compares results with recorded values, so that a loss of quality anywhere between map and view fails.
//!
//! `TMPI_BLESS=quality cargo test --release -p tmpi-lab --test quality` records the values of this version.
#![allow(clippy::unwrap_used, reason = "test")]

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use image::ExtendedColorType;
use serde::{Deserialize, Serialize};
use tmpi_core::container::decode;
use tmpi_core::{Camera, DisparityMap, Pose, ViewBox};
use tmpi_lab::metrics::psnr;
use tmpi_lab::oracle_depth::{self, oracle};
use tmpi_lab::scenes::Scene;
use tmpi_pipeline::depth::halved;
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::{Made, Models, Options, Silent, Switch, make};
use tmpi_render::{Cpu, Renderer};
use tmpi_testing::pictures;

const SIZE: (u32, u32) = (320, 208);
/// Seeds that were not used for training or tuning, and the kind of their maps.
const SCENES: [(u64, Map); 4] = [(920_001, Map::Exact), (920_002, Map::Blurred), (920_003, Map::Noisy), (920_004, Map::Exact)];
/// Half extents of the view box, and the views' distance from its centre.
const BOX: f64 = 0.06;
/// Tolerated change of bytes, as a fraction, and of PSNR, in dB.
const BYTES: f64 = 0.01;
const DECIBELS: f64 = 0.2;

#[derive(Clone, Copy, Debug)]
enum Map {
    /// Exact, provided as a file.
    Exact,
    /// Blurred, as by a network.
    Blurred,
    /// With noise of variance 1e-3, provided as a file.
    Noisy,
}

/// Recorded values of a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Figures {
    family: String,
    planes: usize,
    bytes: usize,
    /// Mean over views from the side, from above and from nearer, dB.
    views_psnr: f64,
    identity_psnr: f64,
}

/// Adds noise: sums of twelve uniform numbers are nearly normal, and the same on every machine.
fn noisy(map: &DisparityMap) -> DisparityMap {
    let mut state = 1u64;
    let mut even = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1 << 24) as f32
    };
    let deviation = 1e-3f32.sqrt();
    let delta = map.delta.iter().map(|d| (d + deviation * ((0..12).map(|_| even()).sum::<f32>() - 6.0)).clamp(0.0, 1.0)).collect();
    DisparityMap { delta, ..*map }
}

struct Subject {
    scene: Scene,
    camera: Camera,
    file: Vec<u8>,
    given: Option<Vec<u8>>,
    models: Models,
}

fn subject(seed: u64, map: Map) -> Subject {
    let scene = Scene::framed(seed, SIZE.0, SIZE.1);
    let camera = scene.camera();
    let picture = scene.render(&camera, 3);
    let file = pictures::png(SIZE.0, SIZE.1, picture.photo.rgb.as_flattened(), ExtendedColorType::Rgb8);
    let png = |map: &DisparityMap| Some(tmpi_pipeline::depth::to_png(map).unwrap());
    let given = match map {
        Map::Exact => png(&picture.disparity),
        Map::Noisy => png(&noisy(&picture.disparity)),
        Map::Blurred => None,
    };
    let models = oracle_depth::models(oracle(halved(&picture.disparity)));
    Subject { scene, camera, file, given, models }
}

impl Subject {
    fn make(&self) -> Made {
        self.make_with(Switch::Auto)
    }

    fn make_with(&self, snap: Switch) -> Made {
        let view_box = ViewBox { x: BOX, y: BOX, z: BOX };
        let options = Options { snap, fov_x: Some(self.camera.intrinsics.fov_x(SIZE.0)), view_box, max_error: 0.5, ..Options::default() };
        make(&self.models, &Limits::default(), &self.file, self.given.as_deref(), &options, &Silent).unwrap()
    }

    fn figures(&self, made: &Made) -> Figures {
        let decoded = Arc::new(decode(&made.container).unwrap());
        let poses = [Pose::at(BOX, 0.0, 0.0), Pose::at(0.0, -BOX, 0.0), Pose::at(-BOX / 2.0, BOX / 2.0, BOX)];
        let cpu = Cpu::default();
        let view = |pose: &Pose| {
            let camera = Camera { pose: *pose, ..self.camera };
            let truth = self.scene.render(&camera, 3).photo;
            let drawn: Vec<u8> = cpu.render(&decoded, &camera).unwrap().rgba.iter().flat_map(|p| [p[0], p[1], p[2]]).collect();
            psnr(&drawn, truth.rgb.as_flattened())
        };
        Figures {
            family: self.scene.family().into(),
            planes: made.report.planes,
            bytes: made.container.len(),
            views_psnr: poses.iter().map(view).sum::<f64>() / 3.0,
            identity_psnr: made.report.error.identity_psnr,
        }
    }
}

#[test]
fn results_match_the_recorded_values() {
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/quality.json");
    let got: BTreeMap<String, Figures> = SCENES
        .map(|(seed, map)| {
            let s = subject(seed, map);
            (format!("{seed} {map:?}"), s.figures(&s.make()))
        })
        .into();
    if std::env::var("TMPI_BLESS").is_ok_and(|v| v == "quality") {
        std::fs::write(&golden, serde_json::to_string_pretty(&got).unwrap() + "\n").unwrap();
    }
    let want: BTreeMap<String, Figures> = serde_json::from_slice(&std::fs::read(&golden).unwrap()).unwrap();
    assert_eq!(got.keys().collect::<Vec<_>>(), want.keys().collect::<Vec<_>>());
    for (name, want) in &want {
        let got = &got[name];
        assert_eq!((got.planes, &got.family), (want.planes, &want.family), "{name}: {got:?}, stated {want:?}");
        assert!((got.bytes as f64 / want.bytes as f64 - 1.0).abs() <= BYTES, "{name}: {got:?}, stated {want:?}");
        for (is, stated) in [(got.views_psnr, want.views_psnr), (got.identity_psnr, want.identity_psnr)] {
            assert!((is - stated).abs() <= DECIBELS, "{name}: {got:?}, stated {want:?}");
        }
    }
}

#[test]
fn results_do_not_depend_on_threads() {
    for (seed, map) in SCENES {
        let s = subject(seed, map);
        let [one, eight] = [1, 8].map(|n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap().install(|| s.make()));
        assert!(one.container == eight.container && one.disparity == eight.disparity, "{seed}");
        assert_eq!(one.report.error, eight.report.error, "{seed}");
    }
}

/// Widening is for networks that draw things too small. These maps are blurred, but their things have their true size.
#[test]
fn widening_hardly_harms_things_of_the_right_size() {
    // `On` does not widen
    let lost = (920_001..920_009).map(|seed| {
        let s = subject(seed, Map::Blurred);
        let [without, with] = [Switch::On, Switch::Auto].map(|snap| s.figures(&s.make_with(snap)).views_psnr);
        assert!(with > without - 0.25, "{seed}: {without:.2} dB without, {with:.2} dB with widening");
        without - with
    });
    let mean = lost.sum::<f64>() / 8.0;
    assert!(mean < 0.1, "{mean:.2} dB");
}
