//! Walks the segments of a JPEG file: size, metadata, and the file again without metadata.

use super::segments::{broken, entropy_end, next_marker, segment};
use super::{Head, Limits, PhotoError};

/// What the segments of a JPEG file say, and the file without what nobody needs to decode it.
#[derive(Debug)]
pub(super) struct Jpeg {
    pub width: u32,
    pub height: u32,
    /// Count of colour components: 1 grey, 3 `YCbCr` or RGB, 4 CMYK or YCCK.
    pub components: u8,
    /// Bytes of DCT coefficients, where the decoder has to keep all of them (progressive, or a scan per component); else 0.
    pub coefficient_bytes: u64,
    /// Bytes of entropy-coded data in all scans.
    data: u64,
    /// Bytes without which the frame's blocks cannot be coded.
    least_data: u64,
    /// Place in `stripped` of the frame's height, two bytes.
    height_at: usize,
    /// Place in `stripped` behind the first scan.
    first_scan_end: usize,
    /// Every scan refines the whole picture.
    pub progressive: bool,
    /// Each component comes in a scan of its own.
    one_by_one: bool,
    /// Count of scans.
    pub scans: usize,
    /// The scans of a progressive file bring every coefficient to its last bit.
    pub complete: bool,
    /// The picture alone: no `APPn` but JFIF (without its thumbnail) and Adobe, no comments, nothing after the end marker.
    pub stripped: Vec<u8>,
    /// TIFF structure of the first EXIF segment.
    pub exif: Option<Vec<u8>>,
    /// ICC profile, put together from its segments.
    pub icc: Option<Vec<u8>>,
}

/// Scans of a file, at most: decoding takes scans × blocks, and a scan of a few bytes covers any count of blocks (LJT-01-003).
/// Writers of progressive files make 10 to 64.
pub(super) const MAX_SCANS: usize = 100;

impl Jpeg {
    /// Memory that decoding takes, result included.
    pub(super) fn memory(&self) -> u64 {
        self.coefficient_bytes + u64::from(self.width) * u64::from(self.height) * 3
    }

    /// Refuses a file whose data cannot fill its frame: a block takes at least two bits, and in a progressive file one.
    pub(super) fn check_data(&self) -> Result<(), PhotoError> {
        if self.data < self.least_data {
            let (have, least) = (self.data, self.least_data);
            return Err(PhotoError::Broken(format!(
                "{have} bytes of picture data, where its size takes at least {least}: it was cut short"
            )));
        }
        Ok(())
    }

    /// The file for a strict decoder: it takes zeros for whatever an end marker cuts off, but not the end of the file. So a file of one
    /// scan ends in a few zeros, which the decoder may read ahead, and no marker.
    pub(super) fn open(&self) -> Vec<u8> {
        if self.progressive || self.one_by_one {
            return self.stripped.clone();
        }
        [&self.stripped[..self.stripped.len() - 2], &[0; READ_AHEAD]].concat()
    }

    /// The file cut to what has to be whole for a damaged picture to be worth showing: the upper [`MOST`] of it, or, where each
    /// scan refines the whole picture, the first scan.
    pub(super) fn most(&self) -> Vec<u8> {
        if self.progressive {
            return [&self.stripped[..self.first_scan_end], &[0xFF, 0xD9]].concat();
        }
        let mut file = self.open();
        let rows = (u64::from(self.height) * MOST.0).div_ceil(MOST.1) as u16;
        file[self.height_at..self.height_at + 2].copy_from_slice(&rows.to_be_bytes());
        file
    }
}

/// Segments and bytes between them, before the frame header, that are looked at while the file is still on its way; more are left to the
/// whole file, so that bytes which come one by one cost little each.
const MAX_STEPS: usize = 1024;

/// What the first bytes tell; they begin with the marker of JPEG.
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
            // whether a scan holds all components is told behind this
            let coefficients = if frame.progressive { frame.coefficient_bytes } else { 0 };
            limits.check_memory(coefficients.saturating_add(u64::from(frame.width) * u64::from(frame.height) * 3))?;
            return Ok(Head::Size(frame.width, frame.height));
        }
        at = end;
    }
    Ok(Head::Silent)
}

/// True for the markers of frame headers.
fn is_frame(marker: u8) -> bool {
    matches!(marker, 0xC0..=0xC3 | 0xC5..=0xC7 | 0xC9..=0xCB | 0xCD..=0xCF)
}

/// Bytes that a decoder holds ahead of the block that it is at.
const READ_AHEAD: usize = 16;

/// Share of the rows, as a fraction, that must decode without a fault.
const MOST: (u64, u64) = (3, 4);

/// Reads all segments up to the end marker, which must be there: a file without it was cut short.
pub(super) fn scan(bytes: &[u8]) -> Result<Jpeg, PhotoError> {
    let mut out = Vec::with_capacity(bytes.len());
    out.extend_from_slice(&[0xFF, 0xD8]);
    let mut jpeg = Jpeg {
        width: 0,
        height: 0,
        components: 0,
        coefficient_bytes: 0,
        data: 0,
        least_data: 0,
        height_at: 0,
        first_scan_end: 0,
        progressive: false,
        one_by_one: false,
        scans: 0,
        complete: false,
        stripped: Vec::new(),
        exif: None,
        icc: None,
    };
    let mut icc: Vec<(u8, &[u8])> = Vec::new();
    let (mut at, mut frame, mut scans) = (2, None::<Frame>, 0);
    loop {
        let (marker, next) = next_marker(bytes, at)?;
        at = next;
        match marker {
            0xD9 => break,
            // Markers that stand alone: TEM, RSTn, a second SOI
            0x01 | 0xD0..=0xD8 => continue,
            _ => {}
        }
        let body = segment(bytes, at)?;
        at += body.len() + 2;
        match marker {
            0xE0 if body.starts_with(b"JFIF\0") && body.len() >= 14 => {
                // The same header with a thumbnail of 0×0
                let mut head = body[..14].to_vec();
                head[12..14].fill(0);
                push(&mut out, marker, &head);
            }
            0xEE if body.starts_with(b"Adobe") => push(&mut out, marker, body),
            0xE1 if body.starts_with(b"Exif\0\0") && jpeg.exif.is_none() => jpeg.exif = Some(body[6..].to_vec()),
            0xE2 if body.starts_with(b"ICC_PROFILE\0") && body.len() > 14 => icc.push((body[12], &body[14..])),
            0xE0..=0xEF | 0xFE => {}
            frame_marker if is_frame(frame_marker) => {
                if frame.is_some() {
                    return Err(broken("more than one frame header"));
                }
                frame = Some(Frame::read(marker, body)?);
                // marker, length and precision come before it
                jpeg.height_at = out.len() + 5;
                push(&mut out, marker, body);
            }
            0xDA => {
                let Some(frame) = &mut frame else { return Err(broken("a scan before the frame header")) };
                if scans == MAX_SCANS {
                    return Err(PhotoError::Broken(format!("more than {MAX_SCANS} scans")));
                }
                frame.refine(body);
                frame.one_by_one |= body.first().is_some_and(|&n| n < frame.components);
                push(&mut out, marker, body);
                let end = entropy_end(bytes, at);
                out.extend_from_slice(&bytes[at..end]);
                jpeg.data += (end - at) as u64;
                if scans == 0 {
                    jpeg.first_scan_end = out.len();
                }
                (at, scans) = (end, scans + 1);
            }
            _ => push(&mut out, marker, body),
        }
    }
    out.extend_from_slice(&[0xFF, 0xD9]);
    let Some(frame) = frame else { return Err(broken("no frame header")) };
    if scans == 0 {
        return Err(broken("no picture data"));
    }
    icc.sort_by_key(|&(n, _)| n);
    jpeg.icc = (!icc.is_empty()).then(|| icc.iter().flat_map(|&(_, part)| part).copied().collect());
    (jpeg.width, jpeg.height, jpeg.components) = (frame.width, frame.height, frame.components);
    jpeg.coefficient_bytes = if frame.progressive || frame.one_by_one { frame.coefficient_bytes } else { 0 };
    (jpeg.progressive, jpeg.one_by_one, jpeg.scans) = (frame.progressive, frame.one_by_one, scans);
    jpeg.complete = frame.left.iter().all(|left| *left == 0);
    jpeg.least_data = (frame.blocks * if frame.progressive { 1 } else { 2 }) / 8;
    jpeg.stripped = out;
    Ok(jpeg)
}

fn push(out: &mut Vec<u8>, marker: u8, body: &[u8]) {
    // A body read from a segment is at most 65 533 bytes long
    let length = (body.len() + 2) as u16;
    out.extend_from_slice(&[0xFF, marker]);
    out.extend_from_slice(&length.to_be_bytes());
    out.extend_from_slice(body);
}

/// Start of frame.
struct Frame {
    width: u32,
    height: u32,
    components: u8,
    progressive: bool,
    /// A scan holds fewer components than the frame.
    one_by_one: bool,
    coefficient_bytes: u64,
    /// Blocks of the picture alone, without those that only fill up the last minimum coded units.
    blocks: u64,
    /// Names of the components.
    names: Vec<u8>,
    /// Coefficients, as bits, of each component that no scan has brought to their last bit.
    left: Vec<u64>,
}

impl Frame {
    fn read(marker: u8, body: &[u8]) -> Result<Self, PhotoError> {
        if !matches!(marker, 0xC0..=0xC2) {
            return Err(broken("lossless, hierarchical and arithmetic-coded JPEG are not read"));
        }
        let Some((head, parts)) = body.split_at_checked(6) else { return Err(broken("a short frame header")) };
        if head[0] != 8 {
            return Err(PhotoError::Broken(format!("JPEG of {} bits a sample is not read", head[0])));
        }
        let (height, width) = (u16::from_be_bytes([head[1], head[2]]), u16::from_be_bytes([head[3], head[4]]));
        let components = head[5];
        if !matches!(components, 1 | 3 | 4) || parts.len() < 3 * usize::from(components) {
            return Err(PhotoError::Broken(format!("JPEG of {components} components is not read")));
        }
        let sampling: Vec<(u64, u64)> =
            parts.chunks_exact(3).take(components.into()).map(|p| (u64::from(p[1] >> 4), u64::from(p[1] & 15))).collect();
        if sampling.iter().any(|&(h, v)| !(1..=4).contains(&h) || !(1..=4).contains(&v)) {
            return Err(broken("an impossible sampling factor"));
        }
        let (h_max, v_max) = sampling.iter().fold((1, 1), |m, s| (m.0.max(s.0), m.1.max(s.1)));
        let mcus = u64::from(width).div_ceil(8 * h_max) * u64::from(height).div_ceil(8 * v_max);
        let across = |side: u16, sampling: u64, most: u64| (u64::from(side) * sampling).div_ceil(most).div_ceil(8);
        let blocks = sampling.iter().map(|&(h, v)| across(width, h, h_max) * across(height, v, v_max)).sum();
        // 64 coefficients of 2 bytes a block
        let coefficient_bytes = sampling.iter().map(|(h, v)| mcus * h * v * 128).sum();
        Ok(Self {
            width: width.into(),
            height: height.into(),
            components,
            progressive: marker == 0xC2,
            one_by_one: false,
            coefficient_bytes,
            blocks,
            names: parts.chunks_exact(3).take(components.into()).map(|p| p[0]).collect(),
            left: vec![u64::MAX; components.into()],
        })
    }

    /// Notes what a scan brings, by its header.
    fn refine(&mut self, scan: &[u8]) {
        let Some((&count, rest)) = scan.split_first() else { return };
        let (named, spectrum) = rest.split_at(rest.len().min(2 * usize::from(count)));
        let &[first, last @ 0..=63, bits] = spectrum else { return };
        if first > last || bits & 15 != 0 {
            return;
        }
        let brought = (u64::MAX >> (63 - last)) & (u64::MAX << first);
        for name in named.chunks_exact(2).map(|p| p[0]) {
            let of_name = self.names.iter().zip(&mut self.left).filter(|(n, _)| **n == name);
            of_name.for_each(|(_, left)| *left &= !brought);
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Memory for a frame of that kind, as its segment describes it.
    pub fn memory_of(marker: u8, body: &[u8]) -> u64 {
        let frame = Frame::read(marker, body).unwrap();
        let coefficients = if frame.progressive { frame.coefficient_bytes } else { 0 };
        coefficients + u64::from(frame.width) * u64::from(frame.height) * 3
    }
}
