"""Shared by the three trainings: reading scenes and photographs, crops, and transfers to the device."""

import functools
import json
from pathlib import Path

import cv2
import numpy as np
import torch

from paths import DATA, HERE, MODELS, RUNS  # noqa: F401 - other modules import them from here


def to_device(arrays, device):
    """Copies arrays of one dtype to the device in one transfer that does not wait for the device."""
    flat = torch.from_numpy(np.concatenate([a.ravel() for a in arrays]))
    if device.type == "cuda":
        flat = flat.pin_memory().to(device, non_blocking=True)
    return [part.view(a.shape) for part, a in zip(flat.split([a.size for a in arrays]), arrays)]


def generator(seed, device):
    """A new PyTorch random generator on the device."""
    return torch.Generator(device).manual_seed(seed)


@functools.cache
def constant(values, device):
    """Tuples of numbers as float32 on the device; cached, because a transfer from pageable memory waits for the device."""
    return torch.tensor(values, dtype=torch.float32, device=device)


def scenes(*folders):
    """Folders of complete `tmpi-lab synth` scenes, sorted, so that a seed gives the same order on every machine."""
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
    """Photo and disparity of a scene, cached in memory."""
    if folder not in CACHE:
        CACHE[folder] = read_rgb(folder / "photo.png"), read_disparity(folder / "disparity.png").astype(np.float16)
    rgb, d = CACHE[folder]
    return rgb, d.astype(np.float32)


def read_scene(folder):
    return json.loads((Path(folder) / "scene.json").read_text())


def random_crop(rgb, disparity, size, rng):
    """Random crops of picture and map with the shape of `size` = (height, width), at least .6 of the picture, mirrored half of the time."""
    h, w = disparity.shape
    zoom = rng.uniform(0.6, 1.0) if rng.random() < 0.6 else 1.0
    ch, cw = (h, h * size[1] / size[0]) if w * size[0] > h * size[1] else (w * size[0] / size[1], w)
    ch, cw = max(16, int(ch * zoom)), max(16, int(cw * zoom))
    y, x = rng.randint(0, max(0, h - ch)), rng.randint(0, max(0, w - cw))
    at = np.s_[y : y + ch, x : x + cw]
    shrink = cw > size[1]
    rgb = cv2.resize(rgb[at], size[::-1], interpolation=cv2.INTER_AREA if shrink else cv2.INTER_CUBIC)
    disparity = cv2.resize(disparity[at], size[::-1], interpolation=cv2.INTER_AREA if shrink else cv2.INTER_NEAREST)
    maps = [m[:, ::-1] for m in (rgb, disparity)] if rng.random() < 0.5 else (rgb, disparity)
    return [np.ascontiguousarray(m) for m in maps]


def shrink_map(disparity, size, least):
    """Shrinks a map by averaging known values; NaN where the known fraction is at most `least`."""
    known = (~np.isnan(disparity)).astype(np.float32)
    if known.all():
        return cv2.resize(disparity, size[::-1], interpolation=cv2.INTER_AREA)
    total = cv2.resize(np.nan_to_num(disparity), size[::-1], interpolation=cv2.INTER_AREA)
    share = cv2.resize(known, size[::-1], interpolation=cv2.INTER_AREA)
    return np.where(share > least, total / np.maximum(share, 1e-6), np.nan).astype(np.float32)


def chw(rgb):
    return torch.from_numpy(rgb).permute(2, 0, 1).float().div(255)
