//! `tmpi key`.

use std::time::Duration;

use tmpi_library::{Key, Scope};

use super::library_args::LibraryArgs;
use super::result;
use crate::server::rfc3339;

#[derive(Clone, Debug, clap::Subcommand)]
pub(super) enum KeyCommand {
    /// Create a key and print it; the server does not store the key itself. Keys with the same name own the same photos
    Add {
        /// Name of the owner: letters, digits, dots, - and _
        name: String,
        /// What the key allows: upload, read, sign (links), metrics, admin (everything, on all photos)
        #[arg(long, value_parser = scope, value_delimiter = ',', required = true, value_name = "SCOPE[,SCOPE…]")]
        scope: Vec<Scope>,
        /// Days until the key expires; without it, never
        #[arg(long, value_parser = clap::value_parser!(u32).range(1..=36_500), value_name = "N")]
        days: Option<u32>,
        /// Create the library if it does not exist
        #[arg(long)]
        create: bool,
        #[command(flatten)]
        server: LibraryArgs,
    },
    /// List the keys, without their secrets
    List {
        #[command(flatten)]
        server: LibraryArgs,
    },
    /// Revoke all keys of a name, effective at once
    Remove {
        /// Name of the owner
        name: String,
        /// Revoke only the key with this id, as `key list` shows it
        #[arg(long, value_name = "ID")]
        id: Option<String>,
        #[command(flatten)]
        server: LibraryArgs,
    },
}

fn scope(name: &str) -> Result<Scope, String> {
    let names = Scope::ALL.map(Scope::name).join(", ");
    Scope::ALL.into_iter().find(|scope| scope.name() == name).ok_or_else(|| format!("expected one of {names}"))
}

fn line(key: &Key) -> String {
    let scopes: Vec<&str> = key.scopes.iter().map(|scope| scope.name()).collect();
    let end = key.expires_at.map_or_else(String::new, |at| format!(", until {}", rfc3339(at)));
    format!("{} {} {}, since {}{end}", key.id, key.name, scopes.join(","), rfc3339(key.created_at))
}

pub(super) fn run(command: &KeyCommand) -> anyhow::Result<()> {
    match command {
        KeyCommand::Add { name, scope, days, create, server } => {
            let lasts = days.map(|days| Duration::from_hours(24 * u64::from(days)));
            let key = server.with(*create, async |library| Ok(library.add_key(name, scope, lasts).await?))?;
            result(&key.secret)
        }
        KeyCommand::List { server } => {
            let all = server.with(false, async |library| Ok(library.keys().await?))?;
            let lines: Vec<String> = all.iter().map(line).collect();
            if lines.is_empty() { Ok(()) } else { result(&lines.join("\n")) }
        }
        KeyCommand::Remove { name, id, server } => {
            let count = server.with(false, async |library| Ok(library.remove_keys(name, id.as_deref()).await?))?;
            eprintln!("{count} {} revoked", if count == 1 { "key" } else { "keys" });
            Ok(())
        }
    }
}
