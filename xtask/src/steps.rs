//! Named steps of a task. Phases run in sequence, the lanes of a phase in parallel, and the steps of a lane in sequence.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use crate::command::{Fault, capture};

/// A named step of a task.
#[derive(Clone, Copy)]
pub struct Step {
    pub name: &'static str,
    pub run: fn() -> Result<(), Fault>,
}

/// Steps that run in sequence.
pub type Lane<'a> = &'a [Step];

/// Whether steps run after another has failed.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum AfterFailure {
    /// No lane starts another step.
    Stop,
    /// All steps run; the failures are reported at the end.
    GoOn,
}

struct Outcome {
    name: &'static str,
    seconds: f64,
    fault: Option<Fault>,
}

/// Runs phases of lanes, then prints how long each step took. If `names` is not empty, only those steps run.
///
/// The first lane of a phase prints directly. The output of a step in another lane appears when that step ends, so that lines do not mix.
///
/// # Errors
/// The faults of all failed steps, or an unknown name.
pub fn run(phases: &[&[Lane]], names: &[String], after: AfterFailure) -> Result<(), Fault> {
    let all: Vec<&str> = phases.iter().flat_map(|lanes| lanes.iter().flat_map(|steps| steps.iter().map(|s| s.name))).collect();
    if let Some(unknown) = names.iter().find(|n| !all.contains(&n.as_str())) {
        return Err(Fault::new(format!("unknown step {unknown:?}; expected one of {}", all.join(", "))));
    }
    let start = Instant::now();
    let failed = AtomicBool::new(false);
    let outcomes: Vec<Outcome> = phases.iter().flat_map(|lanes| run_lanes(lanes, names, &failed, after)).collect();
    println!();
    for outcome in &outcomes {
        let word = if outcome.fault.is_some() { "FAILED" } else { "ok" };
        println!("{:<24} {word:<7} {:7.1} s", outcome.name, outcome.seconds);
    }
    println!("{:<24} {:<7} {:7.1} s", "all", "", start.elapsed().as_secs_f64());
    let faults: Vec<String> = outcomes.into_iter().filter_map(|o| Some(o.fault?.in_step(o.name).to_string())).collect();
    if faults.is_empty() { Ok(()) } else { Err(Fault::new(faults.join("\n\n"))) }
}

fn run_lanes(lanes: &[Lane], names: &[String], failed: &AtomicBool, after: AfterFailure) -> Vec<Outcome> {
    std::thread::scope(|scope| {
        let threads: Vec<_> =
            lanes.iter().enumerate().map(|(lane, steps)| scope.spawn(move || run_lane(steps, names, lane == 0, failed, after))).collect();
        threads.into_iter().flat_map(|t| t.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    })
}

fn run_lane(steps: &[Step], names: &[String], is_first: bool, failed: &AtomicBool, after: AfterFailure) -> Vec<Outcome> {
    let mut outcomes = Vec::new();
    for step in steps.iter().filter(|s| names.is_empty() || names.iter().any(|n| n == s.name)) {
        if after == AfterFailure::Stop && failed.load(Ordering::Relaxed) {
            break;
        }
        let start = Instant::now();
        let fault = if is_first {
            println!("── {}", step.name);
            (step.run)().err()
        } else {
            let (result, output) = capture(step.run);
            println!("── {}\n{}", step.name, output.trim_end());
            result.err()
        };
        failed.fetch_or(fault.is_some(), Ordering::Relaxed);
        outcomes.push(Outcome { name: step.name, seconds: start.elapsed().as_secs_f64(), fault });
    }
    outcomes
}
