"""Pictures in the memory of a device, and the batches that are cut out of them there."""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

# (height, width) of batches, about the pixels that the program runs at, and how often each is drawn
SHAPES = {(192, 256): 0.4, (192, 288): 0.15, (160, 288): 0.12, (224, 224): 0.12, (256, 192): 0.15, (288, 192): 0.06}
# share of a batch that each group of pictures makes, where there are any
SHARES = {"scene": 0.45, "label": 0.22, "rgbd": 0.09, "stereo": 0.02, "pairs:depth": 0.08, "pairs:disparity": 0.02, "pairs:order": 0.02, "photo": 0.1}
# how often a family of scenes is drawn: photographs have more ground in them than `tmpi-lab synth` has by itself
FAMILIES = {
    "room": 0.14, "corridor": 0.03, "lounge": 0.09, "kitchen": 0.08, "street": 0.09, "field": 0.17, "water": 0.05, "terrain": 0.03, "crowd": 0.04,
    "thin": 0.02, "foliage": 0.02, "shelf": 0.06, "heap": 0.06, "table": 0.08, "closeup": 0.05, "drape": 0.03, "figures": 0.04, "floating": 0.01,
    "inside": 0.1,
}  # fmt: skip
# a crop has at least this share of its picture's height or width
CLOSEST = 0.5
# tries to find a picture about as wide as the batch
TRIES = 4


@dataclass
class Held:
    """A picture on the device: colours u8 [3, H, W], map f16 [H, W] with NaN where unknown, number of each pixel's region u8 [H, W] or None, kind of
    each region, and the share of a crop's map that has to be known for it to count."""

    space: str
    rgb: torch.Tensor
    value: torch.Tensor
    region: torch.Tensor | None
    kinds: torch.Tensor | None
    sparse: bool
    shown: float


@dataclass
class Batch:
    """Colours [N, 3, H, W] in 0..1; at half of that size the map to learn with NaN where unknown, number and kind of regions; what crops show enough
    to count [N]; group and space of each picture."""

    rgb: torch.Tensor
    value: torch.Tensor
    region: torch.Tensor
    kind: torch.Tensor
    good: torch.Tensor
    of: list

    def where(self, wanted):
        """Numbers of the pictures whose group and space `wanted` says yes to."""
        return [i for i, (group, space) in enumerate(self.of) if wanted(group, space)]


class Pictures:
    """All pictures that are learnt from, by group; of a photograph with two labels each counts half."""

    def __init__(self, device):
        self.device, self.groups = device, {}  # of each group (name, pictures): more than one where it was labelled again

    def add(self, packed):
        """A [`pack.Packed`]."""
        send = lambda a, dtype: torch.from_numpy(np.ascontiguousarray(a)).to(self.device, dtype)
        labelled = bool(packed.region.any())
        known = float(np.isfinite(packed.value).mean())
        held = Held(
            packed.space, send(packed.rgb.transpose(2, 0, 1), torch.uint8), send(packed.value, torch.float16),
            send(packed.region, torch.uint8) if labelled else None, send(packed.kinds, torch.uint8) if labelled else None,
            packed.sparse, 0.02 if packed.sparse else 0.4 * known,
        )  # fmt: skip
        own, name = self.groups.setdefault(packed.group, []), packed.name.removesuffix(".b")
        again = next((n for n in own if n[0] == name), None) if packed.group == "label" else None
        if again is not None:
            again[1].append(held)
        else:
            own.append((name, [held]))

    def count(self, group):
        """Of pictures in a group, or in all families of scenes."""
        return sum(len(v) for g, v in self.groups.items() if g.split(":")[0] == group or g == group)

    def shares(self):
        """Groups and families that there are, and how often each is drawn."""
        families = {g: FAMILIES[g.removeprefix("scene:")] for g in self.groups if g.startswith("scene:")}
        total = sum(families.values())
        found = {g: SHARES["scene"] * v / total for g, v in families.items()}
        return found | {g: SHARES[g] for g in self.groups if g in SHARES}

    def drawn(self, shape, group, rng):
        """A picture of a group; such as are about as wide as the batch are drawn more often."""
        for _ in range(TRIES):
            held = rng.choice(rng.choice(self.groups[group])[1])
            off = math.log(held.rgb.shape[2] / held.rgb.shape[1] * shape[0] / shape[1])
            if rng.random() < math.exp(-4 * abs(off)):
                break
        return held

    def batch(self, count, rng):
        """A batch, which is a function of the pictures that there are and of `rng`."""
        shares = self.shares()
        shape = rng.choices(list(SHAPES), SHAPES.values())[0]
        groups = sorted(rng.choices(list(shares), shares.values(), k=count))
        held = [self.drawn(shape, g, rng) for g in groups]
        crops = [cropped(h, shape, rng) for h in held]
        rgb, value, region, kind, good = (torch.stack(part) for part in zip(*crops))
        return Batch(rgb, value, region, kind, good, [(g.split(":")[0] if g.startswith("scene") else g, h.space) for g, h in zip(groups, held)])


def frame(size, shape, rng):
    """Top, left, height and width of a random crop of about the wanted shape."""
    (h, w), (to_h, to_w) = size, shape
    zoom = rng.uniform(CLOSEST, 1) if rng.random() < 0.6 else 1
    aspect = to_w / to_h * math.exp(rng.uniform(-0.12, 0.12) if rng.random() < 0.5 else 0)
    crop_h, crop_w = (h, h * aspect) if w > h * aspect else (w / aspect, w)
    crop_h, crop_w = min(h, max(16, int(crop_h * zoom))), min(w, max(16, int(crop_w * zoom)))
    return rng.randint(0, h - crop_h), rng.randint(0, w - crop_w), crop_h, crop_w


def cropped(held, shape, rng):
    """Colours [3, H, W], map, region and kind [H / 2, W / 2] of a random crop, mirrored half of the time; and whether it shows enough to count."""
    y, x, h, w = frame(held.value.shape, shape, rng)
    half = shape[0] // 2, shape[1] // 2
    cut = lambda m: m[..., y : y + h, x : x + w].float()
    rgb = F.interpolate(cut(held.rgb)[None] / 255, shape, mode="bilinear", antialias=True)[0].clamp(0, 1)
    value = cut(held.value)
    total, share = F.interpolate(torch.stack([value.nan_to_num(0), value.isfinite().float()])[None], half, mode="area")[0]
    known = share > (0 if held.sparse else 0.5)
    value = torch.where(known, total / share.clamp_min(1e-6), torch.nan)
    span = torch.where(known, value, -torch.inf).amax() - torch.where(known, value, torch.inf).amin()
    good = (known.float().mean() > held.shown) & (span > 0.05)
    region = torch.zeros(half, device=rgb.device, dtype=torch.int64)
    kind = region
    if held.region is not None:
        region = F.interpolate(cut(held.region)[None, None], half, mode="nearest-exact")[0, 0].long()
        kind = held.kinds[region].long()
    maps = [rgb, value, region, kind]
    return *([m.flip(-1) for m in maps] if rng.random() < 0.5 else maps), good.float()
