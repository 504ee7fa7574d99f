//! Colours: pictures of high dynamic range as sRGB, and two views as an anaglyph.

use std::sync::Arc;

use tmpi_core::{Camera, Photo, Pose, Scene};
use tmpi_pipeline::photo::{Limits, decode};
use tmpi_render::{Arrangement, RenderError, Renderer, Rig, StereoLayout, View, draw_multiview};
use tmpi_testing::pictures::noise;
use tmpi_testing::png::{Png, chunk};

use super::Checked;
use super::scenes::{own_camera, stack};

/// Red, green and blue of an output, each of the red, green and blue of an input.
type Matrix = [[f64; 3]; 3];

pub(super) fn run(checked: &mut Checked) {
    high_dynamic_range(checked, |file| decode(file, &Limits::default(), None).ok().map(|d| d.photo));
    anaglyphs(checked, mixed);
}

/// The anaglyph of the views of the left and the right eye.
pub(super) fn mixed(left: &View, right: &View, layout: StereoLayout) -> Option<View> {
    let views = Views([left.clone(), right.clone()]);
    let scene = Arc::new(stack(left.width, left.height, &[[0; 4]], &[0.5]));
    let rig = Rig { arrangement: Arrangement::Stereo(layout), baseline: 0.1, focus: 0.5 };
    draw_multiview(&views, &scene, &own_camera(&scene, Pose::default()), &rig).ok()
}

fn times(matrix: &Matrix, v: [f64; 3]) -> [f64; 3] {
    matrix.map(|row| row.iter().zip(v).map(|(m, v)| m * v).sum())
}

/// sRGB levels of a pixel of samples 0 to 1 in PQ (SMPTE ST 2084) or HLG (ITU-R BT.2100), as a screen of 1000 nits whose reference white is
/// 203 nits shows it, with the curve of SMPTE ST 2094-50. Matrices of ITU-R BT.2087.
fn shown(samples: [f64; 3], is_hlg: bool, is_bt709: bool) -> [f64; 3] {
    let pq = |v: f64| {
        let root = v.powf(1.0 / 78.843_75);
        10_000.0 * ((root - 0.835_937_5).max(0.0) / (18.851_562_5 - 18.687_5 * root)).powf(1.0 / 0.159_301_757_812_5)
    };
    let hlg = |v: f64| if v <= 0.5 { v * v / 3.0 } else { (((v - 0.559_910_73) / 0.178_832_77).exp() + 0.284_668_92) / 12.0 };
    let mut light = samples.map(|v| if is_hlg { hlg(v) } else { pq(v) });
    if is_bt709 {
        light = times(&[[0.627_404, 0.329_283, 0.043_313], [0.069_097, 0.919_540, 0.011_362], [0.016_391, 0.088_013, 0.895_595]], light);
    }
    if is_hlg {
        let luminance = 0.2627 * light[0] + 0.6780 * light[1] + 0.0593 * light[2];
        light = light.map(|v| 1000.0 * luminance.powf(0.2) * v);
    }
    let most = light.into_iter().fold(0.0, f64::max) / 203.0;
    let gain = if most <= 1.0 { 0.5 } else { tone(most.min(1000.0 / 203.0)) / most };
    let to_bt709 = [[1.660_491, -0.587_641, -0.072_850], [-0.124_550, 1.132_900, -0.008_349], [-0.018_151, -0.100_579, 1.118_730]];
    times(&to_bt709, light.map(|v| v / 203.0 * gain)).map(|v| {
        let v = v.clamp(0.0, 1.0);
        255.0 * if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 }
    })
}

/// Height of the quadratic Bézier curve of (1, ½), (1.65, 0.825) and (1000/203, 1) at `x`, by halving.
fn tone(x: f64) -> f64 {
    let at = |t: f64, [a, b, c]: [f64; 3]| (1.0 - t) * (1.0 - t) * a + 2.0 * t * (1.0 - t) * b + t * t * c;
    let [mut low, mut high] = [0.0, 1.0];
    for _ in 0..60 {
        let t = f64::midpoint(low, high);
        *if at(t, [1.0, 1.65, 1000.0 / 203.0]) < x { &mut low } else { &mut high } = t;
    }
    at(low, [0.5, 0.825, 1.0])
}

/// `kernel` decodes a photo.
pub(super) fn high_dynamic_range(checked: &mut Checked, kernel: impl Fn(&[u8]) -> Option<Photo>) {
    type Sample = fn(usize, u32, u32) -> f64;
    let pictures: [(&str, u32, u32, Sample); 5] = [
        ("greys from black to the peak", 256, 1, |_, x, _| f64::from(x) / 255.0),
        ("nearly black", 1, 200, |c, _, y| f64::from(y * (c as u32 + 1)) / 65_535.0),
        ("any colours", 50, 40, |c, x, y| f64::from(noise(x, y + 50 * c as u32))),
        ("ends of each channel", 8, 1, |c, x, _| f64::from(x >> c & 1)),
        ("one pixel of reference white", 1, 1, |_, _, _| 0.75),
    ];
    for (name, width, height, sample) in pictures {
        for (curve, transfer) in [("PQ", 16), ("HLG", 18)] {
            for (primaries, number) in [("BT.2020", 9), ("BT.709", 1)] {
                let chunks = vec![chunk(b"cICP", &[number, transfer, 0, 1])];
                let file = Png { width, height, depth: 16, colour: 2, interlaced: false, chunks }.write(sample);
                // half a level of rounding, and two where a channel is nearly black: the primaries of the colour library have four digits
                checked.case("high dynamic range", &format!("{name}, {curve}, {primaries}"), "tone mapping", "levels", 2.55, || {
                    let Some(photo) = kernel(&file).filter(|p| (p.width, p.height) == (width, height)) else { return f64::INFINITY };
                    let off = |i: u32| {
                        let (x, y) = (i % width, i / width);
                        let samples = [0, 1, 2].map(|c| (sample(c, x, y) * 65_535.0).round() / 65_535.0);
                        let want = shown(samples, transfer == 18, number == 1);
                        photo.at(x, y).iter().zip(want).map(|(got, want)| (f64::from(*got) - want).abs()).fold(0.0, f64::max)
                    };
                    (0..width * height).map(off).fold(0.0, f64::max)
                });
            }
        }
    }
}

/// Two views that are drawn left and right of the camera.
struct Views([View; 2]);

impl Renderer for Views {
    fn name(&self) -> &'static str {
        "given"
    }

    fn render(&self, _: &Arc<Scene>, camera: &Camera) -> Result<View, RenderError> {
        Ok(self.0[usize::from(camera.pose.tx > 0.0)].clone())
    }
}

/// Matrices of the left and the right eye in thousandths: Dubois's least squares, and the luma of BT.601.
const GLASSES: [(StereoLayout, [[i16; 3]; 6]); 4] = [
    (StereoLayout::Anaglyph, [[456, 500, 176], [-40, -38, -16], [-15, -21, -5], [-43, -88, -2], [378, 734, -18], [-72, -113, 1226]]),
    (StereoLayout::AnaglyphGrey, [[299, 587, 114], [0; 3], [0; 3], [0; 3], [299, 587, 114], [299, 587, 114]]),
    (
        StereoLayout::AnaglyphGreenMagenta,
        [[-62, -158, -39], [284, 668, 143], [-15, -27, 21], [529, 705, 24], [-16, -15, -65], [9, 75, 937]],
    ),
    (StereoLayout::AnaglyphAmberBlue, [[1062, -205, 299], [-26, 908, 68], [-38, -173, 22], [-16, -123, -17], [6, 62, -17], [94, 185, 911]]),
];

/// `kernel` mixes the views of the left and the right eye.
pub(super) fn anaglyphs(checked: &mut Checked, kernel: impl Fn(&View, &View, StereoLayout) -> Option<View>) {
    let view = |f: &dyn Fn(u32, u32) -> u8, alpha: &dyn Fn(u32) -> u8| {
        let rgba = (0..600).map(|i| [f(i, 0), f(i, 1), f(i, 2)].map(|v| v.min(alpha(i)))).zip(0..);
        View { width: 30, height: 20, rgba: rgba.map(|([r, g, b], i)| [r, g, b, alpha(i)]).collect() }
    };
    let any = |seed: u32| move |i: u32, c: u32| (noise(i, seed + c) * 256.0) as u8;
    let opaque = |_: u32| 255u8;
    let pairs = [
        ("any colours", [view(&any(0), &opaque), view(&any(7), &opaque)]),
        ("any colours, partly transparent", [view(&any(0), &|i| any(20)(i, 0)), view(&any(7), &|i| any(30)(i, 0))]),
        ("white", [view(&|_, _| 255, &opaque), view(&|_, _| 255, &opaque)]),
        ("white and black", [view(&|_, _| 255, &opaque), view(&|_, _| 0, &opaque)]),
        ("nothing", [view(&|_, _| 0, &|_| 0), view(&|_, _| 0, &|_| 0)]),
    ];
    for ((layout, matrices), (name, [left, right])) in GLASSES.iter().flat_map(|g| pairs.iter().map(move |p| (g, p))) {
        checked.case("anaglyphs", &format!("{name}, {}", layout.name()), "mix", "levels", 0.501, || {
            let mixed = kernel(left, right, *layout).filter(|mixed| mixed.rgba.len() == left.rgba.len());
            let Some(mixed) = mixed else { return f64::INFINITY };
            let off = |((l, r), got): ((&[u8; 4], &[u8; 4]), &[u8; 4])| {
                let part = |row: &[i16; 3], p: &[u8; 4]| (0..3).map(|c| f64::from(row[c]) * f64::from(p[c])).sum::<f64>() / 1000.0;
                let alpha = f64::from(l[3].min(r[3]));
                let colour = |k: usize| (part(&matrices[k], l) + part(&matrices[k + 3], r)).clamp(0.0, alpha);
                let want = [colour(0), colour(1), colour(2), alpha];
                got.iter().zip(want).map(|(g, w)| (f64::from(*g) - w).abs()).fold(0.0, f64::max)
            };
            left.rgba.iter().zip(&right.rgba).zip(&mixed.rgba).map(off).fold(0.0, f64::max)
        });
    }
}
