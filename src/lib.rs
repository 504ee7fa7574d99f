//! tmpi turns a photo into a tiled multiplane image (TMPI), packs it into a compact container and draws it for any camera.
//!
//! The modules lie along the way of a photo, and arrows run one way only:
//! `photo ← depth ← generate ← atlas ← {render, export, server, client}`. [`tmpi`] is the vocabulary that all of them share and
//! knows none of them. [`way`] runs the whole way; the command line and the server are its only callers.
#![warn(clippy::pedantic)]
// Pixel arithmetic casts between integer and float widths in every line; the ranges are bounded by `photo::Limits`.
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_precision_loss,
    clippy::cast_sign_loss,
    clippy::cast_possible_wrap,
    clippy::cast_lossless
)]
// Image geometry is written with the field's one-letter names (u, v, a, b, c, x, y, w, h).
#![allow(clippy::many_single_char_names, clippy::similar_names)]
// Counts of a class run once a scene; a crate for them is not worth its build.
#![allow(clippy::naive_bytecount)]
// Numerical loops index several arrays at once; zips of five hide what they do.
#![allow(clippy::needless_range_loop)]
// `generate::GenerateError` reads better at a call site than `generate::Error` where several modules meet.
#![allow(clippy::module_name_repetitions)]

mod assets;
pub mod atlas;
pub mod bench;
pub mod check;
pub mod cli;
pub mod clock;
pub mod depth;
pub mod eval;
pub mod export;
#[doc(hidden)]
pub mod fuzzing;
pub mod generate;
pub mod models;
pub mod onnx;
pub mod photo;
pub mod progress;
pub mod quality;
pub mod render;
pub mod server;
mod simd;
pub mod synth;
pub mod tmpi;
pub mod way;
