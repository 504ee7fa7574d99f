"""Writes models/depth.onnx, theta.onnx or psi.onnx from a checkpoint, and their origin into their cards; compares ONNX Runtime with PyTorch."""

import argparse

import numpy as np
import torch
from torch.nn.utils.fusion import fuse_conv_bn_eval

import common
import onnx_graph
import run_record
from common import MODELS, RUNS
from network import Conv, DepthNet, Shipped
from onnx_graph import Graph, check, halved

LICENCE = "MIT OR Apache-2.0"


def depth(path, checkpoint):
    net = folded(DepthNet.of(checkpoint))
    g = Graph("tmpi depth")
    g.output(onnx_graph.depth(g, g.input("image", ["n", 3, "h", "w"]), net), "disparity", ["n", 1, "h", "w"])
    g.save(path, {"licence": f"{LICENCE}; encoder: EfficientNet-Lite2, Apache-2.0"})
    inputs = [{"image": torch.randn(n, 3, h, w)} for n, h, w in ((1, 192, 288), (2, 96, 288), (1, 288, 96))]
    return [check(path, Shipped(net), i) for i in inputs]


@torch.no_grad()
def folded(net):
    """Folds factors and BatchNorms into convolutions, and rounds weights as in the file."""
    for m in net.modules():
        if isinstance(m, Conv):
            m.weight.copy_(m.folded())
            m.scale.fill_(1)
    for b in net.decoder.blocks():
        b[0], b[1] = fuse_conv_bn_eval(b[0], b[1]), torch.nn.Identity()
    return halved(net)


def theta(path, checkpoint):
    from theta import Theta

    net = Theta().eval()
    checkpoint = torch.load(checkpoint, weights_only=False, map_location="cpu")
    net.load_state_dict(checkpoint["mean"])
    g = Graph("tmpi theta", half=False)
    x = g.input("input", ["n", 4, "h", "w"])

    def dilate(v):
        return g.op("MaxPool", v, kernel_shape=[3, 3], pads=[1] * 4)

    def erode(v):
        return g.op("Neg", dilate(g.op("Neg", v)))

    def blurred(v, k):
        return g.op("AveragePool", v, kernel_shape=[k, k], pads=[k // 2] * 4, count_include_pad=0)

    def part(v, a, b):
        return g.op("Slice", v, *(g.constant([i], np.int64) for i in (a, b, 1)))

    def layer(v, c):
        return g.op("LeakyRelu", g.layer(v, c), alpha=0.1)

    d = part(x, 3, 4)
    clean = g.op("Add", erode(dilate(dilate(erode(d)))), dilate(erode(erode(dilate(d)))))
    clean = g.op("Mul", clean, g.constant(np.float32(0.5)))
    quarter = g.op("AveragePool", d, kernel_shape=[4, 4], strides=[4, 4])
    eighth = g.op("AveragePool", quarter, kernel_shape=[2, 2], strides=[2, 2])
    wide = [g.stretched(blurred(v, 5), k) for v, k in ((quarter, 4), (eighth, 8))]
    others = g.op("Concat", clean, blurred(clean, 5), blurred(d, 5), blurred(d, 9), *wide, axis=1)
    difference = g.op("Mul", g.op("Sub", others, d), g.constant(np.float32(8)))
    f0 = layer(g.op("Concat", x, difference, axis=1), net.e0)
    f1 = layer(f0, net.e1)
    f2 = layer(layer(f1, net.e2), net.m2)
    f3 = layer(layer(f2, net.e3), net.e4)
    g2 = layer(g.op("Add", g.double(g.layer(f3, net.u2)), f2), net.d2)
    g1 = layer(g.op("Add", g.double(g.layer(g2, net.u1)), f1), net.d1)
    g0 = layer(g.op("Add", g.double(g.layer(g1, net.u0)), f0), net.d0)
    y = g.layer(g0, net.heads)
    # ONNX Runtime's Softmax over channels is sequential and takes as long as everything else
    logits, channels = part(y, 0, 7), g.constant([1], np.int64)
    weights = g.op("Exp", g.op("Sub", logits, g.op("ReduceMax", logits, axes=[1], keepdims=1)))
    total = g.op("ReduceSum", weights, channels, keepdims=1)
    mixed = g.op("Div", g.op("ReduceSum", g.op("Mul", weights, g.op("Concat", d, others, axis=1)), channels, keepdims=1), total)
    mixed = g.op("Add", mixed, g.op("Mul", g.op("Tanh", part(y, 7, 8)), g.constant(np.float32(net.STEP))))
    g.output(g.op("Clip", mixed, g.constant(np.float32(0)), g.constant(np.float32(1))), "disparity", ["n", 1, "h", "w"])
    g.output(g.op("Sigmoid", part(y, 8, 9)), "confidence", ["n", 1, "h", "w"])
    g.save(path, {"licence": LICENCE, "step": str(checkpoint["step"])})
    inputs = [{"input": torch.rand(n, 4, h, w)} for n, h, w in ((1, 64, 96), (2, 352, 640), (1, 16, 16))]
    return [check(path, net, i) for i in inputs]


def psi(path, checkpoint):
    from psi import Psi

    net = Psi().eval()
    checkpoint = torch.load(checkpoint, weights_only=False, map_location="cpu")
    net.load_state_dict(checkpoint["mean"])
    g = Graph("tmpi psi", half=False)
    x = g.input("layers", ["n", 9, "h", "w"])

    def part(v, a, b):
        return g.op("Slice", v, *(g.constant([i], np.int64) for i in (a, b, 1)))

    centred = g.op("Add", g.op("Mul", x, g.constant(net.scale)), g.constant(net.shift))
    f1 = g.layer(centred, net.e1, relu=True)
    f2 = g.layer(g.layer(f1, net.e2, relu=True), net.m2, relu=True)
    f3 = g.layer(g.layer(g.layer(f2, net.e3, relu=True), net.m3, relu=True), net.m4, relu=True)
    g2 = g.layer(g.op("Add", g.double(g.layer(f3, net.u2)), f2), net.d2, relu=True)
    g1 = g.layer(g.op("Add", g.double(g.layer(g2, net.u1)), f1), net.d1, relu=True)
    colour = g.op("Add", part(x, 0, 3), g.op("Mul", g.double(g.layer(g1, net.head)), part(x, 8, 9)))
    g.output(g.op("Clip", colour, g.constant(np.float32(0)), g.constant(np.float32(1))), "background", ["n", 3, "h", "w"])
    g.save(path, {"licence": LICENCE, "step": str(checkpoint["step"])})
    inputs = [{"layers": torch.rand(n, 9, h, w)} for n, h, w in ((3, 64, 64), (1, 16, 48), (2, 128, 64))]
    return [check(path, net, i) for i in inputs]


def main():
    a = argparse.ArgumentParser(description=__doc__)
    a.add_argument("model", choices=["depth", "theta", "psi"])
    a.add_argument("--checkpoint", type=common.Path)
    a.add_argument("--out", type=common.Path, help="output file instead of models/NAME.onnx; leaves the card unchanged")
    a = a.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    path = a.out or MODELS / f"{a.model}.onnx"
    path.parent.mkdir(parents=True, exist_ok=True)
    source = a.checkpoint or RUNS / {"depth": "depth/best.pt", "theta": "theta/last.pt", "psi": "psi/last.pt"}[a.model]
    worst = {"depth": depth, "theta": theta, "psi": psi}[a.model](path, source)
    record = run_record.exported(source, path)
    if not a.out:
        run_record.into_card(path.with_suffix(".md"), run_record.block(path, record))
    print(f"{path}: {path.stat().st_size} bytes, ONNX Runtime and PyTorch differ by at most {max(worst):.1e}")


if __name__ == "__main__":
    main()
