//! `tmpi key`.

use std::time::Duration;

use tmpi_library::{Key, Scope};

use super::library::LibraryArgs;
use super::result;
use crate::server::rfc3339;

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
        /// What it is good for: upload, read, metrics, admin (everything, with everybody's photos)
        #[arg(long, value_parser = scope, value_delimiter = ',', required = true, value_name = "SCOPE[,SCOPE…]")]
        scope: Vec<Scope>,
        /// Days for which it is good; without it for ever
        #[arg(long, value_parser = clap::value_parser!(u32).range(1..=36_500), value_name = "N")]
        days: Option<u32>,
        /// Make the library where there is none yet
        #[arg(long)]
        create: bool,
        #[command(flatten)]
        server: LibraryArgs,
    },
    /// List the keys, without themselves
    List {
        #[command(flatten)]
        server: LibraryArgs,
    },
    /// Take back all keys of a name, at once
    Remove {
        /// Whose they are
        name: String,
        /// Only the one that `key list` shows with this id
        #[arg(long, value_name = "ID")]
        id: Option<String>,
        #[command(flatten)]
        server: LibraryArgs,
    },
}

fn scope(name: &str) -> Result<Scope, String> {
    let names = Scope::ALL.map(Scope::name).join(", ");
    Scope::ALL.into_iter().find(|scope| scope.name() == name).ok_or_else(|| format!("one of {names} is wanted"))
}

/// What there is to know of a key, as a line of a list.
fn line(key: &Key) -> String {
    let scopes: Vec<&str> = key.scopes.iter().map(|scope| scope.name()).collect();
    let end = key.expires_at.map_or_else(String::new, |at| format!(", until {}", rfc3339(at)));
    format!("{} {} {}, since {}{end}", key.id, key.name, scopes.join(","), rfc3339(key.created_at))
}

pub(super) fn run(args: &KeyArgs) -> anyhow::Result<()> {
    match &args.what {
        What::Add { name, scope, days, create, server } => {
            let lasts = days.map(|days| Duration::from_hours(24 * u64::from(days)));
            let key = server.with(*create, async |library| Ok(library.add_key(name, scope, lasts).await?))?;
            result(&key.secret)
        }
        What::List { server } => {
            let all = server.with(false, async |library| Ok(library.keys().await?))?;
            let lines: Vec<String> = all.iter().map(line).collect();
            if lines.is_empty() { Ok(()) } else { result(&lines.join("\n")) }
        }
        What::Remove { name, id, server } => {
            let count = server.with(false, async |library| Ok(library.remove_keys(name, id.as_deref()).await?))?;
            eprintln!("{count} {} no longer good", if count == 1 { "key is" } else { "keys are" });
            Ok(())
        }
    }
}
