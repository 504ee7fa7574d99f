//! Pictures after a photo in the Multi-Picture Format (CIPA DC-007-2009), and Apple's XMP in its depth maps.

use super::{DepthPicture, SMALL, Scale, number, xmp};
use crate::photo::exif::Tiff;
use crate::photo::segments::applications;
use crate::photo::{self, Limits};

const APPLE: &str = "http://ns.apple.com/pixeldatainfo/1.0/";
const ENTRIES: u16 = 0xB002;
/// Bytes of an entry: attributes, length, offset, and two numbers of other pictures.
const ENTRY: usize = 16;
/// Attribute bits for the type of an entry's picture, and their value for one eye of a 3D camera.
const KIND: u32 = 0x00FF_FFFF;
const EYE: u32 = 0x0002_0002;
/// Most pictures that are looked at.
const MOST: usize = 16;

/// Finds the first picture after the photo that is a depth map.
pub(super) fn find(photo: &[u8]) -> Option<DepthPicture> {
    pictures(photo).find_map(|picture| {
        let packets = xmp::packets(picture);
        let document = packets.iter().find_map(|p| xmp::document(p))?;
        let get = |name| xmp::anywhere(&document, APPLE, name);
        let ends = (number(get("FloatMinValue")), number(get("FloatMaxValue")));
        let kind = get("AuxiliaryImageType")?;
        // mattes also call themselves depth, and have no ends
        if !matches!(kind, "disparity" | "depth") || get("AuxiliaryImageSubType").is_some() {
            return None;
        }
        // a pixel format's number is its four-letter name: half or single floats of disparity or depth
        let native = get("NativeFormat").and_then(|n| n.trim().parse::<u32>().ok()).map(u32::to_be_bytes);
        let distance = match native.as_ref() {
            Some(b"hdep" | b"fdep") => true,
            Some(b"hdis" | b"fdis") => false,
            _ => kind == "depth",
        };
        let (Some(low), Some(high)) = ends else { return Some(Err("the ends of its value range are missing".into())) };
        let scale = if distance { Scale::Distance { near: low, far: high } } else { Scale::Disparity { low, high } };
        Some(
            scale
                .checked()
                .map(|scale| ("multi-picture", picture.to_vec(), scale))
                .ok_or_else(|| format!("values from {low} to {high} do not form a range")),
        )
    })
}

/// The pictures after the first one.
fn pictures(photo: &[u8]) -> impl Iterator<Item = &[u8]> {
    entries(photo).into_iter().filter_map(|entry| entry.picture)
}

/// Finds the picture of the other eye, which 3D cameras write after that of the first; `None` if there is none.
///
/// # Errors
/// The picture extends beyond the end of the file, or is so large that reading it takes more memory than the photo itself.
pub(crate) fn second_picture(photo: &[u8]) -> Option<Result<&[u8], &'static str>> {
    let eye = entries(photo).into_iter().find(|entry| entry.attributes & KIND == EYE)?;
    let Some(picture) = eye.picture else { return Some(Err("the file ends within the picture of the second eye")) };
    // an unreadable picture has no pixels; this copies nothing
    let pixels = |file| photo::upright_size(file, &Limits::NONE).map_or(0, |(w, h)| u64::from(w) * u64::from(h));
    let larger = pixels(picture) > pixels(photo).max(SMALL);
    Some(if larger { Err("the picture of the second eye is larger than that of the first") } else { Ok(picture) })
}

/// A picture after the first.
struct Entry<'a> {
    attributes: u32,
    /// `None` if it is not within the file.
    picture: Option<&'a [u8]>,
}

fn entries(photo: &[u8]) -> Vec<Entry<'_>> {
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
            Some(Entry { attributes: tiff.long(entry)?, picture: photo.get(from..from.checked_add(length)?) })
        }))
    };
    entries().into_iter().flatten().collect()
}
