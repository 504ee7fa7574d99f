//! What does not depend on the camera, kept per scene: texels in drawing form, drawing order, and the caches that hold them.

use std::sync::{Arc, Weak};

use crate::tmpi::{Scene, SceneError};

use super::OPAQUE;
use super::border::{Piece, pieces};
use super::cpu::Home;

/// What the texels of a piece allow to be left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Content {
    /// Some sample can reach the alpha that counts as opaque.
    pub opaque: bool,
    /// Some sample can lie between transparent and opaque.
    pub soft: bool,
}

impl Content {
    /// Of the texels' alphas: an interpolated alpha lies between them.
    pub fn of(alphas: impl Iterator<Item = u8>) -> Self {
        let (mut least, mut most) = (u8::MAX, 0);
        for a in alphas {
            least = least.min(a);
            most = most.max(a);
        }
        let is_opaque = |a: u8| f32::from(a) / 255.0 >= OPAQUE;
        Self { opaque: is_opaque(most), soft: most > 0 && !is_opaque(least) }
    }
}

/// Pieces back to front by (mean δ, index): the same for every camera that looks forward, so nothing flickers.
///
/// `backward` is for cameras that look against the reference camera's view: rays meet the planes in the opposite order, ties stay.
pub(super) fn back_to_front(scene: &Scene, pieces: &[Piece], backward: bool) -> Vec<usize> {
    let sign = if backward { -1.0 } else { 1.0 };
    let mean: Vec<f64> = pieces.iter().map(|p| sign * p.mean_delta(scene.grid.half())).collect();
    let mut order: Vec<usize> = (0..mean.len()).collect();
    order.sort_by(|&a, &b| mean[a].total_cmp(&mean[b]).then(a.cmp(&b)));
    order
}

/// Texels after the last one.
pub(super) const PADDING: usize = 8;

/// A scene as the `cpu` host draws it.
#[derive(Debug)]
pub(super) struct Prepared {
    /// The layers and what is mirrored beyond the borders.
    pub pieces: Vec<Piece>,
    /// Straight-alpha texels of all pieces; each has its last column and last row twice, so that two by two neighbours always exist.
    /// After the last come [`PADDING`] more, so that several may be loaded at once.
    pub texels: Vec<[u8; 4]>,
    /// Place of each piece's first texel; its rows are one texel longer than the piece.
    pub first: Vec<usize>,
    /// Pieces with anything to draw, nearest first.
    pub order: Vec<usize>,
    /// Whether the view from the photo's own place is the photo.
    pub home: Home,
}

impl Prepared {
    /// Checks and expands `scene`.
    pub fn new(scene: &Scene) -> Result<Self, SceneError> {
        scene.validate()?;
        let pieces = pieces(scene);
        let mut texels = Vec::with_capacity(pieces.iter().map(padded).sum::<usize>() + PADDING);
        let mut first = Vec::with_capacity(pieces.len());
        let mut drawn = vec![false; pieces.len()];
        let (mut layer, mut own) = (Vec::new(), Vec::new());
        let mut expanded = None;
        for (index, piece) in pieces.iter().enumerate() {
            let content = Content::of(piece.alphas(scene));
            drawn[index] = content.opaque || content.soft;
            first.push(texels.len());
            if drawn[index] {
                if expanded != Some(piece.layer) {
                    layer.clear();
                    scene.expand_layer(piece.layer, &mut layer);
                    expanded = Some(piece.layer);
                }
                own.clear();
                piece.expand(scene, &layer, &mut own);
                let rows = own.chunks(piece.size[0] as usize);
                for row in rows.clone().chain(rows.last()) {
                    texels.extend_from_slice(row);
                    texels.extend(row.last());
                }
            }
        }
        texels.resize(texels.len() + PADDING, [0; 4]);
        let mut order = back_to_front(scene, &pieces, false);
        order.retain(|&i| drawn[i]);
        order.reverse();
        Ok(Self { pieces, texels, first, order, home: Home::default() })
    }

    /// Bytes that [`Prepared::new`] takes for `scene`, at most.
    pub fn bytes(scene: &Scene) -> usize {
        let pieces = pieces(scene);
        let texels = pieces.iter().map(padded).sum::<usize>() + PADDING;
        texels * size_of::<[u8; 4]>() + pieces.len() * (size_of::<Piece>() + 2 * size_of::<usize>())
    }
}

/// Texels of a piece with the column and the row that come twice.
fn padded(piece: &Piece) -> usize {
    (piece.size[0] as usize + 1) * (piece.size[1] as usize + 1)
}

/// Values by scene, within a budget of bytes; the least recently used go first, those of dropped scenes at once.
#[derive(Debug)]
pub(super) struct SceneCache<T> {
    budget: usize,
    /// Least recently used first. A `Weak` keeps its address taken, so equal pointers are the same scene.
    entries: Vec<(Weak<Scene>, usize, T)>,
}

impl<T> SceneCache<T> {
    /// An empty cache of `budget` bytes.
    pub fn new(budget: usize) -> Self {
        Self { budget, entries: Vec::new() }
    }

    /// The value of `scene`, which becomes the most recently used.
    pub fn get(&mut self, scene: &Arc<Scene>) -> Option<&mut T> {
        self.entries.retain(|(weak, ..)| weak.strong_count() > 0);
        let at = self.entries.iter().position(|(weak, ..)| std::ptr::eq(weak.as_ptr(), Arc::as_ptr(scene)))?;
        self.entries[at..].rotate_left(1);
        self.entries.last_mut().map(|(.., value)| value)
    }

    /// Makes room for `bytes`, then creates the value of `scene`. The newest stays even where it alone exceeds the budget.
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
    use super::super::testing;
    use super::*;
    use crate::tmpi::ViewBox;

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
        let other = Arc::new(testing::flat(8, 8, 0.5));
        get(&mut cache, &other);
        assert_eq!(cache.entries.len(), 1);
    }

    #[test]
    fn the_order_is_by_mean_disparity_then_index() {
        let mut scene = testing::stack(16, 16, &[[9, 9, 9, 255]; 4], &[0.5, 0.2, 0.5, 0.0]);
        scene.view_box = ViewBox { x: 0.0, y: 0.0, z: 0.0 };
        let pieces = pieces(&scene);
        assert_eq!(back_to_front(&scene, &pieces, false), [3, 1, 0, 2]);
        assert_eq!(back_to_front(&scene, &pieces, true), [0, 2, 1, 3]);
    }
}
