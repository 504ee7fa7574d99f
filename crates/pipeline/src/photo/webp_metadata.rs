//! Walks the chunks of a WebP file: reads its size and metadata, and writes the file again without metadata.

use super::{Head, Limits, PhotoError, broken};

/// What the chunks of a WebP file say, and the file reduced to what a decoder needs.
#[derive(Debug)]
pub(super) struct WebP {
    pub width: u32,
    pub height: u32,
    pub animated: bool,
    pub alpha: bool,
    pub lossless: bool,
    /// RIFF file with only the picture's chunks.
    pub stripped: Vec<u8>,
    pub exif: Option<Vec<u8>>,
    pub icc: Option<Vec<u8>>,
}

impl WebP {
    /// A file of which nothing is known yet.
    const NONE: Self =
        Self { width: 0, height: 0, animated: false, alpha: false, lossless: false, stripped: Vec::new(), exif: None, icc: None };

    /// Memory that decoding takes, in bytes, including the result.
    pub(super) fn memory(&self) -> u64 {
        (u64::from(self.width) * u64::from(self.height)).saturating_mul(self.bytes_per_pixel())
    }

    /// Bytes per pixel that decoding takes, including the result.
    fn bytes_per_pixel(&self) -> u64 {
        match (self.animated, self.lossless, self.alpha) {
            // canvas, frame and result in RGBA
            (true, ..) => 12,
            (false, true, _) => 8,
            // Y′CbCr, an alpha plane, RGBA
            (false, false, true) => 7,
            (false, false, false) => 5,
        }
    }
}

const ANIMATED: u8 = 0x02;
const ALPHA: u8 = 0x10;
/// Flag of a frame that replaces what is below.
const UNBLENDED: u8 = 0x02;

fn u24(b: &[u8]) -> u32 {
    u32::from_le_bytes([b[0], b[1], b[2], 0])
}

/// Name, contents, and the bytes after the chunk.
type Chunk<'a> = ([u8; 4], &'a [u8], &'a [u8]);

/// Splits off the first chunk.
fn chunk(bytes: &[u8]) -> Result<Chunk<'_>, PhotoError> {
    let cut = || broken("the file is cut short");
    let (head, rest) = bytes.split_at_checked(8).ok_or_else(cut)?;
    let length = u32::from_le_bytes([head[4], head[5], head[6], head[7]]) as usize;
    let (body, rest) = rest.split_at_checked(length).ok_or_else(cut)?;
    // chunks start at even offsets; writers often forget the padding of the last one
    Ok(([head[0], head[1], head[2], head[3]], body, rest.get(length % 2..).unwrap_or_default()))
}

/// Size in the header of a `VP8 ` or `VP8L` bitstream.
fn bitstream_size(name: [u8; 4], body: &[u8]) -> Result<(u32, u32), PhotoError> {
    match (&name, body) {
        (b"VP8 ", [_, _, _, 0x9D, 0x01, 0x2A, w0, w1, h0, h1, ..]) => {
            Ok((u32::from(u16::from_le_bytes([*w0, *w1]) & 0x3FFF), u32::from(u16::from_le_bytes([*h0, *h1]) & 0x3FFF)))
        }
        (b"VP8L", [0x2F, a, b, c, d, ..]) => {
            let bits = u32::from_le_bytes([*a, *b, *c, *d]);
            Ok(((bits & 0x3FFF) + 1, ((bits >> 14) & 0x3FFF) + 1))
        }
        _ => Err(broken("damaged picture header")),
    }
}

/// Bytes of the first chunk's contents that hold the size.
const SIZE: usize = 10;

/// Reads the size from the first bytes, which begin with `RIFF....WEBP`.
pub(super) fn head(bytes: &[u8], limits: &Limits) -> Result<Head, PhotoError> {
    let Some((&[a, b, c, d, l0, l1, l2, l3], content)) = bytes.get(12..20 + SIZE).and_then(|first| first.split_first_chunk()) else {
        return Ok(Head::Needs(20 + SIZE));
    };
    let (name, length) = ([a, b, c, d], u32::from_le_bytes([l0, l1, l2, l3]) as usize);
    let content = &content[..length.min(SIZE)];
    let (flags, (width, height)) = match (&name, content) {
        (b"VP8X", &[flags, _, _, _, w0, w1, w2, h0, h1, h2]) => (flags, (u24(&[w0, w1, w2]) + 1, u24(&[h0, h1, h2]) + 1)),
        (b"VP8 " | b"VP8L", _) => (0, bitstream_size(name, content)?),
        _ => return Ok(Head::Silent),
    };
    limits.check_size(width, height)?;
    // only a later chunk tells whether a canvas has a lossless picture
    let least =
        WebP { width, height, animated: flags & ANIMATED != 0, alpha: flags & ALPHA != 0, lossless: &name == b"VP8L", ..WebP::NONE };
    limits.check_memory(least.memory())?;
    Ok(Head::Size(width, height))
}

/// Reads all chunks up to the length in the RIFF header, or to the end of the file. What follows a complete picture does not belong to
/// it. `bytes` begins with `RIFF....WEBP`.
pub(super) fn scan(bytes: &[u8]) -> Result<WebP, PhotoError> {
    let riff = u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]) as usize;
    let file = bytes.get(..riff.saturating_add(8)).unwrap_or(bytes);
    let Some(mut rest) = file.get(12..) else { return Err(broken("the file is cut short")) };
    let mut webp = WebP::NONE;
    let mut body = Vec::with_capacity(rest.len());
    let (mut extended, mut pictures) = (false, 0);
    while rest.len() >= 8 {
        let (name, content, tail) = match chunk(rest) {
            Err(_) if pictures > 0 => break,
            chunk => chunk?,
        };
        rest = tail;
        match &name {
            b"VP8X" if !extended && pictures == 0 => {
                let [flags, _, _, _, size @ ..] = content else { return Err(broken("the VP8X chunk is too short")) };
                if size.len() < 6 {
                    return Err(broken("the VP8X chunk is too short"));
                }
                (webp.width, webp.height) = (u24(&size[..3]) + 1, u24(&size[3..6]) + 1);
                webp.animated = flags & ANIMATED != 0;
                webp.alpha = flags & ALPHA != 0;
                extended = true;
                let mut head = content[..10].to_vec();
                // a picture may cover only a part of its canvas: the rest is transparent, not black
                head[0] = flags & (ANIMATED | ALPHA) | if webp.animated { ALPHA } else { 0 };
                push(&mut body, name, &head);
            }
            b"VP8 " | b"VP8L" if pictures == 0 && !webp.animated => {
                let size = bitstream_size(name, content)?;
                if extended && size != (webp.width, webp.height) {
                    return Err(broken("its size differs from that of its canvas"));
                }
                (webp.width, webp.height) = size;
                webp.lossless = &name == b"VP8L";
                pictures += 1;
                push(&mut body, name, content);
            }
            b"ANMF" if webp.animated => {
                check_frame(content, (webp.width, webp.height))?;
                pictures += 1;
                // the other frames are not shown
                if pictures == 1 {
                    // there is nothing below to blend with, and blending rounds
                    let mut frame = content.to_vec();
                    frame[15] |= UNBLENDED;
                    push(&mut body, name, &frame);
                }
            }
            b"ALPH" if pictures == 0 && extended => push(&mut body, name, content),
            b"ANIM" if webp.animated => push(&mut body, name, content),
            b"EXIF" if webp.exif.is_none() => {
                // some writers keep the prefix of the JPEG segment
                webp.exif = Some(content.strip_prefix(b"Exif\0\0").unwrap_or(content).to_vec());
            }
            b"ICCP" if webp.icc.is_none() && content.len() <= super::MAX_PROFILE => webp.icc = Some(content.to_vec()),
            _ => {}
        }
    }
    if pictures == 0 {
        return Err(broken("no picture data"));
    }
    let mut out = Vec::with_capacity(body.len() + 12);
    out.extend_from_slice(b"RIFF");
    out.extend_from_slice(&((body.len() + 4) as u32).to_le_bytes());
    out.extend_from_slice(b"WEBP");
    out.extend_from_slice(&body);
    webp.stripped = out;
    Ok(webp)
}

/// Checks that a frame's bitstream has the frame's size and lies on the canvas. Otherwise its decoder would take unchecked memory.
fn check_frame(frame: &[u8], canvas: (u32, u32)) -> Result<(), PhotoError> {
    let Some((head, mut rest)) = frame.split_at_checked(16) else { return Err(broken("a frame is too short")) };
    let size = (u24(&head[6..9]) + 1, u24(&head[9..12]) + 1);
    if size.0 > canvas.0 || size.1 > canvas.1 {
        return Err(broken("a frame is larger than its canvas"));
    }
    while rest.len() >= 8 {
        let (name, content, tail) = chunk(rest)?;
        rest = tail;
        if matches!(&name, b"VP8 " | b"VP8L") && bitstream_size(name, content)? != size {
            return Err(broken("the size of a frame differs from that in its header"));
        }
    }
    Ok(())
}

fn push(out: &mut Vec<u8>, name: [u8; 4], body: &[u8]) {
    out.extend_from_slice(&name);
    out.extend_from_slice(&(body.len() as u32).to_le_bytes());
    out.extend_from_slice(body);
    if body.len() % 2 == 1 {
        out.push(0);
    }
}
