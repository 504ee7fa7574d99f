//! Uploads a photo, waits until the server has processed it, makes it visible to everyone who has its URL, and prints the HTML that
//! embeds it.
//!
//!     cargo run --release -p tmpi-client --example upload_and_embed -- http://127.0.0.1:8080 beach.jpg [KEY]
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "a command-line program prints")]

use std::process::ExitCode;

use tmpi_client::{Client, Error, Settings, Upload, Visibility};

async fn embedded(server: &str, photo: Vec<u8>, key: Option<&str>) -> Result<String, Error> {
    let client = Client::new(server)?;
    let client = match key {
        Some(key) => client.with_key(key)?,
        None => client.with_fresh_owner()?,
    };
    let accepted = client.upload(Upload::of(photo)).await?;
    let made = client.finished(&accepted.id, |stage| eprintln!("{}/{} {}", stage.step, stage.steps, stage.stage)).await?;
    // visibility is set only on servers with authentication
    if made.visibility.is_some() {
        client.change(&made.id, "", &Settings { visibility: Some(Visibility::Link), ..Settings::default() }).await?;
    }
    if let Some(secret) = client.secret().filter(|_| made.visibility.is_some()) {
        eprintln!("keep this secret to change the photo later: {secret}");
    }
    client.embedding(&made, None)
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [server, file, key @ ..] = &arguments[..] else {
        eprintln!("usage: upload_and_embed SERVER PHOTO [KEY]");
        return ExitCode::from(2);
    };
    let done = std::fs::read(file).map_err(|e| format!("{file}: {e}")).and_then(|photo| {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(|e| e.to_string())?;
        runtime.block_on(embedded(server, photo, key.first().map(String::as_str))).map_err(|e| e.to_string())
    });
    match done {
        Ok(html) => {
            println!("{html}");
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}
