//! OpenEXR pictures: depth maps as renderers write them. Scan lines and tiles of all lossless compressions, PXR24 and B44, with floats of 16
//! or 32 bits or whole numbers, of one or several parts.

mod channels;
mod chunks;
mod headers;
#[cfg(test)]
mod tests;

use std::collections::BTreeSet;

use exr::block::lines::LineRef;
use exr::math::Vec2;
use exr::meta::attribute::SampleType;
use half::f16;

use self::chunks::Chunks;
use self::headers::Headers;
use super::DepthError;
use super::grey::Grey;
use crate::photo::{self, Head, Limits};

pub(super) use self::headers::head;

/// Largest difference of two channels, as a share, at which they count as the same grey: lossy compressions keep fewer digits.
const ALIKE: f32 = 0.01;

/// Whether a file is an OpenEXR picture.
pub(super) fn is_openexr(bytes: &[u8]) -> bool {
    bytes.starts_with(&exr::meta::magic_number::BYTES)
}

/// Checks that a map is within the limits, has a channel that can be depth, and is complete; returns its width and height.
///
/// # Errors
/// [`DepthError::Map`] says what is wrong with the file.
pub(super) fn check(bytes: &[u8], limits: &Limits) -> Result<(u32, u32), DepthError> {
    limits.check_bytes(bytes.len()).map_err(|e| DepthError::Map(e.to_string()))?;
    let headers = Headers::read(bytes, limits)?;
    for stored in Chunks::new(bytes, &headers)? {
        stored?;
    }
    Ok((headers.width, headers.height))
}

/// Reads the values of the channel that holds depth as stored: any float, including NaN and infinity. Pixels outside of what is stored are
/// NaN.
///
/// # Errors
/// [`DepthError::Map`] says what is wrong with the file.
pub(super) fn read(bytes: &[u8], limits: &Limits) -> Result<Grey, DepthError> {
    limits.check_bytes(bytes.len()).map_err(|e| DepthError::Map(e.to_string()))?;
    let headers = Headers::read(bytes, limits)?;
    let values = photo::guarded(DepthError::Map, || values(bytes, &headers))?;
    Ok(Grey { width: headers.width, height: headers.height, values })
}

/// The values of the display window, row by row.
fn values(bytes: &[u8], headers: &Headers) -> Result<Vec<f32>, DepthError> {
    let header = headers.part();
    let mut picture = Picture::new(headers);
    let (mut places, mut pixels) = (BTreeSet::new(), 0);
    for stored in Chunks::new(bytes, headers)? {
        let stored = stored?;
        if stored.part != headers.depth.part || !stored.is_of_full_size() {
            continue;
        }
        let block = stored.unpack(headers)?;
        let Vec2(x, y) = block.index.pixel_position;
        if !places.insert((x, y)) {
            return Err(DepthError::Map("it has two blocks for the same pixels".into()));
        }
        pixels += block.index.pixel_size.area();
        for line in block.lines(&header.channels) {
            if let Some(at) = headers.depth.channels.iter().position(|c| *c == line.location.channel) {
                picture.take(&line, header.channels.list[line.location.channel].sample_type, at == 0)?;
            }
        }
    }
    if pixels != header.layer_size.area() {
        return Err(DepthError::Map("it lacks blocks of pixels".into()));
    }
    Ok(picture.values)
}

/// The display window while it fills.
struct Picture {
    width: usize,
    height: usize,
    /// Where the stored pixels begin in it.
    offset: (i64, i64),
    values: Vec<f32>,
}

impl Picture {
    fn new(headers: &Headers) -> Self {
        let (width, height) = (headers.width as usize, headers.height as usize);
        let (stored, shown) = (headers.part().own_attributes.layer_position, headers.part().shared_attributes.display_window.position);
        let offset = (i64::from(stored.0) - i64::from(shown.0), i64::from(stored.1) - i64::from(shown.1));
        Self { width, height, offset, values: vec![f32::NAN; width * height] }
    }

    /// Takes a line of samples as values, or, if it is not of the `first` channel, checks that they are those of the first.
    fn take(&mut self, line: &LineRef<'_>, kind: SampleType, first: bool) -> Result<(), DepthError> {
        let Vec2(x, y) = line.location.position;
        let (x, y) = (x as i64 + self.offset.0, y as i64 + self.offset.1);
        let Some(row) = usize::try_from(y).ok().filter(|row| *row < self.height) else { return Ok(()) };
        let row = &mut self.values[row * self.width..][..self.width];
        // a negative number skips nothing
        let skip = |n: i64| usize::try_from(n).unwrap_or(0);
        let samples = line.value.chunks_exact(kind.bytes_per_sample()).map(|bytes| sample(bytes, kind));
        for (value, sample) in row.iter_mut().skip(skip(x)).zip(samples.skip(skip(-x))) {
            if first {
                *value = sample;
            } else if !are_alike(*value, sample) {
                return Err(DepthError::Map("it is in colour, and no channel is called Z, Depth, V or Y".into()));
            }
        }
        Ok(())
    }
}

/// The number that a sample stands for.
fn sample(bytes: &[u8], kind: SampleType) -> f32 {
    match (kind, bytes) {
        (SampleType::F16, &[a, b]) => f16::from_ne_bytes([a, b]).to_f32(),
        (SampleType::F32, &[a, b, c, d]) => f32::from_ne_bytes([a, b, c, d]),
        (SampleType::U32, &[a, b, c, d]) => u32::from_ne_bytes([a, b, c, d]) as f32,
        _ => f32::NAN,
    }
}

/// Whether two channels have the same grey; infinity and NaN are each like themselves.
fn are_alike(a: f32, b: f32) -> bool {
    if a.is_finite() && b.is_finite() {
        (a - b).abs() <= ALIKE * a.abs().max(b.abs())
    } else {
        a.total_cmp(&b).is_eq() || (a.is_nan() && b.is_nan())
    }
}
