//! Time that the geometry of a frame may take.

/// Share of the time that depth may take.
const DEPTH: f64 = 0.6;
/// Weight of the newest measurement against all before.
const NEWEST: f64 = 0.2;

/// What a frame's geometry may take, by what it took before.
#[derive(Clone, Copy, Debug)]
pub struct Budget {
    /// Milliseconds a frame; infinite: everything is done at once.
    frame_ms: f64,
    depth_ms: Option<f64>,
    tile_ms: Option<f64>,
    /// Frames since depth was last estimated.
    waited: u32,
}

impl Budget {
    /// So many milliseconds a frame; anything but a positive number is no bound.
    #[must_use]
    pub fn new(frame_ms: f64) -> Self {
        Self { frame_ms: if frame_ms > 0.0 { frame_ms } else { f64::INFINITY }, depth_ms: None, tile_ms: None, waited: 0 }
    }

    /// Whether depth can be estimated for this frame: where it takes longer than its share of a frame, only so often that it keeps to it.
    pub fn depth_is_due(&mut self) -> bool {
        let share = self.depth_ms.unwrap_or(0.0) / (DEPTH * self.frame_ms);
        let due = f64::from(self.waited) + 1.0 >= share.floor();
        self.waited = if due { 0 } else { self.waited + 1 };
        due
    }

    /// What estimating depth took.
    pub fn depth_took(&mut self, ms: f64) {
        self.depth_ms = Some(mixed(self.depth_ms, ms));
    }

    /// Tiles whose planes can be placed in what is left of a frame; at least one.
    #[must_use]
    pub fn tiles(&self) -> usize {
        let depth = self.depth_ms.unwrap_or(0.0).min(DEPTH * self.frame_ms);
        match self.tile_ms {
            Some(ms) if ms > 0.0 => (((self.frame_ms - depth) / ms) as usize).max(1),
            _ => usize::MAX,
        }
    }

    /// What placing the planes of so many tiles took.
    pub fn tiles_took(&mut self, tiles: usize, ms: f64) {
        if tiles > 0 {
            self.tile_ms = Some(mixed(self.tile_ms, ms / tiles as f64));
        }
    }
}

fn mixed(before: Option<f64>, ms: f64) -> f64 {
    before.map_or(ms, |b| b + NEWEST * (ms - b))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_fits_is_done_each_frame_and_what_does_not_less_often() {
        let mut b = Budget::new(30.0);
        assert!(b.depth_is_due());
        b.depth_took(9.0);
        assert!((0..10).all(|_| b.depth_is_due()));
        b = Budget::new(30.0);
        b.depth_took(60.0);
        // 18 ms a frame are its share
        assert_eq!((0..30).filter(|_| b.depth_is_due()).count(), 10);
    }

    #[test]
    fn tiles_are_as_many_as_the_rest_of_the_frame_takes() {
        let mut b = Budget::new(30.0);
        assert_eq!(b.tiles(), usize::MAX);
        b.depth_took(10.0);
        b.tiles_took(10, 20.0);
        assert_eq!(b.tiles(), 10);
        b.tiles_took(1, 1e9);
        assert_eq!(b.tiles(), 1);
        assert_eq!(Budget::new(f64::NAN).tiles(), usize::MAX);
    }
}
