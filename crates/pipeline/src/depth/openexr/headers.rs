//! The headers of an OpenEXR file: one for each part.

use exr::compression::Compression;
use exr::math::Vec2;
use exr::meta::header::Header;
use exr::meta::{BlockDescription, MetaData};

use super::super::DepthError;
use super::channels::{self, Chosen};
use crate::photo::{self, Head, Limits};

/// Magic number, version and flags.
const START: usize = 8;
/// Flag, in the second byte of the flags, of files with several parts.
const SEVERAL: u8 = 1 << 4;
/// Most parts of a file. Renderers write some dozens.
const PARTS: usize = 1024;
/// Attributes that say what a file holds and where. All others are skipped, so that reading them takes no memory.
const KNOWN: [&[u8]; 8] = [b"channels", b"compression", b"dataWindow", b"displayWindow", b"lineOrder", b"name", b"tiles", b"type"];

/// What the headers of a file say, within the limits.
pub(super) struct Headers {
    pub meta: MetaData,
    /// Their bytes in the file, with all before them.
    pub length: usize,
    /// Where depth is.
    pub depth: Chosen,
    /// Size of the picture: that of the display window.
    pub width: u32,
    pub height: u32,
    /// Most bytes of an unpacked block of the part with depth.
    pub block: usize,
}

/// What the decoder says of a file.
pub(super) fn fault(error: &exr::error::Error) -> DepthError {
    DepthError::Map(format!("the OpenEXR file is broken or not supported ({error})"))
}

/// The file ends before its pixels do.
pub(super) fn cut_short() -> DepthError {
    DepthError::Map("the OpenEXR file is cut short".into())
}

/// Reads a map's size from its first bytes while the rest is still arriving.
///
/// # Errors
/// The [`DepthError::Map`] that [`super::check`] returns for the whole file.
pub(in super::super) fn head(bytes: &[u8], limits: &Limits) -> Result<Head, DepthError> {
    match Skimmed::of(bytes) {
        Ok(skimmed) => Headers::within(&skimmed, limits).map(|headers| Head::Size(headers.width, headers.height)),
        // in growing steps: each look begins at the start
        Err(more) => Ok(Head::Needs(more.max(bytes.len() + bytes.len() / 4))),
    }
}

/// The headers with only their [`KNOWN`] attributes.
struct Skimmed {
    file: Vec<u8>,
    parts: usize,
    /// Their bytes in the file, with all before them.
    length: usize,
}

impl Skimmed {
    /// `Err` is a number of bytes, more than there are, without which the headers do not end.
    fn of(bytes: &[u8]) -> Result<Self, usize> {
        let start = bytes.get(..START).ok_or(START)?;
        let several = start[5] & SEVERAL != 0;
        let (mut file, mut parts, mut at) = (start.to_vec(), 0, START);
        loop {
            let (name, after_name) = text(bytes, at)?;
            if name.is_empty() {
                // the end of a header; one more zero ends those of several parts
                parts += 1;
                file.push(0);
                at = after_name;
                if several && *bytes.get(at).ok_or(at + 1)? != 0 {
                    continue;
                }
                if several {
                    file.push(0);
                    at += 1;
                }
                return Ok(Self { file, parts, length: at });
            }
            let (_kind, after_kind) = text(bytes, after_name)?;
            let value = after_kind + 4;
            let size = bytes.get(after_kind..value).and_then(|size| size.try_into().ok()).map(u32::from_le_bytes).ok_or(value)?;
            let end = value.saturating_add(size as usize);
            let attribute = bytes.get(at..end).ok_or(end)?;
            if KNOWN.contains(&name) {
                file.extend_from_slice(attribute);
            }
            at = end;
        }
    }
}

/// The text up to the next zero, and the place after that; `Err` is a number of bytes without which it does not end.
fn text(bytes: &[u8], at: usize) -> Result<(&[u8], usize), usize> {
    let rest = bytes.get(at..).unwrap_or_default();
    let length = rest.iter().position(|byte| *byte == 0).ok_or(bytes.len().max(at) + 1)?;
    Ok((&rest[..length], at + length + 1))
}

impl Headers {
    /// Reads the headers of a whole file.
    ///
    /// # Errors
    /// [`DepthError::Map`] says what is wrong with them, or names the limit.
    pub fn read(bytes: &[u8], limits: &Limits) -> Result<Self, DepthError> {
        Self::within(&Skimmed::of(bytes).map_err(|_| cut_short())?, limits)
    }

    fn within(skimmed: &Skimmed, limits: &Limits) -> Result<Self, DepthError> {
        if skimmed.parts > PARTS {
            return Err(DepthError::Map(format!("the OpenEXR file has {} parts, over the limit of {PARTS}", skimmed.parts)));
        }
        let meta = photo::guarded(DepthError::Map, || {
            let meta = MetaData::read_from_buffered(skimmed.file.as_slice(), false).map_err(|e| fault(&e))?;
            MetaData::validate(&meta.headers, false).map_err(|e| fault(&e))?;
            Ok(meta)
        })?;
        let depth = channels::choose(&meta.headers)?;
        let header = &meta.headers[depth.part];
        if matches!(header.compression, Compression::DWAA(_) | Compression::DWAB(_) | Compression::HTJ2K32 | Compression::HTJ2K256) {
            return Err(DepthError::Map(format!("the OpenEXR file has {}, which is not read: save it with ZIP", header.compression)));
        }
        let (stored, shown) = (size(header.layer_size), size(header.shared_attributes.display_window.size));
        for (width, height) in [shown, stored] {
            limits.check_size(width, height).map_err(|e| DepthError::Map(e.to_string()))?;
        }
        let block = block_bytes(header);
        let area = |(width, height): (u32, u32)| u64::from(width) * u64::from(height);
        // unpacking takes about four blocks at a time, and passes through all samples of the part
        let samples = area(stored).saturating_mul(header.channels.bytes_per_pixel as u64);
        let memory = area(shown).saturating_mul(4).saturating_add(block.saturating_mul(4));
        limits.check_memory(memory.max(samples)).map_err(|e| DepthError::Map(e.to_string()))?;
        let block = usize::try_from(block).unwrap_or(usize::MAX);
        Ok(Self { length: skimmed.length, depth, width: shown.0, height: shown.1, block, meta })
    }

    /// The header of the part with depth.
    pub fn part(&self) -> &Header {
        &self.meta.headers[self.depth.part]
    }
}

fn size(Vec2(width, height): Vec2<usize>) -> (u32, u32) {
    let side = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    (side(width), side(height))
}

/// Most bytes of an unpacked block. Tiles may be larger than their picture, but blocks are not.
fn block_bytes(header: &Header) -> u64 {
    let Vec2(width, height) = header.layer_size;
    let (across, down) = match header.blocks {
        BlockDescription::ScanLines => (width, header.compression.scan_lines_per_block()),
        BlockDescription::Tiles(tiles) => (tiles.tile_size.0, tiles.tile_size.1),
    };
    let pixels = (across.min(width) as u64).saturating_mul(down.min(height) as u64);
    pixels.saturating_mul(header.channels.bytes_per_pixel as u64)
}
