"""Paints a hand-made label file (`labels/NAME.json`): disparity, regions, and known pixels.

    {"photo": "train2/photos/azure/dog.jpg", "sha256": "…", "size": [600, 450], "horizon": 240, "regions": [
      {"name": "sky", "kind": "sky", "area": "all"},
      {"name": "deck", "kind": "ground", "area": "0,320 1000,330 1000,750 0,750", "metres": "500,740:0.7"},
      {"name": "rail", "kind": "object", "line": "0,90 400,140 680,125", "width": 10, "metres": 3},
      {"name": "dog", "kind": "animal", "area": "500,240 540,222 …", "foot": "670,630", "front": "deck"}]}

Points are "x,y" in thousandths of the photo's longer side, from its top left corner. Later regions cover earlier ones.

Shape, one or more of: `area` ("all" or rough outlines, separated by ";"), `box` ("x0,y0 x1,y1"), `disc` ("x,y rx,ry"), `line` (strokes of `width`, 10);
`hole` subtracts outlines. The outline moves by up to `reach` (12; 0: stays as drawn) to an edge in the photo.

Distance, one of: `metres` as a number (the region faces the camera); `metres` as "x,y:z x,y:z" (the inverse of z is linear, along the line of two points or
over a least-squares plane of three or more); `foot` "x,y" (the distance of the ground there; `on` names another region than the last ground before it).
With `horizon` (y, or "x,y x,y" if tilted) the inverse distance of a `ground` with points is zero there, so one point is enough. Sky is infinitely far;
`unknown` regions do not count. `bulge` [m] brings a region's middle nearer. `front` names regions that must be behind this one where they touch.

Outlines: the method was chosen by labelling four photographs (a dog, a furnished room, a house among trees, a portrait) in several ways. Strokes alone,
grown by watershed or random walker on CIELAB edges, worked for plain things and leaked through table legs, shadows and foliage; more strokes cost more than
an outline. Superpixels (SLIC, 150 and 400 with their numbers) need 10 to 30 numbers per thing, and lose table legs and a dog's back to the floor. In a band
around a rough outline, watershed and random walker were ragged on textured ground or things. GrabCut was best: with one global colour model it failed where
thing and background share a colour elsewhere (a white chimney in front of a white sky); with colour models of 96-pixel windows it worked there, and failed
where a window has too little of one side. Therefore both vote, with a small weight on the line as drawn.
"""

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np

from paths import DATA, RUNS

KINDS = ("sky", "ground", "water", "wall", "building", "object", "person", "animal", "plant", "vehicle", "unknown")
REACH, WIDTH, WINDOW = 12, 10, 96
# part of the name of a cached outline; increase it when the method for outlines changes
VERSION = 3


class LabelError(ValueError):
    """A label file that cannot be painted; the message names the region."""


def read(path):
    """Reads a label file, and adds its path."""
    try:
        label = json.loads(Path(path).read_text())
    except json.JSONDecodeError as e:
        raise LabelError(f"{path}: {e}") from e
    label["file"] = str(path)
    return label


def is_old(label):
    """Whether this is an older file with outlines in pixels, which `old_labels.py` paints."""
    return "sha256" not in label


def photo(label):
    """The photograph, u8 BGR [H, W, 3] at the label's size."""
    picture = cv2.imread(str(DATA / label["photo"]))
    if picture is None:
        raise LabelError(f"{label['photo']}: not a picture in TMPI_DATA")
    if left := label.get("left"):
        picture = picture[:, : int(picture.shape[1] * left)]
    if is_old(label):
        picture = cv2.resize(picture, tuple(label["size"]), interpolation=cv2.INTER_AREA)
    if picture.shape[1::-1] != tuple(label["size"]):
        raise LabelError(f"{label['photo']}: {picture.shape[1::-1]}, not {label['size']}")
    return picture


def points(text, what, of=2):
    """Parses points "x,y" or "x,y:z", float64 [N, `of`]."""
    try:
        found = np.array([[float(v) for v in p.replace(":", ",").split(",")] for p in str(text).split()])
    except ValueError as e:
        raise LabelError(f"{what}: {text!r}: {e}") from e
    if found.ndim != 2 or found.shape[1] != of:
        raise LabelError(f"{what}: {text!r}: expected points of {of} numbers")
    return found


def shape(region, size):
    """Mask of a region as drawn, u8 0 or 1 [H, W]."""
    w, h = size
    scale, name = max(w, h) / 1000, region["name"]
    mask = np.zeros((h, w), np.uint8)

    def outlines(key):
        for part in region[key].split(";"):
            p = points(part, f"{name}: {key}")
            if len(p) < 3:
                raise LabelError(f"{name}: {key}: an outline of {len(p)} points")
            # 4 fractional bits, because whole pixels would bend slanted lines
            yield [np.round((p * scale - 0.5) * 16).astype(np.int32)]

    if region.get("area") == "all":
        mask[:] = 1
    elif "area" in region:
        for p in outlines("area"):
            cv2.fillPoly(mask, p, 1, shift=4)
    if "box" in region:
        (x0, y0), (x1, y1) = np.round(points(region["box"], f"{name}: box") * scale).astype(int)
        mask[max(y0, 0) : y1, max(x0, 0) : x1] = 1
    if "disc" in region:
        centre, radii = points(region["disc"], f"{name}: disc") * scale
        y, x = np.mgrid[:h, :w]
        mask[((x + 0.5 - centre[0]) / radii[0]) ** 2 + ((y + 0.5 - centre[1]) / radii[1]) ** 2 <= 1] = 1
    if "line" in region:
        thick = max(1, round(region.get("width", WIDTH) * scale))
        for part in region["line"].split(";"):
            p = points(part, f"{name}: line") * scale
            cv2.polylines(mask, [np.round(p * 16).astype(np.int32)], False, 1, thick, shift=4)
    if "hole" in region:
        for p in outlines("hole"):
            cv2.fillPoly(mask, p, 0, shift=4)
    return mask


def core(mask, reach):
    """Pixels certainly inside: deeper than `reach`, and the middle of thinner parts."""
    far = cv2.copyMakeBorder(mask, *[reach + 2] * 4, cv2.BORDER_REPLICATE)
    deep = cv2.distanceTransform(far, cv2.DIST_L2, 5)
    ridge = deep >= 0.6 * cv2.dilate(deep, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2))
    inside = (deep > reach) | (ridge & (deep >= 1.5))
    return inside[reach + 2 : -reach - 2, reach + 2 : -reach - 2]


def cut(picture, trimap):
    """GrabCut of a trimap, u8 0 or 1; None if either side has too few pixels for a colour model."""
    sure = trimap == cv2.GC_FGD, trimap == cv2.GC_BGD
    if min(s.sum() for s in sure) < 30:
        return None
    out = trimap.copy()
    cv2.setRNGSeed(1)
    cv2.grabCut(np.ascontiguousarray(picture), out, None, np.zeros((1, 65)), np.zeros((1, 65)), 2, cv2.GC_INIT_WITH_MASK)
    return out & 1


def snapped(mask, picture, reach, taken):
    """Moves the edge of a mask by up to `reach` pixels to an edge in the photo; ignores `taken` pixels, which belong to regions in front."""
    grown = cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2))
    inner = core(mask, reach) & (mask > 0)
    if not inner.any() or grown[~taken].all():
        return mask
    ys, xs = np.nonzero(grown)
    y0, y1, x0, x1 = max(ys.min() - WINDOW // 2, 0), ys.max() + WINDOW // 2, max(xs.min() - WINDOW // 2, 0), xs.max() + WINDOW // 2
    crop = slice(y0, y1), slice(x0, x1)
    small, drawn, taken, picture = mask[crop], mask[crop], taken[crop], picture[crop]
    if taken.any() and not taken.all():
        # fill regions in front with the colours around them
        _, nearest = cv2.distanceTransformWithLabels(taken.astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
        colours = np.zeros((nearest.max() + 1, 3), np.uint8)
        colours[nearest[~taken]] = picture[~taken]
        picture = colours[nearest]
    trimap = np.where(inner[crop], cv2.GC_FGD, np.where(grown[crop] == 0, cv2.GC_BGD, np.where(small > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD))).astype(np.uint8)
    trimap[taken] = np.where(small > 0, cv2.GC_FGD, cv2.GC_BGD)[taken]
    band = trimap >= cv2.GC_PR_BGD
    whole = cut(picture, trimap)
    whole = drawn if whole is None else whole
    vote, weight = np.zeros(small.shape, np.float32), np.full(small.shape, 1e-6, np.float32)
    ramp = np.hanning(WINDOW + 2)[1:-1]
    hat = np.outer(ramp, ramp).astype(np.float32) + 0.01
    h, w = small.shape
    for y in range(-WINDOW // 2, h, WINDOW // 2):
        for x in range(-WINDOW // 2, w, WINDOW // 2):
            t = slice(max(y, 0), min(y + WINDOW, h)), slice(max(x, 0), min(x + WINDOW, w))
            if not band[t].any():
                continue
            found = cut(picture[t], trimap[t])
            k = hat[t[0].start - y : t[0].stop - y, t[1].start - x : t[1].stop - x]
            vote[t] += k * (whole[t] if found is None else found)
            weight[t] += k
    voted = np.where(band, 0.5 * (vote / weight + whole), drawn).astype(np.float32)
    prior = cv2.GaussianBlur(drawn.astype(np.float32), (0, 0), 3) - 0.5
    out = mask.copy()
    out[crop] = cv2.GaussianBlur(voted, (0, 0), 1.2) + 0.15 * prior > 0.5
    return out


def crumbs(ids):
    """Assigns small islands of a region to their surroundings if the region has larger parts."""
    drop = np.zeros(ids.shape, np.uint8)
    for i in np.unique(ids[ids > 0]):
        _, marks, stats, _ = cv2.connectedComponentsWithStats((ids == i).astype(np.uint8), connectivity=8)
        size = stats[1:, cv2.CC_STAT_AREA]
        for k in np.nonzero((size < 30) & (size < 0.1 * size.max()))[0]:
            drop[marks == k + 1] = 1
    return filled(ids, drop) if drop.any() else ids


def filled(ids, drop):
    """Assigns marked pixels to the nearest region."""
    _, nearest = cv2.distanceTransformWithLabels(drop, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    regions = np.zeros(nearest.max() + 1, ids.dtype)
    regions[nearest[drop == 0]] = ids[drop == 0]
    return regions[nearest]


def slits(ids, base, reach):
    """Assigns slits and specks of the background region between snapped outlines to the nearest region."""
    behind = (ids == base).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)
    # the background continues outside the photo
    wide = cv2.morphologyEx(cv2.copyMakeBorder(behind, *[3 * reach] * 4, cv2.BORDER_REPLICATE), cv2.MORPH_OPEN, kernel)
    wide = cv2.dilate(wide, kernel)[3 * reach : -3 * reach, 3 * reach : -3 * reach]
    drop = behind & (1 - wide)
    _, marks, stats, _ = cv2.connectedComponentsWithStats(behind, connectivity=4)
    size = stats[1:, cv2.CC_STAT_AREA]
    for k in np.nonzero((size < 0.0015 * ids.size) & (size < size.max(initial=0)))[0]:
        drop[marks == k + 1] = 1
    return filled(ids, drop) if drop.any() and (ids != base).any() else ids


def outlined(label, picture):
    """Region number of each pixel, int32 [H, W]: i + 1 for the i-th, 0 for none."""
    size = tuple(label["size"])
    scale = max(size) / 1000
    ids = np.zeros(size[::-1], np.int32)
    for i in reversed(range(len(label["regions"]))):
        region, taken = label["regions"][i], ids > 0
        mask = shape(region, size)
        reach = round(region.get("reach", REACH) * scale)
        if reach and region.get("area") != "all":
            mask = snapped(mask, picture, reach, taken)
        ids[(mask > 0) & ~taken] = i + 1
    ids = crumbs(ids)
    base = next((i + 1 for i, r in enumerate(label["regions"]) if r.get("area") == "all"), None)
    return slits(ids, base, max(1, round(3 * scale))) if base else ids


def cached(label, picture):
    """`outlined` with a cache in `runs/`, for checks of all files and for training."""
    shapes = [[r.get(k) for k in ("area", "box", "disc", "line", "width", "hole", "reach")] for r in label["regions"]]
    key = hashlib.sha256(json.dumps([VERSION, label["sha256"], label["size"], shapes]).encode() + picture.tobytes()).hexdigest()[:24]
    kept = RUNS / "label-cache" / f"{key}.png"
    if kept.exists() and (ids := cv2.imread(str(kept), cv2.IMREAD_UNCHANGED)) is not None:
        return ids.astype(np.int32)
    ids = outlined(label, picture)
    kept.parent.mkdir(parents=True, exist_ok=True)
    part = kept.with_suffix(".part.png")
    cv2.imwrite(str(part), ids.astype(np.uint8))
    part.replace(kept)
    return ids


def level(label):
    """Height below the horizon as a function of x and y in thousandths, or None without a horizon."""
    if label.get("horizon") is None:
        return None
    if isinstance(label["horizon"], (int, float)):
        return lambda x, y: y - label["horizon"]
    (x0, y0), (x1, y1) = points(label["horizon"], "horizon")
    return lambda x, y: y - (y0 + (x - x0) * (y1 - y0) / (x1 - x0))


def planes(label):
    """Disparity of each region in 1/m, as a function of x and y in thousandths."""
    out = []
    for i, region in enumerate(label["regions"]):
        name, kind = region["name"], region["kind"]
        if kind == "unknown":
            out.append(lambda x, y: np.zeros(np.broadcast(x, y).shape))
        elif kind == "sky":
            out.append(lambda x, y: np.zeros(np.broadcast(x, y).shape))
        elif "foot" in region:
            grounds = [k for k, r in enumerate(label["regions"]) if (r["name"] == region["on"] if "on" in region else r["kind"] == "ground" and k < i)]
            if not grounds or grounds[-1] >= i:
                raise LabelError(f"{name}: no {region.get('on', 'ground')} before it to stand on")
            x, y = points(region["foot"], f"{name}: foot")[0]
            out.append(constant(float(out[grounds[-1]](np.float64(x), np.float64(y)))))
        elif "metres" not in region:
            raise LabelError(f"{name}: neither metres nor foot")
        elif isinstance(region["metres"], (int, float)):
            if region["metres"] <= 0:
                raise LabelError(f"{name}: {region['metres']} metres")
            out.append(constant(1 / region["metres"]))
        else:
            p = points(region["metres"], f"{name}: metres", 3)
            if (p[:, 2] <= 0).any():
                raise LabelError(f"{name}: distances must be above 0")
            below = level(label) if kind in ("ground", "water") else None
            out.append(grounded(p, below, name) if below else slanted(p))
    return out


def constant(value):
    return lambda x, y: np.full(np.broadcast(x, y).shape, value)


def grounded(p, below, name):
    """A plane through the horizon: least squares for its slope."""
    depth = below(p[:, 0], p[:, 1])
    if (depth <= 0).any():
        raise LabelError(f"{name}: a point above the horizon")
    slope = float(depth @ (1 / p[:, 2]) / (depth @ depth))
    return lambda x, y: np.maximum(slope * below(x, y), 0) + 0 * x


def slanted(p):
    """One point: facing the camera; two, or more in a line: a slope along it; else a plane. Limits extrapolation beyond the points."""
    inverse = 1 / p[:, 2]
    low, high = inverse.min() / 1.5, inverse.max() * 1.5
    if len(p) == 1:
        return constant(inverse[0])
    middle = p[:, :2].mean(0)
    axes = np.linalg.svd(p[:, :2] - middle)
    # points nearly in a line do not determine the slope across it
    across = axes[2][: 1 if len(p) == 2 or axes[1][1] < 0.1 * axes[1][0] else 2]
    fit = np.linalg.lstsq(np.c_[(p[:, :2] - middle) @ across.T, np.ones(len(p))], inverse, rcond=None)[0]
    (a, b), c = fit[:-1] @ across, fit[-1] - fit[:-1] @ across @ middle
    return lambda x, y: np.clip(a * x + b * y + c, low, high)


def bulged(value, mask, metres):
    """Brings the middle of a region `metres` nearer than its outline."""
    deep = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    round_ = np.sqrt(1 - (1 - np.clip(deep / max(deep.max(), 1), 0, 1)) ** 2)
    return 1 / np.maximum(1 / np.maximum(value, 1e-6) - metres * round_, 0.05)


def doubtful(disparity, ids, known):
    """Pixels at outlines where depth jumps, because outlines are off by about a pixel."""
    around = np.ones((3, 3), np.uint8)
    fine = disparity.astype(np.float32)
    top = np.percentile(fine[known], 99.5) if known.any() else 1
    jump = cv2.dilate(fine, around) - cv2.erode(fine, around) > 0.02 * top
    return jump & (cv2.morphologyEx(ids.astype(np.uint8), cv2.MORPH_GRADIENT, around) > 0)


def paint(label, size=None):
    """Paints a label at `size` (width, height; default: the label's size).

    `label` is a path or the result of `read`. Returns `disparity` float32 [H, W] in 1/m (0: infinitely far), `region` int32 [H, W] (0: none, i + 1: the i-th),
    `kind` (a name for each number of `region`, "" for 0), `known` bool [H, W]: where `disparity` is valid. Raises `LabelError`.
    """
    if not isinstance(label, dict):
        label = read(label)
    picture = photo(label)
    full = tuple(label["size"])
    w, h = size or full
    if is_old(label):
        import old_labels

        disparity, known, masks = old_labels.painted(label, picture)
        ids = np.zeros(full[::-1], np.int32)
        for i, mask in enumerate(masks):
            ids[mask > 0] = i + 1
        kind = [""] + ["unknown" if r.get("unknown") else "sky" if r.get("far") else "object" for r in label["regions"]]
        disparity[disparity <= 1 / old_labels.FAR] = 0
        if (w, h) != full:
            known = cv2.resize(known.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST) > 0
            disparity, ids = (cv2.resize(m.astype(np.float32), (w, h), interpolation=cv2.INTER_NEAREST) for m in (disparity, ids))
        return {"disparity": disparity.astype(np.float32), "region": ids.astype(np.int32), "kind": kind, "known": known}
    disparities = planes(label)
    ids = cached(label, picture).astype(np.float32)
    if (w, h) != full:
        ids = cv2.resize(ids, (w, h), interpolation=cv2.INTER_NEAREST)
    ids = ids.astype(np.int32)
    unit = 1000 / max(full)
    y, x = np.mgrid[:h, :w].astype(np.float64)
    x, y = (x + 0.5) * full[0] / w * unit, (y + 0.5) * full[1] / h * unit
    disparity, known = np.zeros((h, w)), ids > 0
    for i, (region, plane) in enumerate(zip(label["regions"], disparities)):
        inside = ids == i + 1
        value = plane(x, y)
        if region.get("bulge"):
            value = bulged(value, inside, region["bulge"])
        disparity[inside] = value[inside]
        if region["kind"] == "unknown":
            known[inside] = False
    known &= ~doubtful(disparity, ids, known)
    kind = [""] + [r["kind"] for r in label["regions"]]
    return {"disparity": disparity.astype(np.float32), "region": ids, "kind": kind, "known": known}
