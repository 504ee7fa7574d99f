"""Packs all pictures for training and checkpoint selection, except rendered scenes, into one file of about 20 MB. `depth.py` needs no other data.

    python pack.py [-o runs/pictures.zip]

Paints labels and reads maps once. Pictures have at most `LONGEST` pixels per side and are stored once, even if a photograph is in two groups, as WebP,
which takes two thirds of the size of JPEG. Maps have `STEPS` levels (0: unknown), stored as the colours of a lossless WebP; measured maps have half of the
size, at which the network learns them. Region numbers are a PNG. `index.json` lists name, group, space, whether the map has only single points, kind of
each region, and picture number.
"""

import argparse
import hashlib
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

import common
import eval_depth
import sources
from paths import RUNS

FILE = RUNS / "pictures.zip"
LONGEST = 432
# WebP quality of pictures for training, and for measurement
QUALITY, MEASURED = 80, 95
# levels of a map; 0 is unknown
STEPS = 4095
# groups, before a colon, whose maps have half of the size
HALVED = ("rgbd", "stereo", "pairs")
# group prefix of selection pictures, before the name of the set
CHOICE = "choice:"


@dataclass
class Packed:
    """A packed picture: [`sources.Sample`] with the kind of each region instead of each pixel."""

    name: str
    group: str
    space: str
    sparse: bool
    rgb: np.ndarray
    value: np.ndarray
    region: np.ndarray
    kinds: np.ndarray


def png(values):
    return cv2.imencode(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()


def webp(rgb, quality):
    """Lossless above a quality of 100."""
    return cv2.imencode(".webp", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()


def coded(value):
    """Encodes a map in 0..1 with NaN as colours u8 [H, W, 3]: low and high byte of its level."""
    code = np.where(np.isfinite(value), 1 + np.round(np.clip(np.nan_to_num(value), 0, 1) * (STEPS - 1)), 0).astype(np.uint16)
    return np.stack([code & 255, code >> 8, np.zeros_like(code)], 2).astype(np.uint8)


def decoded(rgb):
    code = rgb[..., 0] + 256 * rgb[..., 1].astype(np.float32)
    return np.where(code > 0, (code - 1) / (STEPS - 1), np.nan).astype(np.float32)


class Writer:
    """Writes a pack."""

    def __init__(self, path):
        self.file, self.index, self.pictures = zipfile.ZipFile(path, "w"), [], {}

    def add(self, name, group, space, sample, sparse=False, quality=QUALITY):
        h, w = sample.rgb.shape[:2]
        scale = min(1, LONGEST / max(h, w))
        size = max(8, round(w * scale)), max(8, round(h * scale))
        number = len(self.index)
        rgb = webp(cv2.resize(sample.rgb, size, interpolation=cv2.INTER_AREA) if scale < 1 else sample.rgb, quality)
        picture = self.pictures.setdefault(hashlib.sha256(rgb).digest(), number)
        entry = {"name": name, "group": group, "space": space, "sparse": sparse, "kinds": [], "picture": picture}
        if picture == number:
            self.file.writestr(f"{number}.webp", rgb)
        if space != "none":
            # do not interpolate between regions of a label
            if sample.region.any() or group.startswith(CHOICE):
                value = cv2.resize(sample.value, size, interpolation=cv2.INTER_NEAREST)
            else:
                size_of = [(v + 1) // 2 for v in size] if group.split(":")[0] in HALVED else size
                value = common.shrink_map(sample.value, size_of[::-1], 0.0 if sparse else 0.5)
            self.file.writestr(f"{number}.map.webp", webp(coded(value), 101))
        if sample.region.any():
            self.file.writestr(f"{number}.region.png", png(cv2.resize(sample.region, size, interpolation=cv2.INTER_NEAREST)))
            entry["kinds"] = kinds_of(sample).tolist()
        self.index.append(entry)

    def close(self):
        self.file.writestr("index.json", json.dumps(self.index))
        self.file.close()


def kinds_of(sample):
    """Kind of each region, by number."""
    kinds = np.zeros(int(sample.region.max()) + 1, np.uint8)
    kinds[sample.region.ravel()] = sample.kind.ravel()
    return kinds


def opened(path):
    """Yields all pictures of a pack in order."""
    with zipfile.ZipFile(path) as z:
        names = set(z.namelist())

        def read(name, how=cv2.IMREAD_UNCHANGED):
            return cv2.imdecode(np.frombuffer(z.read(name), np.uint8), how) if name in names else None

        def colours(name):
            return cv2.cvtColor(read(name, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB) if name in names else None

        for n, entry in enumerate(json.loads(z.read("index.json"))):
            rgb, code, region = colours(f"{entry.pop('picture')}.webp"), colours(f"{n}.map.webp"), read(f"{n}.region.png")
            size, none = rgb.shape[:2], np.zeros(rgb.shape[:2], np.uint8)
            value = np.full(size, np.nan, np.float32) if code is None else cv2.resize(decoded(code), size[::-1], interpolation=cv2.INTER_NEAREST)
            kinds = np.array(entry.pop("kinds") or [0], np.uint8)
            yield Packed(**entry, rgb=rgb, value=value, region=none if region is None else region, kinds=kinds)


def sets_of(pictures):
    """Selection pictures in the format of `eval_depth.load_sets`."""
    sets = {}
    for p in pictures:
        if p.group.startswith(CHOICE):
            sets.setdefault(p.group.removeprefix(CHOICE), []).append((p.rgb, np.nan_to_num(p.value).astype(np.float64), np.isfinite(p.value)))
    return sets


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("-o", "--out", type=Path, default=FILE)
    a.add_argument("--without", nargs="*", default=[], help="omit pictures whose names start with this, such as train2/pairs")
    a = a.parse_args()
    cv2.setNumThreads(1)
    a.out.parent.mkdir(parents=True, exist_ok=True)
    part = Path(f"{a.out}.part")
    pack = Writer(part)
    for item in [*sources.labels(held=False), *sources.gathered()]:
        if not item.name.startswith(tuple(a.without)):
            pack.add(item.name, item.group, item.space, sources.read_item(item), item.sparse)
    for name, pictures in eval_depth.load_sets("wide").items():
        for n, (rgb, d, valid) in enumerate(pictures):
            valid = valid & (d > 0)
            value = np.where(valid, d / d[valid].max(), np.nan).astype(np.float32)
            none = np.zeros(rgb.shape[:2], np.uint8)
            pack.add(f"{name}/{n}", f"{CHOICE}{name}", "disparity", sources.Sample(rgb, value, none, none), quality=MEASURED)
    pack.close()
    part.replace(a.out)
    print(f"{a.out}: {len(pack.index)} pictures, {a.out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
