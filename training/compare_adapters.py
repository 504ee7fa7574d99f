"""Compares the program's pre- and postprocessing of depth networks with their publishers' code, on networks with random weights.

    python compare_adapters.py ../target/release/tmpi [photo …]

Builds each architecture with few layers, exports it to ONNX, and runs it twice: in PyTorch with the image processor of `transformers` (MiDaS: OpenCV, as
in its project), and with `tmpi depth --raw`. For Depth Anything 3 and MoGe-2, which `transformers` does not have, small convolutional networks
have the published interface, and this script reimplements their projects' pre- and postprocessing. Compares the map at the network's size,
without the program's upsampling along the photo's edges."""

import argparse
import itertools
import json
import math
import subprocess
import tempfile
import time
import warnings

import cv2
import numpy as np
import onnx
import timm
import torch
import transformers as t
from PIL import Image
from scipy.optimize import least_squares
from torch import nn
from torch.nn import functional as F

from common import DATA, Path

IMAGENET = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
HALF = [0.5] * 3, [0.5] * 3


def pfm(path):
    with open(path, "rb") as f:
        kind, size, scale = f.readline(), f.readline().split(), float(f.readline())
        w, h = int(size[0]), int(size[1])
        data = np.frombuffer(f.read(), "<f4" if scale < 0 else ">f4").reshape(h, w)
    assert kind.strip() == b"Pf"
    return data[::-1]


class Pixels(nn.Module):
    """Wraps a `transformers` network: pixels to a map with one channel."""

    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, pixels):
        return self.net(pixel_values=pixels).predicted_depth[:, None]


class Midas(nn.Module):
    """A convolutional encoder, and a decoder that fuses its four scales from the coarsest on. With `normalise` it takes
    pixels in 0..1, like the published ONNX files of MiDaS."""

    def __init__(self, encoder, width, normalise):
        super().__init__()
        self.encoder = timm.create_model(encoder, features_only=True, out_indices=(1, 2, 3, 4))
        self.reduce = nn.ModuleList(nn.Conv2d(c, width, 3, 1, 1, bias=False) for c in self.encoder.feature_info.channels())
        self.before = nn.ModuleList(residual(width) for _ in self.reduce)
        self.after = nn.ModuleList(residual(width) for _ in self.reduce)
        self.head = nn.Sequential(nn.Conv2d(width, width // 2, 3, 1, 1), nn.Upsample(scale_factor=2, mode="bilinear"), nn.Conv2d(width // 2, 32, 3, 1, 1), nn.ReLU())
        self.last = nn.Conv2d(32, 1, 1)
        mean, std = IMAGENET if normalise else ([0.0] * 3, [1.0] * 3)
        self.register_buffer("mean", torch.tensor(mean)[:, None, None])
        self.register_buffer("std", torch.tensor(std)[:, None, None])

    def forward(self, pixels):
        scales = self.encoder((pixels - self.mean) / self.std)
        x = None
        for scale, reduce, before, after in list(zip(scales, self.reduce, self.before, self.after))[::-1]:
            scale = reduce(scale)
            x = scale if x is None else x + scale + before(scale)
            x = F.interpolate(x + after(x), scale_factor=2, mode="bilinear", align_corners=True)
        return self.last(self.head(x)).relu()


def residual(width):
    return nn.Sequential(nn.ReLU(), nn.Conv2d(width, width, 3, 1, 1), nn.ReLU(), nn.Conv2d(width, width, 3, 1, 1))


def opencv(size, mean, std):
    """MiDaS's preprocessing: OpenCV's cubic filter on values in 0..1, without rounding."""

    def prepare(image):
        x = cv2.resize(np.asarray(image) / 255.0, size(*image.size), interpolation=cv2.INTER_CUBIC)
        return torch.from_numpy(((x - mean) / std).transpose(2, 0, 1).astype(np.float32))[None]

    return prepare


def within(side):
    """Sizes in multiples of 32, with no side longer than `side`."""

    def size(w, h):
        scale = min(side / w, side / h)
        near = [int(np.round(scale * v / 32) * 32) for v in (w, h)]
        return tuple(n if n <= side else math.floor(scale * v / 32) * 32 for n, v in zip(near, (w, h)))

    return size


def by(processor):
    return lambda image: processor(images=image, return_tensors="pt")["pixel_values"]


def anything(width, heads, neck, fusion, kind, layers=4):
    backbone = t.Dinov2Config(
        hidden_size=width, num_hidden_layers=layers, num_attention_heads=heads, image_size=518, patch_size=14,
        out_indices=[layers // 4 * i for i in (1, 2, 3, 4)],
        reshape_hidden_states=False, apply_layernorm=True,
    )  # fmt: skip
    config = t.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=width, neck_hidden_sizes=neck, fusion_hidden_size=fusion, head_hidden_size=32,
        depth_estimation_type=kind, max_depth=20,
    )  # fmt: skip
    net = t.DepthAnythingForDepthEstimation(config)
    return Pixels(net), net.head.conv3


def dpt(hybrid):
    vit = {"hidden_size": 96, "num_hidden_layers": 4, "num_attention_heads": 4, "intermediate_size": 192, "image_size": 384, "patch_size": 16}
    rest = {"backbone_out_indices": [0, 1, 2, 3], "fusion_hidden_size": 48}
    if hybrid:
        bit = {"model_type": "bit", "embedding_size": 32, "hidden_sizes": [64, 128, 256], "depths": [1, 2, 2], "layer_type": "bottleneck", "global_padding": "same",
               "embedding_dynamic_padding": True, "num_groups": 8, "out_features": ["stage1", "stage2", "stage3"]}  # fmt: skip
        rest |= {"is_hybrid": True, "backbone_config": bit, "backbone_featmap_shape": [1, 256, 24, 24], "neck_hidden_sizes": [64, 128, 96, 96], "neck_ignore_stages": [0, 1]}
    else:
        rest |= {"neck_hidden_sizes": [24, 48, 96, 96]}
    net = t.DPTForDepthEstimation(t.DPTConfig(**vit, **rest))
    return Pixels(net), net.head.head[4]


def trunk(channels, given):
    """Convolutions at full resolution, so that every pixel and its neighbours matter."""
    return nn.Sequential(nn.Conv2d(channels, 24, 3, 1, 1), nn.ReLU(), nn.Conv2d(24, 24, 3, 1, 1), nn.ReLU(), nn.Conv2d(24, given, 1))


class Views(nn.Module):
    """The interface of Depth Anything 3 with patches of 14 pixels: distance and confidence of several pictures; or distance and sky of one."""

    def __init__(self, several):
        super().__init__()
        self.net = nn.Sequential(nn.Conv2d(3, 96, 14, 14), nn.ReLU(), nn.Conv2d(96, 48, 3, 1, 1), nn.ReLU(), nn.Conv2d(48, 2, 3, 1, 1))
        self.several = several
        self.inputs, self.outputs = (["pixel_values"], ["predicted_depth", "confidence"]) if several else (["image"], ["depth", "sky"])

    def forward(self, pixels):
        x = F.interpolate(self.net(pixels.flatten(0, 1) if self.several else pixels), scale_factor=14, mode="bilinear")
        first, second = x[:, 0], x[:, 1]
        if self.several:
            return tuple(v.unflatten(0, pixels.shape[:2]) for v in ((first / 2).exp(), second.exp() + 1))
        # sky is about a tenth of the pixels
        return (first / 2).exp(), torch.sigmoid(second - 4.2)


class Points(nn.Module):
    """The interface of MoGe-2: resizes the picture to its tokens, and returns points as seen from .7 behind, off by a few percent, a mask, and the
    scale."""

    inputs, outputs = ["image", "num_tokens"], ["points", "normal", "mask", "metric_scale"]

    def __init__(self):
        super().__init__()
        self.net = trunk(3, 8)
        self.register_buffer("mean", torch.tensor(IMAGENET[0])[:, None, None])
        self.register_buffer("std", torch.tensor(IMAGENET[1])[:, None, None])

    def forward(self, image, num_tokens):
        h, w = image.shape[2:]
        aspect = w / h
        rows, columns = (num_tokens / aspect).sqrt().round().long(), (num_tokens * aspect).sqrt().round().long()
        x = F.interpolate(image, (rows * 14, columns * 14), mode="bilinear", align_corners=False)
        x = self.net((x - self.mean) / self.std)
        x = F.interpolate(x, (h, w), mode="bilinear", align_corners=False)
        diagonal = (1 + aspect**2) ** 0.5
        u = ((2 * torch.arange(w) + 1) / w - 1) * aspect / diagonal
        v = ((2 * torch.arange(h) + 1) / h - 1) / diagonal
        z = ((x[:, 0] - 2) / 2).exp()
        off = 1 + 0.02 * (x[:, 1:3] - 2)
        points = torch.stack([u * off[:, 0] * (z + 0.7), v[:, None] * off[:, 1] * (z + 0.7), z], -1)
        return points, F.normalize(x[:, 3:6], dim=1).permute(0, 2, 3, 1), torch.sigmoid(x[:, 6] - 1.2), (x[:, 7].mean((1, 2)) / 4).exp()


def three(several):
    """Depth Anything 3's preprocessing: OpenCV on bytes, longer side 504, then each side to the nearest multiple of 14, ties up."""

    def to(x, w, h):
        grows = w > x.shape[1] or h > x.shape[0]
        return cv2.resize(x, (w, h), interpolation=cv2.INTER_CUBIC if grows else cv2.INTER_AREA)

    def prepare(image):
        x = np.asarray(image)
        scale = 504 / max(image.size)
        if scale != 1:
            x = to(x, *(max(1, round(v * scale)) for v in image.size))
        w, h = ((v + 7) // 14 * 14 for v in x.shape[1::-1])
        x = to(x, w, h) / 255.0
        x = torch.from_numpy(((x - IMAGENET[0]) / IMAGENET[1]).transpose(2, 0, 1).astype(np.float32))[None]
        return x[None] if several else x

    return prepare


def moge(image):
    """MoGe's preprocessing: the input of its encoder, resized by PyTorch's antialiased bilinear filter, for 1800 tokens."""
    aspect = image.size[0] / image.size[1]
    rows, columns = round((1800 / aspect) ** 0.5), round((1800 * aspect) ** 0.5)
    x = torch.from_numpy((np.asarray(image) / 255).transpose(2, 0, 1).astype(np.float32))[None]
    return F.interpolate(x, (rows * 14, columns * 14), mode="bilinear", align_corners=False, antialias=True), torch.tensor(rows * columns)


def ignore_threshold(disparity, above):
    """Excludes pixels within a thousandth of a threshold, where rounding decides the side."""
    return torch.where(above.abs() < 1e-3, torch.nan, disparity)


def moge_disparity(points, _normal, mask, scale):
    """MoGe's postprocessing: solves for the shift that projects points to their pixels, on 64 × 64 of them; infinitely far outside the mask."""
    points, inside = points[0].numpy(), mask[0].numpy() > 0.5
    h, w = inside.shape
    diagonal = math.hypot(w, h)
    uv = np.stack(np.meshgrid((2 * np.arange(w) + 1 - w) / diagonal, (2 * np.arange(h) + 1 - h) / diagonal), -1)
    grid = np.ix_(np.arange(64) * h // 64, np.arange(64) * w // 64)
    valid = inside[grid]
    p, uv = points[grid][valid].astype(np.float64), uv[grid][valid]

    def off(shift):
        xy = p[:, :2] / (p[:, 2:] + shift)
        return ((xy * uv).sum() / (xy**2).sum() * xy - uv).ravel()

    shift = least_squares(off, 0, method="lm", ftol=1e-3).x[0]
    depth = np.where(inside & (points[..., 2] + shift > 0), (points[..., 2] + shift) * scale.item(), np.inf)
    print(f"    shift {shift:.4f}, {1 - inside.mean():.0%} outside the mask")
    return ignore_threshold(torch.from_numpy(1 / depth), mask[0] - 0.5)


def architectures():
    """Yields (row, adapter, function that returns network and last linear layer, preprocessing, whether one file takes any size, metric, function from
    outputs to disparity)."""
    for name, encoder, width, side in (("midas-v2.1-small", "tf_efficientnet_lite3", 64, 256), ("midas-v2.1", "resnext101_32x8d", 64, 384)):
        for end, size, norm in (("", lambda w, h, side=side: (side, side), False), ("-hub", within(side), True)):

            def make(encoder=encoder, width=width, norm=norm):
                net = Midas(encoder, width, not norm)
                return net, net.last

            yield name + end, name + end, make, opencv(size, *(IMAGENET if norm else ([0] * 3, [1] * 3))), True, False, None

    # as in their preprocessor_config.json: Pillow's linear filter, both sides 384
    for name in ("dpt-large", "dpt-hybrid"):
        processor = t.DPTImageProcessorPil(resample=Image.Resampling.BILINEAR, image_mean=HALF[0], image_std=HALF[1])
        yield name, name, lambda name=name: dpt(name == "dpt-hybrid"), by(processor), True, False, None

    near = {"size": {"height": 518, "width": 518}, "keep_aspect_ratio": True, "ensure_multiple_of": 14}
    processor = t.DPTImageProcessorPil(**near, resample=Image.Resampling.BICUBIC, image_mean=IMAGENET[0], image_std=IMAGENET[1])
    sizes = {"S": (384, 6, [48, 96, 192, 384], 64), "B": (768, 12, [96, 192, 384, 768], 128), "L": (1024, 16, [256, 512, 1024, 1024], 256)}
    for name, kind, which in (("depth-anything-v2", "relative", "SBL"), ("depth-anything-v2-metric", "metric", "S")):
        for letter in which:
            yield f"{name} {letter}", name, lambda letter=letter, kind=kind: anything(*sizes[letter], kind), by(processor), False, kind == "metric", None

    def made(net):
        return net, net.net[-1]

    yield "depth-anything-3", "depth-anything-3", lambda: made(Views(True)), three(True), True, False, lambda depth, _: 1 / depth[0, 0]
    sky = lambda depth, sky: ignore_threshold(torch.where(sky[0] < 0.3, 1 / depth[0], 0), sky[0] - 0.3)  # noqa: E731
    yield "depth-anything-3 sky", "depth-anything-3", lambda: made(Views(False)), three(False), False, False, sky
    yield "moge-2", "moge-2", lambda: made(Points()), moge, True, False, moge_disparity


def enliven(net, last, *x):
    """Initialises random weights so that the map depends on the picture: batch statistics come from `x`, and the last linear layer returns about 2 ± 1,
    inside the range of the following activation."""
    for m in net.modules():
        if isinstance(m, (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)):
            nn.init.kaiming_normal_(m.weight)
            if m.bias is not None:
                nn.init.constant_(m.bias, 0.1)
        if isinstance(m, nn.modules.batchnorm._BatchNorm):
            m.momentum = 1.0
    with torch.no_grad():
        for m in net.modules():
            m.training = isinstance(m, nn.modules.batchnorm._BatchNorm)
        net(*x)
        net.eval()
        given = []
        hook = last.register_forward_hook(lambda _m, _i, out: given.append(out))
        net(*x)
        hook.remove()
        # per channel
        mean, std = given[0].mean((0, 2, 3)), given[0].std((0, 2, 3))
        last.weight /= std[:, None, None, None]
        last.bias.copy_((last.bias - mean) / std + 2)


def shapes(photos):
    """Yields (name, picture): landscape, portrait, panorama, and small ones to enlarge, from the photos in turn."""
    turn = itertools.cycle(photos)

    def photo():
        return Image.open(next(turn)).convert("RGB")

    def cut(image, aspect):
        w, h = image.size
        w, h = (w, round(w / aspect)) if w / h < aspect else (round(h * aspect), h)
        x, y = (image.size[0] - w) // 2, (image.size[1] - h) // 2
        return image.crop((x, y, x + w, y + h))

    yield "landscape", photo()
    yield "portrait", cut(photo(), 0.7)
    yield "panorama", cut(photo(), 3.4)
    yield "small", cut(photo(), 4 / 3).resize((301, 227))
    yield "small, upright", cut(photo(), 0.6).resize((150, 250))
    yield "medium", cut(photo(), 1.5).resize((600, 400))


def listed(given):
    return given if isinstance(given, tuple) else (given,)


def export(net, x, model, any_size):
    """Writes the network; for several pictures with external weights, like large published files."""
    inputs, outputs = getattr(net, "inputs", ["image"]), getattr(net, "outputs", ["depth"])
    axes = {}
    if any_size:
        if isinstance(net, Points):
            axes = {inputs[0]: {2: "h", 3: "w"}}
        elif isinstance(net, Views):
            axes = {name: {0: "batch", 1: "views", x[0].dim() - 2 - (name in outputs): "h", x[0].dim() - 1 - (name in outputs): "w"} for name in inputs + outputs}
        else:
            axes = {name: {2: "h", 3: "w"} for name in inputs + outputs}
    torch.onnx.export(net, x, model, input_names=inputs, output_names=outputs, dynamic_axes=axes, dynamo=False)
    if isinstance(net, Views) and any_size:
        onnx.save(onnx.load(model), model, save_as_external_data=True, location=f"{Path(model).name}_data", size_threshold=0)


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("program")
    a.add_argument("photos", nargs="*")
    a.add_argument("--bound", type=float, default=1e-3, help="largest difference, relative to the map's range")
    a.add_argument("--only", default="", help="only rows whose names start with this")
    a = a.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    warnings.filterwarnings("ignore")
    t.logging.set_verbosity_error()
    photos = a.photos or sorted(str(p) for p in (DATA / "photos" / "dav2").glob("*.jpg"))[:3]
    if not photos:
        raise SystemExit("no photos: name some, or set TMPI_DATA")
    worst, rows, begun = 0.0, 0, time.time()
    with tempfile.TemporaryDirectory() as folder:
        for row, name, make, prepare, any_size, metric, after in architectures():
            if not row.startswith(a.only):
                continue
            rows += 1
            torch.manual_seed(0)
            net, last = make()
            model, sizes = None, {}
            for shape, image in shapes(photos):
                png = f"{folder}/photo.png"
                image.save(png)
                x = prepare(image)
                x = x if isinstance(x, tuple) else (x,)
                if model is None:
                    enliven(net, last, *x)
                h, w = x[0].shape[-2:]
                if model is None or not (any_size or f"{w}x{h}" in model):
                    if model:
                        Path(model).unlink()
                    # attention with interpolated positions traces for one size only, so one file per size. If the graph identifies the adapter, use a
                    # neutral file name, because a name that starts with the adapter's would identify it too
                    model = f"{folder}/{'network' if after else f'of-{name}'}{'' if any_size else f'-{w}x{h}'}.onnx"
                    export(net, x, model, any_size and "dpt" not in name)
                with torch.no_grad():
                    want = after(*listed(net(*x))) if after else net(*x)[:, 0]
                out = f"{folder}/out.pfm"
                command = [a.program, "depth", "--raw", "--quiet", "--json", "-o", out, png, "--depth-model"]
                # pass only the file, so that the program must detect the adapter
                about = json.loads(subprocess.run([*command, model], check=True, capture_output=True).stdout)
                got = pfm(out)
                want = want.squeeze(0).numpy()
                off = mean = np.inf
                note = "" if got.shape == want.shape else f" here {got.shape[1]}×{got.shape[0]}"
                note += "" if about["model"] == name else f" detected as {about['model']}"
                if not note:
                    want = 1 / want if metric else want
                    difference = np.abs(got - want) / (np.nanmax(want) - np.nanmin(want))
                    off, mean = np.nanmax(difference), np.nanmean(difference)
                worst = max(worst, off)
                label = f"{shape} {image.size[0]}×{image.size[1]}"
                print(f"{row:26} {label:25} {w:4}×{h:<4} worst {off:.1e} mean {mean:.1e}{note}", flush=True)
            Path(model).unlink()
            Path(f"{model}_data").unlink(missing_ok=True)
    if not rows:
        raise SystemExit(f"no row starts with {a.only}")
    print(f"worst {worst:.1e}, bound {a.bound:.0e}, {time.time() - begun:.0f} s")
    if not worst <= a.bound:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
