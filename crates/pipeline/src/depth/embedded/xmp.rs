//! XMP of a JPEG file: its main packet, and the extended packet in further segments (XMP specification, part 3, 1.1.3).

use roxmltree::{Document, Node, ParsingOptions};

use crate::photo::segments::applications;

const MAIN: &[u8] = b"http://ns.adobe.com/xap/1.0/\0";
/// Namespace of the property that names the extended packet.
const NOTE: &str = "http://ns.adobe.com/xmp/note/";
const EXTENSION: &[u8] = b"http://ns.adobe.com/xmp/extension/\0";
/// Bytes of an extended packet's name.
const NAME: usize = 32;
/// Most elements and texts of a packet; photos have a few hundred.
const NODES: u32 = 20_000;
/// Most attributes, and most namespace declarations. The parser compares each attribute of an element with all before it, and passes all
/// namespaces on from element to element. Photos have a few thousand and a few dozen.
const ATTRIBUTES: usize = 10_000;
const NAMESPACES: usize = 256;

/// The packets of a JPEG as text, the main one first. Of several extended packets, the one that the main packet names counts, since
/// editors leave old ones behind; if it names none, the first.
pub(crate) fn packets(jpeg: &[u8]) -> Vec<String> {
    let segments = applications(jpeg);
    let bodies = || segments.iter().filter(|s| s.number == 1).map(|s| s.body);
    let mut found: Vec<String> = bodies().find_map(|b| text(b.strip_prefix(MAIN)?)).into_iter().collect();
    let parts: Vec<Part> = bodies().filter_map(|b| Part::read(b.strip_prefix(EXTENSION)?)).collect();
    let named = found.first().and_then(|main| extension_of(main));
    let of_name = |part: &&Part| named.as_ref().is_none_or(|name| part.name.eq_ignore_ascii_case(name.as_bytes()));
    if let Some(first) = parts.iter().find(of_name) {
        found.extend(joined(first, &parts));
    }
    found
}

/// The name of the extended packet that a main one refers to.
fn extension_of(main: &str) -> Option<String> {
    document(main).and_then(|d| anywhere(&d, NOTE, "HasExtendedXMP").map(|name| name.trim().to_owned()))
}

fn text(bytes: &[u8]) -> Option<String> {
    let text = std::str::from_utf8(bytes).ok()?;
    Some(text.trim_matches(['\0', '\u{feff}']).to_owned())
}

/// A part of an extended packet.
struct Part<'a> {
    name: &'a [u8],
    /// Bytes of the whole packet.
    whole: usize,
    /// Offset of this part.
    at: usize,
    bytes: &'a [u8],
}

impl<'a> Part<'a> {
    fn read(body: &'a [u8]) -> Option<Self> {
        let (name, rest) = body.split_at_checked(NAME)?;
        let (whole, rest) = rest.split_first_chunk()?;
        let (at, bytes) = rest.split_first_chunk()?;
        Some(Self { name, whole: u32::from_be_bytes(*whole) as usize, at: u32::from_be_bytes(*at) as usize, bytes })
    }
}

/// The packet that `first` is a part of, if it is complete.
fn joined(first: &Part, parts: &[Part]) -> Option<String> {
    let mut own: Vec<&Part> = parts.iter().filter(|p| p.name == first.name).collect();
    own.sort_by_key(|p| p.at);
    let mut bytes = Vec::new();
    for part in own {
        // consecutive parts only, none twice: no more memory than the file
        if part.at == bytes.len() {
            bytes.extend_from_slice(part.bytes);
        }
    }
    if bytes.len() == first.whole { text(&bytes) } else { None }
}

/// Parses a packet. Returns `None` if it is not XML, or has more elements, attributes or namespaces than photos have.
pub(crate) fn document(packet: &str) -> Option<Document<'_>> {
    if packet.bytes().filter(|b| *b == b'=').count() > ATTRIBUTES || packet.matches("xmlns").count() > NAMESPACES {
        return None;
    }
    let options = ParsingOptions { allow_dtd: false, nodes_limit: NODES, ..ParsingOptions::default() };
    Document::parse_with_options(packet, options).ok()
}

/// Property `name` in namespace `space` of an element: an attribute, or the text of a child.
pub(super) fn property<'a>(element: Node<'a, '_>, space: &str, name: &str) -> Option<&'a str> {
    let child = || element.children().find(|c| c.has_tag_name((space, name))).and_then(|c| c.text());
    element.attribute((space, name)).or_else(child)
}

/// The first property of this name anywhere in the document.
pub(crate) fn anywhere<'a>(document: &'a Document, space: &str, name: &str) -> Option<&'a str> {
    document.descendants().find_map(|node| property(node, space, name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packets_with_too_many_names_are_refused() {
        let with = |attributes: usize, namespaces: usize| {
            let attributes = (0..attributes).map(|i| format!(" a{i}=''")).collect::<Vec<_>>().concat();
            let elements = (0..namespaces).map(|i| format!("<e xmlns:n{i}='u{i}'/>")).collect::<Vec<_>>().concat();
            document(&format!("<x{attributes}>{elements}</x>")).is_some()
        };
        assert!(with(ATTRIBUTES - 1, 0) && !with(ATTRIBUTES + 1, 0));
        assert!(with(9, NAMESPACES) && !with(9, NAMESPACES + 1));
        // parsing it would take minutes
        assert!(!with(2_000_000, 0));
    }
}
