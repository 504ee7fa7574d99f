"""Trains Θ: denoised disparity and confidence, through differentiable weighted k-means in 64-pixel tiles."""

import argparse

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

import augment
import common
import loop
from common import RUNS

TILE, PLANES = 64, 4


def conv(i, o, stride=1):
    return nn.Conv2d(i, o, 3, stride, 1)


class Theta(nn.Module):
    """Two-headed U-Net that mixes seven versions of the disparity map per pixel, and adds a small correction.

    The mixture always stays within the range of its surroundings, and learns in minutes. The correction, at most STEP, adds what averages cannot: edges
    under noise."""

    STEP = 0.06

    def __init__(self):
        super().__init__()
        self.e0, self.e1, self.e2, self.e3, self.e4 = conv(10, 7), conv(7, 16, 2), conv(16, 24, 2), conv(24, 32, 2), conv(32, 32)
        self.m2 = conv(24, 24)
        self.u2, self.d2 = nn.Conv2d(32, 24, 1), conv(24, 24)
        self.u1, self.d1 = nn.Conv2d(24, 16, 1), conv(16, 16)
        self.u0, self.d0 = nn.Conv2d(16, 7, 1), conv(7, 7)
        self.heads = nn.Conv2d(7, 9, 1)
        with torch.no_grad():
            self.heads.weight[7].zero_()
            self.heads.bias.copy_(torch.tensor([1.0, 0, 0, 0, 0, 0, 0, 0, 1.0]))

    def forward(self, x):
        d = x[:, 3:4]
        v = versions(d)
        f0 = act(self.e0(torch.cat([x, (v[:, 1:] - d) * 8], 1)))
        f1 = act(self.e1(f0))
        f2 = act(self.m2(act(self.e2(f1))))
        f3 = act(self.e4(act(self.e3(f2))))
        g2 = act(self.d2(double(self.u2(f3)) + f2))
        g1 = act(self.d1(double(self.u1(g2)) + f1))
        g0 = act(self.d0(double(self.u0(g1)) + f0))
        y = self.heads(g0)
        mixed = (torch.softmax(y[:, :7], 1) * v).sum(1, keepdim=True) + self.STEP * torch.tanh(y[:, 7:8])
        return mixed.clamp(0, 1), torch.sigmoid(y[:, 8:])


def act(x):
    return F.leaky_relu(x, 0.1)


def versions(d):
    """The map; the map without 3 × 3 outliers, and its 5 × 5 mean; 5 × 5 and 9 × 9 means of the map; means over about 20 and 40 pixels."""
    opened, closed = dilate(erode(d)), erode(dilate(d))
    clean = 0.5 * (erode(dilate(opened)) + dilate(erode(closed)))
    quarter = F.avg_pool2d(d, 4)
    eighth = F.avg_pool2d(quarter, 2)
    return torch.cat([d, clean, mean(clean, 5), mean(d, 5), mean(d, 9), stretched(mean(quarter, 5), 4), stretched(mean(eighth, 5), 8)], 1)


def stretched(x, by):
    return F.interpolate(x, scale_factor=by, mode="bilinear", align_corners=False)


def mean(x, k):
    return F.avg_pool2d(x, k, 1, k // 2, count_include_pad=False)


def dilate(x):
    return F.max_pool2d(x, 3, 1, 1)


def erode(x):
    return -F.max_pool2d(-x, 3, 1, 1)


def double(x):
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def tiles(x, size=TILE):
    """[N,1,H,W] → [tiles, size²]; H and W are multiples of `size`."""
    n, _, h, w = x.shape
    return x.view(n, h // size, size, w // size, size).permute(0, 1, 3, 2, 4).reshape(-1, size * size)


def discrete(disparity, confidence, planes=PLANES, rounds=8):
    """Discrete map per tile by weighted k-means; the last centres carry the gradient."""
    d, w = tiles(disparity), tiles(confidence)
    low, high = d.min(1, keepdim=True).values, d.max(1, keepdim=True).values
    centre = (low + (high - low) * (torch.arange(planes) + 0.5) / planes).detach()

    def assign(centre):
        return (d.detach()[:, None] - centre[..., None]).abs().argmin(1)

    def update(label, d, w, old):
        total = torch.zeros_like(old).scatter_add(1, label, w)
        mean = torch.zeros_like(old).scatter_add(1, label, w * d) / total.clamp_min(1e-6)
        return torch.where(total > 1e-6, mean, old)

    with torch.no_grad():
        for _ in range(rounds):
            centre = update(assign(centre), d, w, centre)
        label = assign(centre)
    return update(label, d, w, centre).gather(1, label)


def network_like(d, rng):
    """Smooths a clean map like the output of large networks, most of the time."""
    if rng.random() < 0.4:
        return d
    s, (h, w) = rng.choice([1, 2, 2, 3, 4]), d.shape
    small = cv2.resize(d, (max(8, w // s), max(8, h // s)), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(cv2.resize(small, (w, h), interpolation=cv2.INTER_CUBIC), (0, 0), rng.uniform(0.4, 1.5)).clip(0, 1)


def damaged(d, rng):
    """Damages a disparity map like networks, sensors and codecs; leaves one in six unchanged."""
    noise = np.random.default_rng(rng.getrandbits(32))
    x, h, w = d.copy(), *d.shape
    if rng.random() < 1 / 6:
        return x
    kind = rng.random()
    if kind < 0.25:
        if rng.random() < 0.5:
            x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.6, 2.5))
        else:
            s = rng.choice([2, 2, 3, 4])
            x = cv2.resize(cv2.resize(x, (w // s, h // s), interpolation=cv2.INTER_AREA), (w, h), interpolation=rng.choice([cv2.INTER_LINEAR, cv2.INTER_CUBIC]))
    if kind > 0.15:
        x = x + noise.normal(0, 10 ** rng.uniform(-2.7, -1.35), x.shape)
    if rng.random() < 0.2:
        hit = noise.random(x.shape) < rng.choice([0.002, 0.01, 0.03])
        x = np.where(hit, noise.random(x.shape), x)
    if rng.random() < 0.12:
        wave = 10 ** rng.uniform(-2.5, -1.6) * np.sin(np.arange(max(h, w)) * rng.uniform(0.3, 2.5))
        x = x + (wave[:h, None] if rng.random() < 0.5 else wave[None, :w])
    if rng.random() < 0.15:
        levels = rng.choice([32, 64, 128, 255])
        x = np.round(x * levels) / levels
    return np.clip(x, 0, 1).astype(np.float32)


def batch_of(folders, size, n, rng):
    colours, damaged_maps, maps = [], [], []
    for _ in range(n):
        rgb, d = common.random_crop(*common.read_pair(rng.choice(folders)), size, rng)
        span = rng.uniform(0.5, 1.0)  # maps that do not fill 0..1
        d = network_like(d, rng) * span + rng.uniform(0, 1 - span)
        colours.append(common.chw(rgb))
        maps.append(torch.from_numpy(d)[None])
        damaged_maps.append(torch.from_numpy(damaged(d, rng))[None])
    y = torch.stack(maps)
    return torch.cat([augment.photometric(torch.stack(colours), y[:, 0], rng), torch.stack(damaged_maps)], 1), y


def loss_of(net, x, y):
    d, c = net(x)
    folded = (discrete(d, c) - tiles(y)).abs().mean()
    direct = (d - y).abs().mean()
    # confidence is how reliable the denoised value is
    trust = (c - torch.exp(-(d - y).abs().detach() / 0.005)).square().mean()
    return folded + 2 * direct + 0.05 * trust, direct


def main():
    a = argparse.ArgumentParser(description=__doc__)
    a.add_argument("--scenes", nargs="+", default=[str(RUNS / "data" / "train")])
    a.add_argument("--out", default=str(RUNS / "theta"))
    a.add_argument("--batch", type=int, default=3)
    loop.arguments(a, steps=2500, seed=2, every=50)
    a = a.parse_args()
    cv2.setNumThreads(1)
    folders = common.scenes(*a.scenes)
    loop.seed_all(a.seed)
    net = Theta()

    def loss_at(step):
        rng = loop.stream(a.seed, step)
        x, y = batch_of(folders, rng.choice([(128, 192), (192, 128), (128, 128), (192, 192)]), a.batch, rng)
        loss, direct = loss_of(net, x, y)
        return {"loss": loss, "direct": direct}

    inputs = {"scenes": [f / n for f in folders for n in ("photo.png", "disparity.png")]}
    plan = loop.Plan(steps=a.steps, lr=5e-3, weight_decay=1e-4, ema=0.99, every=a.every, seed=a.seed, threads=a.threads)
    loop.train(a.out, plan, net, loss_at, inputs, loop.remaining(a, "scenes"), stop=a.stop)


if __name__ == "__main__":
    main()
