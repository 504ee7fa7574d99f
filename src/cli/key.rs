//! `tmpi key`.

use std::path::PathBuf;

use super::result;
use crate::server::keys::{self, Scope};

/// Give out and take back keys of a server that asks who comes
#[derive(Clone, Debug, clap::Args)]
pub(super) struct KeyArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Clone, Debug, clap::Subcommand)]
enum What {
    /// Print a fresh key, which is kept nowhere; keys of one name have the same photos
    Add {
        /// Whose it is: letters, digits, dots, - and _
        name: String,
        /// What it is good for
        #[arg(long, value_enum, value_delimiter = ',', required = true, value_name = "SCOPE[,SCOPE…]")]
        scope: Vec<Scope>,
        /// Days for which it is good; without it for ever
        #[arg(long, value_parser = clap::value_parser!(u32).range(1..=36_500), value_name = "N")]
        days: Option<u32>,
        #[command(flatten)]
        server: ServerFlags,
    },
    /// List the keys, without themselves
    List {
        #[command(flatten)]
        server: ServerFlags,
    },
    /// Take back all keys of a name, at once
    Remove {
        /// Whose they are
        name: String,
        /// Only the one that `key list` shows with this id
        #[arg(long, value_name = "ID")]
        id: Option<String>,
        #[command(flatten)]
        server: ServerFlags,
    },
}

#[derive(Clone, Debug, clap::Args)]
struct ServerFlags {
    /// Directory that the server keeps its photos in
    #[arg(long, default_value = "tmpi-data", value_name = "DIR")]
    data: PathBuf,
}

pub(super) fn run(args: &KeyArgs) -> anyhow::Result<()> {
    match &args.what {
        What::Add { name, scope, days, server } => result(&keys::add(&server.data, name, scope, *days)?),
        What::List { server } => {
            let all = keys::read(&server.data)?;
            let lines: Vec<String> = all.iter().map(keys::Key::line).collect();
            if lines.is_empty() { Ok(()) } else { result(&lines.join("\n")) }
        }
        What::Remove { name, id, server } => {
            let count = keys::remove(&server.data, name, id.as_deref())?;
            eprintln!("{count} {} no longer good", if count == 1 { "key is" } else { "keys are" });
            Ok(())
        }
    }
}
