//! Frames in the pipes: kind (1 byte), length (8 bytes, little-endian), and that many bytes.

use std::io::{self, Read, Write};

use serde::{Deserialize, Serialize};

/// Longest frame.
const FRAME: u64 = 1 << 30;

/// Kinds of frames.
pub mod kind {
    pub const OPTIONS: u8 = 1;
    pub const PHOTO: u8 = 2;
    pub const DEPTH: u8 = 3;
    pub const MAKE: u8 = 4;
    pub const PROGRESS: u8 = 5;
    pub const CONTAINER: u8 = 6;
    pub const DISPARITY: u8 = 7;
    pub const THUMBNAIL: u8 = 8;
    pub const REPORT: u8 = 9;
    pub const FAULT: u8 = 10;
    pub const STROKES: u8 = 11;
    pub const RECIPE: u8 = 12;
    pub const WRITE: u8 = 13;
    pub const PEAK: u8 = 14;
    pub const FILE: u8 = 15;
}

pub fn write(to: &mut impl Write, kind: u8, bytes: &[u8]) -> io::Result<()> {
    to.write_all(&[kind])?;
    to.write_all(&(bytes.len() as u64).to_le_bytes())?;
    to.write_all(bytes)
}

pub fn read(from: &mut impl Read) -> io::Result<(u8, Vec<u8>)> {
    let mut head = [0; 9];
    from.read_exact(&mut head)?;
    let [kind, length @ ..] = head;
    let length = u64::from_le_bytes(length);
    if length > FRAME {
        return Err(io::Error::new(io::ErrorKind::InvalidData, "the frame is too long"));
    }
    let mut bytes = Vec::new();
    from.take(length).read_to_end(&mut bytes)?;
    if bytes.len() as u64 == length { Ok((kind, bytes)) } else { Err(io::ErrorKind::UnexpectedEof.into()) }
}

/// A stage in a frame.
#[derive(Serialize, Deserialize)]
pub struct StageFrame {
    pub stage: String,
    pub step: u32,
    pub steps: u32,
    pub elapsed_ms: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_read_back_and_truncated_ones_are_errors() {
        let mut bytes = Vec::new();
        write(&mut bytes, kind::PHOTO, b"abc").unwrap();
        write(&mut bytes, kind::MAKE, b"").unwrap();
        let mut from = bytes.as_slice();
        assert_eq!(read(&mut from).unwrap(), (kind::PHOTO, b"abc".to_vec()));
        assert_eq!(read(&mut from).unwrap(), (kind::MAKE, Vec::new()));
        assert!(read(&mut from).is_err());
        for end in 0..12 {
            assert!(read(&mut &bytes[..end]).is_err(), "cut to {end}");
        }
        assert!(read(&mut [[1].as_slice(), &(FRAME + 1).to_le_bytes()].concat().as_slice()).is_err());
    }
}
