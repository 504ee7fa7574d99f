"""Everything that the depth network learns from and is chosen by, but for rendered scenes, in one file of about 40 MB: `depth.py` needs no other data.

    python pack.py [-o runs/pictures.zip]

Labels are painted and maps read once. Pictures are at most `LONGEST` pixels long: JPEG, the map as PNG of `STEPS` steps (0: unknown), the numbers of its
regions as PNG. `index.json` lists them: name, group, space, whether the map is single points, kind of each region.
"""

import argparse
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
# quality of the JPEGs: of what is learnt from, and of what is measured on
QUALITY, MEASURED = 80, 95
# steps of a map, of which 0 is where nothing is known
STEPS = 4095
# group of a picture that checkpoints are chosen by, before the name of its set
CHOICE = "choice:"


@dataclass
class Packed:
    """A picture of the pack: [`sources.Sample`] with the kind of each region instead of each pixel."""

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


def jpeg(rgb, quality):
    return cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


class Writer:
    """A pack that is being written."""

    def __init__(self, path):
        self.file, self.index = zipfile.ZipFile(path, "w"), []

    def add(self, name, group, space, sample, sparse=False, quality=QUALITY):
        h, w = sample.rgb.shape[:2]
        scale = min(1, LONGEST / max(h, w))
        size = max(8, round(w * scale)), max(8, round(h * scale))
        told = {"name": name, "group": group, "space": space, "sparse": sparse, "kinds": []}
        number = len(self.index)
        rgb = cv2.resize(sample.rgb, size, interpolation=cv2.INTER_AREA) if scale < 1 else sample.rgb
        self.file.writestr(f"{number}.jpg", jpeg(rgb, quality))
        if space != "none":
            # between the regions of a label nothing is mixed
            nearest = sample.region.any() or group.startswith(CHOICE)
            value = cv2.resize(sample.value, size, interpolation=cv2.INTER_NEAREST) if nearest else common.shrunk(sample.value, size[::-1], 0.0 if sparse else 0.5)
            code = np.where(np.isfinite(value), 1 + np.round(np.clip(np.nan_to_num(value), 0, 1) * (STEPS - 1)), 0)
            self.file.writestr(f"{number}.map.png", png(code.astype(np.uint16)))
        if sample.region.any():
            self.file.writestr(f"{number}.region.png", png(cv2.resize(sample.region, size, interpolation=cv2.INTER_NEAREST)))
            told["kinds"] = kinds_of(sample).tolist()
        self.index.append(told)

    def close(self):
        self.file.writestr("index.json", json.dumps(self.index))
        self.file.close()


def kinds_of(sample):
    """Kind of each region, by its number."""
    kinds = np.zeros(int(sample.region.max()) + 1, np.uint8)
    kinds[sample.region.ravel()] = sample.kind.ravel()
    return kinds


def opened(path):
    """All pictures of a pack, in its order."""
    with zipfile.ZipFile(path) as z:
        names = set(z.namelist())

        def read(name, how=cv2.IMREAD_UNCHANGED):
            return cv2.imdecode(np.frombuffer(z.read(name), np.uint8), how) if name in names else None

        for n, told in enumerate(json.loads(z.read("index.json"))):
            rgb = cv2.cvtColor(read(f"{n}.jpg", cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
            code, region = read(f"{n}.map.png"), read(f"{n}.region.png")
            none = np.zeros(rgb.shape[:2], np.uint8)
            value = np.full(rgb.shape[:2], np.nan, np.float32) if code is None else np.where(code > 0, (code.astype(np.float32) - 1) / (STEPS - 1), np.nan)
            kinds = np.array(told.pop("kinds") or [0], np.uint8)
            yield Packed(**told, rgb=rgb, value=value, region=none if region is None else region, kinds=kinds)


def sets_of(pictures):
    """The pictures to choose by, as `eval_depth.load_sets` gives them."""
    sets = {}
    for p in pictures:
        if p.group.startswith(CHOICE):
            sets.setdefault(p.group.removeprefix(CHOICE), []).append((p.rgb, np.nan_to_num(p.value).astype(np.float64), np.isfinite(p.value)))
    return sets


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("-o", "--out", type=Path, default=FILE)
    a.add_argument("--without", nargs="*", default=[], help="leave out pictures whose names begin so, such as train2/pairs")
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
