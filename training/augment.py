"""Augments colours as light, lenses, sensors and codecs change them, for batches [N, 3, H, W] in 0..1 on any device.

The result depends only on `rng`, a generator of Python's `random`, and on the type of device. Sides must be multiples of 8. Nothing waits for the device."""

import functools
import math

import numpy as np
import torch
import torch.nn.functional as F

from common import constant, generator, to_device

# JPEG quantisation table of luma at quality 50
LUMA = (
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56, 14, 17, 22, 29, 51, 87, 80, 62,
    18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92, 49, 64, 78, 87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99,
)  # fmt: skip
# factor by which chroma quantisation is coarser
CHROMA = 1.6
YCC = ((0.299, 0.587, 0.114), (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))
# lightness, red − green, yellow − blue
OPPONENT = ((1 / 3, 1 / 3, 1 / 3), (0.5, -0.5, 0.0), (0.25, 0.25, -0.5))
# basis of the DCT of JPEG blocks
COSINES = tuple(tuple(0.5 * math.cos((2 * x + 1) * k * math.pi / 16) * (1 if k else 0.5**0.5) for x in range(8)) for k in range(8))


class Draws:
    """Random numbers for each picture of a batch, [N, C, 1, 1]."""

    def __init__(self, count, rng, device):
        self.count, self.device = count, device
        self.generator = generator(rng.getrandbits(60), device)

    def uniform(self, low, high, channels=1, size=(1, 1)):
        return torch.rand(self.count, channels, *size, generator=self.generator, device=self.device) * (high - low) + low

    def normal(self, channels=1):
        return torch.randn(self.count, channels, 1, 1, generator=self.generator, device=self.device)

    def some(self, share):
        return self.uniform(0, 1) < share


@functools.cache
def inverse(matrix):
    """Inverse of a matrix as tuples."""
    return tuple(map(tuple, np.linalg.inv(np.array(matrix)).tolist()))


def channels(matrix, x):
    """Multiplies each pixel's colour by a matrix of tuples."""
    return torch.einsum("oc,nchw->nohw", constant(matrix, x.device), x)


def changed(x, at, change, *more):
    """Applies `change` to the pictures with the numbers `at`; `more` has further arguments per picture."""
    if not at:
        return x
    index = to_device([np.array(at)], x.device)[0]
    return x.index_copy(0, index, change(*(v.index_select(0, index) for v in (x, *more))))


def some(count, share, rng):
    """Draws numbers of pictures on the host, so that expensive changes apply to only a fraction."""
    return [i for i in range(count) if rng.random() < share]


def blurred(x, sigma, reach):
    """Gaussian blur with a deviation per picture [N, 1, 1, 1]."""
    n, c, h, w = x.shape
    at = torch.arange(-reach, reach + 1, device=x.device)
    kernel = torch.exp(-0.5 * (at / sigma.view(n, 1).clamp_min(0.05)).square())
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(c, 0)[:, None]
    y = F.pad(x, [reach] * 4, mode="replicate").view(1, n * c, h + 2 * reach, w + 2 * reach)
    return F.conv2d(F.conv2d(y, kernel[..., None], groups=n * c), kernel[:, :, None], groups=n * c).view(n, c, h, w)


def toned(x, draw):
    """Moves mean and spread of lightness and colour differences towards those of other photographs."""
    y = channels(OPPONENT, x)
    three = lambda *v: constant(v, x.device)[:, None, None]
    mean, spread = y.mean((2, 3), keepdim=True), y.std((2, 3), keepdim=True) + 0.004
    want = three(0.45, 0.0, 0.02) + draw.normal(3) * three(0.12, 0.02, 0.04)
    least, most = three(0.14, 0.01, 0.02), three(0.28, 0.06, 0.1)
    gain = torch.minimum((draw.uniform(0, 1, 3) * (most - least) + least).div(spread).clamp_min(0.4), three(2.0, 2.5, 2.5))
    return channels(inverse(OPPONENT), (y - mean) * gain + 0.35 * mean + 0.65 * want).clamp(0, 1)


def focused(x, value, draw):
    """Blurs by the distance in disparity from a focal plane; `value` [N, h, w] must be finite."""
    v = F.interpolate(value[:, None], size=x.shape[2:], mode="bilinear", align_corners=False)
    low, high = v.amin((2, 3), keepdim=True), v.amax((2, 3), keepdim=True)
    at = low + (high - low) * draw.uniform(0, 1).sqrt()
    amount = ((v - at).abs() / (high - low).clamp_min(1e-3) * 2 - 0.1).clamp(0, 1)
    amount, most = blurred(amount, torch.ones_like(at), 3), draw.uniform(1.5, 5)
    some, much = blurred(x, most / 2, 7), blurred(x, most, 13)
    return torch.where(amount < 0.5, x + (some - x) * 2 * amount, some + (much - some) * (2 * amount - 1))


def compressed(x, quality):
    """Simulates JPEG compression with a quality per picture [N, 1, 1, 1]."""
    n, _, h, w = x.shape
    basis = constant(COSINES, x.device)
    basis = torch.kron(basis, basis)
    step = constant(LUMA, x.device) * torch.where(quality < 50, 50 / quality, 2 - quality / 50)
    step = step.round().clamp(1, 255) * constant((1, CHROMA, CHROMA), x.device)[:, None, None]
    blocks = channels(YCC, x * 255 - 128).view(n, 3, h // 8, 8, w // 8, 8).transpose(3, 4).reshape(n, 3, h * w // 64, 64)
    blocks = (blocks @ basis.T / step).round() * step @ basis
    y = channels(inverse(YCC), blocks.view(n, 3, h // 8, w // 8, 8, 8).transpose(3, 4).reshape(n, 3, h, w))
    return ((y + 128) / 255).clamp(0, 1)


def photometric(x, value, rng):
    """Applies all augmentations. `value` [N, h, w] is the map to learn, NaN where unknown, which defines focus in some pictures."""
    n = x.shape[0]
    draw = Draws(n, rng, x.device)
    x = torch.where(draw.some(0.5), toned(x, draw), x)
    soft = some(n, 0.12, rng)
    x = changed(x, soft, lambda x, v: focused(x, v.nan_to_num(0), Draws(len(soft), rng, x.device)), value)
    gain = (1 + 0.08 * draw.normal(3)) * draw.uniform(0.7, 1.35)
    x = (x * gain).clamp(1e-4, 1) ** draw.uniform(0.7, 1.4)
    grey = x.mean(1, keepdim=True)
    x = grey + (x - grey) * torch.where(draw.some(0.06), 0.0, draw.uniform(0.5, 1.5))
    # uneven light
    light = F.interpolate(draw.uniform(0.7, 1.3, size=(3, 3)), size=x.shape[2:], mode="bicubic", align_corners=False)
    x = torch.where(draw.some(0.35), x * light, x)
    x = changed(x, some(n, 0.4, rng), lambda x, s: blurred(x, s, 4), draw.uniform(0.3, 1.4))
    noise = torch.randn(x.shape, generator=draw.generator, device=x.device)
    x = torch.where(draw.some(0.6), x + noise * draw.uniform(1, 10) / 255, x).clamp(0, 1)
    x = changed(x, some(n, 0.4, rng), compressed, draw.uniform(35, 95))
    return (x * 255).round() / 255
