//! Reads the segments of a JPEG file one after another.

use super::{PhotoError, broken};

/// The first marker at or after `at`, and the offset after it. Skips bytes between segments, as libjpeg does.
pub(super) fn next_marker(bytes: &[u8], mut at: usize) -> Result<(u8, usize), PhotoError> {
    let cut = || broken("the file is cut short");
    loop {
        at += bytes.get(at..).and_then(|rest| rest.iter().position(|&b| b == 0xFF)).ok_or_else(cut)?;
        while *bytes.get(at).ok_or_else(cut)? == 0xFF {
            at += 1;
        }
        let marker = bytes[at];
        at += 1;
        if marker != 0 {
            return Ok((marker, at));
        }
    }
}

/// Contents of the segment whose length field is at `at`.
pub(super) fn segment(bytes: &[u8], at: usize) -> Result<&[u8], PhotoError> {
    let length = bytes.get(at..at + 2).map(|b| usize::from(u16::from_be_bytes([b[0], b[1]])));
    match length {
        Some(n) if n >= 2 => bytes.get(at + 2..at + n).ok_or_else(|| broken("the file is cut short")),
        Some(_) => Err(broken("invalid segment length")),
        None => Err(broken("the file is cut short")),
    }
}

/// Offset of the marker that ends the entropy-coded data at `at`, or the end of the file.
pub(super) fn entropy_end(bytes: &[u8], mut at: usize) -> usize {
    while at + 1 < bytes.len() {
        // stuffed zeros, restart markers and fill bytes belong to the data
        if bytes[at] == 0xFF && !matches!(bytes[at + 1], 0 | 0xD0..=0xD7 | 0xFF) {
            return at;
        }
        at += 1;
    }
    bytes.len()
}

/// Offset after the end marker of a JPEG.
pub(crate) fn end(jpeg: &[u8]) -> Option<usize> {
    let mut at = 2;
    loop {
        let (marker, next) = next_marker(jpeg, at).ok()?;
        at = next;
        match marker {
            0xD9 => return Some(at),
            0x01 | 0xD0..=0xD8 => {}
            _ => {
                at += segment(jpeg, at).ok()?.len() + 2;
                if marker == 0xDA {
                    at = entropy_end(jpeg, at);
                }
            }
        }
    }
}

/// An `APPn` segment.
pub(crate) struct Application<'a> {
    /// n, 0 to 15.
    pub number: u8,
    /// Contents, without the length.
    pub body: &'a [u8],
    /// Offset of the contents in the file.
    pub at: usize,
}

/// The `APPn` segments before the picture data of a JPEG, up to the first that cannot be read. Copies nothing.
pub(crate) fn applications(jpeg: &[u8]) -> Vec<Application<'_>> {
    let mut found = Vec::new();
    if !jpeg.starts_with(&[0xFF, 0xD8]) {
        return found;
    }
    let mut at = 2;
    while let Ok((marker, next)) = next_marker(jpeg, at) {
        at = next;
        match marker {
            0x01 | 0xD0..=0xD8 => continue,
            0xD9 | 0xDA => break,
            _ => {}
        }
        let Ok(body) = segment(jpeg, at) else { break };
        if let number @ 0..=15 = marker.wrapping_sub(0xE0) {
            found.push(Application { number, body, at: at + 2 });
        }
        at += body.len() + 2;
    }
    found
}
