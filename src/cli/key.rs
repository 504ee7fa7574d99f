//! `tmpi key`.

use std::path::{Path, PathBuf};

use super::{Usage, result};
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
        /// Make the directory where it is not yet one of a server
        #[arg(long)]
        create: bool,
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

/// Where the server has its keys: as options of `tmpi serve`, of its file, and of its variables.
#[derive(Clone, Debug, clap::Args)]
struct ServerFlags {
    /// File of settings that the server is started with; where its keys are is read there
    #[arg(long, env = "TMPI_CONFIG", value_name = "FILE")]
    #[allow(dead_code, reason = "read before all else, with what is in it")]
    config: Option<PathBuf>,
    /// Directory that the server keeps its photos in
    #[arg(long, default_value = "tmpi-data", value_name = "DIR")]
    data: PathBuf,
    /// Directory of its keys, where it is not that of --data
    #[arg(long, value_name = "DIR")]
    keys: Option<PathBuf>,
}

impl ServerFlags {
    /// The directory of the keys; one that no server has used is refused unless it is to be made.
    fn dir(&self, create: bool, how: &str) -> anyhow::Result<&Path> {
        let dir = self.keys.as_deref().unwrap_or(&self.data);
        if create || keys::is_of_a_server(dir) {
            return Ok(dir);
        }
        let text = format!("{}: no server keeps photos or keys there; --data, --keys or --config says where it does{how}", dir.display());
        Err(Usage(text).into())
    }
}

pub(super) fn run(args: &KeyArgs) -> anyhow::Result<()> {
    match &args.what {
        What::Add { name, scope, days, create, server } => {
            result(&keys::add(server.dir(*create, ", and --create makes it")?, name, scope, *days)?)
        }
        What::List { server } => {
            let all = keys::read(server.dir(false, "")?)?;
            let lines: Vec<String> = all.iter().map(keys::Key::line).collect();
            if lines.is_empty() { Ok(()) } else { result(&lines.join("\n")) }
        }
        What::Remove { name, id, server } => {
            let count = keys::remove(server.dir(false, "")?, name, id.as_deref())?;
            eprintln!("{count} {} no longer good", if count == 1 { "key is" } else { "keys are" });
            Ok(())
        }
    }
}
