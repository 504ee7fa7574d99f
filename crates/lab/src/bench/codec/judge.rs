//! How alike the views of two scenes are.

use std::sync::Arc;

use rayon::prelude::*;

use crate::bench::BenchError;
use crate::metrics::{Ssimulacra2, psnr};
use tmpi_core::{Camera, Pose, Scene};
use tmpi_render::{Cpu, Renderer};

/// Views of the scene before any coding.
pub struct Judge {
    cameras: Vec<Camera>,
    views: Vec<Vec<[u8; 3]>>,
    scores: Vec<Option<Ssimulacra2>>,
}

/// Means over the views, and the least.
#[derive(Clone, Copy, Debug, Default, serde::Serialize)]
pub struct Score {
    /// SSIMULACRA2, mean.
    pub ssimulacra2: f64,
    /// PSNR in dB, mean.
    pub psnr: f64,
    /// PSNR in dB of the worst view.
    pub psnr_least: f64,
}

/// Four corners of the view box that differ in two of their three coordinates.
fn cameras(scene: &Scene) -> Vec<Camera> {
    let (v, k) = (scene.view_box, scene.intrinsics);
    let (width, height) = (scene.grid.width, scene.grid.height);
    let corners = [(1.0, -1.0, 1.0), (-1.0, 1.0, 1.0), (1.0, 1.0, -1.0), (-1.0, -1.0, -1.0)];
    corners.map(|(x, y, z)| Camera { pose: Pose::at(x * v.x, y * v.y, z * v.z), intrinsics: k, width, height }).into()
}

fn views(scene: &Arc<Scene>, cameras: &[Camera]) -> Result<Vec<Vec<[u8; 3]>>, BenchError> {
    let cpu = Cpu::default();
    let draw = |c: &Camera| Ok(cpu.render(scene, c)?.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect());
    cameras.iter().map(draw).collect()
}

impl Judge {
    pub fn of(scene: &Arc<Scene>) -> Result<Self, BenchError> {
        let cameras = cameras(scene);
        let views = views(scene, &cameras)?;
        let scores = views.iter().map(|v| Ssimulacra2::of(v, scene.grid.width as usize)).collect();
        Ok(Self { cameras, views, scores })
    }

    pub fn score(&self, scene: &Arc<Scene>) -> Result<Score, BenchError> {
        let got = views(scene, &self.cameras)?;
        let each: Vec<(Option<f64>, f64)> = self
            .views
            .par_iter()
            .zip(&self.scores)
            .zip(&got)
            .map(|((want, score), got)| (score.as_ref().and_then(|s| s.score(got)), psnr(want.as_flattened(), got.as_flattened())))
            .collect();
        let n = each.len().max(1) as f64;
        Ok(Score {
            ssimulacra2: each.iter().map(|e| e.0.unwrap_or(f64::NAN)).sum::<f64>() / n,
            psnr: each.iter().map(|e| e.1).sum::<f64>() / n,
            psnr_least: each.iter().map(|e| e.1).fold(f64::INFINITY, f64::min),
        })
    }
}
