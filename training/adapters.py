"""Holds the program's work before and after a depth network against that of `transformers`, on networks with random weights.

    pip install transformers onnxscript
    python adapters.py ../target/release/tmpi [photo …]

Each architecture is built small, exported to ONNX, and run twice: by its own image processor and PyTorch, and by `tmpi depth --raw`.
What is compared is the map at the network's size; enlarging it along the photo's edges is the program's own."""

import argparse
import subprocess
import tempfile
import warnings

import numpy as np
import torch
from PIL import Image
from torch import nn

from common import DATA, Path


def pfm(path):
    with open(path, "rb") as f:
        kind, size, scale = f.readline(), f.readline().split(), float(f.readline())
        w, h = int(size[0]), int(size[1])
        data = np.frombuffer(f.read(), "<f4" if scale < 0 else ">f4").reshape(h, w)
    assert kind.strip() == b"Pf"
    return data[::-1]


class Output(nn.Module):
    """A `transformers` network as a function of pixels alone, its map with a channel."""

    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, pixels):
        return self.net(pixel_values=pixels).predicted_depth[:, None]


class Published(nn.Module):
    """As MiDaS is published in ONNX: it normalises by itself and has one size. A few convolutions stand for the network."""

    def __init__(self):
        super().__init__()
        self.net = convolutions()
        self.register_buffer("mean", torch.tensor([0.485, 0.456, 0.406])[:, None, None])
        self.register_buffer("std", torch.tensor([0.229, 0.224, 0.225])[:, None, None])

    def forward(self, pixels):
        return self.net((pixels - self.mean) / self.std)


def convolutions():
    return nn.Sequential(
        nn.Conv2d(3, 16, 3, 2, 1), nn.ReLU6(), nn.Conv2d(16, 16, 3, 1, 1, groups=16), nn.ReLU6(), nn.Conv2d(16, 24, 1), nn.Conv2d(24, 16, 3, 1, 1), nn.ReLU(),
        nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False), nn.Conv2d(16, 1, 3, 1, 1),
    )  # fmt: skip


def pillow(size, mean, std):
    """Pillow's cubic reduction and a normalisation."""

    def prepare(image):
        small = image.resize(size(*image.size), Image.Resampling.BICUBIC)
        x = (np.asarray(small, np.float32) / 255 - np.array(mean, np.float32)) / np.array(std, np.float32)
        return torch.from_numpy(x.transpose(2, 0, 1).astype(np.float32))[None]

    return prepare


def long_side(side):
    def size(w, h):
        s = side / max(w, h)
        return round(w * s / 32) * 32, round(h * s / 32) * 32

    return size


def architectures():
    """(adapter, network, what comes before it, fixed size or none, larger is farther)."""
    import transformers as t

    imagenet = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
    yield "midas-v2.1-small", Published(), pillow(lambda w, h: (256, 256), [0] * 3, [1] * 3), (256, 256), False
    yield "midas-v2.1", Published(), pillow(lambda w, h: (384, 384), [0] * 3, [1] * 3), (384, 384), False
    yield "midas-v2.1-small-hub", convolutions(), pillow(long_side(256), *imagenet), None, False
    yield "midas-v2.1-hub", convolutions(), pillow(long_side(384), *imagenet), None, False

    def by(processor):
        return lambda image: processor(images=image, return_tensors="pt")["pixel_values"]

    small = {"hidden_size": 48, "num_hidden_layers": 4, "num_attention_heads": 4, "intermediate_size": 96}
    dpt = t.DPTConfig(**small, image_size=384, patch_size=16, backbone_out_indices=[0, 1, 2, 3], neck_hidden_sizes=[16, 16, 32, 32], fusion_hidden_size=32)
    for name in ("dpt-large", "dpt-hybrid"):
        yield name, Output(t.DPTForDepthEstimation(dpt)), by(t.DPTImageProcessor()), (384, 384), False
    anything = by(t.DPTImageProcessor(size={"height": 518, "width": 518}, keep_aspect_ratio=True, ensure_multiple_of=14, image_mean=imagenet[0], image_std=imagenet[1]))
    for name, kind in (("depth-anything-v2", "relative"), ("depth-anything-v2-metric", "metric")):
        backbone = t.Dinov2Config(**{k: v for k, v in small.items() if k != "intermediate_size"}, image_size=518, patch_size=14, out_indices=[1, 2, 3, 4], reshape_hidden_states=False, apply_layernorm=True)
        config = t.DepthAnythingConfig(
            backbone_config=backbone, reassemble_hidden_size=48, neck_hidden_sizes=[16, 16, 32, 32], fusion_hidden_size=16, depth_estimation_type=kind, max_depth=20
        )  # fmt: skip
        yield name, Output(t.DepthAnythingForDepthEstimation(config)), anything, None, kind == "metric"


def enliven(net):
    """Random weights that carry the picture through to a map with relief, all of it positive."""
    for m in net.modules():
        if isinstance(m, (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)):
            nn.init.kaiming_normal_(m.weight)
            if m.bias is not None:
                nn.init.constant_(m.bias, 0.1)


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("program")
    a.add_argument("photos", nargs="*")
    a.add_argument("--bound", type=float, default=1e-3, help="largest difference, relative to the map's range")
    a = a.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    photos = a.photos or sorted(str(p) for p in (DATA / "photos" / "dav2").glob("*.jpg"))[:2]
    if not photos:
        raise SystemExit("no photos: name some, or set TMPI_DATA")
    worst = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for name, net, prepare, fixed, metric in architectures():
            net.eval()
            enliven(net)
            for photo in photos:
                image = Image.open(photo).convert("RGB")
                png = f"{folder}/photo.png"
                image.save(png)
                x = prepare(image)
                with torch.no_grad():
                    want = net(x)[0, 0].numpy()
                model = f"{folder}/{name}-{x.shape[3]}x{x.shape[2]}.onnx"
                if not Path(model).exists():
                    # one size a file: attention with interpolated positions does not trace for all
                    torch.onnx.export(net, (x,), model, input_names=["image"], output_names=["depth"], dynamo=False)
                out = f"{folder}/out.pfm"
                subprocess.run([a.program, "depth", "--raw", "--quiet", "--depth-model", f"{name}={model}", "-o", out, png], check=True)
                got = pfm(out)
                size = got.shape == x.shape[2:]
                off = mean = np.inf
                if got.shape == want.shape:
                    # a distance near 0 has no bounded disparity
                    near = want > 0.05 * want.max() if metric else np.ones(want.shape, bool)
                    want = 1 / want[near] if metric else want[near]
                    difference = np.abs(got[near] - want) / np.ptp(want)
                    off, mean = difference.max(), difference.mean()
                worst = max(worst, off)
                print(f"{name:26} {Path(photo).name:12} {x.shape[3]:4}×{x.shape[2]:<4} {'' if size else f'here {got.shape[::-1]}'} worst {off:.1e} mean {mean:.1e}", flush=True)
    print(f"worst {worst:.1e}, bound {a.bound:.0e}")
    if not worst <= a.bound:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
