//! Entry point for fuzzing.

use super::schema::message::Kind;
use super::{TileState, chunk, read};
use crate::{Geometry, Grid, Intrinsics, ViewBox};

/// Reads a message, and applies its tiles to a small room; then encodes and decodes the tiles again.
///
/// # Panics
/// If the tiles change when they are encoded and decoded again.
pub fn message(data: &[u8]) {
    let Ok(kind) = read(data.to_vec().into()) else { return };
    match kind {
        Kind::Hello(hello) => drop(TileState::new(&hello)),
        Kind::Geometry(g) | Kind::Snapshot(g) => {
            let grid = Grid::new(130, 100, 64);
            let empty = Geometry {
                grid,
                intrinsics: Intrinsics::centred(130, 100, 75.0),
                view_box: ViewBox::cube(0.03),
                tiles: Vec::new(),
                matte_band: 0,
            };
            let Ok(mut model) = TileState::new(&TileState::hello(&empty)) else { return };
            if model.take(&g).is_err() {
                return;
            }
            let Some(geometry) = model.geometry() else { return };
            for c in &g.chunks {
                let again = chunk::encode(&grid, chunk::area(c), &geometry.tiles, 1).and_then(|c| chunk::decode(&grid, &c));
                let same = |tiles: &Vec<_>| tiles.iter().all(|(i, t)| *t == geometry.tiles[*i as usize]);
                assert!(again.as_ref().is_ok_and(same), "decoded tiles encode differently");
            }
        }
        _ => {}
    }
}
