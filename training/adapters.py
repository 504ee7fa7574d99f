"""Holds the program's work before and after a depth network against that of its publishers, on networks with random weights.

    python adapters.py ../target/release/tmpi [photo …]

Each architecture is built with few layers, exported to ONNX, and run twice: with the image processor of `transformers` (MiDaS: OpenCV,
as its project does) in PyTorch, and by `tmpi depth --raw`. What is compared is the map at the network's size, without the margins that
ZoeDepth adds; enlarging it along the photo's edges is the program's own."""

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
import timm
import torch
import transformers as t
from PIL import Image
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
    """A `transformers` network as a function of pixels alone, its map with a channel."""

    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, pixels):
        return self.net(pixel_values=pixels).predicted_depth[:, None]


class Midas(nn.Module):
    """A convolutional encoder, and a decoder that fuses its four scales from the coarsest on. With `normalise` it takes
    pixels in 0..1, as MiDaS is published in ONNX."""

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
    """MiDaS's own: a cubic of OpenCV on values in 0..1, unrounded."""

    def prepare(image):
        x = cv2.resize(np.asarray(image) / 255.0, size(*image.size), interpolation=cv2.INTER_CUBIC)
        return torch.from_numpy(((x - mean) / std).transpose(2, 0, 1).astype(np.float32))[None]

    return prepare


def within(side):
    """No side longer than `side`, multiples of 32."""

    def size(w, h):
        scale = min(side / w, side / h)
        near = [int(np.round(scale * v / 32) * 32) for v in (w, h)]
        return tuple(n if n <= side else math.floor(scale * v / 32) * 32 for n, v in zip(near, (w, h)))

    return size


def by(processor):
    return lambda image: processor(images=image, return_tensors="pt")["pixel_values"]


def anything(width, heads, neck, fusion, kind):
    backbone = t.Dinov2Config(
        hidden_size=width, num_hidden_layers=4, num_attention_heads=heads, image_size=518, patch_size=14, out_indices=[1, 2, 3, 4],
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


def zoe():
    beit = t.BeitConfig(
        image_size=384, hidden_size=96, num_hidden_layers=4, num_attention_heads=4, intermediate_size=192, use_relative_position_bias=True,
        reshape_hidden_states=False, out_features=["stage1", "stage2", "stage3", "stage4"],
    )  # fmt: skip
    config = t.ZoeDepthConfig(backbone_config=beit, neck_hidden_sizes=[24, 48, 96, 96], fusion_hidden_size=48, bottleneck_features=48, bin_embedding_dim=32)
    net = t.ZoeDepthForDepthEstimation(config)
    return Pixels(net), net.relative_head.conv3


def calmed(net):
    """Attractors, whose force falls off within thousandths, tear the map of random weights to distances of 0: weaker weights there."""
    for m in net.net.metric_head.modules():
        if isinstance(m, nn.Conv2d):
            m.weight.data *= 0.6


def architectures():
    """(row, adapter, what makes the network and names its last linear layer, what comes before it, any size in one file, metric, processor)."""
    for name, encoder, width, side in (("midas-v2.1-small", "tf_efficientnet_lite3", 64, 256), ("midas-v2.1", "resnext101_32x8d", 64, 384)):
        for end, size, norm in (("", lambda w, h, side=side: (side, side), False), ("-hub", within(side), True)):

            def make(encoder=encoder, width=width, norm=norm):
                net = Midas(encoder, width, not norm)
                return net, net.last

            yield name + end, name + end, make, opencv(size, *(IMAGENET if norm else ([0] * 3, [1] * 3))), True, False, None

    # as their preprocessor_config.json say: Pillow's linear filter, both sides 384
    for name in ("dpt-large", "dpt-hybrid"):
        processor = t.DPTImageProcessorPil(resample=Image.Resampling.BILINEAR, image_mean=HALF[0], image_std=HALF[1])
        yield name, name, lambda name=name: dpt(name == "dpt-hybrid"), by(processor), True, False, None

    near = {"size": {"height": 518, "width": 518}, "keep_aspect_ratio": True, "ensure_multiple_of": 14}
    processor = t.DPTImageProcessorPil(**near, resample=Image.Resampling.BICUBIC, image_mean=IMAGENET[0], image_std=IMAGENET[1])
    sizes = {"S": (384, 6, [48, 96, 192, 384], 64), "B": (768, 12, [96, 192, 384, 768], 128), "L": (1024, 16, [256, 512, 1024, 1024], 256)}
    for name, kind, which in (("depth-anything-v2", "relative", "SBL"), ("depth-anything-v2-metric", "metric", "S")):
        for letter in which:
            yield f"{name} {letter}", name, lambda letter=letter, kind=kind: anything(*sizes[letter], kind), by(processor), False, kind == "metric", None

    processor = t.ZoeDepthImageProcessor(ensure_multiple_of=32, image_mean=HALF[0], image_std=HALF[1])
    yield "zoedepth", "zoedepth", zoe, by(processor), False, True, processor


def enliven(net, last, x):
    """Random weights that carry the picture through to a map with relief: statistics of batches are those of `x`, and the last
    linear layer gives values about 2 ± 1, which is inside the range of what follows it."""
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
        net(x)
        net.eval()
        given = []
        hook = last.register_forward_hook(lambda _m, _i, out: given.append(out))
        net(x)
        hook.remove()
        mean, std = given[0].mean(), given[0].std()
        last.weight /= std
        last.bias.copy_((last.bias - mean) / std + 2)


def shapes(photos):
    """(name, picture): landscape, portrait, panorama, and small ones that are enlarged, from the given photos in turn."""
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
    yield "middling", cut(photo(), 1.5).resize((600, 400))


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("program")
    a.add_argument("photos", nargs="*")
    a.add_argument("--bound", type=float, default=1e-3, help="largest difference, relative to the map's range")
    a.add_argument("--only", default="", help="rows whose names start so")
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
        for row, name, make, prepare, any_size, metric, processor in architectures():
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
                if model is None:
                    enliven(net, last, x)
                    if name == "zoedepth":
                        calmed(net)
                size = f"{x.shape[3]}x{x.shape[2]}"
                if model is None or not (any_size or size in model):
                    if model:
                        Path(model).unlink()
                    # attention with interpolated positions does not trace for all sizes: one size a file
                    model = f"{folder}/{name}.onnx" if any_size else f"{folder}/{name}-{size}.onnx"
                    extents = {"image": {2: "h", 3: "w"}, "depth": {2: "h", 3: "w"}} if any_size and "dpt" not in name else {}
                    torch.onnx.export(net, (x,), model, input_names=["image"], output_names=["depth"], dynamic_axes=extents, dynamo=False)
                with torch.no_grad():
                    want = net(x)[:, 0]
                out = f"{folder}/out.pfm"
                command = [a.program, "depth", "--raw", "--quiet", "--json", "-o", out, png, "--depth-model"]
                # by the file alone: the program must find the adapter too
                about = json.loads(subprocess.run([*command, model], check=True, capture_output=True).stdout)
                got = pfm(out)
                if processor:
                    # theirs comes at any size that is asked for; ours should have about the network's scale
                    output = t.modeling_outputs.DepthEstimatorOutput(predicted_depth=want)
                    (full,) = processor.post_process_depth_estimation(output, source_sizes=[image.size[::-1]], target_sizes=[got.shape])
                    want = full["predicted_depth"]
                want = want.squeeze(0).numpy()
                off = mean = np.inf
                note = "" if got.shape == want.shape else f" here {got.shape[1]}×{got.shape[0]}"
                note += "" if about["model"] == name else f" taken for {about['model']}"
                if not note:
                    want = 1 / want if metric else want
                    difference = np.abs(got - want) / np.ptp(want)
                    off, mean = difference.max(), difference.mean()
                worst = max(worst, off)
                label = f"{shape} {image.size[0]}×{image.size[1]}"
                print(f"{row:26} {label:25} {x.shape[3]:4}×{x.shape[2]:<4} worst {off:.1e} mean {mean:.1e}{note}", flush=True)
            Path(model).unlink()
    if not rows:
        raise SystemExit(f"no row begins with {a.only}")
    print(f"worst {worst:.1e}, bound {a.bound:.0e}, {time.time() - begun:.0f} s")
    if not worst <= a.bound:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
