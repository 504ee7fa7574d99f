//! The processor's backend: parallel row bands, nearest layer first; it samples nothing behind an opaque texel.

mod band;
mod lanes;
mod reference_view;
mod span;
mod vector;

use std::cell::RefCell;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use rayon::prelude::*;

use self::band::Band;
pub(super) use self::reference_view::ReferenceView;
use self::span::Draw;
use super::scene_cache::{ExpandedScene, SceneCache};
use super::{RenderError, Renderer, View, check};
use tmpi_core::{Camera, Scene, SceneError};

/// Maximum number of pixels of a band, unless a single row has more: 16 rows of 1280 pixels stay in the second-level cache.
const BAND_PIXELS: usize = 16 * 1280;

/// Maximum number of rows of a band, so that small views still give every core work.
const BAND_ROWS: usize = 16;

thread_local! {
    /// The thread's buffers, reused from one view to the next.
    static BAND: RefCell<Band> = RefCell::default();
}

type Slot = Arc<OnceLock<Result<Arc<ExpandedScene>, SceneError>>>;

/// Draws on the processor in `f32`.
///
/// Draws the nearest layer first. A sample of alpha ≥ [`super::OPAQUE`] goes to the depth buffer. A softer one goes to its pixel's list,
/// which is sorted by disparity and composited once the band's depth is final. Caches expanded texels per scene.
#[derive(Debug)]
pub struct Cpu {
    scenes: Mutex<SceneCache<Slot>>,
    continued: bool,
}

impl Cpu {
    /// Default budget for expanded texels, in bytes (4 per texel).
    pub const CACHE_BYTES: usize = 256 << 20;

    /// Creates a backend that keeps at most `cache_bytes` of expanded texels, but always those of the last scene.
    pub fn new(cache_bytes: usize) -> Self {
        Self { scenes: Mutex::new(SceneCache::new(cache_bytes)), continued: true }
    }

    /// The same backend with a mirror image beyond the photo's borders instead of continued colours. It is faster; use it for views that you
    /// only compare with each other.
    pub fn sharp_beyond_borders(self) -> Self {
        Self { continued: false, ..self }
    }

    fn expanded(&self, scene: &Arc<Scene>) -> Result<Arc<ExpandedScene>, SceneError> {
        let slot = {
            let mut scenes = self.scenes.lock().unwrap_or_else(PoisonError::into_inner);
            let slot = scenes.get(scene).map(|slot| Arc::clone(slot));
            slot.unwrap_or_else(|| Arc::clone(scenes.insert(scene, ExpandedScene::bytes(scene), Slot::default)))
        };
        // outside the lock: other scenes can proceed, and several views of a new scene expand it once
        slot.get_or_init(|| ExpandedScene::new(scene, self.continued).map(Arc::new)).clone()
    }
}

/// Draws the view from the photo's own position, even if it differs from the photo. Caches nothing of the scene.
///
/// # Errors
/// [`RenderError::Scene`].
pub fn draw_reference_view(scene: &Scene) -> Result<View, RenderError> {
    Ok(draw(scene, &ExpandedScene::for_reference_view(scene)?, &reference_view::reference_camera(scene)))
}

impl Default for Cpu {
    fn default() -> Self {
        Self::new(Self::CACHE_BYTES)
    }
}

impl Renderer for Cpu {
    fn name(&self) -> &'static str {
        "cpu"
    }

    fn render(&self, scene: &Arc<Scene>, camera: &Camera) -> Result<View, RenderError> {
        check(camera)?;
        let expanded = self.expanded(scene)?;
        let reference = expanded.reference.view(scene, camera, |own| draw(scene, &expanded, own));
        Ok(reference.unwrap_or_else(|| draw(scene, &expanded, camera)))
    }

    fn free_dropped_scenes(&self) {
        self.scenes.lock().unwrap_or_else(PoisonError::into_inner).remove_dropped_scenes();
    }
}

fn draw(scene: &Scene, expanded: &ExpandedScene, camera: &Camera) -> View {
    let draws: Vec<Draw> =
        expanded.order.iter().filter_map(|&i| Draw::new(scene, &expanded.pieces[i], expanded.first[i], camera)).collect();
    let mut view = View::transparent(camera);
    let width = camera.width as usize;
    let rows = (BAND_PIXELS / width).clamp(1, BAND_ROWS);
    view.rgba.par_chunks_mut(width * rows).enumerate().for_each(|(i, out)| {
        BAND.with_borrow_mut(|band| band.draw(&draws, &expanded.texels, (i * rows) as u32, width, out));
    });
    view
}
