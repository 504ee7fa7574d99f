"""Labels photographs by hand: LABELLING.md explains how, `rasterise_labels.py` describes the format and how outlines are found.

    python label_tool.py view PHOTO... [--zoom | --at X,Y,WIDTH]      # shows it with a coordinate grid; --zoom: also its four quarters, twice as large
    python label_tool.py put PHOTO [--horizon Y] [--second] < REGIONS     # writes the label file and paints it; --second: NAME.b.json
    python label_tool.py paint LABEL... [--at X,Y,WIDTH]                # draws outlines, names and disparity
    python label_tool.py check [LABEL...]                               # checks these or all files; fails if one has a fault
    python label_tool.py sheet [LABEL...]                               # contact sheets
    python label_tool.py agree                                          # compares NAME.b.json with NAME.json

PHOTO is relative to TMPI_DATA (train2/photos/azure/dog.jpg) or a path. Pictures go to `runs/label`, or to the folder of `-o`.
"""

import argparse
import hashlib
import json
import sys
from pathlib import Path

import cv2
import numpy as np

from paths import DATA, HERE, RUNS
from rasterise_labels import KINDS, LabelError, is_old, paint, photo, read, shape

LABELS = HERE / "labels"
# longer side of displayed pictures, so that one pixel is one unit of coordinates
LONG = 1000
FIELDS = set("name kind area box disc line width hole reach metres foot on bulge front note".split())


def text(canvas, words, at, size=0.42):
    for thick, colour in ((3, (0, 0, 0)), (1, (0, 255, 255))):
        cv2.putText(canvas, words, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, thick, cv2.LINE_AA)


def gridded(picture, window, step):
    """Draws a grid every `step` units over the picture; `window` is its x0, y0, width, height in coordinates."""
    h, w = picture.shape[:2]
    x0, y0, across, down = window
    over = picture.copy()
    columns = [(x, round((x - x0) * w / across)) for x in range(-(-int(x0) // step) * step, int(x0 + across) + 1, step)]
    rows = [(y, round((y - y0) * h / down)) for y in range(-(-int(y0) // step) * step, int(y0 + down) + 1, step)]
    for at, (dx, dy) in [((c, 0), (0, h)) for _, c in columns] + [((0, r), (w, 0)) for _, r in rows]:
        cv2.line(over, at, (at[0] + dx, at[1] + dy), (255, 255, 255), 1)
        beside = at[0] + (dx == 0), at[1] + (dy == 0)
        cv2.line(over, beside, (beside[0] + dx, beside[1] + dy), (0, 0, 0), 1)
    out = cv2.addWeighted(over, 0.4, picture, 0.6, 0)
    for value, c in columns:
        for y in (12, h - 4):
            text(out, str(value), (min(c + 3, w - 30), y))
    for value, r in rows[1:]:
        for x in (3, w - 30):
            text(out, str(value), (x, r - 3))
    return out


def window_of(picture, words=None):
    """The part of a picture to show, in coordinates and as pixel slices."""
    h, w = picture.shape[:2]
    scale = max(h, w) / 1000
    if not words:
        return (0, 0, w / scale, h / scale), (slice(0, h), slice(0, w))
    x, y, across = (float(v) for v in words.split(","))
    x0, y0 = int(np.clip(x * scale, 0, w - 8)), int(np.clip(y * scale, 0, h - 8))
    x1, y1 = min(round(x0 + across * scale), w), min(round(y0 + across * scale), h)
    return (x0 / scale, y0 / scale, (x1 - x0) / scale, (y1 - y0) / scale), (slice(y0, y1), slice(x0, x1))


def enlarged(picture, long=LONG, how=cv2.INTER_CUBIC):
    factor = long / max(picture.shape[:2])
    return cv2.resize(picture, None, fx=factor, fy=factor, interpolation=how)


def find_photo(name):
    """Path of a photo, and its name in TMPI_DATA."""
    path = Path(name) if Path(name).exists() else DATA / name
    if not path.exists():
        raise LabelError(f"{name}: no such photo")
    return path, path.resolve().relative_to(DATA.resolve()).as_posix()


def view(a):
    for name in a.photos:
        path, below = find_photo(name)
        picture, stem = cv2.imread(str(path)), f"{path.parent.name}-{path.stem}"
        window, at = window_of(picture, a.at)
        files = [a.out / f"{stem}.view.png"]
        cv2.imwrite(str(files[0]), gridded(enlarged(picture[at]), window, 50 if a.at else 100))
        if a.zoom:
            across, down = window[2:]
            for k, (x, y) in enumerate((x, y) for y in (0, 0.45 * down) for x in (0, 0.45 * across)):
                part, at = window_of(picture, f"{x},{y},{0.55 * max(across, down)}")
                files.append(a.out / f"{stem}.view{k + 1}.png")
                cv2.imwrite(str(files[-1]), gridded(enlarged(picture[at]), part, 50))
        print(below, *files)


def regions_of(words):
    """Parses regions, one JSON object after another, optionally separated by commas."""
    decoder, out, at = json.JSONDecoder(), [], 0
    while at < len(words):
        if words[at] in ", \n\t":
            at += 1
            continue
        try:
            region, at = decoder.raw_decode(words, at)
        except json.JSONDecodeError as e:
            raise LabelError(f"region {len(out) + 1}: {e.msg} at {words[e.pos : e.pos + 60]!r}") from e
        out.append(region)
    return out


def put(a):
    path, below = find_photo(a.photo)
    picture = cv2.imread(str(path))
    file = LABELS / f"{path.parent.name}-{path.stem}{'.b' if a.second else ''}.json"
    label = {"photo": below, "sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "size": list(picture.shape[1::-1])}
    label |= {"horizon": json.loads(a.horizon) if a.horizon and "," not in a.horizon else a.horizon, "regions": regions_of(sys.stdin.read())}
    if wrong := list(format_errors(label)):
        raise LabelError("\n".join(wrong))
    head = json.dumps({k: v for k, v in label.items() if k != "regions"}, ensure_ascii=False)[:-1]
    body = ",\n".join("  " + json.dumps(r, ensure_ascii=False) for r in label["regions"])
    file.write_text(f'{head}, "regions": [\n{body}\n]}}\n')
    print(file)
    a.labels = [file]
    painted(a)


def colours(count):
    hues = np.uint8([[[(i * 67) % 180, 255, 255] for i in range(count)]])
    return cv2.cvtColor(hues, cv2.COLOR_HSV2BGR)[0].tolist()


def drawn(picture, ids, names, long, at):
    """Draws outlines and names of regions over the photo."""
    small = ids[at].astype(np.uint8)
    out = enlarged(picture[at], long)
    big = cv2.resize(small, out.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    hue = colours(len(names))
    for i in range(1, len(names) + 1):
        found, _ = cv2.findContours((big == i).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(out, found, -1, hue[i - 1], 1)
    out[big == 0] = (255, 0, 255)
    for i, name in enumerate(names):
        deep = cv2.distanceTransform(np.pad((big == i + 1).astype(np.uint8), 1), cv2.DIST_L2, 3)
        if deep.max() > 0:
            y, x = np.unravel_index(deep.argmax(), deep.shape)
            text(out, name, (max(2, int(x) - 4 * len(name)), int(y) + 4))
    return out


def heat(done, at, shape_):
    """Disparity as perceptually uniform colours; green is unknown."""
    d, known = done["disparity"], done["known"] | ((done["region"] > 0) & (np.array(done["kind"])[done["region"]] != "unknown"))
    top = np.percentile(d[known], 99.5) if known.any() else 1
    # the square root makes far regions visible
    out = cv2.applyColorMap((255 * np.clip(d / max(top, 1e-9), 0, 1) ** 0.5).astype(np.uint8), cv2.COLORMAP_INFERNO)
    out[~known] = (0, 128, 0)
    return cv2.resize(out[at], shape_, interpolation=cv2.INTER_NEAREST)


def metres(values):
    return " to ".join("far" if v < 1e-6 else f"{1 / v:.3g}" for v in dict.fromkeys(np.percentile(values, (98, 2))))


def painted(a):
    for file in a.labels:
        label = read(file)
        picture, done = photo(label), paint(label)
        window, at = window_of(picture, a.at)
        wide = window[2] > 1.15 * window[3]
        names = [r["name"] for r in label["regions"]]
        left = gridded(drawn(picture, done["region"], names, LONG if wide or window[3] > 1.15 * window[2] else 800, at), window, 50 if a.at else 100)
        right = heat(done, at, left.shape[1::-1])
        out = a.out / f"{Path(file).stem}.paint.png"
        cv2.imwrite(str(out), np.vstack([left, right]) if wide else np.hstack([left, right]))
        for i, name in enumerate(names):
            inside = done["region"] == i + 1
            value = metres(done["disparity"][inside]) if inside.any() else "EMPTY"
            print(f"  {i + 1:2} {name:24} {done['kind'][i + 1]:8} {100 * inside.mean():5.1f} %  {value} m")
        for level, fault in faults(label, done):
            print(f"  {level}: {fault}")
        print(out)


def touching(ids, a, b):
    """Pixels of each of two regions within 3 pixels of the other."""
    around = np.ones((7, 7), np.uint8)
    masks = [(ids == k).astype(np.uint8) for k in (a, b)]
    return (cv2.dilate(masks[1], around) & masks[0]) > 0, (cv2.dilate(masks[0], around) & masks[1]) > 0


def islands(label, ids):
    """Spots where the background region shows between others, possibly by mistake."""
    unit = 1000 / max(label["size"])
    for i, region in enumerate(label["regions"]):
        if region.get("area") != "all":
            continue
        count, _, stats, centres = cv2.connectedComponentsWithStats((ids == i + 1).astype(np.uint8), connectivity=4)
        order = np.argsort(-stats[1:, cv2.CC_STAT_AREA])[1:6] + 1
        for k in order:
            if (part := stats[k, cv2.CC_STAT_AREA] / ids.size) > 0.001:
                x, y = np.round(centres[k] * unit).astype(int)
                yield "look", f"{region['name']} shows through around {x},{y} ({100 * part:.1f} %)"


def faults(label, done):
    """Yields faults ("fault") and suspicious spots ("look") of a label, as pairs."""
    ids, disparity = done["region"], done["disparity"]
    regions = label["regions"]
    if (bare := (ids == 0).mean()) > 0.02:
        yield "fault", f"{100 * bare:.0f} % in no region; the first region may be \"area\": \"all\""
    if done["known"].mean() < 0.5:
        yield "fault", f"only {100 * done['known'].mean():.0f} % known"
    numbers = {}
    for i, region in enumerate(regions):
        name, inside = region["name"], ids == i + 1
        if not inside.any():
            yield "look" if is_old(label) else "fault", f"{name}: empty"
            continue
        numbers[name] = i + 1
        if is_old(label):
            continue
        count, _, stats, _ = cv2.connectedComponentsWithStats(inside.astype(np.uint8), connectivity=8)
        size = np.sort(stats[1:, cv2.CC_STAT_AREA])
        speck = size[size < 60].sum() / size.sum()
        if count > 12 and speck > 0.1:
            yield "fault", f"{name}: speckled, {100 * speck:.0f} % in {int((size < 60).sum())} islands"
        if region["kind"] not in ("sky", "unknown") and np.median(disparity[inside]) < 1e-6:
            yield "fault", f"{name}: infinitely far, which only sky may be (is its foot at the horizon?)"
        if inside.mean() > 0.01 and region.get("area") not in (None, "all"):
            rough = shape(region, label["size"]) > 0
            hidden = np.isin(ids, np.arange(i + 2, len(regions) + 1))
            if (moved := ((rough ^ inside) & ~hidden).sum() / inside.sum()) > 0.3:
                yield "look", f"{name}: {100 * moved:.0f} % of it moved at its outline"
    if is_old(label):
        return
    yield from islands(label, ids)
    for i, region in enumerate(regions):
        behind = region.get("front", [])
        for other in [behind] if isinstance(behind, str) else behind:
            if other not in numbers or region["name"] not in numbers:
                yield "fault", f"{region['name']}: in front of {other}, which is not there"
                continue
            mine, its = touching(ids, i + 1, numbers[other])
            if not mine.any():
                mine, its = ids == i + 1, ids == numbers[other]
            near, far = np.median(disparity[mine]), np.median(disparity[its])
            if near < far * 0.9:
                yield "fault", f"{region['name']} ({metres(near)} m) is not in front of {other} ({metres(far)} m)"
    declared = {(r["name"], o) for r in regions for o in np.atleast_1d(r.get("front", []))}
    for i, region in enumerate(regions):
        for k in range(i):
            if region["kind"] == "unknown" or regions[k]["kind"] == "unknown" or (region["name"], regions[k]["name"]) in declared:
                continue
            mine, its = touching(ids, i + 1, k + 1)
            if mine.sum() > 40 and np.median(disparity[mine]) < 0.8 * np.median(disparity[its]):
                near, far = (metres(np.median(disparity[m])) for m in (its, mine))
                yield "look", f"{region['name']} is painted over {regions[k]['name']}, and farther there: {far} m, {near} m"


def format_errors(label):
    """Yields errors in the text of a label."""
    names = [r.get("name") for r in label["regions"]]
    if len(set(names)) < len(names) or None in names:
        yield "names must exist and differ"
        return
    for r in label["regions"]:
        if r.get("kind") not in KINDS:
            yield f"{r['name']}: kind {r.get('kind')!r}; known kinds are {', '.join(KINDS)}"
        if unknown := set(r) - FIELDS:
            yield f"{r['name']}: no field {', '.join(sorted(unknown))}"
        if not {"area", "box", "disc", "line"} & set(r):
            yield f"{r['name']}: no shape"
    if not label["regions"]:
        yield "no regions"


def checked(file):
    """Faults of a label file, and the painted label if it can be painted."""
    try:
        label = read(file)
        if not is_old(label):
            if wrong := list(format_errors(label)):
                return [("fault", w) for w in wrong], None
            path = DATA / label["photo"]
            if not path.exists() or hashlib.sha256(path.read_bytes()).hexdigest() != label["sha256"]:
                return [("fault", f"{label['photo']}: not there, or not the photo that was labelled")], None
        done = paint(label)
        return list(faults(label, done)), done
    except (LabelError, KeyError, TypeError, ValueError) as e:
        return [("fault", f"{type(e).__name__}: {e}")], None


def check(a):
    files = [Path(f) for f in a.labels] or sorted(LABELS.glob("*.json"))
    bad, known = 0, []
    for file in files:
        found, done = checked(file)
        bad += any(level == "fault" for level, _ in found)
        for level, what in found:
            if level == "fault":
                print(f"{file.name}: {what}")
        if done is not None:
            known.append(done["known"].mean())
    print(f"{len(files)} files, {bad} with faults, {100 * np.mean(known or [0]):.0f} % of their pixels known")
    return 1 if bad else 0


def sheet(a):
    files = [Path(f) for f in a.labels] or sorted(LABELS.glob("*.json"))
    cell, per = 240, 20
    for s in range(0, len(files), per):
        out = np.full((5 * (cell + 16), 4 * 2 * cell, 3), 255, np.uint8)
        for k, file in enumerate(files[s : s + per]):
            label = read(file)
            picture, done = photo(label), paint(label)
            _, at = window_of(picture)
            small = drawn(picture, done["region"], [""] * len(label["regions"]), cell, at)
            y, x = k // 4 * (cell + 16), k % 4 * 2 * cell
            out[y : y + small.shape[0], x : x + small.shape[1]] = small
            out[y : y + small.shape[0], x + cell : x + cell + small.shape[1]] = heat(done, at, small.shape[1::-1])
            cv2.putText(out, file.stem, (x + 2, y + cell + 11), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
        print(a.out / f"sheet{s // per + 1}.png")
        cv2.imwrite(str(a.out / f"sheet{s // per + 1}.png"), out)


def agree(a):
    """Compares the two labels of photographs that have two."""
    rows = []
    for second in sorted(LABELS.glob("*.b.json")):
        first = second.with_name(second.name.replace(".b.json", ".json"))
        if not first.exists():
            continue
        p, q = paint(read(first)), paint(read(second))
        both = p["known"] & q["known"]
        d, e = p["disparity"][both].astype(np.float64), q["disparity"][both].astype(np.float64)
        # up to scale and shift, as the network learns, relative to the range of the first
        scale, shift = np.polyfit(e, d, 1)
        spread = np.percentile(d, 99.5) - np.percentile(d, 0.5)
        off = np.abs(d - scale * e - shift).mean() / max(spread, 1e-9)
        picks = np.random.default_rng(0).integers(0, len(d), (20000, 2))
        order = [np.sign((v[picks[:, 0]] - v[picks[:, 1]]) * (np.abs(v[picks[:, 0]] - v[picks[:, 1]]) > 0.02 * np.ptp(v))) for v in (d, e)]
        clear = (order[0] != 0) & (order[1] != 0)
        edges = [jumps(m["disparity"]) for m in (p, q)]
        met = [near(edges[k], edges[1 - k]) for k in (0, 1)]
        rows.append((off, np.corrcoef(d, e)[0, 1], (order[0] == order[1])[clear].mean(), 2 * met[0] * met[1] / max(sum(met), 1e-9)))
        print(f"{first.stem:32} off {100 * off:5.1f} %  correlation {rows[-1][1]:.3f}  order {100 * rows[-1][2]:5.1f} %  borders within 2 px {100 * rows[-1][3]:3.0f} %")
    if rows:
        off, alike, order, border = np.mean(rows, 0)
        print(f"{'mean of ' + str(len(rows)):32} off {100 * off:5.1f} %  correlation {alike:.3f}  order {100 * order:5.1f} %  borders within 2 px {100 * border:3.0f} %")


def jumps(disparity):
    """Pixels where disparity jumps by a twentieth of its range."""
    around = np.ones((2, 2), np.uint8)
    return cv2.dilate(disparity, around) - cv2.erode(disparity, around) > 0.05 * np.percentile(disparity, 99.5)


def near(these, those):
    """Fraction of `these` pixels within 2 pixels of `those`."""
    return (cv2.distanceTransform((~those).astype(np.uint8), cv2.DIST_L2, 5)[these] <= 2).mean() if these.any() and those.any() else 0.0


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=RUNS / "label")
    commands = parser.add_subparsers(required=True)
    of_labels = (("paint", painted, "labels"), ("check", check, "labels"), ("sheet", sheet, "labels"))
    for name, run, many in (("view", view, "photos"), ("put", put, None), *of_labels, ("agree", agree, None)):
        c = commands.add_parser(name)
        c.set_defaults(run=run)
        if many:
            c.add_argument(many, nargs="+" if name in ("view", "paint") else "*")
        if name == "view":
            c.add_argument("--zoom", action="store_true")
        if name in ("view", "paint", "put"):
            c.add_argument("--at", help="show only this part: x, y of its corner and its width, in coordinates")
        if name == "put":
            c.add_argument("photo")
            c.add_argument("--horizon")
            c.add_argument("--second", action="store_true", help="a second label by a person who has not seen the first")
    a = parser.parse_args()
    a.out.mkdir(parents=True, exist_ok=True)
    try:
        return a.run(a)
    except LabelError as e:
        print(e, file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
