"""Which photographs to label next: those of which the decoders of a network say the most different things, with sheets to look at.

    python active.py                                     # the network that ships: its decoders, on pictures and their mirror images
    python active.py runs/m1/best.pt runs/m2/best.pt     # or several networks
    python active.py --check                             # on labelled photographs held out: does what they disagree on tell where they are wrong?

Of `train2/photos` those that may be trained on, have no label yet, and whose label would not be held out. `runs/active/list.tsv` has them in order, the
worst first; the sheets show the first ones: photo, mean map, and where the voices disagree. Look, label where the map is wrong, train, and ask again:
what it disagrees on least may be wrong all the same, so look at `--last` now and then.
"""

import argparse
import json

import cv2
import numpy as np
import torch

import common
import sources
from blind import fitted
from eval_depth import predict, scores
from network import DepthNet, decoders
from paths import DATA, HERE, MODELS, RUNS


def voices(files):
    """Networks of one decoder each."""
    found = []
    for f in map(str, files):
        if f.endswith(".onnx"):
            found += [DepthNet.exported(f, nth) for nth in range(-decoders(f), 0)]
        else:
            found.append(DepthNet.of(torch.load(f, weights_only=False, map_location="cpu")))
    return found


def heard(nets, rgb):
    """What each says of a picture and of its mirror image, each with mean 0 and deviation 1 [N, H, W]."""
    turned = np.ascontiguousarray(rgb[:, ::-1])
    maps = np.stack([m for net in nets for m in (predict(net, rgb), predict(net, turned)[:, ::-1])])
    maps = maps - maps.mean((1, 2), keepdims=True)
    return maps / np.maximum(maps.std((1, 2), keepdims=True), 1e-9)


def disagreement(maps):
    """Where the maps say different things: their deviation from pixel to pixel [H, W]."""
    return maps.std(0)


def unlabelled():
    """Photographs that a label would be trained on, and that have none."""
    done = {json.loads(f.read_text())["photo"] for f in (HERE / "labels").glob("*.json")}
    return [i.files[0] for i in sources.gathered() if i.group == "photo" and str(i.files[0].relative_to(DATA)) not in done]


def small(rgb):
    """At most 640 pixels wide."""
    return rgb if rgb.shape[1] <= 640 else cv2.resize(rgb, (640, round(rgb.shape[0] * 640 / rgb.shape[1])), interpolation=cv2.INTER_AREA)


def check(nets):
    """Prints how the disagreement of labelled photographs goes with their error."""
    told, wrong = [], []
    for item in sources.labels(held=True):
        sample = sources.read_item(item)
        known = np.isfinite(sample.value)
        if known.sum() < 100:
            continue
        maps = heard(nets, sample.rgb)
        told.append(float(disagreement(maps).mean()))
        wrong.append(scores(maps.mean(0), np.nan_to_num(sample.value.astype(np.float64)), known)[0])
    told, wrong = np.array(told), np.array(wrong)
    rank = lambda v: np.argsort(np.argsort(v))
    half = len(told) // 2
    order = np.argsort(-told)
    print(f"{len(told)} held-out labelled photographs, {len(nets)} decoders")
    print(f"rank correlation of disagreement and error: {np.corrcoef(rank(told), rank(wrong))[0, 1]:.2f}")
    print(f"error / deviation of the half with more disagreement: {wrong[order[:half]].mean():.3f}, of the other: {wrong[order[half:]].mean():.3f}")


def sheets(nets, args):
    photos = unlabelled()
    found = []
    for photo in photos:
        rgb = small(common.read_rgb(photo))
        found.append((float(disagreement(heard(nets, rgb)).mean()), photo))
    found.sort(key=lambda f: -f[0])
    args.out.mkdir(parents=True, exist_ok=True)
    with open(args.out / "list.tsv", "w") as f:
        f.writelines(f"{score:.4f}\t{photo.relative_to(DATA)}\n" for score, photo in found)
    print(f"{len(found)} photographs without a label; {args.out / 'list.tsv'}")
    shown = found[-args.count :] if args.last else found[: args.count]
    for start in range(0, len(shown), args.rows):
        rows = []
        for n, (score, photo) in enumerate(shown[start : start + args.rows], start):
            rgb = small(common.read_rgb(photo))
            maps = heard(nets, rgb)
            cells = [cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), coloured(maps.mean(0)), coloured(disagreement(maps), 1.0)]
            row = np.hstack([fitted(c) for c in cells])
            cv2.putText(row, f"{n} {score:.2f} {photo.relative_to(DATA)}", (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
            rows.append(row)
        cv2.imwrite(str(args.out / f"sheet-{start // args.rows}.png"), np.vstack(rows))


def coloured(p, top=None):
    """A map as a picture, BGR: its range, or 0 to `top`."""
    low, high = (p.min(), p.max()) if top is None else (0.0, top)
    return cv2.applyColorMap(np.uint8(255 * np.clip((p - low) / max(high - low, 1e-9), 0, 1)), cv2.COLORMAP_INFERNO)


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("networks", nargs="*", help="checkpoints and exported networks; without any, the one that ships")
    a.add_argument("--check", action="store_true", help="hold the disagreement against the error on held-out labels")
    a.add_argument("--count", type=int, default=36, help="photographs on the sheets")
    a.add_argument("--rows", type=int, default=6)
    a.add_argument("--last", action="store_true", help="sheets of those that the voices agree on most")
    a.add_argument("-o", "--out", type=common.Path, default=RUNS / "active")
    args = a.parse_args()
    torch.set_num_threads(1)
    nets = voices(args.networks or [MODELS / "depth.onnx"])
    with torch.no_grad():
        check(nets) if args.check else sheets(nets, args)


if __name__ == "__main__":
    main()
