//! What each depth network expects and returns, as data.

use crate::photo::Filter;

/// Size at which a network runs, in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SizeRule {
    /// Always this width and height; the photo is stretched.
    Fixed(u32, u32),
    /// The photo's aspect with about this many pixels.
    Area(u32),
    /// The photo's aspect with this width or this height, whichever changes its scale less.
    Near(u32, u32),
    /// The photo's aspect with neither side longer than this.
    Within(u32),
    /// First the photo's aspect in whole pixels with the longer side this long, then the nearest multiples.
    Longest(u32),
    /// The photo's aspect with about this many squares of [`Adapter::multiple`] pixels a side.
    Squares(u32),
}

/// How the photo is resampled to the network's size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sampling {
    /// Unrounded, by a kernel that is stretched when reducing; clamped to 0..=1.
    Unrounded(Filter),
    /// By such a kernel, with Pillow's rounding to bytes.
    Bytes(Filter),
    /// By `OpenCV`'s cubic over four pixels, whatever the ratio.
    Four,
    /// As `OpenCV` does it, with its rounding to bytes; with [`SizeRule::Longest`], by way of its size in whole pixels.
    OpenCv,
}

/// What a network returns for a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Disparity up to scale and shift: larger is nearer.
    Disparity,
    /// Distance.
    Metric,
    /// A point in front of the camera, row by row x, y, z. Its distance is z plus an unknown shift that all points share, see
    /// [`super::points`].
    Points,
}

/// The output by which a network marks pixels that have no distance, such as sky.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sky {
    /// The output's name.
    pub name: &'static str,
    /// Values from this on are sky. With `inside`, values above it are not sky.
    pub threshold: f32,
    /// The output marks what is not sky.
    pub inside: bool,
}

/// Which outputs of a graph are used.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outputs {
    /// Names of the map, one of which the graph must have; if empty, the first output.
    pub map: &'static [&'static str],
    /// The output that marks sky, if the graph has it.
    pub sky: Option<Sky>,
    /// Names of a factor of all distances, if the graph has it.
    pub scale: &'static [&'static str],
}

impl Outputs {
    /// The first output, whatever its name.
    pub const FIRST: Self = Self { map: &[], sky: None, scale: &[] };
    /// Outputs of Depth Anything 3. Its publishers take a score from 0.3 on as sky.
    pub const VIEWS: Self =
        Self { map: &["predicted_depth", "depth"], sky: Some(Sky { name: "sky", threshold: 0.3, inside: false }), scale: &[] };
    /// Outputs of `MoGe`.
    pub const POINTS: Self =
        Self { map: &["points"], sky: Some(Sky { name: "mask", threshold: 0.5, inside: true }), scale: &["metric_scale", "scale"] };
}

/// A depth network: what its input and its output need.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Adapter {
    /// Name by which users choose it.
    pub name: &'static str,
    /// Size at which it runs. A model file with fixed dimensions overrides it.
    pub size: SizeRule,
    /// Sides are multiples of this many pixels.
    pub multiple: u32,
    /// Mean of RGB in 0..=1, which is subtracted.
    pub mean: [f32; 3],
    /// Standard deviation of RGB in 0..=1, by which it is divided.
    pub deviation: [f32; 3],
    /// Meaning of the output.
    pub output: Kind,
    /// Which outputs are used.
    pub outputs: Outputs,
    /// The graph may expect several pictures of a scene in a dimension after the batch's; it gets one.
    pub views: bool,
    /// How the photo is resampled to the network's size.
    pub sampling: Sampling,
    /// Strength of smoothing up to the photo's edges, for a network that leaves haloes; 0 for one with sharp edges.
    pub smoothing: f64,
    /// For photos, the weight of a vertical ramp of deviation 1, nearer at the bottom, that is added to the map of deviation 1.
    pub ramp: f64,
    /// The same for rooms, where more of it makes depth steadier.
    pub ramp_of_rooms: f64,
    /// For photos, average the map with that of the mirrored photo, which takes a second run. Rooms have no time for it.
    pub flip: bool,
}

const IMAGENET: ([f32; 3], [f32; 3]) = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]);
const HALF: ([f32; 3], [f32; 3]) = ([0.5; 3], [0.5; 3]);
/// For networks that normalise their input themselves.
const PLAIN: ([f32; 3], [f32; 3]) = ([0.0; 3], [1.0; 3]);

const CUBIC: Sampling = Sampling::Bytes(Filter::Cubic);
const LINEAR: Sampling = Sampling::Bytes(Filter::Triangle);

const fn entry(name: &'static str, size: SizeRule, multiple: u32, norm: ([f32; 3], [f32; 3]), sampling: Sampling, output: Kind) -> Adapter {
    Adapter {
        name,
        size,
        multiple,
        mean: norm.0,
        deviation: norm.1,
        output,
        outputs: Outputs::FIRST,
        views: false,
        sampling,
        smoothing: 0.0,
        ramp: 0.0,
        ramp_of_rooms: 0.0,
        flip: false,
    }
}

/// All known networks; the first is the embedded one. Input for the others is prepared as their publishers do it, down to the rounding,
/// and `training/compare_adapters.py` checks this. DPT and Depth Anything follow the image processors and published settings of
/// `transformers`. The ONNX files of the `MiDaS` project have one size and normalise their input themselves; those exported from its
/// torch hub do neither. `MoGe` resamples the photo to its tokens itself, but without antialiasing in ONNX: it gets what its own code
/// makes of the photo, for as many tokens as its ONNX documentation takes.
pub const ADAPTERS: [Adapter; 11] = [
    Adapter {
        smoothing: 100.0,
        ramp: 0.05,
        ramp_of_rooms: 0.2,
        flip: true,
        ..entry("tmpi", SizeRule::Area(192 * 256), 32, IMAGENET, Sampling::Unrounded(Filter::Lanczos3), Kind::Disparity)
    },
    entry("midas-v2.1-small", SizeRule::Fixed(256, 256), 32, PLAIN, Sampling::Four, Kind::Disparity),
    entry("midas-v2.1", SizeRule::Fixed(384, 384), 32, PLAIN, Sampling::Four, Kind::Disparity),
    entry("midas-v2.1-small-hub", SizeRule::Within(256), 32, IMAGENET, Sampling::Four, Kind::Disparity),
    entry("midas-v2.1-hub", SizeRule::Within(384), 32, IMAGENET, Sampling::Four, Kind::Disparity),
    entry("dpt-hybrid", SizeRule::Fixed(384, 384), 32, HALF, LINEAR, Kind::Disparity),
    entry("dpt-large", SizeRule::Fixed(384, 384), 32, HALF, LINEAR, Kind::Disparity),
    entry("depth-anything-v2", SizeRule::Near(518, 518), 14, IMAGENET, CUBIC, Kind::Disparity),
    entry("depth-anything-v2-metric", SizeRule::Near(518, 518), 14, IMAGENET, CUBIC, Kind::Metric),
    Adapter {
        outputs: Outputs::VIEWS,
        views: true,
        ..entry("depth-anything-3", SizeRule::Longest(504), 14, IMAGENET, Sampling::OpenCv, Kind::Metric)
    },
    Adapter {
        outputs: Outputs::POINTS,
        ..entry("moge-2", SizeRule::Squares(1800), 14, PLAIN, Sampling::Unrounded(Filter::Triangle), Kind::Points)
    },
];

/// Finds a network by its name.
pub fn adapter(name: &str) -> Option<&'static Adapter> {
    ADAPTERS.iter().find(|a| a.name == name)
}

impl Adapter {
    /// Largest aspect of a photo that a network sized by area sees unsqueezed: ours was trained on no longer pictures, and their short
    /// side would vanish.
    const MAX_ASPECT: f64 = 3.0;
    /// The same for networks sized by a side. It bounds their memory, which in a transformer grows with the square of the pixels.
    const MAX_ASPECT_BY_SIDE: u32 = 4;
    /// Shares of its pixels at which a network may run if there is no time for all of them.
    const SMALLER: [f64; 3] = [0.7, 0.5, 0.25];
    /// Largest factor between the aspect of such a size and the photo's.
    const OFF: f64 = 1.2;
    /// Upper bound of pixels, whatever the rule says.
    const MAX_PIXELS: f64 = 2e6;

    /// Width and height at which the network runs for a photo of `width × height`, each at least 1.
    pub fn network_size(&self, width: u32, height: u32) -> (u32, u32) {
        match self.size {
            SizeRule::Fixed(w, h) => (w, h),
            SizeRule::Area(pixels) => self.by_area(f64::from(pixels).min(Self::MAX_PIXELS), Self::aspect(width, height)),
            SizeRule::Near(w, h) => {
                // the publishers' order of operations: quotients fall on halves, and rounding decides
                let (width, height) = Self::squeezed(width, height);
                let (across, down) = (f64::from(w) / width, f64::from(h) / height);
                let scale = if (1.0 - across).abs() < (1.0 - down).abs() { across } else { down };
                (self.rounded(scale * width, None), self.rounded(scale * height, None))
            }
            SizeRule::Within(side) => {
                let (width, height) = Self::squeezed(width, height);
                let scale = (f64::from(side) / width).min(f64::from(side) / height);
                (self.rounded(scale * width, Some(side)), self.rounded(scale * height, Some(side)))
            }
            SizeRule::Longest(_) => {
                let (width, height) = self.intermediate_size(width, height).unwrap_or((width, height));
                // of two equally near multiples, the larger
                let near = |v: u32| ((v + self.multiple / 2) / self.multiple).max(1) * self.multiple;
                (near(width), near(height))
            }
            SizeRule::Squares(count) => {
                let (width, height) = Self::squeezed(width, height);
                let aspect = width / height;
                let side = |squares: f64| (squares.sqrt().round_ties_even().max(1.0) as u32) * self.multiple;
                (side(f64::from(count) * aspect), side(f64::from(count) / aspect))
            }
        }
    }

    /// Sizes for a photo of `width × height`, from [`Adapter::network_size`] down to a quarter of its pixels, with about the photo's
    /// aspect. If the network has a fixed size, only that one.
    pub fn sizes(&self, width: u32, height: u32) -> Vec<(u32, u32)> {
        let first = self.network_size(width, height);
        let mut sizes = vec![first];
        if matches!(self.size, SizeRule::Fixed(..)) {
            return sizes;
        }
        let (pixels, aspect) = (f64::from(first.0) * f64::from(first.1), f64::from(first.0) / f64::from(first.1));
        let (target, shape) = match self.size {
            // its own size may differ a little from the photo's aspect; smaller ones need not
            SizeRule::Area(area) => (f64::from(area).min(Self::MAX_PIXELS), Self::aspect(width, height)),
            _ => (pixels, aspect),
        };
        for share in Self::SMALLER {
            let (w, h) = self.by_area(target * share, shape);
            let last = sizes[sizes.len() - 1];
            let off = f64::from(w) / f64::from(h) / shape;
            if w <= last.0 && h <= last.1 && (w, h) != last && (1.0 / Self::OFF..=Self::OFF).contains(&off) {
                sizes.push((w, h));
            }
        }
        sizes
    }

    /// Intermediate size in whole pixels to which a photo of `width × height` is resampled first, if the rule has one.
    pub fn intermediate_size(&self, width: u32, height: u32) -> Option<(u32, u32)> {
        let SizeRule::Longest(side) = self.size else { return None };
        let (width, height) = Self::squeezed(width, height);
        let scale = f64::from(side) / width.max(height);
        let whole = |v: f64| (v * scale).round_ties_even().max(1.0) as u32;
        Some((whole(width), whole(height)))
    }

    /// The photo's size with its longer side cut to [`Self::MAX_ASPECT_BY_SIDE`].
    fn squeezed(w: u32, h: u32) -> (f64, f64) {
        (f64::from(w.min(h * Self::MAX_ASPECT_BY_SIDE)), f64::from(h.min(w * Self::MAX_ASPECT_BY_SIDE)))
    }

    /// The multiple nearest to a length, the even one of two equally near; at most `most` if that is given; never 0.
    fn rounded(&self, length: f64, most: Option<u32>) -> u32 {
        let ratio = length / f64::from(self.multiple);
        let near = ratio.round_ties_even();
        let above = most.is_some_and(|most| near * f64::from(self.multiple) > f64::from(most));
        (if above { ratio.floor() } else { near }.max(1.0) as u32) * self.multiple
    }

    // NaN cannot occur: both sides are at least 1
    fn aspect(width: u32, height: u32) -> f64 {
        (f64::from(width) / f64::from(height)).clamp(1.0 / Self::MAX_ASPECT, Self::MAX_ASPECT)
    }

    fn by_area(&self, pixels: f64, aspect: f64) -> (u32, u32) {
        let side = |length: f64| ((length / f64::from(self.multiple)).round().max(1.0) as u32) * self.multiple;
        (side((pixels * aspect).sqrt()), side((pixels / aspect).sqrt()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn smaller_sizes_shrink_and_stay_multiples(w in 16u32..4000, h in 16u32..4000, which in 0..ADAPTERS.len()) {
            let adapter = &ADAPTERS[which];
            let sizes = adapter.sizes(w, h);
            prop_assert_eq!(sizes[0], adapter.network_size(w, h));
            prop_assert!(!matches!(adapter.size, SizeRule::Fixed(..)) || sizes.len() == 1);
            for pair in sizes.windows(2) {
                prop_assert!(pair[1].0 <= pair[0].0 && pair[1].1 <= pair[0].1 && pair[1] != pair[0], "{sizes:?}");
            }
            prop_assert!(sizes[1..].iter().all(|(w, h)| w % adapter.multiple == 0 && h % adapter.multiple == 0 && *w > 0 && *h > 0));
        }
    }

    #[test]
    fn the_embedded_network_has_smaller_sizes_for_frames_of_rooms() {
        let sizes = |w, h| ADAPTERS[0].sizes(w, h);
        assert_eq!(sizes(320, 240), [(256, 192), (224, 160), (192, 128), (128, 96)]);
        assert_eq!(sizes(640, 480), sizes(320, 240));
    }

    #[test]
    fn the_embedded_network_runs_at_a_small_size_whatever_the_photo() {
        let a = adapter("tmpi").unwrap();
        assert_eq!(a.network_size(6000, 4000), (256, 192));
        assert_eq!(a.network_size(300, 450), (192, 256));
        assert_eq!(a.network_size(1, 20_000), a.network_size(1000, 3000));
    }

    #[test]
    fn sizes_match_those_of_the_publishers() {
        let size = |name: &str, w, h| adapter(name).unwrap().network_size(w, h);
        let anything = |w, h| size("depth-anything-v2", w, h);
        assert_eq!(anything(1000, 1000), (518, 518));
        assert_eq!(anything(4000, 3000), (686, 518));
        assert_eq!(anything(640, 480), (686, 518));
        assert_eq!(anything(3000, 2000), (784, 518), "55.5 multiples: the even one");
        assert_eq!(anything(64, 32), (518, 252), "18.5 multiples: the even one; enlarged, the longer side decides");
        assert_eq!(anything(600, 400), (518, 350), "400 would grow more than 600 shrinks");
        assert_eq!(anything(16_384, 1), (518, 126), "squeezed to 4:1");
        assert_eq!(size("midas-v2.1-small-hub", 1500, 1000), (256, 160));
        assert_eq!(size("midas-v2.1-small-hub", 1000, 1500), (160, 256));
        assert_eq!(size("midas-v2.1-hub", 1000, 1000), (384, 384));
        assert_eq!(size("depth-anything-3", 1000, 750), (504, 378));
        assert_eq!(size("depth-anything-3", 300, 301), (504, 504), "502 and 504");
        assert_eq!(size("depth-anything-3", 1008, 686), (504, 350), "343 lies between 336 and 350: the larger one");
        assert_eq!(size("depth-anything-3", 3000, 1000), (504, 168));
        assert_eq!(size("depth-anything-3", 1, 16_384), (126, 504), "squeezed to 4:1");
        assert_eq!(size("moge-2", 518, 518), (588, 588), "42² = 1764 tokens");
        assert_eq!(size("moge-2", 4000, 3000), (686, 518), "49 × 37 = 1813");
        assert_eq!(size("moge-2", 1000, 2000), (420, 840), "30 × 60 = 1800");
    }

    proptest! {
        #[test]
        fn sizes_are_multiples_and_bounded(w in 1u32..=16_384, h in 1u32..=16_384, which in 0..ADAPTERS.len()) {
            let a = &ADAPTERS[which];
            let (nw, nh) = a.network_size(w, h);
            prop_assert!(nw > 0 && nh > 0 && nw % a.multiple == 0 && nh % a.multiple == 0);
            prop_assert!(u64::from(nw) * u64::from(nh) < 2_200_000);
            prop_assert!(f64::from(nw.max(nh)) / f64::from(nw.min(nh)) < 5.0);
        }
    }
}
