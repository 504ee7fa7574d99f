//! Pictures behind a photo in the Multi-Picture Format (CIPA DC-007-2009), and what Apple says in the XMP of its depth maps.

use super::{Found, Scale, number, xmp};
use crate::photo::exif::Tiff;
use crate::photo::segments::applications;

const APPLE: &str = "http://ns.apple.com/pixeldatainfo/1.0/";
const ENTRIES: u16 = 0xB002;
/// Bytes of an entry: attributes, length, place, and two numbers of other pictures.
const ENTRY: usize = 16;
/// Pictures that are looked at, at most.
const MOST: usize = 16;

/// The first picture behind the photo that is a depth map.
pub(super) fn find(photo: &[u8]) -> Option<Found> {
    pictures(photo).into_iter().find_map(|picture| {
        let packets = xmp::packets(picture);
        let document = packets.iter().find_map(|p| xmp::document(p))?;
        let get = |name| xmp::anywhere(&document, APPLE, name);
        let ends = (number(get("FloatMinValue")), number(get("FloatMaxValue")));
        let kind = get("AuxiliaryImageType")?;
        // mattes call themselves depth too, and have no ends
        if !matches!(kind, "disparity" | "depth") || get("AuxiliaryImageSubType").is_some() {
            return None;
        }
        // the number of a pixel format is its name of four letters: half or single floats of disparity or depth
        let native = get("NativeFormat").and_then(|n| n.trim().parse::<u32>().ok()).map(u32::to_be_bytes);
        let distance = match native.as_ref() {
            Some(b"hdep" | b"fdep") => true,
            Some(b"hdis" | b"fdis") => false,
            _ => kind == "depth",
        };
        let (Some(low), Some(high)) = ends else { return Some(Err("the ends of its values are not told".into())) };
        let scale = if distance { Scale::Distance { near: low, far: high } } else { Scale::Disparity { low, high } };
        Some(
            scale
                .checked()
                .map(|scale| ("multi-picture", picture.to_vec(), scale))
                .ok_or_else(|| format!("values from {low} to {high} are no range")),
        )
    })
}

/// The pictures behind the first one.
fn pictures(photo: &[u8]) -> Vec<&[u8]> {
    let segments = applications(photo);
    let index = segments.iter().filter(|s| s.number == 2).find_map(|s| Some((s.at + 4, s.body.strip_prefix(b"MPF\0")?)));
    let Some((start, tiff)) = index else { return Vec::new() };
    let entries = || {
        let tiff = Tiff::new(tiff)?;
        let (at, length) = tiff.bytes(tiff.long(4)?, ENTRIES)?;
        Some((1..(length / ENTRY).min(MOST)).filter_map(move |i| {
            let entry = at.checked_add(i * ENTRY)?;
            let (length, place) = (tiff.long(entry + 4)? as usize, tiff.long(entry + 8)? as usize);
            let from = start.checked_add(place)?;
            photo.get(from..from.checked_add(length)?)
        }))
    };
    entries().into_iter().flatten().collect()
}
