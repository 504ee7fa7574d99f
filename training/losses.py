"""Losses of the depth network for each type of map.

Predictions are disparity up to scale and shift, [N, H, W]; so are targets, with NaN where unknown. Every loss is a mean over pictures, invariant to scale
and shift of the prediction. Nothing here waits for the GPU: control flow depends only on host values, and results stay on the device.
"""

import itertools

import torch
import torch.nn.functional as F

from common import constant
from sources import SKY, THING

# minimum step at a border: as a fraction of the larger disparity, and of the whole range
STEP, LEAST = 0.08, 0.03
# distances in pixels between the compared sides of a border
REACH = (2, 3)
# minimum pixel pairs within a thing, and at its border
INSIDE, BORDER = 24, 6
# margin of the order at a border, for predictions of unit deviation
MARGIN = 0.1


def normalised(x, known):
    """Normalises known values of each picture to median 0 and mean absolute value 1."""
    flat, known = x.flatten(1), known.flatten(1)
    # without known pixels use the median of all, because NaN would spread through gradients
    some = known | ~known.any(1, keepdim=True)
    middle = flat.masked_fill(~some, torch.nan).nanmedian(1, keepdim=True).values
    spread = ((flat - middle).abs() * known).sum(1, keepdim=True) / known.sum(1, keepdim=True).clamp_min(1)
    return ((flat - middle) / spread.clamp_min(1e-4)).view_as(x)


def unit(x):
    """Normalises each picture to mean 0 and deviation 1."""
    x = x - x.mean((1, 2), keepdim=True)
    return x / torch.sqrt(x.square().mean((1, 2), keepdim=True) + 1e-8)


def average(x, known):
    """Mean of known values per picture [N]."""
    return (x * known).flatten(1).sum(1) / known.flatten(1).sum(1).clamp_min(1)


@torch.no_grad()
def fit(p, t, known, rounds=4, most=2.0):
    """Fits scale and shift [N, 1, 1] from p to t by iteratively reweighted least squares, robust to outliers. The scale stays within 1/`most` to `most`,
    so that the fit does not flatten or invert a wrong prediction."""
    w = known.float()
    scale = torch.ones_like(p[:, :1, :1])
    shift = torch.zeros_like(scale)
    for _ in range(rounds):
        total = w.sum((1, 2), keepdim=True).clamp_min(1e-6)
        mp, mt = (w * p).sum((1, 2), keepdim=True) / total, (w * t).sum((1, 2), keepdim=True) / total
        var = (w * (p - mp).square()).sum((1, 2), keepdim=True).clamp_min(1e-6)
        scale = ((w * (p - mp) * (t - mt)).sum((1, 2), keepdim=True) / var).clamp(1 / most, most)
        shift = mt - scale * mp
        # Cauchy weights, scaled by the mean error
        e = (scale * p + shift - t).abs()
        w = known / (1 + (e / (average(e, known)[:, None, None] + 1e-4)).square())
    return scale, shift


def trimmed(e, known, shares):
    """Mean absolute error per picture, without the largest errors; `shares` are the excluded fractions, as host values."""
    found, at, e = [], 0, e.abs()
    for share, same in itertools.groupby(shares):
        part = slice(at, at := at + len(list(same)))
        found.append(average(e[part], known[part] & (e[part] <= bound(e[part].detach(), known[part], share)) if share else known[part]))
    return torch.cat(found)


def bound(e, known, share):
    """Threshold that the largest `share` of each picture's errors exceed [N, 1, 1]."""
    last = ((1 - share) * known.flatten(1).sum(1)).long().clamp(max=e[0].numel() - 1)
    return e.masked_fill(~known, torch.inf).flatten(1).sort(1).values.gather(1, last[:, None])[:, :, None]


def gradients(e, known, scales=4):
    """Differences of the error between neighbours at several scales, per picture; penalises misplaced edges and roughness."""
    total = 0.0
    for s in range(scales):
        share = known.float() if s == 0 else F.avg_pool2d(known.float()[:, None], 2**s)[:, 0]
        d, full = (e, known) if s == 0 else (F.avg_pool2d(e[:, None], 2**s)[:, 0], share > 0.999)
        across, down = full[..., 1:] & full[..., :-1], full[..., 1:, :] & full[..., :-1, :]
        total = total + average((d[..., 1:] - d[..., :-1]).abs(), across) + average((d[..., 1:, :] - d[..., :-1, :]).abs(), down)
    return total / scales


def disparity(p, t, trim):
    """Error in disparity [N] and of its gradients [N]; `trim`: excluded fraction of the largest errors, per picture."""
    known = ~t.isnan()
    p, t = normalised(p, known), normalised(t.nan_to_num(0), known).clamp(-6, 6)
    scale, shift = fit(p, t, known)
    e = (scale * p + shift - t) * known
    return trimmed(e, known, trim), gradients(e, known)


def depth(p, t, trim, offsets=(0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4)):
    """Error in distance [N] and of its gradients [N], for maps of one minus distance up to scale and shift.

    Distance is a/(p + c) + b with p + c > 0. For a given c the rest is linear; takes the best c of the `offsets` above the farthest predicted value, in
    mean deviations of the prediction."""
    known = ~t.isnan()
    p, t = normalised(p, known), normalised(t.nan_to_num(0), known).clamp(-6, 6)
    with torch.no_grad():
        low = torch.nanquantile(p.masked_fill(~known, torch.nan).flatten(1), 0.02, dim=1).nan_to_num(0)[:, None, None]
        tries = constant(tuple(offsets), p.device)
        # all offsets at once
        every = [v.repeat(len(offsets), 1, 1) for v in (p, t, known, low)]
        errors = average(residual(*every, tries.repeat_interleave(len(p))[:, None, None]).abs(), every[2]).view(len(offsets), len(p))
        c = tries[errors.argmin(0)][:, None, None]
    e = residual(p, t, known, low, c)
    return trimmed(e, known, trim), gradients(e, known)


def residual(p, t, known, low, c):
    """Error of p as distance after the best fit with the offset c [N, 1, 1] above `low`; nearer is larger in both."""
    x, half = p - low + c, c / 2
    # beyond the farthest values continue along the tangent, because distance would become infinite
    far = normalised(torch.where(x > half, -1 / torch.maximum(x, half), (x - 2 * half) / half.square()), known)
    scale, shift = fit(far, t, known)
    return (scale * far + shift - t) * known


def order(p, t, generator, pairs=2048, least=0.08):
    """Logistic loss of the order of random pixel pairs [N], for maps that have only order; `generator` must be on the maps' device."""
    p, t = unit(p).flatten(1), t.flatten(1)
    low, high = (torch.nanquantile(t, q, dim=1, keepdim=True) for q in (0.02, 0.98))
    i = torch.randint(p.shape[1], (2, p.shape[0], pairs), generator=generator, device=p.device)
    difference = (t.gather(1, i[0]) - t.gather(1, i[1])) / (high - low).clamp_min(1e-6)
    known = difference.abs() > least  # false for NaN
    wrong = F.softplus(-difference.nan_to_num(0).sign() * (p.gather(1, i[0]) - p.gather(1, i[1])) * 4) / 4
    return (wrong * known).sum(1) / known.sum(1).clamp_min(1)


def pairs(x, reach, axis):
    """Two views of a map [N, H, W], offset by `reach` pixels along an axis."""
    n = x.shape[axis]
    return x.narrow(axis, 0, n - reach), x.narrow(axis, reach, n - reach)


def things(p, t, region, kind):
    """For pictures with regions: errors of the order across borders of things [N], and of the consistency within things [N].

    Order: where two regions meet, one of them a thing, and disparity steps, the nearer side must be nearer by a margin. Consistency: within a thing the
    prediction should deviate from the label by little compared with the step at its border: inside / (inside + step), 0 to 1."""
    p, known = unit(p), ~t.isnan()
    t = t.nan_to_num(0)
    # the label in the prediction's units, so that slanted things may be slanted
    with torch.no_grad():
        relative = normalised(t, known)
        scale = fit(relative, normalised(p, known), known, most=4.0)[0]
        middle = p.flatten(1).masked_fill(~known.flatten(1), torch.nan).nanmedian(1).values.nan_to_num(0)[:, None, None]
        relative = relative * scale * average((p - middle).abs(), known)[:, None, None]
    n, count = p.shape[0], 256
    thing, index = kind == THING, torch.arange(p.shape[0], device=p.device)[:, None, None] * count
    wrong, seen = p.new_zeros(n), p.new_zeros(n)
    inside, inner, step, outer = (p.new_zeros(n * count) for _ in range(4))
    for reach in REACH:
        for axis in (1, 2):
            (pa, pb), (ta, tb), (ra, rb), (ka, kb), (ha, hb), (la, lb) = (pairs(x, reach, axis) for x in (p, t, region, known, thing, relative))
            both = ka & kb
            jump = both & (ra != rb) & (ha | hb) & ((ta - tb).abs() > (STEP * torch.maximum(ta, tb)).clamp_min(LEAST))
            nearer = (ta - tb).sign()
            apart = nearer * (pa - pb)
            wrong = wrong + (F.softplus((MARGIN - apart) * 8) / 8 * jump).flatten(1).sum(1)
            seen = seen + jump.flatten(1).sum(1)
            # the step counts for the nearer side, if that is a thing
            front = torch.where(nearer > 0, ra, rb) + index
            counted = jump & torch.where(nearer > 0, ha, hb)
            step = step.index_add(0, front.flatten(), (apart * counted).flatten())
            outer = outer.index_add(0, front.flatten(), counted.flatten().float())
            same, own = both & (ra == rb) & ha, (ra + index).flatten()
            inside = inside.index_add(0, own, (((pa - pb) - (la - lb)).abs() * same).flatten())
            inner = inner.index_add(0, own, same.flatten().float())
    inside, step = inside / inner.clamp_min(1), F.softplus(step / outer.clamp_min(1) * 16) / 16
    large = ((inner >= INSIDE) & (outer >= BORDER)).float()
    broken = (inside / (inside + step + 1e-3) * large).view(n, count).sum(1) / large.view(n, count).sum(1).clamp_min(1)
    return wrong / seen.clamp_min(1), broken


def sky(p, kind):
    """Penalty for sky that is not farthest and flat [N]."""
    p, far = unit(p), kind == SKY
    some = (far.flatten(1).sum(1) > 20) & ((~far).flatten(1).sum(1) > 20)
    rest = p.detach().masked_fill(far, torch.nan).flatten(1)
    bound = torch.nanquantile(rest, 0.05, dim=1).nan_to_num(0)[:, None, None]
    middle = average(p, far)[:, None, None]
    return (average(F.relu(p - bound), far) + average((p - middle).abs(), far)) * some
