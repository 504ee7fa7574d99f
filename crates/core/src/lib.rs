//! Tiled multiplane images: the data types ([`scene`]), the texels of layers and the colours of hidden texels ([`layers`]), the file format
//! ([`container`]), and the messages of live rooms ([`live`]).
//!
//! Without features, the core uses no threads, no picture codecs and no C libraries, so the same decoder serves the server, native clients
//! and, as WebAssembly, the browser. Paper: Khan, Lanman, Xiao, *Tiled Multiplane Images for Practical 3D Photography*, ICCV 2023.

pub mod container;
pub mod layers;
pub mod live;
mod parallel;
pub mod rim;
pub mod scene;
pub mod simd;

pub use layers::{
    Geometry, Inpainter, LayerMask, LayerMasks, MATTE_BAND, Pyramid, SeenBackground, TexturedLayer, Tile, TileFrame, Uncoloured, compose,
    grown, texture,
};
pub use scene::{
    Border, BorderColours, Camera, Class, DisparityMap, Grid, Intrinsics, Layer, Mat3, Photo, Plane, Pose, Rect, Scene, SceneError, Texels,
    ViewBox, homography, mat3_mul, mat3_vec,
};
