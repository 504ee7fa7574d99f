//! Tiles that wait for planes.

/// Tiles that wait for planes, and coarse tiles that get more when there is time.
#[derive(Clone, Debug)]
pub(crate) struct Queue {
    tiles: Vec<Waiting>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Waiting {
    /// The tile has changed.
    changed: bool,
    /// A time limit capped its planes, so it may need more.
    coarse: bool,
}

impl Queue {
    /// A queue for this many tiles, of which none waits.
    pub fn new(tiles: usize) -> Self {
        Self { tiles: vec![Waiting::default(); tiles] }
    }

    /// Number of changed tiles that wait.
    pub fn waiting(&self) -> usize {
        self.tiles.iter().filter(|w| w.changed).count()
    }

    /// Number of coarse tiles.
    pub fn coarse(&self) -> usize {
        self.tiles.iter().filter(|w| w.coarse).count()
    }

    /// Whether a changed tile waits.
    pub fn waits(&self, tile: u32) -> bool {
        self.tiles[tile as usize].changed
    }

    /// Adds a changed tile.
    pub fn add(&mut self, tile: u32) {
        self.tiles[tile as usize].changed = true;
    }

    /// The next tiles: all that changed, because an object is torn if some of its tiles are from another frame than the others; then `spare`
    /// coarse ones.
    pub fn next(&self, spare: usize) -> Vec<u32> {
        let of = |is: fn(&Waiting) -> bool| (0..).zip(&self.tiles).filter(move |(_, w)| is(w)).map(|(t, _)| t);
        let mut next: Vec<u32> = of(|w| w.changed).collect();
        next.extend(of(|w| w.coarse && !w.changed).take(spare));
        next
    }

    /// Marks a tile as done; `coarse` if it may need more planes.
    pub fn done(&mut self, tile: u32, coarse: bool) {
        self.tiles[tile as usize] = Waiting { changed: false, coarse };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changed_tiles_go_together_and_coarse_ones_follow_if_there_is_time() {
        let mut queue = Queue::new(7);
        for tile in [0, 2, 3] {
            queue.add(tile);
        }
        for tile in [5, 6] {
            queue.done(tile, true);
        }
        assert_eq!((queue.waiting(), queue.coarse(), queue.waits(2), queue.waits(5)), (3, 2, true, false));
        assert_eq!([0, 1, 9].map(|spare| queue.next(spare)), [vec![0, 2, 3], vec![0, 2, 3, 5], vec![0, 2, 3, 5, 6]]);
        queue.done(5, false);
        queue.done(2, false);
        assert_eq!((queue.next(9), queue.coarse()), (vec![0, 3, 6], 1));
    }
}
