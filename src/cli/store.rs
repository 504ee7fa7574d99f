//! `tmpi fsck` and `tmpi gc`: the store of several nodes.

use std::time::Duration;

use anyhow::Context;

use super::{note, result};
use crate::server::{Audit, Remedy, audit};

/// Check the store that several nodes share: whether all that belongs to each photo is there; they may run meanwhile
#[derive(Clone, Debug, clap::Args)]
pub(super) struct FsckArgs {
    #[command(flatten)]
    which: Which,
    /// Mark again what waits and would never be made, as its marker is damaged or gone, and enter what the index of photos lacks
    #[arg(long)]
    mend: bool,
}

/// Remove from the store that several nodes share what nothing leads to any more; they may run meanwhile
#[derive(Clone, Debug, clap::Args)]
pub(super) struct GcArgs {
    #[command(flatten)]
    which: Which,
    /// Tell what would go, and remove nothing
    #[arg(long)]
    dry_run: bool,
}

#[derive(Clone, Debug, clap::Args)]
struct Which {
    #[arg(long, value_name = "URL", help = "The store, as `serve --store` takes it")]
    store: String,
    /// Age from which photos are overdue and leftovers are told; no upload may take as long
    #[arg(long, default_value_t = 24, value_parser = clap::value_parser!(u32).range(1..), value_name = "HOURS")]
    older_than: u32,
    /// JSON on standard output
    #[arg(long)]
    json: bool,
}

pub(super) fn fsck(args: &FsckArgs) -> anyhow::Result<()> {
    let audit = look(&args.which, if args.mend { Remedy::Mend } else { Remedy::Tell })?;
    anyhow::ensure!(audit.is_sound(), "the store {} is not as it should be", args.which.store);
    Ok(())
}

pub(super) fn gc(args: &GcArgs) -> anyhow::Result<()> {
    look(&args.which, if args.dry_run { Remedy::Tell } else { Remedy::Remove }).map(drop)
}

fn look(which: &Which, remedy: Remedy) -> anyhow::Result<Audit> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let _within = runtime.enter();
    let age = Duration::from_secs(3600 * u64::from(which.older_than));
    let audit = audit(&which.store, age, remedy).with_context(|| format!("store {}", which.store))?;
    // of a store that a version before wrote that is all of them
    let none = Vec::new();
    for (what, names) in [
        ("overdue", &audit.overdue),
        ("not understood", &audit.unread),
        ("without a marker", &audit.unmarked),
        ("with a damaged marker", &audit.damaged),
        ("not in the index", if audit.built { &audit.unlisted } else { &none }),
        ("missing", &audit.missing),
        ("of another length than it should be", &audit.cut),
        (if remedy == Remedy::Remove { "removed" } else { "left over" }, &audit.left_over),
    ] {
        for name in names {
            note(&format!("{what}: {name}"));
        }
    }
    let Audit { photos, done, failed, pending, removed, mended, listed, folders, .. } = &audit;
    let text = format!(
        "{photos} photos: {done} done, {failed} failed, {pending} pending ({} overdue, {} without a marker, {} with a damaged one, {mended} mended)\n\
         {} not in the index{}, {listed} entered\n\
         {} not understood, {} missing, {} of another length, {} left over, {removed} and {folders} empty folders removed",
        audit.overdue.len(),
        audit.unmarked.len(),
        audit.damaged.len(),
        audit.unlisted.len(),
        if audit.built { "" } else { ", which nodes build" },
        audit.unread.len(),
        audit.missing.len(),
        audit.cut.len(),
        audit.left_over.len(),
    );
    result(&if which.json { serde_json::to_string_pretty(&audit)? } else { text })?;
    Ok(audit)
}
