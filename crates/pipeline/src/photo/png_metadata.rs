//! Walks the chunks of a PNG file: reads its size and metadata, and writes the file again with only what its pixels need.

use std::io::Cursor;

use image::codecs::png::PngDecoder;

use super::colour::Profile;
use super::exif::Facts;
use super::{Head, Limits, MAX_PROFILE, PhotoError, broken};

const SIGNATURE: usize = 8;
/// The end chunk of a file.
const END: &[u8] = b"\0\0\0\0IEND\xAE\x42\x60\x82";
/// Most bytes of a palette: 256 colours.
const MAX_PALETTE: usize = 3 * 256;
/// Decoder memory beyond the pixels, in bytes: for an unpacked colour profile and for rows in progress.
const WORKING: u64 = 2 * MAX_PROFILE as u64;

/// What the chunks of a PNG file say.
#[derive(Debug)]
pub(crate) struct Png<'a> {
    /// Signature and the chunks that determine pixels and colours; of an animation, those of the still picture.
    stripped: Vec<u8>,
    /// TIFF structure of the EXIF chunk.
    exif: Option<&'a [u8]>,
    /// The EXIF chunk follows the picture.
    late: bool,
    /// Colours by `cICP` code points, which outrank a profile.
    pub(super) cicp: Option<Profile>,
    pub width: u32,
    pub height: u32,
    /// Bytes per decoded pixel.
    pub bytes_per_pixel: u64,
    /// A checksum of the picture data is wrong: the picture may look other than it was written.
    pub(super) damaged: bool,
}

/// Width and height of a PNG. The header chunk comes first and has a fixed length.
pub(super) fn size(bytes: &[u8]) -> Result<(u32, u32), PhotoError> {
    let Some(head) = bytes.get(8..24).filter(|h| &h[4..8] == b"IHDR") else { return Err(broken("no PNG header")) };
    let side = |at: usize| u32::from_be_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
    Ok((side(8), side(12)))
}

/// Samples per pixel of a colour type, without a `tRNS` colour.
fn channels_of(colour: u8) -> Result<u64, PhotoError> {
    match colour {
        0 => Ok(1),
        4 => Ok(2),
        2 | 3 => Ok(3),
        6 => Ok(4),
        _ => Err(broken("unknown colour type")),
    }
}

/// Bytes of a decoded picture.
fn memory((width, height): (u32, u32), channels: u64, depth: u8) -> u64 {
    let pixels = u64::from(width) * u64::from(height);
    pixels.saturating_mul(channels * if depth == 16 { 2 } else { 1 })
}

/// Reads the size from the first bytes, which begin with PNG's signature.
pub(super) fn head(bytes: &[u8], limits: &Limits) -> Result<Head, PhotoError> {
    let Some(&[depth, colour]) = bytes.get(24..26) else { return Ok(Head::Needs(26)) };
    let (width, height) = size(bytes)?;
    limits.check_size(width, height)?;
    limits.check_memory(memory((width, height), channels_of(colour)?, depth))?;
    Ok(Head::Size(width, height))
}

/// Reads all chunks, after it has checked size and memory against the limits. A file that ends within the picture was cut short; one that
/// ends after it is complete.
pub(crate) fn scan<'a>(bytes: &'a [u8], limits: &Limits) -> Result<Png<'a>, PhotoError> {
    head(bytes, limits)?;
    let (width, height) = size(bytes)?;
    limits.check_size(width, height)?;
    let Some(&[depth, colour]) = bytes.get(24..26) else { return Err(broken("the file is cut short")) };
    let mut channels = channels_of(colour)?;
    let mut png = Png {
        stripped: Vec::with_capacity(bytes.len()),
        exif: None,
        late: false,
        cicp: None,
        width,
        height,
        bytes_per_pixel: 0,
        damaged: false,
    };
    png.stripped.extend_from_slice(&bytes[..SIGNATURE]);
    let (mut at, mut pictures) = (SIGNATURE, false);
    while at < bytes.len() {
        let head: Option<[u8; 8]> = bytes.get(at..at + 8).and_then(|h| h.try_into().ok());
        let length = head.map_or(0, |h| u32::from_be_bytes([h[0], h[1], h[2], h[3]]) as usize);
        // length, name and checksum are 4 bytes each
        let (Some(head), Some(chunk)) = (head, bytes.get(at..).and_then(|b| b.get(..length.checked_add(12)?))) else {
            if pictures && head.is_none_or(|head| &head[4..] != b"IDAT") {
                break;
            }
            return Err(broken("the file is cut short"));
        };
        at += chunk.len();
        match &head[4..] {
            b"tRNS" if !pictures => {
                channels += u64::from(matches!(colour, 0 | 2 | 3));
                png.stripped.extend_from_slice(chunk);
            }
            b"iCCP" if length > MAX_PROFILE => {}
            b"cICP" if !pictures => png.cicp = Profile::cicp(&chunk[8..8 + length]),
            // the decoder reads colours of three bytes and panics if the last one is short
            b"PLTE" if length == 0 || length > MAX_PALETTE || !length.is_multiple_of(3) => {
                return Err(broken("the palette is not 1 to 256 colours of three bytes"));
            }
            b"IHDR" | b"PLTE" | b"iCCP" => png.stripped.extend_from_slice(chunk),
            b"IDAT" => {
                pictures = true;
                let (rest, checksum) = chunk.split_at(8 + length);
                let sum = crc32fast::hash(&rest[4..]).to_be_bytes();
                png.damaged |= sum != checksum;
                png.stripped.extend_from_slice(rest);
                png.stripped.extend_from_slice(&sum);
            }
            b"eXIf" if png.exif.is_none() => (png.exif, png.late) = (Some(&chunk[8..8 + length]), pictures),
            b"IEND" => break,
            _ => {}
        }
    }
    if !pictures {
        return Err(broken("no picture data"));
    }
    png.stripped.extend_from_slice(END);
    png.bytes_per_pixel = channels * if depth == 16 { 2 } else { 1 };
    limits.check_memory(memory((width, height), channels, depth))?;
    Ok(png)
}

impl Png<'_> {
    /// Facts from the EXIF chunk. A chunk after the picture sets no orientation: browsers show a picture while it arrives, and do not
    /// look there.
    pub(super) fn facts(&self) -> Facts {
        let facts = Facts::read(self.exif);
        if self.late { Facts { orientation: 1, ..facts } } else { facts }
    }

    /// A decoder that is limited to little memory beyond the pixels it returns.
    pub(crate) fn decoder(&self) -> Result<PngDecoder<Cursor<&[u8]>>, PhotoError> {
        let mut bounds = image::Limits::no_limits();
        bounds.max_alloc = Some(WORKING);
        PngDecoder::with_limits(Cursor::new(self.stripped.as_slice()), bounds).map_err(broken)
    }
}
