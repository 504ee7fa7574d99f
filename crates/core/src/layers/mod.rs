//! Layers from planes and labels: the texels of each layer ([`Geometry::masks`]), and the colours of hidden texels ([`Inpainter`]). Writer
//! and readers run the same steps on the same values, so a container need not carry the results.

mod coarse_surface;
mod dilation;
mod inpaint;
mod inpaint_kernels;
mod masks;
mod matting;
mod occluders;
mod prune;
mod reach;
mod seen_background;
mod surface;
mod texture;
mod visibility_kernels;

pub(crate) use coarse_surface::BLOCK;
pub(crate) use dilation::{Dilation, dilate};
pub(crate) use inpaint::CONTEXT;
pub use inpaint::{Inpainter, Pyramid};
pub use masks::{Geometry, LayerMask, LayerMasks, Tile, TileFrame, grown};
pub use matting::MATTE_BAND;
pub(crate) use matting::{Rows, matte};
pub use reach::work_of;
pub(crate) use reach::{farthest, pixel_rows};
pub use seen_background::SeenBackground;
pub(crate) use seen_background::{MAX_FRAMES, STEADY};
pub use surface::Surface;
pub use texture::{TexturedLayer, Uncoloured, compose, texture};
pub(crate) use texture::{join, texture_tiles};
