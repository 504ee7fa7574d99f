"""Everything that the depth network is trained on, by what its maps mean: rendered scenes, labels by eye, sensors, stereo, published maps.

Maps are float32 [H, W] with larger values nearer and NaN where nothing is known. What they mean is their `space`:

    disparity   inverse distance up to scale and shift (metric depth is inverted)
    depth       one minus distance up to scale and shift
    order       nothing but what is nearer than what
    none        no map: the picture only lends the statistics of its features
"""

import csv
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

import common
from label_paint import paint, read  # label files of both kinds
from paths import DATA, HERE


# numbers of what a region is, in the maps `kind`
NOTHING, SKY, GROUND, SURFACE, THING, PLANT = range(6)
KINDS = {"sky": SKY, "ground": GROUND, "water": GROUND, "wall": SURFACE, "building": SURFACE, "background": SURFACE, "plant": PLANT}
KINDS |= {k: THING for k in ("object", "person", "animal", "vehicle")}
# one label in so many is never trained on
HELD = 5
# pictures that are not trained on though their rows allow it, by the beginning of their path below TMPI_DATA, and why
LEFT_OUT = {
    folder: "some are under the terms of Unsplash, Pexels or Pixabay, which speak against collecting for machine learning; which ones its rows do not tell"
    for folder in ("train2/photos/elementary/", "train2/photos/imaginary/")
}


@dataclass(frozen=True)
class Item:
    """A picture to train on: its name, the group that its share goes to, the space of its map, and the files that it is read from."""

    name: str
    group: str
    space: str
    files: tuple
    sparse: bool = False  # single points instead of a map
    unit: str = "scene"


@dataclass
class Sample:
    """Colours u8 [H, W, 3], the map float32 [H, W] in 0..1 with NaN where unknown, number and kind of the region of each pixel u8 [H, W], 0 for none; and
    the numbers of the regions that were drawn as lines: thin things."""

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
    """Whether the label of a photograph is only measured on: of its path alone, so that new labels move none."""
    return int(hashlib.sha256(photo.encode()).hexdigest()[:8], 16) % HELD == 0


def is_left_out(photo):
    """Whether a picture, by its path below TMPI_DATA, is not trained on, whatever its row says: see `LEFT_OUT`."""
    return photo.startswith(tuple(LEFT_OUT))


def labels(held, folder=HERE / "labels"):
    """Labelled photographs: those to train on, or those held out."""
    found = []
    for file in sorted(Path(folder).glob("*.json")):
        photo = json.loads(file.read_text())["photo"]
        if held_out(photo) == held and (held or not is_left_out(photo)):
            found.append(Item(f"label/{file.stem}", "label", "disparity", (DATA / photo, file), unit="label"))
    return found


def gathered(root=DATA / "train2"):
    """The pictures of `train2`, of those rows alone that may be trained on, without those that are left out."""
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
    """The picture and its map."""
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
        # inverse depth up to an offset, of which 0 is the farthest, not unknown
        value = raw
    if value.shape != rgb.shape[:2]:
        value = cv2.resize(value, rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    return Sample(rgb, ranged(value), none, none)


def ranged(value):
    """A map up to scale: its few nearest values to 1."""
    top = np.nanpercentile(value, 99.5) if np.isfinite(value).any() else 1
    return np.clip(value / max(top, 1e-12), 0, 1).astype(np.float32)


def kinds(label, names):
    """Number of what each region is; in files that only tell things from sky, the backdrop and what slants in two directions are surfaces."""
    found = [KINDS.get(k, NOTHING) for k in names]
    for i, region in enumerate(label["regions"]):
        if "sha256" not in label and found[i + 1] == THING and (region["outline"] == "all" or len(region.get("metres", ())) > 2):
            found[i + 1] = SURFACE
    return np.uint8(found)


def labelled(label):
    """A labelled photograph at the label's size."""
    told = paint(label)
    rgb = cv2.imread(str(DATA / label["photo"]))
    if left := label.get("left"):
        rgb = rgb[:, : int(rgb.shape[1] * left)]
    rgb = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_BGR2RGB), told["region"].shape[::-1], interpolation=cv2.INTER_AREA)
    if told["region"].max() > 255:
        raise SystemExit(f"{label['photo']}: more than 255 regions")
    value = ranged(np.where(told["known"], told["disparity"], np.nan))
    region = told["region"].astype(np.uint8)
    lines = tuple(n for n, r in enumerate(label["regions"], 1) if "line" in r)
    return Sample(rgb, value, region, kinds(label, told["kind"])[region], lines)
