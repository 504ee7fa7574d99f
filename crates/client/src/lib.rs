//! A client of tmpi's HTTP interface: uploads photos, follows how they are made, and fetches what was made of them.
//!
//! ```no_run
//! # async fn example() -> Result<(), tmpi_client::Error> {
//! use std::time::Duration;
//! use tmpi_client::{AtlasQuery, Client, Upload, View};
//!
//! let client = Client::new("http://127.0.0.1:8080")?;
//! let accepted = client.upload(&Upload::file("photo.jpg").await?.title("By the sea")).await?;
//! let made = client.wait(&accepted.id, Duration::from_secs(300), |event| println!("{event:?}")).await?;
//! let atlas = client.atlas(&made.id, &AtlasQuery::default()).await?;
//! println!("{} tiles", atlas.scene()?.grid.tiles());
//! let picture = client.view(&made.id, &View { w: Some(640), ..View::default() }).await?;
//! tokio::fs::write("view.png", picture.bytes).await?;
//! # Ok(())
//! # }
//! ```
//!
//! # Without `async`
//!
//! A runtime of one thread, kept as long as the client is:
//!
//! ```no_run
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
//! let client = tmpi_client::Client::new("http://127.0.0.1:8080")?;
//! let page = runtime.block_on(client.list(Some(50), None))?;
//! println!("{} photos", page.photos.len());
//! # Ok(())
//! # }
//! ```
//!
//! # What is tried again
//!
//! What reads, and uploads of an owner – the same upload is the same photo – are tried again after a broken connection, after silence, and after
//! 429 and 503. Everything else is tried again where no connection was made, or after 429: nothing was done then. `Retry-After` is honoured;
//! where it asks for more than [`Builder::longest_pause`], the problem is given back. Redirects are not followed.
//!
//! # TLS
//!
//! Feature `tls`: rustls with ring, unless the program has installed another provider for its process, and the system's certificates.

mod client;
mod error;
mod events;
mod made;
mod photos;
mod retry;
mod state;
mod strokes;
mod upload;

pub use client::{Builder, Client};
pub use error::{Error, Problem};
pub use events::{Event, Events};
pub use made::{Atlas, AtlasQuery, Crop, Export, Fetched, File, Format, Motion, Pose, Section, Stereo, View};
pub use photos::{Change, Tagged};
pub use state::{Link, Links, Offset, PhotoList, PhotoState, Progress, Settings, State, Visibility};
pub use strokes::{Ask, Stroke, Strokes};
pub use upload::Upload;
