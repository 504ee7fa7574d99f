//! Stiff and extreme cases: every numerical kernel against a plain `f64` reference, each case with the bound that it must hold
//! and the error that it has (DESIGN, section 7).

mod border_colours_reference;
mod clustering;
mod colours;
mod compositing;
mod error_target;
#[cfg(test)]
mod faults;
mod levels;
mod live_depth;
mod live_motion;
mod map_filters;
mod matting;
mod photos;
mod quantisation;
mod raycast;
mod readers;
mod reference;
pub mod scenes;
mod stereo;
mod view_box_corners;
mod views;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;

pub use raycast::{cast, cast_in_layer_order};
use tmpi_render::{Cpu, Gpu, Reference, Renderer};
pub use view_box_corners::run_on_photos;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// The error is within the bound.
    Ok,
    /// It is not, or the code under test panicked.
    Fail,
}

#[derive(Clone, Debug, Serialize)]
pub struct Case {
    pub family: &'static str,
    /// What is stiff or extreme about it.
    pub name: String,
    /// The kernel or the renderer under test.
    pub subject: &'static str,
    /// What `error` and `bound` count.
    pub unit: &'static str,
    pub bound: f64,
    /// Error found; none where the code under test panicked or gave something that is no number.
    pub error: Option<f64>,
    pub verdict: Verdict,
    /// Milliseconds since the case before it, with what was prepared for it.
    pub ms: f64,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Kernel {
    pub family: &'static str,
    pub subject: &'static str,
    pub cases: usize,
    pub failed: usize,
    /// The error that came nearest to its bound, as a share of that; infinite where there is none.
    pub nearest: f64,
    pub ms: f64,
}

#[derive(Clone, Debug, Default, Serialize)]
pub struct Checked {
    /// All cases, family by family.
    pub cases: Vec<Case>,
    /// What could not be checked, and why.
    pub skipped: Vec<String>,
    /// When the last case ended.
    #[serde(skip)]
    last: Option<Instant>,
}

impl Checked {
    pub fn failed(&self) -> usize {
        self.cases.iter().filter(|c| c.verdict == Verdict::Fail).count()
    }

    /// The cases by kernel, in the order in which they ran.
    pub fn kernels(&self) -> Vec<Kernel> {
        let mut kernels: Vec<Kernel> = Vec::new();
        for case in &self.cases {
            let Case { family, subject, .. } = *case;
            let at = kernels.iter().position(|k| (k.family, k.subject) == (family, subject)).unwrap_or(kernels.len());
            if at == kernels.len() {
                kernels.push(Kernel { family, subject, cases: 0, failed: 0, nearest: 0.0, ms: 0.0 });
            }
            let kernel = &mut kernels[at];
            kernel.cases += 1;
            kernel.failed += usize::from(case.verdict == Verdict::Fail);
            kernel.ms += case.ms;
            let share = case.error.map_or(f64::INFINITY, |e| if e > 0.0 { e / case.bound } else { 0.0 });
            kernel.nearest = kernel.nearest.max(share);
        }
        kernels
    }

    /// Runs `work` for a case and notes its error; a panic is a failure.
    fn case(
        &mut self,
        family: &'static str,
        name: &str,
        subject: &'static str,
        unit: &'static str,
        bound: f64,
        work: impl FnOnce() -> f64,
    ) {
        let start = Instant::now();
        let error = catch_unwind(AssertUnwindSafe(work)).ok().filter(|e| e.is_finite());
        let verdict = if error.is_some_and(|e| e <= bound) { Verdict::Ok } else { Verdict::Fail };
        let ms = self.last.replace(Instant::now()).unwrap_or(start).elapsed().as_secs_f64() * 1e3;
        self.cases.push(Case { family, name: name.into(), subject, unit, bound, error, verdict, ms });
    }
}

/// The largest error; infinite where one is no number.
fn largest(errors: impl Iterator<Item = f64>) -> f64 {
    errors.fold(0.0, |most, error| if error.is_nan() { f64::INFINITY } else { most.max(error) })
}

/// A renderer to check.
type Host = Arc<dyn Renderer>;

/// The renderers that can be checked here: `reference`, `cpu`, and `gpu` on whatever adapter there is.
fn hosts(skipped: &mut Vec<String>) -> Vec<Host> {
    let mut all: Vec<Host> = vec![Arc::new(Reference), Arc::new(Cpu::default())];
    match Gpu::new(true) {
        Ok(gpu) => all.push(Arc::new(gpu)),
        Err(reason) => skipped.push(format!("gpu: {reason}")),
    }
    all
}

pub fn run() -> Checked {
    let mut checked = Checked::default();
    let hosts = hosts(&mut checked.skipped);
    clustering::run(&mut checked);
    error_target::run(&mut checked);
    map_filters::run(&mut checked);
    stereo::run(&mut checked);
    live_depth::run(&mut checked);
    live_motion::run(&mut checked);
    colours::run(&mut checked);
    readers::run(&mut checked);
    matting::run(&mut checked);
    levels::run(&mut checked);
    views::run(&mut checked, &hosts);
    compositing::run(&mut checked, &hosts);
    photos::run(&mut checked, &hosts);
    quantisation::run(&mut checked, &hosts);
    view_box_corners::disc(&mut checked, |scene| scene);
    checked
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_case_holds_its_bound() {
        let checked = run();
        let _ = tmpi_testing::Need::Gpu.or_skip(if checked.skipped.is_empty() { Ok(()) } else { Err(checked.skipped.join("; ")) });
        let bad: Vec<&Case> = checked.cases.iter().filter(|c| c.verdict == Verdict::Fail).collect();
        assert!(bad.is_empty(), "{bad:#?}");
        let unproven: Vec<_> = checked.kernels().into_iter().filter(|k| !faults::covers(k)).map(|k| (k.family, k.subject)).collect();
        assert!(unproven.is_empty(), "no planted fault for {unproven:?}");
    }

    #[test]
    fn an_error_beyond_its_bound_nan_and_a_panic_fail() {
        let mut c = Checked::default();
        c.case("f", "within", "s", "u", 1.0, || 1.0);
        c.case("f", "beyond", "s", "u", 1.0, || 1.01);
        c.case("f", "nan", "s", "u", 1.0, || f64::NAN);
        c.case("f", "panic", "s", "u", 1.0, || panic!("on purpose"));
        assert_eq!(c.cases.iter().map(|c| c.verdict == Verdict::Ok).collect::<Vec<_>>(), [true, false, false, false]);
        assert_eq!(c.failed(), 3);
        let [kernel] = c.kernels().try_into().unwrap();
        assert_eq!((kernel.cases, kernel.failed, kernel.nearest), (4, 3, f64::INFINITY));
        assert!(kernel.ms >= 0.0 && kernel.ms < 1e3);
    }
}
