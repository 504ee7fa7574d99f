"""Feature maps of the frozen encoders, with the maps to learn, for several crops and colours of every picture: what `depth.py` learns from.

    python cache.py [--out runs/cache] [--scenes runs/data/train …]

The encoders never change, so they need not run in every step: each picture is cropped, mirrored, scaled and coloured `--variants` times (those that are
not rendered `--real` times), run through the encoders once, and kept as float16, one file for each shape. What a record holds is a function of
the seed, the picture's name and the variant's number; an interrupted build goes on where it was. `cache.json` lists records, input files and
digests. About half a megabyte a record.
"""

import argparse
import hashlib
import json
import math
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image

import common
import loop
import manifest
import network
import sources
from paths import RUNS

# (height, width) of batches: about the pixels that the program runs at, and up to half more
SHAPES = [(128, 192), (192, 128), (160, 160), (128, 224), (224, 128), (96, 256), (160, 224), (224, 160), (192, 192)]
AREA = 128 * 192
# pictures after which an interrupted build can go on
EVERY = 50
# goes into cache.json: to be raised when the same seed gives other records
VERSION = 1


def layout(shape, channels):
    """A record: feature maps of strides 2 to 32, channels last, their statistics, and, at half of the shape, the map to learn (NaN: unknown),
    number and kind of each pixel's region."""
    h, w = shape
    maps = [(f"f{i}", "<f2", (h >> (i + 1), w >> (i + 1), c)) for i, c in enumerate(channels)]
    half, told = (h // 2, w // 2), statistics_layout(channels).descr
    return np.dtype([*maps, *told, ("value", "<f2", half), ("region", "u1", half), ("kind", "u1", half)])


def statistics_layout(channels):
    """Mean and deviation of each channel of all feature maps."""
    return np.dtype([(f"s{i}", "<f4", (2, c)) for i, c in enumerate(channels)])


def size_of(item):
    """Width and height of an item's picture."""
    if item.unit == "label":
        return json.loads(item.files[1].read_text())["size"]
    with Image.open(item.files[0]) as image:
        return image.size


def shape_for(size, rng):
    """A shape about as wide as the picture; those of the program's own number of pixels twice as often."""
    aspect = math.log(size[0] / size[1])
    weights = [math.exp(-4 * abs(aspect - math.log(w / h))) * (2 if h * w < 1.2 * AREA else 1) for h, w in SHAPES]
    return rng.choices(SHAPES, weights)[0]


def planned(items, args):
    """Where each variant of each item goes: (shape, row in that shape's file or None, row of statistics or None); and the records of each file."""
    plan, kept, statistics = [], {s: [] for s in SHAPES}, 0
    for item in items:
        size, own = size_of(item), []
        for k in range(args.variants if item.unit == "scene" else 2 if item.space == "none" else args.real):
            shape, row, told = shape_for(size, loop.stream(args.seed, "shape", item.name, k)), None, None
            if item.space != "none":
                row = len(kept[shape])
                kept[shape].append([item.name, item.group, item.space, k])
            if item.unit != "scene":
                told, statistics = statistics, statistics + 1
            own.append((shape, row, told))
        plan.append(own)
    return plan, kept, statistics


def augmented(item, sample, shape, rng):
    """A crop of the wanted shape in other colours, of a map with holes one that shows enough of it: colours, and at half of the shape map, region, kind."""
    least = 0.0 if item.sparse else 0.5
    shown = 0.02 if item.sparse else 0.4 * float(np.isfinite(sample.value).mean())
    for _ in range(20):
        rgb, value, region, kind = common.framed(sample.rgb, sample.value, shape, rng, 0.6 if item.unit == "scene" else 0.4, least, (sample.region, sample.kind))
        known = np.isfinite(value)
        if item.space == "none" or (known.mean() > shown and np.ptp(value[known]) > 0.1):
            break
    half = shape[0] // 2, shape[1] // 2
    rgb = common.photometric(rgb, np.nan_to_num(value), rng)
    return rgb, common.shrunk(value, half, least), *(cv2.resize(m, half[::-1], interpolation=cv2.INTER_NEAREST) for m in (region, kind))


def digest_of(items, args, encoders):
    """What the records are a function of."""
    told = [VERSION, args.seed, args.variants, args.real, encoders, [[i.name, i.group, i.space, i.sparse, i.unit] for i in items]]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()


def build(items, out, args, net):
    """Writes what is missing of the records."""
    out.mkdir(parents=True, exist_ok=True)
    lines, groups = manifest.listed({"pictures": {f for i in items for f in i.files}})
    encoders = {p.name: manifest.sha256(p) for p in network.FILES}
    made_of = hashlib.sha256((digest_of(items, args, encoders) + groups["pictures"]["sha256"]).encode()).hexdigest()
    progress = out / "progress.json"
    done = json.loads(progress.read_text()) if progress.exists() else {}
    if done.get("made of") != made_of:
        for f in (*out.glob("*.bin"), out / "cache.json"):
            f.unlink(missing_ok=True)
        done = {"made of": made_of}
    (plan, kept, statistics), channels = planned(items, args), net.encoder.channels
    maps = {shape: mapped(out / file_of(shape), layout(shape, channels), len(own), True) for shape, own in kept.items()}
    bank = mapped(out / "statistics.bin", statistics_layout(channels), statistics, True)
    for n, (item, own) in enumerate(zip(items, plan)):
        if n < done.get("items", 0):
            continue
        sample = sources.read_item(item)
        for k, (shape, row, told) in enumerate(own):
            rgb, value, region, kind = augmented(item, sample, shape, loop.stream(args.seed, "variant", item.name, k))
            found = net.features(((common.chw(rgb) - network.MEAN) / network.STD)[None])
            parts = [torch.stack([f.mean((0, 2, 3)), f.std((0, 2, 3)) + 1e-4]).numpy() for f in found]
            if told is not None:
                at = bank[told]
                for i, s in enumerate(parts):
                    at[f"s{i}"][:] = s
            if row is not None:
                at = maps[shape][row]
                for i, (f, s) in enumerate(zip(found, parts)):
                    at[f"f{i}"][:], at[f"s{i}"][:] = f[0].permute(1, 2, 0).numpy(), s
                at["value"][:], at["region"][:], at["kind"][:] = value, region, kind
        if (n + 1) % EVERY == 0 or n + 1 == len(items):
            for m in (*maps.values(), bank):
                if m is not None:
                    m.flush()
            done["items"] = n + 1
            manifest.write(progress, done)
            print(f"{n + 1} of {len(items)} pictures", flush=True)
    kept = {f"{s[0]}x{s[1]}": own for s, own in kept.items() if own}
    files = {f.name: manifest.sha256(f) for f in sorted(out.glob("*.bin"))}
    about = {"version": VERSION, "made of": made_of, "seed": args.seed, "variants": args.variants, "real": args.real, "channels": channels}
    about |= {"encoders": encoders, "versions": manifest.versions(), "files": files, "statistics": statistics, "records": kept}
    (out / "inputs.sha256").write_text("\n".join(lines) + "\n")
    manifest.write(out / "cache.json", about)
    print(f"{out}: {sum(map(len, kept.values()))} records of {len(items)} pictures, {sum(f.stat().st_size for f in out.glob('*.bin')) / 1e9:.1f} GB")


def file_of(shape):
    return f"{shape[0]}x{shape[1]}.bin"


def mapped(path, dtype, count, create=False):
    """An array of records in a file, or None of none."""
    if count == 0:
        return None
    mode = "r" if not create else "r+" if Path(path).exists() else "w+"
    return np.memmap(path, dtype, mode, shape=(count,))


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("--scenes", nargs="*", default=[str(RUNS / "data" / "train")])
    a.add_argument("--out", type=Path, default=RUNS / "cache")
    a.add_argument("--variants", type=int, default=4, help="of each rendered scene")
    a.add_argument("--real", type=int, default=24, help="of each photograph with a map")
    a.add_argument("--without", nargs="*", default=[], help="leave out pictures whose names begin so, such as train2/pairs")
    a.add_argument("--beside", type=Path, help="only pictures with a map that this finished cache does not have, such as labels made since")
    a.add_argument("--threads", type=int, default=1)
    a.add_argument("--seed", type=int, default=1)
    a = a.parse_args()
    torch.set_num_threads(a.threads)
    cv2.setNumThreads(1)
    items = [*(sources.scenes(a.scenes) if a.scenes else ()), *sources.labels(held=False), *sources.gathered()]
    items = [i for i in items if not i.name.startswith(tuple(a.without))] if a.without else items
    if a.beside:
        known = {r[0] for own in json.loads((a.beside / "cache.json").read_text())["records"].values() for r in own}
        items = [i for i in items if i.space != "none" and i.name not in known]
    net = network.DepthNet().eval()
    a.out.mkdir(parents=True, exist_ok=True)
    net.use_runtime(a.out / "encoders.onnx", a.threads)
    build(items, a.out, a, net)


if __name__ == "__main__":
    main()
