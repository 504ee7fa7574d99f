#!/usr/bin/env python3
"""How far near things move against far ones, by block matching: per photo, as a share of its width.

    python3 benches/parallax.py [--program target/release/tmpi] [--also OTHER_PROGRAM] PHOTO...

Makes each photo, draws both ends of the way that it swings by itself, and matches blocks of one view in the other: what the 97th and
the 3rd percentile of all blocks that are found again both ways lie apart. Beside it, the pixels of both views that nothing covers, the
bytes of the container, and what DepthFlow's default horizontal preset moves by its formula: an offset of 0.8 half heights to either
side, times a height of 0.2. `--also` measures a second program, say that of an earlier version. Needs numpy and Pillow.
"""
import argparse
import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

# width that views are drawn in, side of a block, and how far it is looked for: pixels, and shares of the width
WIDTH, BLOCK, REACH, ACROSS = 640, 24, 0.2, 2
# a block needs so much contrast (grey levels), and may differ by so much of it
CONTRAST, DIFFERENT, BACK = 6.0, 0.5, 1.5
ENDS = (3, 97)


def matched(a, b, y, x, reach):
    """Way of the block of `a` at (y, x) to its best place in `b`, below a pixel, and the difference left there."""
    block = a[y:y + BLOCK, x:x + BLOCK]
    best, rows = None, range(max(0, y - ACROSS), min(b.shape[0] - BLOCK, y + ACROSS) + 1)
    first, last = max(0, x - reach), min(b.shape[1] - BLOCK, x + reach)
    for row in rows:
        strip = np.lib.stride_tricks.sliding_window_view(b[row:row + BLOCK, first:last + BLOCK], BLOCK, axis=1)
        cost = np.abs(strip - block[:, None, :]).mean(axis=(0, 2))
        at = int(cost.argmin())
        if best is None or cost[at] < best[1]:
            shift = 0.0
            if 0 < at < len(cost) - 1:
                left, middle, right = cost[at - 1:at + 2]
                bend = left - 2 * middle + right
                shift = 0.5 * (left - right) / bend if bend > 1e-6 else 0.0
            best = (first + at + shift - x, float(cost[at]))
    return best


def near_against_far(a, b):
    """Percentiles' distance of the ways of all blocks, as a share of the width, and how many blocks were found."""
    reach, ways = int(REACH * a.shape[1]), []
    for y in range(ACROSS, a.shape[0] - BLOCK - ACROSS, BLOCK):
        for x in range(0, a.shape[1] - BLOCK, BLOCK):
            contrast = a[y:y + BLOCK, x:x + BLOCK].std()
            if contrast < CONTRAST:
                continue
            way, cost = matched(a, b, y, x, reach)
            there = int(round(x + way))
            if cost > DIFFERENT * contrast or not 0 <= there <= a.shape[1] - BLOCK:
                continue
            if abs(matched(b, a, y, there, reach)[0] + way) <= BACK:
                ways.append(way)
    if not ways:
        return float("nan"), 0
    low, high = np.percentile(ways, ENDS)
    return (high - low) / a.shape[1], len(ways)


def measured(program, photo):
    """Near against far, uncovered share at both ends, bytes, and the container's own account."""
    with tempfile.TemporaryDirectory() as folder:
        made, frame = f"{folder}/a.tmpi", f"{folder}/f.png"
        run = lambda *args: subprocess.run([program, *args], check=True, capture_output=True, text=True).stdout
        run("make", str(photo), "-o", made)
        about = json.loads(run("info", made, "--json"))
        height = round(WIDTH * about["height"] / about["width"])
        run("render", made, "-o", frame, "--path", "swing", "--frames", "4", "--size", f"{WIDTH}x{height}")
        ends = [Image.open(f"{folder}/f-000{i}.png").convert("RGBA") for i in (2, 4)]
        grey = [np.asarray(end.convert("L"), dtype=np.float32) for end in ends]
        bare = np.mean([np.asarray(end)[..., 3] < 128 for end in ends])
        travel = about.get("travel", about["view_box"])["x"]
        return (*near_against_far(*grey), bare, Path(made).stat().st_size, travel, height / WIDTH)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--program", default="target/release/tmpi")
    parser.add_argument("--also", action="append", default=[], help="another program, measured before it")
    parser.add_argument("photos", nargs="+", type=Path)
    args = parser.parse_args()
    programs = [*args.also, args.program]
    print("near against far between the ends, % of the width; uncovered %; bytes; half the way\n")
    sums = []
    for photo in args.photos:
        cells, row = [], []
        for program in programs:
            way, blocks, bare, size, travel, aspect = measured(program, photo)
            cells.append(f"{100 * way:5.2f} %  {100 * bare:.3f} %  {size:8d} B  ±{travel:.3f} ({blocks} blocks)")
            row += [way, bare, size]
        flow = 2 * 0.8 * 0.2 * aspect / 2
        sums.append([*row, flow])
        print(f"{photo.name:24.24}  {'  |  '.join(cells)}  |  DepthFlow {100 * flow:5.2f} %", flush=True)
    mean = np.nanmean(np.array(sums), axis=0)
    spread = np.nanstd(np.array(sums), axis=0)
    print("\nmean    " + "  |  ".join(f"{100 * mean[i]:5.2f} % (± {100 * spread[i]:.2f})  {100 * mean[i + 1]:.3f} %  {mean[i + 2]:8.0f} B"
                                  for i in range(0, len(mean) - 1, 3)) + f"  |  DepthFlow {100 * mean[-1]:5.2f} %")


if __name__ == "__main__":
    main()
