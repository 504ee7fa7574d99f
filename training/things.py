"""How a disparity map treats the things of a labelled photograph: which side of their outline is nearer, and whether they are whole."""

import cv2
import numpy as np

from sources import THING

# what the figures of `measure` are called
MEASURES = {
    "order": "share of the borders of things with the right order",
    "whole": "variation within things / step at their borders",
}
# disparity differs at a border by this share of the nearer side's, and by this share of the range
STEP, LEAST = 0.08, 0.03
# distance of the two sides of a border that are compared, of the picture's longer side
REACH = 0.015
# least pixels of a border, and of a thing's inside, that count
BORDER, INSIDE = 30, 200


def shifted(x, dy, dx):
    """The two views of a map that lie (dy, dx) apart."""
    h, w = x.shape
    return x[: h - dy, : w - dx], x[dy:, dx:]


def fitted(p, t, known):
    """`p` in the units of `t`: after the best affine map, or, where that would turn it round, with as large a deviation."""
    a = np.stack([p[known], np.ones(known.sum())], 1)
    scale = np.linalg.lstsq(a, t[known], rcond=None)[0][0]
    return p * (scale if scale > 0 else t[known].std() / max(p[known].std(), 1e-12))


def measure(p, sample):
    """Figures of a disparity map `p` [H, W], up to scale and shift, at a labelled sample's size; None where the label has no border that counts.

    `order`: of all pairs of pixels across a thing's outline where the label steps, the share in which the nearer side is nearer (equal: half), mean over things.
    `whole`: mean absolute difference of neighbours at the same distance within a thing, less what the label says, over the mean step at its
    outline where it is the nearer side; the median over things, which a thing without any step (infinite) does not throw."""
    t, region, kind = sample.value.astype(np.float64), sample.region.astype(int), sample.kind
    known = np.isfinite(t)
    if not known.any() or not np.isfinite(p).all():
        return None
    t = np.nan_to_num(t)
    q = fitted(p, t, known)
    reach = max(2, round(REACH * max(t.shape)))
    count = region.max() + 1
    right, seen, step, outer, inside, inner = (np.zeros(count) for _ in range(6))
    sure = cv2.erode((kind == THING).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    for offset in ((0, reach), (reach, 0)):
        (ta, tb), (qa, qb), (ra, rb), (ka, kb), (ha, hb), (sa, sb) = (shifted(x, *offset) for x in (t, q, region, known, kind == THING, sure))
        both = ka & kb
        jump = both & (ra != rb) & (np.abs(ta - tb) > np.maximum(STEP * np.maximum(ta, tb), LEAST))
        apart = np.sign(ta - tb) * (qa - qb)
        for thing, ids in ((ha, ra), (hb, rb)):
            of = jump & thing
            right += np.bincount(ids[of], (np.sign(apart[of]) + 1) / 2, count)
            seen += np.bincount(ids[of], minlength=count)
        front, of = np.where(ta > tb, ra, rb), jump & np.where(ta > tb, ha, hb)
        step += np.bincount(front[of], apart[of], count)
        outer += np.bincount(front[of], minlength=count)
        same = both & (ra == rb) & sa & sb
        inside += np.bincount(ra[same], np.abs((qa - qb) - (ta - tb))[same], count)
        inner += np.bincount(ra[same], minlength=count)
    bordered = seen >= BORDER
    full = (outer >= BORDER) & (inner >= INSIDE)
    if not bordered.any() or not full.any():
        return None
    steps = step[full] / outer[full]
    whole = np.where(steps > 0, (inside[full] / inner[full]) / np.maximum(steps, 1e-9), np.inf)
    return {"order": float(np.mean(right[bordered] / seen[bordered])), "whole": float(min(np.median(whole), 99.0))}
