//! Reading a container as a browser does: its pictures by whoever can, its tiles in bands of whole rows that know nothing of each
//! other, so that each may go to a worker of its own.

use std::ops::Range;

use super::schema::Kind;
use super::{ContainerError, PhotoFormat, decode};
use crate::{Geometry, Grid, Layer, Photo, Texels};

/// Some rows of the photo.
#[derive(Clone, Debug, Default)]
pub struct PhotoRows {
    /// Size of the whole photo.
    pub width: u32,
    /// Size of the whole photo.
    pub height: u32,
    /// The first row.
    pub top: u32,
    /// Pixels of the rows.
    pub rgb: Vec<[u8; 3]>,
}

/// Layers of some tiles, and their texels; places of texels count from the first of them.
#[derive(Clone, Debug, Default)]
pub struct Part {
    /// The layers.
    pub layers: Vec<Layer>,
    /// Their texels.
    pub texels: Texels,
}

/// Rows of pixels that the layers of some rows of tiles follow from.
#[must_use]
pub fn reach(grid: &Grid, rows: &Range<u32>) -> Range<u32> {
    Geometry::reach(grid, rows)
}

/// Decodes some rows of tiles, at least one. `photo` has at least their [`reach`]; `hidden` is the picture of carried hidden colours,
/// where there is one that can be read.
///
/// # Errors
/// [`ContainerError::Broken`] or [`ContainerError::Newer`].
pub fn decode_rows(bytes: &[u8], rows: &Range<u32>, photo: &PhotoRows, hidden: Option<&Photo>) -> Result<Part, ContainerError> {
    let (index, body) = decode::split(bytes)?;
    let (grid, intrinsics, view_box) = decode::cameras(&index)?;
    if rows.is_empty() || rows.end > grid.rows() {
        return Err(ContainerError::broken("there are no such rows of tiles"));
    }
    let reach = reach(&grid, rows);
    // all rows of tiles that show in those of pixels
    let near = reach.start.saturating_sub(grid.size) / grid.stride..reach.end.div_ceil(grid.stride);
    let geometry = decode::layer_geometry(&index, body, grid, (intrinsics, view_box), &near)?;
    if decode::find(&index, Kind::Photo).is_none() {
        return Err(ContainerError::broken("there is no photo section"));
    }
    if (photo.width, photo.height) != (grid.width, grid.height) {
        return Err(ContainerError::broken("photo: its size is not the index's"));
    }
    let width = grid.width as usize;
    let own = (reach.start as usize).wrapping_sub(photo.top as usize).saturating_mul(width);
    let rgb = photo.rgb.get(own..own.saturating_add(width * reach.len()));
    let rgb = rgb.ok_or_else(|| ContainerError::broken("photo: not all of its rows are there"))?;
    let carried = |_: PhotoFormat, _: &[u8], _: (u32, u32)| {
        hidden.cloned().ok_or_else(|| ContainerError::broken("hidden: the picture cannot be read"))
    };
    let tiles = rows.start * grid.columns()..rows.end * grid.columns();
    decode::unfold(&index, body, &geometry, tiles, geometry.surface_of(reach), rgb, &carried)
}
