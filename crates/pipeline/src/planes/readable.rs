//! Options against the bounds of those who read the container.

use crate::StageError;
use crate::run::{Options, PlaneCount, TileSize};
use tmpi_core::Grid;
use tmpi_core::container::most_planes;

impl Options {
    /// The grid of tiles over a scene of that size.
    #[must_use]
    pub fn grid(&self, width: u32, height: u32) -> Grid {
        match self.tile {
            TileSize::Pixels(size) => Grid::new(width, height, size),
            TileSize::Full => Grid::full(width, height),
        }
    }

    /// Refuses what could lead, for a scene of that size, to a container that no reader takes.
    ///
    /// # Errors
    /// [`StageError::Bound`] names the option and the most that can be.
    pub fn check_readable(&self, width: u32, height: u32) -> Result<(), StageError> {
        let most = most_planes(&self.grid(width, height));
        if most == 0 {
            let detail = format!("tiles this small are too many for {width}×{height} pixels: readers bound what layers look at");
            return Err(StageError::Bound { field: "tile", detail });
        }
        match self.planes {
            PlaneCount::Fixed(n) if n > most => {
                let detail = format!("{n} planes a tile are over the {most} that readers take of {width}×{height} pixels in such tiles");
                Err(StageError::Bound { field: "planes", detail })
            }
            PlaneCount::Fixed(_) | PlaneCount::Auto => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_at_the_bound_pass_and_one_more_are_refused_by_name() {
        let tile = TileSize::Pixels(8);
        let most = most_planes(&Grid::new(640, 480, 8));
        let at = |n| Options { tile, planes: PlaneCount::Fixed(n), ..Options::default() }.check_readable(640, 480);
        assert!(most < 64 && at(most).is_ok());
        assert!(matches!(at(most + 1), Err(StageError::Bound { field: "planes", .. })));
        let small = Options { tile, ..Options::default() }.check_readable(8192, 6000);
        assert!(matches!(small, Err(StageError::Bound { field: "tile", .. })));
        assert!(Options::default().check_readable(8192, 6000).is_ok());
    }
}
