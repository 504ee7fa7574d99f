//! Tiled multiplane images: what one is ([`scene`]), which texels its layers have and what colour hides behind them ([`layers`]), how
//! it is written and read ([`container`]), and how one that moves is sent ([`live`]).
//!
//! The core knows no thread, no picture codec and no C library unless a feature asks for them, so that one decoder serves the server,
//! native clients and, as wasm, the browser. Paper: Khan, Lanman, Xiao, *Tiled Multiplane Images for Practical 3D Photography*, ICCV 2023.

pub mod container;
pub mod layers;
pub mod live;
mod parallel;
pub mod scene;
pub mod simd;

pub use layers::{
    Geometry, Inpainter, LayerMask, LayerMasks, Pyramid, SeenBackground, TexturedLayer, Tile, TileFrame, compose, grown, texture,
};
pub use scene::{
    Camera, Class, DisparityMap, Grid, Intrinsics, Layer, Mat3, MirrorBlur, Photo, Plane, Pose, Rect, Scene, SceneError, Texels, ViewBox,
    homography, mat3_mul, mat3_vec,
};
