//! Makes a container from some sections of another one.

use prost::Message;

use super::schema::{Kind, Section};
use super::{ContainerError, MAGIC, decode};

/// Names of the sections in file order. `index` stands for header and index, which every container has.
pub const SECTIONS: [&str; 6] = ["index", "photo", "planes", "labels", "alpha", "hidden"];

/// Makes a container of the sections in `names`, without changing their bytes. Its index lists only these sections. Ignores names of
/// sections that the container does not have.
///
/// # Errors
/// [`ContainerError::Broken`] or [`ContainerError::Newer`].
pub fn select(container: &[u8], names: &[&str]) -> Result<Vec<u8>, ContainerError> {
    let (mut index, body) = decode::split(container)?;
    let mut kept = Vec::new();
    let mut sections = Vec::new();
    for s in &index.sections {
        if !names.contains(&name(s.kind())) {
            continue;
        }
        sections.push(Section { offset: kept.len() as u64, ..s.clone() });
        kept.extend_from_slice(decode::range(s, body)?);
    }
    index.sections = sections;
    Ok([header(&container[4..8], &index.encode_to_vec()), kept].concat())
}

/// Header and index of a container; `version` is the major and minor version, little-endian.
pub(super) fn header(version: &[u8], index: &[u8]) -> Vec<u8> {
    [&MAGIC[..], version, &(index.len() as u32).to_le_bytes(), index].concat()
}

/// Name of a section.
pub fn name(kind: Kind) -> &'static str {
    match kind {
        Kind::Photo => "photo",
        Kind::Planes => "planes",
        Kind::Labels => "labels",
        Kind::Alpha => "alpha",
        Kind::Hidden => "hidden",
        Kind::Unspecified => "unknown",
    }
}
