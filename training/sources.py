"""All training data of the depth network: rendered scenes, hand-made labels, sensors, stereo, published maps.

Maps are float32 [H, W]; larger values are nearer, NaN is unknown. `space` says what the values mean:

    disparity   inverse distance up to scale and shift (metric depth is inverted)
    depth       one minus distance up to scale and shift
    order       only which of two pixels is nearer
    none        no map: the picture contributes only feature statistics
"""

import csv
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

import common
from paths import DATA, HERE
from rasterise_labels import paint, read  # label files of both formats


# kinds of regions, in the maps `kind`
NOTHING, SKY, GROUND, SURFACE, THING, PLANT = range(6)
KINDS = {"sky": SKY, "ground": GROUND, "water": GROUND, "wall": SURFACE, "building": SURFACE, "background": SURFACE, "plant": PLANT}
KINDS |= {k: THING for k in ("object", "person", "animal", "vehicle")}
# one in this many labels is never used for training
HELD = 5
# pictures that are excluded although their rows allow training, by path prefix in TMPI_DATA, with the reason
LEFT_OUT = {
    folder: "some are under the terms of Unsplash, Pexels or Pixabay, which forbid collecting for machine learning; the index does not say which ones"
    for folder in ("train2/photos/elementary/", "train2/photos/imaginary/")
}


@dataclass(frozen=True)
class Item:
    """A picture to train on: its name, its group, the space of its map, and its files."""

    name: str
    group: str
    space: str
    files: tuple
    sparse: bool = False  # the map has only single points
    unit: str = "scene"


@dataclass
class Sample:
    """Colours u8 [H, W, 3]; map float32 [H, W] in 0..1, NaN where unknown; region number and kind of each pixel u8 [H, W], 0 for none; and the numbers
    of regions drawn as lines, which are thin things."""

    rgb: np.ndarray
    value: np.ndarray
    region: np.ndarray
    kind: np.ndarray
    lines: tuple = ()


def scenes(folders):
    return [
        Item(f"scene/{f.name}", f"scene:{common.read_scene(f)['family']}", "disparity", (f / "photo.png", f / "disparity.png"))
        for f in common.scenes(*folders)
    ]


def held_out(photo):
    """Whether a photograph's label is only for evaluation; depends only on its path, so that new labels do not change it."""
    return int(hashlib.sha256(photo.encode()).hexdigest()[:8], 16) % HELD == 0


def is_left_out(photo):
    """Whether a picture, by its path in TMPI_DATA, is excluded from training; see `LEFT_OUT`."""
    return photo.startswith(tuple(LEFT_OUT))


def labels(held, folder=HERE / "labels"):
    """Labelled photographs: those for training, or the held-out ones."""
    found = []
    for file in sorted(Path(folder).glob("*.json")):
        photo = json.loads(file.read_text())["photo"]
        if held_out(photo) == held and (held or not is_left_out(photo)):
            found.append(Item(f"label/{file.stem}", "label", "disparity", (DATA / photo, file), unit="label"))
    return found


def gathered(root=DATA / "train2"):
    """The pictures in `train2` whose rows allow training, without the excluded ones."""
    found = []
    if not (root / "INDEX.tsv").exists():
        return found
    with open(root / "INDEX.tsv", newline="") as f:
        rows = list(csv.DictReader(f, delimiter="\t", quoting=csv.QUOTE_NONE))
    for row in rows:
        if row["train"] != "yes" or is_left_out(f"train2/{row['path']}"):
            continue
        folder, path = row["path"].split("/")[0], root / row["path"]
        name = f"train2/{row['path'].rstrip('/')}"
        if folder == "rgbd":
            mm = path.with_name(f"{path.stem}_depth_mm.png")
            depth = mm if mm.exists() else path.with_name(f"{path.stem}_disp16.png")
            found.append(Item(name, "rgbd", "disparity", (path, depth), "sparse" in row["unit"], "mm" if depth == mm else "disp16"))
        elif folder == "stereo":
            found.append(Item(name, "stereo", "disparity", (path / "left.jpg", path / "silver_disp_left.png"), unit="px"))
        elif folder == "pairs":
            space = "depth" if "DEPTH" in row["unit"] else "order" if "ordering" in row["unit"] else "disparity"
            found.append(Item(name, f"pairs:{space}", space, (path, path.with_name(f"{path.stem}_disp16.png")), unit="map"))
        elif folder == "photos" and not held_out(f"train2/{row['path']}"):
            found.append(Item(name, "photo", "none", (path,), unit="none"))
    return found


def read_item(item):
    """Reads a picture and its map."""
    rgb = common.read_rgb(item.files[0])
    none = np.zeros(rgb.shape[:2], np.uint8)
    if item.unit == "label":
        return labelled(read(item.files[1]))
    if item.unit == "none":
        return Sample(rgb, np.full(rgb.shape[:2], np.nan, np.float32), none, none)
    raw = cv2.imread(str(item.files[1]), cv2.IMREAD_UNCHANGED).astype(np.float32)
    if item.unit == "scene":
        return Sample(rgb, raw / 65535, none, none)
    if item.unit == "map":
        value = raw / 65535
    elif item.unit == "mm":
        value = np.where(raw > 0, 1 / np.maximum(raw, 1), np.nan)
    elif item.unit == "px":
        value = np.where(raw > 0, raw, np.nan)
    else:
        # inverse depth up to an offset: 0 is farthest, not unknown
        value = raw
    if value.shape != rgb.shape[:2]:
        value = cv2.resize(value, rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    return Sample(rgb, ranged(value), none, none)


def ranged(value):
    """Scales a map so that its nearest values become 1."""
    top = np.nanpercentile(value, 99.5) if np.isfinite(value).any() else 1
    return np.clip(value / max(top, 1e-12), 0, 1).astype(np.float32)


def kinds(label, names):
    """Kind of each region. Old files mark only sky; there the backdrop, and regions with three or more points, are surfaces."""
    found = [KINDS.get(k, NOTHING) for k in names]
    for i, region in enumerate(label["regions"]):
        if "sha256" not in label and found[i + 1] == THING and (region["outline"] == "all" or len(region.get("metres", ())) > 2):
            found[i + 1] = SURFACE
    return np.uint8(found)


def labelled(label):
    """Reads a labelled photograph at the label's size."""
    painted = paint(label)
    rgb = cv2.imread(str(DATA / label["photo"]))
    if left := label.get("left"):
        rgb = rgb[:, : int(rgb.shape[1] * left)]
    rgb = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_BGR2RGB), painted["region"].shape[::-1], interpolation=cv2.INTER_AREA)
    if painted["region"].max() > 255:
        raise SystemExit(f"{label['photo']}: more than 255 regions")
    value = ranged(np.where(painted["known"], painted["disparity"], np.nan))
    region = painted["region"].astype(np.uint8)
    lines = tuple(n for n, r in enumerate(label["regions"], 1) if "line" in r)
    return Sample(rgb, value, region, kinds(label, painted["kind"])[region], lines)
