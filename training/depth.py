"""Trains the decoder of the monocular depth network on cached feature maps (`cache.py`): rendered scenes, photographs labelled by eye, and gathered depth."""

import argparse
import bisect
import hashlib
import itertools
import json

import numpy as np
import torch

import cache
import common
import losses
import loop
from network import DepthNet, MobileNetV2, Shipped
from paths import RUNS

# share of a batch that each group of pictures makes, where there are any
SHARES = {"scene": 0.5, "label": 0.22, "rgbd": 0.1, "stereo": 0.02, "pairs:depth": 0.12, "pairs:disparity": 0.02, "pairs:order": 0.02}
# how often a family of scenes is drawn: photographs have more ground in them than `tmpi-lab synth` has by itself
FAMILIES = {
    "room": 0.14, "corridor": 0.03, "lounge": 0.09, "kitchen": 0.08, "street": 0.09, "field": 0.17, "water": 0.05, "terrain": 0.03, "crowd": 0.04,
    "thin": 0.02, "foliage": 0.02, "shelf": 0.06, "heap": 0.06, "table": 0.08, "closeup": 0.05, "drape": 0.03, "figures": 0.04, "floating": 0.01,
    "inside": 0.05,
}  # fmt: skip
# share of a picture's worst pixels that counts for nothing: rendered disparity is exact, the rest is not; and the weight of its gradients, by how
# well edges of the map lie on those of the photo
TRUST = {"scene": (0.0, 1.0), "label": (0.05, 1.0), "rgbd": (0.1, 0.3), "stereo": (0.2, 0.1), "pairs:depth": (0.05, 0.5), "pairs:disparity": (0.1, 0.5)}


def first_labels(records, count):
    """Names of the labels of `count` photographs (none: of all), each choice within the larger ones: the order is that of digests."""
    photo = lambda name: name.removesuffix(".b")  # labelled a second time
    names = {name for name, group, _, _ in records if group == "label"}
    some = set(sorted(set(map(photo, names)), key=lambda name: hashlib.sha256(name.encode()).digest())[:count])
    return {name for name in names if photo(name) in some}


class Records:
    """Batches of the cache: what a step gets is a function of the seed and the step."""

    def __init__(self, folders, seed, batch, shares=SHARES, both=True, labels=None, families=FAMILIES):
        self.families = families
        self.folders, self.seed, self.batch = [common.Path(f) for f in folders], seed, batch
        for folder in self.folders:
            if not (folder / "cache.json").exists():
                raise SystemExit(f"{folder}: no finished cache; see cache.py")
        about = [json.loads((f / "cache.json").read_text()) for f in self.folders]
        self.channels = about[0]["channels"]
        # MobileNetV2's channels stand before YOLOX's
        self.used = self.channels if both else MobileNetV2.CHANNELS
        # records of a shape: those of each cache in turn; `maps` are their files, and the row at which each begins
        kept, self.maps, counts = {}, {}, {}
        some = first_labels(itertools.chain(*(v for known in about for v in known["records"].values())), labels)
        for folder, known in zip(self.folders, about):
            for name, records in known["records"].items():
                shape = tuple(map(int, name.split("x")))
                own = cache.mapped(folder / cache.file_of(shape), cache.layout(shape, self.channels), len(records))
                self.maps.setdefault(shape, []).append((len(kept.get(shape, [])), own))
                kept[shape] = kept.get(shape, []) + records
        learnt = lambda r: r[1] != "label" or r[0] in some
        for _, group, _, _ in filter(learnt, itertools.chain(*kept.values())):
            counts[group] = counts.get(group, 0) + 1
        weight = {g: self.share(g, counts, shares) / n for g, n in counts.items()}
        self.shapes = list(kept)
        self.sums = {s: list(itertools.accumulate(weight[r[1]] if learnt(r) else 0 for r in v)) for s, v in kept.items()}
        self.groups = {s: [(r[1].split(":")[0] if r[1].startswith("scene") else r[1], r[2]) for r in v] for s, v in kept.items()}
        banks = (cache.mapped(f / "statistics.bin", cache.statistics_layout(self.channels), k["statistics"]) for f, k in zip(self.folders, about))
        self.bank = np.concatenate([b for b in banks if b is not None])

    def share(self, group, counts, shares):
        """Share of a group, or of a family of scenes, in all batches."""
        name = group.split(":")[0] if group.startswith("scene") else group
        if not group.startswith("scene"):
            return shares.get(name, 0)
        family = {k: v for k, v in self.families.items() if f"scene:{k}" in counts}
        return shares.get("scene", 0) * family[group.split(":")[1]] / sum(family.values())

    def at(self, step):
        """Feature maps [N, C, h, w], channels last, their statistics [N, 2, C], the map to learn [N, H, W], regions and kinds of it, and (group, space)
        of each picture. Every batch has about as many pixels."""
        rng = loop.stream(self.seed, "batch", step)
        shape = rng.choices(self.shapes, [self.sums[s][-1] for s in self.shapes])[0]
        sums, count = self.sums[shape], max(4, round(self.batch * cache.AREA / (shape[0] * shape[1])))
        rows = sorted(min(bisect.bisect(sums, rng.random() * sums[-1]), len(sums) - 1) for _ in range(count))
        own = [(m, [r - start for r in rows if start <= r < start + len(m)]) for start, m in self.maps[shape]]
        got = np.concatenate([m[r] for m, r in own if r])
        features = [torch.from_numpy(got[f"f{i}"][..., :c].astype(np.float32)).permute(0, 3, 1, 2) for i, c in enumerate(self.used)]
        own = [torch.from_numpy(got[f"s{i}"][:, :, :c].copy()) for i, c in enumerate(self.used)]
        told = [torch.from_numpy(got[k].astype(t)) for k, t in (("value", np.float32), ("region", np.int64), ("kind", np.int64))]
        return features, own, *told, [self.groups[shape][r] for r in rows]

    def statistics(self):
        """Channel means and deviations of photographs: per level [N, 2, C]."""
        return [torch.from_numpy(self.bank[f"s{i}"][:, :, :c].copy()) for i, c in enumerate(self.used)]

    def inputs(self):
        return {"cache": [f for folder in self.folders for f in (folder / "cache.json", folder / "inputs.sha256", *sorted(folder.glob("*.bin")))]}


def restyled(features, own, bank):
    """Half of the samples get channel statistics on the way to those of a photograph, the same one at every level.

    What the colours and textures of rendered scenes do to the frozen encoders then matters less (MixStyle, Zhou et al. 2021)."""
    n = features[0].shape[0]
    share = torch.distributions.Beta(0.3, 0.3).sample((n, 1))
    share = torch.where(torch.rand(n, 1) < 0.5, torch.ones(()), share)
    pick, out = torch.randint(len(bank[0]), (n,)), []
    for f, s, b in zip(features, own, bank):
        mean, std = s.unbind(1)
        to_mean, to_std = b[pick].unbind(1)
        gain = share + (1 - share) * to_std / std
        shift = share * mean + (1 - share) * to_mean - mean * gain
        out.append(torch.addcmul(shift[..., None, None], f, gain[..., None, None]))
    return out


def loss_of(p, value, region, kind, of, generator, weights):
    """Sum of all that is known of a batch, and its parts: means over the batch's pictures; p is [N, H, W]."""
    parts = {}

    def some(wanted):
        return [i for i, (g, s) in enumerate(of) if wanted(g, s)]

    def add(name, per_picture):
        parts[name] = parts.get(name, 0.0) + per_picture.sum() / len(of)

    for space, known in (("disparity", losses.disparity), ("depth", losses.depth)):
        if at := some(lambda g, s: s == space):
            trim, sharp = torch.tensor([TRUST[of[i][0]] for i in at]).unbind(1)
            error, gradients = known(p[at], value[at], trim)
            add("error", error)
            add("gradient", gradients * sharp)
    if at := some(lambda g, s: s == "order"):
        add("order", losses.order(p[at], value[at], generator))
    if at := some(lambda g, s: g == "label"):
        wrong, broken = losses.things(p[at], value[at], region[at], kind[at])
        add("border", wrong)
        add("whole", broken)
        add("sky", losses.sky(p[at], kind[at]))
    return {"loss": sum(weights[k] * v for k, v in parts.items()), **parts}


# weight of each part of the loss
WEIGHTS = {"error": 1.0, "gradient": 1.0, "order": 1.0, "border": 1.0, "whole": 0.5, "sky": 0.5}


def main():
    a = argparse.ArgumentParser(description=__doc__)
    a.add_argument("--cache", nargs="+", default=[str(RUNS / "cache")], help="folders of cache.py, the later ones built --beside the first")
    a.add_argument("--out", default=str(RUNS / "depth"))
    a.add_argument("--batch", type=int, default=16, help="pictures of 128 × 192; of larger ones fewer")
    a.add_argument("--lr", type=float, default=2e-3)
    a.add_argument("--style", choices=["off", "photos"], default="photos", help="whether channel statistics of photographs are mixed in")
    a.add_argument("--shares", nargs="*", default=[], metavar="GROUP=SHARE", help="other shares of a batch than SHARES")
    a.add_argument("--families", nargs="*", default=[], metavar="FAMILY=SHARE", help="other shares of the scenes than FAMILIES")
    a.add_argument("--labels", type=int, metavar="N", help="only so many of the labelled photographs, to see what more of them are worth")
    a.add_argument("--weights", nargs="*", default=[], metavar="PART=WEIGHT", help="other weights of the loss than WEIGHTS")
    a.add_argument("--encoder", choices=["mobilenet", "both"], default="both", help="MobileNetV2, or with YOLOX-nano beside it")
    a.add_argument("--ramp", type=float, default=0.05, help="share of the vertical ramp by which checkpoints are measured: the program's for photos")
    a.add_argument("--drop", type=float, default=0.15, help="share of the encoders' channels that each sample goes without")
    a.add_argument("--ema", type=float, default=0.998, help="decay of the mean over weights")
    a.add_argument("--init", help="checkpoint whose weights to begin with, their running mean, or an exported network")
    a.add_argument("--decay", type=float, default=1e-2, help="weight decay of the decoder")
    a.add_argument("--tune", type=float, default=0.0, metavar="GAIN", help="share of the rate at which MobileNetV2's later stages learn too; 0: they are frozen")
    loop.arguments(a, steps=20000, seed=1, every=1000)
    a = a.parse_args()
    import eval_depth  # here, because it reads real pictures

    told = lambda given, known: {**known, **{k: float(v) for k, v in (g.split("=") for g in given)}}
    records = Records(a.cache, a.seed, a.batch, told(a.shares, SHARES), a.encoder == "both", a.labels, told(a.families, FAMILIES))
    weights, bank = told(a.weights, WEIGHTS), records.statistics() if a.style == "photos" else None
    loop.seed_all(a.seed)
    net = DepthNet(a.encoder == "both", a.drop)
    net.decoder.to(memory_format=torch.channels_last)
    inputs = records.inputs() | {"encoders": cache.network.FILES}
    if a.init:
        inputs["start"] = [a.init]
        if a.init.endswith(".onnx"):
            net.decoder.take(a.init, (records.at(-step)[0] for step in range(1, 17)))
        else:
            net.load(torch.load(a.init, weights_only=False))
    slow = net.encoder.classifier.unfreeze() if a.tune else []
    out = common.Path(a.out)
    out.mkdir(parents=True, exist_ok=True)
    if not a.tune:
        net.use_runtime(out / "encoders.onnx", a.threads)
    sets = eval_depth.load_sets("wide")
    inputs["chosen by"] = eval_depth.files("wide")

    def loss_at(step):
        features, own, value, region, kind, of = records.at(step)
        features = features if bank is None else restyled(features, own, bank)
        features = net.retaken(features) if a.tune else features
        generator = torch.Generator().manual_seed(loop.stream(a.seed, "pairs", step).getrandbits(60))
        return loss_of(net.decoder.half(features)[:, 0], value, region, kind, of, generator, weights)

    def measure(mean):
        live = net.decoder
        net.decoder = live if a.tune else mean
        found = {k: v["net"] for k, v in eval_depth.evaluate(Shipped((mean if a.tune else net).eval(), a.ramp), sets).items()}
        net.decoder = live
        return found | ({"score": float(np.mean(list(found.values())))} if found else {})

    plan = loop.Plan(steps=a.steps, lr=a.lr, weight_decay=a.decay, ema=a.ema, every=a.every, seed=a.seed, threads=a.threads)
    options = loop.remaining(a, "cache", "init", "decay") | {"init": bool(a.init)}
    loop.train(out, plan, net if a.tune else net.decoder, loss_at, inputs, options, measure, a.stop, slow=slow, gain=a.tune)


if __name__ == "__main__":
    main()
