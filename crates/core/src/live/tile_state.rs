//! A viewer's knowledge of the tiles of a room.

use super::schema::{self, Chunk, Hello};
use super::{LiveError, MAX_PIXELS, MIN_TILE, VERSION, chunk};
use crate::container::bounds;
use crate::{Geometry, Grid, Intrinsics, Tile, ViewBox};

/// Planes and labels of all tiles, each from the newest chunk received.
#[derive(Clone, Debug)]
pub struct TileState {
    geometry: Geometry,
    /// Number of the frame that each tile comes from; `None` before the first chunk with it.
    versions: Vec<Option<u64>>,
}

impl TileState {
    /// A model of a room without any tiles yet.
    ///
    /// # Errors
    /// [`LiveError::Newer`] if the version is newer; [`LiveError::Broken`] or [`LiveError::Container`] if grid or camera are invalid or
    /// exceed a limit.
    pub fn new(hello: &Hello) -> Result<Self, LiveError> {
        if hello.version > VERSION {
            return Err(LiveError::Newer { found: hello.version });
        }
        let grid = Grid { width: hello.width, height: hello.height, size: hello.tile_size, stride: hello.tile_stride };
        let intrinsics = Intrinsics { fx: hello.fx, fy: hello.fy, cx: hello.cx, cy: hello.cy };
        let view_box = ViewBox { x: hello.view_x, y: hello.view_y, z: hello.view_z };
        bounds::frame(&grid, &intrinsics, &view_box)?;
        if u64::from(grid.width) * u64::from(grid.height) > MAX_PIXELS {
            return Err(LiveError::broken(format!("frames of {}×{}, over {MAX_PIXELS} pixels", grid.width, grid.height)));
        }
        if grid.size < MIN_TILE {
            return Err(LiveError::broken(format!("tiles of {} pixels, below {MIN_TILE}", grid.size)));
        }
        let tiles = vec![Tile::default(); grid.tiles() as usize];
        Ok(Self { versions: vec![None; tiles.len()], geometry: Geometry { grid, intrinsics, view_box, tiles, matte_band: 0 } })
    }

    /// The HELLO message of a room whose tiles are those of `geometry`.
    pub fn hello(geometry: &Geometry) -> Hello {
        let Geometry { grid, intrinsics: k, view_box: v, .. } = geometry;
        Hello {
            version: VERSION,
            width: grid.width,
            height: grid.height,
            tile_size: grid.size,
            tile_stride: grid.stride,
            fx: k.fx,
            fy: k.fy,
            cx: k.cx,
            cy: k.cy,
            view_x: v.x,
            view_y: v.y,
            view_z: v.z,
            ..Hello::default()
        }
    }

    /// Number of tiles.
    pub fn tiles(&self) -> u32 {
        self.geometry.grid.tiles()
    }

    /// All tiles; `None` until each is known.
    pub fn geometry(&self) -> Option<&Geometry> {
        self.versions.iter().all(Option::is_some).then_some(&self.geometry)
    }

    /// Applies the chunks of a message and returns the indices of the tiles that it replaced. Keeps a tile that is from the same or a newer
    /// frame.
    ///
    /// # Errors
    /// [`LiveError`] of the first invalid chunk; the chunks before it are applied.
    pub fn take(&mut self, message: &schema::Geometry) -> Result<Vec<u32>, LiveError> {
        let mut changed = Vec::new();
        for chunk in &message.chunks {
            self.take_chunk(chunk, &mut changed)?;
        }
        Ok(changed)
    }

    fn take_chunk(&mut self, chunk: &Chunk, changed: &mut Vec<u32>) -> Result<(), LiveError> {
        for (index, tile) in chunk::decode(&self.geometry.grid, chunk)? {
            let known = &mut self.versions[index as usize];
            if known.is_none_or(|known| known < chunk.version) {
                *known = Some(chunk.version);
                self.geometry.tiles[index as usize] = tile;
                changed.push(index);
            }
        }
        Ok(())
    }
}
