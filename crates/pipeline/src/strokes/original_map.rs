//! Stores the map before the strokes inside the file of the map after them, so that all strokes can be applied again after a change.
//!
//! It is a chunk of the PNG file that readers of pictures skip (ancillary, private, unsafe to copy), directly after the header, so that
//! the beginning of a file suffices to read it.

use super::region::SIDE;
use crate::depth::{DepthError, resized, to_png};
use crate::photo::reduced_size;
use tmpi_core::DisparityMap;

/// Bytes of the signature and of the header's chunk of 13 bytes, which comes first in every PNG file.
const HEADER: usize = 8 + 12 + 13;
const CHUNK: &[u8; 4] = b"bfST";
/// Bytes of length and name, which precede a chunk's data; its checksum follows.
const NAMED: usize = 8;
/// Most bytes of the stored map: 16 bits per pixel, as much again for what does not compress, and the overhead of a PNG file.
const MOST: usize = 4 * (SIDE * SIDE) as usize + (1 << 16);
/// Bytes from the beginning of a file that suffice for [`before`].
pub const HEAD: usize = HEADER + NAMED + MOST;

/// The map as it is stored: at most 640 pixels on its longer side, as in the picture in which outlines are found, and without mixing
/// across edges.
pub fn to_keep(map: &DisparityMap) -> DisparityMap {
    let (width, height) = reduced_size((map.width, map.height), Some(SIDE));
    if (width, height) == (map.width, map.height) { map.clone() } else { resized(map, width, height) }
}

/// Inserts the map before the strokes into `file`, a PNG of the map after them.
///
/// # Errors
/// [`DepthError::Write`] if the map cannot be encoded, is too large, or `file` is too short.
pub fn keep(file: &[u8], before: &DisparityMap) -> Result<Vec<u8>, DepthError> {
    let map = to_png(before)?;
    let Some((header, rest)) = file.split_at_checked(HEADER).filter(|_| map.len() <= MOST) else {
        return Err(DepthError::Write(format!("a map of {} bytes does not fit into a file of {} bytes", map.len(), file.len())));
    };
    let length = u32::try_from(map.len()).map_err(|e| DepthError::Write(e.to_string()))?;
    let mut checksum = crc32fast::Hasher::new();
    checksum.update(CHUNK);
    checksum.update(&map);
    Ok([header, &length.to_be_bytes(), CHUNK, &map, &checksum.finalize().to_be_bytes(), rest].concat())
}

/// Finds the PNG of the map before the strokes in the beginning of a file; [`HEAD`] bytes suffice. `None` if no map is stored.
pub fn before(head: &[u8]) -> Option<&[u8]> {
    let named = head.get(HEADER..HEADER + NAMED)?;
    let (length, name) = named.split_first_chunk::<4>()?;
    let length = u32::from_be_bytes(*length) as usize;
    (name == CHUNK).then(|| head.get(HEADER + NAMED..)?.get(..length))?
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth::{DepthKind, from_map};
    use crate::photo::Limits;

    fn read(file: &[u8], (w, h): (u32, u32)) -> DisparityMap {
        let (map, size) = from_map(file, DepthKind::Disparity, &Limits::default(), w, h).unwrap();
        assert_eq!(size, (w, h));
        map
    }

    #[test]
    fn both_maps_are_read_back_and_picture_readers_see_only_the_map_after() {
        let (after, before_them) =
            (DisparityMap::from_fn(40, 30, |x, y| (x + y) as f32 / 70.0), DisparityMap::from_fn(40, 30, |x, _| x as f32 / 40.0));
        let plain = to_png(&after).unwrap();
        let file = keep(&plain, &before_them).unwrap();
        assert!(before(&plain).is_none() && before(&[]).is_none() && before(&plain[..20]).is_none());
        let kept = read(before(&file).unwrap(), (40, 30));
        assert!(kept.delta.iter().zip(&before_them.delta).all(|(a, b)| (a - b).abs() < 1e-4));
        assert_eq!(read(&file, (40, 30)), read(&plain, (40, 30)));
        // with a decoder that checks every chunk's checksum
        let seen = image::load_from_memory(&file).unwrap().into_luma16();
        assert_eq!(seen, image::load_from_memory(&plain).unwrap().into_luma16());
        for cut in 0..file.len() {
            let told = before(&file[..cut]);
            assert!(told.is_none() || told == before(&file), "cut at {cut}");
        }
    }

    #[test]
    fn a_large_map_is_stored_small_with_its_edges_and_the_worst_map_fits() {
        let kept = to_keep(&DisparityMap::from_fn(2000, 1000, |x, _| if x < 1000 { 0.2 } else { 0.8 }));
        assert_eq!((kept.width, kept.height), (640, 320));
        assert!(kept.delta.iter().all(|d| (d - 0.2).abs() < 1e-6 || (d - 0.8).abs() < 1e-6));
        let noise = DisparityMap::from_fn(SIDE, SIDE, |x, y| ((x * 7919 + y * 104_729) % 65_521) as f32 / 65_521.0);
        let file = keep(&to_png(&DisparityMap::from_fn(9, 9, |_, _| 0.5)).unwrap(), &noise).unwrap();
        assert_eq!(before(&file[..HEAD.min(file.len())]).map(<[u8]>::len), before(&file).map(<[u8]>::len));
        assert!(before(&file).is_some());
    }
}
