"""The monocular depth network: two frozen encoders, a small decoder, and how it is written into a graph."""

import json

import numpy as np
import onnx
import onnxruntime as ort
import torch
import torch.nn.functional as F
from torch import nn

import graph
import yolox
from paths import DATA
from yolox import Yolox

ENCODER = DATA / "pretrained" / "mobilenet_v2_1.0_imagenet.npz"
# what the frozen encoders are read from
FILES = (ENCODER, yolox.FILE)


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

    def forward(self, x):
        return self.run(self.ops[0]["i"], x * self.scale + self.shift, self.ops, self.taps)

    def split(self):
        """Number of layers up to the map of stride 8, from which the later stages need nothing else."""
        return next(n for n, op in enumerate(self.ops) if op["o"] == self.taps[2]) + 1

    def later(self, f3):
        """The maps of strides 16 and 32 from that of stride 8: nine tenths of the weights, a third of the work."""
        return self.run(self.taps[2], f3, self.ops[self.split() :], self.taps[3:])

    def unfreeze(self):
        """Makes the weights of the later stages learnable, and returns them."""
        names = [f"{n}{op['k']}" for op in self.ops[self.split() :] if op["op"] != "add" for n in "wb"]
        for name in names:
            value = getattr(self, name)
            delattr(self, name)
            self.register_parameter(name, nn.Parameter(value))
        return [getattr(self, name) for name in names]

    def run(self, start, x, ops, wanted):
        """The maps `wanted` after `ops`, where `x` is the map that `start` names."""
        value = {start: x}
        for op in ops:
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
            o = F.conv2d(i, w, b, op["stride"], pad, 1, groups)
            value[op["o"]] = o.clamp(0, 6) if op["act"] == "relu6" else o
        return [value[t] for t in wanted]


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
        """The map at the picture's size, from that at half of it."""
        return F.interpolate(self.half(features), scale_factor=2, mode="bilinear", align_corners=False)

    def half(self, features):
        """The map at half of the picture's size, which is what is learnt: the rest is enlarging."""
        f5 = features[4]
        one = torch.ones_like(f5[:, :1])
        row = torch.cumsum(one, 2) / one.sum(2, keepdim=True)
        x = self.top(torch.cat([self.drop(f5), row * 2 - 1], 1))
        x = self.mix(x + self.context(x.mean((2, 3), keepdim=True)))
        for i in (3, 2, 1, 0):
            x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
            side = self.side[i](self.drop(features[i]) if i else features[i])
            conv, *rest = self.join[i]
            # one convolution over both, without a copy of both side by side: its backward pass would be three times as slow
            own, other = conv.weight.split([x.shape[1], side.shape[1]], 1)
            x = F.conv2d(x, own, conv.bias, padding=1) + F.conv2d(side, other, padding=1)
            for part in rest:
                x = part(x)
        return self.head(x)

    def layers(self):
        """Convolutions in the order in which `graph.decoder` writes them, each with the BatchNorm that is folded into it there, or None."""
        joined = [(c, None) for c in (self.top[0], self.context[0], self.context[2])] + [tuple(self.mix[:2])]
        for i in (3, 2, 1, 0):
            joined += [(self.side[i], None), tuple(self.join[i][:2])]
        return [*joined, (self.head, None)]

    def both(self):
        """Whether this decoder was made for the maps of both encoders, not MobileNetV2's alone."""
        return self.top[0].in_channels > MobileNetV2.CHANNELS[4] + 1

    def seen(self, features):
        """Of the encoders' feature maps those channels that this decoder was made for; MobileNetV2's stand first."""
        return features if self.both() else [f[:, :c] for f, c in zip(features, MobileNetV2.CHANNELS)]

    @torch.no_grad()
    def take(self, path, batches=(), nth=-1):
        """The weights of an exported network, of its `nth` decoder, counted from the last, which is -1. What its BatchNorm was is not in the file: mean and deviation are measured on
        `batches` of feature maps; without any the network is the same, but no start to learn from."""
        n = len(self.layers())
        found = convolutions(path)[nth * n : (nth + 1) * n or None]
        norms = {}
        for (conv, norm), (weight, bias) in zip(self.layers(), found, strict=True):
            conv.weight.copy_(weight)
            if norm is None:
                conv.bias.copy_(bias)
                continue
            norm.running_mean.zero_()
            norm.running_var.fill_(1 - norm.eps)
            norm.weight.fill_(1)
            norm.bias.copy_(bias)
            norms[norm] = []
        hooks = [n.register_forward_pre_hook(lambda n, x: norms[n].append(torch.stack([x[0].mean((0, 2, 3)), x[0].square().mean((0, 2, 3))]))) for n in norms]
        self.eval()
        for features in batches:
            self.half(features)
        for norm, hook in zip(norms, hooks):
            hook.remove()
            if not norms[norm]:
                continue
            mean, square = torch.stack(norms[norm]).mean(0)
            norm.running_mean.copy_(mean)
            norm.running_var.copy_((square - mean.square()).clamp_min(1e-6))
            norm.weight.copy_((norm.running_var + norm.eps).sqrt())
            norm.bias.add_(mean)


def told(path):
    """What an exported network says of itself, by name."""
    return {p.key: p.value for p in onnx.load(str(path), load_external_data=False).metadata_props}


def decoders(path):
    """How many decoders an exported network has."""
    return int(told(path).get("decoders", 1))


def convolutions(path):
    """Weights and biases of an exported network's convolutions, in its order."""
    written = onnx.load(str(path)).graph
    values = {i.name: onnx.numpy_helper.to_array(i).astype(np.float32) for i in written.initializer}
    # large weights are stored as float16 and cast
    values |= {n.output[0]: values[n.input[0]] for n in written.node if n.op_type == "Cast" and n.input[0] in values}
    return [tuple(torch.from_numpy(values[i].copy()) for i in n.input[1:]) for n in written.node if n.op_type == "Conv"]


class Encoders(nn.Module):
    """MobileNetV2, and beside it, where `both`, YOLOX-nano: its maps of strides 8, 16, 32 stand behind the other's channels."""

    def __init__(self, both):
        super().__init__()
        self.classifier, self.detector = MobileNetV2(), Yolox() if both else None
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
    def __init__(self, both=True, drop=0.1):
        super().__init__()
        self.encoder, self.session, self.tuned = Encoders(both), None, False
        self.decoder = Decoder(self.encoder.channels, drop=drop)

    @staticmethod
    def of(checkpoint):
        """The network of a checkpoint, by the running mean of its weights: its decoder tells which encoders it was trained behind."""
        mean = checkpoint["mean"]
        top = mean.get("decoder.top.0.weight", mean.get("top.0.weight"))
        net = DepthNet(top.shape[1] > MobileNetV2.CHANNELS[4] + 1)
        net.load(checkpoint)
        net.tuned = "decoder.top.0.weight" in mean
        return net.eval()

    @staticmethod
    def exported(path, nth=-1):
        """The network of a file: its decoder, of several the `nth`, counted from the last, behind the encoders as they are published."""
        net = DepthNet()
        top = convolutions(path)[nth * len(net.decoder.layers())][0]
        net = DepthNet(top.shape[1] > MobileNetV2.CHANNELS[4] + 1)
        net.decoder.take(path, nth=nth)
        return net.eval()

    def load(self, checkpoint):
        """Takes the running mean of a checkpoint's weights: of the decoder alone, or of the whole network where its encoder was trained too."""
        mean = checkpoint["mean"]
        (self if "decoder.top.0.weight" in mean else self.decoder).load_state_dict(mean)

    def retaken(self, features):
        """Feature maps whose part of MobileNetV2's later stages is taken again, by their weights as they are now, from the map of stride 8."""
        c = MobileNetV2.CHANNELS
        later = self.encoder.classifier.later(features[2][:, : c[2]])
        return features[:3] + [torch.cat([new, old[:, new.shape[1] :]], 1) for new, old in zip(later, features[3:])]

    def forward(self, image):
        # channels last is a third faster on a CPU
        return self.decoder([f.contiguous(memory_format=torch.channels_last) for f in self.features(image)])

    def features(self, image):
        if self.session is not None and image.device.type == "cpu":
            return [torch.from_numpy(f) for f in self.session.run(None, {"image": image.numpy()})]
        with torch.no_grad():
            return self.encoder(image)

    def use_runtime(self, path, threads=1):
        """Runs the frozen encoders in ONNX Runtime, which is five times as fast as PyTorch on a CPU; `path` is where their graph goes."""
        g = graph.Graph("encoder", half=False)
        for i, f in enumerate(self.encoder.written(g, g.input("image", ["n", 3, "h", "w"]))):
            g.output(f, f"f{i}", ["n", self.encoder.channels[i], None, None])
        g.save(path, {})
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        self.session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


class Mean(nn.Module):
    """Several decoders behind the same frozen encoders: the mean of their maps, each with deviation 1, and of the mirrored picture's, where `mirrored`.

    Decoders that learnt from other mixtures or seeds are wrong in other places."""

    def __init__(self, nets, mirrored=False):
        super().__init__()
        self.encoder = max((n.encoder for n in nets), key=lambda e: e.channels)
        self.decoders, self.mirrored = nn.ModuleList(n.decoder for n in nets), mirrored

    @staticmethod
    def of(files, mirrored=False):
        """The mean of the networks of checkpoints and of exported networks; of one that is a mean itself all decoders are taken."""
        nets = []
        for f in files:
            if str(f).endswith(".onnx"):
                nets += [DepthNet.exported(f, nth) for nth in range(-decoders(f), 0)]
            else:
                nets.append(DepthNet.of(torch.load(f, weights_only=False, map_location="cpu")))
        if any(n.tuned for n in nets) and len(nets) > 1:
            raise SystemExit("decoders of one network have the same encoders: none whose encoder was trained along")
        return Mean(nets, mirrored)

    def forward(self, image):
        with torch.no_grad():
            features = self.encoder(torch.cat([image, image.flip(3)]) if self.mirrored else image)
        p = sum(unit(d.half(d.seen(features))) for d in self.decoders)
        if self.mirrored:
            p, q = p.chunk(2)
            p = p + q.flip(3)
        return F.interpolate(p, scale_factor=2, mode="bilinear", align_corners=False)


class Shipped(nn.Module):
    """What is exported, the network's map with deviation 1, plus a ramp of deviation `ramp` that rises towards the lower border, which the program adds.

    Photographs have more of a vertical trend than the rendered scenes; `ramp` is chosen on real pictures."""

    def __init__(self, net, ramp=0.0):
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
