//! Walks the segments of a JPEG file: reads its size and metadata, and writes the file again without metadata.

use super::jpeg_frame::{Colour, Frame, Layout, is_frame, tables};
use super::segments::{entropy_end, next_marker, segment};
use super::{Head, Limits, PhotoError, broken};

/// What the segments of a JPEG file say, and the file reduced to what a decoder needs.
#[derive(Debug)]
#[allow(clippy::struct_excessive_bools, reason = "independent facts about a file")]
pub(super) struct Jpeg {
    pub width: u32,
    pub height: u32,
    pub colour: Colour,
    /// Memory that decoding takes, in bytes, including the result.
    pub memory: u64,
    /// Bytes of entropy-coded data in all scans.
    data: u64,
    /// Fewest bytes that can code the frame's blocks.
    least_data: u64,
    /// Offset in `stripped` of the frame's height, two bytes.
    height_at: usize,
    /// Offset in `stripped` of the end of the first scan.
    first_scan_end: usize,
    /// Every scan refines the whole picture.
    pub progressive: bool,
    pub layout: Layout,
    /// Count of scans.
    pub scans: usize,
    /// The scans deliver every coefficient of every component to its last bit.
    pub complete: bool,
    /// The file has an end marker and every code table that its scans use.
    pub standalone: bool,
    /// The picture alone: no `APPn` but JFIF (without its thumbnail) and Adobe, no comments, and only the end marker after the last scan.
    pub stripped: Vec<u8>,
    /// TIFF structure of the first EXIF segment.
    pub exif: Option<Vec<u8>>,
    /// ICC profile, joined from its segments.
    pub icc: Option<Vec<u8>>,
}

/// Most scans of a file. Decoding takes scans × blocks, and a scan of a few bytes covers any number of blocks (LJT-01-003). Encoders of
/// progressive files write 10 to 64.
pub(super) const MAX_SCANS: usize = 100;

impl Jpeg {
    /// Refuses a file with too little data for its frame: a block takes at least two bits, or one in a progressive file.
    pub(super) fn check_data(&self) -> Result<(), PhotoError> {
        if self.data < self.least_data {
            let (have, least) = (self.data, self.least_data);
            return Err(PhotoError::Broken(format!("{have} bytes of picture data, but its size needs at least {least}: it was cut short")));
        }
        Ok(())
    }

    /// The file with `bytes` after its last scan, in place of the end marker. If they change the pixels, the file has too little data.
    pub(super) fn followed_by(&self, bytes: &[u8]) -> Vec<u8> {
        [&self.stripped[..self.stripped.len() - END.len()], bytes].concat()
    }

    /// The file for a strict decoder. Such a decoder fills in zeros for what an end marker cuts off, but fails at the end of the file. So
    /// a file of one scan ends in a few zeros, which the decoder may read ahead, and no marker.
    pub(super) fn open(&self) -> Vec<u8> {
        if self.progressive { self.stripped.clone() } else { self.followed_by(&[0; READ_AHEAD]) }
    }

    /// The part of the file that has to be intact for a damaged picture to be worth showing: the upper [`MOST`] of its rows or, in a
    /// progressive file, the first scan.
    pub(super) fn most(&self) -> Vec<u8> {
        if self.progressive {
            return [&self.stripped[..self.first_scan_end], &END].concat();
        }
        let mut file = self.open();
        let rows = self.most_rows() as u16;
        file[self.height_at..self.height_at + 2].copy_from_slice(&rows.to_be_bytes());
        file
    }

    /// Rows that must decode without an error.
    pub(super) fn most_rows(&self) -> u64 {
        (u64::from(self.height) * MOST.0).div_ceil(MOST.1)
    }
}

/// Most segments, and bytes between them, that [`head`] walks before the frame header. Longer headers are left to the check of the whole
/// file, so that bytes that arrive one by one stay cheap.
const MAX_STEPS: usize = 1024;

/// Reads the size from the first bytes, which begin with JPEG's marker.
pub(super) fn head(bytes: &[u8], limits: &Limits) -> Result<Head, PhotoError> {
    let mut at = 2;
    for _ in 0..MAX_STEPS {
        let Some(&[first, marker]) = bytes.get(at..at + 2) else { return Ok(Head::Needs(at + 2)) };
        match (first, marker) {
            (0xFF, 0xFF) => {
                at += 1;
                continue;
            }
            (0xFF, 0x01 | 0xD0..=0xD8) => {
                at += 2;
                continue;
            }
            (0xFF, 0x00 | 0xD9 | 0xDA) | (0..=0xFE, _) => return Ok(Head::Silent),
            _ => {}
        }
        let Some(&[high, low]) = bytes.get(at + 2..at + 4) else { return Ok(Head::Needs(at + 4)) };
        let end = at + 2 + usize::from(u16::from_be_bytes([high, low]));
        if end < at + 4 {
            return Ok(Head::Silent);
        }
        if is_frame(marker) {
            let Some(body) = bytes.get(at + 4..end) else { return Ok(Head::Needs(end)) };
            let frame = Frame::read(marker, body)?;
            limits.check_size(frame.width, frame.height)?;
            // whether a scan holds all components is only known later
            limits.check_memory(frame.memory())?;
            return Ok(Head::Size(frame.width, frame.height));
        }
        at = end;
    }
    Ok(Head::Silent)
}

/// Bytes that a decoder may read beyond its current block.
pub(super) const READ_AHEAD: usize = 16;

/// Share of the rows, as a fraction, that must decode without an error.
const MOST: (u64, u64) = (3, 4);

/// The end marker (EOI).
pub(super) const END: [u8; 2] = [0xFF, 0xD9];
/// Marks a frame of Motion JPEG: decoders then use the standard's code tables for missing ones.
const MOTION: &[u8] = b"AVI1\0\0\0\0\0\0\0\0\0\0";

/// Reads all segments up to the end marker. Without a marker the file ends at its last readable part, which must include some picture
/// data.
pub(super) fn scan(bytes: &[u8]) -> Result<Jpeg, PhotoError> {
    let mut walk = Walk { bytes, at: 2, out: vec![0xFF, 0xD8], ..Walk::default() };
    walk.out.reserve(bytes.len());
    let ended = loop {
        match walk.step() {
            Ok(Step::On) => {}
            Ok(Step::End) => break true,
            Ok(Step::TooManyScans) => return Err(PhotoError::Broken(format!("more than {MAX_SCANS} scans"))),
            Err(error) if walk.scans == 0 => return Err(error),
            Err(_) => break false,
        }
    };
    walk.finish(ended)
}

/// Outcome of one [`Walk::step`].
enum Step {
    On,
    End,
    TooManyScans,
}

/// State of a walk over the segments of a file.
#[derive(Default)]
struct Walk<'a> {
    bytes: &'a [u8],
    at: usize,
    /// The stripped file.
    out: Vec<u8>,
    frame: Option<Frame>,
    jfif: bool,
    /// Colour transform of the Adobe segment.
    adobe: Option<u8>,
    /// Code tables defined so far, as bits like those of [`tables`].
    tables: u8,
    /// Some scan uses a code table that is not defined.
    motion: bool,
    scans: usize,
    data: usize,
    height_at: usize,
    /// Offsets in `out` of the ends of the first and the last scan.
    first_scan_end: usize,
    last_scan_end: usize,
    exif: Option<&'a [u8]>,
    icc: Vec<(u8, &'a [u8])>,
}

impl Walk<'_> {
    /// Reads a segment, and the data after it if it is a scan.
    fn step(&mut self) -> Result<Step, PhotoError> {
        let (marker, next) = next_marker(self.bytes, self.at)?;
        self.at = next;
        match marker {
            0xD9 => return Ok(Step::End),
            // markers without a body: TEM, RSTn, a second SOI
            0x01 | 0xD0..=0xD8 => return Ok(Step::On),
            _ => {}
        }
        let body = segment(self.bytes, self.at)?;
        self.at += body.len() + 2;
        match marker {
            0xE0 if body.starts_with(b"JFIF\0") && body.len() >= 14 => {
                self.jfif = true;
                // the same header with a thumbnail of 0×0
                let mut head = body[..14].to_vec();
                head[12..14].fill(0);
                push(&mut self.out, marker, &head);
            }
            0xEE if body.starts_with(b"Adobe") && body.len() >= 12 => self.adobe = Some(body[11]),
            0xE1 if body.starts_with(b"Exif\0\0") && self.exif.is_none() => self.exif = Some(&body[6..]),
            0xE2 if body.starts_with(b"ICC_PROFILE\0") && body.len() > 14 => self.icc.push((body[12], &body[14..])),
            0xE0..=0xEF | 0xFE => {}
            frame if is_frame(frame) => {
                if self.frame.is_some() {
                    return Err(broken("more than one frame header"));
                }
                self.frame = Some(Frame::read(marker, body)?);
                // marker, length and precision precede the height
                self.height_at = self.out.len() + 5;
                push(&mut self.out, marker, body);
            }
            0xDA if self.scans == MAX_SCANS => return Ok(Step::TooManyScans),
            0xDA => self.scan(body)?,
            _ => {
                if marker == 0xC4 {
                    self.tables |= tables(body);
                }
                push(&mut self.out, marker, body);
            }
        }
        Ok(Step::On)
    }

    /// Reads a scan with the header `body`, and its data.
    fn scan(&mut self, body: &[u8]) -> Result<(), PhotoError> {
        let Some(frame) = &mut self.frame else { return Err(broken("a scan before the frame header")) };
        let uses = frame.refine(body)?;
        if self.scans == 0 {
            let colour = frame.colour(self.jfif, self.adobe);
            // without an Adobe segment, the identifiers or the number of components decide
            let transform = match colour {
                Colour::Rgb | Colour::Cmyk => self.adobe.map(|_| 0),
                Colour::Ycck => Some(2),
                Colour::Grey | Colour::YCbCr => None,
            };
            if let Some(transform) = transform {
                push(&mut self.out, 0xEE, &[b"Adobe\0\x64\0\0\0\0", &[transform][..]].concat());
            }
        }
        if !self.motion && uses & !self.tables != 0 {
            self.motion = true;
            push(&mut self.out, 0xE0, MOTION);
        }
        push(&mut self.out, 0xDA, body);
        let end = entropy_end(self.bytes, self.at);
        let data = &self.bytes[self.at..end];
        // fill bytes, or the first half of a marker
        let fill = data.iter().rev().take_while(|byte| **byte == 0xFF).count();
        self.out.extend_from_slice(&data[..data.len() - fill]);
        self.data += data.len();
        self.last_scan_end = self.out.len();
        if self.scans == 0 {
            self.first_scan_end = self.out.len();
        }
        (self.at, self.scans) = (end, self.scans + 1);
        Ok(())
    }

    fn finish(mut self, ended: bool) -> Result<Jpeg, PhotoError> {
        let Some(frame) = self.frame else { return Err(broken("no frame header")) };
        if self.scans == 0 {
            return Err(broken("no picture data"));
        }
        if !frame.progressive && !frame.is_complete() {
            return Err(broken("it was cut before its last scan"));
        }
        self.out.truncate(self.last_scan_end);
        self.out.extend(END);
        self.icc.sort_by_key(|&(n, _)| n);
        let colour = frame.colour(self.jfif, self.adobe);
        Ok(Jpeg {
            width: frame.width,
            height: frame.height,
            colour,
            memory: frame.memory(),
            data: self.data as u64,
            least_data: (frame.blocks * if frame.progressive { 1 } else { 2 }) / 8,
            height_at: self.height_at,
            first_scan_end: self.first_scan_end,
            progressive: frame.progressive,
            layout: frame.layout(colour),
            scans: self.scans,
            complete: frame.is_complete(),
            standalone: ended && !self.motion,
            stripped: self.out,
            exif: self.exif.map(<[u8]>::to_vec),
            icc: (!self.icc.is_empty()).then(|| self.icc.iter().flat_map(|&(_, part)| part).copied().collect()),
        })
    }
}

fn push(out: &mut Vec<u8>, marker: u8, body: &[u8]) {
    // a segment's body has at most 65 533 bytes
    let length = (body.len() + 2) as u16;
    out.extend_from_slice(&[0xFF, marker]);
    out.extend_from_slice(&length.to_be_bytes());
    out.extend_from_slice(body);
}
