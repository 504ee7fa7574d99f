"""What the depth network is trained for, by what is known of a picture.

Predictions are disparity up to scale and shift, [N, H, W]; targets likewise, NaN where nothing is known. Every loss is a mean over pictures, invariant
to scale and shift of the prediction. Nothing here waits for a graphics card: what is done is decided by what the host knows, values stay there.
"""

import itertools

import torch
import torch.nn.functional as F

from common import constant
from sources import SKY, THING

# of the larger of two disparities: what two sides of a border differ by for their order to count, and the least of the whole range
STEP, LEAST = 0.08, 0.03
# pixels between the two sides of a border that are compared
REACH = (2, 3)
# least pairs of pixels within a thing, and at its border, that count
INSIDE, BORDER = 24, 6
# how far a prediction of unit deviation must be on the right side of a border
MARGIN = 0.1


def normalised(x, known):
    """Median 0 and mean absolute value 1 per picture, of what is known."""
    flat, known = x.flatten(1), known.flatten(1)
    # where nothing is known the median of all stands in: NaN would spread through gradients
    some = known | ~known.any(1, keepdim=True)
    middle = flat.masked_fill(~some, torch.nan).nanmedian(1, keepdim=True).values
    spread = ((flat - middle).abs() * known).sum(1, keepdim=True) / known.sum(1, keepdim=True).clamp_min(1)
    return ((flat - middle) / spread.clamp_min(1e-4)).view_as(x)


def unit(x):
    """Mean 0 and deviation 1 per picture."""
    x = x - x.mean((1, 2), keepdim=True)
    return x / torch.sqrt(x.square().mean((1, 2), keepdim=True) + 1e-8)


def average(x, known):
    """Mean of what is known, per picture: [N]."""
    return (x * known).flatten(1).sum(1) / known.flatten(1).sum(1).clamp_min(1)


@torch.no_grad()
def fit(p, t, known, rounds=4, most=2.0):
    """Scale and shift [N, 1, 1] that take p to t by reweighted least squares, which outliers hardly move; the scale is within 1/`most` to `most`,
    so that a prediction that is wrong, or the wrong way round, is not fitted by a flat or turned one."""
    w = known.float()
    scale = torch.ones_like(p[:, :1, :1])
    shift = torch.zeros_like(scale)
    for _ in range(rounds):
        total = w.sum((1, 2), keepdim=True).clamp_min(1e-6)
        mp, mt = (w * p).sum((1, 2), keepdim=True) / total, (w * t).sum((1, 2), keepdim=True) / total
        var = (w * (p - mp).square()).sum((1, 2), keepdim=True).clamp_min(1e-6)
        scale = ((w * (p - mp) * (t - mt)).sum((1, 2), keepdim=True) / var).clamp(1 / most, most)
        shift = mt - scale * mp
        # Cauchy's weights at the mean error
        e = (scale * p + shift - t).abs()
        w = known / (1 + (e / (average(e, known)[:, None, None] + 1e-4)).square())
    return scale, shift


def trimmed(e, known, shares):
    """Mean of absolute errors without the largest `shares`, numbers of the host, of them, per picture."""
    found, at, e = [], 0, e.abs()
    for share, same in itertools.groupby(shares):
        of = slice(at, at := at + len(list(same)))
        found.append(average(e[of], known[of] & (e[of] <= bound(e[of].detach(), known[of], share)) if share else known[of]))
    return torch.cat(found)


def bound(e, known, share):
    """What the largest `share` of the errors of each picture exceeds [N, 1, 1]."""
    last = ((1 - share) * known.flatten(1).sum(1)).long().clamp(max=e[0].numel() - 1)
    return e.masked_fill(~known, torch.inf).flatten(1).sort(1).values.gather(1, last[:, None])[:, :, None]


def gradients(e, known, scales=4):
    """Differences of the error between neighbours at several scales, per picture: edges where they belong, and smooth else."""
    total = 0.0
    for s in range(scales):
        share = known.float() if s == 0 else F.avg_pool2d(known.float()[:, None], 2**s)[:, 0]
        d, full = (e, known) if s == 0 else (F.avg_pool2d(e[:, None], 2**s)[:, 0], share > 0.999)
        across, down = full[..., 1:] & full[..., :-1], full[..., 1:, :] & full[..., :-1, :]
        total = total + average((d[..., 1:] - d[..., :-1]).abs(), across) + average((d[..., 1:, :] - d[..., :-1, :]).abs(), down)
    return total / scales


def disparity(p, t, trim):
    """Error in disparity [N] and of its gradients [N]; `trim`: N shares of the largest errors that count for nothing."""
    known = ~t.isnan()
    p, t = normalised(p, known), normalised(t.nan_to_num(0), known).clamp(-6, 6)
    scale, shift = fit(p, t, known)
    e = (scale * p + shift - t) * known
    return trimmed(e, known, trim), gradients(e, known)


def depth(p, t, trim, offsets=(0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4)):
    """Error in distance [N] and of its gradients [N], for maps of one minus distance up to scale and shift.

    Distance is a/(p + c) + b. For each c, which must leave p + c positive, the rest is linear; the best of the `offsets` above the farthest
    predicted value is taken, in mean deviations of the prediction."""
    known = ~t.isnan()
    p, t = normalised(p, known), normalised(t.nan_to_num(0), known).clamp(-6, 6)
    with torch.no_grad():
        low = torch.nanquantile(p.masked_fill(~known, torch.nan).flatten(1), 0.02, dim=1).nan_to_num(0)[:, None, None]
        tries = constant(tuple(offsets), p.device)
        # all tries at once
        every = [v.repeat(len(offsets), 1, 1) for v in (p, t, known, low)]
        errors = average(residual(*every, tries.repeat_interleave(len(p))[:, None, None]).abs(), every[2]).view(len(offsets), len(p))
        c = tries[errors.argmin(0)][:, None, None]
    e = residual(p, t, known, low, c)
    return trimmed(e, known, trim), gradients(e, known)


def residual(p, t, known, low, c):
    """Error of p as distance, after the best fit with the offset c [N, 1, 1] above `low`; nearer is larger on both sides."""
    x, half = p - low + c, c / 2
    # beyond the farthest values distance goes on along its tangent, where it would be infinite
    far = normalised(torch.where(x > half, -1 / torch.maximum(x, half), (x - 2 * half) / half.square()), known)
    scale, shift = fit(far, t, known)
    return (scale * far + shift - t) * known


def order(p, t, generator, pairs=2048, least=0.08):
    """Logistic loss of the order of random pairs of pixels [N], for maps that tell nothing else; `generator` is one of the maps' device."""
    p, t = unit(p).flatten(1), t.flatten(1)
    low, high = (torch.nanquantile(t, q, dim=1, keepdim=True) for q in (0.02, 0.98))
    i = torch.randint(p.shape[1], (2, p.shape[0], pairs), generator=generator, device=p.device)
    difference = (t.gather(1, i[0]) - t.gather(1, i[1])) / (high - low).clamp_min(1e-6)
    known = difference.abs() > least  # NaN is not
    wrong = F.softplus(-difference.nan_to_num(0).sign() * (p.gather(1, i[0]) - p.gather(1, i[1])) * 4) / 4
    return (wrong * known).sum(1) / known.sum(1).clamp_min(1)


def pairs(x, reach, axis):
    """Views of a map [N, H, W] `reach` pixels apart along an axis."""
    n = x.shape[axis]
    return x.narrow(axis, 0, n - reach), x.narrow(axis, reach, n - reach)


def things(p, t, region, kind):
    """Of pictures with regions: the order across the borders of things [N], and how whole things are [N].

    Order: where two regions meet, at least one is a thing, and disparity steps, the nearer side must be nearer by a margin. Wholeness: within a
    thing the prediction may differ from the label by little against the step at the thing's border: inside / (inside + step), 0 to 1."""
    p, known = unit(p), ~t.isnan()
    t = t.nan_to_num(0)
    # the label in the prediction's units, so that what slants may slant
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
            of = jump & torch.where(nearer > 0, ha, hb)
            step = step.index_add(0, front.flatten(), (apart * of).flatten())
            outer = outer.index_add(0, front.flatten(), of.flatten().float())
            same, own = both & (ra == rb) & ha, (ra + index).flatten()
            inside = inside.index_add(0, own, (((pa - pb) - (la - lb)).abs() * same).flatten())
            inner = inner.index_add(0, own, same.flatten().float())
    inside, step = inside / inner.clamp_min(1), F.softplus(step / outer.clamp_min(1) * 16) / 16
    counted = ((inner >= INSIDE) & (outer >= BORDER)).float()
    broken = (inside / (inside + step + 1e-3) * counted).view(n, count).sum(1) / counted.view(n, count).sum(1).clamp_min(1)
    return wrong / seen.clamp_min(1), broken


def sky(p, kind):
    """How far the sky is from being the farthest, and flat [N]."""
    p, far = unit(p), kind == SKY
    some = (far.flatten(1).sum(1) > 20) & ((~far).flatten(1).sum(1) > 20)
    rest = p.detach().masked_fill(far, torch.nan).flatten(1)
    bound = torch.nanquantile(rest, 0.05, dim=1).nan_to_num(0)[:, None, None]
    middle = average(p, far)[:, None, None]
    return (average(F.relu(p - bound), far) + average((p - middle).abs(), far)) * some
