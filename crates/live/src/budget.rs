//! Time that the geometry of a frame may take, and what is chosen for it.
//!
//! Every choice follows from costs that were measured in this room before, each of a unit of its stage: a pixel that the depth network runs on,
//! what depth takes beside the network, a tile with its planes. Where time is ample everything is done at once and as well as it can be.

/// Share of the time that depth may take.
const DEPTH: f64 = 0.6;
/// Times that share for which a size is still run for each frame that wants depth: where one was, the next one mostly rests.
const EACH: f64 = 2.0;
/// Weight of the newest measurement against all before.
const NEWEST: f64 = 0.2;
/// Share of what depth may take that a larger size must do with before it is gone over to: sizes do not go to and fro.
const HEADROOM: f64 = 0.85;
/// Planes to which tiles are held, one after the other, before any has to wait: two are what a thing and what lies behind it need.
const HELD: [u32; 2] = [3, 2];

/// A cost, by what it was each time.
#[derive(Clone, Copy, Debug, Default)]
struct Cost {
    value: Option<f64>,
    taken: u32,
}

impl Cost {
    /// Takes a measurement; what is no time is none.
    fn take(&mut self, new: f64) {
        if !new.is_finite() || new < 0.0 {
            return;
        }
        // the first one is that of cold caches, and of a network that is yet to be loaded
        self.value = Some(match self.value.filter(|_| self.taken > 1) {
            Some(before) => before + NEWEST * (new - before),
            None => new,
        });
        self.taken = self.taken.saturating_add(1);
    }

    fn get(self) -> f64 {
        self.value.unwrap_or(0.0)
    }
}

/// What there is time for in a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Share {
    /// Tiles whose planes can be placed; at least one.
    pub tiles: usize,
    /// Planes that each may be given; none: as many as it needs.
    pub planes: Option<u32>,
}

/// What a frame's geometry may take, by what it took before.
#[derive(Clone, Debug)]
pub struct Budget {
    /// Milliseconds a frame; infinite: everything is done at once.
    frame_ms: f64,
    /// Of a pixel of the network.
    network: Cost,
    /// Of what depth takes beside it.
    beside: Cost,
    /// Of a tile, and of each of its planes as much again.
    plane: Cost,
    /// Share of tiles that need more than so many planes, from 0 on.
    more_than: Vec<f64>,
    /// Frames since depth was last estimated.
    waited: u32,
    /// Pixels that the network was last run on, and whether it has a larger size.
    size: (f64, bool),
}

impl Budget {
    /// So many milliseconds a frame; anything but a positive number is no bound.
    #[must_use]
    pub fn new(frame_ms: f64) -> Self {
        Self {
            frame_ms: if frame_ms > 0.0 { frame_ms } else { f64::INFINITY },
            network: Cost::default(),
            beside: Cost::default(),
            plane: Cost::default(),
            more_than: Vec::new(),
            waited: 0,
            size: (0.0, false),
        }
    }

    /// Which of the network's `sizes`, from the largest on, depth is to be estimated at for this frame: the largest that takes less than twice
    /// depth's share of it; 0 where there is no choice. Where even the smallest takes longer, depth is due only so often that it keeps to its share:
    /// none where it is not now. With `at_once` it is.
    pub fn depth(&mut self, sizes: &[(u32, u32)], at_once: bool) -> Option<usize> {
        let pixels = |i: usize| sizes.get(i).map_or(0.0, |(w, h)| f64::from(*w) * f64::from(*h));
        let fits = |i: &usize| {
            let headroom = if self.beside.taken > 0 && pixels(*i) > self.size.0 { HEADROOM } else { 1.0 };
            self.depth_ms(pixels(*i)) < headroom * EACH * DEPTH * self.frame_ms
        };
        let last = sizes.len().saturating_sub(1);
        let chosen = (0..last).find(fits).unwrap_or(last);
        let share = self.depth_ms(pixels(chosen)) / (DEPTH * self.frame_ms);
        let due = at_once || f64::from(self.waited) + 1.0 >= share.floor();
        self.waited = if due { 0 } else { self.waited + 1 };
        if due {
            self.size = (pixels(chosen), chosen > 0);
        }
        due.then_some(chosen)
    }

    fn depth_ms(&self, pixels: f64) -> f64 {
        self.beside.get() + self.network.get() * pixels
    }

    /// What depth took in all, and of this the network, at the size that was chosen.
    pub fn depth_took(&mut self, ms: f64, network_ms: f64) {
        if ![ms, network_ms].iter().all(|ms| ms.is_finite() && *ms >= 0.0) {
            return;
        }
        let network_ms = network_ms.min(ms);
        if self.size.0 > 0.0 {
            self.network.take(network_ms / self.size.0);
        }
        self.beside.take(ms - network_ms);
    }

    /// What can be done for so many tiles that wait in what is left of a frame: all of them with as many planes as they need, `most` at most, else with
    /// fewer, else some of them with these. Without `most` a tile's planes are a number that is given.
    #[must_use]
    pub fn tiles(&self, waiting: usize, most: Option<u32>) -> Share {
        // what a smaller size saves is there for a larger one, not for tiles: else more time would mean fewer of them
        let depth = if self.size.1 { f64::INFINITY } else { self.depth_ms(self.size.0) };
        let left = self.frame_ms - depth.min(DEPTH * self.frame_ms);
        let fit = |planes: u32| match self.tile_ms(planes) {
            ms if ms > 0.0 && left.is_finite() => ((left / ms) as usize).max(1),
            _ => usize::MAX,
        };
        let mut share = Share { tiles: fit(most.unwrap_or(u32::MAX)), planes: None };
        for planes in HELD.into_iter().filter(|p| most.is_some_and(|most| *p < most)) {
            if share.tiles >= waiting {
                break;
            }
            share = Share { tiles: fit(planes), planes: Some(planes) };
        }
        share
    }

    /// Of a tile that is given no more than so many planes.
    fn tile_ms(&self, planes: u32) -> f64 {
        self.plane.get() * (1.0 + self.more_than.iter().take(planes as usize).sum::<f64>())
    }

    /// What placing tiles took, of which each was given so many `planes`; whether all were given as many as they needed.
    pub fn tiles_took(&mut self, planes: &[usize], free: bool, ms: f64) {
        let tiles = planes.len() as f64;
        if planes.is_empty() || !ms.is_finite() || ms < 0.0 {
            return;
        }
        self.plane.take(ms / (tiles + planes.iter().sum::<usize>() as f64));
        if !free {
            return;
        }
        let most = planes.iter().copied().max().unwrap_or(0).max(self.more_than.len());
        let first = self.more_than.is_empty();
        self.more_than.resize(most, 0.0);
        for (n, share) in self.more_than.iter_mut().enumerate() {
            let now = planes.iter().filter(|p| **p > n).count() as f64 / tiles;
            *share = if first { now } else { *share + NEWEST * (now - *share) };
        }
    }
}

#[cfg(test)]
mod tests;
