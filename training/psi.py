"""Trains Ψ: the colour of hidden texels, on the program's layers of rendered scenes, where the hidden surface is known."""

import argparse

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

import common
import loop
from common import RUNS

# channels of layers.npy (`tmpi-lab synth --layers`): Ψ's nine, the true colour, and whether it is known
DISPARITY, HIDDEN, TRUTH, KNOWN = 7, 8, 9, 12


def conv(i, o, stride=1):
    return nn.Conv2d(i, o, 3, stride, 1)


class Psi(nn.Module):
    """U-Net from half to an eighth of the resolution; adds its output to the first fill at hidden texels."""

    def __init__(self):
        super().__init__()
        self.e1, self.e2, self.m2, self.e3, self.m3, self.m4 = conv(9, 8, 2), conv(8, 20, 2), conv(20, 20), conv(20, 36, 2), conv(36, 36), conv(36, 36)
        self.u2, self.d2 = nn.Conv2d(36, 20, 1), conv(20, 20)
        self.u1, self.d1 = nn.Conv2d(20, 8, 1), conv(8, 8)
        self.head = conv(8, 3)
        self.register_buffer("scale", torch.tensor([2.0] * 6 + [1, 1, 1])[None, :, None, None])
        self.register_buffer("shift", torch.tensor([-1.0] * 6 + [0, 0, 0])[None, :, None, None])
        with torch.no_grad():
            self.head.weight.zero_()
            self.head.bias.zero_()

    def forward(self, x):
        f1 = F.relu(self.e1(x * self.scale + self.shift))
        f2 = F.relu(self.m2(F.relu(self.e2(f1))))
        f3 = F.relu(self.m4(F.relu(self.m3(F.relu(self.e3(f2))))))
        g2 = F.relu(self.d2(double(self.u2(f3)) + f2))
        g1 = F.relu(self.d1(double(self.u1(g2)) + f1))
        return (x[:, :3] + double(self.head(g1)) * x[:, HIDDEN : HIDDEN + 1]).clamp(0, 1)


def double(x):
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def load(folders):
    """All layers of all scenes, u8 [N,13,64,64]."""
    found = [np.load(f / "layers.npy") for f in folders if (f / "layers.npy").exists()]
    return torch.from_numpy(np.concatenate([v for v in found if len(v)]))


def floats(batch):
    """Input channels of Ψ as floats."""
    x = batch.float() / 255
    x[:, DISPARITY] = x[:, DISPARITY] * 2 - 1
    return x


def augmented(x, rng):
    """Flips and transposes, permutes and scales colours, so that Ψ does not memorise scenes."""
    if rng.random() < 0.5:
        x = x.flip(3)
    if rng.random() < 0.5:
        x = x.flip(2)
    if rng.random() < 0.5:
        x = x.transpose(2, 3)
    order = rng.sample(range(3), 3)
    gain = torch.tensor([rng.uniform(0.5, 1.15) for _ in range(3)]).view(3, 1, 1)
    parts = [(x[:, i : i + 3][:, order] * gain).clamp(0, 1) for i in (0, 3, TRUTH)]
    return torch.cat([parts[0], parts[1], x[:, 6:9], parts[2], x[:, KNOWN:]], 1)


def losses(background, x):
    """L1, mean square, and a smoothed L1 as the loss, over known texels."""
    known = x[:, KNOWN:]
    e = (background - x[:, TRUTH:KNOWN]) * known
    count = (3 * known.sum()).clamp_min(1)
    return {"loss": torch.sqrt(e * e + 1e-3).sub(1e-3**0.5).sum() / count, "l1": e.abs().sum() / count, "mse": (e * e).sum() / count}


@torch.no_grad()
def measure(net, layers):
    """Means over all known texels of held-out layers."""
    sums, n = {}, 0.0
    for batch in layers.split(64):
        x = floats(batch)
        k = float(x[:, KNOWN:].sum())
        for name, v in losses(net(x[:, :9]), x).items():
            sums[name] = sums.get(name, 0) + float(v) * k
        n += k
    return {k: v / n for k, v in sums.items()}


def main():
    a = argparse.ArgumentParser(description=__doc__)
    a.add_argument("--scenes", nargs="+", default=[str(RUNS / "data" / "layers")])
    a.add_argument("--held", nargs="+", default=[str(RUNS / "data" / "held")], help="scenes for evaluation only")
    a.add_argument("--out", default=str(RUNS / "psi"))
    a.add_argument("--batch", type=int, default=32)
    a.add_argument("--measure", metavar="MODEL", help="compare psi.onnx with the first fill on the held-out scenes, then exit")
    loop.arguments(a, steps=6000, seed=3, every=300)
    a = a.parse_args()
    torch.set_num_threads(a.threads)
    held_folders = common.scenes(*a.held)
    held = load(held_folders)
    rounded = lambda r: {k: round(v, 5) for k, v in r.items()}
    print("first fill", rounded(measure(lambda x: x[:, :3], held)), f"{len(held)} layers", flush=True)
    if a.measure:
        from onnx_graph import run

        print("with Ψ    ", rounded(measure(lambda x: torch.from_numpy(run(a.measure, {"layers": x})[0]), held)))
        return
    folders = common.scenes(*a.scenes)
    layers = load(folders)
    print(len(layers), "layers", flush=True)
    loop.seed_all(a.seed)
    net = Psi()

    def loss_at(step):
        rng = loop.stream(a.seed, step)
        x = augmented(floats(layers[rng.choices(range(len(layers)), k=a.batch)]), rng)
        return {"loss": losses(net(x[:, :9]), x)["loss"]}

    def held_out(mean):
        return {f"held {k}": v for k, v in measure(mean, held).items()}

    inputs = {k: [f / "layers.npy" for f in of if (f / "layers.npy").exists()] for k, of in (("layers", folders), ("held", held_folders))}
    plan = loop.Plan(steps=a.steps, lr=2e-3, weight_decay=1e-2, ema=0.995, every=a.every, seed=a.seed, threads=a.threads)
    loop.train(a.out, plan, net, loss_at, inputs, loop.remaining(a, "scenes", "held", "measure"), held_out, a.stop)


if __name__ == "__main__":
    main()
