//! The program: command line, server and exports of tiled multiplane images. What it does with photos stands in the crates
//! `tmpi-core`, `tmpi-pipeline` and `tmpi-render`.

mod assets;
pub mod cli;
pub mod export;
#[doc(hidden)]
pub mod fuzzing;
pub mod live;
pub mod server;
