//! Decodes the pixels of a JPEG file.
//!
//! Two decoders share the work. zune-jpeg is fast and detects damage, but decodes [`Layout::Rare`] files incorrectly. jpeg-decoder
//! decodes those, and can reduce to 1/2, 1/4 or 1/8 inside the DCT. Only the layout chooses between the two.

use jpeg_decoder::{ColorTransform, PixelFormat};
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use super::jpeg_frame::{Colour, Layout};
use super::jpeg_metadata::{END, Jpeg, READ_AHEAD};
use super::{PhotoError, broken};
use tmpi_core::Photo;

/// Decodes a JPEG at full size and returns whether it is damaged. Refuses a file of which too little is intact.
pub(super) fn whole(jpeg: &Jpeg) -> Result<(Photo, bool), PhotoError> {
    let is_common = jpeg.layout == Layout::Common;
    if jpeg.progressive && !jpeg.complete {
        if jpeg.scans < 2 {
            return Err(broken("it was cut within its first scan"));
        }
        let lenient = if is_common { common(&jpeg.stripped, false) } else { rare(jpeg, &jpeg.stripped, None) };
        return Ok((lenient?, true));
    }
    if !is_common {
        return detect_damage(jpeg, |file| rare(jpeg, file, None));
    }
    let strict = if jpeg.progressive && !jpeg.standalone {
        detect_damage(jpeg, |file| common(file, true))
    } else {
        common(&jpeg.open(), true).map(|photo| (photo, false))
    };
    strict.or_else(|_| {
        common(&jpeg.most(), true).map_err(|_| broken("too little of it can be read: it was cut short or is damaged"))?;
        Ok((common(&jpeg.stripped, false)?, true))
    })
}

/// Decodes a JPEG at 1/2, 1/4 or 1/8, but no smaller than `want`; `None` if that is not possible.
pub(super) fn reduced(jpeg: &Jpeg, want: (u32, u32)) -> Option<Photo> {
    rare(jpeg, &jpeg.stripped, Some(want)).ok().filter(|photo| photo.width >= want.0 && photo.height >= want.1)
}

/// Finds missing data with a decoder that fills in zeros for it: decodes twice, and what changes with the bytes after the data is
/// missing.
fn detect_damage(jpeg: &Jpeg, decode: impl Fn(&[u8]) -> Result<Photo, PhotoError>) -> Result<(Photo, bool), PhotoError> {
    let [photo, other] = [0, 0x55].map(|byte| decode(&jpeg.followed_by(&[&[byte; READ_AHEAD], &END[..]].concat())));
    let photo = photo?;
    let width = photo.width as usize;
    let rows = |other: Photo| photo.rgb.chunks(width).zip(other.rgb.chunks(width)).take_while(|(a, b)| a == b).count() as u64;
    let same = other.map_or(0, rows);
    // a progressive file has all rows, if only coarse ones
    if !jpeg.progressive && same < jpeg.most_rows() {
        return Err(broken("it was cut short"));
    }
    let damaged = same < u64::from(photo.height);
    Ok((photo, damaged))
}

/// Decodes a JPEG of one, three or four components. With `strict`, any fault in its data is an error; otherwise the decoder returns what
/// it can.
fn common(file: &[u8], strict: bool) -> Result<Photo, PhotoError> {
    let options = DecoderOptions::default().set_strict_mode(strict).set_max_width(usize::MAX).set_max_height(usize::MAX);
    let mut decoder = zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(file), options);
    decoder.decode_headers().map_err(broken)?;
    let (Some((width, height)), Some(stored)) = (decoder.dimensions(), decoder.input_colorspace()) else {
        return Err(broken("no frame header"));
    };
    let grey = stored == ColorSpace::Luma;
    decoder.set_options(options.jpeg_set_out_colorspace(if grey { ColorSpace::Luma } else { ColorSpace::RGB }));
    let mut rgb = vec![[0; 3]; width * height];
    if grey {
        let mut samples = vec![0; width * height];
        decoder.decode_into(&mut samples).map_err(broken)?;
        rgb.iter_mut().zip(samples).for_each(|(p, v)| *p = [v; 3]);
    } else {
        decoder.decode_into(rgb.as_flattened_mut()).map_err(broken)?;
    }
    Ok(Photo { width: width as u32, height: height as u32, rgb })
}

/// Decodes `file`, whose headers are those of `jpeg`: at full size, or at the smallest scale at which one side is still as long as in
/// `reduced`.
fn rare(jpeg: &Jpeg, file: &[u8], reduced: Option<(u32, u32)>) -> Result<Photo, PhotoError> {
    let mut decoder = jpeg_decoder::Decoder::new(file);
    decoder.set_color_transform(match jpeg.colour {
        Colour::Grey => ColorTransform::Grayscale,
        Colour::YCbCr => ColorTransform::YCbCr,
        Colour::Rgb => ColorTransform::RGB,
        Colour::Cmyk => ColorTransform::CMYK,
        Colour::Ycck => ColorTransform::YCCK,
    });
    if let Some((width, height)) = reduced {
        decoder.scale(u16::try_from(width).map_err(broken)?, u16::try_from(height).map_err(broken)?).map_err(broken)?;
    }
    let samples = decoder.decode().map_err(broken)?;
    let info = decoder.info().ok_or_else(|| broken("no frame header"))?;
    let rgb: Vec<[u8; 3]> = match info.pixel_format {
        PixelFormat::L8 => samples.iter().map(|&v| [v; 3]).collect(),
        PixelFormat::RGB24 => samples.as_chunks().0.to_vec(),
        // amounts of ink, with black printed over the others
        PixelFormat::CMYK32 => samples.as_chunks().0.iter().map(|&[c, m, y, k]| [c, m, y].map(|ink| over(ink, k))).collect(),
        PixelFormat::L16 => return Err(broken("JPEG with 16 bits per sample is not supported")),
    };
    let (width, height) = (u32::from(info.width), u32::from(info.height));
    if rgb.len() != width as usize * height as usize {
        return Err(broken("it has less data than pixels"));
    }
    Ok(Photo { width, height, rgb })
}

/// Light that passes two inks, one over the other, 0 to 255.
fn over(ink: u8, black: u8) -> u8 {
    ((u32::from(255 - ink) * u32::from(255 - black) + 127) / 255) as u8
}
