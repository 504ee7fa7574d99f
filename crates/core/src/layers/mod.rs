//! Layers from planes and labels: the texels of each layer ([`Geometry::masks`]), and the colours of hidden texels ([`Inpainter`]). Writer
//! and readers run the same steps on the same values, so a container need not carry the results.

mod colour_rows;
mod dilation;
mod in_front;
mod inpaint;
mod matting;
mod memory;
mod prune;
mod rows;
mod surface;
mod texture;
mod visibility;

pub(crate) use dilation::{Dilation, dilate};
pub(crate) use inpaint::CONTEXT;
pub use inpaint::{Inpainter, Pyramid};
pub(crate) use matting::{Rows, matte};
pub use memory::Memory;
pub(crate) use memory::{MAX_FRAMES, STEADY};
pub use prune::work_of;
pub use surface::Surface;
pub(crate) use texture::texture_tiles;
pub use texture::{TexturedLayer, compose, texture};
pub use visibility::{Geometry, LayerMask, LayerMasks, Tile, TileFrame, grown};
