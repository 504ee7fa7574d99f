"""Converts hand-made labels to disparity: `labels/NAME.json` to `NAME.rgb.png` and `NAME.disparity.png`.

    python old_labels.py [-o OUT] [--only NAME] [--check]

`rasterise_labels.py` paints the files that `label_tool.py` writes; this module paints the older files, drawn by hand.
Such a file names its photo in TMPI_DATA and lists regions; later regions cover earlier ones. `left` crops the picture to that fraction
of its width:

    {"photo": "photos/kodak/03.png", "size": [768, 512], "regions": [
      {"name": "sky", "outline": "all", "far": true},
      {"name": "ground", "outline": [[x, y], ...], "metres": [[x, y, z], ...]},
      {"name": "man", "outline": [[x, y], ...], "metres": [[x, y, z]], "refine": 8},
      {"name": "water's mirror", "outline": [[x, y], ...], "unknown": true}]}

`x`, `y` are pixels at `size`, `z` is metres from the camera. The inverse of z is linear over a plane: one point gives a region that faces the camera, two a
slope along the line between them, three or more a least-squares plane. `bulge` [metres] brings a region's middle nearer. `refine` moves an outline by up
to that many pixels to an edge in the photo (GrabCut). `unknown` regions, and pixels at outlines where depth jumps, do not count.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

import rasterise_labels
from paths import HERE, RUNS

# metres that count as infinitely far
FAR = 1e6


def outline(region, size):
    """Mask of a region, u8 0 or 1 [H, W]."""
    w, h = size
    mask = np.zeros((h, w), np.uint8)
    if region["outline"] == "all":
        mask[:] = 1
    else:
        parts = region["outline"] if isinstance(region["outline"][0][0], list) else [region["outline"]]
        for part in parts:
            one = np.zeros((h, w), np.uint8)
            cv2.fillPoly(one, [np.round(np.float32(part)).astype(np.int32)], 1)
            mask |= one
    return mask


def refined(mask, picture, reach):
    """Moves the edge of a mask by up to `reach` pixels to an edge in the photo."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    inner, outer = cv2.erode(mask, kernel), cv2.dilate(mask, kernel)
    if not inner.any() or outer.all():
        return mask
    trimap = np.where(inner > 0, cv2.GC_FGD, np.where(outer == 0, cv2.GC_BGD, np.where(mask > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD))).astype(np.uint8)
    cv2.setRNGSeed(1)
    cv2.grabCut(picture, trimap, None, np.zeros((1, 65)), np.zeros((1, 65)), 3, cv2.GC_INIT_WITH_MASK)
    found = np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)
    return cv2.medianBlur(found, 3)


def plane(region, size):
    """Inverse metres of a region over the whole photo [H, W]."""
    w, h = size
    y, x = np.mgrid[:h, :w].astype(np.float64)
    if region.get("far"):
        return np.full((h, w), 1 / FAR)
    points = np.float64(region["metres"])
    inverse = 1 / points[:, 2]
    if len(points) == 1:
        return np.full((h, w), inverse[0])
    if len(points) == 2:
        along = points[1, :2] - points[0, :2]
        t = ((x - points[0, 0]) * along[0] + (y - points[0, 1]) * along[1]) / (along @ along)
        out = inverse[0] + np.clip(t, -0.5, 1.5) * (inverse[1] - inverse[0])
    else:
        a = np.c_[points[:, :2], np.ones(len(points))]
        fit = np.linalg.lstsq(a, inverse, rcond=None)[0]
        out = fit[0] * x + fit[1] * y + fit[2]
    # limit extrapolation beyond the points
    return np.clip(out, max(inverse.min() / 1.5, 1 / FAR), inverse.max() * 1.5)


def painted(label, picture):
    """Inverse metres [H, W], known pixels [H, W], and the mask of each region."""
    size = tuple(label["size"])
    inverse, valid, masks = np.zeros(size[::-1]), np.zeros(size[::-1], bool), []
    ids = np.zeros(size[::-1], np.uint8)
    for region in label["regions"]:
        mask = outline(region, size)
        if region.get("refine"):
            mask = refined(mask, picture, int(region["refine"]))
        masks.append(mask)
        inside = mask > 0
        ids[inside] = len(masks)
        if region.get("unknown"):
            valid[inside] = False
            continue
        value = plane(region, size)
        if region.get("bulge"):
            depth = cv2.distanceTransform(mask, cv2.DIST_L2, 3)
            round_ = np.sqrt(1 - (1 - np.clip(depth / max(depth.max(), 1), 0, 1)) ** 2)
            value = 1 / np.maximum(1 / value - region["bulge"] * round_, 0.05)
        inverse[inside], valid[inside] = value[inside], True
    # an outline is off by a pixel or two, which matters where depth jumps
    around, fine = np.ones((3, 3), np.uint8), inverse.astype(np.float32)
    jump = cv2.dilate(fine, around) - cv2.erode(fine, around) > 0.02 * np.percentile(inverse[valid], 99.5)
    edge = cv2.morphologyEx(ids, cv2.MORPH_GRADIENT, around) > 0
    return inverse, valid & ~(edge & jump), masks


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("-o", "--out", type=Path, default=RUNS / "labels")
    a.add_argument("--only")
    a.add_argument("--check", action="store_true", help="also write a picture of the outlines beside the disparity")
    a = a.parse_args()
    a.out.mkdir(parents=True, exist_ok=True)
    for file in sorted((HERE / "labels").glob("*.json")):
        # second labels are only for comparison
        if (a.only and file.stem != a.only) or file.stem.endswith(".b"):
            continue
        label = json.loads(file.read_text())
        picture = rasterise_labels.photo(label)
        if rasterise_labels.is_old(label):
            inverse, valid, masks = painted(label, picture)
        else:
            done = rasterise_labels.paint(label)
            inverse, valid = done["disparity"], done["known"]
            masks = [(done["region"] == i + 1).astype(np.uint8) for i in range(len(label["regions"]))]
        shown = inverse / np.percentile(inverse[valid], 99.5)
        code = np.where(valid, 1 + np.clip(shown, 0, 1) * 65534, 0)
        cv2.imwrite(str(a.out / f"{file.stem}.rgb.png"), picture)
        cv2.imwrite(str(a.out / f"{file.stem}.disparity.png"), code.astype(np.uint16))
        print(f"{file.stem}: {len(masks)} regions, {100 * valid.mean():.0f} % labelled")
        if a.check:
            colours = cv2.applyColorMap(np.clip(shown * 255, 0, 255).astype(np.uint8), cv2.COLORMAP_INFERNO)
            colours[~valid] = (0, 128, 0)
            drawn = picture.copy()
            for i, mask in enumerate(masks):
                found, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
                hue = cv2.cvtColor(np.uint8([[[(i * 47) % 180, 255, 255]]]), cv2.COLOR_HSV2BGR)[0, 0].tolist()
                cv2.drawContours(drawn, found, -1, hue, 1)
            cv2.imwrite(str(a.out / f"{file.stem}.check.png"), np.hstack([drawn, colours]))


if __name__ == "__main__":
    main()
