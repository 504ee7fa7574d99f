//! What each depth network wants and gives, as data.

use crate::photo::Filter;

/// At which size a network is run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SizeRule {
    /// Always this width and height; the photo is stretched.
    Fixed(u32, u32),
    /// The photo's aspect at about this many pixels.
    Area(u32),
    /// As [`Self::Area`], once for each, and the mean of the maps.
    Areas(&'static [u32]),
    /// The photo's aspect, its shorter side this long.
    Short(u32),
    /// The photo's aspect, its longer side this long.
    Long(u32),
}

/// Order of a tensor's extents.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Batch, channel, row, column.
    Nchw,
    /// Batch, row, column, channel.
    Nhwc,
}

/// What a network gives for a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Larger is nearer, up to scale and shift.
    Disparity,
    /// Distance.
    Metric,
    /// Logarithm of the distance.
    LogDepth,
}

/// One depth network: what comes before and after it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Adapter {
    /// Name that users choose it by.
    pub name: &'static str,
    /// Size that it is run at. A model file with fixed extents overrides it.
    pub size: SizeRule,
    /// Sides are multiples of this.
    pub multiple: u32,
    /// Mean of RGB in 0..=1 that is taken off.
    pub mean: [f32; 3],
    /// Deviation of RGB in 0..=1 that is divided by.
    pub deviation: [f32; 3],
    /// Order of the input's extents.
    pub layout: Layout,
    /// Meaning of the output.
    pub output: Kind,
    /// How the photo is brought to the network's size.
    pub filter: Filter,
    /// Strength of smoothing up to the photo's edges, for a network that leaves haloes; 0 for one with sharp edges.
    pub smoothing: f64,
}

const IMAGENET: ([f32; 3], [f32; 3]) = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]);
const HALF: ([f32; 3], [f32; 3]) = ([0.5; 3], [0.5; 3]);
/// For networks that normalise by themselves.
const PLAIN: ([f32; 3], [f32; 3]) = ([0.0; 3], [1.0; 3]);

const fn entry(name: &'static str, size: SizeRule, multiple: u32, norm: ([f32; 3], [f32; 3]), output: Kind) -> Adapter {
    Adapter { name, size, multiple, mean: norm.0, deviation: norm.1, layout: Layout::Nchw, output, filter: Filter::Cubic, smoothing: 0.0 }
}

/// All known networks; the first is the embedded one. Sizes and normalisation are those of `transformers`, against which
/// `training/adapters.py` holds them; those that the `MiDaS` project publishes are of one size and normalise by themselves,
/// those exported from its torch hub do neither.
pub const ADAPTERS: [Adapter; 11] = [
    Adapter {
        filter: Filter::Lanczos3,
        smoothing: 3000.0,
        ..entry("tmpi", SizeRule::Areas(&[128 * 192, 192 * 256]), 32, IMAGENET, Kind::Disparity)
    },
    entry("midas-v2.1-small", SizeRule::Fixed(256, 256), 32, PLAIN, Kind::Disparity),
    entry("midas-v2.1", SizeRule::Fixed(384, 384), 32, PLAIN, Kind::Disparity),
    entry("midas-v2.1-small-hub", SizeRule::Long(256), 32, IMAGENET, Kind::Disparity),
    entry("midas-v2.1-hub", SizeRule::Long(384), 32, IMAGENET, Kind::Disparity),
    entry("dpt-hybrid", SizeRule::Fixed(384, 384), 32, HALF, Kind::Disparity),
    entry("dpt-large", SizeRule::Fixed(384, 384), 32, HALF, Kind::Disparity),
    entry("depth-anything-v2", SizeRule::Short(518), 14, IMAGENET, Kind::Disparity),
    entry("depth-anything-v2-metric", SizeRule::Short(518), 14, IMAGENET, Kind::Metric),
    entry("zoedepth", SizeRule::Area(384 * 512), 32, HALF, Kind::Metric),
    entry("log-depth", SizeRule::Area(384 * 512), 32, IMAGENET, Kind::LogDepth),
];

/// The network of that name.
#[must_use]
pub fn adapter(name: &str) -> Option<&'static Adapter> {
    ADAPTERS.iter().find(|a| a.name == name)
}

impl Adapter {
    /// Aspect beyond which a photo is squeezed: no network has seen longer pictures, and their short side would vanish.
    const MAX_ASPECT: f64 = 3.0;
    /// Upper bound of pixels, whatever the rule says.
    const MAX_PIXELS: f64 = 2e6;

    /// Widths and heights that the network is run at for a photo of `width × height`, each at least 1.
    #[must_use]
    pub fn network_sizes(&self, width: u32, height: u32) -> Vec<(u32, u32)> {
        let of = |pixels: f64| self.rounded(pixels.min(Self::MAX_PIXELS), Self::aspect(width, height));
        let aspect = Self::aspect(width, height);
        match self.size {
            SizeRule::Fixed(w, h) => vec![(w, h)],
            SizeRule::Area(pixels) => vec![of(f64::from(pixels))],
            SizeRule::Areas(all) => {
                let mut sizes: Vec<_> = all.iter().map(|&pixels| of(f64::from(pixels))).collect();
                sizes.dedup();
                sizes
            }
            SizeRule::Short(side) => vec![of(f64::from(side).powi(2) * aspect.max(1.0 / aspect))],
            SizeRule::Long(side) => vec![of(f64::from(side).powi(2) / aspect.max(1.0 / aspect))],
        }
    }

    // NaN cannot arise: both sides are at least 1
    fn aspect(width: u32, height: u32) -> f64 {
        (f64::from(width) / f64::from(height)).clamp(1.0 / Self::MAX_ASPECT, Self::MAX_ASPECT)
    }

    fn rounded(&self, pixels: f64, aspect: f64) -> (u32, u32) {
        let side = |length: f64| ((length / f64::from(self.multiple)).round().max(1.0) as u32) * self.multiple;
        (side((pixels * aspect).sqrt()), side((pixels / aspect).sqrt()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_embedded_network_runs_at_two_sizes_about_its_training_area() {
        let a = adapter("tmpi").unwrap();
        assert_eq!(a.network_sizes(6000, 4000), [(192, 128), (256, 192)]);
        assert_eq!(a.network_sizes(300, 450), [(128, 192), (192, 256)]);
        assert_eq!(a.network_sizes(1, 20_000), a.network_sizes(1000, 3000));
    }

    #[test]
    fn depth_anything_has_its_shorter_side_at_518() {
        assert_eq!(adapter("depth-anything-v2").unwrap().network_sizes(1000, 1000), [(518, 518)]);
        assert_eq!(adapter("depth-anything-v2").unwrap().network_sizes(4000, 3000), [(686, 518)]);
    }

    proptest! {
        #[test]
        fn sizes_are_multiples_and_bounded(w in 1u32..=16_384, h in 1u32..=16_384, which in 0..ADAPTERS.len()) {
            let a = &ADAPTERS[which];
            prop_assert!(!a.network_sizes(w, h).is_empty());
            for (nw, nh) in a.network_sizes(w, h) {
                prop_assert!(nw > 0 && nh > 0 && nw % a.multiple == 0 && nh % a.multiple == 0);
                prop_assert!(u64::from(nw) * u64::from(nh) < 2_200_000);
                prop_assert!(f64::from(nw.max(nh)) / f64::from(nw.min(nh)) < 4.0);
            }
        }
    }
}
