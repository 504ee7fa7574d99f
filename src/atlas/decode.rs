//! Reading a container. Nothing in it is trusted: counts are bounded before anything is allocated for them.

use prost::Message;
use serde::Serialize;

use super::wire::{Codec, Index, Kind, Section};
use super::{AtlasError, MAGIC, MAJOR, bounds, columns, hidden, picture};
use crate::tmpi::{Class, Grid, Intrinsics, Layer, Scene, Texels, ViewBox};

/// One section as the index names it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct SectionInfo {
    /// `photo planes classes alpha hidden`, or `unknown`.
    pub kind: &'static str,
    /// `raw zstd jpeg png webp`.
    pub codec: &'static str,
    /// First byte in the file.
    pub offset: u64,
    /// Bytes in the file.
    pub length: u64,
    /// Bytes after decompression, 0 for pictures.
    pub raw_length: u64,
}

/// The sections of a container, in file order, without decoding them.
///
/// # Errors
/// [`AtlasError::Broken`] or [`AtlasError::Newer`].
pub fn sections(bytes: &[u8]) -> Result<Vec<SectionInfo>, AtlasError> {
    let (index, body) = split(bytes)?;
    let start = (bytes.len() - body.len()) as u64;
    let name = |s: &Section| match s.kind() {
        Kind::Photo => "photo",
        Kind::Planes => "planes",
        Kind::Classes => "classes",
        Kind::Alpha => "alpha",
        Kind::Hidden => "hidden",
        Kind::Unspecified => "unknown",
    };
    let codec = |s: &Section| match s.codec() {
        Codec::Raw => "raw",
        Codec::Zstd => "zstd",
        Codec::Jpeg => "jpeg",
        Codec::Png => "png",
        Codec::Webp => "webp",
    };
    index
        .sections
        .iter()
        .map(|s| {
            range(s, body)?;
            Ok(SectionInfo { kind: name(s), codec: codec(s), offset: start + s.offset, length: s.length, raw_length: s.raw_length })
        })
        .collect()
}

/// Reads a container; trusts nothing in it. The scene returned passes [`Scene::validate`].
///
/// # Errors
/// [`AtlasError::Broken`] or [`AtlasError::Newer`].
pub fn decode(bytes: &[u8]) -> Result<Scene, AtlasError> {
    let (index, body) = split(bytes)?;
    let (grid, intrinsics, view_box) = geometry(&index)?;
    let photo_section = find(&index, Kind::Photo).ok_or_else(|| AtlasError::broken("there is no photo section"))?;
    let photo = picture::decode(photo_section.codec(), range(photo_section, body)?)?;
    if (photo.width, photo.height) != (grid.width, grid.height) {
        return Err(AtlasError::broken("photo: its size is not the index's"));
    }
    let pixels = u64::from(grid.width) * u64::from(grid.height);
    if index.texels > (pixels * bounds::TEXELS_PER_PIXEL).min(bounds::TEXELS) {
        return Err(AtlasError::broken("more texels than a photo of this size can have"));
    }
    if index.layers > bounds::LAYERS || u64::from(index.layers) > index.texels {
        return Err(AtlasError::broken("too many layers"));
    }
    let count = index.layers as usize;
    let planes = unpack(&index, body, Kind::Planes, columns::bytes(count))?;
    let mut layers = columns::read(&grid, count, &planes)?;
    let codes = unpack(&index, body, Kind::Classes, index.texels as usize)?;
    let mut texels = texels(&index, body, codes)?;
    let hidden_count = place(&mut layers, &texels.class)?;
    texels.hidden = hidden_colours(&index, body, &layers, &texels.class, hidden_count)?;
    let scene = Scene { grid, intrinsics, view_box, photo, layers, texels };
    scene.validate().map_err(|e| AtlasError::broken(e.to_string()))?;
    Ok(scene)
}

/// Header and index checked; gives the index and the bytes after it.
fn split(bytes: &[u8]) -> Result<(Index, &[u8]), AtlasError> {
    let head: [u8; 12] = bytes.first_chunk().copied().ok_or_else(|| AtlasError::broken("shorter than its header"))?;
    if head[..4] != MAGIC {
        return Err(AtlasError::broken("it does not begin with \"TMPI\""));
    }
    let found = u16::from_le_bytes([head[4], head[5]]);
    if found > MAJOR {
        return Err(AtlasError::Newer { found, known: MAJOR });
    }
    if found == 0 {
        return Err(AtlasError::broken("version 0"));
    }
    let length = u32::from_le_bytes([head[8], head[9], head[10], head[11]]) as usize;
    if length > bounds::INDEX {
        return Err(AtlasError::broken("the index is too long"));
    }
    let rest = &bytes[12..];
    let (index, body) = rest.split_at_checked(length).ok_or_else(|| AtlasError::broken("the index is cut off"))?;
    let index = Index::decode(index).map_err(|e| AtlasError::broken(format!("index: {e}")))?;
    if index.sections.len() > bounds::SECTIONS {
        return Err(AtlasError::broken("too many sections"));
    }
    Ok((index, body))
}

fn geometry(i: &Index) -> Result<(Grid, Intrinsics, ViewBox), AtlasError> {
    let sides = 1..=bounds::SIDE;
    if !sides.contains(&i.width) || !sides.contains(&i.height) || u64::from(i.width) * u64::from(i.height) > bounds::PIXELS {
        return Err(AtlasError::broken("photo size out of bounds"));
    }
    if !sides.contains(&i.tile_size) || i.tile_stride == 0 || i.tile_stride > i.tile_size {
        return Err(AtlasError::broken("tile size out of bounds"));
    }
    let k = Intrinsics { fx: i.fx, fy: i.fy, cx: i.cx, cy: i.cy };
    let v = ViewBox { x: i.view_x, y: i.view_y, z: i.view_z };
    if !k.is_valid() || ![v.x, v.y, v.z].iter().all(|e| e.is_finite() && *e >= 0.0) {
        return Err(AtlasError::broken("camera out of bounds"));
    }
    Ok((Grid { width: i.width, height: i.height, size: i.tile_size, stride: i.tile_stride }, k, v))
}

fn find(index: &Index, kind: Kind) -> Option<&Section> {
    index.sections.iter().find(|s| s.kind() == kind)
}

fn range<'a>(s: &Section, body: &'a [u8]) -> Result<&'a [u8], AtlasError> {
    let end = s.offset.checked_add(s.length).filter(|e| *e <= body.len() as u64);
    match end {
        Some(end) => Ok(&body[s.offset as usize..end as usize]),
        None => Err(AtlasError::broken(format!("section {} reaches past the end", s.kind))),
    }
}

/// A compressed section of exactly `want` bytes; absent where that is 0.
fn unpack(index: &Index, body: &[u8], kind: Kind, want: usize) -> Result<Vec<u8>, AtlasError> {
    let Some(s) = find(index, kind) else {
        return if want == 0 { Ok(Vec::new()) } else { Err(AtlasError::broken(format!("section {} is missing", kind as i32))) };
    };
    let data = range(s, body)?;
    if s.raw_length != want as u64 {
        return Err(AtlasError::broken(format!("section {} is of the wrong length", s.kind)));
    }
    let raw = match s.codec() {
        Codec::Raw => data.to_vec(),
        // grows as it decodes, so that a false length cannot reserve memory that the bytes do not fill
        Codec::Zstd => {
            let mut out = Vec::new();
            let decoder = zstd::stream::read::Decoder::with_buffer(data).map_err(|e| AtlasError::broken(format!("zstd: {e}")))?;
            std::io::Read::read_to_end(&mut std::io::Read::take(decoder, want as u64 + 1), &mut out)
                .map_err(|e| AtlasError::broken(format!("section {}: {e}", s.kind)))?;
            out
        }
        _ => return Err(AtlasError::broken(format!("section {} has a picture codec", s.kind))),
    };
    if raw.len() != want {
        return Err(AtlasError::broken(format!("section {} is of the wrong length", s.kind)));
    }
    Ok(raw)
}

/// Splits codes into class and alpha.
fn texels(index: &Index, body: &[u8], mut class: Vec<u8>) -> Result<Texels, AtlasError> {
    let soft_count = class.iter().filter(|&&c| c > Class::Hidden as u8).count();
    let soft = unpack(index, body, Kind::Alpha, soft_count)?;
    let mut soft = soft.into_iter();
    let mut alpha = Vec::with_capacity(class.len());
    for c in &mut class {
        alpha.push(match *c {
            0 => 0,
            1 | 2 => 255,
            3 | 4 => {
                *c -= 2;
                match soft.next() {
                    Some(a @ 1..=254) => a,
                    _ => return Err(AtlasError::broken("alpha: a soft texel must have 1 to 254")),
                }
            }
            _ => return Err(AtlasError::broken("classes: unknown code")),
        });
    }
    Ok(Texels { class, alpha, hidden: Vec::new() })
}

/// Sets the texel offsets of all layers; gives the count of hidden texels.
fn place(layers: &mut [Layer], class: &[u8]) -> Result<usize, AtlasError> {
    let (mut texel, mut hidden) = (0usize, 0usize);
    for l in layers {
        l.first_texel = texel;
        l.first_hidden = hidden;
        let end = texel + l.rect.area();
        let own = class.get(texel..end).ok_or_else(|| AtlasError::broken("planes: more texels than there are classes"))?;
        hidden += own.iter().filter(|&&c| c == Class::Hidden as u8).count();
        texel = end;
    }
    if texel == class.len() { Ok(hidden) } else { Err(AtlasError::broken("classes: more than the layers hold")) }
}

fn hidden_colours(index: &Index, body: &[u8], layers: &[Layer], class: &[u8], count: usize) -> Result<Vec<[u8; 3]>, AtlasError> {
    if count == 0 {
        return Ok(Vec::new());
    }
    let s = find(index, Kind::Hidden).ok_or_else(|| AtlasError::broken("there is no section of hidden colours"))?;
    let p = picture::decode(s.codec(), range(s, body)?)?;
    let columns = index.hidden_columns as usize;
    let blocks = hidden::walk(layers, class, |_, _, _| {});
    if columns == 0 || index.hidden_blocks as usize != blocks {
        return Err(AtlasError::broken("hidden: wrong count of blocks"));
    }
    let fits = columns.checked_mul(8).is_some_and(|w| w <= p.width as usize) && blocks.div_ceil(columns) * 8 <= p.height as usize;
    if !fits {
        return Err(AtlasError::broken("hidden: the picture is too small"));
    }
    Ok(hidden::read(layers, class, count, columns, p.width as usize, &p.rgb))
}
