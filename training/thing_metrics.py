"""Measures how a disparity map treats the things in a labelled photograph: which side of an outline is nearer, and whether things are consistent."""

import cv2
import numpy as np

from sources import THING

# descriptions of the figures of `measure`
MEASURES = {
    "order": "fraction of borders of things with the right order",
    "whole": "variation within things / step at their borders",
    "border": "fraction of borders of things with a right step within 2 pixels",
    "thin": "the same for thin things, drawn as lines",
}
# minimum step at a border: as a fraction of the nearer side's disparity, and of the range
STEP, LEAST = 0.08, 0.03
# distance between the compared sides of a border, as a fraction of the longer side
REACH = 0.015
# pixels on each side of a border: largest distance to the middle of the step, and search range for the step
NEAR, ABOUT = 2, 10
# minimum pixels of a border, and of a thing's inside
BORDER, INSIDE = 30, 200


def shifted(x, dy, dx):
    """Two views of a map, offset by (dy, dx)."""
    h, w = x.shape
    return x[: h - dy, : w - dx], x[dy:, dx:]


def fitted(p, t, known):
    """Scales `p` to the units of `t` by the best affine map, or by the deviation if that map would invert it."""
    a = np.stack([p[known], np.ones(known.sum())], 1)
    scale = np.linalg.lstsq(a, t[known], rcond=None)[0][0]
    return p * (scale if scale > 0 else t[known].std() / max(p[known].std(), 1e-12))


def measure(p, sample):
    """Figures of a disparity map `p` [H, W], up to scale and shift, at a labelled sample's size; None if the label has no relevant border.

    `order`: fraction of pixel pairs across a thing's outline, where the label steps, whose nearer side is nearer (equal: half); mean over things.
    `whole`: mean absolute difference of neighbours within a thing, less the label's difference, divided by the mean step at its outline where it is the
    nearer side; median over things, so that a thing without a step (infinite) does not dominate.
    `border`, `thin`: see [`borders`]; absent without such borders."""
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
            counted = jump & thing
            right += np.bincount(ids[counted], (np.sign(apart[counted]) + 1) / 2, count)
            seen += np.bincount(ids[counted], minlength=count)
        front, counted = np.where(ta > tb, ra, rb), jump & np.where(ta > tb, ha, hb)
        step += np.bincount(front[counted], apart[counted], count)
        outer += np.bincount(front[counted], minlength=count)
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
    """The label's map with unknown pixels of each region, such as at its outline, filled with the region's nearest known value."""
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
    """Largest rise of each of N profiles [K, N], and the position after which half of the rise is reached."""
    lowest = np.minimum.accumulate(profiles, 0)
    end = (profiles - lowest).argmax(0)
    n = np.arange(profiles.shape[1])
    low, high = lowest[end, n], profiles[end, n]
    place = np.arange(len(profiles))[:, None]
    # last position before the end with a value below half
    below = (profiles < (low + high) / 2) & (place < end)
    return high - low, np.where(below, place, 0).max(0, initial=0)


def borders(q, sample):
    """Fraction of borders of things, in pixels of the photograph, at which a map in the label's units steps where the label does; and the same for regions
    drawn as lines.

    A border lies between neighbouring pixels of two regions, one of them a thing, whose disparity differs by [`STEP`] and [`LEAST`]. It is right if the
    map, along the row or column across it, rises to the nearer side by at least that within `ABOUT` pixels on each side, and reaches half of the rise at most
    `NEAR` pixels from the border, however steep the step is."""
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
