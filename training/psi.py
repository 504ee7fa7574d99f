"""Trains Ψ: soft alpha and hidden colour of a tile's layers, by views that a second, exact camera sees."""

import argparse
import random
import time

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

import common
from common import RUNS

TILE, LAYERS, CONTEXT = 64, 4, 32


def conv(i, o, stride=1):
    return nn.Conv2d(i, o, 3, stride, 1)


class Psi(nn.Module):
    """U-Net at half resolution; its output is added to the first fill and to the box-softened mask. 1.9 GMAC for 250 layers of 64²."""

    def __init__(self):
        super().__init__()
        self.e1, self.e2, self.m2, self.e3, self.m3 = conv(9, 12, 2), conv(12, 24, 2), conv(24, 24), conv(24, 40, 2), conv(40, 40)
        self.u2, self.d2 = nn.Conv2d(40, 24, 1), conv(24, 24)
        self.u1, self.d1 = nn.Conv2d(24, 12, 1), conv(12, 12)
        self.head = conv(12, 4)
        self.register_buffer("scale", torch.tensor([2.0] * 6 + [1, 1, 1])[None, :, None, None])
        self.register_buffer("shift", torch.tensor([-1.0] * 6 + [0, 0, 0])[None, :, None, None])
        with torch.no_grad():
            self.head.weight.zero_()
            self.head.bias.zero_()

    def forward(self, x):
        f1 = F.relu(self.e1(x * self.scale + self.shift))
        f2 = F.relu(self.m2(F.relu(self.e2(f1))))
        f3 = F.relu(self.m3(F.relu(self.e3(f2))))
        g2 = F.relu(self.d2(double(self.u2(f3)) + f2))
        g1 = F.relu(self.d1(double(self.u1(g2)) + f1))
        y = double(self.head(g1))
        own, hidden = x[:, 6:7], x[:, 8:9]
        near, box = F.max_pool2d(own, 3, 1, 1), F.avg_pool2d(own, 3, 1, 1)
        alpha = torch.maximum(own, (box + y[:, :1]).clamp(0, 1) * near).clamp(0, 1)
        return alpha, (x[:, :3] + y[:, 1:] * hidden).clamp(0, 1)


def double(x):
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def pyramid(colour, weight):
    """Push-pull: colours where the weight is 1, coarser sums of weighted colours where it is 0."""
    h, w = weight.shape
    own = np.concatenate([colour * weight[..., None], weight[..., None]], -1)
    if h == 1 and w == 1:
        return own
    padded = np.pad(own, ((0, h % 2), (0, w % 2), (0, 0)))
    half = padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2]
    half = half / np.maximum(1, half[..., 3:])
    k = half[..., 3]
    coarse = pyramid(np.divide(half[..., :3], k[..., None], out=np.zeros_like(half[..., :3]), where=k[..., None] > 0), k)
    up = cv2.resize(coarse, (coarse.shape[1] * 2, coarse.shape[0] * 2), interpolation=cv2.INTER_LINEAR)[:h, :w]
    return own + (1 - own[..., 3:]) * up


def clusters(d, k):
    """One-dimensional k-means of a tile's disparities: centres from far to near, and labels."""
    centre = np.quantile(d, (np.arange(k) + 0.5) / k) * 0.5 + np.linspace(d.min(), d.max(), k) * 0.5
    for _ in range(10):
        label = np.abs(d[..., None] - centre).argmin(-1)
        for j in range(k):
            if (label == j).any():
                centre[j] = d[label == j].mean()
        centre.sort()
    label = np.abs(d[..., None] - centre).argmin(-1)
    used = np.unique(label)
    return centre[used], np.searchsorted(used, label)


def tile_of(scene, x0, y0, rng):
    """Inputs [L,9,64,64], disparities and exact hidden colours of one tile's layers; none for a flat tile."""
    photo, d = scene["photo"], scene["estimate"]
    at = np.s_[y0 : y0 + TILE, x0 : x0 + TILE]
    part = d[at]
    if part.max() - part.min() < 0.03:
        return None
    centre, label = clusters(part, rng.choice([2, 3, 4]))
    if len(centre) < 2:
        return None
    h, w = d.shape
    top, left = max(0, y0 - CONTEXT), max(0, x0 - CONTEXT)
    around = np.s_[top : min(h, y0 + TILE + CONTEXT), left : min(w, x0 + TILE + CONTEXT)]
    rgb, visible = photo[at], centre[label]
    layers, truth = [], []
    for j, c in enumerate(centre):
        behind = c - d[around]
        weight = np.where((behind > -0.015) & ~scene["rim"][around], 1 / (1 + (np.maximum(behind, 0) / 0.06) ** 2), 0)
        fill = pyramid(photo[around], weight.astype(np.float32))
        fill = (fill[..., :3] / np.maximum(fill[..., 3:], 1e-6))[y0 - top : y0 - top + TILE, x0 - left : x0 - left + TILE]
        own = label == j
        hidden = ~own & (visible > c)
        initial = np.where(hidden[..., None], fill, rgb)
        known = hidden & (np.abs(scene["hidden_d"][at] - c) < 0.03) & (scene["hidden_d"][at] > 0)
        layers.append(np.concatenate([initial, rgb, own[..., None], np.clip((visible - c) * 8, -1, 1)[..., None], hidden[..., None]], -1))
        truth.append(np.concatenate([scene["hidden"][at], known[..., None]], -1))
    tensor = lambda v: torch.from_numpy(np.stack(v).astype(np.float32)).permute(0, 3, 1, 2)
    return tensor(layers), torch.tensor(centre, dtype=torch.float32), tensor(truth)


def load_scene(folder, spoil):
    about = common.read_scene(folder)
    f = common.Path(folder)
    rgb = lambda name: common.read_rgb(f / name).astype(np.float32) / 255
    d = common.read_disparity(f / "disparity.png")
    scene = {"photo": rgb("photo.png"), "disparity": d, "hidden": rgb("hidden_photo.png"), "hidden_d": common.read_disparity(f / "hidden_disparity.png")}
    # edges of an estimate are a little off; half of the scenes train with such a map
    scene["estimate"] = cv2.medianBlur(cv2.resize(cv2.resize(d, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), d.shape[::-1], interpolation=cv2.INTER_NEAREST), 5) if spoil else d
    e = scene["estimate"]
    scene["rim"] = cv2.dilate(e, np.ones((3, 3))) - e > 0.03
    scene["k"] = about["intrinsics"]
    scene["views"] = [(v["pose"], rgb(v["photo"]), common.read_disparity(f / v["disparity"])) for v in about["views"]]
    return scene


def sampled(layer, delta, window, origin, k, pose):
    """Samples [L,C,64,64] layers of planes `delta` at the pixels of a target window; second result: sampled inside the tile."""
    s = 1 - delta * pose["tz"]
    ys, xs = torch.meshgrid(torch.arange(TILE) + 0.5, torch.arange(TILE) + 0.5, indexing="ij")
    x = (xs + window[0] - k["cx"])[None] * s[:, None, None] + (k["fx"] * delta * pose["tx"])[:, None, None] + k["cx"] - origin[0]
    y = (ys + window[1] - k["cy"])[None] * s[:, None, None] + (k["fy"] * delta * pose["ty"])[:, None, None] + k["cy"] - origin[1]
    grid = torch.stack([x, y], -1) * (2 / TILE) - 1
    inside = ((x > 0) & (x < TILE) & (y > 0) & (y < TILE))[:, None].float()
    return F.grid_sample(layer, grid, align_corners=False, padding_mode="border"), inside


def composite(colour, alpha):
    """Far to near over [L,…]; returns colour and what is left uncovered."""
    out, left = torch.zeros_like(colour[0]), torch.ones_like(alpha[0])
    for c, a in zip(colour, alpha):
        out, left = out * (1 - a) + c * a, left * (1 - a)
    return out, left


def make_samples(folders, per_scene, seed):
    """Everything that does not depend on the network, once for all steps."""
    samples = []
    for f in folders:
        rng = random.Random(f"{seed} {f.name}")
        scene = load_scene(f, rng.random() < 0.5)
        h, w = scene["disparity"].shape
        tries = 0
        found = 0
        while found < per_scene and tries < per_scene * 5:
            tries += 1
            x0, y0 = rng.randrange(0, w - TILE + 1), rng.randrange(0, h - TILE + 1)
            t = tile_of(scene, x0, y0, rng)
            if t is None:
                continue
            layers, delta, truth = t
            pose, view, view_d = rng.choice(scene["views"])
            middle = float(delta.mean())
            k, s = scene["k"], 1 - middle * pose["tz"]
            # where the tile's centre goes
            cx = ((x0 + 32 - k["cx"]) - k["fx"] * middle * pose["tx"]) / s + k["cx"]
            cy = ((y0 + 32 - k["cy"]) - k["fy"] * middle * pose["ty"]) / s + k["cy"]
            wx, wy = round(cx - 32), round(cy - 32)
            if wx < 0 or wy < 0 or wx + TILE > w or wy + TILE > h:
                continue
            cut = np.s_[wy : wy + TILE, wx : wx + TILE]
            own, hidden = layers[:, 6:7], layers[:, 8:9]
            hard, inside = sampled(torch.clamp(own + hidden, 0, 1), delta, (wx, wy), (x0, y0), k, pose)
            _, left = composite(hard, hard)
            # what the second camera truly sees must lie on this tile
            z = 1 / np.maximum(view_d[cut], 1e-4)
            px, py = np.meshgrid(np.arange(TILE) + wx + 0.5, np.arange(TILE) + wy + 0.5)
            zz = z + pose["tz"]
            rx = ((px - k["cx"]) / k["fx"] * z + pose["tx"]) / zz * k["fx"] + k["cx"] - x0
            ry = ((py - k["cy"]) / k["fy"] * z + pose["ty"]) / zz * k["fy"] + k["cy"] - y0
            true_inside = torch.from_numpy((rx > 0) & (rx < TILE) & (ry > 0) & (ry < TILE))[None]
            mask = (inside.min(0).values > 0) & (left < 0.02) & true_inside
            if mask.float().mean() < 0.3:
                continue
            found += 1
            samples.append({
                "layers": layers.half(), "delta": delta, "truth": truth.half(), "mask": mask.float(), "k": k, "pose": pose,
                "window": (wx, wy), "origin": (x0, y0), "view": torch.from_numpy(view[cut].copy()).permute(2, 0, 1).half(),
            })
    return samples


def render(sample, alpha, background):
    layers = sample["layers"].float()
    own, hidden = layers[:, 6:7], layers[:, 8:9]
    a = torch.maximum(alpha, hidden)
    colour = torch.where(hidden > 0, background, layers[:, 3:6])
    # premultiplied, so that a layer's empty texels do not bleed in
    warped, _ = sampled(torch.cat([colour * a, a], 1), sample["delta"], sample["window"], sample["origin"], sample["k"], sample["pose"])
    out = torch.zeros_like(warped[0, :3])
    for w in warped:
        out = out * (1 - w[3:]) + w[:3]
    return out


def losses(net, batch):
    x = torch.cat([s["layers"].float() for s in batch])
    alpha, background = net(x)
    truth = torch.cat([s["truth"].float() for s in batch])
    known = truth[:, 3:]
    hidden = ((background - truth[:, :3]).abs() * known).sum() / (3 * known.sum()).clamp_min(1)
    views, wanted, masks, at = [], [], [], 0
    for s in batch:
        n = len(s["delta"])
        views.append(render(s, alpha[at : at + n], background[at : at + n]))
        wanted.append(s["view"].float())
        masks.append(s["mask"])
        at += n
    v, t, m = torch.stack(views), torch.stack(wanted), torch.stack(masks)
    # outside the mask both are the truth, so that windows of SSIM may overlap its rim
    v = v * m + t * (1 - m)
    area = m.sum().clamp_min(1)
    l1 = ((v - t).abs() * m).sum() / (3 * area)
    structure = (1 - common.ssim(v, t)).mean()
    mse = ((v - t) ** 2 * m).sum() / (3 * area)
    return l1 + 0.3 * structure + 0.5 * hidden, {"l1": l1, "ssim": structure, "hidden": hidden, "mse": mse}


def recoloured(sample, rng):
    """The same tile in other colours: channels permuted and scaled, so that no scene's colours are learnt by heart."""
    order = torch.tensor(rng.sample(range(3), 3))
    gain = torch.tensor([rng.uniform(0.6, 1.15) for _ in range(3)]).view(3, 1, 1)
    layers, truth = sample["layers"].float(), sample["truth"].float()
    def turn(c):
        return (c[..., order, :, :] * gain).clamp(0, 1)
    layers = torch.cat([turn(layers[:, :3]), turn(layers[:, 3:6]), layers[:, 6:]], 1)
    truth = torch.cat([turn(truth[:, :3]), truth[:, 3:]], 1)
    return {**sample, "layers": layers, "truth": truth, "view": turn(sample["view"].float())}


class Nothing(nn.Module):
    """The layers as they come: the bar to beat."""

    def forward(self, x):
        own = x[:, 6:7]
        return torch.maximum(own, F.avg_pool2d(own, 3, 1, 1)), x[:, :3]


@torch.no_grad()
def measure(net, samples):
    rows = [{k: float(v) for k, v in losses(net, samples[i : i + 16])[1].items()} for i in range(0, len(samples), 16)]
    return {k: float(np.mean([r[k] for r in rows])) for k in rows[0]}


def main():
    a = argparse.ArgumentParser(description=__doc__)
    a.add_argument("--scenes", nargs="+", default=[str(RUNS / "data" / "views")])
    a.add_argument("--held", nargs="+", default=[str(RUNS / "data" / "held")], help="scenes that are only measured on")
    a.add_argument("--out", default=str(RUNS / "psi"))
    a.add_argument("--steps", type=int, default=2500)
    a.add_argument("--minutes", type=float, default=1e9, help="processor minutes to end by, with the schedule drawn out over them")
    a.add_argument("--batch", type=int, default=12)
    a.add_argument("--per-scene", type=int, default=8)
    a.add_argument("--threads", type=int, default=1)
    a.add_argument("--seed", type=int, default=3)
    a.add_argument("--measure", metavar="MODEL", help="measure psi.onnx against nothing on the held-out scenes, and end")
    a = a.parse_args()
    torch.set_num_threads(a.threads)
    cv2.setNumThreads(1)
    common.seed_all(a.seed)
    held = make_samples(common.scenes(*a.held), 9, 99)
    bar = measure(Nothing(), held)
    print("without Ψ", {k: round(v, 5) for k, v in bar.items()}, f"{len(held)} tiles", flush=True)
    if a.measure:
        from graph import run

        net = lambda x: [torch.from_numpy(v) for v in run(a.measure, {"layers": x})]
        print("with Ψ   ", {k: round(v, 5) for k, v in measure(net, held).items()})
        return
    out = common.Path(a.out)
    out.mkdir(parents=True, exist_ok=True)
    net = Psi()
    optimiser = torch.optim.AdamW(net.parameters(), 2e-3, weight_decay=3e-3)
    ema = common.Ema(net, 0.99)
    step, spent = 0, 0.0
    if (out / "last.pt").exists():
        s = torch.load(out / "last.pt", weights_only=False)
        net.load_state_dict(s["live"])
        optimiser.load_state_dict(s["optimiser"])
        ema.shadow, step, spent = s["model"], s["step"], s["spent"]
    start = time.process_time() - spent
    samples = make_samples(common.scenes(*a.scenes), a.per_scene, a.seed)
    print(len(samples), "tiles", flush=True)
    log = common.Log(out / "log.csv", ["step", "loss", "l1", "ssim", "hidden", "mse"])
    seen, smoothed = [], Psi()
    while step < a.steps:
        done = max(step / a.steps, (time.process_time() - start) / 60 / a.minutes)
        for group in optimiser.param_groups:
            group["lr"] = 2e-3 * (min(1, (step + 1) / 50) * (0.5 + 0.5 * np.cos(np.pi * min(1, done))) + 0.01)
        if done < 1:
            rng = random.Random(a.seed * 1_000_003 + step)
            loss, _ = losses(net, [recoloured(s, rng) for s in rng.sample(samples, a.batch)])
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimiser.step()
            step += 1
            ema.update(net, step)
            seen.append(loss.item())
        if step % 400 == 0 or done >= 1:
            smoothed.load_state_dict(ema.shadow)
            log.row(step=step, loss=float(np.mean(seen[-200:])), **measure(smoothed, held))
            common.save(out / "last.pt", live=net.state_dict(), model=ema.shadow, optimiser=optimiser.state_dict(), step=step, spent=time.process_time() - start)
        if done >= 1:
            break


if __name__ == "__main__":
    main()
