//! The blocks of pixels of an OpenEXR file.

use exr::block::UncompressedBlock;
use exr::block::chunk::{Chunk, CompressedBlock, CompressedScanLineBlock, CompressedTileBlock, TileCoordinates};
use exr::compression::Compression;
use exr::math::Vec2;
use exr::meta::{BlockDescription, MetaData};

use super::super::DepthError;
use super::headers::{Headers, cut_short, fault};

/// Bytes of an entry in the tables of the blocks' places.
const PLACE: usize = 8;

/// Where the pixels of a block belong.
#[derive(Clone, Copy)]
enum Place {
    /// The first of its lines.
    Lines(i32),
    Tile(TileCoordinates),
}

/// A block as stored.
pub(super) struct Stored<'a> {
    pub part: usize,
    place: Place,
    packed: &'a [u8],
}

/// All blocks of a file in their order; ends with the first that is not there. They lie one behind the other, so the tables of their places
/// are skipped.
pub(super) struct Chunks<'a> {
    meta: &'a MetaData,
    rest: &'a [u8],
    left: usize,
}

impl<'a> Chunks<'a> {
    /// The blocks behind the headers of this file.
    ///
    /// # Errors
    /// [`DepthError::Map`] if it has not even the tables of their places.
    pub fn new(bytes: &'a [u8], headers: &'a Headers) -> Result<Self, DepthError> {
        let left = headers.meta.headers.iter().fold(0_usize, |sum, header| sum.saturating_add(header.chunk_count));
        let start = left.saturating_mul(PLACE).saturating_add(headers.length);
        let rest = bytes.get(start..).ok_or_else(cut_short)?;
        Ok(Self { meta: &headers.meta, rest, left })
    }

    fn number(&mut self) -> Result<i32, DepthError> {
        let (number, rest) = self.rest.split_first_chunk::<4>().ok_or_else(cut_short)?;
        self.rest = rest;
        Ok(i32::from_le_bytes(*number))
    }

    /// A number that cannot be negative.
    fn count(&mut self) -> Result<usize, DepthError> {
        usize::try_from(self.number()?).map_err(|_| DepthError::Map("a block of the OpenEXR file has a negative place or size".into()))
    }

    fn stored(&mut self) -> Result<Stored<'a>, DepthError> {
        let meta = self.meta;
        let part = if meta.requirements.has_multiple_layers { self.count()? } else { 0 };
        let header = meta.headers.get(part).ok_or_else(|| DepthError::Map(format!("the OpenEXR file has no part {part}")))?;
        let place = match header.blocks {
            BlockDescription::ScanLines => Place::Lines(self.number()?),
            BlockDescription::Tiles(_) => Place::Tile(TileCoordinates {
                tile_index: Vec2(self.count()?, self.count()?),
                level_index: Vec2(self.count()?, self.count()?),
            }),
        };
        let size = self.count()?;
        let (packed, rest) = self.rest.split_at_checked(size).ok_or_else(cut_short)?;
        self.rest = rest;
        Ok(Stored { part, place, packed })
    }
}

impl<'a> Iterator for Chunks<'a> {
    type Item = Result<Stored<'a>, DepthError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.left = self.left.checked_sub(1)?;
        let stored = self.stored();
        if stored.is_err() {
            self.left = 0;
        }
        Some(stored)
    }
}

impl Stored<'_> {
    /// Whether it is of the picture itself and not of a smaller copy.
    pub fn is_of_full_size(&self) -> bool {
        match self.place {
            Place::Lines(_) => true,
            Place::Tile(tile) => tile.is_largest_resolution_level(),
        }
    }

    /// Unpacks it; blocks take no more than [`Headers::block`] bytes.
    ///
    /// # Errors
    /// [`DepthError::Map`] says what is wrong with it.
    pub fn unpack(&self, headers: &Headers) -> Result<UncompressedBlock, DepthError> {
        // what packing would make larger is stored as it is
        if self.packed.len() > headers.block {
            return Err(DepthError::Map("a block of the OpenEXR file is larger than its pixels".into()));
        }
        let header = &headers.meta.headers[self.part];
        let compressed_pixels_le = self.packed.to_vec();
        let compressed_block = match self.place {
            Place::Lines(y_coordinate) => CompressedBlock::ScanLine(CompressedScanLineBlock { y_coordinate, compressed_pixels_le }),
            Place::Tile(coordinates) => CompressedBlock::Tile(CompressedTileBlock { coordinates, compressed_pixels_le }),
        };
        if header.compression == Compression::RLE {
            let place = header.get_block_data_indices(&compressed_block).map_err(|e| fault(&e))?;
            let bounds = header.get_absolute_block_pixel_coordinates(place).map_err(|e| fault(&e))?;
            let most = bounds.size.area() * header.channels.bytes_per_pixel;
            if self.packed.len() != most && exceeds(self.packed, most) {
                return Err(DepthError::Map("a block of the OpenEXR file unpacks to more than its pixels".into()));
            }
        }
        let chunk = Chunk { layer_index: self.part, compressed_block };
        UncompressedBlock::decompress_chunk(chunk, &headers.meta, false).map_err(|e| fault(&e))
    }
}

/// Whether run lengths unpack to more than `most` bytes, which the decoder would only notice after it has unpacked them.
fn exceeds(packed: &[u8], most: usize) -> bool {
    let (mut rest, mut length) = (packed, 0);
    while length < most
        && let [count, tail @ ..] = rest
    {
        let count = i32::from(count.cast_signed());
        // a negative count is of bytes that follow, others are of repetitions of the next byte after itself
        let (bytes, unpacked) = if count < 0 { (-count, -count) } else { (1, count + 1) };
        length += unpacked as usize;
        rest = tail.get(bytes as usize..).unwrap_or_default();
    }
    length > most
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn run_lengths_are_added_up_before_they_are_unpacked() {
        // 3 bytes as they are, then 5 times the next
        let packed = [-3_i8 as u8, 7, 8, 9, 4, 1];
        assert!(!exceeds(&packed, 8) && exceeds(&packed, 7) && !exceeds(&packed, 9));
        // what follows a complete block does not count
        assert!(!exceeds(&packed, 3));
        assert!(!exceeds(&[], 0) && !exceeds(&[127], 128) && exceeds(&[127], 127));
    }
}
