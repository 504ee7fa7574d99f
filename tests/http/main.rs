//! The HTTP interface, end to end: real sockets, real disk, and where time allows the real way of a photo.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

mod arrivals;
mod client;
mod cluster;
mod damage;
mod fixture;

mod events;
mod fair;
mod limits;
mod live;
mod matrix;
mod measure;
mod nodes;
mod openapi;
mod origins;
mod process;
mod results;
mod settings;
mod sharing;
mod strokes;
mod uploads;
mod versions;
