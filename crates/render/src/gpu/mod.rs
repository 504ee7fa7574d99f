//! The graphics adapter's backend: runs the browser's WGSL through wgpu on its own thread.

mod device;
mod frame;
mod scene;
mod texture_atlas;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, mpsc};

use self::device::Device;
use self::frame::Target;
use self::scene::{Loaded, Plan};
use super::scene_cache::SceneCache;
use super::{RenderError, Renderer, View, check};
use tmpi_core::{Camera, Scene};

/// Draws with a graphics adapter.
///
/// One named thread owns the device. Calls queue for it and block until their view is ready. After an error, the thread drops the device,
/// and the next call opens a new one. Atlases of recently drawn scenes stay in graphics memory.
#[derive(Debug)]
pub struct Gpu {
    /// `None` only during drop.
    jobs: Option<mpsc::SyncSender<Job>>,
    thread: Option<std::thread::JoinHandle<()>>,
}

/// Stops Mesa's adapter selection layer from looking for a Wayland display if there is none: the layer complains on standard error, and
/// this program selects the adapter itself. If you set `MESA_VK_DEVICE_SELECT`, your selection stays.
///
/// # Safety
/// Same as [`std::env::set_var`]: no other thread may be running.
#[allow(unsafe_code, clippy::disallowed_methods, reason = "the layer reads it from the environment alone; called before any thread")]
pub unsafe fn without_a_display() {
    let named = |name: &str| std::env::var_os(name).is_some();
    if !named("XDG_RUNTIME_DIR") && !named("MESA_VK_DEVICE_SELECT") {
        // SAFETY: guaranteed by this function's own condition
        unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    }
}

/// Work for the thread that owns the device.
type Job = Box<dyn FnOnce(&mut Worker) + Send>;

impl Gpu {
    /// Maximum number of views that wait for the device; further callers wait for a place in the queue.
    pub const QUEUE: usize = 8;

    /// Budget for atlases in graphics memory, in bytes; a scene that alone needs more is refused.
    pub const POOL_BYTES: usize = 512 << 20;

    /// Opens the best adapter; a software adapter counts only if `software` is true.
    ///
    /// # Errors
    /// [`RenderError::Adapter`] if there is no adapter.
    pub fn new(software: bool) -> Result<Self, RenderError> {
        let (jobs, queue) = mpsc::sync_channel(Self::QUEUE);
        let worker = Worker { software, state: None };
        let thread = std::thread::Builder::new()
            .name("tmpi-gpu".into())
            .spawn(move || worker.run(&queue))
            .map_err(|e| RenderError::Adapter(format!("starting its thread: {e}")))?;
        let gpu = Self { jobs: Some(jobs), thread: Some(thread) };
        gpu.ask(|worker| worker.guarded(|_| Ok(())))?;
        Ok(gpu)
    }

    /// Runs `work` on the device's thread.
    fn ask<T: Send + 'static>(&self, work: impl FnOnce(&mut Worker) -> Result<T, RenderError> + Send + 'static) -> Result<T, RenderError> {
        let ended = |_| RenderError::Adapter("its thread has ended".into());
        let (reply, answer) = mpsc::sync_channel(1);
        // sending fails only if the caller has gone away
        let job: Job = Box::new(move |worker: &mut Worker| drop(reply.send(work(worker))));
        self.jobs.as_ref().and_then(|jobs| jobs.send(job).ok()).ok_or_else(|| ended(mpsc::RecvError))?;
        answer.recv().map_err(ended)?
    }
}

impl Drop for Gpu {
    /// Waits until the device is closed: if the driver is unloaded while the process ends, the process crashes.
    fn drop(&mut self) {
        self.jobs = None;
        // a panic of the thread was already reported to its caller
        self.thread.take().map(std::thread::JoinHandle::join);
    }
}

impl Renderer for Gpu {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn render(&self, scene: &Arc<Scene>, camera: &Camera) -> Result<View, RenderError> {
        check(camera)?;
        let (scene, camera) = (Arc::clone(scene), *camera);
        self.ask(move |worker| worker.guarded(|state| state.render(&scene, &camera)))
    }

    fn free_dropped_scenes(&self) {
        // if the thread has ended, nothing is kept
        let _ = self.ask(|worker| {
            if let Some(State { scenes, device, .. }) = &mut worker.state {
                scenes.remove_dropped_scenes();
                // wgpu frees dropped resources when the device is polled
                let _ = device.handle.poll(wgpu::PollType::Poll);
            }
            Ok(())
        });
    }
}

struct State {
    scenes: SceneCache<Loaded>,
    target: Option<Target>,
    device: Device,
}

struct Worker {
    software: bool,
    state: Option<State>,
}

impl Worker {
    fn run(mut self, queue: &mpsc::Receiver<Job>) {
        while let Ok(job) = queue.recv() {
            job(&mut self);
        }
    }

    /// Runs `work` on an open device. After a device error, drops the device, so that the next call opens a new one.
    fn guarded<T>(&mut self, work: impl FnOnce(&mut State) -> Result<T, RenderError>) -> Result<T, RenderError> {
        let software = self.software;
        let state = &mut self.state;
        let caught = catch_unwind(AssertUnwindSafe(|| {
            let state = match state {
                Some(state) => state,
                None => state.insert(State::open(software)?),
            };
            work(state)
        }));
        let result = caught.unwrap_or_else(|_| Err(RenderError::Adapter("the graphics library panicked".into())));
        if let Err(error @ RenderError::Adapter(_)) = &result {
            // if opening failed, there is no device to drop
            if self.state.take().is_some() {
                tracing::warn!(%error, "the graphics device is dropped");
            }
        }
        result
    }
}

impl State {
    fn open(software: bool) -> Result<Self, RenderError> {
        Ok(Self { scenes: SceneCache::new(Gpu::POOL_BYTES), target: None, device: Device::open(software)? })
    }

    fn render(&mut self, scene: &Arc<Scene>, camera: &Camera) -> Result<View, RenderError> {
        let Self { scenes, target, device } = self;
        let loaded = if let Some(loaded) = scenes.get(scene) {
            loaded
        } else {
            let plan = Plan::new(scene, &device.limits)?;
            let bytes = plan.bytes();
            if bytes > Gpu::POOL_BYTES {
                return Err(RenderError::TooLarge(format!("{bytes} bytes of atlas; at most {} are taken", Gpu::POOL_BYTES)));
            }
            scenes.insert(scene, bytes, || plan.load(scene, device))
        };
        if target.as_ref().is_none_or(|t| !t.fits(camera, loaded.wide)) {
            // drops the old target first, so that both never take memory at once
            *target = None;
            *target = Some(Target::new(device, camera, loaded.wide)?);
        }
        match target {
            Some(target) => target.draw(device, scene, loaded, camera),
            None => Err(RenderError::Adapter("no target".into())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing;
    use super::*;
    use tmpi_core::Pose;
    use tmpi_testing::Need;

    #[test]
    fn a_lost_device_is_an_error_once_and_then_rebuilt() {
        let Some(gpu) = Need::Gpu.or_skip(Gpu::new(true)) else { return };
        let lose = |worker: &mut Worker| {
            worker.guarded(|state| {
                state.device.handle.destroy();
                Ok(())
            })
        };
        let scene = Arc::new(testing::flat(8, 8, 0.5));
        let camera = Camera { pose: Pose::default(), intrinsics: scene.intrinsics, width: 8, height: 8 };
        let before = gpu.render(&scene, &camera).unwrap();
        gpu.ask(lose).unwrap();
        assert!(matches!(gpu.render(&scene, &camera), Err(RenderError::Adapter(_))));
        assert_eq!(gpu.render(&scene, &camera).unwrap(), before);
        gpu.ask(lose).unwrap();
        let auto = super::super::GpuOrCpu { gpu, cpu: super::super::Cpu::default() };
        assert_eq!(auto.render(&scene, &camera).unwrap(), before, "meanwhile cpu serves");
    }

    #[test]
    fn a_scene_beyond_the_pool_is_refused_with_its_size() {
        let Some(gpu) = Need::Gpu.or_skip(Gpu::new(true)) else { return };
        let count = Gpu::POOL_BYTES / (2048 * 2048 * 4) + 1;
        let mut scene = testing::flat(2048, 2048, 0.5);
        let texels = 2048 * 2048;
        scene.layers = (0..count).map(|i| tmpi_core::Layer { first_texel: i * texels, ..scene.layers[0] }).collect();
        scene.texels.class = vec![1; count * texels];
        scene.texels.alpha = vec![255; count * texels];
        let camera = Camera { pose: Pose::default(), intrinsics: scene.intrinsics, width: 8, height: 8 };
        let error = gpu.render(&Arc::new(scene), &camera).unwrap_err();
        assert!(matches!(&error, RenderError::TooLarge(text) if text.contains("bytes")), "{error}");
    }
}
