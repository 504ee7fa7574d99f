//! The two facts that are read from EXIF: orientation and focal length.

use exif::{In, Reader, Tag, Value};

/// What EXIF says about a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Facts {
    /// EXIF orientation, 1 to 8.
    pub orientation: u8,
    /// Focal length in millimetres on 35 mm film, where it is sane.
    pub focal_35: Option<f64>,
}

impl Facts {
    const NONE: Self = Self { orientation: 1, focal_35: None };
    /// Focal lengths on 35 mm film that a camera can have; beyond them lies a faulty writer.
    pub(super) const FOCAL_35: std::ops::RangeInclusive<f64> = 8.0..=600.0;

    /// Reads a TIFF structure; what cannot be read is as if it were not there.
    pub(super) fn read(tiff: Option<&[u8]>) -> Self {
        let Some(tiff) = tiff else { return Self::NONE };
        let read = Reader::new().continue_on_error(true).read_raw(tiff.to_vec());
        let Ok(exif) = read.or_else(|e| e.distill_partial_result(|_| ())) else { return Self::NONE };
        let orientation = exif.get_field(Tag::Orientation, In::PRIMARY).and_then(|f| f.value.get_uint(0));
        let focal = exif.get_field(Tag::FocalLengthIn35mmFilm, In::PRIMARY).and_then(|f| number(&f.value));
        Self {
            orientation: orientation.and_then(|o| u8::try_from(o).ok()).filter(|o| (1..=8).contains(o)).unwrap_or(1),
            focal_35: focal.filter(|f| Self::FOCAL_35.contains(f)),
        }
    }
}

/// First number of a value; the standard says SHORT, writers also use other types.
fn number(value: &Value) -> Option<f64> {
    match value {
        Value::Rational(v) => v.first().map(exif::Rational::to_f64),
        Value::SRational(v) => v.first().map(exif::SRational::to_f64),
        Value::Float(v) => v.first().map(|&f| f64::from(f)),
        Value::Double(v) => v.first().copied(),
        _ => value.get_uint(0).map(f64::from),
    }
}
