"""Trains the monocular depth network end to end: on rendered scenes, hand-labelled photographs, collected depth, and unlabelled photographs with
predictions of its own averaged weights. Runs on a CPU or GPU.

    python depth.py --renderers 1                                                      # from the published encoder
    python depth.py --renderers 1 --init FILE.pt                                       # from a checkpoint
    python depth.py --scenes runs/data/train runs/data/models --steps 400 --batch 12   # on existing scenes: reproducible bit for bit on a CPU
"""

import argparse
import copy
import time
from pathlib import Path

import cv2
import numpy as np
import torch

import augment
import losses
import loop
import network
import pack
import renderers
import sources
from batches import Pictures
from choose import Choice
from common import generator, to_device
from paths import HERE, RUNS

# excluded fraction of a picture's worst pixels, because only rendered disparity is exact; and the weight of gradients, by how well edges of the map align
# with those of the photo
TRUST = {"scene": (0.0, 1.0), "label": (0.05, 1.0), "rgbd": (0.1, 0.3), "stereo": (0.2, 0.1), "pairs:depth": (0.05, 0.5), "pairs:disparity": (0.1, 0.5)}
# the same for predictions of the averaged weights
TEACHER_TRUST = (0.1, 0.5)
# weight of each part of the loss
WEIGHTS = {"error": 1.0, "gradient": 1.0, "order": 1.0, "border": 1.0, "whole": 0.5, "sky": 0.5, "photo": 1.0}
# minimum number of scenes to start, and steps between checks for new ones
MIN_SCENES, CHECK_EVERY = 100, 20
# steps after which new averaged weights start to teach, and teach with full weight
TEACHER_RAMP = (200, 600)


def loss_of(p, batch, taught, pairs, weights=WEIGHTS):
    """Loss of a batch and its parts, means over pictures. p is [N, H, W], `taught` the predictions of the averaged weights for photographs without a map,
    `pairs` the generator of pixel pairs."""
    parts = {}

    def add(name, per_picture, at):
        parts[name] = parts.get(name, 0.0) + (per_picture * batch.good[at]).sum() / len(batch.of)

    def found(wanted):
        at = batch.where(wanted)
        return at if at.stop else None

    for space, known in (("disparity", losses.disparity), ("depth", losses.depth)):
        if at := found(lambda g, s: s == space):
            trim, sharp = zip(*(TRUST[group] for group, _ in batch.of[at]))
            error, gradients = known(p[at], batch.value[at], trim)
            add("error", error, at)
            add("gradient", gradients * to_device([np.float32(sharp)], p.device)[0], at)
    if at := found(lambda g, s: s == "order"):
        add("order", losses.order(p[at], batch.value[at], pairs), at)
    if at := found(lambda g, s: g == "label"):
        wrong, broken = losses.things(p[at], batch.value[at], batch.region[at], batch.kind[at])
        add("border", wrong, at)
        add("whole", broken, at)
        add("sky", losses.sky(p[at], batch.kind[at]), at)
    if taught is not None:
        at = batch.where(lambda g, s: s == "none")
        error, gradients = losses.disparity(p[at], taught, [TEACHER_TRUST[0]] * len(taught))
        parts["photo"] = (error + TEACHER_TRUST[1] * gradients).sum() / len(batch.of)
    return {"loss": sum(weights[k] * v for k, v in parts.items()), **parts}


@torch.no_grad()
def teach(mean, rgb):
    """Predictions of the averaged weights for photographs and their mirror images."""
    both = network.normal(torch.cat([rgb, rgb.flip(3)])).contiguous(memory_format=torch.channels_last)
    straight, turned = losses.unit(mean.half(both)[:, 0]).chunk(2)
    return losses.unit(straight + turned.flip(2))


class Steps:
    """Computes the loss of each step."""

    def __init__(self, net, mean, pictures, args, renderers=None):
        self.net, self.mean, self.pictures, self.args, self.renderers = net, mean, pictures, args, renderers

    def teacher_weight(self, step):
        """Relative weight of the teacher's predictions."""
        return 1.0 if self.args.init else min(1.0, max(0.0, (step - TEACHER_RAMP[0]) / (TEACHER_RAMP[1] - TEACHER_RAMP[0])))

    def loss_at(self, step):
        if self.renderers is not None and step % CHECK_EVERY == 0:
            for scene in self.renderers.taken():
                self.pictures.add(scene)
        rng = loop.stream(self.args.seed, "batch", step)
        batch = self.pictures.batch(self.args.batch, rng)
        photos, weight = batch.where(lambda g, s: s == "none"), self.teacher_weight(step)
        device = batch.rgb.device
        # normalise outside of autocast, because bfloat16 is too coarse for colours
        x = network.normal(augment.photometric(batch.rgb, batch.value, rng)).contiguous(memory_format=torch.channels_last)
        with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
            taught = teach(self.mean, batch.rgb[photos]) if photos.stop and weight else None
            p = self.net.half(x)[:, 0]
        pairs = generator(rng.getrandbits(60), device)
        return loss_of(p, batch, taught, pairs, WEIGHTS | {"photo": WEIGHTS["photo"] * weight})


def initial_network(init):
    """The network of a checkpoint, or a new one with the published encoder."""
    net = network.DepthNet(drop=0.1, mix=0.4)
    if init:
        net.load_state_dict(torch.load(init, map_location="cpu", weights_only=False)["mean"])
    else:
        net.encoder.take_published()
    return net


def arguments():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("--pack", type=Path, default=pack.FILE, help="file of pack.py")
    a.add_argument("--scenes", nargs="*", default=[], help="folders of `tmpi-lab synth` scenes")
    a.add_argument("--renderers", type=int, default=0, help="processes that render more scenes during training; such a run is not reproducible bit for bit")
    a.add_argument("--program", default=str(HERE.parent / "target" / "release" / "tmpi-lab"), help="program that renders")
    a.add_argument("--models", help="folder of binary glTF files with z up for the renderers")
    a.add_argument("--init", help="checkpoint whose averaged weights to start from, such as weights.pt")
    a.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    a.add_argument("--out", default=str(RUNS / "depth"))
    a.add_argument("--batch", type=int, default=96, help="pictures of the smallest size; about 12 on a CPU")
    a.add_argument("--lr", type=float, default=1.5e-3)
    a.add_argument("--gain", type=float, default=0.3, help="learning rate of the encoder, relative to --lr")
    a.add_argument("--decay", type=float, default=2e-2, help="weight decay of the decoder")
    a.add_argument("--ema", type=float, default=0.999, help="decay of the weight average")
    loop.arguments(a, steps=10000, seed=1, every=250)
    return a


def start_renderers(a, out, packed):
    """Starts the renderers, if any."""
    if not a.renderers:
        return None
    first = renderers.FIRST + loop.stream(a.seed, "scenes", loop.reached(out)).randrange(10**9) * 1000
    return renderers.Renderers(a.program, a.renderers, out / "rendered", first, renderers.textures(packed, out / "textures"), a.models)


class Run:
    """A prepared training: pictures and network on the device, selection pictures, and renderers."""

    def __init__(self, a):
        cv2.setNumThreads(1)
        self.args, self.device, self.out = a, torch.device(a.device), Path(a.out)
        packed, scenes = list(pack.opened(a.pack)), sources.scenes(a.scenes) if a.scenes else []
        self.pictures, self.choice = Pictures(self.device), Choice(pack.sets_of(packed), self.device)
        self.renderers = start_renderers(a, self.out, packed)
        try:
            for p in [*(p for p in packed if not p.group.startswith(pack.CHOICE)), *map(renderers.read, scenes)]:
                self.pictures.add(p)
            loop.seed_all(a.seed)
            self.net = initial_network(a.init).to(self.device, memory_format=torch.channels_last)
            self.mean = copy.deepcopy(self.net).eval()
            self.inputs = {"pack": [a.pack], "scenes": [f for s in scenes for f in s.files], "start": [a.init or network.published()]}
            self.plan = loop.Plan(steps=a.steps, lr=a.lr, weight_decay=a.decay, ema=a.ema, every=a.every, seed=a.seed, threads=a.threads, warm=min(200, 1 + a.steps // 10))
            self.slow = list(self.net.encoder.parameters())
            self.steps = Steps(self.net, self.mean, self.pictures, a, self.renderers)
            while self.renderers is not None and self.pictures.count("scene") < MIN_SCENES:
                for scene in self.renderers.taken(wait=True):
                    self.pictures.add(scene)
        except BaseException:
            self.close()
            raise

    def close(self):
        if self.renderers is not None:
            self.renderers.close()


def main():
    began, a = time.time(), arguments().parse_args()
    run = Run(a)
    options = loop.remaining(a, "pack", "scenes", "renderers", "program", "models", "init", "device", "decay", "lr", "ema") | {"init": bool(a.init)}
    minutes = a.minutes and max(1e-3, a.minutes - (time.time() - began) / 60)
    try:
        loop.train(run.out, run.plan, run.net, run.steps.loss_at, run.inputs, options, run.choice, a.stop, minutes, run.mean, slow=run.slow, gain=a.gain)
    finally:
        run.close()


if __name__ == "__main__":
    main()
