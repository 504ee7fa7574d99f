//! Rooms for the fuzzer: messages that are valid except for a few changes, with correct checksums.

use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::schema::{self, Hello};
use tmpi_core::live::{MAX_PLANES, TileState, chunk};

use super::arbitrary::{Script, geometry};

/// Builds a room: its hello, and messages of chunks. They are valid except for the changes that the last bytes of `data` make.
pub fn build(data: &[u8]) -> (Hello, Vec<schema::Geometry>) {
    let mut script = Script(data);
    let mut geometry = geometry(&mut script, MAX_PLANES as u32 + 1);
    geometry.tiles.iter_mut().for_each(|t| t.planes.truncate(MAX_PLANES));
    let mut hello = TileState::hello(&geometry);
    let messages = (0..=script.below(3)).map(|_| {
        let grid = geometry.grid;
        let wanted = script.byte();
        // all tiles, or some rectangles of them
        let areas =
            if wanted < 64 { vec![chunk::Area::all(&grid)] } else { chunk::Area::covering(&grid, |t| t % 7 < u32::from(wanted) % 7) };
        let frame = u64::from(script.byte());
        let chunks = areas.into_iter().filter_map(|area| chunk::encode(&grid, area, &geometry.tiles, frame).ok()).collect();
        schema::Geometry { frame, chunks }
    });
    let mut messages: Vec<schema::Geometry> = messages.collect();
    while !script.0.is_empty() {
        let which = script.below(messages.len() as u32) as usize;
        change_message(&mut script, &mut hello, &mut messages[which]);
    }
    messages.iter_mut().flat_map(|m| &mut m.chunks).for_each(set_check);
    (hello, messages)
}

/// Changes a field of the hello or of a chunk, or some of its bytes.
fn change_message(script: &mut Script, hello: &mut Hello, message: &mut schema::Geometry) {
    if script.below(16) == 1 {
        let Hello { width, height, tile_size, tile_stride, .. } = hello;
        return script.change(&mut [width, height, tile_size, tile_stride]);
    }
    let at = script.word() as usize % message.chunks.len().max(1);
    let Some(chunk) = message.chunks.get_mut(at) else { return };
    match script.below(4) {
        0 => {
            let schema::Chunk { column, row, columns, rows, planes, .. } = chunk;
            script.change(&mut [column, row, columns, rows, planes]);
        }
        1 => chunk.version = script.number(chunk.version),
        what => {
            let data = if what == 2 { &mut chunk.plane_data } else { &mut chunk.label_data };
            let mut bytes = data.to_vec();
            let at = script.word() as usize % bytes.len().max(1);
            match bytes.get_mut(at) {
                Some(byte) if script.below(4) > 0 => *byte = script.byte(),
                _ => bytes.truncate(at),
            }
            *data = bytes.into();
        }
    }
}

/// Corrects a chunk's checksum.
fn set_check(chunk: &mut schema::Chunk) {
    let c = &*chunk;
    let head = [c.column.into(), c.row.into(), c.columns.into(), c.rows.into(), c.version, c.planes.into()].map(u64::to_le_bytes);
    chunk.check = crc32fast::hash(&[head.as_flattened(), &chunk.plane_data, &chunk.label_data].concat());
}

/// Corrects the checksums of a message's chunks; `None` if it has no chunks.
pub fn with_checksums(data: &[u8]) -> Option<Vec<u8>> {
    let mut kind = tmpi_core::live::read(data.to_vec().into()).ok()?;
    let (Kind::Geometry(message) | Kind::Snapshot(message)) = &mut kind else { return None };
    message.chunks.iter_mut().for_each(set_check);
    Some(tmpi_core::live::write(kind).to_vec())
}
