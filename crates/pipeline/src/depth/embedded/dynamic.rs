//! Dynamic Depth 1.0: <https://developer.android.com/media/camera/camera2/Dynamic-depth-v1.0.pdf>.

use roxmltree::Node;

use super::{DepthPicture, google, xmp};
use crate::photo::segments;
use tmpi_core::container::PhotoFormat;

const DEPTH: &str = "http://ns.google.com/photos/dd/1.0/depthmap/";
/// Namespaces of the list of pictures: that of the specification, and those that writers use.
const ITEMS: [&str; 3] = [
    "http://ns.google.com/photos/dd/1.0/item/",
    "http://ns.google.com/photos/1.0/container/item/",
    "http://ns.google.com/photos/dd/1.0/container/item/",
];

/// An entry of the list of pictures.
struct Item<'a> {
    address: Option<&'a str>,
    length: usize,
    /// Unused bytes after it.
    padding: usize,
}

impl<'a> Item<'a> {
    fn read(node: Node<'a, '_>) -> Option<Self> {
        let get = |name| ITEMS.iter().find_map(|space| xmp::property(node, space, name));
        get("Mime")?;
        let bytes = |name| get(name).map_or(Some(0), |l| l.trim().parse().ok());
        Some(Self { address: get("DataURI"), length: bytes("Length")?, padding: bytes("Padding")? })
    }

    /// Total bytes of consecutive items.
    fn all(items: &[Self]) -> Option<usize> {
        items.iter().try_fold(0usize, |sum, i| sum.checked_add(i.length)?.checked_add(i.padding))
    }
}

/// Finds the depth map after a photo that XMP packets describe.
pub(super) fn find(photo: &[u8], packets: &[String]) -> Option<DepthPicture> {
    let documents: Vec<_> = packets.iter().filter_map(|p| xmp::document(p)).collect();
    let get = |name| documents.iter().find_map(|d| xmp::anywhere(d, DEPTH, name));
    let address = get("DepthURI")?;
    let items: Vec<Item> = documents.iter().flat_map(|d| d.descendants().filter_map(Item::read)).collect();
    let read = || {
        let scale = google(get("Format"), get("Near"), get("Far"))?;
        let place =
            items.iter().skip(1).position(|i| i.address == Some(address)).ok_or_else(|| format!("picture {address} is not listed"))? + 1;
        let longer = "the listed pictures are longer than the file";
        let (before, behind) = (Item::all(&items[1..place]).ok_or(longer)?, Item::all(&items[place..]).ok_or(longer)?);
        // the first item is the photo itself; the others follow each other up to the end of the file, unless a program appended more:
        // then they are counted from the end of the photo
        let at_end = photo.len().checked_sub(behind);
        let at_photo = || segments::end(photo)?.checked_add(items[0].padding)?.checked_add(before);
        let picture = |start: Option<usize>| photo.get(start?..)?.get(..items[place].length).filter(|p| PhotoFormat::sniff(p).is_some());
        let picture = picture(at_end).or_else(|| picture(at_photo())).ok_or(longer)?;
        Ok(("dynamic-depth", picture.to_vec(), scale))
    };
    Some(read())
}
