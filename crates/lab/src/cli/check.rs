//! `tmpi-lab check`.

use std::fmt::Write;
use std::path::PathBuf;

use super::result;
use tmpi_lab::conformance::{self, Checked, Kernel, Verdict};
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::models;

/// Check each numerical kernel on stiff and extreme cases against an f64 reference
#[derive(Clone, Debug, clap::Args)]
pub(super) struct CheckArgs {
    /// Print all cases as JSON
    #[arg(long)]
    json: bool,
    /// Instead, check what cameras at the corners of the view box see past the borders of the photos in this folder; repeatable
    #[arg(long, value_name = "DIR")]
    photos: Vec<PathBuf>,
    #[command(flatten)]
    models: ModelFlags,
}

pub(super) fn run(args: &CheckArgs) -> anyhow::Result<()> {
    // a panic is a failed case, not a message
    std::panic::set_hook(Box::new(|info| tracing::error!(%info, "a case panicked")));
    let checked = if args.photos.is_empty() {
        conformance::run()
    } else {
        conformance::run_on_photos(&args.photos, &models::load(&args.models.settings())?)
    };
    drop(std::panic::take_hook());
    result(&if args.json { serde_json::to_string_pretty(&checked)? } else { table(&checked) })?;
    let failed = checked.failed();
    anyhow::ensure!(failed == 0, "{failed} of {} cases failed", checked.cases.len());
    Ok(())
}

fn table(checked: &Checked) -> String {
    let widest = |f: &dyn Fn(&conformance::Case) -> usize| checked.cases.iter().map(f).max().unwrap_or(0);
    let name = widest(&|c| c.name.chars().count());
    let (family, subject) = (widest(&|c| c.family.len()), widest(&|c| c.subject.len()));
    let mut out = format!("{:family$}  {:name$}  {:subject$}  {:>9}  {:>9}  verdict  unit\n", "family", "case", "of", "bound", "error");
    for c in &checked.cases {
        let number = |v: f64| if v == 0.0 || (1e-3..1e4).contains(&v) { format!("{v:.3}") } else { format!("{v:.1e}") };
        let error = c.error.map_or("none".into(), number);
        let verdict = if c.verdict == Verdict::Ok { "ok" } else { "FAIL" };
        // writing to a String cannot fail
        let _ = writeln!(
            out,
            "{:family$}  {:name$}  {:subject$}  {:>9}  {error:>9}  {verdict:7}  {}",
            c.family,
            c.name,
            c.subject,
            number(c.bound),
            c.unit
        );
    }
    for s in &checked.skipped {
        let _ = writeln!(out, "skipped: {s}");
    }
    let _ = write!(out, "\n{}{} cases, {} failed", kernels(checked), checked.cases.len(), checked.failed());
    out
}

/// A line for each kernel: how many cases, how near to their bounds, how long.
fn kernels(checked: &Checked) -> String {
    let all = checked.kernels();
    let widest = |f: &dyn Fn(&Kernel) -> usize| all.iter().map(f).max().unwrap_or(0);
    let (family, subject) = (widest(&|k| k.family.len()), widest(&|k| k.subject.len()));
    let mut out = format!("{:family$}  {:subject$}  cases  failed  error/bound       ms\n", "family", "of");
    for k in &all {
        // a String takes everything
        let _ = writeln!(
            out,
            "{:family$}  {:subject$}  {:>5}  {:>6}  {:>11.2}  {:>7.0}",
            k.family, k.subject, k.cases, k.failed, k.nearest, k.ms
        );
    }
    out
}
