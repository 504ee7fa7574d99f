//! Tiles that wait for their planes.

/// Frames after which a tile goes before all that wait for a shorter time, however much these changed: none waits for ever.
pub(crate) const STARVES: u32 = 8;

/// Which tiles wait, and which are to be looked at again when there is time.
#[derive(Clone, Debug)]
pub(crate) struct Queue {
    tiles: Vec<Waiting>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Waiting {
    /// How much it changed; 0: it does not wait.
    by: u64,
    /// Frames for which it has waited.
    age: u32,
    /// It was given as many planes as there was time for, which may be fewer than it needs.
    coarse: bool,
}

impl Queue {
    /// None of so many waits.
    pub fn new(tiles: usize) -> Self {
        Self { tiles: vec![Waiting::default(); tiles] }
    }

    /// How many wait, but for those that are looked at again.
    pub fn waiting(&self) -> usize {
        self.tiles.iter().filter(|w| w.by > 0).count()
    }

    /// How many have fewer planes than they may need.
    pub fn coarse(&self) -> usize {
        self.tiles.iter().filter(|w| w.coarse).count()
    }

    /// Whether one waits.
    pub fn waits(&self, tile: u32) -> bool {
        self.tiles[tile as usize].by > 0
    }

    /// A tile changed by so much.
    pub fn add(&mut self, tile: u32, by: u64) {
        self.tiles[tile as usize].by += by;
    }

    /// A frame has gone by.
    pub fn age(&mut self) {
        self.tiles.iter_mut().filter(|w| w.by > 0).for_each(|w| w.age = w.age.saturating_add(1));
    }

    /// Those whose turn it is, `most` at most: all that wait where there is time for them, else first, from the oldest on, those that have waited for
    /// long, then those that changed most. Where nothing holds tiles back, those that were held follow with `again`.
    pub fn next(&self, most: usize, again: bool) -> Vec<u32> {
        let mut next: Vec<u32> = (0..).zip(&self.tiles).filter(|(_, w)| w.by > 0).map(|(t, _)| t).collect();
        if next.len() > most {
            let turn = |t: &u32| {
                let Waiting { by, age, .. } = self.tiles[*t as usize];
                std::cmp::Reverse((if age >= STARVES { age } else { 0 }, by))
            };
            next.sort_by_key(turn);
            next.truncate(most);
        } else if again {
            let coarse = (0..).zip(&self.tiles).filter(|(_, w)| w.coarse && w.by == 0).map(|(t, _)| t);
            next.extend(coarse.take(most - next.len()));
        }
        next
    }

    /// A tile has its planes; `coarse` where it may need more.
    pub fn done(&mut self, tile: u32, coarse: bool) {
        self.tiles[tile as usize] = Waiting { coarse, ..Waiting::default() };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_changed_most_goes_first_and_those_that_were_held_come_last() {
        let mut queue = Queue::new(6);
        for (tile, by) in [(0, 5), (2, 9), (3, 7)] {
            queue.add(tile, by);
        }
        queue.done(5, true);
        assert_eq!((queue.waiting(), queue.coarse()), (3, 1));
        assert_eq!((queue.next(2, true), queue.next(3, true), queue.next(9, false)), (vec![2, 3], vec![0, 2, 3], vec![0, 2, 3]));
        assert_eq!(queue.next(9, true), [0, 2, 3, 5]);
        queue.done(5, false);
        assert_eq!((queue.next(9, true), queue.coarse()), (vec![0, 2, 3], 0));
    }

    #[test]
    fn no_tile_waits_for_ever_beside_others_that_change_more() {
        let mut queue = Queue::new(20);
        let mut longest = [0u32; 20];
        let mut since = [None::<u32>; 20];
        for frame in 0..400 {
            // tile 0 changes by next to nothing, once in a while; all others by much, each frame
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
        // those that starve go in the order in which they came: a tile waits for each other one once
        assert!(longest.iter().all(|l| *l > 0 && *l <= STARVES + 20), "{longest:?}");
        assert!(since.iter().flatten().all(|from| 400 - from <= STARVES + 20), "{since:?}");
    }
}
