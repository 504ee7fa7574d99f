//! Portable float maps: 32-bit depth maps, as datasets and research code write them.

use super::DepthError;
use super::grey::Grey;
use crate::photo::{Head, Limits};

/// Longest header: two long numbers, a scale, and spaces between them.
const HEADER: usize = 64;

/// Header of a map.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Header {
    width: u32,
    height: u32,
    little_endian: bool,
    /// Bytes before the values.
    length: usize,
}

/// Whether a file is a portable float map, in grey or in colour.
pub(super) fn is_pfm(bytes: &[u8]) -> bool {
    matches!(bytes, [b'P', b'f' | b'F', space, ..] if space.is_ascii_whitespace())
}

/// Checks that a map is within the limits and has a value for each pixel; returns its width and height.
///
/// # Errors
/// [`DepthError::Map`] says what is wrong with the file.
pub(super) fn check(bytes: &[u8], limits: &Limits) -> Result<(u32, u32), DepthError> {
    split(bytes, limits).map(|(header, _)| (header.width, header.height))
}

/// The header of a complete file, and the bytes of its values.
fn split<'a>(bytes: &'a [u8], limits: &Limits) -> Result<(Header, &'a [u8]), DepthError> {
    limits.check_bytes(bytes.len()).map_err(|e| DepthError::Map(e.to_string()))?;
    let header = Header::read(bytes, limits)?;
    let (values, wants) = (&bytes[header.length..], 4 * u64::from(header.width) * u64::from(header.height));
    if (values.len() as u64) < wants {
        let has = values.len();
        return Err(DepthError::Map(format!("the file is cut short: its header announces {wants} bytes of values, but it has {has}")));
    }
    Ok((header, values))
}

/// Reads a map's size from its first bytes while the rest is still arriving.
///
/// # Errors
/// The [`DepthError::Map`] that [`check`] returns for the whole file.
pub(super) fn head(bytes: &[u8], limits: &Limits) -> Result<Head, DepthError> {
    if bytes.len() < HEADER {
        return Ok(Head::Needs(HEADER));
    }
    Header::read(bytes, limits).map(|header| Head::Size(header.width, header.height))
}

/// Reads the values as stored, the top row first: any float, including NaN and infinity.
///
/// # Errors
/// [`DepthError::Map`] says what is wrong with the file.
pub(super) fn read(bytes: &[u8], limits: &Limits) -> Result<Grey, DepthError> {
    let (Header { width, height, little_endian, .. }, floats) = split(bytes, limits)?;
    let mut values = Vec::with_capacity(width as usize * height as usize);
    // the file begins with the lowest row
    for row in floats.chunks_exact(4 * width as usize).take(height as usize).rev() {
        values.extend(row.as_chunks::<4>().0.iter().map(|&v| if little_endian { f32::from_le_bytes(v) } else { f32::from_be_bytes(v) }));
    }
    Ok(Grey { width, height, values })
}

impl Header {
    fn read(bytes: &[u8], limits: &Limits) -> Result<Self, DepthError> {
        let wrong = || DepthError::Map("the header of a portable float map must have width, height and scale".into());
        if bytes.starts_with(b"PF") {
            return Err(DepthError::Map("it is in colour: a depth map must be grey (Pf)".into()));
        }
        let start = &bytes[..bytes.len().min(HEADER)];
        let magic = b"Pf".len();
        if start.len() < magic {
            return Err(wrong());
        }
        let mut words = [""; 3];
        let mut at = magic;
        for word in &mut words {
            at += start[at..].iter().take_while(|b| b.is_ascii_whitespace()).count();
            let end = at + start[at..].iter().take_while(|b| !b.is_ascii_whitespace()).count();
            *word = std::str::from_utf8(&start[at..end]).map_err(|_| wrong())?;
            at = end;
        }
        // a single space or line feed separates header and values
        let length = at + 1;
        let [width, height, scale] = words;
        let (Ok(width), Ok(height), Ok(scale)) = (width.parse(), height.parse(), scale.parse::<f64>()) else { return Err(wrong()) };
        if length > start.len() || scale == 0.0 || !scale.is_finite() {
            return Err(wrong());
        }
        limits.check_size(width, height).map_err(|e| DepthError::Map(e.to_string()))?;
        Ok(Self { width, height, little_endian: scale < 0.0, length })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::{DepthKind, from_map};
    use super::*;

    fn file(header: &str, values: &[f32]) -> Vec<u8> {
        let little = header.contains('-');
        let bytes = values.iter().flat_map(|v| if little { v.to_le_bytes() } else { v.to_be_bytes() });
        header.bytes().chain(bytes).collect()
    }

    fn read_as(bytes: &[u8], kind: DepthKind, width: u32, height: u32) -> Result<Vec<f32>, DepthError> {
        from_map(bytes, kind, &Limits::default(), width, height).map(|(map, _)| map.delta)
    }

    #[test]
    fn rows_are_upright_in_either_byte_order() {
        for header in ["Pf\n2 2\n-1.0\n", "Pf 2 2 1\n", "Pf\n2\t2\n2.5\n"] {
            let got = read_as(&file(header, &[0.3, 0.4, 0.1, 0.2]), DepthKind::Disparity, 2, 2).unwrap();
            assert_eq!(got, [0.1, 0.2, 0.3, 0.4], "{header:?}");
        }
    }

    #[test]
    fn disparities_in_pixels_are_scaled_and_unknown_ones_take_the_farther_neighbour() {
        let got = read_as(&file("Pf\n4 1\n-1\n", &[80.0, f32::INFINITY, 20.0, f32::NAN]), DepthKind::Disparity, 4, 1).unwrap();
        assert_eq!(got, [1.0, 0.25, 0.25, 0.25]);
        let negative = read_as(&file("Pf\n2 1\n-1\n", &[-3.0, 0.5]), DepthKind::Disparity, 2, 1).unwrap();
        assert_eq!(negative, [0.0, 0.5], "a negative disparity is infinitely far");
        assert!(read_as(&file("Pf\n1 1\n-1\n", &[f32::NAN]), DepthKind::Disparity, 1, 1).unwrap_err().to_string().contains("known"));
    }

    #[test]
    fn distances_may_be_infinite() {
        let got = read_as(&file("Pf\n4 1\n-1\n", &[2.0, f32::INFINITY, 8.0, f32::NAN]), DepthKind::Metric, 4, 1).unwrap();
        assert_eq!(got, [1.0, 0.0, 0.25, 0.25]);
    }

    #[test]
    fn wrong_headers_and_short_files_are_refused_with_their_reason() {
        for (header, why) in [
            ("PF\n1 1\n-1\n", "colour"),
            ("Pf\n0 1\n-1\n", "0×1"),
            ("Pf\n16385 1\n-1\n", "16385"),
            ("Pf\n-1 1\n-1\n", "header"),
            ("Pf\n1 1\n0\n", "header"),
            ("Pf\n1 1\nnan\n", "header"),
            ("Pf\n1 1", "header"),
            ("Pf", "header"),
            ("Pf\n2 1\n-1\n", "cut short"),
        ] {
            let error = check(&file(header, &[1.0]), &Limits::default()).unwrap_err().to_string();
            assert!(error.contains(why), "{header:?}: {error}");
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_or_refused(tail in prop::collection::vec(any::<u8>(), 0..200), cut in 0..40_usize) {
            let mut bytes = file("Pf\n3 2\n-1.0\n", &[0.5; 6]);
            bytes.truncate(cut);
            bytes.extend(tail);
            let limits = Limits::default();
            let whole = check(&bytes, &limits);
            prop_assert_eq!(read(&bytes, &limits).is_ok(), whole.is_ok());
            if bytes.len() >= HEADER {
                prop_assert!(whole.is_err() || head(&bytes, &limits).is_ok());
            }
        }
    }
}
