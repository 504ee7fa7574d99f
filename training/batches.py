"""Keeps pictures in device memory and crops batches there, all pictures of a batch at once, without waiting for the device."""

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import torch

from common import to_device

# (height, width) of batches and their probability: half have about as many pixels as the program uses for rooms, the rest up to twice as many
SHAPES = {
    (192, 256): 0.16, (192, 288): 0.07, (160, 288): 0.07, (224, 224): 0.06, (256, 192): 0.09, (288, 160): 0.05,
    (256, 288): 0.08, (224, 320): 0.11, (192, 384): 0.03, (320, 224): 0.08,
    (256, 384): 0.1, (320, 320): 0.04, (384, 256): 0.06,
}  # fmt: skip
# share of a batch for each group of pictures
SHARES = {"scene": 0.45, "label": 0.22, "rgbd": 0.09, "stereo": 0.02, "pairs:disparity": 0.02, "pairs:depth": 0.08, "pairs:order": 0.02, "photo": 0.1}
# probability of each family of scenes: photographs have more ground than the default of `tmpi-lab synth`
FAMILIES = {
    "room": 0.14, "corridor": 0.03, "lounge": 0.09, "kitchen": 0.08, "street": 0.09, "field": 0.17, "water": 0.05, "terrain": 0.03, "crowd": 0.04,
    "thin": 0.02, "foliage": 0.02, "shelf": 0.06, "heap": 0.06, "table": 0.08, "closeup": 0.05, "drape": 0.03, "figures": 0.04, "floating": 0.01,
    "inside": 0.1,
}  # fmt: skip
# minimum size of a crop, as a fraction of the picture's height or width
CLOSEST = 0.5
# a picture's probability decays with the log of its aspect ratio to the batch's, and with the log of the enlargement
WIDER, ENLARGED = 4.0, 1.0
# maximum number of regions
REGIONS = 256


@dataclass
class Batch:
    """Colours [N, 3, H, W] in 0..1; at half of that size the map to learn, NaN where unknown, and number and kind of regions; which crops have enough
    known pixels [N]; group and space of each picture. Pictures of one group or space are adjacent."""

    rgb: torch.Tensor
    value: torch.Tensor
    region: torch.Tensor
    kind: torch.Tensor
    good: torch.Tensor
    of: list

    def where(self, wanted):
        """The slice of adjacent pictures whose group and space satisfy `wanted`."""
        found = [i for i, (group, space) in enumerate(self.of) if wanted(group, space)]
        if found and found[-1] - found[0] + 1 != len(found):
            raise ValueError(f"pictures {found} of a batch are not adjacent")
        return slice(found[0], found[-1] + 1) if found else slice(0, 0)


@dataclass
class Row:
    """A picture in the store: offset, height, width; row of its region kinds; whether its map has only single points; and the minimum known fraction of
    a crop's map."""

    at: int
    height: int
    width: int
    kinds: int
    sparse: bool
    shown: float


class Store:
    """Pictures in device memory, one after another: red, green, blue and region number in the bytes of an int32, lowest first; the map in float16, NaN
    where unknown."""

    def __init__(self, device, room=1 << 22):
        self.device, self.end = device, 0
        self.pixels, self.values = torch.empty(room, dtype=torch.int32, device=device), torch.empty(room, dtype=torch.float16, device=device)

    def add(self, packed):
        """Adds a [`pack.Packed`]; returns the offset of its pixels."""
        parts = [c.astype(np.int32) << s for c, s in zip((*np.moveaxis(packed.rgb, 2, 0), packed.region), (0, 8, 16, 24))]
        pixels, values = parts[0] | parts[1] | parts[2] | parts[3], packed.value.astype(np.float16)
        at, self.end = self.end, self.end + pixels.size
        while self.end > len(self.pixels):
            self.pixels, self.values = (torch.cat([x, torch.empty_like(x)]) for x in (self.pixels, self.values))
        self.pixels[at : self.end], self.values[at : self.end] = to_device([pixels.ravel()], self.device)[0], to_device([values.ravel()], self.device)[0]
        return at


@dataclass
class Group:
    """Pictures that share a part of a batch; each of two labels of a photograph counts half."""

    space: str
    rows: list = field(default_factory=list)
    names: list = field(default_factory=list)
    table: np.ndarray = None  # the rows as an array
    chances: np.ndarray = None  # cumulative probability of each row, for each shape

    def add(self, row, name):
        self.rows.append((row.at, row.height, row.width, row.kinds, row.sparse, row.shown))
        self.names.append(name)
        self.table = None

    def prepare(self):
        """Computes probabilities: all pictures are equally frequent, mostly in shapes of similar aspect ratio and without enlargement."""
        if self.table is not None:
            return
        self.table = np.array(self.rows, np.float64)
        shape, often = np.array(list(SHAPES), np.float64), np.array(list(SHAPES.values()))
        height, width = self.table[:, 1:2], self.table[:, 2:3]
        wider = np.abs(np.log(width / height * shape[:, 0] / shape[:, 1]))
        larger = np.maximum(0, np.log(shape.prod(1) / (height * width)))
        near = np.exp(-WIDER * wider - ENLARGED * larger) * often
        times = Counter(self.names)
        weight = np.array([1 / times[n] for n in self.names])[:, None]
        self.chances = np.cumsum(weight * near / near.sum(1, keepdims=True) / often, 0)

    def drawn(self, shape, count, draw):
        """Draws `count` rows of the table for a shape number."""
        self.prepare()
        sums = self.chances[:, shape]
        return self.table[np.minimum(np.searchsorted(sums, draw.random(count) * sums[-1], side="right"), len(sums) - 1)]


class Pictures:
    """All training pictures."""

    def __init__(self, device):
        self.device, self.store, self.groups = device, Store(device), {}
        self.kinds = np.zeros((1, REGIONS), np.uint8)  # kind of each region, by picture; row 0 is for pictures without regions
        self.device_kinds = None

    def add(self, packed):
        """A [`pack.Packed`]."""
        kinds = 0
        if packed.region.any():
            kinds, own = len(self.kinds), np.zeros((1, REGIONS), np.uint8)
            own[0, : len(packed.kinds)] = packed.kinds
            self.kinds, self.device_kinds = np.concatenate([self.kinds, own]), None
        shown = 0.02 if packed.sparse else 0.4 * float(np.isfinite(packed.value).mean())
        row = Row(self.store.add(packed), *packed.value.shape, kinds, packed.sparse, shown)
        name = packed.name.removesuffix(".b") if packed.group == "label" else packed.name
        self.groups.setdefault(packed.group, Group(packed.space)).add(row, name)

    def count(self, group):
        """Number of pictures in a group, or in all families of scenes."""
        return sum(len(v.rows) for g, v in self.groups.items() if g.split(":")[0] == group or g == group)

    def shares(self):
        """Probability of each group and family, with equal spaces adjacent."""
        families = {g: FAMILIES[g.removeprefix("scene:")] for g in sorted(self.groups) if g.startswith("scene:")}
        total = sum(families.values())
        found = {g: SHARES["scene"] * v / total for g, v in families.items()} | {g: v for g, v in SHARES.items() if g in self.groups}
        return {g: v / sum(found.values()) for g, v in found.items()}

    def batch(self, count, rng, shape=None):
        """Draws a batch, which depends only on the pictures and `rng`: `count` pictures of the smallest shape, or as many pixels of another. Draws the shape
        if it is not given."""
        draw = np.random.default_rng(rng.getrandbits(128))
        often = np.array(list(SHAPES.values()))
        number = list(SHAPES).index(shape) if shape else draw.choice(len(often), p=often / often.sum())
        shape = list(SHAPES)[number]
        count = max(1, round(count * min(h * w for h, w in SHAPES) / math.prod(shape)))
        shares = self.shares()
        # round each group's share up or down at random, so that the mean over batches is exact
        bounds = np.floor(np.cumsum([0, *shares.values()]) * count + draw.random()).astype(int)
        bounds[-1] = count
        counts = dict(zip(shares, np.diff(bounds)))
        rows = np.concatenate([self.groups[g].drawn(number, n, draw) for g, n in counts.items()])
        of = [(g.split(":")[0] if g.startswith("scene") else g, self.groups[g].space) for g, n in counts.items() for _ in range(n)]
        return Batch(*self.cut(rows, shape, frames(rows[:, 1], rows[:, 2], shape, draw)), of)

    def cut(self, rows, shape, frame):
        """Crops frames of pictures: colours, map, regions, kinds and valid crops, as in [`Batch`]. Colours use a triangle filter as wide as a pixel, maps the
        mean of the covered pixels."""
        (height, width), (top, left, down, along) = shape, frame
        first = [np.maximum(0, np.floor(np.minimum(start, start + extent)) - 1) for start, extent in ((top, down), (left, along))]
        rows_of, columns_of = (int(np.ceil(np.abs(extent).max())) + 4 for extent in (down, along))
        at, kinds = to_device([rows[:, n].astype(np.int64)[:, None] for n in (0, 3)], self.device)
        numbers = (*frame, *first, rows[:, 1], rows[:, 2], np.where(rows[:, 4], 0, 0.5), rows[:, 5])
        top, left, down, along, y0, x0, h, w, least, shown = to_device([v.astype(np.float32)[:, None] for v in numbers], self.device)

        def index(y, x):
            y, x = torch.minimum(y, h - 1).long(), torch.minimum(x, w - 1).long()
            return (at + y * w.long())[:, :, None] + x[:, None, :]

        within = index(*(start + torch.arange(n, device=self.device) for start, n in ((y0, rows_of), (x0, columns_of))))
        pixels = self.store.pixels[within]
        high, wide = Taps(top, down, y0, rows_of, h), Taps(left, along, x0, columns_of, w)
        rgb = torch.stack([pixels >> shift & 255 for shift in (0, 8, 16)], 1) / 255
        rgb = (high.triangles(height) @ rgb @ wide.triangles(width).mT).clamp(0, 1)
        value = self.store.values[within].float()
        known_and_value = torch.stack([value.isfinite().float(), value.nan_to_num(0)], 1)
        share, total = (high.means(height // 2) @ known_and_value @ wide.means(width // 2).mT).unbind(1)
        known = share > least[:, :, None]
        value = torch.where(known, total / share.clamp_min(1e-6), torch.nan)
        span = torch.where(known, value, -torch.inf).amax((1, 2)) - torch.where(known, value, torch.inf).amin((1, 2))
        good = (known.float().mean((1, 2)) > shown[:, 0]) & (span > 0.05)
        region = self.store.pixels[index(high.middles(height // 2).floor(), wide.middles(width // 2).floor())] >> 24 & 255
        if self.device_kinds is None:
            self.device_kinds = to_device([self.kinds], self.device)[0]
        kind = self.device_kinds.flatten()[kinds[:, :, None] * REGIONS + region]
        return rgb, value, region.long(), kind.long(), good.float()


class Taps:
    """Resampling weights along one side of each picture: matrices [N, 1, parts, count] with row sums of 1, from `count` pixels after `first`, of `size`
    [N, 1], to equal parts of an extent that starts at `start` and is negative for mirrored pictures."""

    def __init__(self, start, extent, first, count, size):
        self.start, self.extent = start, extent
        self.at = first + torch.arange(count, device=start.device) + 0.5
        self.beyond = self.at > size

    def middles(self, parts):
        return self.start + (torch.arange(parts, device=self.start.device) + 0.5) / parts * self.extent

    def apart(self, parts):
        """Distance of pixels from the centres of parts, and the length of a part."""
        apart = (self.at[:, None, :] - self.middles(parts)[:, :, None]).abs().masked_fill(self.beyond[:, None, :], torch.inf)
        return apart, self.extent.abs()[:, :, None] / parts

    def triangles(self, parts):
        apart, length = self.apart(parts)
        return summed((1 - apart / length.clamp_min(1)).clamp_min(0))

    def means(self, parts):
        apart, length = self.apart(parts)
        return summed(torch.minimum(((1 + length) / 2 - apart).clamp_min(0), length.clamp_max(1)))


def summed(weights):
    """Normalises each row to a sum of 1, for all channels."""
    return (weights / weights.sum(2, keepdim=True))[:, None]


def frames(height, width, shape, draw):
    """Top, left, height and width, float64 [N] each, of random crops with about the shape's aspect ratio. Half of them are mirrored: left is the right
    border, and the width is negative."""
    n, (to_h, to_w) = len(height), shape
    zoom = np.where(draw.random(n) < 0.6, draw.uniform(CLOSEST, 1, n), 1)
    aspect = to_w / to_h * np.exp(np.where(draw.random(n) < 0.5, draw.uniform(-0.12, 0.12, n), 0))
    whole = width > height * aspect
    h, w = np.where(whole, height, width / aspect) * zoom, np.where(whole, height * aspect, width) * zoom
    y, x, turned = draw.random(n) * (height - h), draw.random(n) * (width - w), draw.random(n) < 0.5
    return y, np.where(turned, x + w, x), h, np.where(turned, -w, w)
