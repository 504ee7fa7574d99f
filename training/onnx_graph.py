"""Writes ONNX graphs node by node: every dimension dynamic, large weights stored as float16."""

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper


class Graph:
    def __init__(self, name, half=True):
        self.name, self.half, self.nodes, self.constants, self.count = name, half, [], [], 0
        self.inputs, self.outputs = [], []

    def new_name(self, hint):
        self.count += 1
        return f"{hint}{self.count}"

    def input(self, name, shape):
        self.inputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
        return name

    def output(self, value, name, shape):
        self.nodes.append(helper.make_node("Identity", [value], [name]))
        self.outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))

    def constant(self, array, dtype=np.float32):
        array = np.asarray(array.detach().cpu().numpy() if torch.is_tensor(array) else array).astype(dtype)
        name = self.new_name("c")
        # the session casts float16 weights when it loads, so they cost nothing at run time
        if self.half and dtype == np.float32 and array.size >= 512:
            self.constants.append(numpy_helper.from_array(array.astype(np.float16), name))
            return self.op("Cast", name, to=TensorProto.FLOAT)
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def op(self, kind, *inputs, **attributes):
        out = self.new_name(kind.lower())
        self.nodes.append(helper.make_node(kind, list(inputs), [out], **attributes))
        return out

    def conv(self, x, weight, bias, stride=1, pads=None, group=1):
        k = weight.shape[-1]
        pads = pads if pads is not None else [k // 2] * 4
        return self.op("Conv", x, self.constant(weight), self.constant(bias), strides=[stride] * 2, pads=pads, group=group, kernel_shape=[k, k])

    def layer(self, x, conv, relu=False):
        """Adds a torch Conv2d."""
        p = conv.padding[0]
        y = self.conv(x, conv.weight, conv.bias, conv.stride[0], [p] * 4, conv.groups)
        return self.op("Relu", y) if relu else y

    def double(self, x):
        return self.stretched(x, 2)

    def stretched(self, x, by):
        scales = self.constant([1, 1, by, by])
        return self.op("Resize", x, "", scales, mode="linear", coordinate_transformation_mode="half_pixel")

    def save(self, path, about):
        graph = helper.make_graph(self.nodes, self.name, self.inputs, self.outputs, self.constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], producer_name="tmpi training")
        model.ir_version = 8
        for k, v in about.items():
            entry = model.metadata_props.add()
            entry.key, entry.value = k, v
        onnx.checker.check_model(model)
        onnx.save(model, str(path))


def run(path, inputs):
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"]).run(None, {k: v.numpy() for k, v in inputs.items()})


def check(path, module, inputs, bound=1e-4):
    """Largest difference between ONNX Runtime and PyTorch, relative to the output's range; fails above `bound`."""
    with torch.no_grad():
        want = module(*inputs.values())
    want = want if isinstance(want, (tuple, list)) else [want]
    worst = 0.0
    for w, h in zip(want, run(path, inputs), strict=True):
        w = w.numpy()
        if w.shape != h.shape or not np.isfinite(h).all() or not np.isfinite(w).all():
            raise SystemExit(f"{path}: wrong shape or values: {w.shape}, {h.shape}")
        worst = max(worst, float(np.abs(w - h).max() / max(1.0, np.abs(w).max())))
    if not worst < bound:
        raise SystemExit(f"{path}: ONNX Runtime differs from PyTorch by {worst:.2e}")
    return worst


def halved(module):
    """Rounds large weights to float16 as in the file, so that the check compares equal weights."""
    with torch.no_grad():
        for t in module.state_dict().values():
            if t.dtype == torch.float32 and t.numel() >= 512:
                t.copy_(t.half().float())
    return module


def encoder(g, x, e):
    """The feature maps of `network.Encoder`."""
    zero, six = g.constant(np.float32(0)), g.constant(np.float32(6))

    def conv(x, c, relu=True):
        before, behind = c.pads
        y = g.conv(x, c.folded(), c.bias, c.stride, [before, before, behind, behind], c.groups)
        return g.op("Clip", y, zero, six) if relu else y

    x, found = conv(g.op("Add", g.op("Mul", x, g.constant(e.gain)), g.constant(e.shift)), e.stem), []
    for n, block in enumerate(e.blocks):
        y = x if block.expand is None else conv(x, block.expand)
        y = conv(conv(y, block.depth), block.project, relu=False)
        x = g.op("Add", x, y) if block.shortcut else y
        if n in e.taps:
            found.append(x)
    return found


def ones_of(g, x):
    """Ones of the shape [N,1,H,W] of a map."""
    mean = g.op("ReduceMean", x, axes=[1], keepdims=1)
    return g.op("Add", g.op("Mul", mean, g.constant(np.float32(0))), g.constant(np.float32(1)))


def unit(g, x):
    x = g.op("Sub", x, g.op("ReduceMean", x, axes=[2, 3], keepdims=1))
    var = g.op("Add", g.op("ReduceMean", g.op("Mul", x, x), axes=[2, 3], keepdims=1), g.constant(np.float32(1e-12)))
    return g.op("Div", x, g.op("Sqrt", var))


def decoder(g, features, d):
    """The map of `network.Decoder` with folded BatchNorms."""
    coarse = features[4]
    one = ones_of(g, coarse)
    rows = g.op("CumSum", one, g.constant(np.int64(2), np.int64))
    total = g.op("ReduceSum", one, g.constant([2], np.int64), keepdims=1)
    row = g.op("Sub", g.op("Mul", g.op("Div", rows, total), g.constant(np.float32(2))), g.constant(np.float32(1)))
    x = g.layer(g.op("Concat", coarse, row, axis=1), d.top, relu=True)
    c = g.op("ReduceMean", x, axes=[2, 3], keepdims=1)
    c = g.layer(g.layer(c, d.context[0], relu=True), d.context[2])
    x = g.layer(g.op("Add", x, c), d.mix[0], relu=True)
    for i in (3, 2, 1, 0):
        x = g.layer(g.op("Concat", g.double(x), g.layer(features[i], d.side[i]), axis=1), d.join[i][0], relu=True)
    return g.layer(x, d.head)


def depth(g, image, net):
    """The map of `network.Shipped` without a ramp."""
    return unit(g, g.double(decoder(g, encoder(g, image, net.encoder), net.decoder)))
