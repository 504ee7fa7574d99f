//! Google's depth map metadata: <https://developers.google.com/depthmap-metadata/reference>.

use base64::Engine as _;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};

use super::{DepthPicture, google, xmp};

const SPACE: &str = "http://ns.google.com/photos/1.0/depthmap/";

/// Finds the depth map in XMP packets.
pub(super) fn find(packets: &[String]) -> Option<DepthPicture> {
    let documents: Vec<_> = packets.iter().filter_map(|p| xmp::document(p)).collect();
    let get = |name| documents.iter().find_map(|d| xmp::anywhere(d, SPACE, name));
    let format = get("Format")?;
    // Dynamic Depth reuses the names of some properties, but not this one
    let Some(data) = get("Data") else {
        return Some(Err("its extended XMP, which should hold the map, is incomplete".into()));
    };
    let read = || {
        let scale = google(Some(format), get("Near"), get("Far"))?;
        let lenient =
            GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent).with_decode_allow_trailing_bits(true);
        let data: Vec<u8> = data.bytes().filter(|b| !b.is_ascii_whitespace()).collect();
        let picture = GeneralPurpose::new(&base64::alphabet::STANDARD, lenient).decode(data).map_err(|e| e.to_string())?;
        Ok(("gdepth", picture, scale))
    };
    Some(read())
}
