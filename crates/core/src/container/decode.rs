//! Decodes containers. Trusts nothing in them: checks counts before allocating memory for them.

use std::ops::Range;

use prost::Message;

use super::decode_rows::TileLayers;
use super::schema::{Codec, Index, Kind, Section};
use super::{ContainerError, MAGIC, MAJOR, PhotoFormat, bounds, columns, hidden, label_bands, labels, planes, select_sections};
use crate::layers::{Surface, join, texture_tiles};
use crate::parallel;
use crate::{Class, Geometry, Grid, Intrinsics, Layer, LayerMasks, MATTE_BAND, Photo, Scene, TexturedLayer, ViewBox};

/// All rows of tiles.
const ALL_ROWS: Range<u32> = 0..u32::MAX;
/// Decodes a picture section: format, file, and maximum width and height in pixels.
pub type PictureDecoder<'a> = &'a (dyn Fn(PhotoFormat, &[u8], (u32, u32)) -> Result<Photo, ContainerError> + Sync);

/// A section, as described by the index.
#[derive(Clone, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct SectionInfo {
    /// One of `photo planes labels alpha hidden`, or `unknown`.
    pub kind: &'static str,
    /// One of `raw zstd jpeg png webp range range-bands`.
    pub codec: &'static str,
    /// Offset of the first byte in the file.
    pub offset: u64,
    /// Length in the file, in bytes.
    pub length: u64,
    /// Length after decompression, in bytes; 0 for pictures.
    pub raw_length: u64,
}

/// Lists the sections of a container in file order, without decoding them.
///
/// # Errors
/// [`ContainerError::Broken`], [`ContainerError::Bound`] or [`ContainerError::Newer`].
pub fn sections(bytes: &[u8]) -> Result<Vec<SectionInfo>, ContainerError> {
    let (index, body) = split(bytes)?;
    let start = (bytes.len() - body.len()) as u64;
    let codec = |s: &Section| match s.codec() {
        Codec::Raw => "raw",
        Codec::Zstd => "zstd",
        Codec::Jpeg => "jpeg",
        Codec::Png => "png",
        Codec::Webp => "webp",
        Codec::Range => "range",
        Codec::RangeBands => "range-bands",
    };
    index
        .sections
        .iter()
        .map(|s| {
            range(s, body)?;
            Ok(SectionInfo {
                kind: select_sections::name(s.kind()),
                codec: codec(s),
                offset: start + s.offset,
                length: s.length,
                raw_length: s.raw_length,
            })
        })
        .collect()
}

/// Decodes photo and geometry of a container.
///
/// # Errors
/// [`ContainerError::Broken`], [`ContainerError::Bound`] or [`ContainerError::Newer`].
#[cfg(feature = "pictures")]
pub fn read(bytes: &[u8]) -> Result<(Photo, Geometry), ContainerError> {
    read_rows(bytes, ALL_ROWS)
}

/// Like [`read`] for callers that need labels only in some rows of tiles; labels of other tiles may be missing.
#[cfg(feature = "pictures")]
pub(super) fn read_rows(bytes: &[u8], rows: Range<u32>) -> Result<(Photo, Geometry), ContainerError> {
    let (index, body) = split(bytes)?;
    parts(&index, body, &rows, &super::picture_codec::decode)
}

/// Decodes the geometry of a container; ignores its photo.
///
/// # Errors
/// [`ContainerError::Broken`], [`ContainerError::Bound`] or [`ContainerError::Newer`].
pub fn read_geometry(bytes: &[u8]) -> Result<Geometry, ContainerError> {
    let (index, body) = split(bytes)?;
    let (grid, intrinsics, view_box) = cameras(&index)?;
    layer_geometry(&index, body, grid, (intrinsics, view_box), &ALL_ROWS)
}

fn parts(index: &Index, body: &[u8], rows: &Range<u32>, pictures: PictureDecoder) -> Result<(Photo, Geometry), ContainerError> {
    let (grid, intrinsics, view_box) = cameras(index)?;
    let section = find(index, Kind::Photo).ok_or_else(|| ContainerError::broken("there is no photo section"))?;
    let file = range(section, body)?;
    let (photo, geometry) = parallel::join(
        || pictures(format(section)?, file, (grid.width, grid.height)),
        || layer_geometry(index, body, grid, (intrinsics, view_box), rows),
    );
    let (photo, geometry) = (photo?, geometry?);
    if (photo.width, photo.height) != (grid.width, grid.height) {
        return Err(ContainerError::broken("photo: its size differs from the index"));
    }
    Ok((photo, geometry))
}

/// Decodes a container; trusts nothing in it. The returned scene passes [`Scene::validate`].
///
/// # Errors
/// [`ContainerError::Broken`], [`ContainerError::Bound`] or [`ContainerError::Newer`].
#[cfg(feature = "pictures")]
pub fn decode(bytes: &[u8]) -> Result<Scene, ContainerError> {
    decode_with(bytes, &super::picture_codec::decode)
}

/// Like `decode`, but `pictures` decodes the picture sections.
///
/// # Errors
/// [`ContainerError::Broken`], [`ContainerError::Bound`] or [`ContainerError::Newer`], or the error of `pictures`.
pub fn decode_with(bytes: &[u8], pictures: PictureDecoder) -> Result<Scene, ContainerError> {
    let (index, body) = split(bytes)?;
    let (photo, geometry) = parts(&index, body, &ALL_ROWS, pictures)?;
    let Geometry { grid, intrinsics, view_box, .. } = geometry;
    let tiles = 0..geometry.tiles.len() as u32;
    let TileLayers { layers, texels, .. } = derive_layers(&index, body, &geometry, tiles, geometry.surface(), &photo.rgb, pictures)?;
    let scene = Scene { grid, intrinsics, view_box, photo, layers, texels };
    scene.validate().map_err(|e| ContainerError::broken(e.to_string()))?;
    Ok(scene)
}

/// Layers and texels of some tiles. `surface` and `rgb` cover the same rows, all that these tiles depend on.
pub(super) fn derive_layers(
    index: &Index,
    body: &[u8],
    geometry: &Geometry,
    tiles: Range<u32>,
    surface: Surface,
    rgb: &[[u8; 3]],
    pictures: PictureDecoder,
) -> Result<TileLayers, ContainerError> {
    let shapes = geometry.masks_of(tiles.clone(), &surface, false);
    let has_hidden = find(index, Kind::Hidden).is_some();
    let textured = if has_hidden {
        let tile = |s: LayerMasks| s.layers.into_iter().map(|shape| TexturedLayer { shape, hidden: Vec::new() }).collect();
        shapes.into_iter().map(tile).collect()
    } else {
        texture_tiles(geometry, surface, rgb, tiles.start, shapes)
    };
    let (mut layers, mut texels) = join(tiles.start, textured);
    refine_alpha(index, body, &mut texels.alpha)?;
    let hidden = count_hidden(&mut layers, &texels.class);
    if has_hidden {
        texels.hidden = hidden_colours(index, body, &layers, &texels.class, hidden, pictures)?;
    }
    Ok(TileLayers { layers, texels })
}

/// Checks header and sections; returns the index and the bytes after it.
pub(super) fn split(bytes: &[u8]) -> Result<(Index, &[u8]), ContainerError> {
    let head: [u8; 12] = bytes.first_chunk().copied().ok_or_else(|| ContainerError::broken("shorter than its header"))?;
    if head[..4] != MAGIC {
        return Err(ContainerError::broken("it does not begin with \"TMPI\""));
    }
    let found = u16::from_le_bytes([head[4], head[5]]);
    if found > MAJOR {
        return Err(ContainerError::Newer { found, known: MAJOR });
    }
    if found == 0 {
        return Err(ContainerError::broken("version 0"));
    }
    let length = u32::from_le_bytes([head[8], head[9], head[10], head[11]]) as usize;
    if length > bounds::INDEX {
        return Err(ContainerError::broken("the index is too long"));
    }
    let rest = &bytes[12..];
    let (index, body) = rest.split_at_checked(length).ok_or_else(|| ContainerError::broken("the index is cut off"))?;
    let index = Index::decode(index).map_err(|e| ContainerError::broken(format!("index: {e}")))?;
    if index.sections.len() > bounds::SECTIONS {
        return Err(ContainerError::broken("too many sections"));
    }
    // also checks sections that no reader uses
    index.sections.iter().try_for_each(|s| range(s, body).map(drop))?;
    Ok((index, body))
}

/// Index and grid, both checked.
pub(super) fn declared(bytes: &[u8]) -> Result<(Index, Grid), ContainerError> {
    let (index, _) = split(bytes)?;
    let (grid, ..) = cameras(&index)?;
    Ok((index, grid))
}

pub(super) fn cameras(i: &Index) -> Result<(Grid, Intrinsics, ViewBox), ContainerError> {
    let k = Intrinsics { fx: i.fx, fy: i.fy, cx: i.cx, cy: i.cy };
    let v = ViewBox { x: i.view_x, y: i.view_y, z: i.view_z };
    let grid = Grid { width: i.width, height: i.height, size: i.tile_size, stride: i.tile_stride };
    bounds::frame(&grid, &k, &v)?;
    Ok((grid, k, v))
}

pub(super) fn find(index: &Index, kind: Kind) -> Option<&Section> {
    index.sections.iter().find(|s| s.kind() == kind)
}

pub(super) fn range<'a>(s: &Section, body: &'a [u8]) -> Result<&'a [u8], ContainerError> {
    let end = s.offset.checked_add(s.length).filter(|e| *e <= body.len() as u64);
    match end {
        Some(end) => Ok(&body[s.offset as usize..end as usize]),
        None => Err(ContainerError::broken(format!("section {} reaches past the end", s.kind))),
    }
}

/// Picture format of a section.
fn format(s: &Section) -> Result<PhotoFormat, ContainerError> {
    match s.codec() {
        Codec::Jpeg => Ok(PhotoFormat::Jpeg),
        Codec::Png => Ok(PhotoFormat::Png),
        Codec::Webp => Ok(PhotoFormat::WebP),
        Codec::Raw | Codec::Zstd | Codec::Range | Codec::RangeBands => Err(ContainerError::broken("picture: not a picture codec")),
    }
}

/// Unpacks a section of exactly `want` bytes; it may be missing if that is 0.
fn unpack(index: &Index, body: &[u8], kind: Kind, want: usize) -> Result<Vec<u8>, ContainerError> {
    let Some(s) = find(index, kind) else {
        return if want == 0 { Ok(Vec::new()) } else { Err(ContainerError::broken(format!("section {} is missing", kind as i32))) };
    };
    let data = range(s, body)?;
    if s.raw_length != want as u64 {
        return Err(ContainerError::broken(format!("section {} has the wrong length", s.kind)));
    }
    let raw = match s.codec() {
        Codec::Raw => data.to_vec(),
        #[cfg(feature = "unpack")]
        Codec::Zstd => super::unpack::section(s, data, want)?,
        #[cfg(not(feature = "unpack"))]
        Codec::Zstd => return Err(ContainerError::broken(format!("section {} is packed with zstd", s.kind))),
        _ => return Err(ContainerError::broken(format!("section {} has a picture codec", s.kind))),
    };
    if raw.len() != want {
        return Err(ContainerError::broken(format!("section {} has the wrong length", s.kind)));
    }
    Ok(raw)
}

/// The section of `count` planes in the layout of [`columns`].
fn plane_section(index: &Index, body: &[u8], grid: &Grid, count: usize) -> Result<Vec<u8>, ContainerError> {
    let want = columns::bytes(grid.tiles() as usize, count);
    match find(index, Kind::Planes).filter(|s| s.codec() == Codec::Range) {
        Some(s) if s.raw_length != want as u64 => Err(ContainerError::broken("planes: wrong length")),
        Some(s) => planes::decode(&mut planes::Models::new(), planes::Layout::of(grid, count), range(s, body)?),
        // packed with zstd: repetitive planes
        None => unpack(index, body, Kind::Planes, want),
    }
}

/// Planes of all tiles, and labels of the tiles in `rows`.
pub(super) fn layer_geometry(
    index: &Index,
    body: &[u8],
    grid: Grid,
    (intrinsics, view_box): (Intrinsics, ViewBox),
    rows: &Range<u32>,
) -> Result<Geometry, ContainerError> {
    if index.matted && [Kind::Alpha, Kind::Hidden].into_iter().any(|kind| find(index, kind).is_some()) {
        return Err(ContainerError::broken("a matted container must not carry alphas or hidden colours"));
    }
    let count = index.planes as usize;
    bounds::planes(&grid, count)?;
    let mut tiles = columns::read(&grid, count, &plane_section(index, body, &grid, count)?)?;
    let section = find(index, Kind::Labels)
        .filter(|s| matches!(s.codec(), Codec::Range | Codec::RangeBands))
        .ok_or_else(|| ContainerError::broken("there is no section of labels"))?;
    bounds::work(&grid, &tiles)?;
    let counts: Vec<u8> = tiles.iter().map(|t| t.planes.len() as u8).collect();
    let data = range(section, body)?;
    let labels = match section.codec() {
        Codec::RangeBands => label_bands::decode(&grid, &counts, &section.bands, data, rows)?,
        _ => labels::decode(&grid, &counts, data)?,
    };
    let mut rest = labels.as_slice();
    for (i, t) in (0..).zip(&mut tiles) {
        let own = rest.split_off(..grid.rect(i).area()).unwrap_or_default();
        if rows.contains(&(i / grid.columns())) {
            t.labels = own.to_vec();
        }
    }
    Ok(Geometry { grid, intrinsics, view_box, tiles, matte_band: if index.matted { MATTE_BAND } else { 0 } })
}

/// Applies the section of refined alphas to the soft texels, if there is one.
fn refine_alpha(index: &Index, body: &[u8], alpha: &mut [u8]) -> Result<(), ContainerError> {
    if find(index, Kind::Alpha).is_none() {
        return Ok(());
    }
    let soft = |a: u8| (1..255).contains(&a);
    let change = unpack(index, body, Kind::Alpha, alpha.iter().filter(|a| soft(**a)).count())?;
    for (a, c) in alpha.iter_mut().filter(|a| soft(**a)).zip(change) {
        *a = a.wrapping_add(c);
        if !soft(*a) {
            return Err(ContainerError::broken("alpha: a soft texel must have 1 to 254"));
        }
    }
    Ok(())
}

/// Sets the index of each layer's first hidden texel; returns the number of hidden texels.
fn count_hidden(layers: &mut [Layer], class: &[u8]) -> usize {
    let mut hidden = 0;
    for l in layers {
        l.first_hidden = hidden;
        hidden += class[l.first_texel..l.first_texel + l.rect.area()].iter().filter(|&&c| c == Class::Hidden as u8).count();
    }
    hidden
}

fn hidden_colours(
    index: &Index,
    body: &[u8],
    layers: &[Layer],
    class: &[u8],
    count: usize,
    pictures: PictureDecoder,
) -> Result<Vec<[u8; 3]>, ContainerError> {
    if count == 0 {
        return Ok(Vec::new());
    }
    let s = find(index, Kind::Hidden).ok_or_else(|| ContainerError::broken("there is no section of hidden colours"))?;
    let columns = index.hidden_columns as usize;
    let blocks = hidden::walk(layers, class, |_, _, _| {});
    if columns == 0 || index.hidden_blocks as usize != blocks {
        return Err(ContainerError::broken("hidden: wrong count of blocks"));
    }
    let side = |blocks: usize| u32::try_from(blocks * 8).map_err(|_| ContainerError::broken("hidden: more blocks than a picture can hold"));
    let most = (side(columns)?, side(blocks.div_ceil(columns))?);
    let p = pictures(format(s)?, range(s, body)?, most)?;
    if p.width > most.0 || p.height > most.1 {
        return Err(ContainerError::broken("hidden: the picture is too large"));
    }
    let fits = columns.checked_mul(8).is_some_and(|w| w <= p.width as usize) && blocks.div_ceil(columns) * 8 <= p.height as usize;
    if !fits {
        return Err(ContainerError::broken("hidden: the picture is too small"));
    }
    Ok(hidden::read(layers, class, count, columns, p.width as usize, &p.rgb))
}
