//! Makers of photos, and a renderer, that a test can hold.

use std::sync::atomic::AtomicUsize;
use std::sync::{Condvar, Mutex};

use tmpi::server::{HeadOf, PipelineMaker};
use tmpi_core::{Camera, DisparityMap, Photo, Scene};
use tmpi_pipeline::depth::Estimator;
use tmpi_pipeline::{Models, Progress, photo};
use tmpi_render::{RenderError, Renderer};

use crate::prelude::*;

/// A network whose disparity grows towards the bottom, as in most photos.
pub fn ramp() -> impl Estimator {
    ("ramp", |photo: &Photo| Ok(DisparityMap::from_fn(photo.width, photo.height, |_, y| (y + 1) as f32 / photo.height as f32)))
}

/// A depth network that estimates the red channel of a photo.
pub fn bright() -> impl Estimator {
    ("bright", |photo: &Photo| Ok(DisparityMap::from_fn(photo.width, photo.height, |x, y| f32::from(photo.at(x, y)[0]) / 255.0)))
}

/// This depth network alone.
pub fn models(depth: impl Estimator + 'static) -> Models {
    Models { depth: Arc::new(depth), theta: None, psi: None }
}

/// The real pipeline with a ramp as depth network.
pub fn pipeline() -> PipelineMaker {
    way_within(Limits::default().photo())
}

/// The same with other limits.
pub fn way_within(limits: photo::Limits) -> PipelineMaker {
    PipelineMaker::new(models(ramp()), limits)
}

/// The real pipeline with a network of this name that estimates a flat wall.
pub fn with_network(name: &'static str) -> PipelineMaker {
    let flat = |photo: &Photo| Ok(DisparityMap::from_fn(photo.width, photo.height, |_, _| 0.5));
    PipelineMaker::new(models((name, flat)), Limits::default().photo())
}

/// The real pipeline behind a gate.
pub struct Gate {
    inner: PipelineMaker,
    open: Mutex<usize>,
    changed: Condvar,
    pub started: AtomicUsize,
    pub finished: AtomicUsize,
}

impl Gate {
    /// A gate that lets `n` photos through.
    pub fn new(n: usize) -> Arc<Self> {
        Arc::new(Self {
            inner: pipeline(),
            open: Mutex::new(n),
            changed: Condvar::new(),
            started: AtomicUsize::new(0),
            finished: AtomicUsize::new(0),
        })
    }

    /// Lets `n` more through.
    pub fn open(&self, n: usize) {
        *self.open.lock().unwrap() += n;
        self.changed.notify_all();
    }

    pub fn wait_started(&self, n: usize) {
        wait_until("a job starts", || self.started.load(Ordering::SeqCst) >= n);
    }
}

impl Maker for Gate {
    fn check(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> Result<(), MakeError> {
        self.inner.check(photo, depth, options)
    }

    fn check_head(&self, of: HeadOf<'_>, head: &[u8]) -> Result<Option<usize>, MakeError> {
        self.inner.check_head(of, head)
    }

    fn memory(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> u64 {
        self.inner.memory(photo, depth, options)
    }

    fn make(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, Fault> {
        self.started.fetch_add(1, Ordering::SeqCst);
        sink.progress(&Progress { stage: "photo", step: 1, steps: 9, elapsed_ms: 0.0 });
        let mut open = self.open.lock().unwrap();
        while *open == 0 {
            if sink.cancelled() {
                return Err(Fault::Cancelled);
            }
            open = self.changed.wait_timeout(open, Duration::from_millis(5)).unwrap().0;
        }
        *open -= 1;
        drop(open);
        let product = self.inner.make(photo, depth, options, sink)?;
        self.finished.fetch_add(1, Ordering::SeqCst);
        Ok(product)
    }
}

/// A maker from a closure.
pub struct Does<F>(pub F);

impl<F> Maker for Does<F>
where
    F: Fn(&[u8], &dyn Sink) -> Result<Product, Fault> + Send + Sync + 'static,
{
    fn check(&self, _: &[u8], _: Option<&[u8]>, _: &Options) -> Result<(), MakeError> {
        Ok(())
    }

    fn make(&self, photo: &[u8], _: Option<&[u8]>, _: &Options, sink: &dyn Sink) -> Result<Product, Fault> {
        (self.0)(photo, sink)
    }
}

/// Fails with each of `faults` in turn, then makes photos.
pub fn failing(faults: Vec<Fault>) -> Arc<dyn Maker> {
    let faults = Mutex::new(faults.into_iter());
    Arc::new(Does(move |photo: &[u8], sink: &dyn Sink| match faults.lock().unwrap().next() {
        Some(fault) => Err(fault),
        None => Maker::make(&pipeline(), photo, None, &Options::default(), sink),
    }))
}

/// Returns plain views at once; those that are [`SlowDrawing::HELD`] pixels wide wait until it is opened.
#[derive(Default)]
pub struct SlowDrawing {
    open: Mutex<bool>,
    changed: Condvar,
    pub begun: AtomicUsize,
    pub held: AtomicUsize,
}

impl SlowDrawing {
    pub const HELD: u32 = 77;

    pub fn open(&self) {
        *self.open.lock().unwrap() = true;
        self.changed.notify_all();
    }
}

impl Renderer for SlowDrawing {
    fn name(&self) -> &'static str {
        "slow"
    }

    fn render(&self, _: &Arc<Scene>, camera: &Camera) -> Result<View, RenderError> {
        self.begun.fetch_add(1, Ordering::SeqCst);
        if camera.width == Self::HELD {
            self.held.fetch_add(1, Ordering::SeqCst);
            let guard = self.changed.wait_while(self.open.lock().unwrap(), |open| !*open).unwrap();
            drop(guard);
            self.held.fetch_sub(1, Ordering::SeqCst);
        }
        std::thread::sleep(Duration::from_millis(5));
        Ok(View { width: camera.width, height: camera.height, rgba: vec![[9; 4]; (camera.width * camera.height) as usize] })
    }
}
