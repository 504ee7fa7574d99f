//! The backend without a graphics adapter: row bands in parallel, nearest layer first, nothing sampled behind an opaque texel.

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
use super::scene_cache::{Prepared, SceneCache};
use super::{RenderError, Renderer, View, check};
use tmpi_core::{Camera, Scene, SceneError};

/// Pixels of a band, at most unless a row has more: 16 rows of 1280 stay in the second-level cache.
const BAND_PIXELS: usize = 16 * 1280;

/// Most rows of a band, so that small views still give every core work.
const BAND_ROWS: usize = 16;

thread_local! {
    /// Buffers of the thread, kept from one view to the next.
    static BAND: RefCell<Band> = RefCell::default();
}

type Slot = Arc<OnceLock<Result<Arc<Prepared>, SceneError>>>;

/// Draws on the processor in `f32`.
///
/// Layers come nearest first. A sample of alpha ≥ [`super::OPAQUE`] goes to the depth buffer, a softer one to its pixel's list, sorted by
/// disparity and composited when the band's depth is final. Expanded texels are cached per scene.
#[derive(Debug)]
pub struct Cpu {
    scenes: Mutex<SceneCache<Slot>>,
    blurred: bool,
}

impl Cpu {
    /// Bytes of expanded texels that are kept (4 a texel).
    pub const CACHE_BYTES: usize = 256 << 20;

    /// A backend that keeps at most `cache_bytes` of expanded texels, and always those of the last scene.
    #[must_use]
    pub fn new(cache_bytes: usize) -> Self {
        Self { scenes: Mutex::new(SceneCache::new(cache_bytes)), blurred: true }
    }

    /// The same with a sharp mirror image beyond the photo's borders. It is quicker, for views that are only compared with each other.
    #[must_use]
    pub fn sharp_beyond_borders(self) -> Self {
        Self { blurred: false, ..self }
    }

    fn prepared(&self, scene: &Arc<Scene>) -> Result<Arc<Prepared>, SceneError> {
        let slot = {
            let mut scenes = self.scenes.lock().unwrap_or_else(PoisonError::into_inner);
            let slot = scenes.get(scene).map(|slot| Arc::clone(slot));
            slot.unwrap_or_else(|| Arc::clone(scenes.insert(scene, Prepared::bytes(scene), Slot::default)))
        };
        // outside the lock: other scenes go on, and several views of a new scene expand it once
        slot.get_or_init(|| Prepared::new(scene, self.blurred).map(Arc::new)).clone()
    }
}

/// Draws the view that is to be the photo, from its own place, whatever it turns out to be. Nothing is kept of the scene.
///
/// # Errors
/// [`RenderError::Scene`].
pub fn draw_reference_view(scene: &Scene) -> Result<View, RenderError> {
    Ok(draw(scene, &Prepared::for_reference_view(scene)?, &reference_view::reference_camera(scene)))
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
        let prepared = self.prepared(scene)?;
        let reference = prepared.reference.view(scene, camera, |own| draw(scene, &prepared, own));
        Ok(reference.unwrap_or_else(|| draw(scene, &prepared, camera)))
    }

    fn settle(&self) {
        self.scenes.lock().unwrap_or_else(PoisonError::into_inner).settle();
    }
}

fn draw(scene: &Scene, prepared: &Prepared, camera: &Camera) -> View {
    let draws: Vec<Draw> =
        prepared.order.iter().filter_map(|&i| Draw::new(scene, &prepared.pieces[i], prepared.first[i], camera)).collect();
    let mut view = View::transparent(camera);
    let width = camera.width as usize;
    let rows = (BAND_PIXELS / width).clamp(1, BAND_ROWS);
    view.rgba.par_chunks_mut(width * rows).enumerate().for_each(|(i, out)| {
        BAND.with_borrow_mut(|band| band.draw(&draws, &prepared.texels, (i * rows) as u32, width, out));
    });
    view
}
