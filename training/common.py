"""What the three trainings share: reading scenes and photographs, crops, and what cameras and codecs do to colours."""

import json
from pathlib import Path

import cv2
import numpy as np
import torch

from paths import DATA, HERE, MODELS, RUNS  # noqa: F401 - others import them from here


def device():
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def scenes(*folders):
    """Folders of complete scenes of `tmpi-lab synth`, sorted, so that a seed means the same order everywhere."""
    found = [p.parent for f in folders for p in sorted(Path(f).glob("*/scene.json"))]
    if not found:
        raise SystemExit(f"no scenes in {folders}; see README.md for the `tmpi-lab synth` command")
    return found


def read_rgb(path):
    return cv2.cvtColor(cv2.imread(str(path), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_disparity(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / 65535


CACHE = {}


def read_pair(folder):
    """Photo and disparity of a scene, kept in memory once read."""
    if folder not in CACHE:
        CACHE[folder] = read_rgb(folder / "photo.png"), read_disparity(folder / "disparity.png").astype(np.float16)
    rgb, d = CACHE[folder]
    return rgb, d.astype(np.float32)


def read_scene(folder):
    return json.loads((Path(folder) / "scene.json").read_text())


def photometric(rgb, disparity, rng):
    """Colours, light, focus, noise and compression of a photograph, on a uint8 picture; the focus follows the map, which is finite."""
    x = rgb.astype(np.float32)
    if rng.random() < 0.5:
        lab = cv2.cvtColor(x / 255, cv2.COLOR_RGB2LAB)
        mean, std = lab.mean((0, 1)), lab.std((0, 1)) + 1e-3
        want = [rng.gauss(48, 12), rng.gauss(1, 5), rng.gauss(4, 9)]
        gain = [rng.uniform(14, 28) / std[0], rng.uniform(4, 14) / std[1], rng.uniform(5, 18) / std[2]]
        gain = np.clip(gain, 0.4, [2.0, 2.5, 2.5])
        lab = (lab - mean) * gain + (0.35 * mean + 0.65 * np.array(want))
        x = np.clip(cv2.cvtColor(lab.astype(np.float32), cv2.COLOR_LAB2RGB), 0, 1) * 255
    if rng.random() < 0.12 and min(x.shape[:2]) >= 64:
        # focus on a depth: blur grows with the distance in disparity from it
        focus = np.quantile(disparity, rng.choice([0.5, 0.8, 0.95]))
        most = rng.uniform(1.5, 6.0)
        amount = np.clip(np.abs(disparity - focus) / max(1e-3, disparity.max() - disparity.min()) * 2 - 0.1, 0, 1)
        soft = cv2.GaussianBlur(x, (0, 0), most)
        mid = cv2.GaussianBlur(x, (0, 0), most / 2)
        a = cv2.GaussianBlur(amount.astype(np.float32), (0, 0), 1.0)[..., None]
        x = np.where(a < 0.5, x * (1 - 2 * a) + mid * 2 * a, mid * (2 - 2 * a) + soft * (2 * a - 1))
    gain = np.array([rng.gauss(1, 0.08) for _ in range(3)]) * rng.uniform(0.7, 1.35)
    x = 255 * np.clip(np.clip(x / 255 * gain, 0, 1), 1e-4, 1) ** rng.uniform(0.7, 1.4)
    grey = x.mean(-1, keepdims=True)
    x = grey + (x - grey) * (0 if rng.random() < 0.05 else rng.uniform(0.5, 1.5))
    if rng.random() < 0.35:
        # uneven light
        small = np.array([[rng.uniform(0.7, 1.3) for _ in range(3)] for _ in range(3)], np.float32)
        x = x * cv2.resize(small, x.shape[1::-1], interpolation=cv2.INTER_CUBIC)[..., None]
    if rng.random() < 0.4:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.3, 1.4))
    if rng.random() < 0.6:
        x = x + np.random.default_rng(rng.getrandbits(32)).normal(0, rng.uniform(1, 10), x.shape)
    x = np.clip(x, 0, 255).astype(np.uint8)
    if rng.random() < 0.4:
        ok, b = cv2.imencode(".jpg", x, [cv2.IMWRITE_JPEG_QUALITY, rng.randint(35, 95)])
        x = cv2.imdecode(b, cv2.IMREAD_COLOR) if ok else x
    return x


def framed(rgb, disparity, size, rng, closest=0.6, least=0.999, regions=()):
    """A random crop of the wanted shape, down to `closest` of the picture, flipped half of the time, at `size` = (height, width).

    NaN in the map is unknown; a pixel is known where more than the share `least` of what it covers is. `regions` are maps of numbers that are
    cropped alike. Returns colours, map, and those maps."""
    h, w = disparity.shape
    zoom = rng.uniform(closest, 1.0) if rng.random() < 0.6 else 1.0
    ch, cw = (h, h * size[1] / size[0]) if w * size[0] > h * size[1] else (w * size[0] / size[1], w)
    ch, cw = max(16, int(ch * zoom)), max(16, int(cw * zoom))
    y, x = rng.randint(0, max(0, h - ch)), rng.randint(0, max(0, w - cw))
    at = np.s_[y : y + ch, x : x + cw]
    shrink = cw > size[1]
    area, nearest = cv2.INTER_AREA, cv2.INTER_NEAREST
    rgb = cv2.resize(rgb[at], size[::-1], interpolation=area if shrink else cv2.INTER_CUBIC)
    disparity = shrunk(disparity[at], size, least) if shrink else cv2.resize(disparity[at], size[::-1], interpolation=nearest)
    maps = [rgb, disparity, *(cv2.resize(r[at], size[::-1], interpolation=nearest) for r in regions)]
    if rng.random() < 0.5:
        maps = [m[:, ::-1] for m in maps]
    return [np.ascontiguousarray(m) for m in maps]


def shrunk(disparity, size, least):
    """Mean of what is known below each pixel of a smaller map; NaN where that is no more than the share `least`."""
    known = (~np.isnan(disparity)).astype(np.float32)
    if known.all():
        return cv2.resize(disparity, size[::-1], interpolation=cv2.INTER_AREA)
    total = cv2.resize(np.nan_to_num(disparity), size[::-1], interpolation=cv2.INTER_AREA)
    share = cv2.resize(known, size[::-1], interpolation=cv2.INTER_AREA)
    return np.where(share > least, total / np.maximum(share, 1e-6), np.nan).astype(np.float32)


def chw(rgb):
    return torch.from_numpy(rgb).permute(2, 0, 1).float().div(255)
