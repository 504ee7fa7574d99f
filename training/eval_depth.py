"""Real pictures: affine-aligned disparity RMSE over its standard deviation, the network against the best vertical ramp."""

import argparse
import json

import cv2
import numpy as np
import torch

import common
from common import DATA
from depth import MEAN, STD, DepthNet

# pixels of the network's input that it was trained for
AREA = 160 * 224


def size_for(h, w, area=AREA):
    """Multiples of 32 of about the picture's shape (1:3 to 3:1) and of `area` pixels."""
    r = min(max(w / h, 1 / 3), 3)
    return max(2, round((area / r) ** 0.5 / 32)) * 32, max(2, round((area * r) ** 0.5 / 32)) * 32


def load_sets(quick=False):
    """Name → list of (rgb, disparity, valid). Empty where the data is not there."""
    sets = {}
    def add(name, rgb, d, valid):
        if rgb.shape[1] > 640:
            s = 640 / rgb.shape[1]
            size = (640, round(rgb.shape[0] * s))
            rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        if d.shape != rgb.shape[:2]:
            size = rgb.shape[1::-1]
            d = cv2.resize(d, size, interpolation=cv2.INTER_NEAREST)
            valid = cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        sets.setdefault(name, []).append((rgb, d.astype(np.float64), valid))

    for f in sorted((DATA / "depth_pred" / "adampi").glob("*.jpg")):
        d = cv2.imread(str(f.with_name(f.stem + "_disp16.png")), -1).astype(np.float32)
        add("adampi", common.read_rgb(f), d, np.ones(d.shape, bool))
    for f in sorted((DATA / "stereo_gt").iterdir() if (DATA / "stereo_gt").exists() else []):
        if not (f / "disp_left.png").exists():
            continue
        left = next(p for p in sorted(f.iterdir()) if p.stem in ("left", "im0", "view1", "im2"))
        d = cv2.imread(str(f / "disp_left.png"), -1).astype(np.float32)
        add("middlebury", common.read_rgb(left), d, d > 0)
    depth_sets = [("replica", *p) for p in replica()] + [("kitchen", *p) for p in kitchen(14 if quick else 28)]
    for name, photo, depth in depth_sets:
        z = cv2.imread(str(depth), -1).astype(np.float32)
        valid = (z > 0) & (z < 65535)
        add(name, common.read_rgb(photo), 1 / np.maximum(z, 1), valid)
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


def aligned(p, t, valid):
    """RMSE of the best affine map of p to t, over the deviation of t."""
    p, t = p[valid], t[valid]
    a = np.stack([p, np.ones_like(p)], 1)
    fit = a @ np.linalg.lstsq(a, t, rcond=None)[0]
    return float(np.sqrt(np.mean((fit - t) ** 2)) / max(t.std(), 1e-12))


@torch.no_grad()
def predict(net, rgb, areas=(AREA,), flip=False):
    h, w = rgb.shape[:2]
    total = 0
    for area in areas:
        th, tw = size_for(h, w, area)
        small = cv2.resize(rgb, (tw, th), interpolation=cv2.INTER_AREA if tw < w else cv2.INTER_LINEAR)
        x = ((common.chw(small) - MEAN) / STD)[None]
        p = net(x)
        if flip:
            p = 0.5 * (p + net(x.flip(3)).flip(3))
        p = p[0, 0].double().numpy()
        p = (p - np.median(p)) / max(1e-9, np.abs(p - np.median(p)).mean())
        total = total + cv2.resize(p, (w, h), interpolation=cv2.INTER_LINEAR)
    return total / len(areas)


def evaluate(net, sets, **how):
    result = {}
    for name, pictures in sets.items():
        net_error, ramp_error = [], []
        for rgb, d, valid in pictures:
            net_error.append(aligned(predict(net, rgb, **how), d, valid))
            rows = np.repeat(np.arange(d.shape[0], dtype=np.float64)[:, None], d.shape[1], 1)
            ramp_error.append(aligned(rows, d, valid))
        result[name] = {"net": float(np.mean(net_error)), "ramp": float(np.mean(ramp_error)), "pictures": len(pictures)}
    return result


class Onnx:
    """The exported network with the interface of the module."""

    def __init__(self, path):
        import onnxruntime as ort

        options = ort.SessionOptions()
        options.intra_op_num_threads = 1
        self.session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    def __call__(self, x):
        return torch.from_numpy(self.session.run(None, {"image": x.numpy()})[0])


def main():
    a = argparse.ArgumentParser(description=__doc__)
    a.add_argument("model", help="depth.onnx, or a checkpoint .pt")
    a.add_argument("--flip", action="store_true")
    a.add_argument("--areas", type=int, nargs="+", default=[AREA])
    a.add_argument("--json", action="store_true")
    a = a.parse_args()
    torch.set_num_threads(1)
    sets = load_sets()
    if not sets:
        print("TMPI_DATA is not there: nothing to measure")
        return
    if a.model.endswith(".pt"):
        net = DepthNet().eval()
        net.decoder.load_state_dict(torch.load(a.model, weights_only=False)["decoder"])
    else:
        net = Onnx(a.model)
    result = evaluate(net, sets, flip=a.flip, areas=a.areas)
    if a.json:
        print(json.dumps(result))
        return
    print("set          pictures  net    ramp")
    for k, v in result.items():
        print(f"{k:12} {v['pictures']:8}  {v['net']:.3f}  {v['ramp']:.3f}")


if __name__ == "__main__":
    main()
