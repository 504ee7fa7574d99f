//! Sections packed with zstd: planes that repeat from tile to tile, and refined alphas.

use prost::Message;
use ruzstd::decoding::{BlockDecodingStrategy, FrameDecoder};

use super::schema::{Codec, Kind, Section};
use super::select_sections::header;
use super::{ContainerError, bounds, columns, decode};

/// A zstd block has at least 4 bytes and holds at most 128 KiB.
const MIN_BLOCK: usize = 4;
const MAX_CONTENT: usize = 128 << 10;
/// A frame's window may exceed its content by this many bytes, because writers round it up.
const SLACK: usize = 1 << 20;

/// Unpacks the zstd sections of a container, for readers without zstd. Appends the unpacked sections at the end; sections that such readers
/// ignore stay packed.
///
/// # Errors
/// [`ContainerError::Broken`], [`ContainerError::Bound`] or [`ContainerError::Newer`].
pub fn unpacked(container: &[u8]) -> Result<Vec<u8>, ContainerError> {
    let (mut index, body) = decode::split(container)?;
    let (grid, ..) = decode::cameras(&index)?;
    let planes = index.planes as usize;
    bounds::planes(&grid, planes)?;
    let tile = u64::from(grid.size.min(grid.width)) * u64::from(grid.size.min(grid.height));
    // for alphas, one byte for each possible texel
    let most = |kind| if kind == Kind::Planes { columns::bytes(grid.tiles() as usize, planes) as u64 } else { planes as u64 * tile };
    let mut added = Vec::new();
    for kind in [Kind::Planes, Kind::Alpha] {
        // readers use the first section of a kind
        let Some(s) = index.sections.iter_mut().find(|s| s.kind() == kind).filter(|s| s.codec() == Codec::Zstd) else { continue };
        if s.raw_length > most(kind) {
            return Err(ContainerError::broken(format!("section {} has the wrong length", s.kind)));
        }
        let raw = section(s, decode::range(s, body)?, s.raw_length as usize)?;
        s.set_codec(Codec::Raw);
        (s.offset, s.length) = ((body.len() + added.len()) as u64, raw.len() as u64);
        added.extend(raw);
    }
    Ok([&header(&container[4..8], &index.encode_to_vec())[..], body, &added].concat())
}

/// Unpacks a section to at most `want` bytes.
pub(super) fn section(s: &Section, data: &[u8], want: usize) -> Result<Vec<u8>, ContainerError> {
    if want > (data.len() / MIN_BLOCK).saturating_mul(MAX_CONTENT) {
        return Err(ContainerError::broken(format!("section {} cannot unpack to {want} bytes", s.kind)));
    }
    decompress(data, want)
}

/// Decompresses a single zstd frame of at most `want` bytes. Checks its window before allocating it, and the output while decompressing.
fn decompress(mut data: &[u8], want: usize) -> Result<Vec<u8>, ContainerError> {
    // the texts of its own errors would be a tenth of the wasm
    let damaged = || ContainerError::broken("a zstd frame is damaged");
    if window(data).is_some_and(|window| window > (want + SLACK) as u64) {
        return Err(ContainerError::broken("a zstd frame has a window larger than its content"));
    }
    let mut decoder = FrameDecoder::new();
    decoder.init(&mut data).map_err(|_| damaged())?;
    while !decoder.is_finished() {
        decoder.decode_blocks(&mut data, BlockDecodingStrategy::UptoBlocks(1)).map_err(|_| damaged())?;
        if decoder.can_collect() > want {
            return Err(ContainerError::broken("a zstd frame is longer than declared"));
        }
    }
    Ok(decoder.collect().unwrap_or_default())
}

/// The window size that a zstd frame declares; `None` for a single segment, whose window is its content.
fn window(frame: &[u8]) -> Option<u64> {
    let (flags, window) = (frame.get(4)?, u64::from(*frame.get(5)?));
    let base = 1u64 << (10 + (window >> 3));
    (flags & 0x20 == 0).then_some(base + base / 8 * (window & 7))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_of_a_frame_is_checked_before_it_is_allocated() {
        let frame = |flags: u8, window: u8| [0x28, 0xb5, 0x2f, 0xfd, flags, window];
        assert_eq!(window(&frame(0, 0)), Some(1024));
        // 2¹⁰⁺³ bytes, plus five eighths
        assert_eq!(window(&frame(0, 3 << 3 | 5)), Some(13_312));
        assert_eq!(window(&frame(0x20, 3 << 3 | 5)), None);
        assert_eq!(window(&frame(0, 0)[..5]), None);
        let refused = |want| decompress(&frame(0, 20 << 3), want).unwrap_err().to_string().contains("window larger");
        let most = (1 << 30) - SLACK;
        assert!(refused(most - 1) && refused(0) && !refused(most));
    }
}
