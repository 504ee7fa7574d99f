//! `tmpi fsck` and `tmpi gc`.

use serde_json::json;

use super::library_args::LibraryArgs;
use super::{note, result};

/// The library to check or to clean up.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct IntegrityArgs {
    #[command(flatten)]
    library: LibraryArgs,
    /// JSON on standard output
    #[arg(long)]
    json: bool,
}

pub(super) fn fsck(args: &IntegrityArgs) -> anyhow::Result<()> {
    let damage = args.library.with(false, async |library| Ok(library.fsck().await?))?;
    for found in &damage {
        note(&format!("{}: {found}", found.photo));
    }
    let all: Vec<_> = damage.iter().map(|found| json!({ "photo": found.photo, "part": found.part, "detail": found.detail })).collect();
    result(&if args.json { serde_json::to_string_pretty(&json!({ "damaged": all }))? } else { format!("{} damaged", all.len()) })?;
    anyhow::ensure!(damage.is_empty(), "the library is damaged: upload the damaged photos again");
    Ok(())
}

pub(super) fn gc(args: &IntegrityArgs) -> anyhow::Result<()> {
    let gone = args.library.with(false, async |library| Ok(library.gc().await?))?;
    let text = format!("{} removed, {} bytes", gone.blobs, gone.bytes);
    result(&if args.json { serde_json::to_string_pretty(&json!({ "removed": gone.blobs, "bytes": gone.bytes }))? } else { text })
}
