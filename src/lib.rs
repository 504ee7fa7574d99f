//! The program: command line, server and exports of tiled multiplane images. The crates `tmpi-core`, `tmpi-pipeline` and `tmpi-render` do
//! the work on photos.

mod assets;
pub mod cli;
pub mod export;
pub mod live;
pub mod server;
