"""What light, lenses, sensors and codecs do to the colours of photographs, on batches [N, 3, H, W] in 0..1, on any device.

What happens is a function of the generator `rng` of Python's `random` alone. Sides are multiples of 8."""

import math

import torch
import torch.nn.functional as F

# quantisation of luma by JPEG at quality 50
LUMA = [
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56, 14, 17, 22, 29, 51, 87, 80, 62,
    18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92, 49, 64, 78, 87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99,
]  # fmt: skip
# chroma is quantised more coarsely by so much
CHROMA = 1.6
YCC = [[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]]
# lightness, red against green, yellow against blue
OPPONENT = [[1 / 3, 1 / 3, 1 / 3], [0.5, -0.5, 0.0], [0.25, 0.25, -0.5]]


class Draws:
    """Numbers for each picture of a batch, [N, C, 1, 1]."""

    def __init__(self, count, rng, device):
        self.count, self.device = count, device
        self.generator = torch.Generator().manual_seed(rng.getrandbits(60))

    def uniform(self, low, high, channels=1, size=(1, 1)):
        return (torch.rand(self.count, channels, *size, generator=self.generator) * (high - low) + low).to(self.device)

    def normal(self, channels=1):
        return torch.randn(self.count, channels, 1, 1, generator=self.generator).to(self.device)

    def some(self, share):
        return self.uniform(0, 1) < share


def constant(values, x):
    return torch.tensor(values, device=x.device, dtype=torch.float32)


def channels(matrix, x):
    """Each pixel's colour times a matrix."""
    return torch.einsum("oc,nchw->nohw", matrix, x)


def blurred(x, sigma, reach):
    """Gaussian blur of each picture by its own deviation [N, 1, 1, 1]."""
    n, c, h, w = x.shape
    at = torch.arange(-reach, reach + 1, device=x.device)
    kernel = torch.exp(-0.5 * (at / sigma.view(n, 1).clamp_min(0.05)).square())
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(c, 0)[:, None]
    y = F.pad(x, [reach] * 4, mode="replicate").view(1, n * c, h + 2 * reach, w + 2 * reach)
    return F.conv2d(F.conv2d(y, kernel[..., None], groups=n * c), kernel[:, :, None], groups=n * c).view(n, c, h, w)


def toned(x, draw):
    """Mean and spread of lightness and of both colour differences on the way to those of other photographs."""
    to = constant(OPPONENT, x)
    y = channels(to, x)
    mean, spread = y.mean((2, 3), keepdim=True), y.std((2, 3), keepdim=True) + 0.004
    want = constant([0.45, 0.0, 0.02], x)[:, None, None] + draw.normal(3) * constant([0.12, 0.02, 0.04], x)[:, None, None]
    least, most = (constant(v, x)[:, None, None] for v in ([0.14, 0.01, 0.02], [0.28, 0.06, 0.1]))
    gain = torch.minimum((draw.uniform(0, 1, 3) * (most - least) + least).div(spread).clamp_min(0.4), constant([2.0, 2.5, 2.5], x)[:, None, None])
    return channels(torch.linalg.inv(to), (y - mean) * gain + 0.35 * mean + 0.65 * want).clamp(0, 1)


def focused(x, value, draw):
    """Blur that grows with the distance in disparity from what is in focus; `value` [N, h, w] is finite."""
    v = F.interpolate(value[:, None], size=x.shape[2:], mode="bilinear", align_corners=False)
    low, high = v.amin((2, 3), keepdim=True), v.amax((2, 3), keepdim=True)
    at = low + (high - low) * draw.uniform(0, 1).sqrt()
    amount = ((v - at).abs() / (high - low).clamp_min(1e-3) * 2 - 0.1).clamp(0, 1)
    amount, most = blurred(amount, torch.ones_like(at), 3), draw.uniform(1.5, 5)
    some, much = blurred(x, most / 2, 7), blurred(x, most, 13)
    return torch.where(amount < 0.5, x + (some - x) * 2 * amount, some + (much - some) * (2 * amount - 1))


def compressed(x, quality):
    """What JPEG of a quality [N, 1, 1, 1] does."""
    n, _, h, w = x.shape
    i = torch.arange(8, device=x.device)
    basis = torch.cos((2 * i[None] + 1) * i[:, None] * math.pi / 16) * 0.5
    basis[0] *= 0.5**0.5
    step = constant(LUMA, x).view(8, 8) * torch.where(quality < 50, 50 / quality, 2 - quality / 50)[..., None, None]
    step = step.round().clamp(1, 255) * constant([1, CHROMA, CHROMA], x).view(3, 1, 1, 1, 1)
    to = constant(YCC, x)
    blocks = channels(to, x * 255 - 128).view(n, 3, h // 8, 8, w // 8, 8).transpose(3, 4)
    blocks = basis.T @ ((basis @ blocks @ basis.T / step).round() * step) @ basis
    y = channels(torch.linalg.inv(to), blocks.transpose(3, 4).reshape(n, 3, h, w))
    return ((y + 128) / 255).clamp(0, 1)


def photometric(x, value, rng):
    """Another photograph of the same things. `value` [N, h, w] is the map to learn, NaN where unknown, that focus follows in some pictures."""
    n = x.shape[0]
    draw = Draws(n, rng, x.device)
    x = torch.where(draw.some(0.5), toned(x, draw), x)
    if soft := [i for i in range(n) if rng.random() < 0.12]:
        x[soft] = focused(x[soft], value[soft].nan_to_num(0), Draws(len(soft), rng, x.device))
    gain = (1 + 0.08 * draw.normal(3)) * draw.uniform(0.7, 1.35)
    x = (x * gain).clamp(1e-4, 1) ** draw.uniform(0.7, 1.4)
    grey = x.mean(1, keepdim=True)
    x = grey + (x - grey) * torch.where(draw.some(0.06), 0.0, draw.uniform(0.5, 1.5))
    # uneven light
    light = F.interpolate(draw.uniform(0.7, 1.3, size=(3, 3)), size=x.shape[2:], mode="bicubic", align_corners=False)
    x = torch.where(draw.some(0.35), x * light, x)
    x = torch.where(draw.some(0.4), blurred(x, draw.uniform(0.3, 1.4), 4), x)
    noise = torch.randn(x.shape, generator=torch.Generator(x.device).manual_seed(rng.getrandbits(60)), device=x.device)
    x = torch.where(draw.some(0.6), x + noise * draw.uniform(1, 10) / 255, x).clamp(0, 1)
    x = torch.where(draw.some(0.4), compressed(x, draw.uniform(35, 95)), x)
    return (x * 255).round() / 255
