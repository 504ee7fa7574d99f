//! Memory of surfaces that were visible before something moved in front of them.
//!
//! A viewer of a room keeps it, and shows remembered colours instead of those that [`super::Inpainter`] makes up. It needs no data from the
//! server: a viewer that joins later has seen less and makes up more. The memory changes only colours of texels, never their classes or
//! positions.

use super::occluders::Occluders;
use super::{LayerMasks, Surface, TileFrame, visibility_kernels};
use crate::scene::packed_rgb::{difference, of_word};
use crate::scene::{Class, Grid, Plane, Rect};
use crate::simd::dispatch;

/// Difference in δ from which a surface lies in front of the remembered one, or a layer does not match it; larger than the noise of depth
/// between frames.
const DEPTH_STEP: f32 = 0.05;
/// Difference in levels, summed over the channels, from which a visible surface has changed.
const COLOUR_STEP: u32 = 48;
/// If more than this share of the sampled pixels has changed, the camera has moved or the light has changed, and the whole memory is
/// invalid.
const MOVED_SHARE: f64 = 0.3;
/// One pixel in this many of a row is sampled for that.
const SAMPLE_STEP: usize = 7;
/// Frames, at 30 a second, for which a pixel must stay the same before it is remembered. A moving object appears at its new position some
/// frames before its labels do, and would be remembered as background, longest where it reverses slowly. `tmpi-lab live-bench --files DIR`
/// compares: with 6 frames, light and dark lines of the object remain where it reversed, at label borders of the floor; with 15 none
/// remain, which costs 0.02 dB on uncovered pixels.
pub(crate) const STEADY: u8 = 15;
/// Maximum number of these frames that one frame counts for if frames are less frequent: labels are then at most one frame late, so three
/// frames suffice. `tmpi-lab live-bench --only measured --every 15` compares: if each frame counts as one, nothing is remembered within the
/// sequence, and uncovered pixels are 1.9 dB worse.
pub(crate) const MAX_FRAMES: u8 = 5;

/// For each pixel, the farthest surface that was visible there and stayed for some frames.
#[derive(Clone, Debug)]
pub struct SeenBackground {
    grid: Grid,
    pixels: Pixels,
    in_front: Occluders,
}

/// State of each pixel, as a structure of arrays for vectorisation.
#[derive(Clone, Debug)]
struct Pixels {
    /// Remembered colours, as words.
    colour: Vec<u32>,
    /// δ of the remembered surface, NaN where nothing is remembered.
    delta: Vec<f32>,
    /// Colours of the previous frame.
    last: Vec<u32>,
    /// Number of frames for which the pixel has stayed the same, up to [`STEADY`].
    steady: Vec<u8>,
    /// δ in the previous frame: NaN before the first frame, infinite where the pixel is mixed with a nearer surface.
    last_delta: Vec<f32>,
    /// The same, but finite also where the pixel is mixed.
    last_shown: Vec<f32>,
}

/// A frame: colours as words, and δ of its visible surface, infinite at mixed pixels.
#[derive(Clone, Copy)]
struct Frame<'a> {
    colour: &'a [u32],
    delta: &'a [f32],
}

dispatch!(
    /// Adds `frames` to the count of each pixel that has stayed the same, and resets the others; then replaces the last colour and δ by the
    /// current ones.
    stay, stay_body, (last: &mut [u32], last_delta: &mut [f32], steady: &mut [u8], now: &[u32], delta: &[f32], frames: u8)
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn stay_body(last: &mut [u32], last_delta: &mut [f32], steady: &mut [u8], now: &[u32], delta: &[f32], frames: u8) {
    for ((((last, last_delta), steady), now), delta) in last.iter_mut().zip(last_delta).zip(steady).zip(now).zip(delta) {
        // δ is infinite at mixed pixels, which therefore never stay the same
        let same = ((delta - *last_delta).abs() <= DEPTH_STEP) & (difference(*now, *last) <= COLOUR_STEP);
        *steady = if same { (*steady + frames).min(STEADY) } else { 0 };
        (*last, *last_delta) = (*now, *delta);
    }
}

dispatch!(
    /// Remembers the colour and δ of pixels that are steady and not nearer than the remembered surface.
    keep, keep_body, (known: &mut [u32], known_delta: &mut [f32], steady: &[u8], now: &[u32], delta: &[f32])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
#[allow(clippy::needless_bitwise_bool, clippy::neg_cmp_op_on_partial_ord, reason = "without a branch, and NaN is nearer than nothing")]
fn keep_body(known: &mut [u32], known_delta: &mut [f32], steady: &[u8], now: &[u32], delta: &[f32]) {
    for ((((known, known_delta), steady), now), delta) in known.iter_mut().zip(known_delta).zip(steady).zip(now).zip(delta) {
        // an unknown δ is NaN, and nothing compares nearer than that
        let keeps = (*steady == STEADY) & !(*delta > *known_delta + DEPTH_STEP);
        *known = if keeps { *now } else { *known };
        *known_delta = if keeps { *delta } else { *known_delta };
    }
}

dispatch!(
    /// Fills the mask of [`Occluders::pixels`].
    mark, mark_body, (in_front: &mut [u8], known: &[u32], known_delta: &[f32], now: &[u32], delta: &[f32])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn mark_body(in_front: &mut [u8], known: &[u32], known_delta: &[f32], now: &[u32], delta: &[f32]) {
    for ((((in_front, known), known_delta), now), delta) in in_front.iter_mut().zip(known).zip(known_delta).zip(now).zip(delta) {
        *in_front = u8::from(!((*delta <= *known_delta + DEPTH_STEP) & (difference(*now, *known) > COLOUR_STEP)));
    }
}

impl SeenBackground {
    /// An empty memory.
    pub fn new(grid: Grid) -> Self {
        let count = grid.width as usize * grid.height as usize;
        let pixels = Pixels {
            colour: vec![0; count],
            delta: vec![f32::NAN; count],
            last: vec![0; count],
            steady: vec![0; count],
            last_delta: vec![f32::NAN; count],
            last_shown: vec![f32::NAN; count],
        };
        Self { grid, pixels, in_front: Occluders::default() }
    }

    /// Forgets everything, for a new scene.
    pub fn forget(&mut self) {
        self.pixels.delta.fill(f32::NAN);
        self.in_front.clear();
        self.pixels.steady.fill(0);
    }

    /// Number of pixels at which something is remembered.
    pub fn known(&self) -> usize {
        self.pixels.delta.iter().filter(|d| !d.is_nan()).count()
    }

    /// Takes the next frame. Remembers surfaces that are at least as far as the remembered ones and have stayed the same for some frames;
    /// nearer surfaces are in front of them. `colour` has the frame's colours as words, `shown` is the visible surface of all rows, and
    /// `surface` is the same without mixed pixels. The frame is `frames` thirtieths of a second later than the previous one, 0 if it is the
    /// same frame again. Ignores a frame of another size.
    pub(crate) fn take(&mut self, colour: &[u32], shown: &Surface, surface: &Surface, frames: u8) {
        if colour.len() != self.pixels.last.len() {
            return;
        }
        let frame = Frame { colour, delta: surface.all() };
        if self.has_moved(&frame) {
            self.forget();
        }
        let Pixels { colour: known, delta, last, steady, last_delta, .. } = &mut self.pixels;
        stay(last, last_delta, steady, frame.colour, frame.delta, frames.min(MAX_FRAMES));
        keep(known, delta, steady, frame.colour, frame.delta);
        mark(self.in_front.pixels(colour.len()), known, delta, frame.colour, frame.delta);
        self.pixels.last_shown.copy_from_slice(shown.all());
        self.in_front.update(self.grid.width);
    }

    /// True if a large share of the remembered surface that is visible now has changed colour.
    fn has_moved(&self, now: &Frame) -> bool {
        let (mut seen, mut other) = (0usize, 0usize);
        let width = self.grid.width as usize;
        for (y, new) in now.colour.chunks(width).enumerate() {
            let from = y * width;
            let row = now.delta[from..from + width].iter().zip(new).enumerate().skip(y % SAMPLE_STEP).step_by(SAMPLE_STEP);
            for (x, (delta, rgb)) in row {
                if (delta - self.pixels.delta[from + x]).abs() <= DEPTH_STEP {
                    seen += 1;
                    other += usize::from(difference(*rgb, self.pixels.colour[from + x]) > COLOUR_STEP);
                }
            }
        }
        other as f64 > MOVED_SHARE * seen as f64
    }

    /// Replaces made-up `colours` of hidden texels by remembered ones, for all layers of the tiles from index `first` on, in the order of
    /// their classes. Returns the number of colours replaced.
    pub fn recall(&self, first: u32, masks: &[LayerMasks], colours: &mut [Vec<Vec<[u8; 3]>>]) -> usize {
        let layers =
            masks.iter().zip(colours).zip(first..).flat_map(|((m, c), tile)| m.layers.iter().zip(c).map(move |(l, c)| (tile, l, c)));
        layers.map(|(tile, l, colours)| self.recall_layer(tile, &l.plane, l.rect, &l.class, colours)).sum()
    }

    /// Like [`SeenBackground::recall`] for one layer.
    fn recall_layer(&self, tile: u32, plane: &Plane, rect: Rect, class: &[u8], colours: &mut [[u8; 3]]) -> usize {
        let seen = self.seen_of(tile, plane, rect, class).into_iter();
        seen.zip(colours).filter_map(|(seen, colour)| seen.map(|seen| *colour = seen)).count()
    }

    /// The remembered colour of each hidden texel of a layer, in their order; `None` where the colour has to be made up.
    pub(crate) fn seen_of(&self, tile: u32, plane: &Plane, rect: Rect, class: &[u8]) -> Vec<Option<[u8; 3]>> {
        let (place, width) = (TileFrame::of(&self.grid, tile), rect.w as usize);
        let (mut us, mut delta, mut holds, mut out) = (Vec::new(), vec![0.0; width], vec![0; width], Vec::new());
        place.columns(rect.x, rect.w, &mut us);
        for (y, class) in (rect.y..).zip(class.chunks(width.max(1))) {
            if !class.contains(&(Class::Hidden as u8)) {
                continue;
            }
            let at = y as usize * self.grid.width as usize + rect.x as usize;
            visibility_kernels::disparities(&us, place.v(y), plane, &mut delta);
            hold(&delta, &self.pixels.delta[at..at + width], &self.pixels.last_shown[at..at + width], &mut holds);
            if let Some(in_front) = self.in_front.row(at, width) {
                holds.iter_mut().zip(in_front).for_each(|(holds, in_front)| *holds &= 1 - in_front);
            }
            let texels = class.iter().zip(&holds).zip(&self.pixels.colour[at..at + width]).filter(|((c, _), _)| **c == Class::Hidden as u8);
            out.extend(texels.map(|((_, holds), colour)| (*holds != 0).then(|| of_word(*colour))));
        }
        out
    }
}

dispatch!(
    /// Marks with 1 the pixels of a row where a layer of disparity `delta` shows the remembered surface of disparity `known`, behind the
    /// visible surface `shown`.
    hold, hold_body, (delta: &[f32], known: &[f32], shown: &[f32], holds: &mut [u8])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn hold_body(delta: &[f32], known: &[f32], shown: &[f32], holds: &mut [u8]) {
    for (((delta, known), shown), holds) in delta.iter().zip(known).zip(shown).zip(holds) {
        // a layer's plane is extrapolated from the side, so it may be nearer than the remembered surface; a remembered surface that is
        // nearer belongs to another layer, and a layer closer to the visible object than to the remembered surface belongs to that object
        *holds = u8::from((*known <= *delta + DEPTH_STEP) & ((*delta - *known).abs() <= (*delta - *shown).abs()));
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::layers::occluders::GAP;
    use crate::scene::packed_rgb::words;
    use crate::{Geometry, Inpainter, Intrinsics, Photo, Tile, ViewBox};

    const SIDE: u32 = 64;

    /// A striped wall, and in front of it a red object from column `from` to `to`.
    fn frame(from: u32, to: u32, wall: impl Fn(u32) -> [u8; 3]) -> (Photo, Geometry) {
        let inside = |i: u32| (from..to).contains(&(i % SIDE));
        let rgb = (0..SIDE * SIDE).map(|i| if inside(i) { [200, 0, 0] } else { wall(i) }).collect();
        let planes = vec![Plane::fronto_parallel(0.2), Plane::fronto_parallel(0.8)];
        let tiles = vec![Tile { planes, labels: (0..SIDE * SIDE).map(|i| inside(i).into()).collect(), background: None }];
        let (grid, intrinsics) = (Grid::new(SIDE, SIDE, 64), Intrinsics::centred(SIDE, SIDE, 50.0));
        let view_box = ViewBox { x: 0.2, y: 0.2, z: 0.0 };
        (Photo { width: SIDE, height: SIDE, rgb }, Geometry { grid, intrinsics, view_box, tiles, matte_band: 0 })
    }

    fn stripes(i: u32) -> [u8; 3] {
        [0, if (i % SIDE).is_multiple_of(2) { 250 } else { 10 }, (i / SIDE) as u8]
    }

    /// Takes a photo with the labels of a geometry.
    fn take(memory: &mut SeenBackground, photo: &Photo, geometry: &Geometry) {
        take_after(memory, photo, geometry, 1);
    }

    fn take_after(memory: &mut SeenBackground, photo: &Photo, geometry: &Geometry, frames: u8) {
        let (shown, mut colours) = (geometry.surface(), vec![0; photo.rgb.len()]);
        words(&photo.rgb, &mut colours);
        memory.take(&colours, &shown, &shown.without_mixed(), frames);
    }

    /// Repeats a frame until it is remembered.
    fn repeat(memory: &mut SeenBackground, (photo, geometry): &(Photo, Geometry)) {
        (0..=STEADY).for_each(|_| take(memory, photo, geometry));
    }

    #[test]
    fn low_frame_rates_remember_as_soon() {
        for (frames, after) in [(1, 15), (3, 5), (5, 3), (200, 3)] {
            let (photo, geometry) = frame(0, 12, stripes);
            let mut memory = SeenBackground::new(geometry.grid);
            let known: Vec<usize> = (0..=after)
                .map(|_| {
                    take_after(&mut memory, &photo, &geometry, frames);
                    memory.known()
                })
                .collect();
            assert!(known[..after].iter().all(|k| *k == 0) && known[after] > 0, "{frames}: {known:?}");
        }
    }

    /// Hidden texels of the wall with their columns, and the number of remembered ones.
    fn hidden(memory: &SeenBackground, (photo, geometry): &(Photo, Geometry)) -> (Vec<(u32, [u8; 3])>, usize) {
        let masks = geometry.masks();
        let mut colours = Inpainter::new(photo, geometry).fill_all(&masks);
        let known = memory.recall(0, &masks, &mut colours);
        let wall = &masks[0].layers[0];
        let columns = (0..).zip(&wall.class).filter(|(_, c)| **c == Class::Hidden as u8).map(|(i, _)| wall.rect.x + i % wall.rect.w);
        (columns.zip(colours[0][0].clone()).collect(), known)
    }

    #[test]
    fn hidden_texels_show_what_was_seen_and_the_rest_is_made_up() {
        let (before, now) = (frame(0, 12, stripes), frame(20, 50, stripes));
        let mut memory = SeenBackground::new(now.1.grid);
        assert_eq!((hidden(&memory, &now).1, memory.known()), (0, 0));
        repeat(&mut memory, &before);
        repeat(&mut memory, &now);
        let (texels, known) = hidden(&memory, &now);
        assert!(!texels.is_empty() && known == texels.len(), "{known} of {}", texels.len());
        assert!(texels.iter().all(|(x, c)| c[..2] == stripes(*x)[..2]));
        // the wall behind an object that never moves was never visible
        let stays = frame(0, 30, stripes);
        let mut memory = SeenBackground::new(stays.1.grid);
        repeat(&mut memory, &stays);
        assert_eq!(hidden(&memory, &stays).1, 0);
    }

    #[test]
    fn an_object_ahead_of_its_labels_is_not_remembered_as_background() {
        let thing = |step: u32| frame(2 * step, 12 + 2 * step, stripes);
        let mut memory = SeenBackground::new(thing(0).1.grid);
        repeat(&mut memory, &thing(0));
        for step in 1..=10 {
            take(&mut memory, &thing(step).0, &thing(step.saturating_sub(3)).1);
        }
        let (texels, known) = hidden(&memory, &thing(10));
        // the object's foremost six columns had no labels: the gap around all but the first must not show the wall behind both
        let behind: Vec<_> = texels.iter().filter(|(x, _)| *x < 27 - GAP).collect();
        assert!(known == behind.len() && known > 0 && known < texels.len(), "{known} of {}", texels.len());
        assert!(behind.iter().all(|(x, c)| c[..2] == stripes(*x)[..2]), "{texels:?}");
    }

    #[test]
    fn a_layer_near_the_object_in_front_belongs_to_it() {
        let (before, now) = (frame(0, 12, stripes), frame(20, 50, stripes));
        let mut memory = SeenBackground::new(now.1.grid);
        repeat(&mut memory, &before);
        repeat(&mut memory, &now);
        // the wall is at 0.2, the object at 0.8
        for (delta, expected) in [(0.1, 0), (0.2, 4), (0.45, 4), (0.55, 0), (0.75, 0)] {
            let plane = Plane::fronto_parallel(delta);
            let mut colours = [[1, 2, 3]; 4];
            let known = memory.recall_layer(0, &plane, Rect { x: 30, y: 20, w: 4, h: 1 }, &[Class::Hidden as u8; 4], &mut colours);
            assert_eq!((known, colours[0] != [1, 2, 3]), (expected, expected > 0), "at {delta}");
        }
    }

    #[test]
    fn a_painted_wall_is_remembered_as_last_seen() {
        let plain = |level: u8| move |_| [level; 3];
        let mut memory = SeenBackground::new(frame(0, 1, plain(0)).1.grid);
        for step in 0..20u8 {
            let (photo, geometry) = frame(0, 12, plain(step * 4));
            take(&mut memory, &photo, &geometry);
        }
        let now = frame(20, 50, plain(76));
        take(&mut memory, &now.0, &now.1);
        // only the count shows that the colours are remembered: inpainting gives the same ones for a wall of one colour
        let (texels, known) = hidden(&memory, &now);
        assert!(known > 0 && texels.iter().all(|(_, c)| *c == [76; 3]), "{known} of {}", texels.len());
    }

    #[test]
    fn a_moving_camera_clears_the_memory() {
        let mut memory = SeenBackground::new(frame(0, 1, stripes).1.grid);
        repeat(&mut memory, &frame(0, 12, stripes));
        assert!(memory.known() > 0);
        let moved = frame(20, 50, |i| stripes(i + 1));
        take(&mut memory, &moved.0, &moved.1);
        assert_eq!(hidden(&memory, &moved).1, 0);
        memory.forget();
        assert_eq!(memory.known(), 0);
    }

    /// Reference in `f64` of a pixel: its colour and δ, remembered and in the last frame, and how long it has stayed.
    #[derive(Clone, Copy, Debug, Default)]
    struct Pixel {
        known: Option<([u8; 3], f64)>,
        last: Option<([u8; 3], f64)>,
        steady: u32,
    }

    fn differ(a: [u8; 3], b: [u8; 3]) -> bool {
        a.iter().zip(b).map(|(a, b)| u32::from(a.abs_diff(b))).sum::<u32>() > 48
    }

    impl Pixel {
        fn take(&mut self, colour: [u8; 3], delta: f64, frames: u32) {
            let stays = self.last.is_some_and(|(c, d)| (d - delta).abs() <= 0.05 && !differ(c, colour));
            self.steady = if stays { (self.steady + frames).min(15) } else { 0 };
            self.last = Some((colour, delta));
            if self.steady == 15 && self.known.is_none_or(|(_, d)| delta <= d + 0.05) {
                self.known = self.last;
            }
        }

        /// Whether a layer at `delta` shows what is remembered, behind the visible surface at `shown`.
        fn holds(&self, delta: f64, shown: f64) -> bool {
            self.known.is_some_and(|(_, d)| d <= delta + 0.05 && (delta - d).abs() <= (delta - shown).abs())
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        /// No δ lies at a bound, where rounding would decide; infinite and NaN as for mixed and unknown pixels.
        #[test]
        fn memories_agree_with_their_definition(
            count in 1usize..40, frames in prop::collection::vec((1u8..9, prop::collection::vec((0usize..24, 0usize..24), 40)), 1..40),
        ) {
            let colours = [[10, 10, 10], [26, 26, 26], [27, 26, 26], [200, 0, 0]];
            let deltas = [0.2, 0.23, 0.27, 0.81, f32::INFINITY, f32::NAN];
            let (mut want, none) = (vec![Pixel::default(); count], vec![f32::NAN; count]);
            let (mut known, mut known_delta, mut last, mut last_delta) = (vec![0; count], none.clone(), vec![0; count], none.clone());
            let (mut steady, mut in_front, mut holds) = (vec![0; count], vec![7; count], vec![7; count]);
            let (mut rgb, mut delta) = (vec![[10; 3]; count], vec![0.2; count]);
            for (by, pixels) in &frames {
                // a pixel keeps its colour and δ in most frames
                for (i, (colour, surface)) in (0..count).zip(pixels) {
                    rgb[i] = *colours.get(*colour).unwrap_or(&rgb[i]);
                    delta[i] = *deltas.get(*surface).unwrap_or(&delta[i]);
                    want[i].take(rgb[i], f64::from(delta[i]), u32::from(*by));
                }
                let mut now = vec![0; count];
                words(&rgb, &mut now);
                stay(&mut last, &mut last_delta, &mut steady, &now, &delta, *by);
                keep(&mut known, &mut known_delta, &steady, &now, &delta);
                mark(&mut in_front, &known, &known_delta, &now, &delta);
                let layer: Vec<f32> = delta.iter().rev().copied().collect();
                hold(&layer, &known_delta, &delta, &mut holds);
                for (i, p) in want.iter().enumerate() {
                    let is = (!known_delta[i].is_nan()).then(|| (of_word(known[i]), f64::from(known_delta[i])));
                    let shows = p.known.is_some_and(|(c, d)| f64::from(delta[i]) <= d + 0.05 && differ(c, rgb[i]));
                    let held = p.holds(f64::from(layer[i]), f64::from(delta[i]));
                    prop_assert_eq!((is, u32::from(steady[i])), (p.known, p.steady));
                    prop_assert_eq!((in_front[i], holds[i]), (u8::from(!shows), u8::from(held)), "{:?} {:?}", p, rgb[i]);
                }
            }
        }
    }
}
