//! Reading a container as a browser does: its head as soon as the first bytes are there, its pictures by whoever can, its tiles in
//! bands of whole rows that know nothing of each other, so that each may go to a worker of its own.

use std::ops::Range;

use super::wire::Kind;
use super::{ContainerError, PhotoFormat, decode};
use crate::{Geometry, Grid, Intrinsics, Layer, Photo, Texels, ViewBox};

/// What the first bytes of a container tell.
#[derive(Clone, Debug)]
pub struct Head {
    /// The tiles.
    pub grid: Grid,
    /// The reference camera.
    pub intrinsics: Intrinsics,
    /// Camera positions that the scene was made for.
    pub view_box: ViewBox,
    /// The photo's file.
    pub photo: Option<Picture>,
    /// The file of carried hidden colours.
    pub hidden: Option<Picture>,
    /// Whether tiles can be read in bands: not where something runs through all texels.
    pub bands: bool,
    /// Bytes of the whole container.
    pub bytes: u64,
}

/// A picture file in a container.
#[derive(Clone, Debug)]
pub struct Picture {
    /// Its bytes in the container.
    pub range: Range<u64>,
    /// Its format.
    pub format: PhotoFormat,
}

/// Reads what the first bytes of a container tell; none where more are needed.
///
/// # Errors
/// [`ContainerError::Broken`] or [`ContainerError::Newer`].
pub fn head(bytes: &[u8]) -> Result<Option<Head>, ContainerError> {
    let Some(length) = decode::index_length(bytes)? else { return Ok(None) };
    let start = decode::HEADER + length;
    let Some(index) = bytes.get(decode::HEADER..start) else { return Ok(None) };
    let index = decode::parsed(index)?;
    let (grid, intrinsics, view_box) = decode::cameras(&index)?;
    let end = |offset: u64, length: u64| (start as u64).saturating_add(offset).saturating_add(length);
    let picture = |kind| {
        let of = |s: &super::wire::Section| Ok(Picture { range: end(s.offset, 0)..end(s.offset, s.length), format: decode::format(s)? });
        decode::find(&index, kind).map(of).transpose()
    };
    let bands = ![Kind::Alpha, Kind::Hidden].into_iter().any(|kind| decode::find(&index, kind).is_some());
    let bytes = index.sections.iter().map(|s| end(s.offset, s.length)).max().unwrap_or(start as u64);
    // a codec of hidden colours that is none matters only where there are any
    Ok(Some(Head { grid, intrinsics, view_box, photo: picture(Kind::Photo)?, hidden: picture(Kind::Hidden).unwrap_or_default(), bands, bytes }))
}

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
