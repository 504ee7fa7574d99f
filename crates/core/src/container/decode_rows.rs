//! Decodes a container as browsers do: platform codecs decode the pictures, and tiles are decoded in bands of whole rows. Bands are
//! independent, so each can go to its own worker.

use std::ops::Range;

use super::schema::{Index, Kind};
use super::{ContainerError, PhotoFormat, decode};
use crate::{Layer, Photo, Texels, layers};

/// Some rows of the photo.
#[derive(Clone, Debug, Default)]
pub struct PhotoRows {
    /// Width of the whole photo in pixels.
    pub width: u32,
    /// Height of the whole photo in pixels.
    pub height: u32,
    /// Index of the first row.
    pub top: u32,
    /// Pixels of the rows.
    pub rgb: Vec<[u8; 3]>,
}

/// Layers of some tiles, and their texels. Texel indices start at 0 for the first layer.
#[derive(Clone, Debug, Default)]
pub struct TileLayers {
    /// The layers.
    pub layers: Vec<Layer>,
    /// Texels of these layers.
    pub texels: Texels,
}

/// Rows of pixels that determine the layers in some rows of tiles of a container, at least one.
///
/// # Errors
/// [`ContainerError::Broken`], [`ContainerError::Bound`] or [`ContainerError::Newer`].
pub fn pixel_rows(bytes: &[u8], rows: &Range<u32>) -> Result<Range<u32>, ContainerError> {
    rows_of(&decode::split(bytes)?.0, rows)
}

fn rows_of(index: &Index, rows: &Range<u32>) -> Result<Range<u32>, ContainerError> {
    let (grid, intrinsics, view_box) = decode::cameras(index)?;
    if rows.is_empty() || rows.end > grid.rows() {
        return Err(ContainerError::broken("rows of tiles out of range"));
    }
    let (_, reach) = layers::farthest(&grid, &intrinsics, &view_box);
    Ok(layers::pixel_rows(&grid, reach, rows))
}

/// Decodes some rows of tiles, at least one. `photo` must cover their [`pixel_rows`]; `hidden` is the picture of carried hidden colours, if
/// there is one and it can be decoded.
///
/// # Errors
/// [`ContainerError::Broken`], [`ContainerError::Bound`] or [`ContainerError::Newer`].
pub fn decode_rows(bytes: &[u8], rows: &Range<u32>, photo: &PhotoRows, hidden: Option<&Photo>) -> Result<TileLayers, ContainerError> {
    let (index, body) = decode::split(bytes)?;
    let (grid, intrinsics, view_box) = decode::cameras(&index)?;
    let pixel_rows = rows_of(&index, rows)?;
    // all rows of tiles that overlap these rows of pixels
    let near = pixel_rows.start.saturating_sub(grid.size) / grid.stride..pixel_rows.end.div_ceil(grid.stride);
    let geometry = decode::layer_geometry(&index, body, grid, (intrinsics, view_box), &near)?;
    if decode::find(&index, Kind::Photo).is_none() {
        return Err(ContainerError::broken("there is no photo section"));
    }
    if (photo.width, photo.height) != (grid.width, grid.height) {
        return Err(ContainerError::broken("photo: its size differs from the index"));
    }
    let width = grid.width as usize;
    let own = (pixel_rows.start as usize).wrapping_sub(photo.top as usize).saturating_mul(width);
    let rgb = photo.rgb.get(own..own.saturating_add(width * pixel_rows.len()));
    let rgb = rgb.ok_or_else(|| ContainerError::broken("photo: rows are missing"))?;
    let carried = |_: PhotoFormat, _: &[u8], _: (u32, u32)| {
        hidden.cloned().ok_or_else(|| ContainerError::broken("hidden: the picture cannot be read"))
    };
    let tiles = rows.start * grid.columns()..rows.end * grid.columns();
    decode::derive_layers(&index, body, &geometry, tiles, geometry.surface_of(pixel_rows), rgb, &carried)
}
