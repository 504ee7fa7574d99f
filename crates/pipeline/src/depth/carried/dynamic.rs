//! Dynamic Depth 1.0: <https://developer.android.com/media/camera/camera2/Dynamic-depth-v1.0.pdf>.

use roxmltree::Node;

use super::{Found, google, xmp};

const DEPTH: &str = "http://ns.google.com/photos/dd/1.0/depthmap/";
/// Namespaces of the list of pictures, of the specification and of what writers make of it.
const ITEMS: [&str; 3] = [
    "http://ns.google.com/photos/dd/1.0/item/",
    "http://ns.google.com/photos/1.0/container/item/",
    "http://ns.google.com/photos/dd/1.0/container/item/",
];

/// A picture that the list names.
struct Item<'a> {
    address: Option<&'a str>,
    length: usize,
}

impl<'a> Item<'a> {
    fn read(node: Node<'a, '_>) -> Option<Self> {
        let get = |name| ITEMS.iter().find_map(|space| xmp::property(node, space, name));
        get("Mime")?;
        let length = get("Length").map_or(Some(0), |l| l.trim().parse().ok())?;
        Some(Self { address: get("DataURI"), length })
    }
}

/// The depth map behind a photo that XMP packets describe.
pub(super) fn find(photo: &[u8], packets: &[String]) -> Option<Found> {
    let documents: Vec<_> = packets.iter().filter_map(|p| xmp::document(p)).collect();
    let get = |name| documents.iter().find_map(|d| xmp::anywhere(d, DEPTH, name));
    let address = get("DepthURI")?;
    let items: Vec<Item> = documents.iter().flat_map(|d| d.descendants().filter_map(Item::read)).collect();
    let read = || {
        let scale = google(get("Format"), get("Near"), get("Far"))?;
        // the first is the photo itself; the others lie one behind the other up to the end of the file
        let others = items.get(1..).unwrap_or_default();
        let place = others.iter().position(|i| i.address == Some(address)).ok_or_else(|| format!("no picture {address} is listed"))?;
        let behind = others[place..].iter().try_fold(0usize, |sum, i| sum.checked_add(i.length));
        let start = behind.and_then(|n| photo.len().checked_sub(n)).ok_or("the pictures listed are longer than the file")?;
        let picture = photo.get(start..start + others[place].length).ok_or("the pictures listed are longer than the file")?;
        Ok(("dynamic-depth", picture.to_vec(), scale))
    };
    Some(read())
}
