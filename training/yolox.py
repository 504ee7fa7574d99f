"""The frozen backbone and neck of YOLOX-nano (Apache-2.0), read from its ONNX file: what a detector knows of things on photographs."""

import numpy as np
import onnx
import torch
import torch.nn.functional as F
from onnx import numpy_helper
from torch import nn

from paths import DATA

FILE = DATA / "pretrained" / "yolox_nano.onnx"


# the neck's maps that the three heads take
TAPS = ("956", "990", "1024")


def pruned(path=FILE):
    """Nodes of the network up to the neck's maps, initial values by name, and the name of the input."""
    graph = onnx.load(str(path)).graph
    values = {i.name: numpy_helper.to_array(i) for i in graph.initializer}
    made = {o: n for n in graph.node for o in n.output}
    wanted, stack = set(), list(TAPS)
    while stack:
        name = stack.pop()
        if name in made and id(made[name]) not in wanted:
            wanted.add(id(made[name]))
            stack += made[name].input
    nodes = [n for n in graph.node if id(n) in wanted]
    used = {i for n in nodes for i in n.input}
    return nodes, {k: v for k, v in values.items() if k in used}, graph.input[0].name


class Yolox(nn.Module):
    """Feature maps of strides 8, 16, 32 (64, 128, 256 channels). Input: ImageNet-normalised RGB, sides multiples of 32."""

    CHANNELS = (64, 128, 256)

    def __init__(self, path=FILE):
        super().__init__()
        self.nodes, values, self.source = pruned(path)
        self.names = {}
        for i, (k, v) in enumerate(values.items()):
            self.names[k] = f"v{i}"
            self.register_buffer(f"v{i}", torch.from_numpy(np.array(v)))
        # the network was trained on BGR of 0 to 255
        std, mean = torch.tensor([0.229, 0.224, 0.225]), torch.tensor([0.485, 0.456, 0.406])
        self.register_buffer("scale", (255 * std)[None, :, None, None])
        self.register_buffer("shift", (255 * mean)[None, :, None, None])

    def forward(self, x):
        value = {self.source: (x * self.scale + self.shift).flip(1)}

        def get(name):
            return value[name] if name in value else getattr(self, self.names[name])

        for n in self.nodes:
            a = {v.name: onnx.helper.get_attribute_value(v) for v in n.attribute}
            i = get(n.input[0])
            if n.op_type == "Conv":
                b = get(n.input[2]) if len(n.input) > 2 else None
                o = F.conv2d(i, get(n.input[1]), b, a["strides"], a["pads"][:2], a.get("dilations", 1), a["group"])
            elif n.op_type == "Sigmoid":
                o = torch.sigmoid(i)
            elif n.op_type in ("Mul", "Add"):
                o = i * get(n.input[1]) if n.op_type == "Mul" else i + get(n.input[1])
            elif n.op_type == "Concat":
                o = torch.cat([get(k) for k in n.input], a["axis"])
            elif n.op_type == "MaxPool":
                o = F.max_pool2d(i, a["kernel_shape"], a["strides"], a["pads"][:2])
            elif n.op_type == "Slice":
                start, axis, step = (int(get(n.input[k])[0]) for k in (1, 3, 4))
                o = i[:, :, start::step] if axis == 2 else i[:, :, :, start::step]
            elif n.op_type == "Resize":
                o = F.interpolate(i, scale_factor=2, mode="nearest")
            else:
                raise SystemExit(f"{FILE}: unknown operation {n.op_type}")
            value[n.output[0]] = o
        return [value[t] for t in TAPS]


def written(g, x, net):
    """The same, node by node into a graph; returns its three maps."""
    x = g.op("Add", g.op("Mul", x, g.constant(net.scale)), g.constant(net.shift))
    value = {net.source: g.op("Gather", x, g.constant([2, 1, 0], np.int64), axis=1)}

    def get(name):
        if name not in value:
            v = getattr(net, net.names[name])
            value[name] = g.constant(v, np.int64 if v.dtype == torch.int64 else np.float32)
        return value[name]

    for n in net.nodes:
        a = {v.name: onnx.helper.get_attribute_value(v) for v in n.attribute}
        if n.op_type == "Resize":
            value[n.output[0]] = g.op("Resize", get(n.input[0]), "", g.constant([1, 1, 2, 2]), mode="nearest", coordinate_transformation_mode="asymmetric", nearest_mode="floor")
            continue
        value[n.output[0]] = g.op(n.op_type, *(get(k) for k in n.input), **a)
    return [value[t] for t in TAPS]
