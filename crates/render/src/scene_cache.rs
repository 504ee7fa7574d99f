//! Camera-independent data of a scene: texels in drawing form, drawing order, and the caches that hold them.

use std::sync::{Arc, Weak};

use tmpi_core::{BorderColours, Scene, SceneError};

use super::OPAQUE;
use super::border::{Expander, Piece, border_colours, pieces};
use super::cpu::ReferenceView;

/// Which drawing passes a piece's texels need.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Content {
    /// Some sample can reach the alpha that counts as opaque.
    pub opaque: bool,
    /// Some sample can lie between transparent and opaque.
    pub soft: bool,
}

impl Content {
    /// From rows of the texels' alphas: an interpolated alpha lies between their minimum and maximum.
    pub fn of<'a>(rows: impl Iterator<Item = &'a [u8]>) -> Self {
        let (mut least, mut most) = (u8::MAX, 0);
        for row in rows {
            (least, most) = row.iter().fold((least, most), |(least, most), &a| (least.min(a), most.max(a)));
        }
        let is_opaque = |a: u8| f32::from(a) / 255.0 >= OPAQUE;
        Self { opaque: is_opaque(most), soft: most > 0 && !is_opaque(least) }
    }
}

/// Pieces from back to front, by (mean δ, index). The order is the same for every camera that looks forward, so nothing flickers.
///
/// `backward` is for cameras that look against the reference camera's direction: their rays meet the planes in the opposite order; the
/// order of ties stays.
pub(super) fn back_to_front(scene: &Scene, pieces: &[Piece], backward: bool) -> Vec<usize> {
    let sign = if backward { -1.0 } else { 1.0 };
    let mean: Vec<f64> = pieces.iter().map(|p| sign * p.mean_delta(scene.grid.half())).collect();
    let mut order: Vec<usize> = (0..mean.len()).collect();
    order.sort_by(|&a, &b| mean[a].total_cmp(&mean[b]).then(a.cmp(&b)));
    order
}

/// Number of texels that is worth a thread to expand them.
const THREAD_TEXELS: usize = 1 << 17;

/// Number of extra texels after the last one.
pub(super) const PADDING: usize = 8;

/// A scene as the `cpu` backend draws it.
#[derive(Debug)]
pub(super) struct ExpandedScene {
    /// The layers, and their mirror images beyond the borders.
    pub pieces: Vec<Piece>,
    /// Straight-alpha texels of all pieces. Each piece repeats its last column and last row, so that all 2×2 neighbours exist. [`PADDING`]
    /// more texels follow the last one, so that a kernel may load several at once.
    pub texels: Vec<[u8; 4]>,
    /// Index of each piece's first texel. The piece's rows are one texel longer than the piece.
    pub first: Vec<usize>,
    /// Pieces with visible content, nearest first. Those that reach infinity come last, the highest index first.
    pub order: Vec<usize>,
    /// Whether the view from the photo's own position is the photo.
    pub reference: ReferenceView,
}

impl ExpandedScene {
    /// Validates and expands `scene`; if `continued`, mirrored pieces continue the colours at the borders.
    pub fn new(scene: &Scene, continued: bool) -> Result<Self, SceneError> {
        scene.validate()?;
        let pieces = pieces(scene);
        let colours = if continued { border_colours(scene, &pieces) } else { None };
        Ok(Self::of(scene, pieces, colours.as_ref()))
    }

    /// Validates and expands what the photo's own position sees of `scene`, without mirrored pieces.
    pub fn for_reference_view(scene: &Scene) -> Result<Self, SceneError> {
        scene.validate()?;
        let mut pieces = pieces(scene);
        pieces.retain(|p| !p.is_mirrored());
        Ok(Self::of(scene, pieces, None))
    }

    fn of(scene: &Scene, pieces: Vec<Piece>, colours: Option<&BorderColours>) -> Self {
        let contents: Vec<Content> = pieces.iter().map(|p| Content::of(p.alphas(scene))).collect();
        let drawn = |i: usize| contents[i].opaque || contents[i].soft;
        let mut first = Vec::with_capacity(pieces.len());
        let mut count = 0;
        for (i, piece) in pieces.iter().enumerate() {
            first.push(count);
            count += if drawn(i) { padded(piece) } else { 0 };
        }
        let mut texels = vec![[0; 4]; count + PADDING];
        let mut order = back_to_front(scene, &pieces, false);
        order.retain(|&i| drawn(i));
        order.reverse();
        // everything beyond infinity counts as at infinity, where the index decides: the higher one comes first
        let (mut order, mut last): (Vec<usize>, Vec<usize>) =
            order.into_iter().partition(|&i| pieces[i].least_delta(scene.grid.half()) > 0.0);
        last.sort_unstable_by(|a, b| b.cmp(a));
        order.append(&mut last);
        let mut parts: Vec<(&Piece, &mut [[u8; 4]])> = Vec::with_capacity(order.len());
        let mut rest = &mut texels[..];
        for (i, piece) in pieces.iter().enumerate().filter(|(i, _)| drawn(*i)) {
            debug_assert_eq!(first[i] + rest.len(), count + PADDING);
            let (own, after) = rest.split_at_mut(padded(piece));
            parts.push((piece, own));
            rest = after;
        }
        expand(scene, colours, parts, count);
        Self { pieces, texels, first, order, reference: ReferenceView::default() }
    }

    /// Maximum number of bytes that [`ExpandedScene::new`] takes for `scene`.
    pub fn bytes(scene: &Scene) -> usize {
        let pieces = pieces(scene);
        let texels = pieces.iter().map(padded).sum::<usize>() + PADDING;
        texels * size_of::<[u8; 4]>() + pieces.len() * (size_of::<Piece>() + 2 * size_of::<usize>())
    }
}

/// Expands the texels of pieces, `count` in total, into their slices.
///
/// Uses its own threads, not rayon's: a rayon thread may wait for this scene while it holds what this function waits for.
fn expand(scene: &Scene, colours: Option<&BorderColours>, mut parts: Vec<(&Piece, &mut [[u8; 4]])>, count: usize) {
    let threads = std::thread::available_parallelism().map_or(1, usize::from).min(count / THREAD_TEXELS);
    if threads < 2 {
        return expand_some(scene, colours, &mut parts);
    }
    std::thread::scope(|scope| {
        let mut rest = &mut parts[..];
        while !rest.is_empty() {
            let mut sum = 0;
            let enough = rest.iter().position(|(_, own)| {
                sum += own.len();
                sum > count / threads
            });
            let (some, after) = rest.split_at_mut(enough.map_or(rest.len(), |i| i + 1));
            rest = after;
            if rest.is_empty() {
                expand_some(scene, colours, some);
            } else {
                scope.spawn(|| expand_some(scene, colours, some));
            }
        }
    });
}

fn expand_some(scene: &Scene, colours: Option<&BorderColours>, parts: &mut [(&Piece, &mut [[u8; 4]])]) {
    let mut expander = Expander::new(scene, colours);
    for (piece, out) in parts {
        let width = piece.size[0] as usize;
        for (row, out) in expander.rows(piece).zip(out.chunks_mut(width + 1)) {
            out[..width].copy_from_slice(row);
            if piece.mirrored[0].is_some() {
                out[..width].reverse();
            }
            out[width] = out[width - 1];
        }
        let last = out.len() - (width + 1);
        out.copy_within(last - (width + 1)..last, last);
    }
}

/// Number of texels of a piece, with the repeated column and row.
fn padded(piece: &Piece) -> usize {
    (piece.size[0] as usize + 1) * (piece.size[1] as usize + 1)
}

/// Values by scene, within a budget in bytes. Evicts the least recently used values first, and those of dropped scenes at once.
#[derive(Debug)]
pub(super) struct SceneCache<T> {
    budget: usize,
    /// Least recently used first. A `Weak` keeps the allocation, so equal pointers mean the same scene.
    entries: Vec<(Weak<Scene>, usize, T)>,
}

impl<T> SceneCache<T> {
    /// An empty cache of `budget` bytes.
    pub fn new(budget: usize) -> Self {
        Self { budget, entries: Vec::new() }
    }

    /// Removes the values of dropped scenes.
    pub fn remove_dropped_scenes(&mut self) {
        self.entries.retain(|(weak, ..)| weak.strong_count() > 0);
    }

    /// Returns the value of `scene` and marks it as the most recently used.
    pub fn get(&mut self, scene: &Arc<Scene>) -> Option<&mut T> {
        self.remove_dropped_scenes();
        let at = self.entries.iter().position(|(weak, ..)| std::ptr::eq(weak.as_ptr(), Arc::as_ptr(scene)))?;
        self.entries[at..].rotate_left(1);
        self.entries.last_mut().map(|(.., value)| value)
    }

    /// Makes room for `bytes`, then creates the value of `scene`. The newest value stays even if it alone exceeds the budget.
    pub fn insert(&mut self, scene: &Arc<Scene>, bytes: usize, create: impl FnOnce() -> T) -> &mut T {
        while !self.entries.is_empty() && self.bytes().saturating_add(bytes) > self.budget {
            self.entries.remove(0);
        }
        self.entries.push((Arc::downgrade(scene), bytes, create()));
        let last = self.entries.len() - 1;
        &mut self.entries[last].2
    }

    fn bytes(&self) -> usize {
        self.entries.iter().map(|(_, bytes, _)| bytes).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Cpu, Renderer, draw_reference_view, testing};
    use super::*;
    use tmpi_core::container::fixtures::discs;
    use tmpi_core::{Camera, Layer, Plane, Pose, ViewBox};

    #[test]
    fn the_cache_keeps_within_its_budget_and_forgets_dropped_scenes() {
        let scenes: Vec<_> = (0..3).map(|_| Arc::new(testing::flat(8, 8, 0.5))).collect();
        let mut cache = SceneCache::new(20);
        let mut made = 0;
        let mut get = |cache: &mut SceneCache<u32>, scene: &Arc<Scene>| {
            cache.get(scene).copied().unwrap_or_else(|| {
                made += 1;
                *cache.insert(scene, 10, || made)
            })
        };
        assert_eq!(get(&mut cache, &scenes[0]), 1);
        assert_eq!(get(&mut cache, &scenes[1]), 2);
        assert_eq!(get(&mut cache, &scenes[0]), 1, "kept");
        assert_eq!(get(&mut cache, &scenes[2]), 3);
        assert_eq!(cache.bytes(), 20);
        assert_eq!(get(&mut cache, &scenes[1]), 4, "the least recently used one was dropped");
        drop(scenes);
        cache.remove_dropped_scenes();
        assert_eq!((cache.entries.len(), cache.bytes()), (0, 0));
        assert_eq!(get(&mut cache, &Arc::new(testing::flat(8, 8, 0.5))), 5);
        assert_eq!(cache.entries.len(), 1);
    }

    #[test]
    fn texels_that_several_threads_expand_are_those_of_each_piece_with_its_ends_twice() {
        let scene = discs(640, 480).1;
        let expanded = ExpandedScene::new(&scene, true).unwrap();
        assert!(expanded.texels.len() > 3 * THREAD_TEXELS && expanded.pieces.iter().any(Piece::is_mirrored));
        let colours = border_colours(&scene, &expanded.pieces);
        for &i in &expanded.order {
            let (piece, first) = (&expanded.pieces[i], expanded.first[i]);
            let mut own = Vec::new();
            Expander::new(&scene, colours.as_ref()).append(piece, &mut own);
            let (w, h) = (piece.size[0] as usize, piece.size[1] as usize);
            let texel = |i: usize| own[(i / (w + 1)).min(h - 1) * w + (i % (w + 1)).min(w - 1)];
            assert!((0..padded(piece)).all(|i| expanded.texels[first + i] == texel(i)), "{piece:?}");
        }
        let reference = ExpandedScene::for_reference_view(&scene).unwrap();
        assert_eq!(reference.pieces.len(), scene.layers.len());
        let camera = Camera { pose: Pose::default(), intrinsics: scene.intrinsics, width: 640, height: 480 };
        assert_eq!(draw_reference_view(&scene).unwrap(), Cpu::default().render(&Arc::new(scene), &camera).unwrap());
    }

    #[test]
    fn the_order_is_by_mean_disparity_then_index() {
        let mut scene = testing::flat(16, 16, 0.0);
        scene.layers = [0.5, 0.2, 0.5, 0.0].map(|delta| Layer { plane: Plane::fronto_parallel(delta), ..scene.layers[0] }).to_vec();
        scene.view_box = ViewBox { x: 0.0, y: 0.0, z: 0.0 };
        let pieces = pieces(&scene);
        assert_eq!(back_to_front(&scene, &pieces, false), [3, 1, 0, 2]);
        assert_eq!(back_to_front(&scene, &pieces, true), [0, 2, 1, 3]);
    }
}
