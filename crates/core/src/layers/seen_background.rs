//! What was seen of a surface before something came in front of it.
//!
//! A reader of a room keeps it, and shows it in place of the colours that [`super::Inpainter`] makes up. Nothing is sent for it: who came
//! later has seen less and makes up more. What a texel is, and where, does not depend on it; its colour alone does.

use super::occluders::Occluders;
use super::{LayerMasks, Surface, TileFrame, visibility_kernels};
use crate::scene::packed_rgb::{apart, of_word};
use crate::scene::{Class, Grid, Plane, Rect};
use crate::simd::dispatch;

/// δ by which something lies in front of what is remembered, or a layer apart from it: the noise of depth from frame to frame is less.
const APART: f32 = 0.05;
/// Levels, summed over the channels, by which a surface that is seen all the time has become another.
const OTHER: u32 = 48;
/// Share of such pixels from which on the camera has moved, or the light has changed: nothing that was seen holds any more.
const MOVED: f64 = 0.3;
/// Pixels in a row of which one is looked at for that.
const EVERY: usize = 7;
/// Frames, at 30 a second, in which a pixel must go on as it was before it is kept: what moves is seen at its new place some frames before its labels say that it
/// is there, and would be taken for what lies behind it, the longer the slower it turns round. `tmpi-lab live-bench --files DIR` compares: with 6 frames light
/// and dark lines of the thing stand where it turned, at the borders of labels of the floor, with 15 none, at .02 dB of what is uncovered.
pub(crate) const STEADY: u8 = 15;
/// For how many of these one frame may count where frames are shown more seldom: labels are then a frame late at the most, and three frames tell.
/// `tmpi-lab live-bench --only measured --every 15` compares: where each counts for one, nothing is remembered within the sequence, and what is uncovered is 1.9 dB worse.
pub(crate) const MOST: u8 = 5;

/// For each pixel of the frames the farthest surface that was seen there, and stayed for some frames.
#[derive(Clone, Debug)]
pub struct SeenBackground {
    grid: Grid,
    pixels: Pixels,
    in_front: Occluders,
}

/// What is known of each pixel, a list of each so that vectors take them.
#[derive(Clone, Debug)]
struct Pixels {
    /// Colour of what is remembered, as words.
    colour: Vec<u32>,
    /// δ of what is remembered, NaN where there is nothing.
    delta: Vec<f32>,
    /// Colour that was shown in the frame before.
    last: Vec<u32>,
    /// Frames for which a pixel has shown that, up to [`STEADY`].
    steady: Vec<u8>,
    /// δ in the frame before: NaN before the first, infinite where it is mixed with something nearer.
    last_delta: Vec<f32>,
    /// The same, also where it is mixed.
    last_shown: Vec<f32>,
}

/// A frame, of as many pixels: colours as words, δ of its visible surface without what is mixed.
#[derive(Clone, Copy)]
struct Frame<'a> {
    colour: &'a [u32],
    delta: &'a [f32],
}

dispatch!(
    /// Frames for which each pixel has gone on as it was before, `frames` more than until now, from its colour and δ before, which become those of now.
    stay, stay_body, (last: &mut [u32], last_delta: &mut [f32], steady: &mut [u8], now: &[u32], delta: &[f32], frames: u8)
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn stay_body(last: &mut [u32], last_delta: &mut [f32], steady: &mut [u8], now: &[u32], delta: &[f32], frames: u8) {
    for ((((last, last_delta), steady), now), delta) in last.iter_mut().zip(last_delta).zip(steady).zip(now).zip(delta) {
        // infinite where it is mixed with something nearer, and then never within anything
        let same = ((delta - *last_delta).abs() <= APART) & (apart(*now, *last) <= OTHER);
        *steady = if same { (*steady + frames).min(STEADY) } else { 0 };
        (*last, *last_delta) = (*now, *delta);
    }
}

dispatch!(
    /// Keeps the colour and δ of what is steady and no nearer than what is `known`.
    keep, keep_body, (known: &mut [u32], known_delta: &mut [f32], steady: &[u8], now: &[u32], delta: &[f32])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
#[allow(clippy::needless_bitwise_bool, clippy::neg_cmp_op_on_partial_ord, reason = "without a branch, and NaN is nearer than nothing")]
fn keep_body(known: &mut [u32], known_delta: &mut [f32], steady: &[u8], now: &[u32], delta: &[f32]) {
    for ((((known, known_delta), steady), now), delta) in known.iter_mut().zip(known_delta).zip(steady).zip(now).zip(delta) {
        // what is not known is NaN, and nothing is nearer than that
        let keeps = (*steady == STEADY) & !(*delta > *known_delta + APART);
        *known = if keeps { *now } else { *known };
        *known_delta = if keeps { *delta } else { *known_delta };
    }
}

dispatch!(
    /// Marks pixels as [`Occluders::pixels`] has it.
    mark, mark_body, (in_front: &mut [u8], known: &[u32], known_delta: &[f32], now: &[u32], delta: &[f32])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn mark_body(in_front: &mut [u8], known: &[u32], known_delta: &[f32], now: &[u32], delta: &[f32]) {
    for ((((in_front, known), known_delta), now), delta) in in_front.iter_mut().zip(known).zip(known_delta).zip(now).zip(delta) {
        *in_front = u8::from(!((*delta <= *known_delta + APART) & (apart(*now, *known) > OTHER)));
    }
}

impl SeenBackground {
    /// Knows nothing yet.
    #[must_use]
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

    /// Forgets everything: a new scene.
    pub fn forget(&mut self) {
        self.pixels.delta.fill(f32::NAN);
        self.in_front.clear();
        self.pixels.steady.fill(0);
    }

    /// Pixels of which something is remembered.
    #[must_use]
    pub fn known(&self) -> usize {
        self.pixels.delta.iter().filter(|d| !d.is_nan()).count()
    }

    /// Looks at the next frame: what is as far as what is remembered, or farther, and has stayed as it is for some frames, is kept; what is nearer
    /// stands in front of it. `colour` has the frame's colours as words, `shown` is its visible surface, over all rows, and `surface` the same without
    /// what is mixed. It comes `frames` thirtieths of a second after the one before, 0 where it is that one once more. A frame of another size is left alone.
    pub(crate) fn take(&mut self, colour: &[u32], shown: &Surface, surface: &Surface, frames: u8) {
        if colour.len() != self.pixels.last.len() {
            return;
        }
        let frame = Frame { colour, delta: surface.all() };
        if self.has_moved(&frame) {
            self.forget();
        }
        let Pixels { colour: known, delta, last, steady, last_delta, .. } = &mut self.pixels;
        stay(last, last_delta, steady, frame.colour, frame.delta, frames.min(MOST));
        keep(known, delta, steady, frame.colour, frame.delta);
        mark(self.in_front.pixels(colour.len()), known, delta, frame.colour, frame.delta);
        self.pixels.last_shown.copy_from_slice(shown.all());
        self.in_front.look(self.grid.width);
    }

    /// Whether much of what is in sight as it was before looks otherwise.
    fn has_moved(&self, now: &Frame) -> bool {
        let (mut seen, mut other) = (0usize, 0usize);
        let width = self.grid.width as usize;
        for (y, new) in now.colour.chunks(width).enumerate() {
            let from = y * width;
            let row = now.delta[from..from + width].iter().zip(new).enumerate().skip(y % EVERY).step_by(EVERY);
            for (x, (delta, rgb)) in row {
                if (delta - self.pixels.delta[from + x]).abs() <= APART {
                    seen += 1;
                    other += usize::from(apart(*rgb, self.pixels.colour[from + x]) > OTHER);
                }
            }
        }
        other as f64 > MOVED * seen as f64
    }

    /// Puts what is remembered in place of the made-up `colours` of hidden texels: of all layers of the tiles from `first` on, in the order
    /// of their classes. Gives how many it knew.
    pub fn recall(&self, first: u32, masks: &[LayerMasks], colours: &mut [Vec<Vec<[u8; 3]>>]) -> usize {
        let layers =
            masks.iter().zip(colours).zip(first..).flat_map(|((m, c), tile)| m.layers.iter().zip(c).map(move |(l, c)| (tile, l, c)));
        layers.map(|(tile, l, colours)| self.recall_layer(tile, &l.plane, l.rect, &l.class, colours)).sum()
    }

    /// The same of one layer.
    fn recall_layer(&self, tile: u32, plane: &Plane, rect: Rect, class: &[u8], colours: &mut [[u8; 3]]) -> usize {
        let seen = self.seen_of(tile, plane, rect, class).into_iter();
        seen.zip(colours).filter_map(|(seen, colour)| seen.map(|seen| *colour = seen)).count()
    }

    /// What is remembered of each of a layer's hidden texels, in their order; none where it has to be made up.
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
    /// Marks with 1 the pixels of a row where a layer of disparity `delta` shows what is remembered, of disparity `known`, behind what is `shown`.
    hold, hold_body, (delta: &[f32], known: &[f32], shown: &[f32], holds: &mut [u8])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled anew with the caller's target features")]
fn hold_body(delta: &[f32], known: &[f32], shown: &[f32], holds: &mut [u8]) {
    for (((delta, known), shown), holds) in delta.iter().zip(known).zip(shown).zip(holds) {
        // a layer may lie nearer than what was seen there, as its plane was guessed from beside; what was seen nearer is another one's, and
        // what lies nearer to the thing that stands there is a part of it
        *holds = u8::from((*known <= *delta + APART) & ((*delta - *known).abs() <= (*delta - *shown).abs()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::occluders::GAP;
    use crate::scene::packed_rgb::words;
    use crate::{Geometry, Inpainter, Intrinsics, Photo, Tile, ViewBox};

    const SIDE: u32 = 64;

    /// A wall with stripes, and before it a red thing from column `from` to `to`.
    fn frame(from: u32, to: u32, wall: impl Fn(u32) -> [u8; 3]) -> (Photo, Geometry) {
        let inside = |i: u32| (from..to).contains(&(i % SIDE));
        let rgb = (0..SIDE * SIDE).map(|i| if inside(i) { [200, 0, 0] } else { wall(i) }).collect();
        let planes = vec![Plane::fronto_parallel(0.2), Plane::fronto_parallel(0.8)];
        let tiles = vec![Tile { planes, labels: (0..SIDE * SIDE).map(|i| inside(i).into()).collect(), background: None }];
        let (grid, intrinsics) = (Grid::new(SIDE, SIDE, 64), Intrinsics::centred(SIDE, SIDE, 50.0));
        let view_box = ViewBox { x: 0.2, y: 0.2, z: 0.0 };
        (Photo { width: SIDE, height: SIDE, rgb }, Geometry { grid, intrinsics, view_box, tiles, matted: false })
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

    /// Looks at a frame for as long as it takes to keep it.
    fn look(memory: &mut SeenBackground, (photo, geometry): &(Photo, Geometry)) {
        (0..=STEADY).for_each(|_| take(memory, photo, geometry));
    }

    #[test]
    fn what_few_frames_a_second_show_is_remembered_as_soon() {
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

    /// Hidden texels of the wall, with the column of each, and how many were remembered.
    fn hidden(memory: &SeenBackground, (photo, geometry): &(Photo, Geometry)) -> (Vec<(u32, [u8; 3])>, usize) {
        let masks = geometry.masks();
        let mut colours = Inpainter::new(photo, geometry).fill_all(&masks);
        let known = memory.recall(0, &masks, &mut colours);
        let wall = &masks[0].layers[0];
        let columns = (0..).zip(&wall.class).filter(|(_, c)| **c == Class::Hidden as u8).map(|(i, _)| wall.rect.x + i % wall.rect.w);
        (columns.zip(colours[0][0].clone()).collect(), known)
    }

    #[test]
    fn what_was_seen_is_shown_where_something_stands_now_and_the_rest_is_made_up() {
        let (before, now) = (frame(0, 12, stripes), frame(20, 50, stripes));
        let mut memory = SeenBackground::new(now.1.grid);
        assert_eq!((hidden(&memory, &now).1, memory.known()), (0, 0));
        look(&mut memory, &before);
        look(&mut memory, &now);
        let (texels, known) = hidden(&memory, &now);
        assert!(!texels.is_empty() && known == texels.len(), "{known} of {}", texels.len());
        assert!(texels.iter().all(|(x, c)| c[..2] == stripes(*x)[..2]));
        // behind where the thing was all the time nothing was ever seen
        let stays = frame(0, 30, stripes);
        let mut memory = SeenBackground::new(stays.1.grid);
        look(&mut memory, &stays);
        assert_eq!(hidden(&memory, &stays).1, 0);
    }

    #[test]
    fn what_moves_ahead_of_its_labels_is_not_taken_for_what_lies_behind_it() {
        let thing = |step: u32| frame(2 * step, 12 + 2 * step, stripes);
        let mut memory = SeenBackground::new(thing(0).1.grid);
        look(&mut memory, &thing(0));
        for step in 1..=10 {
            take(&mut memory, &thing(step).0, &thing(step.saturating_sub(3)).1);
        }
        let (texels, known) = hidden(&memory, &thing(10));
        // its foremost six columns were shown without labels: what opens about these, but for the first, must not show what lies behind both
        let behind: Vec<_> = texels.iter().filter(|(x, _)| *x < 27 - GAP).collect();
        assert!(known == behind.len() && known > 0 && known < texels.len(), "{known} of {}", texels.len());
        assert!(behind.iter().all(|(x, c)| c[..2] == stripes(*x)[..2]), "{texels:?}");
    }

    #[test]
    fn what_lies_near_the_thing_in_front_is_a_part_of_it() {
        let (before, now) = (frame(0, 12, stripes), frame(20, 50, stripes));
        let mut memory = SeenBackground::new(now.1.grid);
        look(&mut memory, &before);
        look(&mut memory, &now);
        // the wall is at .2, the thing at .8
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
        // what is remembered must say so: a wall of one colour is made up just so
        let (texels, known) = hidden(&memory, &now);
        assert!(known > 0 && texels.iter().all(|(_, c)| *c == [76; 3]), "{known} of {}", texels.len());
    }

    #[test]
    fn nothing_holds_once_the_camera_has_moved() {
        let mut memory = SeenBackground::new(frame(0, 1, stripes).1.grid);
        look(&mut memory, &frame(0, 12, stripes));
        assert!(memory.known() > 0);
        let moved = frame(20, 50, |i| stripes(i + 1));
        take(&mut memory, &moved.0, &moved.1);
        assert_eq!(hidden(&memory, &moved).1, 0);
        memory.forget();
        assert_eq!(memory.known(), 0);
    }
}
