"""How a disparity map treats the things of a labelled photograph: which side of their outline is nearer, and whether they are whole."""

import cv2
import numpy as np

from sources import THING

# what the figures of `measure` are called
MEASURES = {
    "order": "share of the borders of things with the right order",
    "whole": "variation within things / step at their borders",
    "border": "share of the borders of things with a right step within 2 pixels",
    "thin": "the same of thin things, drawn as lines",
}
# disparity differs at a border by this share of the nearer side's, and by this share of the range
STEP, LEAST = 0.08, 0.03
# distance of the two sides of a border that are compared, of the picture's longer side
REACH = 0.015
# pixels on each side of a border within which the middle of the step has to be, and within which the step is looked for
NEAR, ABOUT = 2, 10
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
    outline where it is the nearer side; the median over things, which a thing without any step (infinite) does not throw.
    `border`, `thin`: see [`borders`]; absent where there is none."""
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
    return {"order": float(np.mean(right[bordered] / seen[bordered])), "whole": float(min(np.median(whole), 99.0)), **borders(q, sample)}


def filled(sample):
    """The label's map with the pixels of each region that do not count, such as at its outline, at the nearest value of their region that does."""
    t = sample.value.astype(np.float64)
    for n in np.unique(sample.region[np.isnan(t)]):
        own = sample.region == n
        known = own & np.isfinite(sample.value)
        if not known.any():
            continue
        _, nearest = cv2.distanceTransformWithLabels((~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        value = np.zeros(nearest.max() + 1)
        value[nearest[known]] = sample.value[known]
        hole = own & ~known
        t[hole] = value[nearest[hole]]
    return t


def rise(profiles):
    """The most that each of N profiles [K, N] rises by, from a place to one further on, and the place after which it is half way up."""
    lowest = np.minimum.accumulate(profiles, 0)
    end = (profiles - lowest).argmax(0)
    n = np.arange(profiles.shape[1])
    low, high = lowest[end, n], profiles[end, n]
    place = np.arange(len(profiles))[:, None]
    # the last place before the end that is below
    below = (profiles < (low + high) / 2) & (place < end)
    return high - low, np.where(below, place, 0).max(0, initial=0)


def borders(q, sample):
    """Of a map in the label's units: the share of the borders of things at which it steps where the label does, pixels of the label's size, which is its
    photograph's; and that of the borders of regions that were drawn as lines alone.

    A border lies between neighbours of two regions, one of them a thing, whose disparity differs by [`STEP`] and [`LEAST`]. It is right where the
    map, along the row or column across it, rises to the nearer side by as much within `ABOUT` pixels before and behind, and is half way up at most `NEAR`
    pixels from the border: how steep the step is does not matter."""
    t, found = filled(sample), []
    lines = np.isin(sample.region, sample.lines)
    for turn in (False, True):
        tt, qq, region, kind, line = ((v.T if turn else v) for v in (t, q, sample.region, sample.kind, lines))
        w = tt.shape[1]
        ta, tb = tt[:, :-1], tt[:, 1:]
        differs = (region[:, :-1] != region[:, 1:]) & ((kind[:, :-1] == THING) | (kind[:, 1:] == THING))
        with np.errstate(invalid="ignore"):
            y, x = np.nonzero(differs & (np.abs(ta - tb) > np.maximum(STEP * np.maximum(ta, tb), LEAST)))
        sign = np.sign(tb - ta)[y, x]
        profiles = sign * np.stack([qq[y, np.clip(x + k, 0, w - 1)] for k in range(-ABOUT, ABOUT + 2)])
        most, middle = rise(profiles)
        least = np.maximum(STEP * np.maximum(ta, tb)[y, x], LEAST)
        found.append(np.stack([(most > least) & (np.abs(middle - ABOUT) <= NEAR), line[y, x] | line[y, x + 1]], 1))
    right, thin = np.concatenate(found).T.astype(bool)
    shares = {"border": right, "thin": right[thin]}
    return {k: float(v.mean()) for k, v in shares.items() if len(v) >= BORDER}
