"""Error of discrete maps (h = 64, n = 4) against the clean map, for damaged input, for median and guided filter, and for Θ."""

import argparse

import cv2
import numpy as np
import torch

import common
from onnx_graph import run
from paths import DATA
from theta import TILE, discrete, tiles


def boxed(x, radius):
    """Box mean with windows clipped to the map."""
    total = lambda v: cv2.boxFilter(v, -1, (2 * radius + 1,) * 2, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return total(x.astype(np.float64)) / total(np.ones(x.shape))


def guided(d, guide, radius, eps):
    mg, md = boxed(guide, radius), boxed(d, radius)
    a = (boxed(guide * d, radius) - mg * md) / (np.maximum(boxed(guide * guide, radius) - mg * mg, 0) + eps)
    return boxed(a, radius) * guide + boxed(md - a * mg, radius)


def classic(rgb, d, radius=3, eps=1e-4):
    """Like `--denoise classic`, except for the median within two pixels of the border: 5-pixel median, then a filter guided by luminance."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    return guided(cv2.medianBlur(d.astype(np.float32), 5), grey, radius, eps).astype(np.float32)


def noise_level(d):
    """Noise deviation from the median of mixed second differences, and fraction of pixels above or below all neighbours."""
    k = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    sigma = np.median(np.abs(cv2.filter2D(d, -1, k))[1:-1, 1:-1]) / 0.6745 / 6
    around = np.ones((3, 3), np.uint8)
    around[1, 1] = 0
    return sigma, ((d > cv2.dilate(d, around) + 0.05) | (d < cv2.erode(d, around) - 0.05)).mean()


def fitted(d, guide, radius, spread, tolerance, stride):
    """Value at each pixel of a plane fitted around it; weights depend on distance and similarity of the guide."""
    h, w = d.shape
    dp, gp = (np.pad(v, radius, mode="edge") for v in (d, guide))
    sums = np.zeros((9, h, w))
    for dy in range(-radius, radius + 1, stride):
        for dx in range(-radius, radius + 1, stride):
            if dx * dx + dy * dy > radius * radius:
                continue
            at = np.s_[radius + dy : radius + dy + h, radius + dx : radius + dx + w]
            like = np.maximum(0, 1 - ((gp[at] - guide) / tolerance) ** 2 / 8) ** 4
            like *= np.exp(-(dx * dx + dy * dy) / (2 * spread * spread))
            for i, v in enumerate((1, dx, dy, dx * dx, dx * dy, dy * dy, dp[at], dx * dp[at], dy * dp[at])):
                sums[i] += like * v
    s, x, y, xx, xy, yy, t, tx, ty = sums
    left = np.stack([s, x, y, x, xx + 2, xy, y, xy, yy + 2], -1).reshape(h, w, 3, 3)
    return np.linalg.solve(left, np.stack([t, tx, ty], -1)[..., None])[..., 0, 0].clip(0, 1).astype(np.float32)


def planar(d):
    """Approximates `--denoise auto`: nothing without noise, else three plane fits, each guided by the previous result."""
    sigma, outliers = noise_level(d)
    if sigma < 1.5e-3 and outliers < 1e-3:
        return d
    g = cv2.medianBlur(d, 5)
    if sigma < 1.5e-3:
        return np.where(np.abs(d - g) > 0.05, g, d)
    g = cv2.GaussianBlur(g, (0, 0), 1.0)
    for radius, spread, tolerance, stride in ((6, 3, 1.7, 1), (10, 5, 0.9, 1), (14, 7, 0.6, 2)):
        g = fitted(d, g, radius, spread, tolerance * max(sigma, 0.01), stride)
    return g


def maps(step):
    """(name, rgb, clean map in 0..1): real maps if the data exists, and held-out scenes."""
    found = []
    for f in sorted((DATA / "depth_pred" / "adampi").glob("*.jpg"))[::step]:
        d = cv2.imread(str(f.with_name(f.stem + "_disp16.png")), -1).astype(np.float32)
        found.append(("adampi", common.read_rgb(f), (d - d.min()) / (d.max() - d.min())))
    for f in sorted((DATA / "mpi_peers").glob("*/input.png"))[::step]:
        d = cv2.imread(str(f.with_name("expected_disp16.png")), -1).astype(np.float32)
        found.append(("published", common.read_rgb(f), (d - d.min()) / (d.max() - d.min())))
    held = common.RUNS / "data" / "held"
    for f in sorted(held.glob("*/scene.json"))[:: 2 * step]:
        found.append(("rendered", *common.read_pair(f.parent)))
    return found


def cropped(x):
    return x[: x.shape[0] // TILE * TILE, : x.shape[1] // TILE * TILE]


def errors(d, c, clean):
    t = lambda v: torch.from_numpy(np.ascontiguousarray(cropped(v)).astype(np.float32))[None, None]
    e = (discrete(t(d), t(c)) - tiles(t(clean))).abs().flatten().numpy()
    return e.mean() * 1e3, (e**2).mean() * 1e3, np.quantile(e, 0.25) * 1e3, np.abs(cropped(d) - cropped(clean)).mean() * 1e3


def main():
    a = argparse.ArgumentParser(description=__doc__)
    a.add_argument("model", nargs="?", default=str(common.MODELS / "theta.onnx"))
    a.add_argument("--step", type=int, default=1, help="use every Nth picture")
    a = a.parse_args()
    torch.set_num_threads(1)
    damages = {
        "none": lambda d, r: d,
        "noise 1e-4": lambda d, r: d + r.normal(0, 1e-2, d.shape),
        "noise 1e-3": lambda d, r: d + r.normal(0, 1e-3**0.5, d.shape),
        "blur 5x5": lambda d, r: cv2.blur(d, (5, 5)),
        "outliers 1 %": lambda d, r: np.where(r.random(d.shape) < 0.01, r.random(d.shape), d),
    }
    table = {}
    for i, (name, rgb, clean) in enumerate(maps(a.step)):
        h, w = (s // 64 * 64 for s in clean.shape)
        rgb, clean = np.ascontiguousarray(rgb[:h, :w]), np.ascontiguousarray(clean[:h, :w])
        for damage, f in damages.items():
            d = np.clip(f(clean, np.random.default_rng(i)), 0, 1).astype(np.float32)
            x = torch.cat([common.chw(rgb), torch.from_numpy(d)[None]])[None]
            td, tc = (v[0, 0] for v in run(a.model, {"input": x}))
            one = np.ones_like(d)
            for method, (m, c) in {"input": (d, one), "classic": (classic(rgb, d), one), "planar": (planar(d), one), "theta": (td, tc), "theta, no confidence": (td, one)}.items():
                table.setdefault((name, damage, method), []).append(errors(m, c, clean))
    print("discrete map, ×1e-3                             MAE    MSE    Q25   | full map MAE")
    for key, rows in table.items():
        mae, mse, q25, own = np.mean(rows, 0)
        print(f"{key[0]:9} {key[1]:13} {key[2]:21} {mae:6.2f} {mse:6.3f} {q25:6.2f}   | {own:6.2f}   ({len(rows)})")


if __name__ == "__main__":
    main()
