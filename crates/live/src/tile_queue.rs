//! Queue of tiles that wait for planes.

/// After this many frames, a tile precedes all that have waited less, however much they changed, so that no tile waits forever.
pub(crate) const MAX_WAIT: u32 = 8;

/// Tiles that wait for planes, and coarse tiles that get more when there is time.
#[derive(Clone, Debug)]
pub(crate) struct Queue {
    tiles: Vec<Waiting>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Waiting {
    /// How much the tile changed; 0: it does not wait.
    change: u64,
    /// Number of frames it has waited.
    age: u32,
    /// A time limit capped its planes, so it may need more.
    coarse: bool,
}

impl Queue {
    /// A queue for this many tiles, of which none waits.
    pub fn new(tiles: usize) -> Self {
        Self { tiles: vec![Waiting::default(); tiles] }
    }

    /// Number of tiles that wait, without coarse ones.
    pub fn waiting(&self) -> usize {
        self.tiles.iter().filter(|w| w.change > 0).count()
    }

    /// Number of coarse tiles.
    pub fn coarse(&self) -> usize {
        self.tiles.iter().filter(|w| w.coarse).count()
    }

    /// Whether a tile waits.
    pub fn waits(&self, tile: u32) -> bool {
        self.tiles[tile as usize].change > 0
    }

    /// Adds a change of a tile.
    pub fn add(&mut self, tile: u32, change: u64) {
        self.tiles[tile as usize].change += change;
    }

    /// Counts a frame for all tiles that wait.
    pub fn age(&mut self) {
        self.tiles.iter_mut().filter(|w| w.change > 0).for_each(|w| w.age = w.age.saturating_add(1));
    }

    /// The next tiles, at most `most`. If not all waiting tiles fit: first those that have waited long, oldest first, then those that
    /// changed most. If all fit and `again` is set, coarse tiles follow.
    pub fn next(&self, most: usize, again: bool) -> Vec<u32> {
        let mut next: Vec<u32> = (0..).zip(&self.tiles).filter(|(_, w)| w.change > 0).map(|(t, _)| t).collect();
        if next.len() > most {
            let turn = |t: &u32| {
                let Waiting { change, age, .. } = self.tiles[*t as usize];
                std::cmp::Reverse((if age >= MAX_WAIT { age } else { 0 }, change))
            };
            next.sort_by_key(turn);
            next.truncate(most);
        } else if again {
            let coarse = (0..).zip(&self.tiles).filter(|(_, w)| w.coarse && w.change == 0).map(|(t, _)| t);
            next.extend(coarse.take(most - next.len()));
        }
        next
    }

    /// Marks a tile as done; `coarse` if it may need more planes.
    pub fn done(&mut self, tile: u32, coarse: bool) {
        self.tiles[tile as usize] = Waiting { coarse, ..Waiting::default() };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn most_changed_tiles_come_first_and_coarse_ones_last() {
        let mut queue = Queue::new(6);
        for (tile, change) in [(0, 5), (2, 9), (3, 7)] {
            queue.add(tile, change);
        }
        queue.done(5, true);
        assert_eq!((queue.waiting(), queue.coarse()), (3, 1));
        assert_eq!((queue.next(2, true), queue.next(3, true), queue.next(9, false)), (vec![2, 3], vec![0, 2, 3], vec![0, 2, 3]));
        assert_eq!(queue.next(9, true), [0, 2, 3, 5]);
        queue.done(5, false);
        assert_eq!((queue.next(9, true), queue.coarse()), (vec![0, 2, 3], 0));
    }

    #[test]
    fn no_tile_starves() {
        let mut queue = Queue::new(20);
        let mut longest = [0u32; 20];
        let mut since = [None::<u32>; 20];
        for frame in 0..400 {
            // tile 0 rarely changes, and only slightly; all others change much in each frame
            for tile in 0..20 {
                if tile > 0 || frame % 40 == 0 {
                    queue.add(tile, if tile == 0 { 1 } else { 1000 + u64::from(tile) });
                    since[tile as usize].get_or_insert(frame);
                }
            }
            for tile in queue.next(1, true) {
                queue.done(tile, false);
                if let Some(from) = since[tile as usize].take() {
                    longest[tile as usize] = longest[tile as usize].max(frame - from);
                }
            }
            queue.age();
        }
        // starving tiles go in order of arrival: a tile waits for each other tile once
        assert!(longest.iter().all(|l| *l > 0 && *l <= MAX_WAIT + 20), "{longest:?}");
        assert!(since.iter().flatten().all(|from| 400 - from <= MAX_WAIT + 20), "{since:?}");
    }
}
