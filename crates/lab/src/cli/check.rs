//! `tmpi-lab check`.

use std::path::PathBuf;

use super::result;
use crate::conformance::{self, Case, Checked, Kernel, Verdict};
use crate::table::table;
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
    result(&if args.json { serde_json::to_string_pretty(&checked)? } else { text(&checked) })?;
    let failed = checked.failed();
    anyhow::ensure!(failed == 0, "{failed} of {} cases failed", checked.cases.len());
    Ok(())
}

fn text(checked: &Checked) -> String {
    let number = |v: f64| if v == 0.0 || (1e-3..1e4).contains(&v) { format!("{v:.3}") } else { format!("{v:.1e}") };
    let case = |c: &Case| {
        let verdict = if c.verdict == Verdict::Ok { "ok" } else { "FAIL" };
        let error = c.error.map_or("none".into(), number);
        vec![c.family.into(), c.name.clone(), c.subject.into(), verdict.into(), c.unit.into(), number(c.bound), error]
    };
    let cases = table(5, &["family", "case", "of", "verdict", "unit", "bound", "error"], checked.cases.iter().map(case));
    let skipped: String = checked.skipped.iter().map(|s| ["skipped: ", s, "\n"].concat()).collect();
    // for each kernel: how many cases, how near to their bounds, how long
    let kernel = |k: &Kernel| {
        let [cases, failed] = [k.cases, k.failed].map(|n| n.to_string());
        vec![k.family.into(), k.subject.into(), cases, failed, format!("{:.2}", k.nearest), format!("{:.0}", k.ms)]
    };
    let kernels = table(2, &["family", "of", "cases", "failed", "error/bound", "ms"], checked.kernels().iter().map(kernel));
    format!("{cases}{skipped}\n{kernels}{} cases, {} failed", checked.cases.len(), checked.failed())
}
