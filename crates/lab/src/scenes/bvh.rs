//! Bounding volume hierarchy over the bounded objects of a scene.

use super::math::V3;

#[derive(Clone, Copy, Debug)]
pub(super) struct Aabb {
    pub low: V3,
    pub high: V3,
}

impl Aabb {
    fn join(self, o: Self) -> Self {
        Self { low: self.low.min(o.low), high: self.high.max(o.high) }
    }

    /// Distance along the ray to the box, if the ray enters it before `far`; `inv` is 1/direction.
    fn entry(&self, o: V3, inv: V3, far: f64) -> Option<f64> {
        let a = (self.low - o).mul(inv);
        let b = (self.high - o).mul(inv);
        let (near, exit) = (a.min(b), a.max(b));
        let t0 = near.x.max(near.y).max(near.z).max(0.0);
        let t1 = exit.x.min(exit.y).min(exit.z).min(far);
        (t0 <= t1).then_some(t0)
    }
}

#[derive(Debug)]
struct Node {
    bounds: Aabb,
    /// Leaf: first item. Inner node: index of the right child; the left child follows its parent.
    first: u32,
    /// Number of items; 0 marks an inner node.
    count: u32,
}

#[derive(Debug, Default)]
pub(super) struct Bvh {
    nodes: Vec<Node>,
    items: Vec<u32>,
}

impl Bvh {
    pub fn new(boxes: &[(u32, Aabb)]) -> Self {
        let mut tree = Self::default();
        let mut work = boxes.to_vec();
        if !work.is_empty() {
            tree.build(&mut work);
        }
        tree
    }

    fn build(&mut self, boxes: &mut [(u32, Aabb)]) {
        let bounds = boxes.iter().skip(1).fold(boxes[0].1, |a, b| a.join(b.1));
        let at = self.nodes.len();
        self.nodes.push(Node { bounds, first: self.items.len() as u32, count: boxes.len() as u32 });
        if boxes.len() <= 2 {
            self.items.extend(boxes.iter().map(|b| b.0));
            return;
        }
        let e = bounds.high - bounds.low;
        let key = |b: &Aabb| {
            let c = b.low + b.high;
            if e.x >= e.y && e.x >= e.z {
                c.x
            } else if e.y >= e.z {
                c.y
            } else {
                c.z
            }
        };
        boxes.sort_by(|a, b| key(&a.1).total_cmp(&key(&b.1)));
        let (left, right) = boxes.split_at_mut(boxes.len() / 2);
        self.build(left);
        let place = self.nodes.len() as u32;
        self.build(right);
        self.nodes[at].first = place;
        self.nodes[at].count = 0;
    }

    /// Calls `hit(item, far)` for each item whose box the ray enters before `far`; `hit` returns the new `far`. A negative value stops the
    /// walk.
    pub fn walk(&self, o: V3, d: V3, mut far: f64, mut hit: impl FnMut(u32, f64) -> f64) {
        // avoids exact zeros: 1/0 is infinite, and 0·∞ would be NaN
        let inv = d.map(|v| 1.0 / if v.abs() < 1e-12 { 1e-12_f64.copysign(v) } else { v });
        let mut stack = [0u32; 64];
        let mut top = usize::from(!self.nodes.is_empty());
        while top > 0 {
            top -= 1;
            let i = stack[top] as usize;
            let node = &self.nodes[i];
            if node.bounds.entry(o, inv, far).is_none() {
                continue;
            }
            if node.count > 0 {
                for &item in &self.items[node.first as usize..(node.first + node.count) as usize] {
                    far = hit(item, far);
                    if far < 0.0 {
                        return;
                    }
                }
            } else {
                let (left, right) = (i as u32 + 1, node.first);
                let near = |n: u32| self.nodes[n as usize].bounds.entry(o, inv, far).unwrap_or(f64::INFINITY);
                let (a, b) = if near(left) < near(right) { (right, left) } else { (left, right) };
                stack[top] = a;
                stack[top + 1] = b;
                top += 2;
            }
        }
    }
}
