"""Contact sheets for a blind comparison of two depth networks: photo, depth maps, and views from the left.

    python blind.py PROGRAM BEFORE.onnx AFTER.onnx [--count 24] [--seed 1] [-o runs/blind]     # writes sheets, and key.json, which stays secret
    python blind.py --count-of runs/blind/judged.csv                                           # counts the judgements

The seed selects photographs in TMPI_DATA that no training uses. `judged.csv` has a line `number,side,objects,sky,ground` for each side (A, B) of each
photograph, with y, n, or - if the photograph has none.
"""

import argparse
import csv
import json
import random
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np

from paths import DATA, RUNS

FOLDERS = ("photos/imagenet", "photos/bsds_train", "photos/mlsharp", "photos/tmpi")
COLUMNS = ("objects", "sky", "ground")
WIDTH, HEIGHT = 300, 225
# to the left, in nearest distances
POSE = "-0.06,0,0"


def made(program, network, photo):
    """Depth map and view from the left, both BGR."""
    run = lambda *command: subprocess.run([program, *map(str, command)], check=True, stdout=subprocess.DEVNULL)
    how = ["--quiet", "--depth-model", f"tmpi={network}"]
    with tempfile.TemporaryDirectory() as folder:
        container, depth, view = (Path(folder) / n for n in ("a.tmpi", "depth.png", "view.png"))
        run("depth", *how, "-o", depth, photo)
        run("make", *how, "-o", container, photo)
        run("render", container, f"--pose={POSE}", "-o", view)
        near, view = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED), cv2.imread(str(view))
    near = np.uint8(255.0 * (near - near.min()) / max(int(near.max()) - int(near.min()), 1))
    return cv2.applyColorMap(near, cv2.COLORMAP_INFERNO), view


def fitted(picture):
    """Fits a picture into a grey cell."""
    scale = min(WIDTH / picture.shape[1], HEIGHT / picture.shape[0])
    small = cv2.resize(picture, (round(picture.shape[1] * scale), round(picture.shape[0] * scale)), interpolation=cv2.INTER_AREA)
    cell = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    cell[: small.shape[0], : small.shape[1]] = small
    return cell


def sheets(args):
    rng = random.Random(args.seed)
    photos = sorted(p for f in FOLDERS for p in (DATA / f).iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
    chosen = sorted(rng.sample(photos, args.count))
    args.out.mkdir(parents=True, exist_ok=True)
    key, rows = [], []
    for n, photo in enumerate(chosen):
        swapped = rng.random() < 0.5
        pairs = [made(args.program, network, photo) for network in args.networks]
        a, b = reversed(pairs) if swapped else pairs
        row = np.hstack([fitted(p) for p in (cv2.imread(str(photo)), a[0], b[0], a[1], b[1])])
        cv2.putText(row, f"{n} photo | A | B | A from the left | B from the left", (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
        rows.append(row)
        key.append({"photo": str(photo.relative_to(DATA)), "A": "after" if swapped else "before"})
        if len(rows) == args.rows or n + 1 == len(chosen):
            cv2.imwrite(str(args.out / f"sheet-{n // args.rows}.png"), np.vstack(rows))
            rows = []
    (args.out / "key.json").write_text(json.dumps(key, indent=1))


def count(judged):
    """Prints how often each network was right, among photographs that have objects, sky or ground."""
    key = json.loads((judged.parent / "key.json").read_text())
    found = {network: {c: [0, 0] for c in COLUMNS} for network in ("before", "after")}
    with open(judged, newline="") as f:
        for row in csv.DictReader(f):
            is_after = (row["side"] == "A") == (key[int(row["number"])]["A"] == "after")
            for c in COLUMNS:
                if row[c] in ("y", "n"):
                    found["after" if is_after else "before"][c][0] += row[c] == "y"
                    found["after" if is_after else "before"][c][1] += 1
    for network, columns in found.items():
        print(network, ", ".join(f"{c} {right} of {of}" for c, (right, of) in columns.items()))


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("program", nargs="?")
    a.add_argument("networks", nargs="*")
    a.add_argument("--count", type=int, default=24)
    a.add_argument("--rows", type=int, default=6)
    a.add_argument("--seed", type=int, default=1)
    a.add_argument("--count-of", type=Path)
    a.add_argument("-o", "--out", type=Path, default=RUNS / "blind")
    args = a.parse_args()
    if args.count_of:
        count(args.count_of)
    elif args.program and len(args.networks) == 2:
        sheets(args)
    else:
        a.error("needs a program and two networks, or --count-of")


if __name__ == "__main__":
    main()
