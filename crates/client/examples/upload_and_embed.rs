//! Uploads a photo, waits until it is made, and prints what shows it on a page.
//!
//!     cargo run --release -p tmpi-client --example upload_and_embed -- http://127.0.0.1:8080 photo.jpg
//!
//! `TMPI_KEY` names a key of `tmpi key add`, where the server asks who comes; `--features tls` for `https`.

use std::time::Duration;

use tmpi_client::{Change, Client, Event, Upload, Visibility};

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let [_, server, photo] = std::env::args().collect::<Vec<_>>().try_into().map_err(|_| "usage: upload_and_embed SERVER PHOTO")?;
    let builder = Client::builder(&server);
    let client = match std::env::var("TMPI_KEY") {
        Ok(key) => builder.key(key),
        Err(_) => builder,
    }
    .build()?;
    let accepted = client.upload(&Upload::file(&photo).await?).await?;
    // whoever uploads without a key owns the photo by a secret that is told once
    let client = match &accepted.links.manage {
        Some(link) => Client::builder(&server).owner_link(link)?.build()?,
        None => client,
    };
    let told = |event: &Event| match event {
        Event::Queued { position } => eprintln!("{position} before it"),
        Event::Stage(stage) => eprintln!("{}/{} {}", stage.step, stage.steps, stage.stage),
        _ => {}
    };
    let made = client.wait(&accepted.id, Duration::from_mins(10), told).await?;
    if made.visibility == Some(Visibility::Private) {
        client.change(&made.id, &Change::new().visibility(Visibility::Link), None).await?;
        eprintln!("whoever has its address can see it now");
    }
    if let Some(link) = &accepted.links.manage {
        eprintln!("change it at {}", client.address(link)?);
    }
    println!("<iframe src=\"{}\" allow=\"fullscreen\"></iframe>", client.address(&made.links.embed)?);
    println!("<script type=\"module\" src=\"{}\"></script>", client.address("/tmpi-viewer.js")?);
    println!("<tmpi-viewer src=\"{}\"></tmpi-viewer>", client.address(&format!("/v1/photos/{}/atlas", made.id))?);
    Ok(())
}
