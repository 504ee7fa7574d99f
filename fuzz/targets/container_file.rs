//! Containers for the fuzzer: valid ones with a few changes and corrected checksums.

use prost::Message as _;
use tmpi_core::container::schema::Index;
use tmpi_core::container::{EncodedPhoto, HiddenCodec, MAGIC, OptionalSections, PhotoFormat, encode_in, encode_lossless, readable};
use tmpi_core::{Geometry, MATTE_BAND, Photo, Plane, compose, texture};

use super::arbitrary::{Script, geometry};

/// Maximum number of planes per tile: one more than the format allows.
const MAX_PLANES: u32 = 66;
/// Bytes before the index: magic, version, length of the index.
const HEAD: usize = 12;

/// Splits a container into its index and the bytes that follow.
fn apart(bytes: &[u8]) -> Option<(Index, &[u8])> {
    let length = u32::from_le_bytes(bytes.get(8..HEAD)?.try_into().ok()?) as usize;
    let (index, body) = bytes[HEAD..].split_at_checked(length)?;
    Some((Index::decode(index).ok()?, body))
}

fn together(version: &[u8], index: &Index, body: &[u8]) -> Vec<u8> {
    let index = index.encode_to_vec();
    [&MAGIC[..], version, &(index.len() as u32).to_le_bytes(), &index, body].concat()
}

/// Corrects the checksums of a container's bands, so that a reader gets past them; `None` if the container has no bands.
pub fn with_checksums(bytes: &[u8]) -> Option<Vec<u8>> {
    let (mut index, body) = apart(bytes)?;
    set_checksums(&mut index, body).then(|| together(&bytes[4..8], &index, body))
}

/// Corrects the checksums of all bands; returns whether there are any.
fn set_checksums(index: &mut Index, body: &[u8]) -> bool {
    let mut bands = 0;
    for section in &mut index.sections {
        let range = section.offset.checked_add(section.length).map(|end| section.offset as usize..end as usize);
        let mut data = range.and_then(|range| body.get(range)).unwrap_or_default();
        for band in &mut section.bands {
            let Some(own) = data.split_off(..band.length as usize) else { break };
            band.check = crc32fast::hash(own);
            bands += 1;
        }
    }
    bands > 0
}

/// Builds a container that is valid except for the changes that the last bytes of `data` make. Its checksums are correct. `None` if no
/// container can be written from `data`.
pub fn build(data: &[u8]) -> Option<Vec<u8>> {
    let mut script = Script(data);
    let geometry = geometry(&mut script, MAX_PLANES);
    if !geometry.tiles.iter().flat_map(|t| t.planes.iter().chain(&t.background)).all(Plane::is_finite) {
        return None;
    }
    if !readable(&geometry.grid, &geometry.tiles) {
        return None;
    }
    let (width, height) = (geometry.grid.width, geometry.grid.height);
    let photo = Photo { width, height, rgb: (0..width * height).map(|i| [(i % width) as u8, (i / width) as u8, 90]).collect() };
    let how = script.byte();
    let photo_file = match how & 3 {
        0 => EncodedPhoto::from_photo(&photo, 80).ok()?,
        1 => EncodedPhoto::lossless(&photo).ok()?,
        _ => {
            let bytes = encode_lossless(image::ImageFormat::Png, width, height, photo.rgb.as_flattened()).ok()?;
            EncodedPhoto { bytes, format: PhotoFormat::Png }
        }
    };
    let hidden = [None, None, Some(HiddenCodec::Png), Some(HiddenCodec::Jpeg(80))][usize::from(how >> 2 & 3)];
    let geometry = Geometry { matte_band: if how >> 6 & 1 == 1 { MATTE_BAND } else { 0 }, ..geometry };
    let optional =
        if geometry.matte_band > 0 { OptionalSections::default() } else { OptionalSections { alpha: how >> 4 & 1 == 1, hidden } };
    let mut scene = compose(photo.clone(), &geometry, texture(&photo, &geometry, geometry.masks()));
    if optional.alpha {
        scene.texels.alpha.iter_mut().filter(|a| (1..255).contains(*a)).step_by(3).for_each(|a| *a = 17);
    }
    let rows = (how >> 5 & 1 == 1).then(|| 1 + script.below(4));
    let (bytes, _) = encode_in(rows, &geometry, &scene, &photo_file, optional).ok()?;
    let (mut index, body) = apart(&bytes)?;
    let mut body = body.to_vec();
    while !script.0.is_empty() {
        change(&mut script, &mut index, &mut body);
    }
    set_checksums(&mut index, &body);
    Some(together(&bytes[4..8], &index, &body))
}

/// Changes a field of the index or of a section, some bytes, or the order of sections.
fn change(script: &mut Script, index: &mut Index, body: &mut Vec<u8>) {
    match script.below(8) {
        0 => {
            let Index { width, height, tile_size, tile_stride, planes, hidden_blocks, hidden_columns, .. } = index;
            script.change(&mut [width, height, tile_size, tile_stride, planes, hidden_blocks, hidden_columns]);
        }
        1 => {
            let Index { fx, fy, cx, cy, view_x, view_y, view_z, .. } = index;
            let fields = &mut [fx, fy, cx, cy, view_x, view_y, view_z];
            let at = script.below(7) as usize;
            *fields[at] = script.real(*fields[at]);
        }
        2 | 3 => {
            let at = script.below(index.sections.len() as u32) as usize;
            let Some(section) = index.sections.get_mut(at) else { return };
            match script.below(6) {
                0 => section.offset = script.number(section.offset),
                1 => section.length = script.number(section.length),
                2 => section.raw_length = script.number(section.raw_length),
                3 => section.codec = script.below(8) as i32,
                4 => section.kind = script.below(7) as i32,
                _ => {
                    let at = script.below(section.bands.len() as u32) as usize;
                    let Some(band) = section.bands.get_mut(at) else { return };
                    script.change(&mut [&mut band.rows, &mut band.length]);
                }
            }
        }
        4 => {
            let at = script.below(index.sections.len() as u32) as usize;
            if at < index.sections.len() {
                let section = index.sections.remove(at);
                if script.below(2) == 1 {
                    index.sections.insert(0, section);
                }
            }
        }
        5 => body.truncate(body.len().saturating_sub(script.number(0) as usize)),
        _ => {
            let at = script.word() as usize % body.len().max(1);
            if let Some(byte) = body.get_mut(at) {
                *byte = script.byte();
            }
        }
    }
}
