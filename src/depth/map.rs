//! A depth map that the user gives.

use image::{DynamicImage, ImageFormat, ImageReader, Limits as DecoderLimits};

use super::{DepthError, DepthKind};
use crate::photo::Limits;
use crate::tmpi::DisparityMap;

/// Reads a user's depth map (8- or 16-bit grey PNG) at the photo's size `width × height`; a map of another size is resampled
/// by nearest neighbour, which does not mix across edges. Metric depth is scaled so that its nearest 0.1 % is at δ = 1;
/// unknown metric values (0) take the farther known neighbour in the row.
///
/// # Errors
/// [`DepthError::Map`] says what is wrong with the file.
pub fn from_png(bytes: &[u8], kind: DepthKind, width: u32, height: u32) -> Result<DisparityMap, DepthError> {
    let bad = |e: image::ImageError| DepthError::Map(e.to_string());
    let reader = || ImageReader::with_format(std::io::Cursor::new(bytes), ImageFormat::Png);
    let (w, h) = reader().into_dimensions().map_err(bad)?;
    if w > Limits::SIDE || h > Limits::SIDE || u64::from(w) * u64::from(h) > Limits::PIXELS {
        return Err(DepthError::Map(format!("{w}×{h} is over the limit of {} pixels or {} a side", Limits::PIXELS, Limits::SIDE)));
    }
    let mut limits = DecoderLimits::default();
    limits.max_alloc = Some(Limits::DECODER_MEMORY);
    let mut r = reader();
    r.limits(limits);
    let grey: Vec<u16> = match r.decode().map_err(bad)? {
        DynamicImage::ImageLuma8(p) => p.into_raw().into_iter().map(|v| u16::from(v) * 257).collect(),
        DynamicImage::ImageLuma16(p) => p.into_raw(),
        DynamicImage::ImageLumaA8(p) => p.pixels().map(|v| u16::from(v.0[0]) * 257).collect(),
        DynamicImage::ImageLumaA16(p) => p.pixels().map(|v| v.0[0]).collect(),
        _ => return Err(DepthError::Map("it is in colour".into())),
    };
    let known = match kind {
        DepthKind::Disparity => grey.iter().map(|&v| f32::from(v) / 65_535.0).collect(),
        DepthKind::Metric => from_metric(&grey, w as usize),
    };
    let delta = if (w, h) == (width, height) { known } else { nearest(&known, (w, h), (width, height)) };
    Ok(DisparityMap { width, height, delta })
}

fn from_metric(depth: &[u16], width: usize) -> Vec<f32> {
    let mut sorted: Vec<u16> = depth.iter().copied().filter(|&v| v > 0).collect();
    if sorted.is_empty() {
        return vec![0.0; depth.len()];
    }
    let at = sorted.len() / 1000;
    let near = f32::from(*sorted.select_nth_unstable(at).1);
    let mut delta: Vec<f32> = depth.iter().map(|&v| if v == 0 { f32::NAN } else { (near / f32::from(v)).min(1.0) }).collect();
    for row in delta.chunks_mut(width) {
        fill_unknown(row);
    }
    delta
}

/// NaN takes the lesser of the nearest known values to the left and right; a row without any is at infinity.
fn fill_unknown(row: &mut [f32]) {
    let mut i = 0;
    while i < row.len() {
        if !row[i].is_nan() {
            i += 1;
            continue;
        }
        let end = row[i..].iter().position(|v| !v.is_nan()).map_or(row.len(), |p| i + p);
        let left = i.checked_sub(1).map_or(f32::INFINITY, |l| row[l]);
        let right = row.get(end).copied().unwrap_or(f32::INFINITY);
        let fill = left.min(right);
        row[i..end].fill(if fill.is_finite() { fill } else { 0.0 });
        i = end;
    }
}

fn nearest(from: &[f32], (w, h): (u32, u32), (nw, nh): (u32, u32)) -> Vec<f32> {
    let at = |i: u32, n: u32, of: u32| ((u64::from(i) * 2 + 1) * u64::from(of) / (u64::from(n) * 2)) as usize;
    let mut out = Vec::with_capacity(nw as usize * nh as usize);
    for y in 0..nh {
        let row = at(y, nh, h) * w as usize;
        out.extend((0..nw).map(|x| from[row + at(x, nw, w)]));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{GrayImage, ImageBuffer, Luma, RgbImage};

    fn png(image: &DynamicImage) -> Vec<u8> {
        let mut out = std::io::Cursor::new(Vec::new());
        image.write_to(&mut out, ImageFormat::Png).unwrap();
        out.into_inner()
    }

    #[test]
    fn disparity_is_taken_as_it_is() {
        let map: ImageBuffer<Luma<u16>, _> = ImageBuffer::from_raw(3, 1, vec![0u16, 32_768, 65_535]).unwrap();
        let d = from_png(&png(&map.into()), DepthKind::Disparity, 3, 1).unwrap();
        assert_eq!(d.delta, vec![0.0, 32_768.0 / 65_535.0, 1.0]);
    }

    #[test]
    fn metric_depth_becomes_disparity_and_unknown_the_farther_neighbour() {
        let map: ImageBuffer<Luma<u16>, _> = ImageBuffer::from_raw(5, 1, vec![0u16, 1000, 0, 2000, 4000]).unwrap();
        let d = from_png(&png(&map.into()), DepthKind::Metric, 5, 1).unwrap();
        assert_eq!(d.delta, vec![1.0, 1.0, 0.5, 0.5, 0.25]);
    }

    #[test]
    fn another_size_is_not_mixed() {
        let map = GrayImage::from_raw(2, 1, vec![0, 255]).unwrap();
        let d = from_png(&png(&map.into()), DepthKind::Disparity, 5, 3).unwrap();
        assert_eq!(d.delta.len(), 15);
        assert!(d.delta.iter().all(|v| *v == 0.0 || (*v - 1.0).abs() < 1e-6));
    }

    #[test]
    fn colour_and_garbage_are_refused() {
        assert!(
            matches!(from_png(&png(&RgbImage::new(2, 2).into()), DepthKind::Disparity, 2, 2), Err(DepthError::Map(m)) if m.contains("colour"))
        );
        assert!(from_png(b"not a png", DepthKind::Disparity, 2, 2).is_err());
        let empty: ImageBuffer<Luma<u16>, _> = ImageBuffer::from_raw(2, 2, vec![0u16; 4]).unwrap();
        assert_eq!(from_png(&png(&empty.into()), DepthKind::Metric, 2, 2).unwrap().delta, vec![0.0; 4]);
    }
}
