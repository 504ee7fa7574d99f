//! Stereo pairs as one file: two JPEGs in the Multi-Picture Format (CIPA DC-007-2009), as 3D cameras write them.

/// Marker of the segment that holds the index.
const APP2: [u8; 2] = [0xFF, 0xE2];
/// Identifier of the segment.
const NAME: &[u8; 4] = b"MPF\0";
/// Header of the directories: big-endian, and the first one follows.
const TIFF: [u8; 8] = *b"MM\0\x2A\0\0\0\x08";
/// Sizes in bytes: a directory without its entries, one entry, and one picture in the index.
const DIRECTORY: usize = 6;
const ENTRY: usize = 12;
const PICTURE: usize = 16;
/// Picture type: one of several eyes. Flag: the picture to show if a reader shows only one.
const DISPARITY: u32 = 0x0002_0002;
const REPRESENTATIVE: u32 = 0x2000_0000;
/// Numerator and denominator of an unknown ratio.
const UNKNOWN: [u32; 2] = [u32::MAX; 2];

/// Value types.
const LONG: u16 = 4;
const RATIONAL: u16 = 5;
const UNDEFINED: u16 = 7;
const SRATIONAL: u16 = 10;

/// Joins the JPEG files of the left and the right eye.
pub(crate) fn join(left: &[u8], right: &[u8]) -> Vec<u8> {
    // the segments' length does not depend on their values
    let first = left.len() + segment(&index(0, 0, 0)).len();
    let second = [right.get(..2).unwrap_or_default(), &segment(&attributes(2, 8)), right.get(2..).unwrap_or_default()].concat();
    // offsets in the file count from the header in the first segment, which follows the start marker, the segment's marker, its length and
    // its name
    let base = 2 + 4 + NAME.len();
    let index = index(first as u32, second.len() as u32, (first - base) as u32);
    [left.get(..2).unwrap_or_default(), &segment(&index), left.get(2..).unwrap_or_default(), &second].concat()
}

fn segment(body: &[u8]) -> Vec<u8> {
    let length = (2 + NAME.len() + TIFF.len() + body.len()) as u16;
    [&APP2[..], &length.to_be_bytes(), NAME, &TIFF, body].concat()
}

/// The directory of the whole file, then that of the first picture. `first` and `second` are the pictures' sizes in bytes; `place` is the
/// offset of the second.
fn index(first: u32, second: u32, place: u32) -> Vec<u8> {
    let pictures_at = TIFF.len() + DIRECTORY + 3 * ENTRY;
    let next = pictures_at + 2 * PICTURE;
    let entries = [
        entry(0xB000, UNDEFINED, 4, *b"0100"),
        entry(0xB001, LONG, 1, 2u32.to_be_bytes()),
        entry(0xB002, UNDEFINED, 2 * PICTURE as u32, (pictures_at as u32).to_be_bytes()),
    ];
    let picture = |kind: u32, bytes: u32, place: u32| [kind, bytes, place, 0].map(u32::to_be_bytes).concat();
    let pictures = [picture(REPRESENTATIVE | DISPARITY, first, 0), picture(DISPARITY, second, place)].concat();
    [directory(&entries, next as u32), pictures, attributes(1, next)].concat()
}

/// The directory of picture `number`, which starts `at` bytes after the header. The distance between the eyes is unknown, because the
/// photo's scale is.
fn attributes(number: u32, at: usize) -> Vec<u8> {
    let ratios_at = (at + DIRECTORY + 5 * ENTRY) as u32;
    let entries = [
        entry(0xB000, UNDEFINED, 4, *b"0100"),
        entry(0xB101, LONG, 1, number.to_be_bytes()),
        entry(0xB204, LONG, 1, 1u32.to_be_bytes()),
        entry(0xB205, SRATIONAL, 1, ratios_at.to_be_bytes()),
        entry(0xB206, RATIONAL, 1, (ratios_at + 8).to_be_bytes()),
    ];
    [directory(&entries, 0), [UNKNOWN, UNKNOWN].as_flattened().iter().flat_map(|v| v.to_be_bytes()).collect()].concat()
}

fn directory(entries: &[[u8; ENTRY]], next: u32) -> Vec<u8> {
    [&(entries.len() as u16).to_be_bytes()[..], entries.as_flattened(), &next.to_be_bytes()].concat()
}

fn entry(tag: u16, kind: u16, count: u32, value: [u8; 4]) -> [u8; ENTRY] {
    let mut bytes = [0; ENTRY];
    bytes[..2].copy_from_slice(&tag.to_be_bytes());
    bytes[2..4].copy_from_slice(&kind.to_be_bytes());
    bytes[4..8].copy_from_slice(&count.to_be_bytes());
    bytes[8..].copy_from_slice(&value);
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Value of an entry of the directory that begins at `at` bytes behind the header.
    fn value(tiff: &[u8], at: usize, tag: u16) -> Option<u32> {
        let count = u16::from_be_bytes(tiff[at..at + 2].try_into().unwrap()) as usize;
        let mut entries = tiff[at + 2..].as_chunks::<ENTRY>().0.iter().take(count);
        entries.find(|e| e[..2] == tag.to_be_bytes()).map(|e| u32::from_be_bytes(e[8..].try_into().unwrap()))
    }

    #[test]
    fn the_index_finds_both_pictures() {
        let [left, right] = [b"\xff\xd8left\xff\xd9".as_slice(), b"\xff\xd8the right one\xff\xd9"];
        let file = join(left, right);
        assert!(file.starts_with(b"\xff\xd8\xff\xe2") && file.ends_with(b"right one\xff\xd9"));
        let tiff = &file[10..];
        let number = |at: usize| u32::from_be_bytes(tiff[at..at + 4].try_into().unwrap());
        assert_eq!((value(tiff, 8, 0xB001), &tiff[..8]), (Some(2), &TIFF[..]));
        let pictures = value(tiff, 8, 0xB002).unwrap() as usize;
        let [first, place, second] = [pictures + 4, pictures + 24, pictures + 20].map(|at| number(at) as usize);
        assert_eq!((number(pictures), number(pictures + 16), number(pictures + 8)), (REPRESENTATIVE | DISPARITY, DISPARITY, 0));
        assert!(file[..first].ends_with(b"left\xff\xd9") && place + 10 == first && first + second == file.len());
        assert!(file[place + 10..].starts_with(b"\xff\xd8\xff\xe2"));
        // the directories of the pictures themselves
        let own = u32::from_be_bytes(tiff[8 + 2 + 3 * ENTRY..][..4].try_into().unwrap()) as usize;
        assert_eq!(value(tiff, own, 0xB101), Some(1));
        let other = &file[place + 20..];
        assert_eq!((value(other, 8, 0xB101), value(other, 8, 0xB204)), (Some(2), Some(1)));
        let ratios = value(other, 8, 0xB205).unwrap() as usize;
        assert_eq!(other[ratios..ratios + 16], [0xFF; 16]);
    }
}
