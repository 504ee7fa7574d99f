//! `tmpi live`.

use std::path::PathBuf;

use super::live_publish::{self, PublishArgs};
use super::live_watch::{self, WatchArgs};
use super::{files, result};
use crate::live::{self as rooms, Grant};
use crate::server::since_1970;

#[derive(Clone, Debug, clap::Subcommand)]
pub(super) enum LiveCommand {
    Publish(PublishArgs),
    Watch(WatchArgs),
    Token(TokenArgs),
}

/// Print a token that admits its holder to a room
#[derive(Clone, Debug, clap::Args)]
pub(super) struct TokenArgs {
    /// Name of the room
    room: String,
    /// File with the server's key, as given to `serve --live-key`
    #[arg(long, value_name = "FILE")]
    key: PathBuf,
    /// Token for publishing; default: for watching
    #[arg(long)]
    publish: bool,
    /// Hours until it expires
    #[arg(long, default_value_t = 24, value_parser = clap::value_parser!(u32).range(1..=100_000), value_name = "N")]
    hours: u32,
}

pub(super) fn run(command: &LiveCommand) -> anyhow::Result<()> {
    match command {
        LiveCommand::Publish(args) => live_publish::publish(args),
        LiveCommand::Watch(args) => live_watch::watch(args),
        LiveCommand::Token(args) => token(args),
    }
}

fn token(args: &TokenArgs) -> anyhow::Result<()> {
    let grant = if args.publish { Grant::Publish } else { Grant::Watch };
    let expires = since_1970().as_secs() + u64::from(args.hours) * 3600;
    result(&rooms::room_token(&files::read(&args.key)?, grant, &args.room, expires))
}
