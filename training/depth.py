"""Trains the monocular depth network: frozen encoders and a small decoder, on rendered scenes and a few photographs labelled by hand."""

import argparse
import json
import random
import time

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

import common
import graph
import yolox
from common import DATA, RUNS
from yolox import Yolox

# (height, width) of batches; small ones first, then those of about the area used at inference
LARGE = [(160, 224), (224, 160), (192, 192), (128, 256), (160, 256), (192, 224), (128, 288), (256, 160), (224, 192), (288, 128)]
SMALL = [(128, 192), (192, 128), (160, 160), (128, 224), (160, 192), (128, 160), (96, 192), (160, 224)]
ENCODER = DATA / "pretrained" / "mobilenet_v2_1.0_imagenet.npz"


class MobileNetV2(nn.Module):
    """Feature maps of strides 2, 4, 8, 16, 32 (16, 24, 32, 96, 320 channels). Input: ImageNet-normalised RGB."""

    CHANNELS = (16, 24, 32, 96, 320)

    def __init__(self, path=ENCODER):
        super().__init__()
        data = np.load(path)
        self.ops = json.loads(data["meta"].tobytes().decode())[:-1]  # the last one is the 1280-channel head
        for op in self.ops:
            if op["op"] == "add":
                continue
            w, k = data[f"{op['k']}.w"], op["k"]
            w = w.transpose(3, 0, 1, 2) if op["op"] == "dw" else w.transpose(0, 3, 1, 2)
            self.register_buffer(f"w{k}", torch.from_numpy(w.copy()))
            self.register_buffer(f"b{k}", torch.from_numpy(data[f"{op['k']}.b"].copy()))
        # the network was trained on RGB/127.5 − 1
        std, mean = torch.tensor([0.229, 0.224, 0.225]), torch.tensor([0.485, 0.456, 0.406])
        self.register_buffer("scale", (2 * std)[None, :, None, None])
        self.register_buffer("shift", (2 * mean - 1)[None, :, None, None])
        self.taps = self._taps()

    def _taps(self):
        """The last linear output before each halving, and the last of all."""
        linear = [op for op in self.ops if op["op"] == "add" or op["act"] == "linear"]
        last = {}
        for op in linear:
            last[op["oshape"][1]] = op["o"]
        return [last[s] for s in sorted(last, reverse=True)]

    def after(self, op, o):
        """What follows a convolution: nothing, its BatchNorm is folded into it."""
        return o

    def forward(self, x):
        value = {self.ops[0]["i"]: x * self.scale + self.shift}
        for op in self.ops:
            i = value[op["i"]]
            if op["op"] == "add":
                value[op["o"]] = i + value[op["i2"]]
                continue
            w, b = getattr(self, f"w{op['k']}"), getattr(self, f"b{op['k']}")
            groups = w.shape[0] if op["op"] == "dw" else 1
            pad = 0
            if w.shape[-1] == 3:
                if op["stride"] == 2:
                    i = F.pad(i, (0, 1, 0, 1))  # TensorFlow's SAME for even sizes
                else:
                    pad = 1
            o = self.after(op, F.conv2d(i, w, b, op["stride"], pad, 1, groups))
            value[op["o"]] = o.clamp(0, 6) if op["act"] == "relu6" else o
        return [value[t] for t in self.taps]


def block(i, o):
    return nn.Sequential(nn.Conv2d(i, o, 3, padding=1, bias=False), nn.BatchNorm2d(o), nn.ReLU())


class Decoder(nn.Module):
    """Top-down pyramid with one 3×3 convolution a level and the mean of the coarsest level as context."""

    def __init__(self, channels=MobileNetV2.CHANNELS, width=(12, 24, 40, 64, 96), drop=0.1):
        super().__init__()
        self.top = nn.Sequential(nn.Conv2d(channels[4] + 1, width[4], 1), nn.ReLU())
        self.context = nn.Sequential(nn.Conv2d(width[4], width[4], 1), nn.ReLU(), nn.Conv2d(width[4], width[4], 1))
        self.mix = block(width[4], width[4])
        self.side = nn.ModuleList(nn.Conv2d(channels[i], width[i], 1) for i in range(4))
        self.join = nn.ModuleList(block(width[i] + width[i + 1], width[i]) for i in range(4))
        self.drop = nn.Dropout2d(drop)
        self.head = nn.Conv2d(width[0], 1, 3, padding=1)

    def forward(self, features):
        f5 = features[4]
        one = torch.ones_like(f5[:, :1])
        row = torch.cumsum(one, 2) / one.sum(2, keepdim=True)
        x = self.top(torch.cat([self.drop(f5), row * 2 - 1], 1))
        x = self.mix(x + self.context(x.mean((2, 3), keepdim=True)))
        for i in (3, 2, 1, 0):
            x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
            x = self.join[i](torch.cat([x, self.side[i](self.drop(features[i]) if i else features[i])], 1))
        return F.interpolate(self.head(x), scale_factor=2, mode="bilinear", align_corners=False)


class Untrained(MobileNetV2):
    """The same layers with random weights that are trained along, each with a BatchNorm of its own: what the pretrained start is worth."""

    def __init__(self):
        super().__init__()
        self.norms = nn.ModuleDict()
        for op in self.ops:
            if op["op"] != "add":
                w = getattr(self, f"w{op['k']}")
                delattr(self, f"w{op['k']}")
                self.register_parameter(f"w{op['k']}", nn.Parameter(nn.init.kaiming_normal_(torch.empty_like(w))))
                setattr(self, f"b{op['k']}", None)
                self.norms[str(op["k"])] = nn.BatchNorm2d(w.shape[0])

    def after(self, op, o):
        return self.norms[str(op["k"])](o)


class Encoders(nn.Module):
    """MobileNetV2, and beside it, where `both`, YOLOX-nano: its maps of strides 8, 16, 32 stand behind the other's channels."""

    def __init__(self, both, untrained=False):
        super().__init__()
        self.classifier, self.detector = Untrained() if untrained else MobileNetV2(), Yolox() if both else None
        self.channels = MobileNetV2.CHANNELS
        if both:
            self.channels = self.channels[:2] + tuple(a + b for a, b in zip(self.channels[2:], Yolox.CHANNELS))

    def forward(self, x):
        f = self.classifier(x)
        return f if self.detector is None else f[:2] + [torch.cat(p, 1) for p in zip(f[2:], self.detector(x))]

    def written(self, g, x):
        """The same into a graph."""
        f = graph.encoder(g, x, self.classifier)
        if self.detector is not None:
            f[2:] = [g.op("Concat", *p, axis=1) for p in zip(f[2:], yolox.written(g, x, self.detector))]
        return f


class DepthNet(nn.Module):
    def __init__(self, both=False, drop=0.1, untrained=False):
        super().__init__()
        self.encoder, self.session, self.untrained = Encoders(both, untrained), None, untrained
        self.decoder = Decoder(self.encoder.channels, drop=drop)

    @staticmethod
    def of(checkpoint):
        """The network of a checkpoint, of its running mean where it has one: its decoder tells what it was trained behind."""
        decoder = checkpoint.get("ema", checkpoint["decoder"])
        net = DepthNet(decoder["top.0.weight"].shape[1] > MobileNetV2.CHANNELS[4] + 1)
        net.decoder.load_state_dict(decoder)
        return net

    def forward(self, image):
        # channels last is a third faster on a CPU
        return self.decoder([f.contiguous(memory_format=torch.channels_last) for f in self.features(image)])

    def features(self, image):
        if self.session is not None and image.device.type == "cpu":
            return [torch.from_numpy(f) for f in self.session.run(None, {"image": image.numpy()})]
        with torch.set_grad_enabled(self.untrained and self.training):
            return self.encoder(image)

    def use_runtime(self, path, threads):
        """Runs the frozen encoder in ONNX Runtime, which is twice as fast as PyTorch on a CPU."""
        g = graph.Graph("encoder", half=False)
        for i, f in enumerate(self.encoder.written(g, g.input("image", ["n", 3, "h", "w"]))):
            g.output(f, f"f{i}", ["n", self.encoder.channels[i], None, None])
        g.save(path, {})
        self.runtime(path, threads)

    def runtime(self, path, threads):
        """The same, from the file that is there."""
        import onnxruntime as ort

        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        self.session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


class Shipped(nn.Module):
    """What is exported: the network's map with deviation 1, plus a ramp of deviation `ramp` that rises towards the lower border.

    Photographs have more of a vertical trend than the rendered scenes; `ramp` is chosen on real pictures."""

    def __init__(self, net, ramp):
        super().__init__()
        self.net, self.ramp = net, ramp

    def forward(self, image):
        p = self.net(image)
        row = torch.cumsum(torch.ones_like(p), 2)
        return unit(p) + self.ramp * unit(row)


def unit(x):
    """Mean 0 and deviation 1 per picture."""
    x = x - x.mean((2, 3), keepdim=True)
    return x / torch.sqrt((x * x).mean((2, 3), keepdim=True) + 1e-12)


MEAN = torch.tensor([0.485, 0.456, 0.406])[:, None, None]
STD = torch.tensor([0.229, 0.224, 0.225])[:, None, None]


def normalised(x, known):
    """Median 0 and mean absolute value 1 per picture, of what is known."""
    flat, known = x.flatten(1), known.flatten(1)
    middle = flat.masked_fill(~known, torch.nan).nanmedian(1, keepdim=True).values
    spread = ((flat - middle).abs() * known).sum(1, keepdim=True) / known.sum(1, keepdim=True)
    return ((flat - middle) / spread.clamp_min(1e-4)).view_as(x)


def mean_of(x, known):
    """Mean of what is known."""
    return (x * known).sum() / known.sum().clamp_min(1)


def loss_of(prediction, target):
    """Scale- and shift-invariant L1 with gradients at four scales; NaN in the target counts for nothing."""
    known = ~target.isnan()
    target = target.nan_to_num(0)
    e = (normalised(prediction, known) - normalised(target, known).clamp(-6, 6)) * known
    loss = mean_of(e.abs(), known)
    for s in range(4):
        share = known.float() if s == 0 else F.avg_pool2d(known.float(), 2**s)
        d, full = (e, known) if s == 0 else (F.avg_pool2d(e, 2**s), share > 0.999)
        across, down = full[..., 1:] & full[..., :-1], full[..., 1:, :] & full[..., :-1, :]
        loss = loss + 0.25 * (mean_of((d[..., 1:] - d[..., :-1]).abs(), across) + mean_of((d[..., 1:, :] - d[..., :-1, :]).abs(), down))
    return loss


# how often a family is drawn: photographs have more ground in them than `tmpi synth` has by itself
SHARE = {
    "room": 0.14, "corridor": 0.03, "lounge": 0.09, "kitchen": 0.08, "street": 0.09, "field": 0.17, "water": 0.05, "terrain": 0.03, "crowd": 0.04,
    "thin": 0.02, "foliage": 0.02, "shelf": 0.06, "heap": 0.06, "table": 0.08, "closeup": 0.05, "drape": 0.03, "figures": 0.04, "floating": 0.01,
}  # fmt: skip
# families that labelled photographs have little of
INDOORS = ("room", "corridor", "lounge", "kitchen", "shelf", "heap", "table", "closeup", "drape")


def families(folders):
    """Scenes by family."""
    found = {}
    for f in folders:
        found.setdefault(common.read_scene(f)["family"], []).append(f)
    return found


def batch_of(kinds, size, n, rng, labels=(), share=0.0):
    """Pictures and disparity; `share` of them are labelled photographs, whose unknown pixels are NaN."""
    xs, ys = [], []
    names = sorted(kinds)
    share = share if labels else 0.0
    # the photographs take the place of scenes outdoors and of figures
    indoors, all_ = (sum(SHARE[k] for k in names if k in of) for of in (INDOORS, names))
    others = max(0.2, (all_ * (1 - share) - indoors) / max(all_ - indoors, 1e-9))
    for kind in rng.choices(names, [SHARE[k] if k in INDOORS else SHARE[k] * others for k in names], k=n):
        if rng.random() < share:
            rgb, d = labelled(labels, size, rng)
        else:
            rgb, d = common.framed(*common.read_pair(rng.choice(kinds[kind])), size, rng)
        xs.append((common.chw(common.photometric(rgb, np.nan_to_num(d), rng)) - MEAN) / STD)
        ys.append(torch.from_numpy(d)[None])
    return torch.stack(xs), torch.stack(ys)


def labelled(labels, size, rng):
    """A crop of a labelled photograph at least half of which is known and has a depth to tell."""
    for _ in range(20):
        rgb, d = common.framed(*common.read_label(rng.choice(labels)), size, rng, 0.4)
        known = ~np.isnan(d)
        if known.mean() > 0.5 and np.ptp(d[known]) > 0.1:
            break
    return rgb, d


def batch_at(kinds, step, done, a):
    """The batch of a step: a function of the seed and of how far the run is."""
    rng = random.Random(a.seed * 1_000_003 + step)
    small = done < a.small
    size = rng.choice(SMALL if small or rng.random() < 0.25 else LARGE)
    labels = sorted(common.Path(a.labels).glob("*.disparity.png")) if a.labels else ()
    return batch_of(kinds, size, a.batch if small else max(4, a.batch * 5 // 8), rng, labels, a.label_share)


def produce(queue, a, first, encoder):
    """Feature maps and truth of every fresh batch from `first` on, made beside the training."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    net, kinds, start = DepthNet(a.encoder == "both"), None, time.time() - a.spent
    if a.encoder != "untrained":
        net.runtime(encoder, 1)
    for step in range(first, a.steps):
        done = max(step / a.steps, (time.time() - start) / 60 / a.minutes)
        if kinds is None or step % 100 == 0:
            kinds = families(common.scenes(*a.scenes))  # scenes may still be coming
        x, y = batch_at(kinds, step, done, a)
        made = [x] if a.encoder == "untrained" else net.features(x)
        queue.put(([f.numpy().astype(np.float16) for f in made], y.numpy(), sum(map(len, kinds.values()))))


def restyled(features, bank):
    """Half of the samples get channel statistics on the way to those of another picture, the same one at every level.

    What the colours and textures of rendered scenes do to the frozen encoder then matters less (MixStyle, Zhou et al. 2021)."""
    n = features[0].shape[0]
    other, share = torch.randperm(n), torch.distributions.Beta(0.3, 0.3).sample((n, 1, 1, 1))
    share = torch.where(torch.rand(n, 1, 1, 1) < 0.5, torch.ones(()), torch.maximum(share, 1 - share) if bank is None else share)
    pick = None if bank is None else torch.randint(len(bank[0]), (n,))
    out = []
    for i, f in enumerate(features):
        mean, std = f.mean((2, 3), keepdim=True), f.std((2, 3), keepdim=True) + 1e-4
        to_mean, to_std = (mean[other], std[other]) if bank is None else (bank[i][pick, 0][..., None, None], bank[i][pick, 1][..., None, None])
        out.append((f - mean) / std * (share * std + (1 - share) * to_std) + share * mean + (1 - share) * to_mean)
    return out


def statistics(net, folder, crops=12, seed=7):
    """Channel means and deviations of the encoder on crops of photographs: per level [N, 2, C]."""
    rng, found = random.Random(seed), []
    for f in sorted(common.Path(folder).iterdir()):
        rgb = common.read_rgb(f)
        for _ in range(crops):
            size = rng.choice(SMALL)
            crop, flat = common.framed(rgb, np.zeros(rgb.shape[:2], np.float32), size, rng)
            x = ((common.chw(common.photometric(crop, flat, rng)) - MEAN) / STD)[None]
            found.append([torch.stack([v.mean((2, 3))[0], v.std((2, 3))[0] + 1e-4]) for v in net.features(x)])
    return [torch.stack([f[i] for f in found]) for i in range(5)]


def main():
    a = argparse.ArgumentParser(description=__doc__)
    a.add_argument("--scenes", nargs="+", default=[str(RUNS / "data" / "train")])
    a.add_argument("--out", default=str(RUNS / "depth"))
    a.add_argument("--steps", type=int, default=1600)
    a.add_argument("--minutes", type=float, default=1e9, help="end by then, with the schedule drawn out over that time")
    a.add_argument("--batch", type=int, default=16)
    a.add_argument("--lr", type=float, default=2e-3)
    a.add_argument("--every", type=int, default=100, help="steps between evaluations on real pictures")
    a.add_argument("--threads", type=int, default=1)
    a.add_argument("--small", type=float, default=0.5, help="share of the steps at small sizes")
    a.add_argument("--replay", type=int, default=1, help="how often an earlier batch is taken again after each fresh one")
    a.add_argument("--style", choices=["off", "batch", "photos"], default="off", help="whose channel statistics are mixed in")
    a.add_argument("--pictures", default=str(RUNS / "pictures"), help="photographs for --style photos")
    a.add_argument("--labels", help="photographs labelled by hand, as `labels.py` writes them")
    a.add_argument("--label-share", type=float, default=0.3, help="share of them in a batch")
    a.add_argument("--encoder", choices=["untrained", "mobilenet", "both"], default="both", help="MobileNetV2 with random weights, as it is, or with YOLOX-nano beside it")
    a.add_argument("--ramp", type=float, default=0.2, help="share of the vertical ramp by which checkpoints are measured")
    a.add_argument("--drop", type=float, default=0.1, help="share of the encoder's channels that each sample goes without")
    a.add_argument("--ema", type=float, default=0.995, help="decay of the mean over weights")
    a.add_argument("--init", help="checkpoint whose decoder to begin with, its running mean where it has one")
    a.add_argument("--seed", type=int, default=1)
    a = a.parse_args()
    from eval_depth import evaluate, load_sets  # here, because it needs DepthNet

    torch.set_num_threads(a.threads)
    cv2.setNumThreads(1)
    common.seed_all(a.seed)
    out = common.Path(a.out)
    out.mkdir(parents=True, exist_ok=True)
    dev = common.device()
    untrained = a.encoder == "untrained"
    net = DepthNet(a.encoder == "both", a.drop, untrained).to(dev)
    if dev.type == "cpu" and not untrained:
        net.use_runtime(out / "encoder.onnx", a.threads)
    net.decoder.to(memory_format=torch.channels_last)
    params = list(net.parameters())
    optimiser = torch.optim.AdamW(params, a.lr, weight_decay=1e-2)
    if a.init:
        begun = torch.load(a.init, weights_only=False, map_location=dev)
        net.decoder.load_state_dict(begun.get("ema", begun["decoder"]))
    ema = common.Ema(net.decoder, a.ema)
    step, best, a.spent = 0, 9.0, 0.0
    if (out / "last.pt").exists():
        s = torch.load(out / "last.pt", weights_only=False)
        net.decoder.load_state_dict(s["decoder"])
        optimiser.load_state_dict(s["optimiser"])
        ema.shadow, step, best, a.spent = s["ema"], s["step"], s["best"], s["spent"]
    sets = load_sets("choose")
    log = common.Log(out / "log.csv", ["step", "loss", "scenes", *sets, "score"])
    bank = statistics(net, a.pictures) if a.style == "photos" else None
    kinds, losses, kept = None, [], []
    queue = None
    if dev.type == "cpu":
        spawn = torch.multiprocessing.get_context("spawn")
        queue = spawn.Queue(6)
        spawn.Process(target=produce, args=(queue, a, step, out / "encoder.onnx"), daemon=True).start()
    start = time.time() - a.spent
    while step < a.steps:
        done = min(1, max(step / a.steps, (time.time() - start) / 60 / a.minutes))
        for group in optimiser.param_groups:
            group["lr"] = a.lr * (min(1, (step + 1) / 50) * (0.5 + 0.5 * np.cos(np.pi * done)) + 0.01)
        if queue is not None:
            kept.append(queue.get())
        else:
            if kinds is None or step % 100 == 0:
                kinds = families(common.scenes(*a.scenes))
            x, y = batch_at(kinds, step, done, a)
            made = [x] if untrained else net.features(x.to(dev))
            kept.append(([f.cpu().numpy() for f in made], y.numpy(), sum(map(len, kinds.values()))))
        del kept[:-200]
        again = random.Random(a.seed * 7_000_003 + step)
        net.train()
        for k in range(1 + a.replay):
            f, y, scenes = kept[-1] if k == 0 else again.choice(kept)
            f = [torch.from_numpy(v).to(dev).float() for v in f]
            if untrained:
                f = net.features(f[0])
            elif a.style != "off":
                f = restyled(f, bank)
            loss = loss_of(net.decoder([v.contiguous(memory_format=torch.channels_last) for v in f]), torch.from_numpy(y).to(dev))
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(params, 1.0)
            optimiser.step()
            ema.update(net.decoder, step)
            losses.append(loss.item())
        step += 1
        if step % 20 == 0:
            print(f"step {step} loss {np.mean(losses[-20 * (1 + a.replay) :]):.4f}", flush=True)
        ended = step == a.steps or time.time() - start >= 60 * a.minutes
        if step % a.every == 0 or ended:
            live = {k: v.clone() for k, v in net.decoder.state_dict().items()}
            net.decoder.load_state_dict(ema.shadow)
            scores = evaluate(Shipped(net.eval(), a.ramp), sets)
            score = float(np.mean([v["net"] for v in scores.values()]))
            if score < best:
                best = score
                common.save(out / "best.pt", decoder=ema.shadow, step=step, scores=scores)
            net.decoder.load_state_dict(live)
            log.row(step=step, loss=float(np.mean(losses[-a.every * (1 + a.replay) :])), scenes=scenes, **{k: v["net"] for k, v in scores.items()}, score=score)
            common.save(out / "last.pt", decoder=live, ema=ema.shadow, optimiser=optimiser.state_dict(), step=step, best=best, spent=time.time() - start)
        if ended:
            break


if __name__ == "__main__":
    main()
