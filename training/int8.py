"""Quantises an exported network to int8 (static, QDQ, one scale a channel), calibrated on held-out scenes, and measures what that costs.

    python int8.py ../models/depth.onnx runs/depth-int8.onnx

Prints the differences of the maps, and times of one thread, run in turns. `eval_depth.py` takes the result like any other network."""

import argparse
import random
import tempfile
import time

import cv2
import numpy as np
import onnx
import onnxruntime as ort
import torch
from onnx import TensorProto, numpy_helper
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static

import common
from common import RUNS
from eval_depth import size_for
from network import MEAN, STD

# (height, width) that the program runs the depth network at, for photos of 3:2, 16:9, 1:1 and 2:3
SIZES = [size_for(h, w) for w, h in ((3, 2), (16, 9), (1, 1), (2, 3))]


def inputs(kind, folders, count, sizes=SIZES):
    """Inputs of the network from scenes that no network was trained on."""
    rng = random.Random(5)
    for i, f in enumerate(folders[:count]):
        rgb, d = common.framed(*common.read_pair(f), sizes[i % len(sizes)], rng)
        x = common.chw(common.photometric(rgb, d, rng))
        if kind == "image":
            yield {"image": ((x - MEAN) / STD)[None].numpy()}
        else:
            yield {"input": torch.cat([x, torch.from_numpy(d)[None]])[None].numpy()}


class Reader(CalibrationDataReader):
    def __init__(self, samples):
        self.samples = iter(samples)

    def get_next(self):
        return next(self.samples, None)


def widened(path, out):
    """The graph with weights of 32 bits in place of those of 16 bits that are cast."""
    m = onnx.load(str(path))
    values = {i.name: i for i in m.graph.initializer}
    for n in [n for n in m.graph.node if n.op_type == "Cast" and n.input[0] in values]:
        wide = numpy_helper.to_array(values[n.input[0]]).astype(np.float32)
        m.graph.initializer.append(numpy_helper.from_array(wide, n.output[0]))
        m.graph.initializer.remove(values[n.input[0]])
        m.graph.node.remove(n)
    onnx.save(m, out)


def session(path):
    o = ort.SessionOptions()
    o.intra_op_num_threads = 1
    return ort.InferenceSession(str(path), o, providers=["CPUExecutionProvider"])


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("model")
    a.add_argument("out")
    a.add_argument("--scenes", nargs="+", default=[str(RUNS / "data" / "held")])
    a.add_argument("--count", type=int, default=24)
    a.add_argument("--calibrate", choices=["minmax", "percentile", "entropy"], default="percentile")
    a.add_argument("--rounds", type=int, default=40)
    a.add_argument("--keep", type=int, default=0, help="leave that many convolutions at the end in 32 bits")
    a = a.parse_args()
    cv2.setNumThreads(1)
    folders = common.scenes(*a.scenes)
    kind = session(a.model).get_inputs()[0].name
    with tempfile.TemporaryDirectory() as t:
        wide = f"{t}/wide.onnx"
        widened(a.model, wide)
        m = onnx.load(wide)
        for i, n in enumerate(m.graph.node):
            n.name = n.name or f"{n.op_type}_{i}"
        convolutions = [n.name for n in m.graph.node if n.op_type == "Conv"]
        onnx.save(m, wide)
        # histograms want maps of one size: that of most photos
        samples = inputs(kind, folders, a.count, SIZES if a.calibrate == "minmax" else SIZES[:1])
        quantize_static(
            wide, a.out, Reader(samples), quant_format=QuantFormat.QDQ, per_channel=True, activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8, op_types_to_quantize=["Conv", "Add", "Concat", "Clip", "Relu", "Mul", "Sigmoid", "MaxPool"],
            nodes_to_exclude=convolutions[len(convolutions) - a.keep :], calibrate_method=getattr(CalibrationMethod, {"minmax": "MinMax"}.get(a.calibrate, a.calibrate.title())),
        )  # fmt: skip
        pair = [session(wide), session(a.out)]
    difference, times = [], ([], [])
    for x in inputs(kind, folders[a.count :], 8):
        p, q = (s.run(None, x)[0] for s in pair)
        difference.append(np.abs(p - q).mean() / p.std())
    for size in SIZES:
        x = next(inputs(kind, folders[1:], 1, [size]))
        for _ in range(a.rounds):
            for s, t in zip(pair, times):
                start = time.perf_counter()
                s.run(None, x)
                t.append((size, time.perf_counter() - start))
    print(f"maps differ by {np.mean(difference):.3f} of their deviation in the mean")
    for size in SIZES:
        fp32, int8 = (1e3 * np.median([s for z, s in t if z == size]) for t in times)
        print(f"{size[1]}×{size[0]}: fp32 {fp32:.2f} ms, int8 {int8:.2f} ms")
    print(f"{a.out}: {common.Path(a.out).stat().st_size} bytes against {common.Path(a.model).stat().st_size}")


if __name__ == "__main__":
    main()
