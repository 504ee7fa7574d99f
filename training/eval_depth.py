"""Evaluates on real pictures: affine-aligned disparity RMSE / standard deviation, for the network and for the best vertical ramp."""

import argparse
import json
import subprocess
import tempfile

import cv2
import numpy as np
import torch

import common
import sources
import thing_metrics
from network import DepthNet, Shipped, normal
from paths import DATA

# pixels at which the program runs the network
AREA = 192 * 256


def size_for(h, w, area=AREA):
    """Size in multiples of 32 with about the picture's aspect ratio (1:3 to 3:1) and `area` pixels."""
    r = min(max(w / h, 1 / 3), 3)
    return max(2, round((area / r) ** 0.5 / 32)) * 32, max(2, round((area * r) ** 0.5 / 32)) * 32


def listed(part):
    """Pictures to measure on: (set, photo, depth file, storage). `part`: "choose" selects checkpoints, "report" is the rest, which selects nothing, "all" is
    both; "wide" is "choose" plus further sets that are never reported, for less noise."""
    if part == "wide":
        return listed("choose") + further()
    found = []
    for i, f in enumerate(sorted((DATA / "depth_pred" / "adampi").glob("*.jpg"))):
        found.append(("adampi", f, f.with_name(f.stem + "_disp16.png"), "disparity", i % 2 == 0))
    for f in sorted((DATA / "stereo_gt").iterdir() if (DATA / "stereo_gt").exists() else []):
        if (f / "disp_left.png").exists():
            left = next(p for p in sorted(f.iterdir()) if p.stem in ("left", "im0", "view1", "im2"))
            found.append(("middlebury", left, f / "disp_left.png", "stereo", f.name in ("art", "cones")))
    found += [("replica", *p, "depth", i % 3 == 0) for i, p in enumerate(replica())]
    found += [("kitchen", *p, "depth", i % 7 == 0) for i, p in enumerate(kitchen(28))]
    single = DATA / "rgbd_single"
    found += [("nyu", p, single / "nyu_demo" / "depth" / (p.stem.replace("rgb", "sync_depth") + ".png"), "depth", False) for p in sorted((single / "nyu_demo" / "rgb").glob("*"))]
    found += [("redwood", p, single / "redwood" / "depth" / (p.stem + ".png"), "depth", False) for p in sorted((single / "redwood" / "color").glob("*"))]
    found += [("corridor", single / "sun_corridor" / "SUN_color.jpg", single / "sun_corridor" / "SUN_depth.png", "rotated depth", False)]
    return [f[:4] for f in found if f[2].exists() and (part == "all" or f[4] == (part == "choose"))]


def further():
    """Pictures that are neither for training nor for reporting: matched stereo, tables with objects, published MPIs, sparse LiDAR."""
    silver, single = DATA / "stereo_silver", DATA / "rgbd_single"
    found = [("still lifes", f / "left.png", f / "silver_disp_left.png", "stereo") for f in sorted(silver.glob("mb_*"))]
    found += [("eth3d", f / "left.png", f / "silver_disp_left.png", "stereo") for f in sorted(silver.glob("eth_*"))]
    tables = sorted((DATA / "train2" / "rgbd" / "pcl_mosd").glob("*.jpg"))[::2]
    found += [("tables", f, f.with_name(f"{f.stem}_depth_mm.png"), "depth") for f in tables]
    found += [("svmpi", f / "input.png", f / "expected_disp16.png", "disparity") for f in sorted((DATA / "mpi_peers").glob("svmpi_*"))]
    found += [("kitti", f, single / "kitti_demo" / "depth" / f.name, "depth") for f in sorted((single / "kitti_demo" / "rgb").glob("*.png"))]
    return [f for f in found if f[2].exists()]


def load_sets(part):
    """Name → list of (rgb, disparity, valid); empty without data. `part` as in [`listed`]."""
    sets = {}
    for name, photo, depth, kind in listed(part):
        rgb, d = common.read_rgb(photo), cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
        if kind in ("disparity", "stereo"):
            d = d.astype(np.float32)
            valid = d > 0 if kind == "stereo" else np.ones(d.shape, bool)
        else:
            d = (d >> 3) | (d << 13) if kind == "rotated depth" else d
            valid = (d > 0) & (d < 65535)
            d = 1 / np.maximum(d.astype(np.float32), 1)
        if rgb.shape[1] > 640:
            rgb = cv2.resize(rgb, (640, round(rgb.shape[0] * 640 / rgb.shape[1])), interpolation=cv2.INTER_AREA)
        if d.shape != rgb.shape[:2]:
            size = rgb.shape[1::-1]
            d = cv2.resize(d, size, interpolation=cv2.INTER_NEAREST)
            valid = cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        sets.setdefault(name, []).append((rgb, d.astype(np.float64), valid))
    return sets


def replica():
    root = DATA / "rgbd_single" / "replica_office0"
    out = []
    for d in sorted((root / "depth").glob("*.png")):
        photo = [p for p in root.glob(f"*/{d.stem}.*") if p.parent != d.parent]
        if photo:
            out.append((photo[0], d))
    return out


def kitchen(n):
    root = DATA / "rgbd_pose" / "kitchen"
    depths = sorted(root.rglob("*depth*.png")) if root.exists() else []
    out = []
    for d in depths[:: max(1, len(depths) // n)]:
        photo = next((p for p in (d.with_name(d.name.replace("depth", "color")), d.with_name(d.name.replace("depth", "color")).with_suffix(".jpg")) if p.exists()), None)
        if photo:
            out.append((photo, d))
    return out


def scores(p, t, valid):
    """RMSE / deviation of t after the best affine map of p to t, rank correlation, and fraction within a factor of 1.25."""
    p, t = p[valid], t[valid]
    a = np.stack([p, np.ones_like(p)], 1)
    fit = a @ np.linalg.lstsq(a, t, rcond=None)[0]
    far = np.maximum(fit, 1e-9 * t.max())
    rank = lambda v: np.argsort(np.argsort(v, kind="stable")).astype(np.float64)
    thin = slice(None, None, max(1, len(p) // 50_000))
    return [
        float(np.sqrt(np.mean((fit - t) ** 2)) / max(t.std(), 1e-12)),
        float(np.corrcoef(rank(p[thin]), rank(t[thin]))[0, 1]),
        float(np.mean(np.maximum(far / t, t / far) < 1.25)),
    ]


@torch.no_grad()
def predict(net, rgb, area=AREA):
    """The network's map for a picture, at the picture's size."""
    h, w = rgb.shape[:2]
    th, tw = size_for(h, w, area)
    small = cv2.resize(rgb, (tw, th), interpolation=cv2.INTER_AREA if tw < w else cv2.INTER_LINEAR)
    p = net(normal(common.chw(small))[None])[0, 0].double().numpy()
    return cv2.resize(p, (w, h), interpolation=cv2.INTER_LINEAR)


class Program:
    """The full pipeline of `tmpi depth`: network, smoothing along the photo's edges, upsampling, snapping."""

    def __init__(self, path, flags):
        self.command = [path, "depth", *flags]

    def predict(self, rgb):
        with tempfile.TemporaryDirectory() as folder:
            photo, out = f"{folder}/photo.png", f"{folder}/depth.png"
            cv2.imwrite(photo, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
            subprocess.run([*self.command, "--quiet", "-o", out, photo], check=True, stdout=subprocess.DEVNULL)
            d = cv2.imread(out, -1).astype(np.float64) / 65535
        return cv2.resize(d, rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR)


def predicted(net, rgb, **how):
    return net.predict(rgb) if isinstance(net, Program) else predict(net, rgb, **how)


def rows_of(d):
    """A vertical ramp of a map's size."""
    return np.repeat(np.arange(d.shape[0], dtype=np.float64)[:, None], d.shape[1], 1)


def evaluate(net, sets, **how):
    """Means per set of RMSE/deviation, Spearman and δ < 1.25, for the network and for the best vertical ramp."""
    result = {}
    for name, pictures in sets.items():
        own, ramp = [], []
        for rgb, d, valid in pictures:
            valid = valid & (d > 0)
            own.append(scores(predicted(net, rgb, **how), d, valid))
            s = scores(rows_of(d), d, valid)
            ramp.append([s[0], abs(s[1]), s[2]])  # the fit may invert the ramp
        own, ramp = np.mean(own, 0), np.mean(ramp, 0)
        result[name] = {"net": float(own[0]), "ramp": float(ramp[0]), "all": own.tolist(), "all_ramp": ramp.tolist(), "pictures": len(pictures)}
    return result


def evaluate_things(net, items, **how):
    """Means of [`thing_metrics.measure`] over labelled photographs, for the network and for the vertical ramp with the best sign."""
    own, ramp, names = [], [], []
    for item in items:
        sample = sources.read_item(item)
        known = np.isfinite(sample.value)
        rows = rows_of(sample.value)
        rows *= np.sign(np.corrcoef(rows[known], sample.value[known])[0, 1]) or 1
        pair = [thing_metrics.measure(p, sample) for p in (predicted(net, sample.rgb, **how), rows)]
        if pair[0] is not None:
            own.append(pair[0])
            ramp.append(pair[1])
            names.append(item.name)
    if not own:
        return None
    mean = lambda rows: {k: float(np.mean(v)) for k in thing_metrics.MEASURES if (v := [r[k] for r in rows if k in r])}
    return {"net": mean(own), "ramp": mean(ramp), "pictures": names, "each": own}


class Onnx:
    """The exported network with the module's interface."""

    def __init__(self, path):
        import onnxruntime as ort

        options = ort.SessionOptions()
        options.intra_op_num_threads = 1
        self.session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    def __call__(self, x):
        return torch.from_numpy(self.session.run(None, {"image": x.numpy()})[0])


def opened(model, flags):
    """Opens a network file, or the program."""
    if model.endswith(".pt"):
        return DepthNet.of(model)
    return Onnx(model) if model.endswith(".onnx") else Program(model, flags)


def main():
    a = argparse.ArgumentParser(description=__doc__)
    a.add_argument("model", help="depth.onnx, a checkpoint .pt, or the program tmpi for the full pipeline of `tmpi depth`")
    a.add_argument("--mirrored", action="store_true", help="average with the map of the mirrored picture, for a file or checkpoint; use --flip for the program")
    a.add_argument("--area", type=int, default=AREA, help="input pixels for a file or checkpoint; use --depth-pixels for the program")
    a.add_argument("--part", choices=["all", "choose", "wide", "report"], default="report", help="report: pictures that select nothing; choose: pictures that select checkpoints; wide: choose with further sets; all: choose and report")
    a.add_argument("--ramp", type=float, default=0.05, help="amount of vertical ramp to add, for a file or checkpoint; use --depth-ramp for the program")
    a.add_argument("--json", action="store_true")
    a, flags = a.parse_known_args()  # the program gets the remaining arguments
    torch.set_num_threads(1)
    sets = load_sets(a.part)
    if not sets:
        print("TMPI_DATA has no pictures: nothing to measure")
        return
    net = opened(a.model, flags)
    if not isinstance(net, Program):
        net = Shipped(net, a.mirrored, a.ramp)
    result = evaluate(net, sets, area=a.area)
    # held-out labels never select a checkpoint
    objects = evaluate_things(net, sources.labels(held=True), area=a.area) if a.part in ("all", "report") else None
    if a.json:
        print(json.dumps({"sets": result, "things": objects}))
        return
    print(f"part: {a.part}\nset          pictures  RMSE/std net  ramp   Spearman net  ramp   <1.25 net  ramp")
    for k, v in result.items():
        print(f"{k:12} {v['pictures']:8}  " + "   ".join(f"{n:10.3f} {r:6.3f}" for n, r in zip(v["all"], v["all_ramp"])))
    print(f"mean {np.mean([v['net'] for v in result.values()]):.4f}")
    if objects:
        print(f"\nthings of {len(objects['pictures'])} held-out labelled photographs                      net    ramp")
        for k in objects["net"]:
            print(f"{thing_metrics.MEASURES[k]:68} {objects['net'][k]:6.3f} {objects['ramp'][k]:6.3f}")


if __name__ == "__main__":
    main()
