"""Error of discrete maps (h = 64, n = 4) against the clean map: damaged input as it is, median and guided filter, Θ."""

import argparse

import cv2
import numpy as np
import torch

import common
from common import DATA
from graph import run
from theta import TILE, discrete, tiles


def guided(d, guide, radius, eps):
    box = lambda x: cv2.blur(x, (2 * radius + 1, 2 * radius + 1), borderType=cv2.BORDER_REFLECT)
    mg, md = box(guide), box(d)
    a = (box(guide * d) - mg * md) / (box(guide * guide) - mg * mg + eps)
    return box(a) * guide + box(md - a * mg)


def classic(rgb, d, radius=4, eps=1e-3):
    """5-pixel median, then a filter guided by luminance."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    return guided(cv2.medianBlur(d.astype(np.float32), 5), grey, radius, eps).clip(0, 1)


def maps(limit):
    """(name, rgb, clean map in 0..1): real maps where the data is there, and held-out scenes."""
    found = []
    for f in sorted((DATA / "depth_pred" / "adampi").glob("*.jpg")):
        d = cv2.imread(str(f.with_name(f.stem + "_disp16.png")), -1).astype(np.float32)
        found.append(("real", common.read_rgb(f), (d - d.min()) / (d.max() - d.min())))
    for f in sorted((DATA / "mpi_peers").glob("*/input.png")):
        d = cv2.imread(str(f.with_name("expected_disp16.png")), -1).astype(np.float32)
        found.append(("real", common.read_rgb(f), (d - d.min()) / (d.max() - d.min())))
    found = found[:: max(1, len(found) // limit)][:limit]
    held = common.RUNS / "data" / "held"
    for f in sorted(held.glob("*/scene.json"))[:limit]:
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
    a.add_argument("--limit", type=int, default=8, help="pictures of a kind")
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
    for i, (name, rgb, clean) in enumerate(maps(a.limit)):
        h, w = (s // 64 * 64 for s in clean.shape)
        rgb, clean = np.ascontiguousarray(rgb[:h, :w]), np.ascontiguousarray(clean[:h, :w])
        for damage, f in damages.items():
            d = np.clip(f(clean, np.random.default_rng(i)), 0, 1).astype(np.float32)
            x = torch.cat([common.chw(rgb), torch.from_numpy(d)[None]])[None]
            td, tc = (v[0, 0] for v in run(a.model, {"input": x}))
            one = np.ones_like(d)
            for method, (m, c) in {"as it is": (d, one), "classic": (classic(rgb, d), one), "theta": (td, tc), "theta, no confidence": (td, one)}.items():
                table.setdefault((name, damage, method), []).append(errors(m, c, clean))
    print("discrete map, ×1e-3                             MAE    MSE    Q25   | map itself MAE")
    for key, rows in table.items():
        mae, mse, q25, own = np.mean(rows, 0)
        print(f"{key[0]:9} {key[1]:13} {key[2]:21} {mae:6.2f} {mse:6.3f} {q25:6.2f}   | {own:6.2f}   ({len(rows)})")


if __name__ == "__main__":
    main()
