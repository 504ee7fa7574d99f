//! Draws a scene for a camera (paper, algorithm 1) with three backends, which tests compare with each other.

mod animation;
mod border;
mod cpu;
pub mod difference;
mod encode;
mod gpu;
mod layer_footprint;
mod motion_range;
mod mpo;
mod multiview;
mod reference;
mod scene_cache;
#[cfg(test)]
mod testing;

pub use animation::{Animation, AnimationError, AnimationFormat, Path, RATE};
pub use border::{contains_pose, corners, looking_at, margin as border_margin};
pub use cpu::{Cpu, draw_reference_view};
pub use encode::{DEFAULT_QUALITY, EncodeError, PictureFormat, encode};
pub use gpu::{Gpu, without_a_display};
pub use motion_range::MotionRange;
pub use multiview::{Arrangement, EYE_DISTANCE, MAX_QUILT, Rig, StereoLayout, draw_multiview};
pub use reference::Reference;

use std::sync::Arc;

use tmpi_core::{Camera, Scene, SceneError};

/// Near plane: backends draw nothing that is closer to the camera. In units of the photo's nearest distance; depth 1 of the depth buffer. A
/// power of two, so that `f32` rounds neither this distance nor the step that leads there: every backend draws a surface at exactly this
/// distance.
pub const NEAR: f64 = 1.0 / 1024.0;

/// Minimum sampled alpha of a texel that `cpu` and `gpu` treat as opaque.
pub const OPAQUE: f32 = 0.99;

/// Maximum width or height of a view, in pixels.
pub const MAX_SIDE: u32 = 16_384;

/// Maximum number of pixels of a view.
pub const MAX_PIXELS: u64 = 1 << 26;

/// The backend to draw with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// `gpu` where there is a hardware adapter, else `cpu`.
    #[default]
    Auto,
    /// wgpu with the WGSL that the browser uses.
    Gpu,
    /// Row bands in parallel, front to back.
    Cpu,
    /// `f64`, all samples of a pixel sorted.
    Reference,
}

/// Why a backend drew nothing.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The camera is invalid; the text names the field.
    #[error("camera: {0}")]
    Camera(&'static str),
    /// The scene is invalid.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// There is no graphics adapter, or the device was lost and could not be rebuilt.
    #[error("graphics adapter: {0}")]
    Adapter(String),
    /// Nobody waits for the view any more.
    #[error("the view is not wanted any more")]
    Cancelled,
    /// The scene exceeds the adapter's limits.
    #[error("the scene does not fit the graphics adapter: {0}")]
    TooLarge(String),
}

/// A drawn view.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct View {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Premultiplied RGBA, row-major. Alpha is below 255 where the scene has no content; no camera of the view box sees such a pixel.
    pub rgba: Vec<[u8; 4]>,
}

impl View {
    /// A fully transparent view of `camera`'s size.
    fn transparent(camera: &Camera) -> Self {
        let pixels = camera.width as usize * camera.height as usize;
        Self { width: camera.width, height: camera.height, rgba: vec![[0; 4]; pixels] }
    }
}

/// A backend that draws scenes.
pub trait Renderer: Send + Sync {
    /// The backend's name: `gpu`, `cpu` or `reference`.
    fn name(&self) -> &'static str;

    /// Draws `scene` for `camera`.
    ///
    /// # Errors
    /// [`RenderError`].
    fn render(&self, scene: &Arc<Scene>, camera: &Camera) -> Result<View, RenderError>;

    /// Frees the cached data of scenes that were dropped; otherwise the next view frees it. May wait until a view in progress is drawn.
    fn settle(&self) {}
}

/// Checks what every backend relies on: a finite pose, valid intrinsics, and a size within [`MAX_SIDE`] and [`MAX_PIXELS`].
fn check(camera: &Camera) -> Result<(), RenderError> {
    let (w, h) = (camera.width, camera.height);
    if !camera.pose.is_finite() {
        return Err(RenderError::Camera("pose must be finite"));
    }
    if !camera.intrinsics.is_valid() {
        return Err(RenderError::Camera("intrinsics must be finite, focal lengths above 0"));
    }
    if w == 0 || h == 0 || w > MAX_SIDE || h > MAX_SIDE || u64::from(w) * u64::from(h) > MAX_PIXELS {
        return Err(RenderError::Camera("width and height must be 1 to 16384, and at most 67108864 pixels together"));
    }
    Ok(())
}

/// Opens the backend for `backend`. A software adapter counts only if you ask for `gpu` by name.
///
/// # Errors
/// [`RenderError::Adapter`] if you ask for `gpu` and there is no adapter.
pub fn select(backend: Backend) -> Result<Arc<dyn Renderer>, RenderError> {
    select_with_cache(backend, Cpu::CACHE_BYTES)
}

/// Like [`select`], but keeps at most `cache_bytes` of expanded texels in main memory.
///
/// # Errors
/// As [`select`].
pub fn select_with_cache(backend: Backend, cache_bytes: usize) -> Result<Arc<dyn Renderer>, RenderError> {
    let cpu = || Cpu::new(cache_bytes);
    match backend {
        Backend::Reference => Ok(Arc::new(Reference)),
        Backend::Cpu => Ok(Arc::new(cpu())),
        Backend::Gpu => Ok(Arc::new(Gpu::new(true)?)),
        Backend::Auto => match Gpu::new(false) {
            Ok(gpu) => Ok(Arc::new(GpuOrCpu { gpu, cpu: cpu() })),
            Err(reason) => {
                tracing::info!(%reason, "drawing on the processor");
                Ok(Arc::new(cpu()))
            }
        },
    }
}

/// Draws with `gpu`, or with `cpu` if `gpu` cannot: the scene or the view is too large, or the device was lost.
struct GpuOrCpu {
    gpu: Gpu,
    cpu: Cpu,
}

impl Renderer for GpuOrCpu {
    fn name(&self) -> &'static str {
        self.gpu.name()
    }

    fn render(&self, scene: &Arc<Scene>, camera: &Camera) -> Result<View, RenderError> {
        match self.gpu.render(scene, camera) {
            Err(RenderError::Adapter(_) | RenderError::TooLarge(_)) => self.cpu.render(scene, camera),
            result => result,
        }
    }

    fn settle(&self) {
        self.gpu.settle();
        self.cpu.settle();
    }
}
