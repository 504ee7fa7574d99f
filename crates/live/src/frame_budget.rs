//! Time budget for a frame's geometry, and the choices that aim at it.
//!
//! All choices follow from unit costs measured on earlier frames of the room: of a pixel of the depth network's input, of depth's overhead
//! beside the network, and of a tile with its planes. With enough time, everything is done at once at full quality.

/// Fraction of the time that depth may take.
const DEPTH_SHARE: f64 = 0.6;
/// A network size may exceed depth's share by this factor, because after a frame with depth the next one usually has none.
const SIZE_OVERRUN: f64 = 2.0;
/// Weight of the newest measurement in the running mean.
const NEWEST: f64 = 0.2;
/// A larger size must fit into this fraction of depth's time before it is chosen, so that sizes do not oscillate.
const HEADROOM: f64 = 0.85;
/// Plane limits to try in turn if the tiles do not fit. Two planes suffice for an object and its background.
const PLANE_LIMITS: [u32; 2] = [3, 2];

/// Running mean of a cost.
#[derive(Clone, Copy, Debug, Default)]
struct Cost {
    value: Option<f64>,
    taken: u32,
}

impl Cost {
    /// Adds a measurement; ignores values that are not finite or negative.
    fn record(&mut self, new: f64) {
        if !new.is_finite() || new < 0.0 {
            return;
        }
        // discard the first: caches are cold, and the network is not loaded yet
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

/// How many planes fit into a frame's time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TileBudget {
    /// Maximum number of planes per tile; `None`: as many as it needs.
    pub planes: Option<u32>,
    /// Coarse tiles for which there is time besides; 0 if the number of planes is limited.
    pub spare: usize,
}

/// Milliseconds that the depth of a frame took.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DepthTime {
    /// From start to end.
    pub ms: f64,
    /// The network's part of it.
    pub network_ms: f64,
    /// Processor time that this process used meanwhile, for depth or anything else; `None` or 0 if unknown.
    pub cpu_ms: Option<f64>,
}

/// Time budget of a frame's geometry, with the costs measured so far.
#[derive(Clone, Debug)]
pub struct Budget {
    /// Milliseconds per frame; infinite: no limit.
    frame_ms: f64,
    /// Cost per pixel of the network's input.
    network: Cost,
    /// Cost of depth beside the network.
    overhead: Cost,
    /// Cost of a tile, and of each of its planes.
    plane: Cost,
    /// At index n, the fraction of tiles that need more than n planes.
    more_than: Vec<f64>,
    /// Processor time of this process per millisecond of depth, at most 1; less while other programs use the processor. Other rooms raise
    /// it.
    processor: Cost,
    /// Frames since depth was last estimated.
    waited: u32,
    /// Pixels of the network's last input, and whether a larger size exists.
    size: (f64, bool),
}

impl Budget {
    /// A budget of `frame_ms` milliseconds per frame. Anything but a positive number means no limit.
    pub fn new(frame_ms: f64) -> Self {
        Self {
            frame_ms: if frame_ms > 0.0 { frame_ms } else { f64::INFINITY },
            network: Cost::default(),
            overhead: Cost::default(),
            processor: Cost::default(),
            plane: Cost::default(),
            more_than: Vec::new(),
            waited: 0,
            size: (0.0, false),
        }
    }

    /// Chooses the size at which to estimate this frame's depth: an index into `sizes`, which begins with the largest, or 0 if `sizes` is
    /// empty. It is the largest size that takes less than twice depth's share of the frame.
    ///
    /// If even the smallest takes longer, depth runs only as often as its share allows; returns `None` if it is not due yet. With `at_once`
    /// it is always due. Time in which other programs use the processor does not count here: it does not become shorter if depth runs less
    /// often.
    pub fn depth(&mut self, sizes: &[(u32, u32)], at_once: bool) -> Option<usize> {
        let pixels = |i: usize| sizes.get(i).map_or(0.0, |(w, h)| f64::from(*w) * f64::from(*h));
        let fits = |i: &usize| {
            let headroom = if self.overhead.taken > 0 && pixels(*i) > self.size.0 { HEADROOM } else { 1.0 };
            self.depth_ms(pixels(*i)) < headroom * SIZE_OVERRUN * DEPTH_SHARE * self.frame_ms
        };
        let last = sizes.len().saturating_sub(1);
        let chosen = (0..last).find(fits).unwrap_or(last);
        let own = self.depth_ms(pixels(chosen)) * self.processor.value.unwrap_or(1.0);
        let share = own / (DEPTH_SHARE * self.frame_ms);
        let due = at_once || f64::from(self.waited) + 1.0 >= share.floor();
        self.waited = if due { 0 } else { self.waited + 1 };
        if due {
            self.size = (pixels(chosen), chosen > 0);
        }
        due.then_some(chosen)
    }

    fn depth_ms(&self, pixels: f64) -> f64 {
        self.overhead.get() + self.network.get() * pixels
    }

    /// Records the time that depth took at the chosen size. Ignores times that are not finite or negative.
    pub fn depth_took(&mut self, DepthTime { ms, network_ms, cpu_ms }: DepthTime) {
        let cpu_ms = cpu_ms.filter(|cpu_ms| cpu_ms.abs() > 0.0).unwrap_or(ms);
        if ![ms, network_ms, cpu_ms].iter().all(|ms| ms.is_finite() && *ms >= 0.0) {
            return;
        }
        let network_ms = network_ms.min(ms);
        if self.size.0 > 0.0 {
            self.network.record(network_ms / self.size.0);
        }
        self.overhead.record(ms - network_ms);
        self.processor.record(if ms > 0.0 { (cpu_ms / ms).min(1.0) } else { 1.0 });
    }

    /// Decides how many planes the `waiting` tiles get in the rest of the frame: as many as they need, up to `most`, if that fits; otherwise
    /// the largest limit that fits, or the smallest. `most` is `None` if the number of planes is fixed.
    pub fn tiles(&self, waiting: usize, most: Option<u32>) -> TileBudget {
        // a smaller network size saves time for a larger one, not for tiles; otherwise more time could mean fewer tiles
        let depth = if self.size.1 { f64::INFINITY } else { self.depth_ms(self.size.0) };
        let left = self.frame_ms - depth.min(DEPTH_SHARE * self.frame_ms);
        let fit = |planes: u32| match self.tile_ms(planes) {
            ms if ms > 0.0 && left.is_finite() => ((left / ms) as usize).max(1),
            _ => usize::MAX,
        };
        let free = fit(most.unwrap_or(u32::MAX));
        let mut limits = PLANE_LIMITS.into_iter().filter(|p| most.is_some_and(|most| *p < most));
        if free >= waiting {
            return TileBudget { planes: None, spare: free - waiting };
        }
        let planes = limits.clone().find(|planes| fit(*planes) >= waiting).or_else(|| limits.next_back());
        TileBudget { planes, spare: 0 }
    }

    /// Expected milliseconds of a tile with at most this many planes.
    fn tile_ms(&self, planes: u32) -> f64 {
        self.plane.get() * (1.0 + self.more_than.iter().take(planes as usize).sum::<f64>())
    }

    /// Records the time for tiles with these numbers of `planes`. `free` means that no limit on planes applied.
    pub fn tiles_took(&mut self, planes: &[usize], free: bool, ms: f64) {
        let tiles = planes.len() as f64;
        if planes.is_empty() || !ms.is_finite() || ms < 0.0 {
            return;
        }
        self.plane.record(ms / (tiles + planes.iter().sum::<usize>() as f64));
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
